"""Small policies of the spacecraft, so that these tests need no weights and no solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from lagros_benchmarks.run.library import Toolbox
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_policies.policy import BasePolicy, as_policy
from lagros_policies.tasks.spacecraft.thrusters import thrust_for_acceleration

# Gains towards the goal, critically damped [1/s^2, 1/s].
STIFFNESS, DAMPING = 0.16, 0.8
STEPS, PERIOD = 450, 0.1


def thrust(heading, acceleration):
    """Return the thrust that gives bodies at rest an acceleration in the plane, shape (B, 8)."""
    states = np.zeros((len(acceleration), 6))
    states[:, 2] = heading
    wanted = np.zeros((len(acceleration), 3))
    wanted[:, :2] = acceleration
    return thrust_for_acceleration(Spacecraft(), states, wanted).astype(np.float32)


@dataclass
class SpringPolicy:
    """Goes straight to the goal, whatever stands in between; remembers how often it was called."""

    name: str = "spring"
    pull: float = 1.0
    observes: str = "local"
    calls: list = field(default_factory=list)

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        rows = np.asarray(observation, float)
        assert rows.ndim == 2
        assert np.shape(episode_start) == (len(rows),)
        self.calls.append(len(rows))
        heading = np.arctan2(rows[:, 5], rows[:, 4])
        pull = self.pull * STIFFNESS * rows[:, :2] - DAMPING * rows[:, 2:4]
        counts = [0] * len(rows) if state is None else state
        assert all(count == 0 for count in counts) == bool(episode_start.all())
        return thrust(heading, pull), [count + 1 for count in counts]

    def counters(self, state):
        return {"decisions": sum(state), "failed_plans": 0}


@dataclass
class IdlePolicy:
    """Does nothing."""

    name: str = "idle"
    observes: str = "local"

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 8), np.float32), None


@dataclass
class DrawingPolicy:
    """Draws its thrusts from the generator of the episode."""

    name: str = "drawing"
    observes: str = "local"
    generator: Any = None

    def reseed(self, generator):
        self.generator = generator

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return self.generator.uniform(0.0, 0.1, (len(observation), 8)).astype(np.float32), None


@dataclass
class RaisingPolicy(SpringPolicy):
    """Raises some time after the start where an agent is left of its goal."""

    name: str = "raising"
    after: float = 19.95

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        answer = super().predict(observation, state, episode_start, deterministic)
        rows = np.asarray(observation, float)
        if any(row[8] > self.after and row[0] > 0.0 for row in rows):
            raise ArithmeticError("no solution\nat all [bold]here[/bold]")
        return answer


@dataclass
class JointPolicy:
    """Feeds `state()` and plans for all agents: straight lines to the goals.

    Its law follows the plan stiffly. Where the first agent starts in the left half it finds none.
    """

    name: str = "joint"
    agents: int = 2
    observes: str = "global"

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        rows = np.asarray(observation, float)
        n = self.agents
        states = rows[:, 1 : 1 + 6 * n].reshape(len(rows), n, 6)
        goals = rows[:, 1 + 6 * n : 1 + 8 * n].reshape(len(rows), n, 2)
        if episode_start.all():
            state = [self._plan(*one) for one in zip(states, goals, strict=True)]
        instants = np.minimum(np.round(rows[:, 0] / PERIOD).astype(int), STEPS)
        target = np.stack([memory.nominal[k] for memory, k in zip(state, instants, strict=True)])
        error = states - target
        pull = -4.0 * error[..., :2] - 4.0 * error[..., 3:5]
        forces = thrust(states[..., 2].ravel(), pull.reshape(-1, 2))
        return forces.reshape(len(rows), n, 8), state

    def _plan(self, states, goals):
        solved = bool(states[0, 0] > 1.0)
        share = np.clip(np.linspace(0.0, 1.5, STEPS + 1), 0.0, 1.0)[:, None, None]
        share = 3.0 * share**2 - 2.0 * share**3 if solved else 0.0 * share
        nominal = np.zeros((STEPS + 1, self.agents, 6))
        nominal[..., :2] = states[:, :2] + share * (goals - states[:, :2])
        nominal[..., 2] = states[:, 2]
        nominal[:-1, :, 3:5] = np.diff(nominal[..., :2], axis=0) / PERIOD
        return SimpleNamespace(nominal=nominal, solved=solved)

    def counters(self, state):
        return {"plans": len(state), "failed_plans": sum(not memory.solved for memory in state)}


@dataclass
class HalfFilter(BasePolicy):
    """A filter in name: halves every thrust and counts the agents it did that to."""

    policy: Any
    observes: str = "local"

    def __post_init__(self):
        self.observes = self.policy.observes
        self.name = f"{self.policy.name}+filter"

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        inner, count = (None, 0) if state is None else state
        action, inner = self.policy.predict(observation, inner, episode_start, deterministic)
        return 0.5 * action, (inner, count + len(np.reshape(action, (-1, 8))))

    def reseed(self, generator):
        as_policy(self.policy).reseed(generator)

    @property
    def draws(self):
        return as_policy(self.policy).draws

    def counters(self, state):
        return {"interventions": state[1]}


MAKERS: dict[str, Callable[..., Any]] = {
    "spring": SpringPolicy,
    "timid": lambda **settings: SpringPolicy(name="timid", pull=0.05, **settings),
    "idle": IdlePolicy,
    "drawing": DrawingPolicy,
    "raising": RaisingPolicy,
}


def make_policy(name, env, settings):
    if name == "joint":
        return JointPolicy(agents=env.preset.agents)
    if name not in MAKERS:
        raise FileNotFoundError(f"no weights for {name}")
    return MAKERS[name](**settings)


def make_filter(policy, env, disturbance_bound):
    return HalfFilter(policy)


def position_margin(policy, disturbance_bound):
    return disturbance_bound if policy.name == "joint" else None


TOOLBOX = Toolbox(make_policy=make_policy, make_filter=make_filter, position_margin=position_margin)
