"""The guide to a system of one's own: each command and block of it, in order, at small size."""

from __future__ import annotations

import re
import shutil

import gymnasium
import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_envs import registry
from lagros_envs.tasks import SHIPPED
from tests import documents
from tests.found import ROOT

TEXT = (ROOT / "docs" / "your-system.md").read_text(encoding="utf-8")
COMMANDS = [words[1:] for _, words in documents.commands(TEXT)]
OF_EXAMPLES = [words for words in COMMANDS if "examples/ball_beam.py" in words]
# What makes each command small.
SMALL = {
    "attack": ("--episodes", "1", "--budget", "30"),
    "bench": ("--episodes", "2"),
    "certify": ("--episodes", "1"),
    "check": ("--episodes", "2"),
    "reproduce": ("--episodes", "2", "--jobs", "1"),
    "watch": ("--seconds", "0.5"),
}
TINY = "Learning(20, 400, 0.03, (8,), 1, 1, scheduled=True, slope_weight=0.3, mpc_samples=0)"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to work in, in which no task but the shipped ones is known."""
    shipped = {name: task for name, task in registry._FOUND.items() if name in SHIPPED}
    strangers = [task.env_id for name, task in registry._FOUND.items() if name not in SHIPPED]
    monkeypatch.setattr(registry, "_FOUND", shipped)
    for env_id in strangers:
        monkeypatch.delitem(gymnasium.registry, env_id, raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def typed(words):
    """Type a command at small size, and return what it prints."""
    result = CliRunner().invoke(cli.app, [*words, *SMALL.get(words[0], ())])
    assert result.exit_code == 0, (words, result.output)
    return result.stdout


def test_from_the_equation_to_the_certificate(folder):
    system, python = documents.python_blocks(TEXT)
    (folder / "carts.py").write_text(system, encoding="utf-8")
    said = {}
    for words in COMMANDS:
        if words not in OF_EXAMPLES:
            said[words[0], words[1]] = typed(words)
    assert {name for name, _ in said} == {"new", "check", "bench", "attack", "watch", "certify"}
    assert said["check", "./carts.py"].startswith("carts is ready: nothing is wrong")
    assert said["certify", "./carts.py"].startswith("guaranteed for 1 of 1 episodes at d̄ = 0.05")
    assert (folder / "carts.gif").stat().st_size > 1000
    names: dict[str, object] = {}
    exec(python, names)
    assert names["action"] in names["env"].action_space  # type: ignore[attr-defined]


@pytest.mark.slow
def test_a_bound_that_is_too_large_is_answered_by_one_that_is_shown(folder):
    (folder / "carts.py").write_text(documents.python_blocks(TEXT)[0], encoding="utf-8")
    assert "Say `--bound 0.1` and it answers that nothing is shown at 0.1" in " ".join(TEXT.split())
    said = typed(("certify", "./carts.py", "--bound", "0.1"))
    assert said.startswith("guaranteed for 0 of 1 episodes at d̄ = 0.1, and for 1 at d̄ = 0.0")


@pytest.mark.slow
def test_from_a_metric_to_networks_that_are_proved_and_exported(folder):
    (folder / "examples").mkdir()
    copy = folder / "examples" / "ball_beam.py"
    shutil.copy(ROOT / "examples" / "ball_beam.py", copy)
    small, count = re.subn(r"Learning\(\n.*?\n    \)", TINY, copy.read_text(), flags=re.DOTALL)
    assert count == 1
    copy.write_text(small)
    assert [words[0] for words in OF_EXAMPLES] == ["reproduce", "bench", "certify", "export"]
    said = [typed(words) for words in OF_EXAMPLES]
    assert "(c) lagros" in said[1]
    assert "policy lagros" in said[2]
    assert (folder / "lagros_ball_beam.c").is_file()
