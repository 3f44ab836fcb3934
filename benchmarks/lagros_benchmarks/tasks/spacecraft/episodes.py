"""Worlds of spacecraft flown by one policy, and what is written down about each agent.

A chunk of worlds flies in one batch, one call of `predict` for all of them. Where a batch raises,
its worlds fly again one by one, so that an exception is the failure of one world and not of its
neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.episodes import TUBE_TOLERANCE, added_up
from lagros_benchmarks.run.flying import Answer, Attempt, ask, counted, rehearse, reseed
from lagros_benchmarks.run.library import FloatArray, Policy
from lagros_envs.tasks.spacecraft.task import THRUSTERS
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv

BoolArray = NDArray[np.bool_]
Float32Array = NDArray[np.float32]

# Memories of a policy within those of what it wears.
_MOST_WRAPPED = 4
_MEASURES = (
    *("success", "success_time", "strict_success", "paper_success", "collided", "collision_time"),
    *("effort", "effort_to_success", "goal_distance"),
)


@dataclass(frozen=True)
class AgentRecord:
    """What happened to one agent.

    Attributes:
        success: It came within the goal radius before the time limit and any collision of its own.
        success_time: t*, when it did [s]; None if it did not.
        strict_success: It was there at the end and never collided.
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
class WorldRecord:
    """What happened in one world.

    Attributes:
        seed: Seed of the episode.
        planned: Whether the policy found a plan for all agents at the start; None if it makes none.
        error: The exception that ended the episode, which is then a failure of every agent; None
            if none did.
        agents: One record per agent.
    """

    seed: int
    planned: bool | None
    error: str | None
    agents: tuple[AgentRecord, ...]


@dataclass(frozen=True)
class Flight:
    """Some worlds flown by one policy.

    Attributes:
        worlds: One record per world.
        counters: What the policy counts, summed over the worlds.
    """

    worlds: tuple[WorldRecord, ...]
    counters: dict[str, int]


@dataclass
class Trace:
    """What a batch has left behind so far, whole even if the next call raises.

    Attributes:
        info: The measures of every agent, each of shape (worlds, agents); those of a world that
            has ended stay as they were at its end.
        over: Which worlds have ended, shape (worlds,).
        state: The policy's memory.
        nominal: x_d, shape (worlds, steps + 1, agents, 6), or None.
        planned: Which worlds have a plan, shape (worlds,), or None.
        left_paper: Who left the paper tube, shape (worlds, agents).
        position_error: Largest so far, shape (worlds, agents) [m].
        path: Positions at every control instant, each of shape (worlds, agents, 2) [m].
    """

    info: dict[str, Any] = field(default_factory=dict)
    over: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    state: Any = None
    nominal: FloatArray | None = None
    planned: BoolArray | None = None
    left_paper: BoolArray = field(default_factory=lambda: np.zeros((0, 0), bool))
    position_error: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    path: list[FloatArray] = field(default_factory=list)


def act(
    policy: Policy, env: SpacecraftVectorEnv, rows: Float32Array, state: Any, first: bool
) -> Answer:
    """Ask the policy for the actions of all agents of all worlds.

    Args:
        policy: Fed the rows if it observes "local", `state()` if "global".
        env: The worlds.
        rows: Observations of all agents, shape (worlds * agents, o).
        state: What the last call returned.
        first: Whether the episodes begin.

    Returns:
        Actions, shape (worlds * agents, 8), the policy's memory, and the time of the call.

    Raises:
        ValueError: The policy's answer is not such actions.
    """
    observation = env.state() if is_global(policy) else rows
    starts = np.full(len(observation), first)
    shapes = shapes_of(policy, env.num_worlds, env.num_agents)
    return ask(policy, observation, state, starts, *shapes)


def shapes_of(policy: Policy, worlds: int, agents: int) -> list[tuple[int, ...]]:
    """Return the shapes that the actions of a policy may have; the first has a row per agent."""
    rows = (worlds * agents, THRUSTERS)
    if not is_global(policy):
        return [rows]
    return [rows, (worlds, agents, THRUSTERS), (worlds, agents * THRUSTERS)]


def is_global(policy: Policy) -> bool:
    """Return whether the policy is fed `state()` of all worlds."""
    return getattr(policy, "observes", "local") == "global"


def rehearse_in(env: SpacecraftVectorEnv, name: str, policy: Policy) -> None:
    """Ask a policy once in a world, so that what its first call loads is not timed.

    Args:
        env: One world.
        name: The policy, as the run was asked for it.
        policy: The policy.

    Raises:
        SetupError: It cannot run.
    """
    rows, _ = env.reset(seed=[0])
    seen = env.state() if is_global(policy) else rows
    shapes = shapes_of(policy, 1, env.num_agents)
    rehearse(f"policy {name!r}", policy, seen, np.ones(len(seen), bool), *shapes)


def bare(policy: Policy) -> Policy:
    """Return a policy without the safety filter that it wears, which has it as `policy`.

    A policy of the user's own may call something else so, the model that it asks for instance: only
    a filter has the name of what it filters.
    """
    inner = getattr(policy, "policy", None)
    worn = getattr(policy, "name", None) == f"{getattr(inner, 'name', None)}+filter"
    return inner if worn and inner is not None else policy


def fly(
    env: SpacecraftVectorEnv,
    policy: Policy,
    seeds: Sequence[int],
    margin: float | None = None,
    trace: Trace | None = None,
    keep_path: bool = False,
) -> Flight:
    """Fly one batch of worlds to their end.

    An exception in the policy or the environment ends the batch; it is written down and not raised.

    Args:
        env: The worlds, one per seed, without autoreset.
        policy: The policy.
        seeds: Seeds of the episodes.
        margin: Certified bound of the position error to x_d [m], or None.
        trace: Filled as the batch flies; for those who want more than the records.
        keep_path: Whether the trace keeps where everybody was.

    Returns:
        The records and counters.
    """
    trace = Trace() if trace is None else trace
    counters: dict[str, int] = {}
    with Attempt() as attempt:
        _fly(env, policy, seeds, trace, keep_path)
    with Attempt() as counting:
        counters = counted(policy, trace.state)
    problem = attempt.error or counting.error
    return Flight(tuple(_records(env, seeds, trace, problem, margin)), counters)


def fly_chunk(
    make_env: Any, policy: Policy, seeds: Sequence[int], margin: float | None = None
) -> Flight:
    """Fly worlds in one batch, and one by one where that raises or the policy draws for itself.

    Args:
        make_env: Number of worlds to a `SpacecraftVectorEnv`.
        policy: The policy.
        seeds: Seeds of the episodes.
        margin: As for `fly`.

    Returns:
        The records, in the order of the seeds, and the counters.
    """
    from lagros_policies.policy import as_policy

    # What a policy draws comes from the stream of one episode.
    alone = len(seeds) == 1 or as_policy(bare(policy)).draws
    if not alone:
        flight = fly(make_env(len(seeds)), policy, seeds, margin)
        if all(world.error is None for world in flight.worlds):
            return flight
    env = make_env(1)
    flights = [fly(env, policy, [seed], margin) for seed in seeds]
    counters = added_up(flight.counters for flight in flights)
    return Flight(tuple(world for flight in flights for world in flight.worlds), counters)


def _fly(
    env: SpacecraftVectorEnv, policy: Policy, seeds: Sequence[int], trace: Trace, keep_path: bool
) -> None:
    shape = (env.num_worlds, env.num_agents)
    trace.over = np.zeros(shape[0], bool)
    trace.left_paper, trace.position_error = np.zeros(shape, bool), np.zeros(shape)
    reseed(policy, seeds[0])
    rows, info = env.reset(seed=list(seeds))
    _note(trace, env, info, keep_path)
    for step in range(env.settings.steps):
        action, trace.state, _ = act(policy, env, rows, trace.state, step == 0)
        if step == 0:
            _find_plans(trace, policy, env)
            _hold_against_tube(trace, env, 0)
        # A world that has ended only keeps the batch whole.
        action[np.repeat(trace.over, shape[1])] = 0.0
        rows, _, terminated, truncated, info = env.step(action)
        _note(trace, env, info, keep_path)
        _hold_against_tube(trace, env, step + 1)
        trace.over = trace.over | (terminated | truncated).reshape(shape)[:, 0]
        if trace.over.all():
            return


def _note(trace: Trace, env: SpacecraftVectorEnv, info: dict[str, Any], keep_path: bool) -> None:
    shape = (env.num_worlds, env.num_agents)
    latest = {name: np.asarray(info[name]).reshape(shape) for name in _MEASURES}
    going = ~trace.over[:, None]
    trace.info = {
        name: np.where(going, value, trace.info.get(name, value)) for name, value in latest.items()
    }
    if keep_path:
        trace.path.append(env.states[..., :2].copy())


def _find_plans(trace: Trace, policy: Policy, env: SpacecraftVectorEnv) -> None:
    """Take x_d from the memory of a policy that planned the whole episode of every world."""
    plans = plans_of(trace.state)
    if plans is None or len(plans) != env.num_worlds:
        return
    wanted = (env.settings.steps + 1, env.num_agents, 6)
    if all(np.shape(plan.nominal) == wanted for plan in plans):
        trace.nominal = np.stack([plan.nominal for plan in plans])
        trace.planned = np.array([bool(plan.solved) for plan in plans])


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


def _hold_against_tube(trace: Trace, env: SpacecraftVectorEnv, instant: int) -> None:
    if trace.nominal is None:
        return
    going = ~trace.over[:, None]
    # What overflowed is infinitely far away, not unmeasured.
    error = np.nan_to_num(env.states - trace.nominal[:, instant], nan=np.inf)
    radius = env.settings.tube.radius(instant * env.settings.control_period) + TUBE_TOLERANCE
    trace.left_paper |= going & (np.linalg.norm(error, axis=-1) > radius)
    distance = np.linalg.norm(error[..., :2], axis=-1)
    trace.position_error = np.where(
        going, np.maximum(trace.position_error, distance), trace.position_error
    )


def _records(
    env: SpacecraftVectorEnv,
    seeds: Sequence[int],
    trace: Trace,
    problem: str | None,
    margin: float | None,
) -> list[WorldRecord]:
    return [
        WorldRecord(
            seed=int(seed),
            planned=None if trace.planned is None else bool(trace.planned[world]),
            error=problem,
            agents=tuple(
                _agent(trace, world, agent, problem, margin) for agent in range(env.num_agents)
            ),
        )
        for world, seed in enumerate(seeds)
    ]


def _agent(
    trace: Trace, world: int, agent: int, problem: str | None, margin: float | None
) -> AgentRecord:
    if not trace.info:  # not even the reset came to an end
        return _nothing()
    one = {name: values[world, agent].item() for name, values in trace.info.items()}
    ran = problem is None
    success = ran and bool(one["success"])
    left_paper = left_certified = None
    error: float | None = None
    if trace.nominal is not None and trace.planned is not None:
        error = float(trace.position_error[world, agent])
        kept = ran and bool(trace.planned[world])
        left_paper = not kept or bool(trace.left_paper[world, agent])
        if margin is not None:
            left_certified = not kept or error > margin + TUBE_TOLERANCE
    return AgentRecord(
        success=success,
        success_time=one["success_time"] if success else None,
        strict_success=ran and bool(one["strict_success"]),
        paper_success=ran and bool(one["paper_success"]),
        collided=bool(one["collided"]),
        collision_time=one["collision_time"] if one["collided"] else None,
        effort=one["effort_to_success"],
        effort_total=one["effort"],
        goal_distance=one["goal_distance"],
        left_paper_tube=left_paper,
        left_certified_tube=left_certified,
        max_position_error=error,
    )


def _nothing() -> AgentRecord:
    return AgentRecord(
        success=False,
        success_time=None,
        strict_success=False,
        paper_success=False,
        collided=False,
        collision_time=None,
        effort=0.0,
        effort_total=0.0,
        goal_distance=float("nan"),
        left_paper_tube=None,
        left_certified_tube=None,
        max_position_error=None,
    )
