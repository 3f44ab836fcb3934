"""docs/reproduction.md: its tables, from rows to Markdown and into the page, and derivations."""

import json
import re
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from studies import reproduction_table as page

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reproduction.md"
DERIVATIONS = ROOT / "benchmarks" / "studies" / "reproduction.md"


def cartpole_row(policy, **values):
    row = {
        "policy": policy,
        "bound": 0.75,
        "success_rate": 0.5,
        "success_ci95": [0.4, 0.6],
        "effort_mean": 12.0,
        "effort_ci95": [10.0, 14.0],
        "effort_total_mean": 13.0,
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
        "| (c) lagros | 100.0 | 50.0 (40.0–60.0) | 567 | 56.7 | 12.0 (10.0–14.0) | 13.0 |"
    )
    assert "30.1 ms | 2.5 ms |" in lines[-1]
    # (a) was only run under another bound, (b) not at all.
    assert lines[2].count("–") == lines[3].count("–") == 4
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


def test_the_page_holds_what_the_published_results_say():
    text = PAGE.read_text()
    assert page.update(text, page.tables(ROOT / "benchmarks" / "results")) == text


def test_success_by_the_papers_radius_has_a_line_of_its_own():
    row = {
        "policy": "lagros",
        "bound": 0.2,
        "success_rate": 0.97,
        "success_world_ci95": [0.96, 0.98],
        "paper_success_rate": 0.91,
        "paper_success_world_ci95": [0.9, 0.92],
    }
    lines = page.spacecraft_success_table([row], []).splitlines()
    assert any("| ours, r(t) | 91.0 (90.0–92.0) |" in line for line in lines)
    assert any("| ours | 97.0 (96.0–98.0) |" in line for line in lines)


def test_published_efforts_of_the_spacecraft_are_shared_among_agents_and_steps():
    # 1785 over six agents, in steps of 0.1 s.
    assert "| paper / 60 | 29.8 |" in page.spacecraft_effort_table([], [])


def test_published_rates_belong_to_270_agents():
    rates = [rate for row in page._FIGURE_SUCCESS.values() for rate in row]

    def fits(agents):
        nearest = [100.0 * round(0.01 * rate * agents) / agents for rate in rates]
        return np.allclose(nearest, rates, rtol=0.0, atol=0.0501)

    assert [agents for agents in range(20, 361) if fits(agents)] == [270]


def snippet(first_words):
    """Return the indented program of the derivations that begins so."""
    text = DERIVATIONS.read_text()
    found = re.search(rf"^( +){re.escape(first_words)}.*\n(?:\1.*\n)+", text, re.MULTILINE)
    assert found is not None
    return dedent(found[0])


def test_the_least_condition_number_at_the_upright(capsys):
    """The page gives what the program prints, but for its last digit: the solver's is its own."""
    exec(snippet("from lagros_policies.contraction import"), {})
    found = np.array(capsys.readouterr().out.split(), dtype=float).reshape(-1, 2)
    bounds, weights = (
        np.array(
            re.search(rf"{name} = ([\d.e+, ]+\d)", DERIVATIONS.read_text())[1].split(","), float
        )
        for name in ("prints χ", "and ν")
    )
    assert found[:, 0] == pytest.approx(bounds, rel=2e-3)
    assert found[:, 1] == pytest.approx(weights, rel=0.05)
    assert np.all(np.diff(bounds) < 0.0)
    assert bounds[-1] >= 114.8


def test_the_bound_below_it_needs_no_weight():
    """On the null space of B' the condition does not know nu; the linearisation is by hand."""
    import cvxpy as cp

    total, inertia, rate = 1.1, 0.5 * (4.0 / 3.0 - 0.1 / 1.1), 0.6
    spin = np.array([0.0, 9.8, 0.5 / total, -0.002 / (0.1 * 0.5)]) / inertia
    push = -1.0 / total / inertia
    share = 0.1 * 0.5 / total
    speed = np.array([0.0, 0.0, -0.5 / total, 0.0]) - share * spin
    slope = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], speed, spin])
    effect = np.array([0.0, 0.0, 1.0 / total - share * push, push])
    assert np.linalg.norm(effect) == pytest.approx(1.759, abs=5e-4)

    free = np.linalg.svd(effect[None])[2][1:].T
    dual, bound = cp.Variable((4, 4), symmetric=True), cp.Variable()
    flow = slope @ dual + dual @ slope.T + 2.0 * rate * dual
    ordered = [dual >> np.eye(4), dual << bound * np.eye(4), free.T @ flow @ free << 0]
    cp.Problem(cp.Minimize(bound), ordered).solve(solver="CLARABEL")
    assert bound.value == pytest.approx(114.8, abs=0.05)
    assert 0.75 / rate * np.sqrt(bound.value) == pytest.approx(13.4, abs=0.05)


@pytest.mark.slow
def test_what_a_plan_of_the_cartpole_costs(capsys):
    exec(snippet("import gymnasium as gym"), {})
    said = re.search(r"([\d.]+) N²s in the mean", PAGE.read_text())
    assert said is not None
    assert float(capsys.readouterr().out) == pytest.approx(float(said[1]), abs=0.1)
