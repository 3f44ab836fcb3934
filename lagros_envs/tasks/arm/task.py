"""From pose to pose, upright against gravity: the task of the arm of two links."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.task import (
    Defaults,
    Feedback,
    Learning,
    MetricDesign,
    Scenario,
    Task,
    distance_between,
)
from lagros_envs.tasks.arm.physics import Arm

_UPRIGHT = math.pi / 2.0
_BESIDE = 0.3  # from upright, where C3M's episodes start [rad]
_REACH = (0.6, 0.8)  # from upright, of the goals [rad]
_WAY = 0.6  # least distance of the tip from its goal at the start [m]
_RATE = math.pi / 3.0  # of plans [rad/s]
_THICK = 0.05  # of a drawn link [m]


@dataclass(frozen=True)
class ArmSettings(Task):
    """Swing from beside upright to another pose in 2 s, and hold it against gravity.

    Starts and limits of rates are those of C3M (Sun, Jha & Fan 2021), whose own task is to come
    back to upright. A success is a tip within 0.15 m of where the goal has it.

    Attributes:
        system: The arm.
        control_period: Zero-order hold [s].
        time_limit: Length of an episode and of a plan [s].
    """

    system: Arm = field(default_factory=Arm)
    control_period: float = 0.05
    time_limit: float = 2.0

    name, title = "arm", "Arm"
    state_names = ("q_1 [rad]", "q_2 [rad]", "dq_1/dt [rad/s]", "dq_2/dt [rad/s]")
    control_names = ("shoulder torque [N m]", "elbow torque [N m]")
    rates = (2, 3)
    state_low = (0.0, -_UPRIGHT, -_RATE, -_RATE)
    state_high = (math.pi, _UPRIGHT, _RATE, _RATE)
    control_low, control_high, control_scale = (-100.0, -50.0), (100.0, 50.0), (100.0, 50.0)
    control_spread = (10.0, 10.0)
    goal_radius = 0.15
    metric = MetricDesign(
        low=(_UPRIGHT - 0.7, -1.2, -1.1, -1.1),
        high=(_UPRIGHT + 0.7, 1.2, 1.1, 1.1),
        error=(0.2, 0.2, 0.8, 0.8),
        control_low=(-80.0, -40.0),
        control_high=(80.0, 40.0),
        scaling=(1.0, 1.0, 3.0, 3.0),
    )
    # By benchmarks/studies/plan_law.py --task arm: no kind of disturbance costs an episode.
    feedback = Feedback((1.0, 1.0, 1e-3, 1e-3), (1e-6, 1e-6), rate=3.0)
    learning = Learning(
        plans=1500,
        samples=200_000,
        disturbance_bound=0.5,
        hidden=(64, 64),
        epochs=40,
        learned_epochs=60,
        scheduled=True,
        slope_weight=0.3,
        mpc_samples=0,
    )
    defaults = Defaults(bounds=(0.5,), bound=0.5)

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw a start at rest beside upright, and a pose at rest around it, with a way to go."""
        start, goal = np.zeros(4), np.zeros(4)
        upright = np.array([_UPRIGHT, 0.0])
        start[:2] = upright + rng.uniform(-_BESIDE, _BESIDE, 2)
        while True:
            goal[:2] = upright + rng.uniform(-1.0, 1.0, 2) * _REACH
            if self.goal_distance(start.tolist(), goal.tolist(), np) >= _WAY:
                return Scenario(start, goal)

    def sample_many(self, rng: np.random.Generator, count: int) -> Scenario:
        """Draw as `sample` does, all at once."""
        start, goal = np.zeros((count, 4)), np.zeros((count, 4))
        upright = np.array([_UPRIGHT, 0.0])
        start[:, :2] = upright + rng.uniform(-_BESIDE, _BESIDE, (count, 2))
        near = np.arange(count)
        while len(near):
            goal[near, :2] = upright + rng.uniform(-1.0, 1.0, (len(near), 2)) * _REACH
            here, there = list(start[near].T), list(goal[near].T)
            near = near[self.goal_distance(here, there, np) < _WAY]
        return Scenario(start, goal, np.zeros((count, 0, 3)))

    def tip(self, state: Sequence[Any], functions: Any) -> tuple[Any, Any]:
        """Return where the tip is [m], the shoulder being at the origin."""
        first, second = self.system.first_length, self.system.second_length
        upper, lower = state[0], state[0] + state[1]
        return (
            first * functions.cos(upper) + second * functions.cos(lower),
            first * functions.sin(upper) + second * functions.sin(lower),
        )

    def goal_distance(self, state: Sequence[Any], goal: Sequence[Any], functions: Any) -> Any:
        """Return the distance between the tip and that of the goal [m]."""
        return distance_between(self.tip(state, functions), self.tip(goal, functions), functions)

    def excess(self, state: Sequence[Any], functions: Any) -> Any:
        """Return by how much the upper link hangs below the horizontal [rad]."""
        return abs(state[0] - _UPRIGHT) - _UPRIGHT

    def features(self, observation: Sequence[Any], functions: Any) -> Sequence[Any]:
        """Return what the networks see: the state from the goal, goal and start, and the time."""
        layout = self.layout
        state, goal = observation[layout.state], observation[layout.goal]
        start = observation[layout.initial_state]
        return (
            state[0] - goal[0],
            state[1] - goal[1],
            *state[2:],
            goal[0] - _UPRIGHT,
            goal[1],
            start[0] - _UPRIGHT,
            start[1],
            observation[layout.time],
        )

    def place(self, state: FloatArray) -> FloatArray:
        """Return where the tip is, shape (2,) [m]."""
        return np.array(self.tip(state.tolist(), np))

    def outline(self, state: FloatArray) -> Sequence[FloatArray]:
        """Return the two links."""
        upper, lower = state[0], state[0] + state[1]
        elbow = self.system.first_length * np.array([math.cos(upper), math.sin(upper)])
        links = [(np.zeros(2), elbow, upper), (elbow, self.place(state), lower)]
        outlines = []
        for start, end, angle in links:
            aside = _THICK * np.array([-math.sin(angle), math.cos(angle)])
            outlines.append(np.stack([start + aside, end + aside, end - aside, start - aside]))
        return outlines
