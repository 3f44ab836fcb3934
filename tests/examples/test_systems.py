"""The systems of `examples/`: short, free of faults, and flown and proved as they say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_envs import find_task
from tests.found import EXAMPLES, ROOT, named

MOST_LINES = 80
# All that a user writes for a system: the file of an example.
FILES = named([str(path) for path in EXAMPLES])


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(cli.app, [*map(str, arguments)])


def test_three_systems_are_there_and_the_guide_names_each():
    guide = (ROOT / "docs" / "your-system.md").read_text(encoding="utf-8")
    assert [path.name for path in EXAMPLES] == ["ball_beam.py", "boat.py", "pendulum.py"]
    for path in EXAMPLES:
        assert f"(../examples/{path.name})" in guide
    pendulum, boat, ball = (find_task(str(EXAMPLES[index])) for index in (2, 1, 0))
    # Each shows what the guide says of it.
    assert not pendulum.most_discs
    assert pendulum.metric is pendulum.learning is None
    assert boat.most_discs
    assert ball.metric is not None
    assert ball.learning.scheduled
    assert hasattr(ball.system, "energy")


@pytest.mark.parametrize("file", FILES)
def test_the_lines_that_a_user_writes_are_few(file):
    lines = len(Path(file).read_text(encoding="utf-8").splitlines())
    print(f"{Path(file).name}: {lines} lines")  # noqa: T201 - shown by pytest -rP
    assert lines <= MOST_LINES


@pytest.mark.parametrize("file", FILES)
def test_nothing_is_wrong_and_tube_mpc_flies(file, invoke):
    result = invoke("check", file, "--episodes", 4)
    assert result.exit_code == 0, result.output
    assert "is ready: nothing is wrong" in result.stdout.splitlines()[0]
    command = ("bench", file, "--disturbance", "uniform,constant", "--policies", "tube-mpc")
    result = invoke(*command, "--episodes", 4, "--json", "a.json")
    assert result.exit_code == 0, result.output
    rows = json.loads(Path("a.json").read_text())
    assert [row["success_rate"] for row in rows] == [1.0, 1.0]


def test_flights_of_the_ball_are_proved(invoke):
    command = ("certify", EXAMPLES[0], "--policy", "tube-mpc", "--episodes", 3)
    result = invoke(*command, "--json", "c.json")
    assert result.exit_code == 0, result.output
    found = json.loads(Path("c.json").read_text())
    assert found["guarantee"]["guaranteed"] == 3
    assert found["guarantee"]["search"]["contradicted"] == 0
