"""The README's Python runs as it stands there, and its policy does what the README says of it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.commands.extras import MODULES
from tests import documents, first_half

README = Path(__file__).parents[2] / "README.md"
TEXT = README.read_text(encoding="utf-8")


def test_every_block_runs(capsys: pytest.CaptureFixture[str]) -> None:
    blocks = documents.python_blocks(TEXT)
    assert len(blocks) == 3
    names: dict[str, Any] = {}
    for block in blocks:
        exec(block, names)
    assert capsys.readouterr().out.startswith("True ")

    # The policy of one's own answers one observation, and a batch of them row by row.
    env, lean = names["env"], names["Lean"]
    envs = gymnasium.make_vec("lagros/CartPole-v0", num_envs=8, disturbance="gust")
    policy = lean(env.unwrapped.settings)
    rows, _ = envs.reset(seed=2)
    actions, _ = policy.predict(rows)
    assert actions.shape == envs.action_space.shape
    one, _ = policy.predict(rows[0])
    assert env.action_space.shape == one.shape
    np.testing.assert_allclose(one, actions[0], rtol=1e-6)


def test_the_readers_own_policy_has_the_success_that_is_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    # Other tests have modules of this name, which Python keeps.
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    first_half.write_modules(TEXT)
    result = CliRunner().invoke(cli.app, ["bench", "cartpole", "--policies", "mine:Lean"])
    assert result.exit_code == 0
    assert "it has 100 % there" in TEXT
    row = next(line.split() for line in result.output.splitlines() if line.startswith(" Lean"))
    assert row[1] == "100.0"


def test_the_readers_own_system_flies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    first_half.write_modules(TEXT)
    command = ["bench", "./slide.py", "--policies", "lqr,random", "--episodes", "3"]
    result = CliRunner().invoke(cli.app, command)
    assert result.exit_code == 0
    row = next(line.split() for line in result.output.splitlines() if line.startswith("lqr"))
    assert row[1] == "100.0"


@pytest.mark.slow
def test_nobody_collides_in_the_world_of_the_film(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["watch", "spacecraft", "--seed", "1", "--speed", "100", "--video", "x.gif"]
    result = CliRunner().invoke(cli.app, command)
    assert result.exit_code == 0
    assert "6 of 6 arrived, 0 collided" in result.output


def test_the_first_half_needs_no_other_extra_than_that_of_the_command_line() -> None:
    blocks, typed = first_half.blocks_and_commands(TEXT)
    assert len(blocks) == 3
    assert {command.words[1] for command in typed} == {
        *("bench", "watch", "attack", "certify", "export")
    }
    named = " ".join(word for command in typed for word in command.words)
    for name in {"train", "reproduce", "onnx", "ray", "dask", "cma", ".mp4", *MODULES["rl"]}:
        assert name not in named


def test_nothing_of_the_readme_is_written_but_in_the_folder_it_runs_in() -> None:
    for command in documents.commands(TEXT):
        assert not any(word.startswith(("/", "~", "..")) for word in command.words)
