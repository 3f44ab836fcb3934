"""Tables and figures of a spacecraft run, and the command that makes them."""

from __future__ import annotations

import csv
import dataclasses
import functools
import io
import json
import re

import matplotlib.image
import numpy as np
import pytest
from matplotlib.axes import Axes
from rich.cells import cell_len
from rich.console import Console
from rich.text import Text
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.report import figures, formats, tables
from lagros_benchmarks.report.canvas import save
from lagros_benchmarks.report.formats import percent
from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.run import files
from lagros_benchmarks.run.runner import fly_scene, run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_benchmarks.tasks.spacecraft import figures as spacecraft_figures
from lagros_benchmarks.tasks.spacecraft.scene_figure import scene_figure
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from tests.benchmarks import spacecraft_fakes as fakes

WIDTH = 80
POLICIES = ("learned", "raising", "lagros", "centralized")
STAND_INS = {"learned": "timid", "tube-mpc": "raising", "lagros": "spring", "centralized": "joint"}


def make_policy(name, env, settings):
    stand_in = STAND_INS.get(name, name)
    return fakes.make_policy(stand_in, env, {"after": 4.0} if stand_in == "raising" else {})


TOOLBOX = dataclasses.replace(fakes.TOOLBOX, make_policy=make_policy)


@pytest.fixture(scope="module", autouse=True)
def short_episodes():
    """A fifth of the time is enough for what is printed and drawn."""
    short = functools.partial(SpacecraftVectorEnv, settings=SpacecraftSettings(time_limit=9.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lagros_benchmarks.tasks.spacecraft.episodes.SpacecraftVectorEnv", short)
        yield


def rows_of(**changes):
    options = {"policies": POLICIES, "episodes": 3, "agents": (2,), "timing_episodes": 1}
    settings = BenchmarkSettings.for_task("spacecraft", **(options | changes))
    return summarise(run_benchmark(settings, TOOLBOX))


@pytest.fixture(scope="module")
def sweep(short_episodes):
    return rows_of(bounds=(0.2, 0.8))


@pytest.fixture(scope="module")
def scale(short_episodes):
    return rows_of(agents=(1, 3), bounds=(0.4,), preset="swarm", policies=("lagros", "centralized"))


LONG = "mine:AControllerWithAVeryLongName"


def wide(row):
    """The widest figures that a run can bring."""
    versus = {
        LONG if name == "raising" else name: {
            **values,
            "success_difference": -0.99,
            "success_difference_world_ci95": (-0.999, -0.888),
            "effort_ratio": 0.00123,
            "effort_ratio_ci95": (0.00111, 0.00222),
        }
        for name, values in row["versus"].items()
    }
    return {
        **row,
        "versus": versus,
        "policy": LONG if row["policy"] == "raising" else row["policy"],
        "bound": 0.12345,
        "disturbance": "sinusoid",
        "channels": "rates",
        "preset": "released",
        "agents": 32,
        "episodes": 100000,
        "success_rate": 0.9999,
        "success_world_ci95": (0.9987, 1.0),
        "strict_success_rate": 0.9996,
        "paper_success_rate": 0.9996,
        "collision_rate": 0.9996,
        "effort_mean": 12345.6,
        "step_time_median_s": 1.234,
        "step_time_p99_s": 12.34,
        "plan_time_median_s": None if row["plan_time_median_s"] is None else 43.21,
        "plan_time_p99_s": None if row["plan_time_p99_s"] is None else 98.76,
    }


def width(text):
    """The widest line of a text in columns: d̄ is one of them, though it is two characters."""
    return max(cell_len(line.rstrip()) for line in text.splitlines())


def colours_of(path):
    image = matplotlib.image.imread(path)[..., :3]
    pixels = np.unique(np.round(255 * image).astype(int).reshape(-1, 3), axis=0)
    return {tuple(pixel) for pixel in pixels.tolist()}


def printed(rows):
    console = Console(file=io.StringIO(), width=WIDTH, highlight=False)
    for group in formats.by_condition(rows):
        console.print(tables.terminal_table(group))
        for line in tables.comparison_lines(group):
            console.print(line, soft_wrap=True)
    for title, table in tables.sweep_tables(rows):
        console.print(Text(title), soft_wrap=True)
        console.print(table)
    return console.file.getvalue()


@pytest.mark.parametrize("change", [dict, wide])
def test_tables_fit_80_columns_and_lose_nothing(sweep, change):
    text = printed([change(row) for row in sweep])
    assert width(text) <= WIDTH
    if change is wide:
        for figure in ("99.9 (99.9–100.0)", "(d) centralized", "12346", "(c) lagros"):
            assert figure in text
        # No heading or number was cut off; a name of the user's is.
        assert all("ACon" in line for line in text.splitlines() if "…" in line)


def test_the_filter_stands_below_its_policy(sweep):
    lines = printed(sweep[:8]).splitlines()
    begin = next(at for at, line in enumerate(lines) if line.startswith("(a) learned"))
    names = [line[:15].strip() for line in lines[begin : begin + 8]]
    assert names == [
        *("(a) learned", "+ filter", "raising!", "+ filter!"),
        *("(c) lagros", "+ filter", "(d) centralized", "+ filter"),
    ]
    alone = [row for row in sweep[:8] if row["safety_filter"]]
    text = printed([{**row, "filter_effect": None} for row in alone])
    assert "(c) lagros" in text
    assert "+ filter" not in text
    assert "all with the safety filter" in text


def test_the_order_can_be_read_from_the_comparisons(sweep):
    text = printed(sweep[:8])
    assert "without the filter" in text
    assert "with the filter" in text
    row = next(r for r in sweep if r["policy"] == "lagros" and not r["safety_filter"])
    difference = 100 * row["versus"]["centralized"]["success_difference"]
    line = next(line for line in text.splitlines() if line.startswith("  (c) − (d)"))
    assert f"{difference:+.1f}".replace("-", "−") in line


def test_sweeps_have_a_column_per_bound_or_number_of_agents(sweep, scale):
    titles = [title for title, _ in tables.sweep_tables(sweep)]
    assert [title.partition(" ")[0] for title in titles] == ["Success", "Effort", "Effort", "Δt"]
    _, table = next(tables.sweep_tables(sweep))
    assert [column.header for column in table.columns] == ["d̄", "0.2", "0.8"]
    assert table.row_count == 8
    counts = [
        [column.header for column in table.columns] for _, table in tables.sweep_tables(scale)
    ]
    assert counts == [["agents", "1", "3"]] * 5
    assert list(tables.sweep_tables(sweep[:8])) == []


def test_many_bounds_are_broken_into_tables_that_fit(sweep):
    many = [{**row, "bound": bound} for bound in np.linspace(0.1, 0.9, 9) for row in sweep[:8]]
    headings = [
        [column.header for column in table.columns] for _, table in tables.sweep_tables(many)
    ]
    assert [len(names) for names in headings] == [6, 6, 6, 6, 5, 5, 5, 5]
    assert width(printed(many)) <= WIDTH


def test_errors_are_listed_by_world(sweep):
    lines = list(tables.error_lines(sweep, most=1))
    raised = [row for row in sweep if row["errors"]]
    assert raised
    assert "of 3 worlds raised and count as failures" in lines[0]
    assert any("raising + filter" in line for line in lines) == any(
        row["safety_filter"] for row in raised
    )


def test_csv_latex_and_markdown(sweep, scale):
    read = list(csv.DictReader(io.StringIO(tables.csv_text(sweep))))
    assert len(read) == len(sweep)
    assert float(read[0]["success_world_ci95_low"]) == sweep[0]["success_world_ci95"][0]
    assert "filter_effect" not in read[0]
    text = tables.latex_text(sweep)
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len(body) == len(sweep) + 2
    assert all(line.replace(r"\&", "").count("&") == 7 for line in body)
    assert "‖" not in "".join(body)
    for rows in (sweep, scale, sweep[:8]):
        lines = [line for line in tables.markdown_text(rows).splitlines() if "|" in line[:1]]
        assert len(lines) >= 2 + len({row["policy"] for row in rows})


@pytest.mark.parametrize("part", ["sweep", "kinds", "scale"])
def test_every_condition_is_in_the_markdown_and_in_the_figure(
    sweep, scale, part, tmp_path, monkeypatch
):
    calm = [{**row, "disturbance": "none", "bound": 0.0} for row in sweep[:8]]
    gust = [{**row, "disturbance": "gust"} for row in sweep[:8]]
    rows = {"sweep": [*calm, *sweep], "kinds": [*sweep[:8], *gust], "scale": scale}[part]
    marked = [{**row, "success_rate": 0.001 * (at + 1)} for at, row in enumerate(rows)]
    text = tables.markdown_text(marked)
    for row in marked:
        assert re.search(rf"\| {percent(row['success_rate'])} [±(]", text)
    drawn = []
    monkeypatch.setattr(Axes, "errorbar", lambda *_, **__: pytest.fail("conditions are mixed"))
    monkeypatch.setattr(
        spacecraft_figures, "_draw_lines", lambda _, part, *__: drawn.extend(map(id, part))
    )
    figures.draw(marked, tmp_path / "figure.png")
    assert set(drawn) == set(map(id, marked))


@pytest.mark.parametrize("part", ["sweep", "scale", "one"])
def test_figures_are_drawn_from_rows_that_json_has_seen(sweep, scale, part, tmp_path):
    rows = {"sweep": sweep, "scale": scale, "one": sweep[:8]}[part]
    again = json.loads(json.dumps(files.plain(rows)))
    path = figures.draw(again, tmp_path / "figure.png")
    colours = colours_of(path)
    # The line of (c), and what is not white.
    assert (0xD5, 0x5E, 0x00) in colours
    assert len(colours) > 100


def test_a_row_without_numbers_can_be_drawn(sweep, tmp_path):
    empty = {"effort_mean": None, "effort_ci95": None}
    rows = [{**row, **(empty if row["policy"] == "learned" else {})} for row in sweep]
    assert figures.draw(rows, tmp_path / "figure.svg").stat().st_size > 5_000
    assert figures.draw(rows[:8], tmp_path / "one.pdf").stat().st_size > 5_000


def test_the_scene_is_drawn(tmp_path, monkeypatch):
    titles = []

    def write(figure, path):
        titles.extend(axes.get_title("left") for axes in figure.axes if axes.axison)
        return save(figure, path)

    monkeypatch.setattr("lagros_benchmarks.tasks.spacecraft.scene_figure.write", write)
    settings = BenchmarkSettings.for_task(
        "spacecraft",
        policies=("lagros", "centralized", "learned"),
        episodes=2,
        bounds=(0.4,),
        agents=(3,),
    )
    scene = fly_scene(settings, 1, TOOLBOX)
    colours = colours_of(scene_figure(scene, tmp_path / "scene.png"))
    # An obstacle, and a path; the red of a collision where there is one.
    assert (0xC9, 0xC9, 0xC9) in colours
    assert (0x00, 0x72, 0xB2) in colours
    collided = any(a.collided for panel in scene.panels for a in panel.world.agents)
    assert ((0xB0, 0x00, 0x20) in colours) == collided
    for title, panel in zip(titles, scene.panels, strict=True):
        efforts = [agent.effort for agent in panel.world.agents]
        assert title.endswith(f"effort {np.mean(efforts):.2f} N²s")
    with pytest.raises(ValueError, match="must end in"):
        scene_figure(scene, tmp_path / "scene.gif")


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lagros_benchmarks.run.runner.Toolbox", lambda: TOOLBOX)
    return lambda *arguments: CliRunner().invoke(cli.app, arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--preset", "papper"), "Did you mean 'paper'"),
        (("--agents", "6,six"), "--agents: 'six' is not a whole number"),
        (("--agents", "0"), "agents=0 must be a whole number"),
        (("--safety-filter", "yes"), "Valid: none, all, both"),
        (
            ("--policies", "lqr"),
            "Valid: learned, tube-mpc, tube-mpc:least-norm, lagros, centralized",
        ),
        (("--disturbance", "worst"), "'worst' pushes away"),
        (("--replan-every", "2"), "--replan-every is for one body"),
        (("--scene", "s.gif"), "must end in .png"),
        (("--scene", "s.png", "--episodes", "2", "--scene-world", "2"), "scene_world=2"),
    ],
)
def test_a_mistake_is_explained(invoke, arguments, message):
    result = invoke("bench", "spacecraft", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("bench", "cartpole", "--scene", "s.png"), "cartpole has no worlds of agents"),
        (("bench", "cartpole", "--agents", "6"), "does not fit: cartpole is one body"),
    ],
)
def test_what_is_for_spacecraft_only_says_so(invoke, arguments, message):
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr


def test_bench_prints_the_tables_and_writes_the_files(invoke, tmp_path):
    names = ("a.json", "a.csv", "a.tex", "a.md", "a.png", "s.pdf", "a.jsonl")
    options = ("--json", "--csv", "--latex", "--markdown", "--figure", "--scene", "--episodes-file")
    written = [word for pair in zip(options, names, strict=True) for word in pair]
    result = invoke(
        *("bench", "spacecraft", "--policies", "tube-mpc,centralized", "--episodes", "2"),
        *("--agents", "2", "--bound", "0.2,0.4", "--timing-episodes", "1", "--seed", "5"),
        *written,
    )
    assert result.exit_code == 3, result.output  # worlds raised
    for text in ("(b) tube-mpc!", "(d) centralized", "+ filter", "(b) − (d)", "Success [%]"):
        assert text in result.stdout
    assert "[ms]" in result.stdout
    assert width(result.stdout) <= WIDTH
    for name in names:
        assert f"wrote {name}" in result.stdout
        assert (tmp_path / name).stat().st_size > 100
    rows = json.loads((tmp_path / "a.json").read_text())
    assert [(row["bound"], row["safety_filter"], row["policy"]) for row in rows] == [
        (bound, filtered, policy)
        for bound in (0.2, 0.4)
        for filtered in (False, True)
        for policy in ("tube-mpc", "centralized")
    ]
    assert {row["seed"] for row in rows} == {5}


def test_headings_below_a_markdown_table_are_no_entries_of_lists(sweep):
    blocks = tables.markdown_text([row for row in sweep if row["bound"] == 0.2]).split("\n\n")
    for heading in ("On the same agents, with", "On the same agents, without", "What the filter"):
        at = next(at for at, block in enumerate(blocks) if block.startswith(f"{heading}"))
        assert blocks[at].endswith("; effort ratio where both succeed:")
        lines = blocks[at + 1].splitlines()
        assert len(lines) == (4 if heading.startswith("What") else 3)
        assert all(line.startswith("- (") or "raising" in line for line in lines)
