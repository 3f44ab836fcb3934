"""The families of matrices that are proved definite, for any system, against brute force."""

import numpy as np
import pytest

from lagros_envs.dynamics import hold_step
from lagros_envs.numbers import Interval, exact
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_policies.contraction import Basis, BoxRegion, Metric
from lagros_policies.proof.enclosures import constant
from lagros_policies.proof.families import (
    BoxCondition,
    Violation,
    _regular_rows,
    hold_matrices,
    lifted_matrices,
    rate_matrices,
)
from lagros_policies.proof.sets import Triple as SetTriple
from lagros_policies.proof.sets import boxed, held_triples, triples
from lagros_policies.tasks.cartpole.box import ProofBox, balance
from tests.policies.foreign import Car, Pvtol, Triple, positive, reach, slopes

PVTOL_BOX = BoxRegion(
    (-9.0, -9.0, -0.3, -0.5, -0.4, -0.3),
    (9.0, 9.0, 0.2, 0.5, 0.4, 0.3),
    (9.0, 9.0, 0.2, 0.3, 2.0, 0.1),
    (1.5, 1.5),
    (3.5, 3.5),
)
CAR_BOX = BoxRegion(
    (-9.0, -9.0, -0.5, 1.0), (9.0, 9.0, 0.5, 2.0), (1.0, 1.0, 0.2, 0.4), (-1.0, -2.0), (1.0, 2.0)
)
TRIPLE_BOX = BoxRegion((-0.5,) * 4, (0.5,) * 4, (0.2,) * 4, (-1.0,) * 3, (1.0,) * 3)
LEANING = ProofBox(0.6, 1.0, 1.5, 1.0, 0.2, 0.4, lean=0.5)


def metric_of(n, terms, box, point="state"):
    parts = [positive(n, 3)] + [0.1 * positive(n, seed) for seed in range(1, len(terms))]
    return Metric(np.stack(parts), 0.3, 50.0, 2.0, np.ones(n), box, basis=Basis(terms), point=point)


CASES = [
    (Pvtol(), PVTOL_BOX, metric_of(6, ("1",), PVTOL_BOX)),
    (Pvtol(), PVTOL_BOX, metric_of(6, ("1", "cos(x[2])", "x[2]^2*x[1]"), PVTOL_BOX)),
    (Car(), CAR_BOX, metric_of(4, ("1", "cos(x[2])*x[3]", "sin(x[2])"), CAR_BOX, "nominal")),
    (Triple(), TRIPLE_BOX, metric_of(4, ("1", "x[1]", "cos(x[3])"), TRIPLE_BOX, "nominal")),
    (CartPole(), LEANING, metric_of(4, ("1", "cos(x[1])", "cos(x[1])^3"), LEANING.region)),
]
by_case = pytest.mark.parametrize(
    ("system", "box", "metric"), CASES, ids=["pvtol", "pvtol-roll", "car", "triple", "cartpole"]
)


def triple_at(where, coordinates, middle):
    """Return the triple of a set at coordinates, as arrays."""
    found = where.triple([constant(float(one), 0) for one in coordinates], middle)
    names = ("place", "between", "state", "control")
    parts = (getattr(found, name) for name in names)
    return SetTriple(*(np.array([float(x.parts[0].midpoint) for x in part]) for part in parts))


def left_side(system, metric, point):
    """Return the left side at a point, by complex steps and by moving along the flow."""
    slope, gain = slopes(system, point.nominal, point.control), reach(system, point.state)
    dual, h = metric.dual(point.place), 1e-6
    columns = [point.place[i] for i in range(len(point.place))]
    motion = np.array(system.derivative(columns, list(point.control), np), dtype=float)
    change = metric.dual(point.place + h * motion) - metric.dual(point.place - h * motion)
    left = slope @ dual + dual @ slope.T - change / (2.0 * h)
    left -= 2.0 * metric.control_weight * gain @ gain.T
    return left + 2.0 * metric.contraction_rate * dual


def interpolated(corners, share):
    """Return the multilinear interpolation of corners (2^c, n, n) at shares (c,)."""
    weights = np.ones(1)
    for one in share:
        weights = np.concatenate([w * np.array([1.0 - one, one]) for w in weights[:, None]])
    return np.tensordot(weights, corners, axes=1)


def check_between_corners(condition, brute, tolerance, part=0.2, sharp=True):
    rng, bent = np.random.default_rng(1), 0.0
    start = condition.start()
    low = start.lower[rng.integers(0, len(start.lower), 8)]
    width = part * (start.upper - start.lower).max(axis=0)
    cells = Interval(low, low + width)
    found = condition.examine(cells)
    size = sum(np.maximum(np.abs(part.lower), np.abs(part.upper)) for part in found.remainders)
    for index in range(len(low)):
        share = rng.random(low.shape[1])
        point = condition._point(low[index] + share * width, cells.midpoint[index])
        gap = np.abs(interpolated(found.corners.midpoint[index], share) - brute(point))
        assert np.all(gap <= size[index] + tolerance)
        bent = max(bent, float(gap.max()))
    # Not so wide that nothing could be proved with it, and not without a bend.
    assert tolerance < bent
    assert not sharp or np.median(size) < 100.0 * bent


@by_case
def test_what_lies_between_corners_is_within_the_remainders(system, box, metric):
    where = triples(box, system, metric.point)
    condition = BoxCondition(where, rate_matrices(system, metric, metric.contraction_rate))
    check_between_corners(condition, lambda point: left_side(system, metric, point), 1e-5)


@by_case
def test_coordinates_on_which_nothing_depends_are_left_out(system, box, metric):
    where = triples(box, system, metric.point)
    condition = BoxCondition(where, rate_matrices(system, metric, metric.contraction_rate))
    rng, spread, moves = np.random.default_rng(2), where.upper - where.lower, set()
    for _ in range(3):
        base = where.lower + rng.random(len(spread)) * spread

        def at(coordinates, middle=base):
            found = triple_at(where, coordinates, list(middle))
            point = Violation(found.state, found.between, found.control, found.place)
            return left_side(system, metric, point)

        for index in np.flatnonzero(spread):
            moved = base.copy()
            moved[index] = where.lower[index] + rng.random() * spread[index]
            if np.abs(at(moved) - at(base)).max() > 1e-7:
                moves.add(index)
    assert moves == set(condition.moving)


@pytest.mark.parametrize("error", [0.0, 0.3, 0.5, 0.8, 1.0, 3.0])
def test_the_set_holds_every_pair_of_a_box_and_no_other(error):
    """Of one coordinate between -0.4 and 0.6: y, and x as its share of what is left around y."""
    where = boxed((-0.4,), (0.6,), (error,), (0.0,), (1.0,))
    cells = where.cells((3, 1, 1))
    for low, high in zip(cells.lower, cells.upper, strict=True):
        for y in (low[0], 0.5 * (low[0] + high[0]), high[0]):
            ends = []
            for share in (low[1], high[1]):
                found = triple_at(where, [y, share, 0.0], [0.5 * (low[0] + high[0])] * 3)
                ends.append(float(found.place[0]))
            wanted = max(-0.4, y - error), min(0.6, y + error)
            assert ends == pytest.approx(wanted, abs=1e-9)


def test_a_leaning_force_is_that_which_holds_the_pole_still_at_x_d():
    where = LEANING.proof_set(CartPole())
    rng, spread = np.random.default_rng(4), where.upper - where.lower
    body = CartPole()
    for _ in range(50):
        place = where.lower + rng.random(len(spread)) * spread
        found = triple_at(where, place, list(place))
        y, x, control = found.between, found.place, found.control[0]
        assert np.all(np.abs(x - y)[[1, 3]] <= [0.2 + 1e-9, 0.4 + 1e-9])
        assert abs(y[2]) <= 1.0 + 1e-9
        largest = 0.5 * 1.1 * 9.8 * np.tan(np.clip(abs(y[1]) + 0.2, 0.0, 0.6))
        assert abs(control) <= 1.0 + largest + 1e-9
    still = float(balance(body, exact(0.4)).midpoint)
    assert abs(body.derivative([0.0, 0.4, 0.0, 0.0], [still], np)[3]) < 1e-12


@pytest.mark.parametrize(("system", "box", "metric"), CASES[1:4], ids=["pvtol", "car", "triple"])
def test_the_condition_over_a_hold_is_that_of_brute_force(system, box, metric):
    rate, period = 0.3, 0.05
    where = held_triples(box, system)
    condition = BoxCondition(where, hold_matrices(system, metric, rate, period, where))
    middle = 0.5 * (np.array(box.low) + np.array(box.high))
    control = np.array(
        [0.5 * (a + b) for a, b in zip(box.control_low, box.control_high, strict=True)]
    )

    def held(state, control):
        h = period / 4.0

        def slope(x):
            return np.stack(system.derivative(list(x), list(control), np))

        for _ in range(4):
            one = slope(state)
            two = slope(state + h / 2 * one)
            three = slope(state + h / 2 * two)
            four = slope(state + h * three)
            state = state + h / 6 * (one + 2 * two + 2 * three + four)
        return state

    def differentiated(state, control):
        whole, columns = np.concatenate([state, control]), []
        for index in range(len(whole)):
            there = whole.astype(complex)
            there[index] += 1e-30j
            columns.append(held(there[: len(state)], there[len(state) :]).imag / 1e-30)
        full = np.stack(columns, axis=-1)
        return full[:, : len(state)], full[:, len(state) :]

    rows = _regular_rows(differentiated(middle, control)[1])
    others = [row for row in range(system.state_dim) if row not in rows]

    def brute(point):
        slope, gain = differentiated(point.state, point.control)
        left = np.zeros((len(others), system.state_dim))
        left[:, others] = np.eye(len(others))
        left[:, rows] = -gain[others] @ np.linalg.inv(gain[rows])
        after = metric.dual(hold_step(system, point.state, point.control, period))
        inner = slope @ metric.dual(point.state) @ slope.T - np.exp(-2 * rate * period) * after
        assert np.abs(left @ gain).max() < 1e-12
        return left @ inner @ left.T

    # Three columns to eliminate widen what intervals find.
    check_between_corners(condition, brute, 1e-11, 0.02, system.control_dim < 3)


def test_the_lifted_condition_is_that_of_brute_force():
    system, n, m = Triple(), 4, 3
    dual = positive(n + m)
    where = triples(TRIPLE_BOX, system, "state")
    condition = BoxCondition(where, lifted_matrices(system, dual, exact(np.eye(n + m))))

    def brute(point):
        lifted = np.zeros((n + m, n + m))
        lifted[:n, :n] = slopes(system, point.nominal, point.control)
        lifted[:n, n:] = reach(system, point.state)
        return lifted @ dual + dual @ lifted.T + np.eye(n + m)

    check_between_corners(condition, brute, 1e-8)
