"""The command line: its errors, its files, its speed of starting."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from typer.testing import CliRunner

import lagros_policies
from lagros_benchmarks.commands import cli
from lagros_benchmarks.run import library, settings
from lagros_envs.disturbances import KINDS
from lagros_envs.registry import task_named, task_names
from lagros_policies.policy import policy_names
from tests.benchmarks import fakes

HEAVY = ("torch", "scipy", "matplotlib", "joblib", "cvxpy", "piqp", "gymnasium", "rich.progress")


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(cli.app, arguments)


@pytest.fixture
def faked(monkeypatch):
    """The fakes in the place of the library, under its names."""
    makers = {"lqr": "steady", "lagros": "raising", "learned": "idle", "tube-mpc": "timid"}

    def make(name, env, settings):
        return fakes.make_policy(makers[name], env, settings)

    toolbox = library.Toolbox(make, fakes.easy_planner, fakes.load_metric)
    monkeypatch.setattr("lagros_benchmarks.run.runner.Toolbox", lambda: toolbox)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("cartpol",), "unknown task 'cartpol'. Did you mean 'cartpole'?"),
        (("cartpole", "--policies", "lagors,lqr"), "Did you mean 'lagros'? Valid: learned,"),
        (("cartpole", "--policies", "ppo2.zip"), "there is no file 'ppo2.zip'"),
        (("cartpole", "--policies", ","), "--policies: an entry is empty"),
        (("cartpole", "--disturbance", "gusts"), "Did you mean 'gust'? Valid: none, uniform,"),
        (("cartpole", "--bound", "0.1,much"), "--bound: 'much' is not a number"),
        (("cartpole", "--bound", "-1"), "must be finite and >= 0"),
        (("cartpole", "--episodes", "0"), "episodes=0"),
        (("cartpole", "--figure", "x.gif"), "must end in .png, .pdf, .svg"),
        (("cartpole", "--json", "/proc/none/x.json"), "cannot write"),
    ],
)
def test_a_mistake_is_explained_with_status_2_and_no_traceback(invoke, arguments, message):
    result = invoke("bench", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.output
    assert isinstance(result.exception, SystemExit)


@pytest.mark.parametrize("task", ["cartpole", "spacecraft"])
@pytest.mark.parametrize(
    "options", [("--episodes", "0"), ("--episodes", "-3", "--shipped-weights")]
)
def test_a_table_without_episodes_is_refused_before_anything_is_made(
    invoke, tmp_path, monkeypatch, task, options
):
    for name in ("run.reproduction.reproduce", "commands.cli.run_and_report"):
        monkeypatch.setattr(f"lagros_benchmarks.{name}", lambda *_: pytest.fail("it began"))
    result = invoke("reproduce", task, *options, "--jobs", "1")
    assert result.exit_code == 2
    assert f"episodes={options[1]} must be a whole number" in result.stderr
    assert not list(tmp_path.iterdir())


def test_bench_prints_the_table_and_writes_the_files(invoke, faked, tmp_path):
    names = ("a.json", "a.csv", "a.tex", "a.png", "a.jsonl")
    options = ("--json", "--csv", "--latex", "--figure", "--episodes-file")
    files = [word for pair in zip(options, names, strict=True) for word in pair]
    result = invoke("bench", "cartpole", "--episodes", "6", "--seed", "3", *files)
    # One of the fakes raises in some episodes.
    assert result.exit_code == 3, result.output
    for text in ("(a) learned", "(b) tube-mpc", "(c) lagros", "lqr", "Against (b) tube-mpc"):
        assert text in result.stdout
    assert "[bold]here[/bold]" in result.stdout
    assert max(len(line.rstrip()) for line in result.stdout.splitlines()) <= 80
    for name in names:
        assert f"wrote {name}" in result.stdout
        assert (tmp_path / name).stat().st_size > 100
    rows = json.loads((tmp_path / "a.json").read_text())
    assert [row["policy"] for row in rows] == ["learned", "tube-mpc", "lagros", "lqr"]
    assert {row["seed"] for row in rows} == {3}


def test_bench_runs_a_grid(invoke, faked, tmp_path):
    result = invoke(
        *("bench", "cartpole", "--policies", "lqr,learned", "--episodes", "2"),
        *("--disturbance", "none,gust", "--bound", "0.1,0.2", "--json", "g.json"),
    )
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "g.json").read_text())
    conditions = [(row["disturbance"], row["bound"]) for row in rows]
    assert conditions == [c for c in (("none", 0.0), ("gust", 0.1), ("gust", 0.2)) for _ in "12"]


def test_demo_writes_table_and_figure(invoke, faked, tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "DEMO", cli.DEMO | {"episodes": 3})
    few = settings.BenchmarkSettings(policies=("lqr",), episodes=2)
    monkeypatch.setattr(cli, "a_few_worlds", lambda: few)
    result = invoke("demo")
    assert result.exit_code == 0, result.output
    assert "(c) lagros" in result.stdout
    assert "runs/demo/error.png" in result.stdout
    assert "runs/demo/report.html" in result.stdout
    assert (tmp_path / "runs/demo/error.png").exists()
    assert len(json.loads((tmp_path / "runs/demo/results.json").read_text())) == 4


def test_missing_weights_end_with_status_1_and_a_sentence(invoke, faked, monkeypatch):
    def absent(name, env, settings):
        raise FileNotFoundError("no weights")

    toolbox = library.Toolbox(absent, fakes.easy_planner, fakes.load_metric)
    monkeypatch.setattr("lagros_benchmarks.run.runner.Toolbox", lambda: toolbox)
    result = invoke("bench", "cartpole")
    assert result.exit_code == 1
    assert "policy 'learned' cannot be built: FileNotFoundError: no weights" in result.stderr


def test_help_names_every_kind_and_policy(invoke):
    # Rich wraps and frames the help: only letters and digits count.
    text = "".join(invoke("bench", "--help").stdout.replace("│", " ").split())
    assert ",".join(KINDS) in text
    assert ",".join(lagros_policies.NAMES) in text


def test_version(invoke):
    result = invoke("--version")
    assert result.exit_code == 0
    assert result.stdout.startswith("lagros ")


def test_no_arguments_show_the_help(invoke):
    assert "bench" in invoke().output


def test_help_imports_nothing_heavy():
    command = "lagros_benchmarks.commands.cli"
    code = f"import sys, {command}; print([m for m in {HEAVY} if m in sys.modules])"
    output = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert output.strip() == "[]"


@pytest.mark.parametrize(
    "command",
    [
        ("bench", "cartpole", "--policies"),
        ("watch", "cartpole", "--policy"),
        ("attack", "cartpole", "--policy"),
    ],
)
def test_the_folder_is_searched_last_and_for_classes_alone(invoke, tmp_path, monkeypatch, command):
    before = [place for place in sys.path if place != str(tmp_path)]
    monkeypatch.setattr(sys, "path", list(before))
    assert invoke(*command, "nobody").exit_code == 2
    assert sys.path == before
    for name in ("json", "mine_of_the_folder"):
        (tmp_path / f"{name}.py").write_text("raise ArithmeticError('of the folder')")
    result = invoke(*command, "json:Good")  # Python's own, in spite of the file
    assert result.exit_code in (1, 2)
    assert "has no class 'Good'" in result.stderr
    result = invoke(*command, "mine_of_the_folder:Good")
    assert result.exit_code == 1
    assert "ArithmeticError: of the folder" in result.stderr
    assert sys.path == [*before, str(tmp_path)]


def test_the_help_says_what_the_registry_knows_of_every_task(invoke):
    told = " ".join(invoke("bench", "--help").stdout.replace("│", " ").split())
    for name in task_names():
        bounds = ", ".join(f"{bound:g}" for bound in task_named(name).defaults.bounds)
        assert f"{name}: {bounds}" in told
        assert f"{name}: {', '.join(policy_names(task_named(name)))}" in told
    assert ", ".join(task_names()) in told
