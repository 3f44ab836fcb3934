"""The loop of a network along its own undisturbed flight, as `plan_tubes` takes it.

Around its own flight a network leaves no offset: x_n is where it goes when nothing disturbs it, and
the error e = x - x_n moves by the slope of the network and what that leaves. Networks that see the
state through affine features (`View.affine`) are enclosed: by relaxations and second derivatives,
or, where the gain is scheduled (`Mlp`), as they are: u = c + K s is affine, and nothing but the
rounding of single precision is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_envs.arrays import Float32Array, FloatArray
from lagros_envs.numbers import Dual, Interval, exact, functions
from lagros_envs.numbers.interval import ordered
from lagros_envs.task import Scenario, Task
from lagros_policies.learning.features import Seen, View, view_of
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.rounds import flown, padded_discs
from lagros_policies.proof.error_set import ErrorSet
from lagros_policies.proof.network_enclosure import AffineEnclosure, enclose
from lagros_policies.proof.network_expansion import Expansion, evaluated
from lagros_policies.proof.rounded import above, symmetric
from lagros_policies.proof.steering import SINGLE, Steering

# Features that are said to be affine may differ by so much from the affine ones that are taken.
_AFFINE = 1e-9
# Roundings of an action on its way: sign, unit, the unit itself, and the sum with the centre.
_ACTION = 4
# What double precision rounds in a few operations.
DOUBLE = 2.0**-48


@dataclass(frozen=True)
class NetworkFlight:
    """What a network does when nothing disturbs it, and how it answers what does.

    Attributes:
        states: x_n, shape (p, N + 1, n).
        controls: u_n, shape (p, N, m).
        steering: The network, enclosed around them.
    """

    states: FloatArray
    controls: FloatArray
    steering: NetworkSteering


def network_flight(task: Task, network: Mlp, scenarios: Sequence[Scenario]) -> NetworkFlight:
    """Fly scenarios undisturbed, and enclose the network around these flights.

    Args:
        task: The task.
        network: The network of policy (c), or of another that sees what the task's networks see.
        scenarios: The episodes, p of them.

    Raises:
        ValueError: What the network sees is not affine in the state.
    """
    pushes = np.zeros((len(scenarios), task.steps, task.system.state_dim))
    states = flown(task, network, scenarios, pushes)
    layout = task.layout
    rows = np.zeros((len(scenarios), task.steps, layout.size))
    rows[..., layout.state] = states[:, :-1]
    rows[..., layout.time] = task.control_period * np.arange(task.steps)
    for row, scenario in zip(rows, scenarios, strict=True):
        row[:, layout.goal], row[:, layout.initial_state] = scenario.goal, scenario.initial_state
        row[:, layout.discs] = padded_discs(task, scenario).ravel()
    steering = NetworkSteering(task, network, rows.astype(np.float32))
    return NetworkFlight(states, steering.controls(), steering)


class NetworkSteering:
    """A network as a `Controller`, around observations along p flights.

    Args:
        task: The task.
        network: The network.
        rows: Observations along the flights, shape (p, N, o); what else than the state is in them
            is what the network will see, bit by bit.

    Raises:
        ValueError: What the network sees is not affine in the state, or a scheduled gain depends
            on the state.
    """

    def __init__(self, task: Task, network: Mlp, rows: Float32Array) -> None:
        self.task, self.network = task, network
        view = view_of(task)
        self._place = rows[..., task.layout.state].astype(np.float64)
        self._features, self._slope, signs = _affine_features(task, view, rows)
        shape = *rows.shape[:2], task.system.control_dim
        self._signs = np.broadcast_to(signs, shape)
        self._law: tuple[Interval, FloatArray] | None = None
        if network.scheduled:
            if network.scheduled > view.affine:
                raise ValueError(
                    f"the gain is scheduled by features that depend on the state: the first "
                    f"{view.affine} do, and the network is affine in {network.scheduled} of them"
                )
            scheduling = self._features[..., network.scheduled :]
            self._law = evaluated(network, scheduling)

    def controls(self) -> FloatArray:
        """Return the controls at the places, of real numbers, shape (p, N, m)."""
        found = np.empty(self._signs.shape)
        for step in range(self.task.steps):
            middle = self._place[:, step]
            found[:, step] = self._enclosed(step, middle, np.zeros_like(middle)).offset
        return found

    def steering(
        self, step: int, errors: ErrorSet, state: FloatArray, control: FloatArray
    ) -> Steering:
        """Enclose the control that reaches the environment; see `Controller.steering`."""
        # What is seen is rounded to single precision.
        reach, centre = errors.radius, state + errors.centre
        unseen = above(SINGLE * (np.abs(centre) + reach) + DOUBLE * np.abs(centre))
        if self._law is None:
            found = self._curved(step, centre, above(reach + unseen), *axes_along(errors, unseen))
        else:
            found = self._enclosed(step, centre, above(reach + unseen))
        offset = found.offset - control
        largest = np.abs(found.range()).upper + np.abs(np.array(self.task.control_centre))
        size = np.abs(found.gain)
        radius = found.error + np.einsum("pmn,pn->pm", size, unseen) + _ACTION * SINGLE * largest
        radius = radius + DOUBLE * (np.abs(offset) + np.abs(control))
        return Steering(found.gain, offset, above(radius))

    def _curved(
        self,
        step: int,
        centre: FloatArray,
        reach: FloatArray,
        axes: FloatArray,
        back: FloatArray,
        along: FloatArray,
    ) -> AffineEnclosure:
        """Enclose a curved network over boxes |R e| <= along that lie along the errors.

        Args:
            step: Index of the control step.
            centre: Middle of each box, shape (p, n).
            reach: Bounds of |e| by coordinate, shape (p, n).
            axes: T, almost the inverse of R, shape (p, n, n).
            back: R, shape (p, n, n).
            along: Half the sides along the axes, shape (p, n).
        """
        slope = self._slope[:, step]
        sizes = np.abs(slope)
        # e = T f + what R misses of the inverse of T, which the features do not see.
        missed = DOUBLE * (np.abs(axes) @ (np.abs(back) @ reach[..., None]))
        turned = slope @ axes
        unturned = DOUBLE * (sizes @ (np.abs(axes) @ along[..., None]))
        lost = above((sizes @ missed + unturned)[..., 0])
        found = self._enclosed(step, centre, along, turned, lost)
        gain = found.gain @ back
        turn = np.einsum("pmi,pij,pj->pm", np.abs(found.gain), np.abs(back), reach)
        return AffineEnclosure(
            centre, reach, found.offset, gain, above(found.error + DOUBLE * turn)
        )

    def _enclosed(
        self,
        step: int,
        centre: FloatArray,
        reach: FloatArray,
        slope: FloatArray | None = None,
        lost: FloatArray | float = 0.0,
    ) -> AffineEnclosure:
        """Enclose the control in units of u over boxes of the state, single precision included.

        Args:
            step: Index of the control step.
            centre: Middle of each box, shape (p, n).
            reach: Half its sides, shape (p, n).
            slope: Of the affine features along the sides, shape (p, k, n); by the state if left
                out.
            lost: What the features may be off that, shape (p, k).
        """
        by_state = self._slope[:, step]
        count = by_state.shape[1]
        moved = exact(centre) - self._place[:, step]
        near = product(exact(by_state), moved[:, None])
        value = exact(self._features[:, step, :count]) + near
        slope = by_state if slope is None else slope
        away = np.einsum("pfn,pn->pf", np.abs(slope), reach)
        values = value + symmetric(above(away))
        rounding = above(SINGLE * np.abs(values).upper + lost)
        if self._law is not None:
            found = self._scheduled(step, centre, reach, value, values, rounding)
        else:
            rest = exact(self._features[:, step, count:])
            inputs = _inputs(centre, reach, slope, value, values, rest, rounding)
            found = enclose(self.network, inputs)
        return found.scaled(self._signs[:, step])

    def _scheduled(
        self,
        step: int,
        centre: FloatArray,
        reach: FloatArray,
        value: Interval,
        values: Interval,
        rounding: FloatArray,
    ) -> AffineEnclosure:
        """Enclose c + K s, of which c and K are known."""
        assert self._law is not None
        count, m = self.network.scheduled, self.task.system.control_dim
        numbers, loose = self._law[0][:, step], self._law[1][:, step]
        rows = numbers[:, m:].lower.shape[0], m, count
        gain = ordered(
            *(part.reshape(rows) for part in (numbers.lower[:, m:], numbers.upper[:, m:]))
        )
        middle, spread = gain.midpoint, gain.radius + loose[:, m:].reshape(rows)
        total = numbers[:, :m] + product(exact(middle), value[:, None, :count])
        size = np.abs(values[:, :count]).upper
        # What c and K are not known to, what s is rounded to, and the sum in single precision.
        error = loose[:, :m] + np.einsum("pmk,pk->pm", spread, size + rounding[:, :count])
        error = error + np.einsum("pmk,pk->pm", np.abs(middle), rounding[:, :count])
        largest = np.abs(numbers[:, :m]).upper + np.einsum(
            "pmk,pk->pm", np.abs(middle) + spread, size + rounding[:, :count]
        )
        error = error + (count + 2) * SINGLE * largest + total.radius
        slope = self._slope[:, step, :count]
        by_state = np.einsum("pmk,pkn->pmn", middle, slope)
        # The product of gain and slope is rounded, too.
        error = error + DOUBLE * np.einsum("pmk,pkn,pn->pm", np.abs(middle), np.abs(slope), reach)
        return AffineEnclosure(centre, reach, total.midpoint, by_state, above(error))


def axes_along(errors: ErrorSet, unseen: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return axes along which a set of errors lies, and how far it goes along them.

    Returns:
        T of e = T f, shape (p, n, n), R of f = R e, likewise, its inverse but for rounding, and
        bounds of |f|, shape (p, n), with |e| up to `unseen` (p, n) more.
    """
    columns = errors.generators
    scale = np.sqrt((columns**2).sum(axis=-1))
    scale = np.maximum(np.where(scale > 0.0, scale, 1.0), 1e-100)
    unit = columns / scale[..., None]
    _, vectors = np.linalg.eigh(unit @ np.swapaxes(unit, 1, 2))
    back = np.swapaxes(vectors, 1, 2) / scale[:, None, :]
    along = errors.support(back) + np.einsum("pij,pj->pi", np.abs(back), unseen)
    return scale[..., None] * vectors, back, above(along)


def _inputs(
    centre: FloatArray,
    reach: FloatArray,
    slope: FloatArray,
    value: Interval,
    values: Interval,
    rest: Interval,
    rounding: FloatArray,
) -> Expansion:
    """Return features that are affine in the state, followed by others, over boxes."""
    plans, n = centre.shape
    others = rest.shape[1]
    slopes = np.concatenate([np.swapaxes(slope, 1, 2), np.zeros((plans, n, others))], axis=2)
    return Expansion(
        centre,
        reach,
        _beside(value, rest),
        exact(slopes),
        _beside(values, rest),
        exact(slopes),
        exact(np.zeros((plans, n * (n + 1) // 2, slopes.shape[2]))),
        # The others are what they are in single precision.
        np.concatenate([rounding, np.zeros((plans, others))], axis=1),
    )


def _beside(one: Interval, other: Interval) -> Interval:
    return ordered(
        np.concatenate([one.lower, other.lower], axis=-1),
        np.concatenate([one.upper, other.upper], axis=-1),
    )


def product(left: Interval, right: Interval) -> Interval:
    """Enclose the sums over the last axis of products, (..., k) by (..., k)."""
    terms = left * right
    total = terms[..., 0]
    for index in range(1, terms.shape[-1]):
        total = total + terms[..., index]
    return total


def _affine_features(
    task: Task, view: View, rows: Float32Array
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return features at observations, their slopes by the state, and the signs of the outputs.

    Returns:
        Features, shape (p, N, f): the affine ones of real numbers, the others in single precision,
        as the network sees them; the slopes of the affine ones, (p, N, k, n); signs, (p, N, m).

    Raises:
        ValueError: They are not affine as the view says.
    """
    count, layout, n = view.affine, task.layout, task.system.state_dim
    if not count:
        raise ValueError(
            f"what the networks of {task.name} see is not affine in the state: only networks that "
            "see it so are enclosed (View.affine)"
        )
    shape = rows.shape[:2]
    flat = rows.reshape(-1, rows.shape[-1]).astype(np.float64)

    def at(observation: FloatArray, move: bool) -> Seen:
        columns: Any = list(observation.T)
        for index in range(n if move else 0):
            unit = np.zeros((n, len(observation)))
            unit[index] = 1.0
            place = range(layout.size)[layout.state][index]
            columns[place] = Dual(columns[place], unit)
        return view(columns, functions)

    def table(columns: Sequence[Any]) -> FloatArray:
        return np.stack([np.broadcast_to(one, len(flat)) for one in columns], axis=-1)

    here = at(flat, move=False)
    features = table(here.features)
    slope = np.zeros((len(flat), features.shape[1], n))
    for index, one in enumerate(at(flat, move=True).features):
        if isinstance(one, Dual):
            slope[:, index] = np.broadcast_to(one.gradient, (n, len(flat))).T
    # Somewhere else they must be where the slope leads.
    shift = np.random.default_rng(0).standard_normal((len(flat), n))
    other = flat.copy()
    other[:, layout.state] += shift
    gone = table(at(other, move=False).features) - features
    straight = np.einsum("sfn,sn->sf", slope, shift)
    if np.any(slope[:, count:]) or not np.allclose(gone, straight, rtol=0.0, atol=_AFFINE):
        raise ValueError(
            f"the first {count} features of {task.name} are said to be affine in the state, the "
            "others not to depend on it, and that is not so: see View.affine"
        )
    features[:, count:] = features[:, count:].astype(np.float32)
    signs = table(here.signs) if here.signs else np.ones((len(flat), 1))
    return (
        features.reshape(*shape, -1),
        slope[:, :count].reshape(*shape, count, n),
        signs.reshape(*shape, -1),
    )
