"""Environments: steps and resets against Gymnasium's own cart-pole, single and vectorised."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import lagros_envs  # noqa: F401  (registers the environment)
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.baselines import LqrPolicy
from speed.report import Row, Section, timed_row
from speed.timing import Candidate, Scale, Times, interleave

_OURS = "lagros/CartPole-v0"
_THEIRS = "CartPole-v1"
_DISTURBANCE = {"disturbance": "uniform", "disturbance_bound": 0.75}
_SEED = 0
# Control steps of an episode that nobody ends early, and the step that starts the next.
_EPISODE = CartPoleSettings().steps + 1

Actions = Callable[[NDArray[Any]], Any]


def sections(scale: Scale) -> list[Section]:
    """Measure and return the tables."""
    return [_single(scale), _vector(scale)]


def _single(scale: Scale) -> Section:
    ours = gym.make(_OURS, **_DISTURBANCE)
    theirs = gym.make(_THEIRS)
    steps = interleave(
        {
            _OURS: stepping(ours, np.zeros(1, np.float32), scale.calls),
            _THEIRS: stepping(theirs, 0, scale.calls),
        },
        scale.rounds,
    )
    resets = interleave(
        {
            _OURS: lambda index: ours.reset(seed=index),
            _THEIRS: lambda index: theirs.reset(seed=index),
        },
        scale.rounds,
        scale.calls,
    )
    return Section(
        "One environment, from gym.make",
        [
            *_rows("step", {name: returned(times) for name, times in steps.items()}),
            *_rows("reset", resets),
        ],
        notes=[
            "Steps without the resets between them. Ours integrates sixteen derivatives a step, "
            "under a disturbance that its reset draws for the whole episode; Gymnasium's step is "
            "one of Euler. Each ratio is to the row of lagros."
        ],
    )


def _vector(scale: Scale) -> Section:
    worlds = scale.worlds
    ours = gym.make_vec(_OURS, num_envs=worlds, compiled=False, **_DISTURBANCE)
    theirs = gym.make_vec(_THEIRS, num_envs=worlds, vectorization_mode="vector_entry_point")
    # LQR keeps nearly all worlds upright; Gymnasium's fall every twenty steps or so.
    lqr = LqrPolicy()
    choices = np.random.default_rng(_SEED).integers(0, 2, worlds)
    rounds = max(scale.rounds // 10, 2)
    episodes = interleave(
        {
            _OURS: episode(ours, lambda observations: lqr.predict(observations)[0]),
            _THEIRS: episode(theirs, lambda _: choices),
        },
        rounds,
    )
    steps = {name: np.array(times.results) for name, times in episodes.items()}
    resets = interleave(
        {
            _OURS: lambda index: ours.reset(seed=index),
            _THEIRS: lambda index: theirs.reset(seed=index),
        },
        rounds,
    )
    return Section(
        f"{worlds:,} worlds, from gym.make_vec",
        [
            *_rows("step", _times(steps, np.median), worlds),
            *_rows("with restarts", _times(steps, np.mean), worlds),
            *_rows("reset", resets, worlds),
        ],
        notes=[
            f"Step: the median of {_EPISODE} steps, the mean with the restarts among them. Rates "
            "count worlds. Ours without numba; `ratios` has both."
        ],
    )


def stepping(env: gym.Env[Any, Any], action: Any, calls: int) -> Candidate:
    """Return what steps through episodes and returns the mean time of a step alone [s]."""
    env.reset(seed=_SEED)

    def steps(_: int) -> float:
        total = 0.0
        for _ in range(calls):
            begun = time.perf_counter()
            _, _, terminated, truncated, _ = env.step(action)
            total += time.perf_counter() - begun
            if terminated or truncated:
                env.reset()
        return total / calls

    return steps


def episode(env: gym.vector.VectorEnv[Any, Any, Any], act: Actions) -> Candidate:
    """Return what runs an episode of all worlds and returns the time of every step [s]."""

    def steps(index: int) -> list[float]:
        observations, _ = env.reset(seed=index)
        seconds = []
        for _ in range(_EPISODE):
            actions = act(observations)
            begun = time.perf_counter()
            observations, *_ = env.step(actions)
            seconds.append(time.perf_counter() - begun)
        return seconds

    return steps


def returned(times: Times) -> Times:
    """Take the time that a candidate measured itself for that around it."""
    return Times(np.array(times.results), [], single=False)


def _times(
    seconds: dict[str, NDArray[np.float64]], summary: Callable[..., Any]
) -> dict[str, Times]:
    """Return the median or mean step of each episode."""
    return {name: Times(summary(all_, axis=1), [], single=False) for name, all_ in seconds.items()}


def _rows(what: str, times: dict[str, Times], worlds: int = 1) -> list[Row]:
    rows = []
    for name, taken in times.items():
        rate = worlds / taken.median
        rows.append(
            timed_row(
                f"{name}, {what}", taken, times[_OURS], f"{rate:,.0f} per second", per_second=rate
            )
        )
    return rows
