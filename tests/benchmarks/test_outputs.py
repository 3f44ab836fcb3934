"""Files, tables and figures of a run."""

from __future__ import annotations

import csv
import io
import json
import os

import matplotlib.image
import numpy as np
import pytest
from rich.console import Console

from lagros_benchmarks.report import canvas, figures, formats, single_figures, tables
from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.run import files
from lagros_benchmarks.run.runner import run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_policies.policy import NAMES
from lagros_policies.tasks.spacecraft import SPACECRAFT_NAMES
from tests.benchmarks import fakes

POLICIES = ("steady", "idle", "raising")


@pytest.fixture(scope="module")
def rows():
    settings = BenchmarkSettings(policies=POLICIES, episodes=12)
    return summarise(run_benchmark(settings, fakes.TOOLBOX))


@pytest.fixture(scope="module")
def grid_rows():
    settings = BenchmarkSettings(
        policies=("steady", "idle"),
        episodes=4,
        disturbances=("none", "uniform", "constant", "gust"),
        bounds=(0.1, 0.75),
    )
    return summarise(run_benchmark(settings, fakes.EASY))


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = files.write_atomic(tmp_path / "results.json", "old")

    def broken(*args):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises(OSError, match="disk full"):
        files.write_atomic(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["results.json"]


def test_others_may_read_what_is_written(tmp_path):
    mask = os.umask(0o022)
    try:
        path = files.write_atomic(tmp_path / "results.json", b"{}")
    finally:
        os.umask(mask)
    assert path.stat().st_mode & 0o777 == 0o644


def test_what_is_not_finite_becomes_null(tmp_path):
    value = {"a": np.array([1.0, np.inf]), "b": (np.float64("nan"), np.int64(3)), "c": []}
    path = files.write_json(tmp_path / "x.json", value)
    assert json.loads(path.read_text()) == {"a": [1.0, None], "b": [None, 3], "c": []}


def printed(rows):
    console = Console(file=io.StringIO(), width=80, highlight=False)
    for group in formats.by_condition(rows):
        console.print(tables.terminal_table(group))
    return console.file.getvalue()


def wide(row):
    """The widest figures that a run can bring."""
    return {
        **row,
        "policy": "runs/a-model-with-a-very-long-name.zip",
        "disturbance": "sinusoid",
        "success_rate": 0.9996,
        "success_ci95": (0.996, 1.0),
        "effort_mean": 123456.7,
        "step_time_median_s": 0.0123456,
        "step_time_p99_s": 12.345,
        "channels": "rates",
        "episodes": 1000,
    }


def test_no_line_of_the_table_is_longer_than_80_columns_or_cut(rows):
    text = printed([*rows, *(wide(row) for row in rows)])
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    assert "…" not in text.replace("a-model-wit…", "")
    # Each condition and each policy has its line.
    assert text.count("steady") == 1
    assert text.count("a-model-wit…") == 3
    assert "99.9 (99.6–100.0)" in text


def test_lines_below_the_table_name_the_reference_and_the_errors(rows):
    comparison = list(tables.comparison_lines(rows))
    assert comparison[0] == (
        "Against steady on the same episodes; effort ratio where both succeed:"
    )
    assert all(len(line) <= 80 for line in comparison)
    errors = list(tables.error_lines(rows, most=1))
    assert errors[0].startswith("! raising, uniform 0.75:")
    assert "ArithmeticError" in errors[1]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (0.0, "0"),
        (0.01234, "0.0123"),
        (1.0, "1.00"),
        (95.23, "95.2"),
        (567.8, "568"),
        (12345.6, "12346"),
        (1e20, "1e20"),
        (-2.5, "-2.50"),
    ],
)
def test_numbers_have_three_digits(value, text):
    assert formats.number(value) == text


@pytest.mark.parametrize(
    ("rate", "text"),
    [(1.0, "100.0"), (0.9996, "99.9"), (0.0, "0.0"), (0.0004, "<0.1"), (0.5, "50.0"), (None, "–")],
)
def test_percent_rounds_to_certainty_only_if_it_is(rate, text):
    assert formats.percent(rate) == text


def test_the_paper_letters_its_methods():
    assert formats.policy_label("tube-mpc") == "(b) tube-mpc"
    assert formats.policy_label("tube-mpc:gain") == "(b) gain"
    assert formats.policy_label("runs/ppo.zip") == "ppo.zip"
    assert formats.policy_label("a_package.policies:Mine") == "Mine"


def test_policies_of_one_label_are_told_apart(rows, grid_rows):
    names = {"steady": "one:Good", "idle": "another.one:Good"}

    def renamed(group):
        text = json.dumps(group, default=float)
        for before, after in names.items():
            text = text.replace(f'"{before}"', f'"{after}"')
        return json.loads(text)

    said = "Good, always in this order: one:Good, another.one:Good"
    for given in (renamed(grid_rows), renamed(rows)):
        assert said in tables.error_lines(given)
        assert said in tables.markdown_text(given)
        assert said in tables.latex_text(given)
        assert said in formats.figure_note(given)
    assert not formats.names_lines(rows)


def test_csv_has_a_line_per_row_and_no_curves(rows):
    read = list(csv.DictReader(io.StringIO(tables.csv_text(rows))))
    assert [line["policy"] for line in read] == list(POLICIES)
    assert float(read[0]["success_ci95_low"]) == rows[0]["success_ci95"][0]
    assert int(read[2]["errors"]) == len(rows[2]["errors"])
    assert "time_s" not in read[0]
    assert all(None not in line and None not in line.values() for line in read)


def test_latex_is_a_booktabs_table_per_condition(grid_rows):
    text = tables.latex_text([{**row, "policy": "a_b & c%"} for row in grid_rows])
    assert text.count(r"\toprule") == text.count(r"\end{tabular}") == 7
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len(body) == 14 + 7
    # Escaped, so that each line has its seven columns.
    assert all(line.replace(r"\&", "").count("&") == 6 for line in body)
    assert r"a\_b \& c\%" in text


def test_the_error_figure_is_drawn(rows, tmp_path):
    path = figures.draw(rows, tmp_path / "error.png")
    image = matplotlib.image.imread(path)
    assert image.shape[:2] == (630, 1050)
    # It holds lines in several colours, and not only axes.
    assert len(np.unique(image[..., :3].reshape(-1, 3), axis=0)) > 100


def test_the_error_figure_takes_what_json_made_of_the_rows(rows, tmp_path):
    far = {**rows[0], "mean_tracking_error": [0.0, *np.geomspace(0.1, 500.0, 88), np.inf, np.inf]}
    again = json.loads(json.dumps(files.plain([far, *rows[1:]])))
    assert single_figures.error_figure(again, tmp_path / "log.png").stat().st_size > 10_000


def test_the_success_figure_is_drawn(grid_rows, tmp_path):
    path = figures.draw(grid_rows, tmp_path / "grid.png")
    height, width = matplotlib.image.imread(path).shape[:2]
    assert (width, height) == (1560, 480)


@pytest.mark.parametrize("count", range(1, 9))
def test_one_place_of_the_success_figure_stays_empty_at_most(grid_rows, monkeypatch, count):
    drawn = []
    monkeypatch.setattr(single_figures, "save", lambda figure, _: drawn.append(figure))
    kinds = [f"kind {number}" for number in range(count)]
    rows = [{**row, "disturbance": kind} for row in grid_rows[:4] for kind in kinds]
    single_figures.grid_figure(rows, "grid.png")
    (figure,) = drawn
    shown = [axes for axes in figure.axes if axes.axison]
    assert [axes.get_title("left") for axes in shown] == kinds
    assert len(figure.axes) - count <= 1
    legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes if axes.get_legend())]
    names = [[text.get_text() for text in legend.get_texts()] for legend in legends]
    policies = dict.fromkeys(row["policy"] for row in rows)
    assert names == [[formats.policy_label(name, 24) for name in policies]]


@pytest.mark.parametrize("suffix", ["pdf", "svg"])
def test_figures_for_print(rows, tmp_path, suffix):
    path = single_figures.error_figure(rows, tmp_path / f"error.{suffix}")
    assert path.stat().st_size > 5_000


def test_a_figure_says_what_it_cannot_draw(rows, grid_rows, tmp_path):
    with pytest.raises(ValueError, match="must end in"):
        single_figures.error_figure(rows, tmp_path / "error.gif")
    with pytest.raises(ValueError, match="one condition"):
        single_figures.error_figure(grid_rows, tmp_path / "error.png")


def test_rows_without_an_error_still_have_their_figure(rows, tmp_path):
    bare = [{**row, "mean_tracking_error": None} for row in rows]
    path = single_figures.error_figure(bare, tmp_path / "error.svg")
    assert "every nominal plan failed" in path.read_text(encoding="utf-8")


def test_known_policies_always_look_the_same_and_all_differ():
    known = dict.fromkeys(name for name in (*NAMES, *SPACECRAFT_NAMES) if ":" not in name)
    names = ["x.zip", *known, "y.zip", "mine:A", "mine:B", "mine:C"]
    found = canvas.styles(names)
    for name in known:
        assert canvas.styles(["z.zip", name])[name] == found[name]
    for part in ("colour", "line", "marker"):
        # Only (d) and LQR, which no task has both of, share a mark.
        same = len(names) - len({str(getattr(style, part)) for style in found.values()})
        assert same == (part == "marker")
    assert canvas.BLACK not in {style.colour for style in found.values()}  # that of the tubes


@pytest.mark.parametrize(
    ("ends", "labels"),
    [
        ((0.16, 7.0), ["0.2", "0.5", "1", "2", "5"]),
        ((0.3, 22.0), ["0.5", "1", "2", "5", "10", "20"]),
        ((0.005, 90.0), ["0.01", "0.1", "1", "10"]),
    ],
)
def test_a_logarithmic_ordinate_has_few_and_plain_labels(ends, labels):
    figure, (axes,) = canvas.canvas(4.0, 3.0)
    axes.plot([0.0, 1.0], ends)
    axes.set_ylim(*ends)
    canvas.log_ordinate(axes)
    figure.draw_without_rendering()
    low, high = axes.get_ylim()
    marks = [*axes.yaxis.get_major_ticks(), *axes.yaxis.get_minor_ticks()]
    shown = [mark.label1.get_text() for mark in marks if low <= mark.get_loc() <= high]
    assert [text for text in shown if text] == labels


def test_markdown_is_one_table_with_the_paired_differences(rows):
    lines = tables.markdown_text(rows).splitlines()
    cells = [line.split("|") for line in lines if line.startswith("|")]
    assert len(cells) == 2 + len(POLICIES)
    assert len({len(line) for line in cells}) == 1
    assert sum(line.startswith("- ") for line in lines) == len(POLICIES) - 1
    assert tables.markdown_text(rows[:1]).count("|") > 0


def test_markdown_of_many_conditions_is_the_success_of_each(grid_rows):
    lines = [line for line in tables.markdown_text(grid_rows).splitlines() if "|" in line]
    conditions = {(row["disturbance"], row["bound"]) for row in grid_rows}
    assert len(lines) == 2 + len(conditions)
    assert f"{100 * grid_rows[0]['success_rate']:.1f}" in lines[2]
