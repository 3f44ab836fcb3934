"""Baselines that nothing has trained: LQR and random actions.

Both policies follow stable-baselines3's `PolicyPredictor` protocol. Observations are those of
`lagros_envs.tasks.cartpole.env`, (13,) or (B, 13); actions are (1,) or (B, 1) float32, in units of
`CartPoleSettings.force_scale` [N].
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_positive, check_seed, shown
from lagros_envs.conventions import settings_of
from lagros_envs.dynamics import linearise_hold
from lagros_envs.options import real_numbers
from lagros_envs.tasks.cartpole import task
from lagros_policies.observed import cartpole_rows
from lagros_policies.policy import BasePolicy

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]


class LqrPolicy(BasePolicy):
    """Linear-quadratic regulator about the upright goal: u = -K (x - x_f).

    K minimises the infinite sum of x'Qx + u'Ru for the exact linearisation, at the upright, of one
    control step with zero-order hold. The default weights follow Bryson's rule, one over the square
    of the largest acceptable value: for p `settings.goal_range` [m], for theta
    `settings.initial_angle` [rad], for the rates what crosses these ranges in one second, for u
    `settings.force_scale` [N] (1 where such a range is zero).

    Args:
        settings: The task; None for the paper's.
        state_weights: Diagonal of Q for [p, theta, dp/dt, dtheta/dt]; None for the rule.
        force_weight: R [1/N^2]; None for the rule.

    Raises:
        ValueError: Q is not four non-negative numbers with that of p positive, or R is not
            positive.
        ImportError: SciPy is not installed.

    Attributes:
        gain: K, shape (1, 4) [N per unit of the state].
    """

    def __init__(
        self,
        settings: task.CartPoleSettings | None = None,
        state_weights: Sequence[float] | None = None,
        force_weight: float | None = None,
    ) -> None:
        """Solve for the gain; see the class for the arguments."""
        try:
            from scipy.linalg import solve_discrete_are
        except ImportError as error:
            raise ImportError("LqrPolicy needs SciPy: pip install 'lagros[policies]'") from error
        self.name = "lqr"
        self.settings = settings_of(task.CartPoleSettings(), settings)
        if state_weights is None:
            ranges = [self.settings.goal_range or 1.0, self.settings.initial_angle or 1.0] * 2
            state_weights = [1.0 / (value * value) for value in ranges]
        if force_weight is None:
            force_weight = 1.0 / self.settings.force_scale**2
        diagonal = real_numbers(state_weights)
        # Without a weight on p nothing brings the cart to its goal, and Riccati has no solution.
        fits = diagonal is not None and diagonal.shape == (task.STATE_DIM,)
        if diagonal is None or not (
            fits and np.isfinite(diagonal).all() and np.all(diagonal >= 0.0) and diagonal[0] > 0.0
        ):
            raise ValueError(
                f"state_weights={shown(state_weights)} must be {task.STATE_DIM} finite numbers "
                ">= 0, the first > 0"
            )
        check_positive("force_weight", force_weight)
        _, transition, effect = linearise_hold(
            self.settings.system,
            np.zeros(task.STATE_DIM),
            np.zeros(1),
            self.settings.control_period,
        )
        weight = np.array([[force_weight]])
        try:
            cost = solve_discrete_are(transition, effect, np.diag(diagonal), weight)
        except np.linalg.LinAlgError as error:
            raise ValueError(
                f"force_weight={force_weight:g} and state_weights={shown(state_weights)} differ so "
                f"much that no gain is found: {error}"
            ) from error
        self.gain: FloatArray = np.linalg.solve(
            weight + effect.T @ cost @ effect, effect.T @ cost @ transition
        )
        self._action_gain = self.gain.T / self.settings.force_scale

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Return -K (x - x_f) as an action, and the state as it came; see the module.

        Raises:
            ValueError: The observation is not one of the task, or not finite.
        """
        rows = cartpole_rows(observation, np.float64)
        error = rows[..., task.GOAL] - rows[..., task.STATE]
        return (error @ self._action_gain).astype(np.float32), state


class RandomPolicy(BasePolicy):
    """Actions uniform in [-1, 1], from the policy's own generator.

    `deterministic` changes nothing: the draws are reproducible through the seed.

    Args:
        settings: The task; None for the paper's. The policy does not look at it.
        seed: Seed of the generator.

    Raises:
        ValueError: The seed is no whole number, or negative.
    """

    def __init__(self, settings: task.CartPoleSettings | None = None, seed: int = 0) -> None:
        """Seed the generator; see the class for the arguments."""
        self.name = "random"
        self.settings = settings_of(task.CartPoleSettings(), settings)
        check_seed(seed)
        self._rng = np.random.default_rng(seed)

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Draw one action per row of the observation, and return the state as it came.

        Raises:
            ValueError: The observation is not one of the task, or not finite.
        """
        shape = (*cartpole_rows(observation, np.float64).shape[:-1], 1)
        return self._rng.uniform(-1.0, 1.0, shape).astype(np.float32), state
