"""Baselines that nothing has trained: a linear-quadratic regulator, and random actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.checks import check_seed, shown
from lagros_envs.dynamics import control_matrix, hold_step, linearise_hold, vector_field
from lagros_envs.options import real_numbers
from lagros_envs.task import Feedback, Task
from lagros_policies.observed import observed_rows
from lagros_policies.policy import BasePolicy
from lagros_policies.room import part_of, task_of

# A state whose rate is below this share of its scale per second is held.
_AT_REST = 1e-9
# Goals of random episodes by which the regulator sees whether they need gains of their own.
_GOALS = 4
_MOST_GOALS = 1024  # whose gains are remembered


def regulator_weights(task: Task) -> Feedback:
    """Return a task's weights of a regulator: its own, or by Bryson's rule."""
    found: Feedback = part_of(task, "WEIGHTS", "lagros_policies.baselines:bryson_weights")(task)
    return found


def bryson_weights(task: Task) -> Feedback:
    """Return the weights that a task names or, by Bryson's rule, one over the square of its scales.

    The scales say how far each coordinate and each control typically moves.
    """
    if task.feedback is not None:
        return task.feedback
    state = task.state_scale or (1.0,) * task.system.state_dim
    control = task.control_spread or (1.0,) * task.system.control_dim
    return Feedback(tuple(x**-2 for x in state), tuple(u**-2 for u in control))


class _About(NamedTuple):
    """What the regulator of one goal needs.

    Attributes:
        gain: K, shape (m, n).
        control: u_f, shape (m,).
        motion: x_r at the control instants, shape (N + 1, n); None where the goal is held.
    """

    gain: FloatArray
    control: FloatArray
    motion: FloatArray | None


class LqrPolicy(BasePolicy):
    """Linear-quadratic regulator about the goal: u = u_f - K (x - x_f).

    K minimises the infinite sum of x'Qx + u'Ru for the exact linearisation, at the goal, of one
    control step with zero-order hold; u_f holds the goal. Where no control holds it, as for a body
    that passes it at speed, the regulator follows the motion under the reference control that is at
    the goal at the time limit. It knows of no discs.

    Args:
        settings: The task; None for the paper's.
        state_weights: Diagonal of Q, shape (n,); None for `task.regulator`, or
            where that is None for those of `regulator_weights`.
        control_weights: Diagonal of R, shape (m,), or a number for all; None likewise.
        force_weight: Older name of `control_weights`.

    Raises:
        ValueError: Weights are none, or leave no gain, or the controls cannot stabilise the system
            about its goals.
        ImportError: SciPy is not installed.

    Attributes:
        gain: K, shape (m, n), where it is the same for all goals; that of one of them elsewhere.
    """

    name = "lqr"

    def __init__(
        self,
        settings: Task | None = None,
        state_weights: Sequence[float] | None = None,
        control_weights: Sequence[float] | float | None = None,
        force_weight: float | None = None,
    ) -> None:
        """Solve for the gain; see the class for the arguments."""
        try:
            import scipy.linalg  # noqa: F401
        except ImportError as error:
            raise ImportError("LqrPolicy needs SciPy: pip install 'lagros[policies]'") from error
        self.settings = task = task_of(settings)
        n, m = task.system.state_dim, task.system.control_dim
        self._named = "control_weights"
        if force_weight is not None:
            self._named, control_weights = "force_weight", (force_weight,) * m
        usual = task.regulator or regulator_weights(task)
        control: Any
        control = usual.control_weights if control_weights is None else control_weights
        if np.ndim(control) == 0:
            control = (control,) * m
        state = usual.state_weights if state_weights is None else state_weights
        self._weights = (
            _diagonal("state_weights", state, n, 0.0),
            _diagonal(self._named, control, m, np.finfo(float).tiny),
        )
        self._layout = task.layout
        self._known: dict[bytes, _About] = {}
        rng = np.random.default_rng(0)
        found = [self._about(np.array(task.sample(rng).goal, np.float64)) for _ in range(_GOALS)]
        first = found[0]
        self._alike = all(
            one.motion is None
            and np.array_equal(one.gain, first.gain)
            and np.array_equal(one.control, first.control)
            for one in found
        )
        self.gain = first.gain
        self._action_gain = self.gain.T / np.array(task.control_scale)
        hold = task.action(first.control)
        self._action_hold = hold if np.any(hold) else None

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Return u_f - K (x - x_f) as an action, and the state as it came.

        Raises:
            ValueError: The observation is not one of the task, or not finite, or the controls
                cannot stabilise the system about its goal.
        """
        rows = observed_rows(observation, self._layout.size, np.float64)
        if self._alike:
            error = rows[..., self._layout.goal] - rows[..., self._layout.state]
            action = error @ self._action_gain
            if self._action_hold is not None:
                action = action + self._action_hold
        else:
            control = [self._control(row) for row in np.atleast_2d(rows)]
            action = self.settings.action(np.array(control)).reshape(*rows.shape[:-1], -1)
        return action.astype(np.float32), state

    def _control(self, row: FloatArray) -> FloatArray:
        """Return u of one observation (o,), by the regulator of its goal."""
        goal = row[self._layout.goal]
        about = self._known.get(goal.tobytes()) or self._about(goal)
        if about.motion is not None:
            step = round(float(row[self._layout.time]) / self.settings.control_period)
            goal = about.motion[min(step, len(about.motion) - 1)]
        control: FloatArray = about.control - about.gain @ (row[self._layout.state] - goal)
        return control

    def _about(self, goal: FloatArray) -> _About:
        task = self.settings
        system, period = task.system, task.control_period
        control = np.array(task.control_centre, np.float64)
        scale = np.array(task.state_scale or (1.0,) * system.state_dim)
        rate = vector_field(system, goal, control)
        motion = None
        if np.max(np.abs(rate) / scale) > _AT_REST:
            reach = control_matrix(system, goal)
            held = control - np.linalg.lstsq(reach, rate, rcond=None)[0]
            if np.max(np.abs(vector_field(system, goal, held)) / scale) <= _AT_REST:
                control = held
            else:
                motion = self._motion_to(goal, control)
        _, transition, effect = linearise_hold(system, goal, control, period)
        about = _About(self._gain(transition, effect, goal), control, motion)
        if len(self._known) >= _MOST_GOALS:
            self._known.clear()
        self._known[goal.tobytes()] = about
        return about

    def _motion_to(self, goal: FloatArray, control: FloatArray) -> FloatArray:
        """Return the states, (N + 1, n), from which the reference control ends at a goal."""
        task, states = self.settings, [goal]
        with np.errstate(all="ignore"):
            for _ in range(task.steps):
                states.append(hold_step(task.system, states[-1], control, -task.control_period))
        motion = np.array(states[::-1])
        if not np.isfinite(motion).all():
            raise ValueError(
                f"lqr of {task.name}: no control holds the goal {shown(goal)}, and the motion that "
                "leads there under the reference control has no beginning; give goals that are held"
            )
        return motion

    def _gain(self, transition: FloatArray, effect: FloatArray, goal: FloatArray) -> FloatArray:
        from scipy.linalg import solve_discrete_are

        state, control = (np.diag(weights) for weights in self._weights)
        name = self.settings.name
        if not _stabilisable(transition, effect):
            raise ValueError(
                f"lqr of {name}: the controls cannot stabilise the system about its goal "
                f"{shown(goal)}: the linearisation there has a motion that no control moves and "
                "that does not die out; choose other goals, or another policy"
            )
        if not _stabilisable(transition.T, state):
            raise ValueError(
                f"state_weights={shown(self._weights[0].tolist())} must be > 0 for a coordinate of "
                f"every motion of {name} that does not die out by itself"
            )
        try:
            cost = solve_discrete_are(transition, effect, state, control)
        except np.linalg.LinAlgError as error:
            raise ValueError(
                f"{self._named}={shown(self._weights[1].tolist())} and state_weights="
                f"{shown(self._weights[0].tolist())} differ so much that no gain is found: {error}"
            ) from error
        gain: FloatArray = np.linalg.solve(
            control + effect.T @ cost @ effect, effect.T @ cost @ transition
        )
        return gain


def _stabilisable(transition: FloatArray, effect: FloatArray) -> bool:
    """Return whether every mode that does not die out is moved by a control (Hautus)."""
    n = len(transition)
    for value in np.linalg.eigvals(transition):
        if abs(value) >= 1.0 - _AT_REST:
            pencil = np.hstack([value * np.eye(n) - transition, effect.astype(complex)])
            singular = np.linalg.svd(pencil, compute_uv=False)
            if singular[-1] <= 1e-9 * singular[0]:
                return False
    return True


def _diagonal(name: str, given: Any, count: int, least: float) -> FloatArray:
    numbers = real_numbers(given)
    if numbers is None or numbers.shape != (count,) or not np.all(numbers >= least):
        raise ValueError(
            f"{name}={shown(given)} must be {count} finite numbers {'> 0' if least else '>= 0'}"
        )
    if not np.isfinite(numbers).all():
        raise ValueError(f"{name}={shown(given)} must be {count} finite numbers")
    return numbers.astype(np.float64)


class RandomPolicy(BasePolicy):
    """Actions uniform in [-1, 1], from the policy's own generator.

    `deterministic` changes nothing: the draws are reproducible through the seed.

    Args:
        settings: The task; None for the paper's.
        seed: Seed of the generator.

    Raises:
        ValueError: The seed is no whole number, or negative.
    """

    name = "random"

    def __init__(self, settings: Task | None = None, seed: int = 0) -> None:
        self.settings = task_of(settings)
        check_seed(seed)
        self._rng = np.random.default_rng(seed)
        self._size, self._controls = self.settings.layout.size, self.settings.system.control_dim

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, Any]:
        """Draw one action per row of the observation, and return the state as it came.

        Raises:
            ValueError: The observation is not one of the task, or not finite.
        """
        rows = observed_rows(observation, self._size, np.float64)
        shape = (*rows.shape[:-1], self._controls)
        return self._rng.uniform(-1.0, 1.0, shape).astype(np.float32), state
