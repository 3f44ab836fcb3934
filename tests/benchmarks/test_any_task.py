"""`lagros bench` on every task, and on one that stands in a file of a user's own."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.report import figures, tables
from lagros_benchmarks.run.room import room_named
from lagros_benchmarks.run.runner import run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_envs import registry
from lagros_envs.env import TaskEnv
from lagros_envs.registry import find_task, task_named, task_names
from lagros_envs.seeding import EVALUATION, episode_seeds, episode_streams
from tests.found import SINGLE_BODY, named, task_of
from tests.policies import toys


@pytest.fixture
def slide(tmp_path, monkeypatch):
    """The file of a task, in the folder that `lagros` is run from."""
    monkeypatch.setattr(registry, "_FOUND", dict(registry._FOUND))
    monkeypatch.chdir(tmp_path)
    text = Path(toys.__file__).read_text(encoding="utf-8")
    (tmp_path / "slide.py").write_text(f"{text}\n\ntask = Slide()\n", encoding="utf-8")
    return "./slide.py"


def invoke(*arguments):
    return CliRunner().invoke(cli.app, arguments)


def test_the_parts_of_every_room_are_there():
    for name in task_names():
        room = room_named(name)
        assert hasattr(room.part("experiment"), "set_up")
        for part in ("figures", "comparison", "episode_objects"):
            assert callable(getattr(room.part("records"), part))
        for part in ("title", "ordered", "comparison_lines", "markdown_grids", "sweeps"):
            assert callable(getattr(room.part("tables"), part))
        assert callable(room.part("figures"))
        assert (room.scene is None) == (task_named(name).most_agents == 1)


@pytest.mark.parametrize("task", named(SINGLE_BODY))
def test_bench_flies_every_task_of_one_body(task, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    described = task_of(task)
    command = ("bench", task, "--policies", "lqr,random", "--episodes", "2", "--seed", "7")
    result = invoke(*command, "--json", "a.json", "--figure", "a.png", "--episodes-file", "e")
    assert result.exit_code == 0, result.output
    assert max(len(line.rstrip()) for line in result.stdout.splitlines()) <= 80
    rows = json.loads(Path("a.json").read_text())
    flown = [(described.name, policy) for policy in ("lqr", "random")]
    assert [(row["task"], row["policy"]) for row in rows] == flown
    assert {row["bound"] for row in rows} == set(described.defaults.bounds)
    episodes = [json.loads(line) for line in Path("e").read_text().splitlines()]
    for row in rows:
        own = [one for one in episodes if one["policy"] == row["policy"]]
        assert row["success_rate"] == sum(one["success"] for one in own) / 2
        assert row["collision_rate"] == sum(one["collided"] for one in own) / 2
        assert row["fall_rate"] == sum(one["fallen"] for one in own) / 2
        # A task without a published tube has no share of flights that left it.
        assert (row["tube_violation_rate"] is None) == (row["paper_tube"] is None)
    assert Path("a.png").stat().st_size > 10_000


class Drawing:
    """Draws both controls of a body from the generator of the episode."""

    def reseed(self, generator):
        self.generator = generator

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return self.generator.uniform(-0.3, 0.3, 2).astype(np.float32), None


def test_an_episode_of_a_table_is_the_one_that_its_seed_says():
    settings = BenchmarkSettings.for_task("pvtol", policies=("lqr",), episodes=3, seed=5)
    run = run_benchmark(settings, policies={"drawing": Drawing()})
    _, episodes = run.episodes.values()
    assert [one.seed for one in episodes] == episode_seeds(5, 3, EVALUATION)
    env = TaskEnv("uniform", settings.bounds[0], task=task_named("pvtol"))
    for one in episodes:
        generator = episode_streams(one.seed).policy
        _, info = env.reset(seed=one.seed)
        over = False
        while not over:
            action = generator.uniform(-0.3, 0.3, 2).astype(np.float32)
            _, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        assert (one.collided, one.fallen) == (info["collided"], info["fallen"])
        assert one.effort_total == info["effort"]


def test_a_task_in_a_file_goes_through_the_whole_command(slide):
    files = ("a.json", "a.csv", "a.tex", "a.md", "a.svg", "a.jsonl")
    options = ("--json", "--csv", "--latex", "--markdown", "--figure", "--episodes-file")
    asked = [word for pair in zip(options, files, strict=True) for word in pair]
    command = ("bench", slide, "--policies", "lqr,random", "--bound", "0.1,0.3", "--episodes", "3")
    result = invoke(*command, *asked, "--out", "kept")
    assert result.exit_code == 0, result.output
    for word in ("slide, uniform disturbance, d̄ = 0.3", "lqr", "coll.", "fell"):
        assert word in result.stdout
    rows = json.loads(Path("a.json").read_text())
    assert {row["task"] for row in rows} == {"slide"}
    assert [row["bound"] for row in rows] == [0.1, 0.1, 0.3, 0.3]
    with Path("a.csv").open() as stream:
        flat = list(csv.DictReader(stream))
    assert [float(row["success_rate"]) for row in flat] == [row["success_rate"] for row in rows]
    # Its file is part of what finished work depends on.
    again = invoke(*command, "--out", "kept")
    assert "going on with" in again.stderr
    assert "slide-" in again.stderr
    Path("slide.py").write_text(Path("slide.py").read_text() + "# another\n")
    assert "going on with" not in invoke(*command, "--out", "kept").stderr
    # A table and a figure need nothing but the rows.
    registry._FOUND.pop("slide")
    assert figures.draw(rows, "again.png").stat().st_size > 5_000
    assert "lqr" in tables.markdown_text(rows)


@pytest.mark.slow
def test_a_task_in_a_file_travels_to_worker_processes(slide):
    command = ("bench", slide, "--policies", "lqr,random", "--bound", "0.2", "--episodes", "4")
    alone, together = "alone.jsonl", "together.jsonl"
    assert invoke(*command, "--episodes-file", alone).exit_code == 0
    result = invoke(*command, "--jobs", "2", "--episodes-file", together)
    assert result.exit_code == 0, result.output

    def outcomes(path):
        lines = [json.loads(line) for line in Path(path).read_text().splitlines()]
        timed = ("step_time_median_s", "step_time_max_s", "deadline_misses")
        return [{n: v for n, v in line.items() if n not in timed} for line in lines]

    assert outcomes(alone) == outcomes(together)


def test_a_task_of_a_module_is_found_in_the_folder_of_the_command(slide):
    result = invoke("bench", "slide:task", "--policies", "random", "--episodes", "1")
    assert result.exit_code == 0, result.output
    assert find_task("slide").title == "Slide"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--agents", "3"), "--agents: agents=(3,) does not fit: slide is one body"),
        (("--safety-filter", "all"), "does not fit: slide is one body; leave it out"),
        (("--scene", "s.png"), "--scene: slide has no worlds of agents to draw"),
        (("--policies", "tube-mpc:tuned"), "slide_metric.json"),
        (("--policies", "centralized"), "unknown policy 'centralized'"),
        (("--policies", "lqr", "--replan-every", "2"), "none of --policies"),
    ],
)
def test_what_does_not_fit_a_task_is_refused_by_what_it_lacks(slide, options, message):
    result = invoke("bench", slide, "--episodes", "1", *options)
    assert result.exit_code in (1, 2), result.output
    assert message in result.stderr
    assert "Traceback" not in result.output


def test_a_file_without_a_task_is_refused(slide):
    Path("none.py").write_text("x = 1\n")
    for text in ("./none.py", "./absent.py", "slide:nothing", "nothing:task"):
        result = invoke("bench", text, "--episodes", "1")
        assert result.exit_code == 2
        assert result.stderr.startswith("lagros: "), result.stderr
        assert "Traceback" not in result.output
