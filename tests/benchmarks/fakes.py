"""Small policies and a small planner, so that these tests need no weights and no solver."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_benchmarks.run.library import Toolbox

STEPS = 90
# A linear-quadratic gain about the upright, and the force of the action 1.0 [N].
GAIN = np.array([-1.08074186, -31.30221022, -2.88083507, -9.36982247])
FORCE_SCALE = 40.0


@dataclass
class LinearPolicy:
    """Balances and goes to the goal; counts its calls."""

    name: str = "steady"
    scale: float = 1.0
    observes: str = "local"

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        force = -self.scale * GAIN @ (observation[:4] - observation[4:8])
        calls = 1 if state is None or episode_start[0] else state + 1
        return np.array([force / FORCE_SCALE], np.float32), calls

    def counters(self, state):
        return {"calls": state, "episodes": 1, "failures": 0}

    def bare_forward(self, features):
        return GAIN @ features

    def example_features(self):
        return np.ones(4, np.float32)


@dataclass
class IdlePolicy:
    """Does nothing, so that the pole falls."""

    name: str = "idle"
    observes: str = "local"

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros(1, np.float32), None


@dataclass
class DrawingPolicy:
    """Draws its actions from the generator of the episode."""

    name: str = "drawing"
    observes: str = "local"
    generator: Any = None

    def reseed(self, generator):
        self.generator = generator

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if self.generator is None:
            raise RuntimeError("no generator")
        return self.generator.uniform(-1.0, 1.0, 1).astype(np.float32), None


@dataclass
class RaisingPolicy(LinearPolicy):
    """Raises at its third step where the goal lies on the right."""

    name: str = "raising"

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if observation[4] > 0.0 and observation[12] > 0.15:
            raise ArithmeticError("no solution\nat all [bold]here[/bold]")
        return super().predict(observation, state, episode_start, deterministic)


@dataclass
class FakePlan:
    states: np.ndarray
    solved: bool = True
    defect: float = 0.0


@dataclass
class StraightPlanner:
    """A straight line in state space; no plan beyond 4 m, an exception beyond 4.5 m."""

    refuses: bool = True

    def plan(self, initial_state, goal, discs=None):
        if self.refuses and goal[0] > 4.5:
            raise RuntimeError("infeasible")
        share = np.linspace(0.0, 1.0, STEPS + 1)[:, None]
        states = (1.0 - share) * initial_state + share * goal
        return FakePlan(states, solved=not (self.refuses and goal[0] > 4.0), defect=0.25)


@dataclass
class Spy:
    """Balances, and writes down what each episode is made of."""

    env: Any
    seen: list = field(default_factory=list)
    name: str = "spy"
    observes: str = "local"

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if episode_start[0]:
            world = self.env.unwrapped
            self.seen.append((world.scenario.goal, world.scenario.initial_state, world._pushes))
        return LinearPolicy().predict(observation, state, episode_start)[0], 1


MAKERS = {
    "steady": LinearPolicy,
    "timid": lambda: LinearPolicy(name="timid", scale=0.8),
    "idle": IdlePolicy,
    "drawing": DrawingPolicy,
    "raising": RaisingPolicy,
}


def make_policy(name, env, settings):
    if name not in MAKERS:
        raise FileNotFoundError(f"no weights for {name}")
    return MAKERS[name](**settings) if settings else MAKERS[name]()


def load_metric(task, path):
    return lambda states: np.broadcast_to(np.diag([1.0, 4.0, 1.0, 2.0]), (*states.shape, 4))


def planner(task):
    return StraightPlanner()


def easy_planner(task):
    return StraightPlanner(refuses=False)


TOOLBOX = Toolbox(make_policy, planner, load_metric)
EASY = Toolbox(make_policy, easy_planner, load_metric)
