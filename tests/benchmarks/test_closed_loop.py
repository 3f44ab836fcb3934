"""The one loop of episodes: alone and in batches, and what it leaves where something raises."""

from __future__ import annotations

import numpy as np
import pytest

from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_envs.env import TaskEnv
from lagros_envs.registry import task_named
from lagros_envs.vector import TaskVectorEnv

SEEDS = [3, 1, 2]


class Lean:
    """Pushes against the sideways distance from the goal, and counts its calls."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        rows = np.atleast_2d(observation)
        calls = 0 if state is None else state
        assert np.all(np.asarray(episode_start) == (calls == 0))
        pushed = 0.05 * np.tanh(rows[:, [1, 0]] - rows[:, [7, 6]])
        return pushed.reshape((*np.shape(observation)[:-1], 2)).astype(np.float32), calls + 1


class Raising:
    """Does nothing four times, and raises at its fifth step."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        calls = 0 if state is None else state
        if calls == 4:
            raise ArithmeticError("no solution")
        return np.zeros(1, np.float32), calls + 1


def paths(seed):
    env = TaskEnv("uniform", 0.3, task=task_named("pvtol"))
    loop = ClosedLoop(env, Lean())
    return np.array([one.env.state for one in loop.fly(seed)]), loop


def test_worlds_side_by_side_fly_as_each_does_alone():
    batch = TaskVectorEnv(
        3, "uniform", 0.3, task=task_named("pvtol"), autoreset_mode="disabled", compiled=False
    )
    loop = ClosedLoop(batch, Lean())
    states = np.array([batch.state.copy() for _ in loop.fly(SEEDS)])
    lengths = []
    for row, seed in enumerate(SEEDS):
        alone, single = paths(seed)
        np.testing.assert_array_equal(states[: len(alone), row], alone)
        assert single.step == len(alone) - 1 == len(single.step_times)
        assert single.over
        assert bool(single.ended) is bool(loop.ended[row])
        lengths.append(single.step)
    # Some end sooner than the others, and the loop goes on until the last has ended.
    assert len(set(lengths)) > 1
    assert loop.step == max(lengths)
    ended = lengths.index(min(lengths))
    np.testing.assert_array_equal(loop.action[ended], 0.0)


def test_what_the_loop_holds_is_whole_where_the_policy_raises():
    loop = ClosedLoop(TaskEnv(task=task_named("cartpole")), Raising())
    with pytest.raises(ArithmeticError, match="no solution"):
        for _ in loop.fly(0, {"initial_state": np.zeros(4)}):
            pass
    assert (loop.step, loop.memory, len(loop.step_times)) == (4, 4, 4)
    assert loop.info["effort"] == 0.0
    # It begins anew with nothing of that.
    loop.begin(1)
    assert (loop.step, loop.memory, loop.step_times, loop.over) == (0, None, [], False)


def test_an_object_without_predict_is_refused_at_the_door():
    with pytest.raises(TypeError, match="has no method predict"):
        ClosedLoop(TaskEnv(task=task_named("cartpole")), object())
