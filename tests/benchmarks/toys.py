"""A task of one body in a file of its own, with policies: a puck among discs, from side to side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_envs.task import Defaults, Feedback, Scenario, Task


@dataclass(frozen=True)
class Puck:
    """[x, y, vx, vy] under two accelerations."""

    state_dim: int = 4
    control_dim: int = 2

    def derivative(self, state: Sequence[Any], control: Sequence[Any], functions: Any) -> Any:
        """Return dx/dt."""
        return state[2], state[3], control[0], control[1]


@dataclass(frozen=True)
class Slide(Task):
    """Slide 3 m to the right in 4 s, past a disc that is in the way."""

    system: Puck = field(default_factory=Puck)
    control_period: float = 0.2
    time_limit: float = 4.0

    name, title = "slider", "Slider"
    state_names = ("x [m]", "y [m]", "vx [m/s]", "vy [m/s]")
    control_names = ("right [m/s^2]", "up [m/s^2]")
    control_low, control_high, control_scale = (-2.0, -2.0), (2.0, 2.0), (2.0, 2.0)
    rates = (2, 3)
    position, body_radius, margin, most_discs = (0, 1), 0.1, 0.05, 2
    feedback = Feedback((4.0, 4.0, 1.0, 1.0), (1.0, 1.0))
    defaults = Defaults(
        policies=("lqr",), bounds=(0.1,), bound=0.1, attack_episodes=2, attack_budget=60
    )

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw start, goal and one disc or two."""
        start, goal = np.zeros(4), np.zeros(4)
        start[1], goal[:2] = rng.uniform(-0.5, 0.5), (3.0, rng.uniform(-0.5, 0.5))
        discs = np.array([[1.5, rng.uniform(-0.3, 0.3), 0.2], [1.5, 1.5, 0.3]])
        return Scenario(start, goal, discs[: int(rng.integers(1, 3))])

    def excess(self, state: Sequence[Any], functions: Any) -> Any:
        """Return how far beyond three metres to the side the puck is [m]."""
        return abs(state[1]) - 3.0


class Straight:
    """Goes straight to the goal, whatever is in the way."""

    name, observes = "straight", "local"

    def __init__(self, settings: Slide) -> None:
        """Remember the task."""
        self.settings = settings

    def predict(self, observation: Any, state: Any = None, *_: Any) -> Any:
        """Return the action, and no memory."""
        rows, layout = np.atleast_2d(observation), self.settings.layout
        x, goal = rows[:, layout.state], rows[:, layout.goal]
        control = 1.5 * (goal - x)[:, :2] - 2.0 * x[:, 2:]
        action = self.settings.action(control).astype(np.float32)
        return (action if np.ndim(observation) == 2 else action[0]), None
