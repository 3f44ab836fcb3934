"""The constant metric against semidefinite programs, and its tubes against simulation."""

import cvxpy
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.dynamics import control_matrix, hold_step, jacobian
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_policies.contraction.double_integrator import (
    AxisMetric,
    certified_margin,
    design_axis,
    expected_margin,
    flow,
    position_tube,
    state_tube,
    stiffness_range,
)
from lagros_policies.tasks.spacecraft.wrench_control import HeldBall, WrenchTracking

RATES = [0.3, 0.6, 1.0, 1.5, 3.0]
rates = st.floats(0.05, 4.0)
shares = st.floats(0.02, 0.98)
DRIFT = np.array([[0.0, 1.0], [0.0, 0.0]])
PUSH = np.array([[0.0], [1.0]])
BODY = Spacecraft()
PERIOD = 0.1


def metric_at(rate, share, period=PERIOD):
    """Return a metric whose stiffness lies at a share of the admissible range."""
    low, high = stiffness_range(rate, period)
    high = min(high, 100.0 * low)
    return AxisMetric(rate, low * (high / low) ** share, period)


def tracking(rate, objective="state"):
    return WrenchTracking(BODY, design_axis(rate, PERIOD, objective), AxisMetric(0.3, 0.2, PERIOD))


def semidefinite_condition(rate):
    """Return the infimum of chi of CV-STEM for one axis, by cvxpy, with nu free."""
    dual, weight, chi = cvxpy.Variable((2, 2), PSD=True), cvxpy.Variable(), cvxpy.Variable()
    left = DRIFT @ dual + dual @ DRIFT.T - 2.0 * weight * PUSH @ PUSH.T + 2.0 * rate * dual
    bounds = [dual >> np.eye(2), dual << chi * np.eye(2), 0.5 * (left + left.T) << 0, weight <= 1e4]
    problem = cvxpy.Problem(cvxpy.Minimize(chi), bounds)
    problem.solve(solver="CLARABEL")
    assert problem.status in ("optimal", "optimal_inaccurate")
    return chi.value


def test_control_reaches_all_states_alike():
    states = np.random.default_rng(0).uniform(-4.0, 4.0, (50, 6))
    matrix = control_matrix(BODY, states)
    gram = matrix @ np.swapaxes(matrix, 1, 2)
    assert gram == pytest.approx(np.tile(np.diag([0, 0, 0, 4, 4, 2]), (50, 1, 1)), abs=1e-12)


@pytest.mark.parametrize("rate", RATES)
def test_least_condition_is_that_of_the_semidefinite_program(rate):
    closed = design_axis(rate, 0.0).state_condition
    assert closed == pytest.approx((rate + np.sqrt(1.0 + rate**2)) ** 2, rel=1e-9)
    # nu is bounded in the program, so that it stays a little above the infimum.
    assert closed <= semidefinite_condition(rate) * (1.0 + 1e-4)
    assert semidefinite_condition(rate) == pytest.approx(closed, rel=0.02)


@pytest.mark.parametrize("rate", [0.3, 0.9])
def test_least_condition_beats_that_of_unit_stiffness(rate):
    unit = AxisMetric(rate, 1.0, 0.0).state_condition
    assert unit == pytest.approx((1.0 + rate) / (1.0 - rate))
    assert design_axis(rate, 0.0).state_condition < unit


def test_certified_radius_per_disturbance_falls_to_two_as_the_rate_grows():
    radii = [state_tube(design_axis(rate, 0.0), 1.0).steady_radius for rate in (0.3, 1.0, 50.0)]
    assert radii[0] == pytest.approx(4.5, abs=0.05)
    assert radii[0] > radii[1] > radii[2] > 2.0
    assert radii[2] == pytest.approx(2.0, abs=0.01)


def weight_at_will(metric, gain, slack):
    """Return a nu for the rate (1 - slack) alpha; at alpha itself it is without bound."""
    alpha, q, s = metric.rate * (1.0 - slack), metric.coupling, metric.stiffness
    return (2.0 * alpha * s - (s + 2.0 * alpha * q) ** 2 / (2.0 * (q + alpha))) / (2.0 * gain)


@given(rate=rates, share=shares)
def test_condition_at_will_holds_with_a_finite_weight(rate, share):
    metric = metric_at(rate, share, period=0.0)
    slack = 0.01
    dual, alpha = metric.dual, rate * (1.0 - slack)
    weight = weight_at_will(metric, 4.0, slack)
    left = DRIFT @ dual + dual @ DRIFT.T + 2.0 * alpha * dual - 8.0 * weight * PUSH @ PUSH.T
    assert np.max(np.linalg.eigvalsh(left)) <= 1e-9 * (1.0 + np.max(np.abs(left)))


def test_six_state_condition_holds_at_random_states():
    rate, slack = 0.6, 0.01
    metric = design_axis(rate, 0.0)
    dual, weight = np.zeros((6, 6)), weight_at_will(metric, 2.0, slack)
    for axis in range(3):
        dual[np.ix_([axis, axis + 3], [axis, axis + 3])] = metric.dual
    for state in np.random.default_rng(1).uniform(-4.0, 4.0, (30, 6)):
        drift = jacobian(BODY, state, np.zeros(8))[0]
        matrix = control_matrix(BODY, state)
        left = drift @ dual + dual @ drift.T - 2.0 * weight * matrix @ matrix.T
        left += 2.0 * rate * (1.0 - slack) * dual
        assert np.max(np.linalg.eigvalsh(left)) <= 1e-8


@given(rate=rates, share=shares)
def test_condition_of_the_hold_is_tight(rate, share):
    metric = metric_at(rate, share)
    # The energy of the next error under the best control equals the allowed one at its worst.
    matrix, step = metric.matrix, flow(PERIOD)
    push = np.array([0.5 * PERIOD**2, PERIOD])
    best = matrix - np.outer(matrix @ push, matrix @ push) / (push @ matrix @ push)
    factor = np.linalg.cholesky(metric.dual)
    worst = np.linalg.eigvalsh(factor.T @ step.T @ best @ step @ factor)[-1]
    assert worst == pytest.approx(np.exp(-2.0 * rate * PERIOD), rel=1e-6)


@given(rate=rates)
def test_stiffness_range_is_where_the_dual_is_positive(rate):
    low, high = stiffness_range(rate, PERIOD)
    for stiffness in (1.001 * low, np.sqrt(low * high), 0.999 * high):
        assert np.linalg.eigvalsh(AxisMetric(rate, stiffness, PERIOD).dual)[0] > 0.0
    for stiffness in (0.999 * low, 1.001 * high):
        with pytest.raises(ValueError, match="stiffness"):
            AxisMetric(rate, stiffness, PERIOD)


@pytest.mark.parametrize("rate", RATES)
def test_designs_are_optimal(rate):
    low, high = stiffness_range(rate, PERIOD)
    others = [AxisMetric(rate, s, PERIOD) for s in np.geomspace(1.01 * low, 0.99 * high, 400)]
    state, position = (design_axis(rate, PERIOD, kind) for kind in ("state", "position"))
    assert state.state_condition <= min(m.state_condition for m in others) * (1 + 1e-9)
    assert position.position_condition <= min(m.position_condition for m in others) * (1 + 1e-9)
    limited = design_axis(rate, PERIOD, "position", stiffness_limit=12.0 * rate**2 + 1.0)
    assert limited.stiffness == pytest.approx(12.0 * rate**2 + 1.0, rel=1e-3)
    assert position.position_condition < limited.position_condition < state.position_condition


def test_short_hold_tends_to_control_at_will():
    short, will = design_axis(1.0, 1e-4), design_axis(1.0, 0.0)
    assert short.stiffness == pytest.approx(will.stiffness, rel=1e-3)
    assert short.coupling == pytest.approx(will.coupling, rel=1e-3)
    tube = position_tube(will, 0.5)
    assert certified_margin(short, 0.5) == pytest.approx(tube.steady_radius, rel=1e-2)


def test_position_tube_is_the_smaller_one():
    for rate in RATES:
        metric = design_axis(rate, 0.0)
        position, state = position_tube(metric, 0.4), state_tube(metric, 0.4)
        assert 0.4 / rate < position.steady_radius < state.steady_radius


@given(
    rate=rates,
    share=shares,
    error=st.tuples(*[st.floats(-2.0, 2.0)] * 4),
    preferred=st.tuples(*[st.floats(-2.0, 2.0)] * 2),
)
def test_ball_holds_exactly_the_contracting_deviations(rate, share, error, preferred):
    metric = metric_at(rate, share)
    error = np.array(error).reshape(2, 2)  # rows: position, velocity
    push = np.array([[0.5 * PERIOD**2], [PERIOD]])

    def excess(deviation):
        following = flow(PERIOD) @ error + push * deviation
        energy = np.sum(following * (metric.matrix @ following))
        allowed = np.exp(-2.0 * rate * PERIOD) * np.sum(error * (metric.matrix @ error))
        return (energy - allowed) / (allowed + 1e-9)

    law = HeldBall(metric)
    preferred = np.array(preferred)
    deviation = law(error[0], error[1], preferred)
    assert excess(deviation) <= 1e-6
    if excess(preferred) < -1e-9:
        assert deviation == pytest.approx(preferred)
    elif np.linalg.norm(error) > 1e-3:
        assert excess(deviation) == pytest.approx(0.0, abs=1e-6)
        # Half-way back to what was preferred the condition fails.
        if np.linalg.norm(deviation - preferred) > 1e-6:
            assert excess(deviation + 0.01 * (preferred - deviation)) > -1e-9


def test_deviation_is_the_least_one_by_an_optimiser():
    metric = design_axis(1.5)
    law = HeldBall(metric)
    rng = np.random.default_rng(3)
    push = np.array([[0.5 * PERIOD**2], [PERIOD]])
    for error in rng.standard_normal((10, 2, 2)):
        allowed = np.exp(-2.0 * 1.5 * PERIOD) * np.sum(error * (metric.matrix @ error))

        def room(deviation, error=error, allowed=allowed):
            following = flow(PERIOD) @ error + push * deviation
            return allowed - np.sum(following * (metric.matrix @ following))

        centre, _ = law.ball(error[0], error[1])
        answer = scipy.optimize.minimize(
            lambda v: v @ v, centre, constraints={"type": "ineq", "fun": room}, method="SLSQP"
        )
        assert np.linalg.norm(law(error[0], error[1])) == pytest.approx(
            np.sqrt(answer.fun), abs=1e-5
        )


def uniform_in_ball(rng, count, bound):
    draws = rng.standard_normal((count, 6))
    length = bound * rng.random((count, 1)) ** (1.0 / 6.0)
    return draws * length / np.linalg.norm(draws, axis=1, keepdims=True)


def fly(law, agents, steps, disturbance, start=None):
    """Track rest at the origin; return states (steps + 1, agents, 6) and the mean effort."""
    states = [np.zeros((agents, 6)) if start is None else start]
    effort = 0.0
    for step in range(steps):
        thrust = law.control(states[-1], np.zeros(6), np.zeros(3))
        assert np.all(thrust >= 0.0)
        effort += PERIOD * np.mean(np.sum(thrust**2, axis=1))
        states.append(hold_step(BODY, states[-1], thrust, PERIOD, disturbance(step), substeps=1))
    return np.array(states), effort


@pytest.mark.parametrize("rate", [0.3, 1.5])
def test_energy_shrinks_at_the_rate_without_disturbance(rate):
    law = tracking(rate)
    start = np.random.default_rng(4).uniform(-1.0, 1.0, (40, 6))
    states, _ = fly(law, 40, 60, lambda step: None, start)
    plane, turning = (
        np.einsum("...ai,ij,...aj->...", errors, metric.matrix, errors)
        for errors, metric in (
            (np.stack([states[..., :2], states[..., 3:5]], axis=-1), law.plane),
            (np.stack([states[..., 2:3], states[..., 5:]], axis=-1), law.turning),
        )
    )
    # The turning within a step, at up to 1 rad/s, is what is left over.
    assert np.all(plane[1:] <= np.exp(-2.0 * rate * PERIOD) * plane[:-1] * (1 + 1e-2) + 1e-12)
    assert np.all(turning[1:] <= np.exp(-2.0 * 0.3 * PERIOD) * turning[:-1] * (1 + 1e-9) + 1e-12)


@pytest.mark.parametrize("rate", [0.3, 0.6, 1.0, 1.5, 2.0, 3.0])
def test_expected_margin_is_what_simulation_shows(rate):
    rng = np.random.default_rng(5)
    states, _ = fly(tracking(rate), 400, 300, lambda step: uniform_in_ball(rng, 400, 1.0))
    worst = np.max(np.linalg.norm(states[..., :2], axis=-1), axis=0)
    assert np.quantile(worst, 0.95) == pytest.approx(expected_margin(1.0, rate), rel=0.07)
    assert np.max(worst) < certified_margin(design_axis(rate), 1.0)


def test_margin_for_a_disturbance_is_proportional():
    assert expected_margin(0.5, 1.0) == pytest.approx(0.5 * expected_margin(1.0, 1.0))


@pytest.mark.parametrize("objective", ["state", "position"])
@pytest.mark.parametrize("rate", [0.3, 1.5, 3.0])
def test_certified_margin_bounds_the_worst_disturbances_too(rate, objective):
    law = tracking(rate, objective)
    margin = certified_margin(law.plane, 0.4)
    pushes = np.zeros((9, 6))
    pushes[1], pushes[2] = [0.4, 0, 0, 0, 0, 0], [0, 0, 0, 0.4, 0, 0]
    angle = np.linspace(0.0, np.pi, 6)
    pushes[3:, 0], pushes[3:, 3] = 0.4 * np.cos(angle), 0.4 * np.sin(angle)
    states, _ = fly(law, 9, 300, lambda step: pushes)
    reached = np.max(np.linalg.norm(states[..., :2], axis=-1))
    # A constant push already uses a good share of the bound.
    assert 0.3 * margin < reached < margin


def test_tracking_takes_batches_of_any_shape():
    law = tracking(1.0)
    rng = np.random.default_rng(6)
    state, nominal = rng.standard_normal((2, 3, 4, 6))
    acceleration = rng.standard_normal((3, 4, 3))
    thrust = law.control(state, nominal, acceleration)
    assert thrust.shape == (3, 4, 8)
    for index in np.ndindex(3, 4):
        single = law.control(state[index], nominal[index], acceleration[index])
        assert thrust[index] == pytest.approx(single, abs=1e-12)


def test_a_body_that_spins_still_gets_the_acceleration_that_was_asked_for():
    law = tracking(1.0)
    state = np.tile([0.0, 0.0, 0.4, 0.1, 0.2, 0.0], (3, 1))
    state[:, 5] = [-1.0, 0.3, 1.0]
    wanted = np.array([0.5, -0.3, 0.8])
    # Nothing to correct: the whole acceleration is nominal.
    following = hold_step(BODY, state, law.control(state, state, wanted), PERIOD)
    gained = (following - state)[:, 3:] / PERIOD
    # A force that turns by 0.1 rad and is right in the middle loses (0.1)^2 / 24 of itself.
    assert gained == pytest.approx(np.tile(wanted, (3, 1)), abs=1e-3)


def test_on_the_plan_nothing_is_added():
    state = np.random.default_rng(7).standard_normal((5, 6))
    acceleration = np.random.default_rng(8).standard_normal((5, 3))
    assert np.array_equal(tracking(1.0).acceleration(state, state, acceleration), acceleration)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: AxisMetric(0.0, 1.0), "rate"),
        (lambda: AxisMetric(1.0, 3.0, -0.1), "period"),
        (lambda: AxisMetric(1.0, 0.5), "stiffness"),
        (lambda: design_axis(1.0, 0.0, "position"), "stiffness_limit"),
        (lambda: certified_margin(AxisMetric(1.0, 3.0, 0.0), 1.0), "period"),
        (lambda: HeldBall(AxisMetric(1.0, 3.0, 0.0)), "period"),
        (
            lambda: WrenchTracking(BODY, AxisMetric(1.0, 3.0, 0.1), AxisMetric(1.0, 3.0, 0.2)),
            "period",
        ),
    ],
)
def test_wrong_values_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan")])
def test_a_metric_needs_a_positive_rate(rate):
    with pytest.raises(ValueError, match="rate="):
        design_axis(rate, 0.1)
