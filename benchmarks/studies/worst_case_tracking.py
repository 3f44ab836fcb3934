"""Agents that track joint plans with u*, pushed away from them, for worst_case_certificates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.tasks.spacecraft.plane import worst_plane_pushes
from lagros_benchmarks.worst_case.optimisers import make_search
from lagros_benchmarks.worst_case.seeds import ATTACK
from lagros_envs.balls import onto_unit_sphere
from lagros_envs.disturbances import Disturbance
from lagros_envs.dynamics import hold_step
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.contraction.double_integrator import certified_margin
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy

FloatArray = NDArray[np.float64]

KINDS = ("uniform", "sphere", "constant", "sinusoid", "gust")
# Another run than the published attacks.
SEED = 2
# Spacecraft: worlds of six agents, random draws of each kind for each agent, numbers of an
# adversary (share of d that displaces, lookahead, share across, share of the heading).
_WORLDS, _AGENTS, _SPACECRAFT_DRAWS = 60, 6, 2
SPACECRAFT_BOUNDS = (0.6,)
_GENERATIONS, _POPULATION, _SEARCH_PLANS = 12, 24, 30
_ADVERSARIES = 10
_LOOKAHEADS = (0.3, 1.0, 3.0)
_TURNS = (0.0, 0.25, 0.5, 0.75)


def drawn(
    kind: str, rng: np.random.Generator, steps: int, channels: int, period: float
) -> FloatArray:
    """Return one random sequence d/d_bar, shape (steps, channels)."""
    return Disturbance(kind, 1.0, (True,) * channels).realise(rng, steps, period)


class Tracking:
    """Agents of the centralised policy that track their plans with u*, one episode each.

    Args:
        bound: d_bar that the policy prepares for.
    """

    def __init__(self, bound: float) -> None:
        """Plan all worlds."""
        env = SpacecraftVectorEnv(_AGENTS, _AGENTS, "paper", "none", autoreset_mode="disabled")
        policy = CentralizedPolicy(env.settings, "paper", _AGENTS, disturbance_bound=bound)
        nominal, accelerations = [], []
        self.unplanned = 0
        for seed in episode_seeds(SEED, _WORLDS, ATTACK):
            env.reset(seed=[seed])
            _, state = policy.predict(env.state(), None, np.ones(1, bool))
            self.unplanned += not state[0].solved
            nominal.append(state[0].nominal)
            accelerations.append(state[0].accelerations)
        self.settings, self.tracking, self.bound = env.settings, policy.tracking, bound
        self.nominal = np.concatenate(nominal, axis=1)  # (steps + 1, agents, 6)
        self.accelerations = np.concatenate(accelerations, axis=1)
        self.margin = certified_margin(policy.tracking.plane, bound)

    def fly(
        self, agents: NDArray[np.intp], push: Callable[[FloatArray, int], FloatArray]
    ) -> FloatArray:
        """Return the largest position error of each flight, shape (b,) [m].

        Args:
            agents: Whose plan each flight follows, shape (b,).
            push: Errors x - x_d (b, 6) and step to d/d_bar (b, 6).
        """
        settings = self.settings
        body = settings.system
        state = self.nominal[0, agents]
        largest = np.zeros(len(agents))
        for step in range(settings.steps):
            nominal = self.nominal[step, agents]
            thrust = self.tracking.control(state, nominal, self.accelerations[step, agents])
            wrench = np.stack(body.wrench(list(np.moveaxis(thrust, -1, 0))), axis=-1)
            disturbance = self.bound * push(state - nominal, step)
            state = hold_step(
                body.by_wrench, state, wrench, settings.control_period, disturbance, substeps=2
            )
            error = np.linalg.norm((state - self.nominal[step + 1, agents])[:, :2], axis=-1)
            largest = np.maximum(largest, error)
        return largest


def adversary(points: FloatArray, first: FloatArray) -> Callable[[FloatArray, int], FloatArray]:
    """Return the feedback that pushes each flight away from its plan.

    Args:
        points: Share that displaces, logarithm of the lookahead, share across the error and share
            of the heading, shape (b, 4).
        first: Where to push while there is no error, unit vectors (b, 2).
    """
    ahead = np.exp(points[:, 1:2])
    turn = 0.5 * np.pi * np.tanh(points[:, :1])

    def push(error: FloatArray, step: int) -> FloatArray:
        way = onto_unit_sphere(error[:, :2] + ahead * error[:, 3:5], first)
        across = np.stack([-way[:, 1], way[:, 0]], axis=-1)
        way = onto_unit_sphere(way + points[:, 2:3] * across, first)
        d = np.zeros((len(error), 6))
        d[:, :2], d[:, 3:5] = np.sin(turn) * way, np.cos(turn) * way
        d[:, 5] = points[:, 3]
        return onto_unit_sphere(d, d)

    return push


def spacecraft_case(bound: float) -> dict[str, Any]:
    """Fly u* around joint plans against the certified position error."""
    loop = Tracking(bound)
    count, steps = loop.nominal.shape[1], loop.settings.steps
    period = loop.settings.control_period
    every = np.arange(count)
    rng = np.random.default_rng([SEED, 7])
    rows: dict[str, Any] = {}

    def note(name: str, errors: FloatArray) -> None:
        old = rows.get(
            name, {"flights": 0, "crossed": 0, "largest_share": 0.0, "observed_tube": 0.0}
        )
        worst = float(errors.max())
        rows[name] = {
            "flights": old["flights"] + len(errors),
            "crossed": old["crossed"] + int(np.count_nonzero(errors > loop.margin + 1e-9)),
            "largest_share": max(old["largest_share"], worst / loop.margin),
            "observed_tube": max(old["observed_tube"], worst),
            "certified_radius": loop.margin,
        }

    for kind in KINDS:
        for _ in range(_SPACECRAFT_DRAWS):
            pushes = np.stack([drawn(kind, rng, steps, 6, period) for _ in every])
            note("random", loop.fly(every, given(pushes)))
    for turn in _TURNS:
        for ahead in _LOOKAHEADS:
            point = np.array([np.arctanh(turn), np.log(ahead), 0.0, 0.0])
            note(
                "greedy",
                loop.fly(every, adversary(np.tile(point, (count, 1)), directions(rng, count))),
            )
    best = searched_adversaries(loop, rng)
    for point in best:
        note(
            "searched",
            loop.fly(every, adversary(np.tile(point, (count, 1)), directions(rng, count))),
        )
    note("climbed", loop.fly(every, given(climbed_pushes(loop, directions(rng, count)))))
    return {"unplanned": loop.unplanned, "rows": rows, "adversaries": best.tolist()}


def climbed_pushes(loop: Tracking, ways: FloatArray) -> FloatArray:
    """Return the sequence that the error's own loop stands worst, along directions (b, 2).

    Returns:
        d/d_bar, shape (b, steps, 6).
    """
    along = worst_plane_pushes(loop.tracking, loop.bound, loop.settings.steps)
    pushes = np.zeros((len(ways), len(along), 6))
    pushes[..., :2] = along[:, :1] * ways[:, None]
    pushes[..., 3:5] = along[:, 1:] * ways[:, None]
    return pushes


def given(pushes: FloatArray) -> Callable[[FloatArray, int], FloatArray]:
    """Return the feedback that plays sequences d/d_bar, shape (b, steps, 6)."""
    return lambda error, step: pushes[:, step]


def searched_adversaries(loop: Tracking, rng: np.random.Generator) -> FloatArray:
    """Return the worst adversaries that the cross-entropy method finds on some plans, (k, 4)."""
    chosen = make_search("cross-entropy", 4, _POPULATION, rng)
    plans = rng.choice(loop.nominal.shape[1], _SEARCH_PLANS, replace=False)
    points, scores = np.empty((0, 4)), np.empty(0)
    for _ in range(_GENERATIONS):
        asked = chosen.ask()
        each = np.repeat(asked, _SEARCH_PLANS, axis=0)
        which = np.tile(plans, _POPULATION)
        errors = loop.fly(which, adversary(each, directions(rng, len(which))))
        values = errors.reshape(_POPULATION, _SEARCH_PLANS).max(axis=1)
        chosen.tell(asked, values)
        points, scores = np.concatenate([points, asked]), np.concatenate([scores, values])
    return points[np.argsort(-scores)[:_ADVERSARIES]]


def directions(rng: np.random.Generator, count: int) -> FloatArray:
    """Return random unit vectors of the plane, shape (count, 2)."""
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
