"""Spacecraft in closed loop as the target of a search for their worst disturbance.

Six agents for 450 steps are too many numbers for an open-loop search. What is searched is a small
adversary instead, a feedback of nine numbers that sees all states and pushes every agent; what it
did in its worst flight is the open-loop sequence that is kept and replayed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_benchmarks.run.flying import Attempt
from lagros_benchmarks.tasks.spacecraft.episodes import WorldsLoop, make_worlds
from lagros_benchmarks.worst_case.goals import GOALS
from lagros_envs.arrays import FloatArray
from lagros_envs.balls import onto_unit_sphere
from lagros_envs.disturbances import Situation
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.scenarios import Scenario, preset_named
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.policy import BasePolicy, as_policy

# Towards the nearest thing, across that, away from the goal, along the own way, away from the plan,
# along both axes of the arena; the lookahead; how d divides between position and velocity.
PARAMETERS = 9
_DIRECTIONS = 7
# Lookahead of the parameter 0 [s]; one more makes it e times as long.
_LOOKAHEAD = 1.0
# What a search tries first, each on its own: the directions that know something of the world.
_FIRST = (0, 1, 2, 3, 4)


@dataclass(frozen=True)
class Adversary:
    """A feedback that pushes every agent at the bound, one set of numbers per world.

    Attributes:
        points: Shape (worlds, `PARAMETERS`).
        scenario: Where goals and obstacles are; the same in all worlds.
        nominal: x_d, shape (steps + 1, agents, 6), or None where the policy has none.
        period: Control period [s].
    """

    points: FloatArray
    scenario: Scenario
    nominal: FloatArray | None
    period: float

    def __call__(self, situation: Situation) -> FloatArray:
        """Return directions of length one, shape (worlds, agents, 6)."""
        state = situation.state
        ahead = _LOOKAHEAD * np.exp(np.clip(self.points[:, -2], -3.0, 3.0))[:, None, None]
        position, velocity = state[..., :2], state[..., 3:5]
        foreseen = position + ahead * velocity
        towards = _unit(self._nearest(foreseen))
        parts = [
            towards,
            np.stack([-towards[..., 1], towards[..., 0]], axis=-1),
            _unit(foreseen - self.scenario.goals),
            _unit(velocity),
            self._astray(state, ahead, situation.time),
            np.broadcast_to([1.0, 0.0], position.shape),
            np.broadcast_to([0.0, 1.0], position.shape),
        ]
        direction = np.zeros(position.shape)
        for index, part in enumerate(parts):
            direction += self.points[:, index, None, None] * part
        direction = _unit(direction)
        turn = 0.5 * np.pi * np.tanh(self.points[:, -1])[:, None, None]
        push = np.zeros(state.shape)
        # Parameter 0: all of it accelerates.
        push[..., :2] = np.sin(turn) * direction
        push[..., 3:5] = np.cos(turn) * direction
        return push

    def _nearest(self, position: FloatArray) -> FloatArray:
        """Return from every agent to the nearest surface of anything else, (worlds, agents, 2)."""
        scene = self.scenario
        agents = position.shape[1]
        apart = position[:, None] - position[:, :, None]
        gap = np.linalg.norm(apart, axis=-1) - 2.0 * scene.agent_radius
        gap[:, np.arange(agents), np.arange(agents)] = np.inf
        if len(scene.obstacles):
            to_obstacle = scene.obstacles - position[:, :, None]
            away = np.linalg.norm(to_obstacle, axis=-1) - scene.obstacle_radii - scene.core
            apart = np.concatenate([apart, to_obstacle], axis=2)
            gap = np.concatenate([gap, away], axis=2)
        nearest = np.argmin(gap, axis=2)[..., None, None]
        return np.take_along_axis(apart, nearest, axis=2)[:, :, 0]

    def _astray(self, state: FloatArray, ahead: FloatArray, time: FloatArray) -> FloatArray:
        if self.nominal is None:
            return np.zeros((*state.shape[:2], 2))
        step = min(round(float(np.max(time)) / self.period), len(self.nominal) - 1)
        error = state - self.nominal[step]
        return _unit(error[..., :2] + ahead * error[..., 3:5])


@dataclass(frozen=True)
class SpacecraftFlights:
    """What happened to worlds with one scenario under different disturbances.

    Attributes:
        scores: How bad each flight was, shape (worlds,); see `SpacecraftTarget`.
        pushes: d at every control step, shape (worlds, steps, agents, 6).
        gap: Least distance between surfaces at a control instant, shape (worlds,) [m].
        misses: How far outside its goal each agent stayed before any collision, at the nearest,
            shape (worlds, agents) [m].
        position_error: Largest ||p - p_d|| of each agent, shape (worlds, agents) [m]; nan
            without x_d.
        info: The last measures, each (worlds, agents).
    """

    scores: FloatArray
    pushes: FloatArray
    gap: FloatArray
    misses: FloatArray
    position_error: FloatArray
    info: dict[str, Any]


@dataclass(frozen=True)
class SpacecraftTarget:
    """One world of one policy under one bound, with one goal.

    The score is for "tube" the largest ||p - p_d|| in units of the certified margin, for "success"
    how far outside its goal the worst agent stays [m], for "clearance" the depth of the deepest
    approach [m]; the last two are broken where positive.

    Attributes:
        policy: The policy, with its filter.
        seed: Seed of the episode.
        agents: Agents of the world.
        preset: Preset of the scenarios.
        bound: d_bar, in units of the state per second.
        goal: One of `GOALS`.
        margin: Certified bound of the position error [m]; None where there is none.

    Raises:
        ValueError: The goal is unknown, or "tube" of a policy without a certified margin.
    """

    policy: BasePolicy
    seed: int
    agents: int
    preset: str
    bound: float
    goal: str
    margin: float | None = None

    def __post_init__(self) -> None:
        """Check the goal, and let a planner plan the one scenario once."""
        if self.goal not in GOALS:
            raise ValueError(f"goal {self.goal!r} must be one of {', '.join(GOALS)}")
        if self.goal == "tube" and self.margin is None:
            raise ValueError(
                "goal 'tube' needs a policy with a certified tracking law and no safety filter: "
                "--policy centralized; attack the others with --goal success or clearance"
            )
        remember_plans(self.policy)

    @property
    def task(self) -> task.SpacecraftSettings:
        """The task of these worlds."""
        return task.settings_for(preset_named(self.preset).for_agents(self.agents))

    def environment(self, worlds: int, disturbance: Any) -> SpacecraftVectorEnv:
        """Return worlds under a disturbance."""
        return make_worlds(worlds, self.agents, self.preset, disturbance, self.bound)

    def try_adversaries(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how bad each adversary is, shape (worlds,), and its d as in `SpacecraftFlights`.

        Where the policy raises the adversaries fly one by one, and one under which it does so is
        infinitely bad.
        """
        pushes = np.zeros((len(points), self.task.steps, self.agents, task.STATE_DIM))
        with Attempt():
            return self.fly_adversaries(points, pushes).scores, pushes
        if len(points) == 1:
            return np.array([np.inf]), pushes
        parts = [self.try_adversaries(points[at : at + 1]) for at in range(len(points))]
        scores, flown = zip(*parts, strict=True)
        return np.concatenate(scores), np.concatenate(flown)

    def fly_adversaries(
        self, points: FloatArray, pushes: FloatArray | None = None
    ) -> SpacecraftFlights:
        """Fly one world per adversary, points (worlds, `PARAMETERS`); `pushes` as for `fly`."""
        loop = WorldsLoop(self.environment(1, "none"), self.policy)
        loop.begin([self.seed])
        scenario = loop.env.scenarios[0]
        assert scenario is not None
        loop.decide()
        nominal = None if loop.nominal is None else loop.nominal[0]
        adversary = Adversary(points, scenario, nominal, loop.env.settings.control_period)
        return self.fly(self.environment(len(points), adversary), pushes)

    def fly(self, env: SpacecraftVectorEnv, pushes: FloatArray | None = None) -> SpacecraftFlights:
        """Fly all worlds of an environment to the time limit.

        The pushes (worlds, steps, agents, 6) are filled as they fly, for those who want to know how
        far the worlds came where the policy raises.
        """
        shape = (env.num_worlds, self.agents)
        loop = WorldsLoop(env, self.policy, past_the_end=True)
        if pushes is None:
            pushes = np.zeros((shape[0], env.settings.steps, self.agents, task.STATE_DIM))
        # The start belongs to the scenario, not to the policy.
        gap, misses = np.full(shape[0], np.inf), np.full(shape, np.inf)
        error: FloatArray | None = None
        for _ in loop.fly([self.seed] * shape[0]):
            info, scene = loop.info, env.scenarios[0]
            assert scene is not None
            miss = info["goal_distance"].reshape(shape) - env.settings.goal_radius
            if loop.step == 0:
                misses = miss
                continue
            pushes[:, loop.step - 1] = info["disturbance"].reshape(*shape, task.STATE_DIM)
            gap = np.minimum(gap, least_gap(env.states[..., :2], scene))
            whole = ~info["collided"].reshape(shape)
            misses = np.where(whole, np.minimum(misses, miss), misses)
            if loop.nominal is not None:
                away = env.states[..., :2] - loop.nominal[:, loop.step, :, :2]
                distance = np.linalg.norm(away, axis=-1)
                error = np.maximum(0.0 if error is None else error, distance)
        error = np.full(shape, np.nan) if error is None else error
        return SpacecraftFlights(
            self._scores(gap, misses, error),
            pushes,
            gap,
            misses,
            error,
            {
                name: np.asarray(value).reshape(*shape, *value.shape[1:])
                for name, value in loop.info.items()
            },
        )

    def _scores(self, gap: FloatArray, misses: FloatArray, error: FloatArray) -> FloatArray:
        if self.goal == "clearance":
            return -gap
        if self.goal == "success":
            return np.asarray(misses.max(axis=1))
        assert self.margin is not None
        return np.asarray(error.max(axis=1) / self.margin)


def first_adversaries() -> FloatArray:
    """Return the adversaries that push along one direction only, shape (k, `PARAMETERS`)."""
    alone = np.zeros((2 * len(_FIRST), PARAMETERS))
    for row, index in enumerate(_FIRST):
        # Accelerating, and then mostly displacing.
        alone[2 * row, index] = alone[2 * row + 1, index] = 1.0
        alone[2 * row + 1, -1] = 0.5
    return alone


def least_gap(positions: FloatArray, scenario: Scenario) -> FloatArray:
    """Return the least distance between surfaces, shape (worlds,) [m], at (worlds, agents, 2)."""
    first, second = np.triu_indices(positions.shape[1], 1)
    apart = np.linalg.norm(positions[:, first] - positions[:, second], axis=-1)
    gaps = [apart - 2.0 * scenario.agent_radius]
    if len(scenario.obstacles):
        away = np.linalg.norm(positions[:, :, None] - scenario.obstacles, axis=-1)
        gaps.append((away - scenario.obstacle_radii - scenario.core).reshape(len(positions), -1))
    return np.asarray(np.concatenate(gaps, axis=1).min(axis=1))


class PlansOnce:
    """A joint planner that answers the same question only once."""

    def __init__(self, planner: Any) -> None:
        self._planner, self._known = planner, dict[bytes, Any]()

    def __getattr__(self, name: str) -> Any:
        """Return whatever else the planner has."""
        return getattr(self._planner, name)

    def plan(self, *question: Any) -> Any:
        """Return the plan, from memory where the question is the same to the last bit."""
        key = b"|".join(
            np.asarray(part, np.float64).tobytes() for part in question if part is not None
        )
        if key not in self._known:
            self._known[key] = self._planner.plan(*question)
        return self._known[key]


def remember_plans(policy: BasePolicy) -> None:
    """Let the joint planner of a policy, if it has one, plan each scenario once."""
    inner: Any = as_policy(policy).bare
    planner = getattr(inner, "planner", None)
    if planner is not None and inner.observes == "global" and not isinstance(planner, PlansOnce):
        inner.planner = PlansOnce(planner)


def _unit(vectors: FloatArray) -> FloatArray:
    return onto_unit_sphere(vectors, np.zeros(vectors.shape[-1]))
