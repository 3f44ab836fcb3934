"""What the planner of one body is asked: a system, two ends, bounds, discs and scales."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lagros_envs.arrays import BoolArray, FloatArray
from lagros_envs.checks import (
    MOST_STEPS,
    check_fields,
    check_not_negative,
    check_positive,
    check_whole,
    shown,
)
from lagros_envs.dynamics import System
from lagros_policies.contraction.tube import tighten

# By so much less than required a distance from a disc counts as kept [units of the position].
DISTANCE_SLACK = 1e-6


# (components of states, functions) -> numbers that are to stay at or below zero.
Keep = Callable[[Sequence[Any], Any], Sequence[Any]]

# One number for all entries of an array.
_NO_LOW, _NO_HIGH = partial(np.array, -np.inf), partial(np.array, np.inf)
_ZERO, _ONE = partial(np.array, 0.0), partial(np.array, 1.0)


@dataclass(frozen=True, eq=False)
class Discs:
    """Discs that a body must stay clear of.

    Attributes:
        centres: Shape (k, 2).
        radii: Shape (k,), or one for all.
        body_radius: Radius of the body around its position.
        margin: Room beside the radii: one for all times, or one per node, shape (N + 1,).
        position: The two coordinates of the state that are the position.

    Raises:
        ValueError: A shape is wrong, or a value is not finite or negative.
    """

    centres: FloatArray
    radii: FloatArray
    body_radius: float = 0.0
    margin: FloatArray = field(default_factory=_ZERO)
    position: tuple[int, int] = (0, 1)

    def __post_init__(self) -> None:
        """Take the numbers in double precision and check them."""
        centres = _shaped("centres", self.centres)
        centres = centres.reshape(0, 2) if centres.size == 0 else centres
        if centres.ndim != 2 or centres.shape[1] != 2:
            raise ValueError(f"centres of shape {centres.shape} must be of shape (k, 2)")
        object.__setattr__(self, "centres", centres)
        object.__setattr__(self, "radii", _shaped("radii", self.radii, (len(centres),)))
        object.__setattr__(self, "margin", _shaped("margin", self.margin))
        check_not_negative("body_radius", self.body_radius)
        for name in ("centres", "radii", "margin"):
            value = getattr(self, name)
            if not np.all(np.isfinite(value)) or (name != "centres" and np.any(value < 0.0)):
                raise ValueError(f"{name}={shown(value)} must be finite and >= 0")
        check_fields(self)
        first, second = self.position
        if first == second or min(first, second) < 0:
            raise ValueError(f"position={self.position!r} must be two different coordinates")

    def required(self, steps: int) -> FloatArray:
        """Return the distances to keep from the centres at the nodes, shape (N + 1, k)."""
        margin = _shaped("margin", self.margin, (steps + 1,))
        value: FloatArray = margin[:, None] + (self.radii + self.body_radius)
        return value


@dataclass(frozen=True, eq=False)
class Problem:
    """From one state to another with least effort, in N steps of one held control each.

        min  sum_k ||u_k - u_ref||^2 period
        s.t. x_{k+1} = F(x_k, u_k), x_0 and x_N given, low <= x_k <= high for k = 1 ... N,
             low <= u_k <= high, ||p(t) - o_j|| >= R_j(t) at the nodes and between them,
             and g(x_k) <= 0 for k = 1 ... N

    Bounds and scales may be given as one number for all, or without the axis of time.

    Attributes:
        system: The system.
        period: Control period [s].
        steps: Number N of control steps.
        initial_state: x_0, shape (n,); it need not keep the bounds.
        terminal_state: x_N, shape (n,); NaN for a coordinate that may end anywhere in its bounds.
        state_low: Lower bounds of x_1 ... x_N, shape (N, n); -inf for none.
        state_high: Upper bounds, likewise; inf for none.
        control_low: Lower bounds of u_0 ... u_{N-1}, shape (N, m); -inf for none.
        control_high: Upper bounds, likewise.
        reference_control: u_ref, from which effort is counted, such as what holds a hover; (m,).
        state_scale: How far each coordinate typically moves, shape (n,). Steps, violations and the
            unknowns of the programs are counted in these: without them a small coordinate of a
            fast motion is drowned.
        control_scale: Likewise for the controls, shape (m,).
        discs: What the position must stay clear of.
        keep: g, numbers that stay at or below zero; one of them counts as much as one scale. No
            tube tightens them: they bring their own room.

    Raises:
        ValueError: A shape is wrong, a number is not finite where it must be, bounds cross, the end
            lies outside its bounds, or an end is too near a disc.
    """

    system: System
    period: float
    steps: int
    initial_state: FloatArray
    terminal_state: FloatArray
    state_low: FloatArray = field(default_factory=_NO_LOW)
    state_high: FloatArray = field(default_factory=_NO_HIGH)
    control_low: FloatArray = field(default_factory=_NO_LOW)
    control_high: FloatArray = field(default_factory=_NO_HIGH)
    reference_control: FloatArray = field(default_factory=_ZERO)
    state_scale: FloatArray = field(default_factory=_ONE)
    control_scale: FloatArray = field(default_factory=_ONE)
    discs: Discs | None = None
    keep: Keep | None = None

    def __post_init__(self) -> None:
        """Take the numbers in double precision, fill the shapes and check them."""
        check_positive("period", self.period)
        check_whole("steps", self.steps, 1, MOST_STEPS)
        n, m, steps = self.system.state_dim, self.system.control_dim, self.steps
        for name in ("initial_state", "terminal_state"):
            self._take(name, (n,), broadcast=False)
        for name in ("state_low", "state_high"):
            self._take(name, (steps, n))
        for name in ("control_low", "control_high"):
            self._take(name, (steps, m))
        self._take("reference_control", (m,))
        self._take("state_scale", (n,))
        self._take("control_scale", (m,))
        for name in ("initial_state", "reference_control", "state_scale", "control_scale"):
            value = getattr(self, name)
            if not np.isfinite(value).all():
                raise ValueError(f"{name}={shown(value)} must be finite")
            if name.endswith("scale") and not value.min() > 0.0:
                raise ValueError(f"{name}={shown(value)} must be > 0")
        self._check_bounds("state")
        self._check_bounds("control")
        self._check_end()
        if self.discs is not None:
            self._check_discs(self.discs)

    @property
    def given_end(self) -> BoolArray:
        """Which coordinates of x_N are given, shape (n,)."""
        return ~np.isnan(self.terminal_state)

    def tightened(
        self, states: ArrayLike = 0.0, controls: ArrayLike = 0.0, discs: ArrayLike = 0.0
    ) -> Problem:
        """Return the problem whose bounds shrink by a tube, per coordinate and time (Theorem 3).

        Args:
            states: Radii of the tube at x_1 ... x_N: one, or shape (n,) or (N, n).
            controls: What the feedback may add to u_0 ... u_{N-1}: one, or shape (m,) or (N, m).
            discs: Radii of the tube around the position at the nodes: one, or shape (N + 1,).

        Raises:
            ValueError: A tube is wider than what it is to stay in, its radius is negative, or an
                end is no longer admissible.
        """
        shapes = self.state_low.shape, self.control_low.shape
        low, high = tighten(self.state_low, self.state_high, _shaped("states", states, shapes[0]))
        radius = _shaped("controls", controls, shapes[1])
        least, largest = tighten(self.control_low, self.control_high, radius)
        around = self.discs
        if around is not None:
            more = _shaped("discs", discs, (self.steps + 1,))
            if not np.all(more >= 0.0):
                raise ValueError(f"discs={shown(discs)} must be >= 0, the radius of a tube")
            around = replace(around, margin=around.margin + more)
        return replace(
            self,
            state_low=low,
            state_high=high,
            control_low=least,
            control_high=largest,
            discs=around,
        )

    def rest(self, steps: int, initial_state: FloatArray, terminal_state: FloatArray) -> Problem:
        """Return the problem of its last steps, from and to other states.

        Nothing is looked at again: the states must be n finite numbers each that keep bounds and
        discs. A planner that renews its plan at every step asks for a tenth of the time so.

        Args:
            steps: How many of the steps are left.
            initial_state: Where the plan begins, shape (n,).
            terminal_state: Where it ends, shape (n,).
        """
        left = copy(self)
        changed: dict[str, Any] = {
            "steps": steps,
            "initial_state": np.asarray(initial_state, np.float64),
            "terminal_state": np.asarray(terminal_state, np.float64),
        }
        for name in ("state_low", "state_high", "control_low", "control_high"):
            changed[name] = getattr(self, name)[-steps:]
        if self.discs is not None and self.discs.margin.ndim:
            changed["discs"] = replace(self.discs, margin=self.discs.margin[-(steps + 1) :])
        left.__dict__.update(changed)
        return left

    def _take(self, name: str, shape: tuple[int, ...], broadcast: bool = True) -> None:
        given = getattr(self, name)
        if not broadcast and np.shape(given) != shape:
            raise ValueError(f"{name} of shape {np.shape(given)} must be of shape {shape}")
        object.__setattr__(self, name, _shaped(name, given, shape))

    def _check_bounds(self, of: str) -> None:
        low, high = getattr(self, f"{of}_low"), getattr(self, f"{of}_high")
        # Neither NaN nor an infinity on the wrong side leaves anything between.
        good = (low <= high) & (low < np.inf) & (high > -np.inf)
        if not good.all():
            step, index = np.argwhere(~good)[0]
            raise ValueError(
                f"{of}_low={low[step, index]:g} and {of}_high={high[step, index]:g} of coordinate "
                f"{index} at step {step} leave nothing between them"
            )

    def _check_end(self) -> None:
        end = self.terminal_state
        if np.isinf(end).any():
            raise ValueError(
                f"terminal_state={shown(end)} must be finite, or NaN where the plan may end "
                "anywhere"
            )
        outside = (end < self.state_low[-1]) | (end > self.state_high[-1])
        if outside.any():
            index = int(np.flatnonzero(outside)[0])
            raise ValueError(
                f"terminal_state[{index}]={end[index]:g} lies outside its bounds "
                f"{self.state_low[-1, index]:g} and {self.state_high[-1, index]:g}"
            )

    def _check_discs(self, discs: Discs) -> None:
        place = list(discs.position)
        if max(place) >= self.system.state_dim:
            raise ValueError(
                f"position={discs.position!r} must be two of the {self.system.state_dim} states"
            )
        required = discs.required(self.steps)
        for name, node in (("initial_state", 0), ("terminal_state", -1)):
            gaps = np.linalg.norm(getattr(self, name)[place] - discs.centres, axis=-1)
            near = np.flatnonzero(gaps < required[node] - DISTANCE_SLACK)
            if near.size:
                raise ValueError(
                    f"{name} is {gaps[near[0]]:.3g} from the centre of disc {near[0]}; radius, "
                    f"body and margin need {required[node, near[0]]:.3g}"
                )


def _shaped(name: str, given: ArrayLike, shape: tuple[int, ...] | None = None) -> FloatArray:
    """Return a read-only array of numbers, of a shape where one is asked for.

    Raises:
        ValueError: It holds no numbers, or does not fit the shape.
    """
    try:
        array = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}={shown(given)} must be numbers") from None
    if shape is not None and array.shape != shape:
        try:
            # Numbers for all are the usual case, and filling takes a third of broadcasting's time.
            array = np.full(shape, array) if array.ndim == 0 else np.broadcast_to(array, shape)
        except ValueError:
            raise ValueError(f"{name} of shape {array.shape} must fit shape {shape}") from None
    array.flags.writeable = False
    return array
