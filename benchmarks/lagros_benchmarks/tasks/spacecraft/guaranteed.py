"""Worlds of a policy that tracks joint plans: what is proved of each, and what a search finds."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_benchmarks.run.workers import Progress, untold
from lagros_benchmarks.tasks.spacecraft.aimed import Aimed
from lagros_benchmarks.tasks.spacecraft.claims import tracked_with_a_gain
from lagros_benchmarks.tasks.spacecraft.episodes import WorldsLoop, make_worlds
from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.contraction.statement import Statement, at_most
from lagros_policies.policy import BasePolicy, PolicyState, make
from lagros_policies.tasks.spacecraft.filtering import COUNTERS
from lagros_policies.tasks.spacecraft.guarantee import WorldGuarantee, guarantee

# Worlds that fly in one batch, instants from one aim to the next, and kinds that fly beside.
_WORLDS = 25
_AIMS = (20, 45)
_KINDS = ("sphere", "gust", "constant")
# Above the rounding of a flight [m].
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Evidence:
    """What is proved of worlds, and what flights of them did.

    Attributes:
        worlds: What is proved of each; None for one without a plan.
        error: The largest ||p - p_d|| of any agent in any flight, shape (worlds,) [m].
        collided: Whether an agent collided in a flight, shape (worlds,).
        missed: Whether one did not arrive, shape (worlds,).
        flights: Flights of each world.
        proof_seconds: Time of tubes and guarantees [s].
        search_seconds: Time of the flights [s].
    """

    worlds: tuple[WorldGuarantee | None, ...]
    error: FloatArray
    collided: BoolArray
    missed: BoolArray
    flights: int
    proof_seconds: float
    search_seconds: float

    @property
    def free(self) -> BoolArray:
        """Which worlds are proved to be free of collisions, shape (worlds,)."""
        return np.array([one is not None and one.collision_free for one in self.worlds], bool)

    @property
    def arriving(self) -> BoolArray:
        """Which are proved to be that and to have every agent arrive, shape (worlds,)."""
        return np.array([one is not None and one.arriving for one in self.worlds], bool)

    @property
    def shares(self) -> FloatArray:
        """The largest error found over its bound, of each world that is free of collisions."""
        bounds = np.array([one.position_error if one else np.inf for one in self.worlds])
        return np.asarray(self.error[self.free] / bounds[self.free])

    @property
    def contradicted(self) -> int:
        """Worlds in which a flight did what is proved to be impossible."""
        bounds = np.array([np.inf if one is None else one.position_error for one in self.worlds])
        crossed = self.error > bounds + _ROUNDING
        wrong = crossed | (self.free & self.collided) | (self.arriving & self.missed)
        return int(np.count_nonzero(wrong))


def world_evidence(
    name: str,
    bound: float,
    seeds: Sequence[int],
    preset: str = "paper",
    agents: int = 6,
    tell: Progress = untold,
) -> Evidence | None:
    """Prove what can be proved of worlds, and search for what is worst in them.

    Every world is planned once. Then it is flown under disturbances that are aimed along the
    proof's own worst case, in a new direction for each agent every few seconds, and under the kinds
    of the benchmark that push hardest.

    Args:
        name: The policy.
        bound: d_bar, in units of the state per second.
        seeds: Of the worlds.
        preset: Theirs.
        agents: In each.
        tell: Called with the flights of batches of worlds that are done, and how many there are.

    Returns:
        The evidence; None for a policy that tracks no joint plan with a gain.
    """
    policy: Any = make(name, make_worlds(1, agents, preset, "none", bound))
    if not tracked_with_a_gain(policy):
        return None
    found: list[WorldGuarantee | None] = []
    batches: list[list[Any]] = []
    proving = searching = 0.0
    each = len(_AIMS) + len(_KINDS)
    whole = each * math.ceil(len(seeds) / _WORLDS)
    for at in range(0, len(seeds), _WORLDS):
        some = [int(seed) for seed in seeds[at : at + _WORLDS]]
        flights: list[tuple[Any, ...]] = []
        memory: Any = None
        for disturbance in disturbances(policy, bound):
            tell("flights", each * len(batches) + len(flights), whole)
            begun = time.monotonic()
            env = make_worlds(len(some), agents, preset, disturbance, bound)
            flight, memory = _fly(env, policy, some, memory)
            flights.append(flight)
            searching += time.monotonic() - begun
        begun = time.monotonic()
        found += [_proved(env, policy, world, one, bound) for world, one in enumerate(memory)]
        proving += time.monotonic() - begun
        batches.append([np.stack(part).max(axis=0) for part in zip(*flights, strict=True)])
    tell("flights", whole, whole)
    error, collided, missed = (np.concatenate(part) for part in zip(*batches, strict=True))
    return Evidence(
        tuple(found),
        error,
        collided,
        missed,
        flights=each,
        proof_seconds=proving,
        search_seconds=searching,
    )


def disturbances(policy: Any, bound: float) -> Iterable[Any]:
    """Yield what the worlds of a policy are flown under, as an environment takes it."""
    for index, steps in enumerate(_AIMS):
        aimed = Aimed(policy.tracking.plane, steps, index)
        yield lambda situation, aimed=aimed: bound * aimed(situation)
    yield from _KINDS


def headline(evidence: Evidence, bound: float) -> str:
    """Return what is guaranteed, in one line."""
    count, free, arriving = len(evidence.worlds), evidence.free.sum(), evidence.arriving.sum()
    what = "collision-free and arriving"
    if arriving < free:
        what = f"collision-free ({arriving} of them arriving too)"
    text = (
        f"guaranteed for {free} of {count} worlds at d̄ = {bound:g}: {what}, whatever the "
        "disturbance does"
    )
    if free:
        text += f"; the search came to {100.0 * evidence.shares.max():.3g} % of the bound"
    return text


def lines(evidence: Evidence, bound: float) -> list[Statement]:
    """Return what the headline rests on, as lines of a certificate."""
    free, count = evidence.free, len(evidence.worlds)
    planned = [one for one in evidence.worlds if one is not None]
    kept = [one for one in planned if one.collision_free]
    text = (
        f"{free.sum()} of {count} worlds: no agent touches anything until the time limit, at and "
        f"between the instants, for every d of norm <= {bound:g}"
    )
    if kept:
        errors = max(one.position_error for one in kept)
        text += f"; ||p - p_d|| <= {at_most(errors)} m in each"
    arriving = [one for one in kept if one.arriving]
    second = f"{len(arriving)} of {count} worlds: every agent comes within the goal radius, too"
    if arriving:
        nearest = max(float(one.arrival.max()) for one in arriving)
        second += f" (to {at_most(nearest)} m)"
    lines = []
    if kept:
        lines.append(Statement(text, "proved", True, evidence.proof_seconds))
    if arriving:
        lines.append(Statement(second, "proved", True, 0.0))
    shares = evidence.shares
    third = (
        f"{evidence.flights} flights of each world, aimed along the proof's worst case and under "
        f"{', '.join(_KINDS)}: {evidence.contradicted} did what is proved to be impossible"
    )
    if len(shares):
        third += (
            f"; the largest error is {100.0 * shares.max():.4g} % of its bound, "
            f"{100.0 * np.median(shares):.4g} % in the median world"
        )
    third += f"; {count - len(planned)} worlds had no plan"
    lines.append(Statement(third, "observed", evidence.contradicted == 0, evidence.search_seconds))
    return lines


def as_json(evidence: Evidence) -> dict[str, Any]:
    """Return what is guaranteed as what JSON can hold."""
    free, shares = evidence.free, evidence.shares
    kept = [one for one in evidence.worlds if one is not None and one.collision_free]
    return {
        "worlds": len(evidence.worlds),
        "collision_free": int(free.sum()),
        "arriving": int(evidence.arriving.sum()),
        "without_plan": sum(one is None for one in evidence.worlds),
        "position_error_bound": max((one.position_error for one in kept), default=None),
        "arrival_bound": max((float(one.arrival.max()) for one in kept), default=None),
        "search": {
            "flights": evidence.flights,
            "largest_error": float(evidence.error.max(initial=0.0)),
            "share_of_bound": float(shares.max()) if len(shares) else None,
            "contradicted": evidence.contradicted,
        },
    }


def _fly(
    env: SpacecraftVectorEnv, policy: BasePolicy, seeds: list[int], memory: PolicyState
) -> tuple[tuple[FloatArray, BoolArray, BoolArray], PolicyState]:
    """Fly worlds once; return errors (worlds,), who collided and who missed, and the plans."""
    env.reset(seed=seeds)
    agents, error = env.num_agents, np.zeros(len(seeds))
    for step in range(env.settings.steps):
        actions, memory = policy.predict(env.state(), memory)
        *_, info = env.step(actions.reshape(-1, actions.shape[-1]))
        nominal = np.stack([one.nominal[step + 1] for one in memory])
        off = np.linalg.norm((env.states - nominal)[..., :2], axis=-1)
        error = np.maximum(error, off.max(axis=1))
    collided, success = (np.reshape(info[name], (-1, agents)) for name in ("collided", "success"))
    missed = np.asarray(~np.all(success, axis=1))
    return (error, np.asarray(np.any(collided, axis=1)), missed), memory


def proved(loop: WorldsLoop, policy: Any, bound: float) -> list[dict[str, Any]]:
    """Return what is proved of worlds that have flown, as fields of their records.

    Args:
        loop: The worlds, and what the policy remembers of them.
        policy: It tracks joint plans with a gain.
        bound: d_bar, in units of the state per second.
    """
    said = []
    for world, memory in enumerate(loop.memory):
        found = _proved(loop.env, policy, world, memory, bound)
        said.append(
            {
                "guaranteed": found is not None and found.collision_free,
                "arriving": found is not None and found.arriving,
                "position_error_bound": None if found is None else found.position_error,
            }
        )
    return said


def kept_apart(loop: WorldsLoop) -> list[dict[str, Any]]:
    """Return what is proved of worlds that have flown with the proved filter; see `proved`.

    It is about whoever begins in the set that the filter keeps, and of nobody else.
    """
    outside = loop.memory.counts[:, COUNTERS.index("infeasible")]
    inside = ~outside.reshape(loop.env.num_worlds, -1).any(axis=1)
    return [{"guaranteed": bool(one), "arriving": False} for one in inside]


def _proved(
    env: SpacecraftVectorEnv, policy: Any, world: int, memory: Any, bound: float
) -> WorldGuarantee | None:
    scenario = env.scenarios[world]
    if not memory.solved or scenario is None:
        return None
    return guarantee(
        scenario, env.settings, policy.tracking, memory.nominal, memory.accelerations, bound
    )
