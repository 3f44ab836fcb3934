"""What several studies of the cart-pole share: plans, a flight of all at once, its measures.

Everything is flown by the package's physics, with a true system that need not be the model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.metrics import mean_interval, wilson_interval
from lagros_envs.disturbances import Disturbance
from lagros_envs.dynamics import hold_step
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_policies.tasks.cartpole.expert import CartPoleExpert

FloatArray = NDArray[np.float64]
# (states (s, 4), step) -> forces (s, 1) [N].
Law = Callable[[FloatArray, int], FloatArray]

# Beyond this a state has left every region; it is counted as fallen and kept finite.
_FAR = 1e3


@dataclass(frozen=True)
class Episodes:
    """Episodes with their plans.

    Attributes:
        states: x_d, shape (s, N + 1, 4).
        controls: u_d, shape (s, N, 1).
        goals: x_f, shape (s, 4).
        pushes: A uniform disturbance in the unit ball, shape (s, N, 4).
    """

    states: FloatArray
    controls: FloatArray
    goals: FloatArray
    pushes: FloatArray


@dataclass(frozen=True)
class Flown:
    """What was flown.

    Attributes:
        states: x, shape (s, N + 1, 4); held at its last value after a fall.
        controls: u, shape (s, N, 1); zero after a fall.
        fallen: Which poles fell, shape (s,).
    """

    states: FloatArray
    controls: FloatArray
    fallen: NDArray[np.bool_]


def plan_episodes(expert: CartPoleExpert, count: int, namespace: int, seed: int = 0) -> Episodes:
    """Plan random episodes and draw their disturbances.

    Raises:
        RuntimeError: An episode has no plan.
    """
    settings = expert.task
    unit = Disturbance("uniform", 1.0, (True,) * task.STATE_DIM)
    plans, goals, pushes = [], [], []
    for number in episode_seeds(seed, count, namespace):
        streams = episode_streams(number)
        scenario = settings.sample(streams.scenario)
        plan = expert.planner.plan(scenario.initial_state, scenario.goal)
        if not plan.solved:
            raise RuntimeError(f"episode {number} has no plan: {plan.status}")
        plans.append(plan)
        goals.append(scenario.goal)
        pushes.append(unit.realise(streams.disturbance, settings.steps, settings.control_period))
    return Episodes(
        np.stack([plan.states for plan in plans]),
        np.stack([plan.controls for plan in plans]),
        np.stack(goals),
        np.stack(pushes),
    )


def fly(
    episodes: Episodes,
    law: Law,
    system: CartPole,
    settings: task.CartPoleSettings,
    bound: float = 0.0,
    seen: Callable[[FloatArray, FloatArray, int], None] | None = None,
) -> Flown:
    """Fly all episodes side by side.

    Args:
        episodes: The episodes.
        law: The control; it does not know the true system.
        system: The true system.
        settings: The task; its own system is not used.
        bound: d_bar, in units of the state per second.
        seen: Called after every step with the states before and after it, and the step.
    """
    state = episodes.states[:, 0]
    fallen = np.zeros(len(state), bool)
    path, forces = [state], []
    for step in range(settings.steps):
        # A pole that has fallen is out of the law's sight: it is shown the nominal state.
        shown = np.where(fallen[:, None], episodes.states[:, step], state)
        force = np.where(fallen[:, None], 0.0, law(shown, step))
        push = bound * episodes.pushes[:, step]
        with np.errstate(over="ignore", invalid="ignore"):
            following = hold_step(system, state, force, settings.control_period, push)
        sound = np.all(np.abs(following) < _FAR, axis=1)
        following = np.where((sound & ~fallen)[:, None], following, state)
        if seen is not None:
            after = np.where((sound & ~fallen)[:, None], following, episodes.states[:, step + 1])
            seen(shown, after, step)
        fallen = fallen | ~sound | (np.abs(following[:, 1]) > task.FALL_ANGLE)
        state = following
        path.append(state)
        forces.append(force)
    return Flown(np.stack(path, axis=1), np.stack(forces, axis=1), fallen)


def measures(episodes: Episodes, flown: Flown, settings: task.CartPoleSettings) -> dict[str, Any]:
    """Return success, effort and tube of a flight; definitions as in the published tables."""
    times = settings.control_period * np.arange(settings.steps + 1)
    radius = settings.tube.radius(times)
    # A pole that has fallen stays where it fell, which is outside for good.
    up = np.abs(flown.states[..., 1]) <= task.FALL_ANGLE
    up &= ~flown.fallen[:, None] | (np.cumsum(~up, axis=1) == 0)
    inside = np.linalg.norm(flown.states - episodes.goals[:, None], axis=-1) <= radius
    arrived = inside & up
    success = arrived.any(axis=1)
    first = np.where(success, arrived.argmax(axis=1), settings.steps)
    spent = np.cumsum(flown.controls[..., 0] ** 2 * settings.control_period, axis=1)
    spent = np.concatenate([np.zeros((len(spent), 1)), spent], axis=1)
    effort = spent[np.arange(len(spent)), first]
    strict = inside[:, -1] & ~flown.fallen
    error = np.linalg.norm(flown.states - episodes.states, axis=-1)
    left = np.any(error > radius + 1e-6, axis=1) | flown.fallen
    count = len(success)
    return {
        "episodes": count,
        "success_rate": float(success.mean()),
        "success_ci95": list(wilson_interval(int(success.sum()), count)),
        "strict_success_rate": float(strict.mean()),
        "strict_success_ci95": list(wilson_interval(int(strict.sum()), count)),
        "fall_rate": float(flown.fallen.mean()),
        "effort_mean": float(effort.mean()),
        "effort_ci95": mean_interval(effort),
        "tube_violation_rate": float(left.mean()),
        "tracking_error_rms": float(np.sqrt(np.mean(error**2))),
        "tracking_error_mean_end": float(error[:, -1].mean()),
    }
