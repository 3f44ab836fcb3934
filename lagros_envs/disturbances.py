"""Bounded disturbances: whatever the kind, the norm of d never exceeds the bound.

A disturbance is constant over a control step. An open-loop kind draws the whole episode at reset,
as a sequence in the unit ball that the bound then scales: a larger bound is the same realisation,
larger. (An episode without a seed may draw it step by step, see `stepwise`.) A feedback kind
(`worst`, or any callable) looks at the state instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, cast

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.balls import INSIDE, into_ball, into_unit_ball, onto_unit_sphere
from lagros_envs.checks import check_disturbance_bound, shown, suggestion
from lagros_envs.options import real_numbers
from lagros_envs.values import ByValue

GUST_CORRELATION_TIME = 1.0  # [s]
GUST_SPREAD = 0.6  # stationary norm (root mean square) as a share of the bound, before clipping
SINUSOID_RATES = (0.5, 5.0)  # [rad/s]
SWITCHING_TIME = 1.5  # [s]
# Episodes that are worked on at once: what they draw then stays in the cache.
_BLOCK = 64


@dataclass(frozen=True, slots=True)
class Situation:
    """What a feedback disturbance may look at.

    Attributes:
        state: x, shape (..., n).
        nominal: x_d at the same time, shape (..., n), or None if the episode has no plan.
        time: t [s], shape (...).
        direction: A unit vector drawn for the episode, shape (..., n).
    """

    state: FloatArray
    nominal: FloatArray | None
    time: FloatArray
    direction: FloatArray

    def copy(self) -> Situation:
        """Return the same in arrays of its own, which a callable may write to."""
        nominal = None if self.nominal is None else np.array(self.nominal)
        return Situation(
            np.array(self.state), nominal, np.array(self.time), np.array(self.direction)
        )


Feedback = Callable[[Situation], FloatArray]


@dataclass(frozen=True)
class OpenLoop:
    """How an open-loop kind makes its sequences: draws per episode, arithmetic on all at once.

    Attributes:
        size: Numbers that an episode draws, from the control steps and the channels.
        draw: Fills the numbers (size,) of one episode, from its generator and the steps.
        sequence: From numbers (..., size), steps, channels and control period [s] to sequences in
            the unit ball, (..., steps, channels).
    """

    size: Callable[[int, int], int]
    draw: Callable[[np.random.Generator, FloatArray, int], None]
    sequence: Callable[[FloatArray, int, int, float], FloatArray]

    def realise(
        self, rng: np.random.Generator, steps: int, channels: int, period: float
    ) -> FloatArray:
        """Return one sequence in the unit ball, shape (steps, channels); period in [s]."""
        numbers = np.empty(self.size(steps, channels))
        self.draw(rng, numbers, steps)
        return self.sequence(numbers, steps, channels, period)


def _draw_normals(rng: np.random.Generator, numbers: FloatArray, steps: int) -> None:
    rng.standard_normal(out=numbers)


def _directions(normals: FloatArray, count: int, channels: int) -> FloatArray:
    axis = np.zeros(channels)
    axis[0] = INSIDE
    return onto_unit_sphere(normals.reshape(*normals.shape[:-1], count, channels), axis)


def _none(numbers: FloatArray, steps: int, channels: int, period: float) -> FloatArray:
    return np.zeros((*numbers.shape[:-1], steps, channels))


def _draw_uniform(rng: np.random.Generator, numbers: FloatArray, steps: int) -> None:
    rng.standard_normal(out=numbers[:-steps])
    rng.random(out=numbers[-steps:])


def _uniform(numbers: FloatArray, steps: int, channels: int, period: float) -> FloatArray:
    directions = _directions(numbers[..., :-steps], steps, channels)
    return directions * numbers[..., -steps:, None] ** (1.0 / channels)


def _constant(numbers: FloatArray, steps: int, channels: int, period: float) -> FloatArray:
    return np.repeat(_directions(numbers, 1, channels), steps, axis=-2)


def _draw_sinusoid(rng: np.random.Generator, numbers: FloatArray, steps: int) -> None:
    rng.standard_normal(out=numbers[:-2])
    numbers[-2] = rng.uniform(*SINUSOID_RATES)
    numbers[-1] = rng.uniform(0.0, 2.0 * math.pi)


def _sinusoid(numbers: FloatArray, steps: int, channels: int, period: float) -> FloatArray:
    direction = _directions(numbers[..., :-2], 1, channels)
    rate, phase = numbers[..., -2, None, None], numbers[..., -1, None, None]
    times = period * np.arange(steps)[:, None]
    waves: FloatArray = direction * np.sin(rate * times + phase)
    return waves


def _sphere(numbers: FloatArray, steps: int, channels: int, period: float) -> FloatArray:
    return _directions(numbers, steps, channels)


def _gust(numbers: FloatArray, steps: int, channels: int, period: float) -> FloatArray:
    # Exact discretisation of an Ornstein-Uhlenbeck process, begun in its stationary law.
    decay = math.exp(-period / GUST_CORRELATION_TIME)
    spread = GUST_SPREAD / math.sqrt(channels)
    shocks = spread * numbers.reshape(*numbers.shape[:-1], steps, channels)
    fresh = math.sqrt(1.0 - decay * decay)
    path = np.empty_like(shocks)
    value = shocks[..., 0, :]
    path[..., 0, :] = value
    for step in range(1, steps):
        value = decay * value + fresh * shocks[..., step, :]
        path[..., step, :] = value
    return into_unit_ball(path)


def switching_steps(period: float) -> int:
    """Return the control steps for which `switching` keeps a direction; period in [s]."""
    return max(1, round(SWITCHING_TIME / period))


def _switching(numbers: FloatArray, steps: int, channels: int, period: float) -> FloatArray:
    # One direction a step is drawn, whatever the period, of which the first few are used.
    directions = _directions(numbers, steps, channels)
    return directions[..., np.arange(steps) // switching_steps(period), :]


OPEN_LOOP: dict[str, OpenLoop] = {
    "none": OpenLoop(lambda steps, channels: 0, _draw_normals, _none),
    "uniform": OpenLoop(lambda steps, channels: steps * (channels + 1), _draw_uniform, _uniform),
    "sphere": OpenLoop(lambda steps, channels: steps * channels, _draw_normals, _sphere),
    "constant": OpenLoop(lambda steps, channels: channels, _draw_normals, _constant),
    "sinusoid": OpenLoop(lambda steps, channels: channels + 2, _draw_sinusoid, _sinusoid),
    "gust": OpenLoop(lambda steps, channels: steps * channels, _draw_normals, _gust),
    "switching": OpenLoop(lambda steps, channels: steps * channels, _draw_normals, _switching),
}
KINDS = (*OPEN_LOOP, "worst")


@dataclass(frozen=True, eq=False)
class WorstCase(ByValue):
    """Push along the gradient of e'Me, the direction in which the error energy grows fastest.

    Attributes:
        metric: M, shape (n, n), or a function of the states (..., n) that gives (..., n, n).
    """

    metric: FloatArray | Callable[[FloatArray], FloatArray]

    def __call__(self, situation: Situation) -> FloatArray:
        """Return M e, shape (..., n); the caller masks it and scales it to the bound.

        Raises:
            ValueError: The episode has no nominal trajectory, or the function that is the metric
                returned a wrong shape or what is not finite.
        """
        if situation.nominal is None:
            raise ValueError(
                'disturbance="worst" needs the nominal trajectory x_d of the episode: '
                'pass reset(options={"nominal": array of shape (steps + 1, n)})'
            )
        error = situation.state - situation.nominal
        metric = self._at(situation.state) if callable(self.metric) else self.metric
        gradient = np.einsum("...ij,...j->...i", metric, error)
        # An error of zero has no gradient: the direction of the episode breaks the tie.
        return np.where(np.any(error != 0.0, axis=-1, keepdims=True), gradient, situation.direction)

    def _at(self, state: FloatArray) -> FloatArray:
        """Return M at states (..., n) from the function of the user."""
        returned = cast("Callable[[FloatArray], FloatArray]", self.metric)(state.copy())
        matrices, shape = real_numbers(returned), (*state.shape, state.shape[-1])
        if (
            matrices is None
            or matrices.shape not in (shape, shape[-2:])
            or not np.isfinite(matrices).all()
        ):
            raise ValueError(
                f"the function metric returned {_described(returned, matrices)}; for states of "
                f"shape {state.shape} it must return finite numbers of shape {shape}"
            )
        return matrices


@dataclass(frozen=True, eq=False)
class Disturbance(ByValue):
    """A disturbance of one kind and bound on chosen channels of the state.

    Attributes:
        kind: A name of `KINDS`, or a function of the `Situation` whose value is projected onto the
            ball and the channels.
        bound: d_bar, the largest norm of d, in units of the state per second.
        channels: Mask of the disturbed states, length n.
        metric: M for the kind `worst`: an array (n, n) or a function of the state.

    Raises:
        ValueError: The kind is unknown, the bound is negative or not finite, the mask is empty, the
            metric is no metric of the state, or `worst` was asked for without one.
    """

    kind: str | Feedback
    bound: float
    channels: tuple[bool, ...]
    metric: FloatArray | Callable[[FloatArray], FloatArray] | None = None

    def __post_init__(self) -> None:
        if not callable(self.kind) and not (isinstance(self.kind, str) and self.kind in KINDS):
            raise ValueError(
                f"disturbance={shown(self.kind)} is not known; use one of {', '.join(KINDS)} or a "
                f"callable.{suggestion(self.kind, KINDS)}"
            )
        check_disturbance_bound("disturbance_bound", self.bound)
        if not any(self.channels):
            raise ValueError("channels must leave at least one state disturbed")
        if self.kind == "worst" and self.metric is None:
            raise ValueError(
                'disturbance="worst" needs a contraction metric: pass metric=M, an array (n, n) or '
                "a function of the state"
            )
        if self.metric is not None and not callable(self.metric):
            metric = _checked_metric(self.metric, len(self.channels))
            object.__setattr__(self, "metric", metric)
            self._lock()

    @cached_property
    def feedback(self) -> Feedback | None:
        """The function whose projected value is d; None for an open-loop kind."""
        if not isinstance(self.kind, str):
            return self.kind
        if self.kind == "worst" and self.metric is not None:
            return WorstCase(self.metric)
        return None

    @property
    def is_feedback(self) -> bool:
        """Whether d depends on the state."""
        return self.feedback is not None

    def realise(self, rng: np.random.Generator, steps: int, period: float) -> FloatArray:
        """Draw the disturbance of one episode.

        Args:
            rng: The disturbance stream of the episode.
            steps: Control steps of the episode.
            period: Control period [s].

        Returns:
            Shape (steps, n). For an open-loop kind d at every step, of norm at most the bound; for
            a feedback kind the unit direction of the episode, to be passed to `respond`.
        """
        sequence = np.empty((steps, len(self.channels)))
        self.realise_all([rng], sequence[None], period)
        return sequence

    def realise_all(
        self, generators: Iterable[np.random.Generator], sequences: FloatArray, period: float
    ) -> None:
        """Draw the disturbances of many episodes, each as `realise` draws it.

        Args:
            generators: The disturbance stream of each episode; each is done with before the next.
            sequences: Where to write, shape (episodes, steps, n).
            period: Control period [s].
        """
        # A feedback kind draws no sequence; its episode only needs one direction.
        kind = OPEN_LOOP.get(self.kind) if isinstance(self.kind, str) else None
        kind = kind or OPEN_LOOP["constant"]
        bound = 1.0 if self.is_feedback else self.bound
        episodes, steps, _ = sequences.shape
        disturbed = np.flatnonzero(self.channels)
        numbers = np.empty((min(episodes, _BLOCK), kind.size(steps, disturbed.size)))
        streams = iter(generators)
        for begin in range(0, episodes, _BLOCK):
            block = sequences[begin : begin + _BLOCK]
            drawn = numbers[: len(block)]
            for row in drawn:
                kind.draw(next(streams), row, steps)
            scaled = bound * kind.sequence(drawn, steps, disturbed.size, period)
            if disturbed.size < len(self.channels):
                block[:] = 0.0
                block[..., disturbed] = scaled
            else:
                block[:] = scaled

    def respond(self, situation: Situation) -> FloatArray:
        """Return d of a feedback kind, shape (..., n), of norm at most the bound.

        Raises:
            ValueError: The kind is an open-loop one, or the callable returned a wrong shape or a
                value that is not finite.
        """
        if self.feedback is None:
            raise ValueError(f"disturbance={self.kind!r} does not respond to states: realise it")
        if isinstance(self.kind, str):
            gradient = self.feedback(situation) * np.asarray(self.channels)
            if not np.isfinite(gradient).all():
                raise ValueError(f"metric={shown(self.metric)} is too large: M e is not finite")
            return self.bound * onto_unit_sphere(gradient, situation.direction)
        returned = self.feedback(situation.copy())
        push = real_numbers(returned)
        if push is None or push.shape != situation.state.shape or not np.isfinite(push).all():
            raise ValueError(
                f"the disturbance callable returned {_described(returned, push)}; it must return "
                f"finite numbers of the state's shape {situation.state.shape}"
            )
        return into_ball(push * np.asarray(self.channels), self.bound)


def _described(returned: Any, numbers: FloatArray | None) -> str:
    """Say what a function of the user has returned, and as numbers where it is made of them."""
    if numbers is None:
        return shown(returned)
    return f"shape {numbers.shape} (finite: {bool(np.isfinite(numbers).all())})"


def channel_mask(
    channels: Literal["all", "rates"] | Sequence[bool], rates: tuple[bool, ...]
) -> tuple[bool, ...]:
    """Resolve the channel mask of a task.

    Args:
        channels: "all", "rates", or one boolean per state.
        rates: Which states of the task are rates.

    Returns:
        One boolean per state.

    Raises:
        ValueError: The name is unknown or the mask has the wrong length.
    """
    if isinstance(channels, str):
        if channels == "all":
            return (True,) * len(rates)
        if channels == "rates":
            return rates
        raise ValueError(f'disturbance_channels={shown(channels)} must be "all", "rates" or a mask')
    mask = np.asarray(channels)
    if mask.dtype != np.bool_ or mask.ndim != 1:
        raise ValueError(
            f'disturbance_channels={shown(channels)} must be "all", "rates" or {len(rates)} '
            "booleans, one per state"
        )
    if len(mask) != len(rates):
        raise ValueError(
            f"disturbance_channels has {len(mask)} entries; the state has {len(rates)}"
        )
    return tuple(mask.tolist())


def _checked_metric(metric: Any, states: int) -> FloatArray:
    """Return M (states, states) in double precision.

    Raises:
        ValueError: It has another shape, or is not symmetric and positive definite.
    """
    matrix = real_numbers(metric)
    holds = (
        matrix is not None
        and matrix.shape == (states, states)
        and bool(np.all(np.isfinite(matrix)))
        and np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0)
        and float(np.linalg.eigvalsh(matrix)[0]) > 0.0
    )
    if matrix is None or not holds:
        raise ValueError(
            f"metric={shown(metric)} must be a symmetric positive definite matrix of shape "
            f"({states}, {states}), or a function of the state that gives one"
        )
    return matrix
