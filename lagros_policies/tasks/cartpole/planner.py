"""Target trajectories of the cart-pole: the paper's tube-based planning problem (19)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_fields, check_positive
from lagros_envs.tasks.cartpole.physics import ANGLE
from lagros_envs.tasks.cartpole.task import FALL_ANGLE, CartPoleSettings
from lagros_policies.contraction.tube import tighten
from lagros_policies.planning.problem import Problem
from lagros_policies.planning.scp import ScpSettings, solve_scp
from lagros_policies.planning.trajectory import Trajectory

FloatArray = NDArray[np.float64]

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
        """Check the values."""
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
        """Remember task and settings."""
        self.task = task or CartPoleSettings()
        self.settings = settings or CartPolePlannerSettings()
        limit = self.task.force_limit
        self._largest = math.inf if limit is None else limit

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
    ) -> Trajectory:
        """Plan from a state at a control instant to the goal at the time limit.

        Args:
            initial_state: x at the instant, shape (4,).
            goal: x_f, shape (4,).
            start_step: Index k of the instant; the plan covers the steps that remain.
            guess: A plan whose last part is the warm start.

        Returns:
            The plan, over task.steps - start_step steps.

        Raises:
            ValueError: No step remains, the guess is shorter than what remains, or a state is
                misshapen or not finite.
        """
        for name, vector in (("initial_state", initial_state), ("goal", goal)):
            if np.shape(vector) != (4,) or not np.all(np.isfinite(vector)):
                raise ValueError(f"{name}={vector!r} must be 4 finite numbers")
        horizon = self.task.steps - start_step
        if not 1 <= horizon <= self.task.steps:
            raise ValueError(
                f"start_step={start_step} is not one of the {self.task.steps} steps before the "
                "time limit"
            )
        if guess is not None and guess.horizon < horizon:
            raise ValueError(
                f"guess covers {guess.horizon} steps, but {horizon} remain from "
                f"start_step={start_step}"
            )
        times = self.task.control_period * np.arange(start_step + 1.0, self.task.steps)
        # At the end the state is given, not bounded.
        high = np.full((horizon, 4), np.inf)
        high[:-1, ANGLE] = self.angle_limit(times)
        scp = self.settings.scp
        problem = Problem(
            self.task.system,
            self.task.control_period,
            horizon,
            np.asarray(initial_state, np.float64),
            np.asarray(goal, np.float64),
            -high,
            high,
        )
        warm, largest = None, self._largest
        if guess is not None:
            warm = guess.states[-(horizon + 1) :], guess.controls[-horizon:]
        if guess is None or not self._keeps(guess) or math.isinf(largest):
            # From a straight line the linearised dynamics may ask for more than the limit.
            plan = solve_scp(problem, warm, scp)
            if not plan.solved or self._keeps(plan):
                return plan
            warm = plan.states, plan.controls
        low, high = np.array(-largest), np.array(largest)
        return solve_scp(replace(problem, control_low=low, control_high=high), warm, scp)

    def _keeps(self, plan: Trajectory) -> bool:
        """Return whether a plan keeps the force limit."""
        return bool(np.max(np.abs(plan.controls)) <= self._largest + FORCE_SLACK)
