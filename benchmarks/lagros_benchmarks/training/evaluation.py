"""How a policy does in training: figures of one body on episodes of given seeds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_benchmarks.run.metrics import wilson_interval
from lagros_envs.vector import TaskVectorEnv


def evaluate(policy: Any, seeds: list[int], disturbance: str, bound: float) -> dict[str, float]:
    """Run a policy over episodes of its `settings` and return its figures.

    Returns:
        Shares of episodes: `success` (the paper's), `strict` (inside the tube at the end, never
        fell), `fallen` and, where there are discs, `collided`; means over all episodes: `effort`
        (to the end, whatever it is) and `effort_to_success`; `final_distance`, the mean over those
        that did not end early (0 if all did); `reward`, the mean of the task's own reward over an
        episode.
    """
    venv = TaskVectorEnv(
        len(seeds),
        disturbance=disturbance,
        disturbance_bound=bound,
        settings=policy.settings,
        compiled=False,
        autoreset_mode="disabled",
    )
    loop = ClosedLoop(venv, policy)
    going, rewards = np.ones(len(seeds), dtype=bool), np.zeros(len(seeds))
    last: dict[str, NDArray[Any]] = {}
    lost = np.zeros(len(seeds), dtype=bool)
    for _ in loop.fly(seeds):
        info = loop.info
        kept = ("success", "effort", "effort_to_success", "fallen", "collided")
        for key in kept:
            if key in info:
                last.setdefault(key, np.array(info[key]))[going] = info[key][going]
        if loop.step:
            rewards += np.where(going, loop.reward, 0.0)
            lost |= going & loop.terminated
            going &= ~loop.ended
    standing = loop.info["goal_distance"][~lost]
    collided = {"collided": float(np.mean(last["collided"]))} if "collided" in last else {}
    return {
        "success": float(np.mean(last["success"])),
        "strict": float(np.mean(loop.info["inside_tube"] & ~lost)),
        "fallen": float(np.mean(last["fallen"])),
        **collided,
        "effort": float(np.mean(last["effort"])),
        "effort_to_success": float(np.mean(last["effort_to_success"])),
        "final_distance": float(np.mean(standing)) if standing.size else 0.0,
        "reward": float(np.mean(rewards)),
    }


def final_row(policy: Any, seeds: list[int], disturbance: str, bound: float) -> dict[str, Any]:
    """Return the figures of a policy under one condition, as records of trainings keep them."""
    figures = evaluate(policy, seeds, disturbance, bound)
    interval = wilson_interval(round(figures["success"] * len(seeds)), len(seeds))
    return {
        "disturbance": disturbance,
        "bound": bound,
        "episodes": len(seeds),
        **{key: round(value, 4) for key, value in figures.items()},
        "success_ci95": [round(limit, 4) for limit in interval],
    }
