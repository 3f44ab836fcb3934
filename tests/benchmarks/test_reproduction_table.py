"""The tables of docs/reproduction.md: from rows to Markdown, and into the page."""

import json
from pathlib import Path

import pytest
from studies import reproduction_table as page

ROOT = Path(__file__).resolve().parents[2]


def cartpole_row(policy, **values):
    row = {
        "policy": policy,
        "bound": 0.75,
        "success_rate": 0.5,
        "success_ci95": [0.4, 0.6],
        "effort_mean": 12.0,
        "effort_ci95": [10.0, 14.0],
        "step_time_median_s": 2.5e-3,
        "mean_tracking_error": [0.0, 0.5, None],
        "tracking_error_mean_below_tube": True,
        "tube_violation_rate": 0.031,
        "versus": {"tube-mpc": {"effort_ratio": 1.25, "effort_ratio_ci95": [1.2, 1.3]}},
    }
    return {**row, **values}


def test_ours_stand_beside_the_papers():
    rows = [cartpole_row("lagros"), cartpole_row("learned", bound=0.3)]
    lines = page.cartpole_table(rows).splitlines()
    assert lines[-1].startswith(
        "| (c) lagros | 100.0 | 50.0 (40.0–60.0) | 567 | 12.0 (10.0–14.0) |"
    )
    assert "30.1 ms | 2.5 ms |" in lines[-1]
    # (a) was only run under another bound, (b) not at all.
    assert lines[2].count("–") == lines[3].count("–") == 3
    assert "| 0.500 | 3.1 |" in page.cartpole_curve_table(rows)
    assert "| 1.092 | 1.25 (1.20–1.30) |" in page.ratio_table(rows, [], [])


def test_published_ratios_follow_from_the_figure():
    text = page.ratio_table([], [], [])
    for ratio in ("1.23", "2.01", "1.25", "1.36", "1.41"):
        assert f"{ratio} (figure)" in text


def test_results_that_are_not_there_leave_dashes(tmp_path):
    found = page.tables(tmp_path)
    assert set(found) >= {"cartpole", "spacecraft-success", "spacecraft-time"}
    assert "13.3" in found["spacecraft-success"]
    rows = [cartpole_row(name) for name in ("learned", "tube-mpc", "lagros")]
    (tmp_path / "cartpole_uniform.json").write_text(json.dumps(rows))
    assert page.tables(tmp_path)["cartpole"].count("50.0 (40.0–60.0)") == 3


def test_page_keeps_all_but_its_tables():
    found = {"one": "| new |", "two": "| \\1 |"}
    text = (
        "a\n<!-- table: one -->\n| old |\n<!-- end -->\nb\n<!-- table: two -->\n<!-- end -->\nc\n"
    )
    wanted = (
        "a\n<!-- table: one -->\n| new |\n<!-- end -->\n"
        "b\n<!-- table: two -->\n| \\1 |\n<!-- end -->\nc\n"
    )
    assert page.update(text, found) == wanted
    assert page.update(wanted, found) == wanted
    with pytest.raises(ValueError, match="three"):
        page.update(text, {"three": ""})


def test_the_page_has_a_place_for_every_table(tmp_path):
    text = (ROOT / "docs" / "reproduction.md").read_text()
    page.update(text, page.tables(tmp_path))
