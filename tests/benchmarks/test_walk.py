"""The walk over the registry: what is promised of every task, on every one that is found.

Checkers of other libraries, copies, the vector twin and drawing are in `tests/envs/test_tasks.py`,
energy in `tests/envs/test_invariants.py`, bench in `test_any_task.py`, watch and attack in
`test_commands_any_task.py`. Here are a spec in JSON, a pickle, and the commands that take longer.
"""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_envs.task import Learning
from lagros_policies.room import shipped_file
from tests.found import SINGLE_BODY, TASKS, named, task_of

TINY = Learning(20, 400, hidden=(8, 8, 8), epochs=1, learned_epochs=1, mpc_samples=0)


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def invoked(*arguments):
        result = CliRunner().invoke(cli.app, [*map(str, arguments)])
        assert result.exit_code == 0, (arguments, result.output)
        return result.stdout

    return invoked


@pytest.mark.parametrize("text", named(TASKS))
def test_a_spec_in_json_and_a_pickle_make_the_environment_again(text):
    spec = gym.make(task_of(text).env_id, disturbance="gust", disturbance_bound=0.2).spec
    again = gym.make(gym.envs.registration.EnvSpec.from_json(spec.to_json()))
    first = gym.make(spec)
    sent = pickle.loads(pickle.dumps(first.unwrapped))
    starts = [env.reset(seed=7)[0] for env in (first, again, sent)]
    action = np.full(first.action_space.shape, 0.1, np.float32)
    for start in starts[1:]:
        np.testing.assert_array_equal(start, starts[0])
    ends = [env.step(action) for env in (first, again, sent)]
    for end in ends[1:]:
        np.testing.assert_array_equal(end[0], ends[0][0])
        assert end[1:4] == ends[0][1:4]


@pytest.mark.slow
@pytest.mark.parametrize("text", named(SINGLE_BODY))
def test_nothing_is_wrong_with_what_is_shown(text, invoke):
    invoke("check", text, "--episodes", 4, "--json", "c.json")
    assert json.loads(Path("c.json").read_text())["faults"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("text", named(SINGLE_BODY))
def test_flights_are_certified_or_it_is_said_why_not(text, invoke):
    bound = 0.1 * task_of(text).defaults.bound
    options = ("--policy", "tube-mpc", "--bound", bound, "--episodes", 1, "--seconds", 5)
    invoke("certify", text, *options, "--json", "c.json")
    found = json.loads(Path("c.json").read_text())
    assert found["guarantee"]["search"]["contradicted"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("text", named(SINGLE_BODY))
def test_the_expert_is_written_as_data(text, invoke):
    pytest.importorskip("minari")
    arguments = ("--minari", "--task", text, "--episodes", 2, "--bound", 0.01, "--out", "sets")
    assert "2 episodes" in invoke("data", "export", *arguments)


@pytest.mark.slow
@pytest.mark.parametrize("text", named(SINGLE_BODY))
def test_an_agent_learns_for_a_segment(text, invoke, monkeypatch):
    pytest.importorskip("stable_baselines3")
    from lagros_benchmarks.training.course import course_of, default_training
    from lagros_benchmarks.training.settings import Ppo

    task = task_of(text)
    usual: Any = default_training(task.name, "ppo")
    algorithm = Ppo(rollout_steps=task.steps, batch_size=task.steps, epochs=1, hidden=(8,))
    small = {"segment_steps": task.steps, "worlds": 2, "curve_episodes": 2, "final_episodes": 2}
    tiny = replace(usual, algorithm=algorithm, **small)
    monkeypatch.setattr(type(course_of(task)), "trainings", lambda *_: {"ppo": tiny})
    invoke("train", text, "--algo", "ppo", "--segments", 1, "--out", "runs")
    (weights,) = Path("runs").rglob("weights.safetensors")
    assert weights.stat().st_size > 100


@pytest.mark.slow
@pytest.mark.parametrize("text", named(SINGLE_BODY))
def test_networks_are_made_flown_and_exported(text, invoke, monkeypatch):
    task = task_of(text)
    if task.learning is None:
        pytest.skip(f"{task.name} describes no networks")
    kind = type(task)
    tiny = replace(
        TINY, scheduled=task.learning.scheduled, disturbance_bound=0.1 * task.defaults.bound
    )
    monkeypatch.setattr(kind, "learning", tiny)
    run = Path("runs") / f"reproduce-{task.name}"
    run.mkdir(parents=True)
    made = shipped_file(task, "metric.json")
    if made.is_file():
        # A design takes a minute; that of each kind of metric has tests of its own.
        shutil.copy(made, run / "metric.json")
    printed = invoke("reproduce", text, "--out", run, "--jobs", 1, "--episodes", 2)
    assert "(c) lagros" in printed
    weights = run / f"{task.name}_lagros.safetensors"
    exported = invoke("export", "lagros", text, "--weights", weights)
    assert "differs from NumPy" in exported or "not compared" in exported
