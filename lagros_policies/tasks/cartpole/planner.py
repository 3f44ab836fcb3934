"""Target trajectories of the cart-pole: the paper's tube-based planning problem (19)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_fields, check_positive
from lagros_envs.tasks.cartpole.physics import ANGLE
from lagros_envs.tasks.cartpole.task import FALL_ANGLE, STATE_DIM, CartPoleSettings
from lagros_policies.contraction.tube import tighten
from lagros_policies.planning.planner import check_states, steps_left
from lagros_policies.planning.problem import Problem
from lagros_policies.planning.scp import ScpSettings, solve_scp
from lagros_policies.planning.trajectory import Trajectory

# By so much a solver may exceed the force limit [N].
FORCE_SLACK = 1e-6


@dataclass(frozen=True, slots=True)
class CartPolePlannerSettings:
    """The tube by which the admissible angles shrink (Theorem 3), and how to iterate.

    The whole-state tube of the paper (3.15 at the end) is wider than the admissible set, so the
    tightening uses a margin of the angle alone. It is observed, not proved: under uniform
    disturbance of 0.75 the angle of (b) strayed by at most 0.26 rad in 1,000 episodes, though in
    the first second by more than the margin has grown to.

    Attributes:
        angle_margin: Steady margin of the angle [rad].
        margin_rate: Rate at which the margin grows from zero [1/s].
        scp: How to iterate.

    Raises:
        ValueError: The margin leaves no admissible angle, or the rate is not positive.
    """

    angle_margin: float = 0.4
    margin_rate: float = 0.6
    scp: ScpSettings = field(default_factory=ScpSettings)

    def __post_init__(self) -> None:
        check_fields(self)
        if not 0.0 <= self.angle_margin < FALL_ANGLE:
            raise ValueError(f"angle_margin={self.angle_margin!r} must be in [0, pi/2)")
        check_positive("margin_rate", self.margin_rate)


class CartPolePlanner:
    """Plans (x_d, u_d) of least effort that ends at the goal at the time limit.

    Args:
        task: The task; its system, period, time limit and force limit are planned for.
        settings: The tightening and the iteration.
    """

    def __init__(
        self,
        task: CartPoleSettings | None = None,
        settings: CartPolePlannerSettings | None = None,
    ) -> None:
        self.task = task or CartPoleSettings()
        self.settings = settings or CartPolePlannerSettings()
        high = np.full((self.task.steps, STATE_DIM), np.inf)
        # At the end the state is given, not bounded.
        times = self.task.control_period * np.arange(1.0, self.task.steps)
        high[:-1, ANGLE] = self.angle_limit(times)
        rest = np.zeros(STATE_DIM)
        free = Problem(
            self.task.system, self.task.control_period, self.task.steps, rest, rest, -high, high
        )
        limit = self.task.force_limit
        self._free = free
        self._limited = (
            None
            if limit is None
            else replace(free, control_low=np.array(-limit), control_high=np.array(limit))
        )

    def angle_limit(self, time: FloatArray) -> FloatArray:
        """Return the tightened bound of |theta_d| [rad] at the times [s] (Theorem 3)."""
        margin = self.settings.angle_margin * -np.expm1(-self.settings.margin_rate * time)
        whole = np.full_like(margin, FALL_ANGLE)
        return tighten(-whole, whole, margin)[1]

    def plan(
        self,
        initial_state: FloatArray,
        goal: FloatArray,
        start_step: int = 0,
        guess: Trajectory | None = None,
        discs: FloatArray | None = None,
    ) -> Trajectory:
        """Plan to the goal at the time limit; see `planning.planner.Planner.plan`."""
        check_states(STATE_DIM, initial_state=initial_state, goal=goal)
        left = steps_left(self.task, start_step, guess)
        scp = self.settings.scp
        warm = None if guess is None else (guess.states[-(left + 1) :], guess.controls[-left:])
        if guess is None or not self._keeps(guess) or self._limited is None:
            # From a straight line the linearised dynamics may ask for more than the limit.
            plan = solve_scp(self._free.rest(left, initial_state, goal), warm, scp)
            if not plan.solved or self._keeps(plan):
                return plan
            warm = plan.states, plan.controls
        assert self._limited is not None  # a plan without a limit keeps it
        return solve_scp(self._limited.rest(left, initial_state, goal), warm, scp)

    def _keeps(self, plan: Trajectory) -> bool:
        """Return whether a plan keeps the force limit."""
        limit = self.task.force_limit
        return limit is None or bool(np.max(np.abs(plan.controls)) <= limit + FORCE_SLACK)
