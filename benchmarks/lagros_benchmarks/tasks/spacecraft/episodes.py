"""Worlds of spacecraft flown by one policy, and what is written down about each agent.

A chunk of worlds flies in one batch, one call of `predict` for all of them. Where a batch raises,
its worlds fly again one by one, so that an exception is the failure of one world and not of its
neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_benchmarks.run.episodes import TUBE_TOLERANCE, added_up
from lagros_benchmarks.run.flying import Attempt
from lagros_benchmarks.run.keeping import Keepable
from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.tasks.spacecraft.task import THRUSTERS
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.policy import BasePolicy, as_policy

# Memories of a policy within those of the filters that it uses.
_MOST_WRAPPED = 4
_MEASURES = (
    *(
        "success",
        "success_time",
        "strict_success",
        "reached",
        "paper_success",
        "collided",
        "collision_time",
    ),
    *("effort", "effort_to_success", "goal_distance"),
)


@dataclass(frozen=True)
class AgentRecord(Keepable):
    """What happened to one agent.

    Attributes:
        success: It came within the goal radius before the time limit and any collision of its own.
        success_time: t*, when it did [s]; None if it did not.
        strict_success: It was there at the end and never collided.
        reached: It came within the goal radius before the time limit, collided or not.
        paper_success: ||(p - p_f, v)|| <= r(t) at some control instant before any collision.
        collided: It touched an obstacle or another agent, before or after its success.
        collision_time: When it first did [s]; None if it did not.
        effort: The integral of ||u||^2 to t*, else to the end [N^2 s].
        effort_total: The same to the end, successful or not [N^2 s].
        goal_distance: Distance from the goal at the end [m].
        left_paper_tube: ||x - x_d|| ever exceeded the paper tube, or there was no plan x_d to keep
            to; None where the policy has none to show.
        left_certified_tube: The position's error ever exceeded its certified bound, likewise.
        max_position_error: Largest ||p - p_d|| [m]; None without x_d.
    """

    success: bool
    success_time: float | None
    strict_success: bool
    reached: bool
    paper_success: bool
    collided: bool
    collision_time: float | None
    effort: float
    effort_total: float
    goal_distance: float
    left_paper_tube: bool | None
    left_certified_tube: bool | None
    max_position_error: float | None


@dataclass(frozen=True)
class WorldRecord(Keepable):
    """What happened in one world.

    Attributes:
        seed: Seed of the episode.
        planned: Whether the policy found a plan for all agents at the start; None if it makes none.
        error: The exception that ended the episode, which is then a failure of every agent; None
            if none did.
        agents: One record per agent.
        guaranteed: Whether it is proved that nobody collides, whatever the disturbance does; None
            for a policy that no such statement is about, as of the next two.
        arriving: Whether it is proved that all arrive, too.
        position_error_bound: Proved bound of ||p - p_d|| of any agent [m]; None without a tube.
    """

    seed: int
    planned: bool | None
    error: str | None
    agents: tuple[AgentRecord, ...]
    guaranteed: bool | None = None
    arriving: bool | None = None
    position_error_bound: float | None = None


@dataclass(frozen=True)
class Flight(Keepable):
    """Some worlds flown by one policy, and what it counts, summed over the worlds."""

    worlds: tuple[WorldRecord, ...]
    counters: dict[str, int]


class WorldsLoop(ClosedLoop):
    """Worlds and the policy that flies all of their agents, whether it is fed rows or worlds.

    Attributes:
        nominal: x_d, shape (worlds, steps + 1, agents, 6), where the policy has planned the whole
            episode of every world at its start; else None.
        planned: Which worlds have a plan, shape (worlds,), or None.
    """

    env: SpacecraftVectorEnv
    nominal: FloatArray | None = None
    planned: BoolArray | None = None

    def begin(self, seed: Any, options: dict[str, Any] | None = None) -> None:
        """Reset the worlds, none of which has a plan then."""
        self.nominal = self.planned = None
        super().begin(seed, options)

    def decide(self) -> None:
        """Ask the policy for the actions of all agents, and at the start for its plans."""
        super().decide()
        if self.step == 0:
            self._find_plans()

    def seen(self) -> Any:
        """Return the rows of all agents, or `state()` of all worlds where it observes "global"."""
        return self.env.state() if self.policy.observes == "global" else self.observation

    def shapes(self) -> list[tuple[int, ...]]:
        """Return the shapes that the actions may have."""
        return shapes_of(self.policy, self.env.num_worlds, self.env.num_agents)

    def _find_plans(self) -> None:
        plans = plans_of(self.memory)
        wanted = (self.env.settings.steps + 1, self.env.num_agents, 6)
        if plans is None or len(plans) != self.env.num_worlds:
            return
        if all(np.shape(plan.nominal) == wanted for plan in plans):
            self.nominal = np.stack([plan.nominal for plan in plans])
            self.planned = np.array([bool(plan.solved) for plan in plans])


# From worlds that have flown to what is proved of each: fields of its `WorldRecord`.
Prover = Callable[[WorldsLoop], Sequence[dict[str, Any]]]


@dataclass
class Trace:
    """What a batch has left behind so far, whole even if the next call raises.

    Attributes:
        info: The measures of every agent, each of shape (worlds, agents); those of a world that
            has ended stay as they were at its end.
        left_paper: Who left the paper tube, shape (worlds, agents).
        position_error: Largest so far, shape (worlds, agents) [m].
        path: Positions at every control instant, each of shape (worlds, agents, 2) [m].
    """

    info: dict[str, Any] = field(default_factory=dict)
    left_paper: BoolArray = field(default_factory=lambda: np.zeros((0, 0), bool))
    position_error: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    path: list[FloatArray] = field(default_factory=list)
    _going: BoolArray = field(init=False)
    _start: FloatArray = field(init=False)

    def note(self, loop: WorldsLoop) -> None:
        """Note where everybody is and how each fared."""
        env, shape = loop.env, (loop.env.num_worlds, loop.env.num_agents)
        if loop.step == 0:
            self._going, self._start = np.ones(shape, bool), env.states.copy()
            self.left_paper, self.position_error = np.zeros(shape, bool), np.zeros(shape)
        latest = {name: np.asarray(loop.info[name]).reshape(shape) for name in _MEASURES}
        self.info = {
            name: np.where(self._going, value, self.info.get(name, value))
            for name, value in latest.items()
        }
        self.path.append(env.states[..., :2].copy())
        if loop.nominal is not None and loop.step > 0:
            if loop.step == 1:
                self._hold_against_tube(loop, self._start, 0)
            self._hold_against_tube(loop, env.states, loop.step)
        self._going = ~loop.ended.reshape(shape)

    def _hold_against_tube(self, loop: WorldsLoop, states: FloatArray, instant: int) -> None:
        assert loop.nominal is not None
        # What overflowed is infinitely far away, not unmeasured.
        error = np.nan_to_num(states - loop.nominal[:, instant], nan=np.inf)
        settings = loop.env.settings
        radius = settings.tube.radius(instant * settings.control_period) + TUBE_TOLERANCE
        self.left_paper |= self._going & (np.linalg.norm(error, axis=-1) > radius)
        distance = np.linalg.norm(error[..., :2], axis=-1)
        largest = np.maximum(self.position_error, distance)
        self.position_error = np.where(self._going, largest, self.position_error)


def make_worlds(worlds: int, agents: int, *args: Any, **options: Any) -> SpacecraftVectorEnv:
    """Return worlds that stand still where they have ended; see the environment for the rest."""
    # The figures must not depend on whether numba is installed.
    options |= {"compiled": False, "autoreset_mode": "disabled"}
    return SpacecraftVectorEnv(worlds * agents, agents, *args, **options)


def shapes_of(policy: BasePolicy, worlds: int, agents: int) -> list[tuple[int, ...]]:
    """Return the shapes that the actions of a policy may have; the first has a row per agent."""
    rows = (worlds * agents, THRUSTERS)
    if policy.observes == "local":
        return [rows]
    return [rows, (worlds, agents, THRUSTERS), (worlds, agents * THRUSTERS)]


def make_filter(
    policy: BasePolicy, env: Any, disturbance_bound: float, proved: bool = False
) -> BasePolicy:
    """Return a policy with a safety filter of an environment's task and preset, at a bound."""
    from lagros_policies.tasks.spacecraft.proved_filter import ProvedFilter
    from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter

    chosen = ProvedFilter if proved else SafetyFilter
    return chosen(policy, env.settings, env.preset, disturbance_bound=disturbance_bound)


def fly(
    loop: WorldsLoop,
    seeds: Sequence[int],
    margin: float | None = None,
    trace: Trace | None = None,
    prove: Prover | None = None,
) -> Flight:
    """Fly one batch of worlds, one per seed and without autoreset, to their end.

    An exception in the policy or the environment ends the batch; it is written down and not raised.
    The margin is the certified bound of the position error to x_d [m], or None. A trace, for those
    who want more than the records, is filled as the batch flies. What the prover says of the worlds
    is written down with them, where they have flown.
    """
    trace = Trace() if trace is None else trace
    counters: dict[str, int] = {}
    with Attempt() as attempt:
        for _ in loop.fly(list(seeds)):
            trace.note(loop)
    with Attempt() as counting:
        counters = loop.counters()
    problem = attempt.error or counting.error
    records = _records(loop, seeds, trace, problem, margin)
    if prove is not None and problem is None:
        records = [
            replace(record, **said) for record, said in zip(records, prove(loop), strict=True)
        ]
    return Flight(tuple(records), counters)


def fly_chunk(
    make_env: Any,
    policy: Any,
    seeds: Sequence[int],
    margin: float | None = None,
    prove: Prover | None = None,
) -> Flight:
    """Fly worlds in one batch, and one by one where that raises or the policy draws for itself.

    Args:
        make_env: Makes an environment of so many worlds.
        policy: The policy.
        seeds: Of the worlds.
        margin: The certified bound of the position error to x_d [m], or None.
        prove: Says what is proved of the worlds flown, or None.

    Returns:
        The records, in the order of the seeds, and the counters.
    """
    policy = as_policy(policy)
    # What a policy draws comes from the stream of one episode.
    alone = len(seeds) == 1 or policy.draws
    if not alone:
        flight = fly(WorldsLoop(make_env(len(seeds)), policy), seeds, margin, prove=prove)
        if all(world.error is None for world in flight.worlds):
            return flight
    loop = WorldsLoop(make_env(1), policy)
    flights = [fly(loop, [seed], margin, prove=prove) for seed in seeds]
    counters = added_up(flight.counters for flight in flights)
    return Flight(tuple(world for flight in flights for world in flight.worlds), counters)


def plans_of(state: Any) -> Sequence[Any] | None:
    """Return the plans in a policy's memory: one per world, each with `nominal` and `solved`.

    A safety filter wraps the memory of its policy in its own, as the first entry.
    """
    for _ in range(_MOST_WRAPPED):
        if not (isinstance(state, list | tuple) and state):
            return None
        if all(hasattr(entry, "nominal") and hasattr(entry, "solved") for entry in state):
            return state
        state = state[0]
    return None


def _records(
    loop: WorldsLoop,
    seeds: Sequence[int],
    trace: Trace,
    problem: str | None,
    margin: float | None,
) -> list[WorldRecord]:
    return [
        WorldRecord(
            seed=int(seed),
            planned=None if loop.planned is None else bool(loop.planned[world]),
            error=problem,
            agents=tuple(
                _agent(loop, trace, world, agent, problem, margin)
                for agent in range(loop.env.num_agents)
            ),
        )
        for world, seed in enumerate(seeds)
    ]


def _agent(
    loop: WorldsLoop,
    trace: Trace,
    world: int,
    agent: int,
    problem: str | None,
    margin: float | None,
) -> AgentRecord:
    # Empty where not even the reset came to an end.
    one = {name: values[world, agent].item() for name, values in trace.info.items()}
    ran = problem is None
    success = ran and bool(one["success"])
    collided = bool(one.get("collided", False))
    left_paper = left_certified = None
    error: float | None = None
    if loop.nominal is not None and loop.planned is not None:
        error = float(trace.position_error[world, agent])
        kept = ran and bool(loop.planned[world])
        left_paper = not kept or bool(trace.left_paper[world, agent])
        if margin is not None:
            left_certified = not kept or error > margin + TUBE_TOLERANCE
    return AgentRecord(
        success=success,
        success_time=one["success_time"] if success else None,
        strict_success=ran and bool(one["strict_success"]),
        reached=ran and bool(one["reached"]),
        paper_success=ran and bool(one["paper_success"]),
        collided=collided,
        collision_time=one["collision_time"] if collided else None,
        effort=one.get("effort_to_success", 0.0),
        effort_total=one.get("effort", 0.0),
        goal_distance=one.get("goal_distance", float("nan")),
        left_paper_tube=left_paper,
        left_certified_tube=left_certified,
        max_position_error=error,
    )
