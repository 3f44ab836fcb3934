"""The families of matrices that are proved definite, for any system, against brute force."""

from dataclasses import replace

import numpy as np
import pytest

from lagros_envs.dynamics import check_system, hold_step
from lagros_envs.numbers import Interval, exact
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.pvtol.physics import Pvtol as Planar
from lagros_policies.contraction import Basis, BoxRegion, HeldControl, Metric, Samples
from lagros_policies.contraction.ellipsoid import TubeControl, prove_tube
from lagros_policies.contraction.held_design import HeldDesign, design_held_contained
from lagros_policies.contraction.held_ellipsoid import prove_held_tube
from lagros_policies.contraction.tube_design import PlanBounds, TubeDesign, design_contained
from lagros_policies.proof.condition import largest_proved, prove, prove_contraction
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
from tests.policies.foreign import (
    Car,
    Pvtol,
    Ramp,
    Triple,
    brute_residual,
    positive,
    reach,
    slopes,
)

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


# What is true of other systems.

FREE = np.inf
CAR = BoxRegion(
    (-FREE, -FREE, -0.6, 1.0),
    (FREE, FREE, 0.6, 2.0),
    (FREE, FREE, 1.2, 1.0),
    (-1.0,) * 2,
    (1.0,) * 2,
)
CAR_W = [
    [1.778, -0.039, 0.031, -1.044],
    [-0.039, 1.809, -0.994, -0.005],
    [0.031, -0.994, 2.221, 0.029],
    [-1.044, -0.005, 0.029, 2.406],
]


PLANAR_W = [
    [6.435, -0.031, 0.042, -4.135, 0.148, -0.283],
    [-0.031, 1.757, -0.052, -0.127, -2.643, 0.03],
    [0.042, -0.052, 0.52, 1.129, -0.063, -0.828],
    [-4.135, -0.127, 1.129, 8.467, -0.32, 0.929],
    [0.148, -2.643, -0.063, -0.32, 10.371, 0.29],
    [-0.283, 0.03, -0.828, 0.929, 0.29, 11.84],
]


def car(weight=8.5, rate=0.3):
    return Metric(np.array([CAR_W]), rate, 4.0, weight, np.ones(4), CAR)


def triples_of(box, count, seed):
    """Return triples of a box, x and x_d anywhere in it, at its faces more often than inside."""
    rng, ends = np.random.default_rng(seed), (np.array(box.low), np.array(box.high))
    low, high = (
        np.where(np.isfinite(end), end, sign) for end, sign in zip(ends, (-1, 1), strict=True)
    )
    x, y = (
        low + np.clip(rng.uniform(-0.3, 1.3, (count, len(low))), 0, 1) * (high - low) for _ in "xy"
    )
    least, most = np.array(box.control_low), np.array(box.control_high)
    share = np.clip(rng.uniform(-0.3, 1.3, (count, len(least))), 0, 1)
    return Samples(x, y, least + share * (most - least))


def test_a_car_is_proved_to_contract_on_a_whole_box():
    found = prove(Car(), car(), CAR, period=0.1)
    assert [line.holds for line in found.statements] == [True, True, True]
    assert "any x[0], x[1]" in found.statements[0].text
    assert brute_residual(Car(), car(), triples_of(CAR, 300, 0)).max() < 0.0
    # u* finds contracting controls there.
    samples = triples_of(CAR, 500, 1)
    error = 1e-5 * np.random.default_rng(2).standard_normal(samples.state.shape)
    law = HeldControl(Car(), car(), 0.3, 0.1)
    a, b, c = law.quadratic(samples.state, samples.state - error, samples.nominal_control)
    assert np.all(np.einsum("si,sij,sj->s", b, np.linalg.inv(a), b) > c)


def test_bad_metrics_of_a_car_are_refused_with_a_point_that_fails():
    for metric, rate in ((car(weight=0.01), 0.3), (car(), 3.0)):
        found = prove_contraction(Car(), metric, CAR, rate)
        point = found.violation
        assert not found.proved
        left = left_side(Car(), replace(metric, contraction_rate=rate), point)
        assert np.linalg.eigvalsh(left)[-1] > 0.0
    lines = prove(Car(), car(weight=0.01), CAR).statements
    assert [line.verdict for line in lines] == ["NO", "yes"]


def test_the_largest_multiple_of_a_box_is_found():
    wide = CAR.scaled(2.0)
    assert wide.low[3] == 0.5
    assert wide.error == (FREE, FREE, 2.4, 2.0)
    found = largest_proved(Car(), car(), wide, rounds=3, most_seconds=20.0)
    assert found.proved
    assert 0.6 <= found.box.high[2] < 1.2


def test_what_a_control_moves_or_nothing_bounds_is_refused():
    moved = replace(
        car(), coefficients=np.array([CAR_W, np.zeros((4, 4))]), basis=Basis(("1", "x[3]"))
    )
    with pytest.raises(ValueError, match=r"a control of Car.* moves coordinates \(3,\).*nominal"):
        prove_contraction(Car(), moved, CAR)
    assert prove_contraction(Car(), replace(moved, point="nominal"), CAR).proved
    free = replace(
        CAR, low=(-FREE,) * 3 + (1.0,), high=(FREE,) * 3 + (2.0,), error=(FREE,) * 3 + (1.0,)
    )
    with pytest.raises(ValueError, match="not bounded"):
        prove_contraction(Car(), car(), free)
    with pytest.raises(ValueError, match=r"low of shape \(4,\)"):
        prove_contraction(Ramp(), car(), CAR)


def test_a_quadrotor_is_proved_to_contract_on_a_whole_box():
    hover = Planar().hover
    box = BoxRegion(
        (-FREE, -FREE, -0.3, -0.5, -0.5, -0.5),
        (FREE, FREE, 0.3, 0.5, 0.5, 0.5),
        (FREE, FREE, 0.6, 1.0, 1.0, 1.0),
        (hover - 0.5,) * 2,
        (hover + 0.5,) * 2,
    )
    metric = Metric(np.array([PLANAR_W]), 0.3, 60.0, 4.0, np.ones(6), box)
    assert prove_contraction(Planar(), metric, box).proved
    assert brute_residual(Planar(), metric, triples_of(box, 100, 3)).max() < 0.0
    fast = prove_contraction(Planar(), metric, box, 0.9)
    assert fast.violation is not None


def test_a_tube_of_a_car_is_designed_proved_and_kept():
    """An invariant ellipsoid that keeps the car in the box of its own condition."""
    plans = PlanBounds((-FREE, -FREE, -0.2, 1.2), (FREE, FREE, 0.2, 1.8), (-0.3,) * 2, (0.3,) * 2)
    tube = design_contained(Car(), plans, TubeDesign(rate=0.5, disturbance_bound=0.1))
    assert prove_tube(Car(), tube).proved
    wider = replace(tube, design=replace(tube.design, disturbance_bound=0.2))
    assert not prove_tube(Car(), wider).proved
    control = TubeControl(Car(), tube)
    rng = np.random.default_rng(5)
    nominal = np.tile([0.0, 0.0, 0.1, 1.5], (200, 1))
    state, u_d, step = nominal.copy(), np.zeros((200, 2)), 0.02
    push = rng.standard_normal((200, 4))
    for _ in range(100):
        push = push + 0.3 * rng.standard_normal((200, 4))
        force = 0.1 * push / np.linalg.norm(push, axis=1, keepdims=True)
        state = hold_step(Car(), state, control(state, nominal, u_d), step, force, substeps=1)
        nominal = hold_step(Car(), nominal, u_d, step, substeps=1)
        assert np.all(np.abs(state - nominal) <= tube.steady_outputs)


@pytest.mark.slow
def test_a_tube_of_a_held_car_is_designed_and_proved():
    plans = PlanBounds((-FREE, -FREE, -0.2, 1.2), (FREE, FREE, 0.2, 1.8), (-0.3,) * 2, (0.3,) * 2)
    design = HeldDesign(0.1, 0.5, disturbance_bound=0.1, degree=3, control_unit=1.0)
    tube = design_held_contained(Car(), plans, design)
    assert prove_held_tube(Car(), tube).proved
    wider = replace(tube, design=replace(design, disturbance_bound=0.2))
    assert not prove_held_tube(Car(), wider).proved


def test_no_proof_reaches_over_a_bend_and_one_beside_it_is_found():
    """|v| v has no second derivative at v = 0; it flies and plans all the same."""

    class Boat:
        state_dim, control_dim = 2, 1

        def derivative(self, x, u, functions):
            return x[1], u[0] - 0.3 * abs(x[1]) * x[1]

    check_system(Boat(), np.zeros((1, 2)), np.ones((1, 1)))
    weights = np.array([[[1.0, -1.0], [-1.0, 2.0]]])
    for low, proved in ((-1.0, False), (1.0, True)):
        box = BoxRegion((-1.0, low), (1.0, 2.0), (0.1, 0.1), (-1.0,), (1.0,))
        metric = Metric(weights, 0.3, 50.0, 9.0, np.ones(2), box)
        found = prove_contraction(Boat(), metric, box, most_boxes=2000)
        assert (found.proved, found.refuted) == (proved, False)


def test_a_box_of_too_many_coordinates_is_refused_before_any_is_cut():
    class Chain:
        state_dim, control_dim = 12, 1

        def derivative(self, x, u, functions):
            return [*(after**2 for after in x[1:]), u[0]]

    box = BoxRegion((-1.0,) * 12, (1.0,) * 12, (0.1,) * 12, (-1.0,), (1.0,))
    metric = Metric(np.eye(12)[None], 0.3, 50.0, 9.0, np.ones(12), box)
    with pytest.raises(ValueError, match=r"pieces before a search cuts any, more than 10000"):
        prove_contraction(Chain(), metric, box)
