"""u* against the programs that define it, and the closed loop against Theorem 2."""

from dataclasses import replace

import cvxpy as cp
import gymnasium as gym
import numpy as np
import osqp
import pytest
import scipy.optimize
import scipy.sparse
from hypothesis import assume, given
from hypothesis import strategies as st

import lagros_envs  # noqa: F401  registers the environment
from lagros_envs.dynamics import hold_step, linearise_hold
from lagros_policies.contraction import (
    CvStemSettings,
    HeldControl,
    Metric,
    certified_tube,
    extreme_eigenvalues,
    robust_control,
)
from lagros_policies.contraction.control import error_energy, nearest_in_ellipsoid

PERIOD = 0.1
unit = st.floats(-1.0, 1.0)
# x_d within the region, e within its box, u_d.
triples = st.tuples(
    st.tuples(unit, unit, unit, unit),
    st.tuples(unit, unit, unit, unit),
    unit,
)


def as_triple(drawn):
    nominal, error, force = drawn
    nominal = np.array(nominal) * [5.0, 0.9, 3.0, 2.0]
    error = np.array(error) * [1.0, 0.2, 2.0, 1.0]
    return nominal + error, nominal, np.array([30.0 * force])


def least_deviation(phi_0, phi_1):
    """Return min ||v||^2 s.t. phi_0 + phi_1'v <= 0, by OSQP; rows scaled to one for its sake."""
    size = np.linalg.norm(phi_1)
    solver = osqp.OSQP()
    unknowns = len(phi_1)
    # In units of the distance to the constraint, so that OSQP's tolerance is relative.
    distance = abs(phi_0) / size
    solver.setup(
        scipy.sparse.eye(unknowns, format="csc"),
        np.zeros(unknowns),
        scipy.sparse.csc_matrix((phi_1 / size)[None]),
        np.array([-np.inf]),
        np.array([-np.sign(phi_0)]),
        verbose=False,
        eps_abs=1e-9,
        eps_rel=1e-9,
        max_iter=100_000,
    )
    answer = solver.solve(raise_error=True)
    assert answer.info.status == "solved"
    return distance * answer.x


class TwoForces:
    """A body in the plane under two oblique forces, with a drift that is not linear."""

    state_dim, control_dim = 4, 2

    def derivative(self, state, control, functions):
        x, angle, v, w = state
        push = functions.cos(angle) * control[0] + 0.3 * control[1]
        turn = (0.2 + 0.1 * functions.sin(x)) * control[0] - control[1]
        return v, w, push - 0.4 * v + x * w, turn + functions.sin(angle) - 0.1 * w * v

    def rates(self, state, control):
        return np.stack(self.derivative(list(state), list(control), np))


@given(triples, st.sampled_from([0.5, 2.0]))
def test_robust_control_solves_the_program_of_the_cart_pole(metric, system, oracle, drawn, rate):
    state, nominal, nominal_control = as_triple(drawn)
    energy = oracle.energy(metric, state, nominal)
    assume(energy > 1e-6)

    def excess(control):
        moving = oracle.energy_rate(metric, state, nominal, nominal_control, control)
        return moving + 2.0 * rate * energy

    phi_0 = excess(nominal_control)
    phi_1 = (excess(nominal_control + 1.0) - excess(nominal_control - 1.0)) / 2.0
    # Where V hardly depends on u, and at the switch, differences of V say nothing.
    assume(abs(phi_1) > 1e-3 * energy)
    assume(abs(phi_0) > 1e-6 * energy)
    deviation = robust_control(system, metric, rate, state, nominal, nominal_control)
    deviation = deviation - nominal_control
    expected = least_deviation(phi_0, np.array([phi_1])) if phi_0 > 0.0 else np.zeros(1)
    assert deviation == pytest.approx(expected, rel=1e-4, abs=1e-4)


@given(
    st.lists(unit, min_size=4, max_size=4),
    st.lists(unit, min_size=4, max_size=4),
    st.lists(unit, min_size=2, max_size=2),
)
def test_robust_control_solves_the_program_of_two_controls(metric, state, error, control):
    system, rate = TwoForces(), 0.8
    state, error = np.array(state), np.array(error)
    assume(np.linalg.norm(error) > 0.05)
    nominal, control = state - error, np.array(control)
    matrix = np.linalg.inv(metric.dual(state))
    h = 1e-6
    turned = [
        np.linalg.inv(metric.dual(state + side * h * system.rates(state, control)))
        for side in (1, -1)
    ]
    # The condition (18), term by term.
    drift = system.rates(state, control) - system.rates(nominal, control)
    slope = (turned[0] - turned[1]) / (2 * h)
    phi_0 = 2 * error @ matrix @ drift + error @ (slope + 2 * rate * matrix) @ error
    gain = np.stack(
        [system.rates(state, row) - system.rates(state, 0 * row) for row in np.eye(2)], -1
    )
    phi_1 = 2 * gain.T @ matrix @ error
    assume(np.linalg.norm(phi_1) > 1e-6 * np.linalg.norm(matrix))
    assume(abs(phi_0) > 1e-9)
    expected = control + (least_deviation(phi_0, phi_1) if phi_0 > 0.0 else 0.0)
    found = robust_control(system, metric, rate, state, nominal, control)
    assert found == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_robust_control_without_error_is_the_nominal_control(metric, system, samples):
    control = robust_control(
        system, metric, 0.5, samples.nominal, samples.nominal, samples.nominal_control
    )
    assert np.array_equal(control, samples.nominal_control)


def test_robust_control_of_a_batch_is_that_of_its_rows(metric, system, samples):
    state, nominal, control = samples.state, samples.nominal, samples.nominal_control
    batch = robust_control(system, metric, 0.5, state, nominal, control)
    cube = robust_control(
        system,
        metric,
        0.5,
        state.reshape(10, 20, 4),
        nominal.reshape(10, 20, 4),
        control.reshape(10, 20, 1),
    )
    rows = [
        robust_control(system, metric, 0.5, *row)
        for row in zip(state, nominal, control, strict=True)
    ]
    assert batch == pytest.approx(np.stack(rows), rel=1e-9, abs=1e-9)
    assert np.array_equal(cube.reshape(200, 1), batch)


def held_condition(oracle, metric, rate, state, nominal, nominal_control):
    """Return v -> V(next, linear in v) - exp(-2 rate dt) V(now)."""
    period = oracle.period
    following = oracle.step(state, nominal_control)
    error = following - oracle.step(nominal, nominal_control)
    slope = oracle.jacobian(lambda u: oracle.step(state.astype(complex), u), nominal_control)[:, 0]
    matrix = np.linalg.inv(metric.dual(following))
    limit = np.exp(-2.0 * rate * period) * oracle.energy(metric, state, nominal)

    def condition(deviation):
        predicted = error + slope * deviation
        return predicted @ matrix @ predicted - limit

    return condition


def held(system, metric, rate):
    """Return the law at any rate, as of a metric that was designed for that rate."""
    return HeldControl(system, replace(metric, contraction_rate=max(rate, 0.5)), rate, PERIOD)


@given(triples, st.sampled_from([0.2, 0.5, 2.0, 8.0]))
def test_held_control_is_the_least_that_meets_its_condition(metric, system, oracle, drawn, rate):
    state, nominal, nominal_control = as_triple(drawn)
    energy = oracle.energy(metric, state, nominal)
    assume(energy > 1e-6)
    law = held(system, metric, rate)
    deviation = float((law(state, nominal, nominal_control) - nominal_control)[0])
    condition = held_condition(oracle, metric, rate, state, nominal, nominal_control)
    lowest = scipy.optimize.minimize_scalar(condition, options={"xtol": 1e-12})
    assume(abs(condition(0.0)) > 1e-6 * energy)
    assume(abs(lowest.fun) > 1e-6 * energy)
    if condition(0.0) < 0.0:
        assert deviation == 0.0
    elif lowest.fun > 0.0:  # no v will do: the one of least energy
        assert deviation == pytest.approx(lowest.x, rel=1e-4, abs=1e-4)
    else:
        least = scipy.optimize.brentq(condition, 0.0, lowest.x, xtol=1e-11)
        assert deviation == pytest.approx(least, rel=1e-5, abs=1e-5)
        assert condition(deviation) <= 1e-7 * energy


@given(triples, st.floats(-60.0, 60.0))
def test_held_control_takes_the_contracting_control_nearest_to_the_preferred_one(
    metric, system, oracle, drawn, preferred
):
    state, nominal, nominal_control = as_triple(drawn)
    energy = oracle.energy(metric, state, nominal)
    assume(energy > 1e-4)
    condition = held_condition(oracle, metric, 0.5, state, nominal, nominal_control)
    lowest = scipy.optimize.minimize_scalar(condition, options={"xtol": 1e-12})
    assume(lowest.fun < -1e-4 * energy)
    control = held(system, metric, 0.5)(state, nominal, nominal_control, preferred)
    deviation = float((control - nominal_control)[0])
    assert condition(deviation) <= 1e-7 * energy
    if condition(preferred) < -1e-6 * energy:
        assert deviation == pytest.approx(preferred)
    elif condition(preferred) > 1e-6 * energy:
        # Between the bottom and the preferred control lies the edge that is nearest to it.
        edge = scipy.optimize.brentq(condition, lowest.x, preferred, xtol=1e-11)
        assert deviation == pytest.approx(edge, rel=1e-5, abs=1e-5)


def test_rates_that_the_metric_does_not_promise_are_refused(metric, system):
    for rate in (0.0, -0.5, 0.51, float("nan")):
        with pytest.raises(ValueError, match="rate"):
            HeldControl(system, metric, rate, PERIOD)


def test_every_branch_of_the_held_control_occurs(metric, system, oracle, samples):
    # The property above says little if the drawn states never reach a branch.
    found = set()
    for rate in (0.5, 8.0):
        for row in zip(samples.state, samples.nominal, samples.nominal_control, strict=True):
            condition = held_condition(oracle, metric, rate, *row)
            lowest = scipy.optimize.minimize_scalar(condition).fun
            found.add("rests" if condition(0.0) < 0.0 else "acts" if lowest < 0.0 else "fails")
    assert found == {"rests", "acts", "fails"}


def test_held_control_agrees_with_the_nonlinear_prediction_for_small_errors(
    metric, system, oracle, samples
):
    law = HeldControl(system, metric, 0.5, oracle.period)
    acted = 0
    for state, nominal, control in zip(
        samples.state[:60], samples.nominal[:60], samples.nominal_control[:60], strict=True
    ):
        state = nominal + 1e-3 * (state - nominal)
        limit = np.exp(-2.0 * 0.5 * oracle.period) * oracle.energy(metric, state, nominal)

        def condition(v, state=state, nominal=nominal, control=control, limit=limit):
            following = oracle.step(state, control + v), oracle.step(nominal, control)
            return oracle.energy(metric, *following) / limit - 1.0

        deviation = float((law(state, nominal, control) - control)[0])
        if condition(0.0) <= 0.0:
            assert abs(deviation) < 1e-2
            continue
        lowest = scipy.optimize.minimize_scalar(condition, bracket=(-1.0, 1.0))
        if lowest.fun < -1e-3:
            acted += 1
            least = scipy.optimize.brentq(condition, 0.0, lowest.x)
            assert deviation == pytest.approx(least, rel=2e-2, abs=1e-3)
    assert acted > 10


class ThreeForces(TwoForces):
    """The same body with a third force, which pushes along both axes."""

    control_dim = 3

    def derivative(self, state, control, functions):
        v, w, push, turn = super().derivative(state, control, functions)
        return v, w, push + 0.5 * control[2], turn - functions.cos(state[0]) * control[2]


@pytest.mark.parametrize("controls", [2, 3])
def test_held_control_of_several_controls_is_that_of_a_conic_program(metric, controls):
    system = TwoForces() if controls == 2 else ThreeForces()
    constant = replace(metric, coefficients=metric.dual(np.zeros(4))[None])
    law = HeldControl(system, constant, 0.5, PERIOD)
    rng = np.random.default_rng(controls)
    found = set()
    for size in (0.02, 0.3):
        for _ in range(10):
            nominal = rng.uniform(-0.5, 0.5, 4)
            state = nominal + size * rng.standard_normal(4)
            nominal_control, preferred = rng.uniform(-3.0, 3.0, (2, controls))
            u = law(state, nominal, nominal_control, preferred)
            following, _, slope = linearise_hold(system, state, nominal_control, PERIOD)
            error = following - hold_step(system, nominal, nominal_control, PERIOD)
            root = np.linalg.cholesky(constant.matrix(following)).T
            before = error_energy(constant.matrix(state), state - nominal)
            limit = np.sqrt(np.exp(-2.0 * 0.5 * PERIOD) * before)
            v = cp.Variable(controls)
            reached = cp.norm(root @ (error + slope @ v))
            program = cp.Problem(cp.Minimize(cp.sum_squares(v - preferred)), [reached <= limit])
            program.solve(cp.CLARABEL, tol_gap_abs=1e-9, tol_gap_rel=1e-9, tol_feas=1e-9)
            if program.status == cp.OPTIMAL:
                found.add("acts" if np.linalg.norm(v.value - preferred) > 1e-4 else "rests")
                assert u - nominal_control == pytest.approx(v.value, abs=1e-4, rel=1e-4)
            else:
                found.add("fails")
                least = np.linalg.lstsq(root @ slope, -root @ error, rcond=None)[0]
                moved = np.linalg.norm(root @ (error + slope @ (u - nominal_control)))
                lowest = np.linalg.norm(root @ (error + slope @ least))
                assert moved == pytest.approx(lowest, rel=1e-6)
    assert "acts" in found


def test_several_states_are_answered_as_each_alone(metric):
    constant = replace(metric, coefficients=metric.dual(np.zeros(4))[None])
    law = HeldControl(TwoForces(), constant, 0.5, PERIOD)
    rng = np.random.default_rng(0)
    nominal, control = rng.uniform(-0.5, 0.5, (6, 4)), rng.uniform(-1.0, 1.0, (6, 2))
    state = nominal + 0.1 * rng.standard_normal((6, 4))
    together = law(state, nominal, control)
    for row in range(6):
        alone = law(state[row], nominal[row], control[row])
        assert alone == pytest.approx(together[row], rel=1e-9, abs=1e-9)
    with pytest.raises(ValueError, match="ellipsoid"):
        law.interval(state, nominal, control)


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_the_nearest_point_of_an_ellipsoid_is_that_of_a_conic_program(size):
    rng = np.random.default_rng(size)
    for spread in (1.0, 1e3):
        root = np.diag(np.geomspace(1.0, spread, size)) @ rng.standard_normal((size, size))
        centre, point = rng.standard_normal((2, size))
        a = root.T @ root
        b, c = -a @ centre, centre @ a @ centre - 0.2
        found = nearest_in_ellipsoid(a, b, np.array(c), 3.0 * point)
        v = cp.Variable(size)
        inside = cp.norm(root @ (v - centre)) <= np.sqrt(0.2)
        cp.Problem(cp.Minimize(cp.sum_squares(v - 3.0 * point)), [inside]).solve(cp.CLARABEL)
        # The program stops within its tolerance; the closed form may only be nearer.
        assert found == pytest.approx(v.value, abs=2e-4)
        apart = np.linalg.norm(found - 3.0 * point), np.linalg.norm(v.value - 3.0 * point)
        assert apart[0] <= apart[1] + 1e-6
        assert found @ a @ found + 2.0 * b @ found + c <= 1e-9 * (1.0 + abs(c))


def test_directions_that_the_ellipsoid_does_not_see_are_left_alone():
    a = np.diag([4.0, 0.0])
    found = nearest_in_ellipsoid(a, np.array([-4.0, 0.0]), np.array(3.0), np.array([9.0, 7.0]))
    assert found == pytest.approx([1.5, 7.0])
    centre = nearest_in_ellipsoid(a, np.array([-4.0, 0.0]), np.array(9.0), np.array([9.0, 7.0]))
    assert centre == pytest.approx([1.0, 7.0])


def test_continuous_loop_contracts_at_the_rate_of_theorem_2(metric, system, oracle, plans):
    # 20 errors around a plan each, one second, the control renewed every millisecond.
    states, controls = plans
    rng = np.random.default_rng(8)
    chosen, start = rng.integers(len(states), size=20), 10
    nominal = states[chosen, start]
    state = nominal + rng.uniform(-1.0, 1.0, (20, 4)) * [0.5, 0.1, 0.5, 0.3]
    rate, h = metric.contraction_rate, 1e-3
    before = oracle.energy(metric, state, nominal)
    for step in range(start, start + 10):
        nominal_control = controls[chosen, step]
        for _ in range(100):
            control = robust_control(system, metric, rate, state, nominal, nominal_control)
            state = oracle.step(state, control, h, 1)
            nominal = oracle.step(nominal, nominal_control, h, 1)
        after = oracle.energy(metric, state, nominal)
        assert np.all(after <= before * np.exp(-2.0 * rate * 0.1) * 1.01)
        before = after


def test_held_loop_contracts_without_disturbance(metric, system, oracle, plans):
    states, controls = plans
    rng = np.random.default_rng(9)
    law = HeldControl(system, metric, metric.contraction_rate, oracle.period)
    state = states[:, 0] + rng.uniform(-1.0, 1.0, (len(states), 4)) * [0.3, 0.05, 0.3, 0.15]
    first = before = oracle.energy(metric, state, states[:, 0])
    for step in range(controls.shape[1]):
        control = law(state, states[:, step], controls[:, step])
        state = oracle.step(state, control)
        after = oracle.energy(metric, state, states[:, step + 1])
        # The law predicts linearly: it may miss the rate by a little, the decrease never.
        assert np.all(after < before)
        before = after
    assert np.all(before < first * np.exp(-2.0 * 0.95 * metric.contraction_rate * 9.0))


@pytest.mark.parametrize("kind", ["angle", "constant"])
def test_certified_bound_holds_under_the_worst_disturbance(
    request, system, oracle, plans, region, kind
):
    metric = request.getfixturevalue("metric" if kind == "angle" else "constant_metric")
    bound, rate = 0.06, metric.contraction_rate
    env = gym.make(
        "lagros/CartPole-v0",
        disturbance="worst",
        disturbance_bound=bound,
        metric=metric.matrix,
    )
    law = HeldControl(system, metric, rate, oracle.period)
    tube = certified_tube(metric, bound)
    largest = np.sqrt(extreme_eigenvalues(metric)[1])
    widest = 0.0
    for episode in range(4):
        states, controls = plans[0][episode], plans[1][episode]
        options = {"initial_state": states[0], "goal": states[-1], "nominal": states}
        env.reset(seed=episode, options=options)
        length = 0.0
        for step, nominal_control in enumerate(controls):
            state = env.unwrapped.state
            assert region.contains(state, states[step], nominal_control)
            control = law(state, states[step], nominal_control)
            *_, info = env.step(control / env.unwrapped.settings.force_scale)
            assert np.linalg.norm(info["disturbance"]) == pytest.approx(bound)
            share = info["tracking_error"] / tube.radius((step + 1) * oracle.period)
            assert share <= 1.0
            widest = max(widest, share)
            # On the way to it the proof bounds the length R of the error in the metric. Under a
            # hold: R contracts over the step, and grows by what d did to the state.
            calm = oracle.step(state, control)
            drift = np.linalg.norm(
                oracle.step(state, control, disturbance=info["disturbance"]) - calm
            )
            length = np.exp(-rate * oracle.period) * length + largest * drift
            energy = oracle.energy(metric, env.unwrapped.state, states[step + 1])
            assert np.sqrt(energy) <= 1.02 * length
    # The bound is not so wide that anything would keep it: without feedback the pole falls.
    env.reset(seed=0, options={"initial_state": plans[0][0, 0], "nominal": plans[0][0]})
    fallen, step = False, 0
    while not fallen:
        action = plans[1][0][step] / env.unwrapped.settings.force_scale
        _, _, fallen, _, info = env.step(action)
        step += 1
    assert widest > 0.01
    assert info["tracking_error"] > 3.0 * widest * tube.radius(step * oracle.period)
    env.close()


def test_metric_of_any_degree_has_the_interface_of_the_law(system, oracle, samples, region):
    # A metric from nowhere, to show that the law needs a Metric and not a design.
    rng = np.random.default_rng(3)
    root = rng.standard_normal((4, 4))
    metric = Metric(
        coefficients=np.stack([root @ root.T + np.eye(4), 0.1 * np.eye(4), 0.2 * np.eye(4)]),
        contraction_rate=CvStemSettings().contraction_rate,
        condition_bound=100.0,
        control_weight=1.0,
        scaling=np.ones(4),
        region=region,
    )
    assert metric.degree == 2
    law = HeldControl(system, metric, 0.3, oracle.period)
    assert np.all(np.isfinite(law(samples.state, samples.nominal, samples.nominal_control)))
