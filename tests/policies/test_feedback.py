"""The preferred feedback against least squares and plain loops, and the expert that uses it."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from lagros_policies.contraction.feedback import riccati_gains
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tasks.cartpole.feedback import (
    FeedbackSettings,
    WeightSchedule,
    gain_table,
    preferred_deviation,
)

STEPS, N = 12, 3


def random_regulator(seed, controls):
    rng = np.random.default_rng(seed)
    by_state = np.eye(N) + 0.3 * rng.standard_normal((STEPS, N, N))
    by_control = rng.standard_normal((STEPS, N, controls))
    state = rng.uniform(0.1, 2.0, (STEPS + 1, N))
    control = rng.uniform(0.1, 2.0, (STEPS, controls))
    return by_state, by_control, state, control


def first_control(by_state, by_control, state, control, error):
    """Return v_0 of the least cost over all controls at once, by linear least squares."""
    steps, m = control.shape
    free, forced = error, np.zeros((N, steps * m))
    # The last stage weighs ten times its stage weight.
    rows = [np.sqrt(state[0])[:, None] * forced]
    target = [-np.sqrt(state[0]) * free]
    for k in range(steps):
        free, forced = by_state[k] @ free, by_state[k] @ forced
        forced[:, k * m : (k + 1) * m] += by_control[k]
        weight = np.sqrt(state[k + 1] * (10.0 if k == steps - 1 else 1.0))
        rows.append(weight[:, None] * forced)
        target.append(-weight * free)
    rows.append(np.diag(np.sqrt(control.ravel())))
    target.append(np.zeros(steps * m))
    return np.linalg.lstsq(np.vstack(rows), np.concatenate(target), rcond=None)[0][:m]


@pytest.mark.parametrize("controls", [1, 2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_riccati_gain_is_the_least_squares_control_at_every_step(seed, controls):
    by_state, by_control, state, control = random_regulator(seed, controls)
    gains = riccati_gains(by_state, by_control, state, control)
    error = np.random.default_rng(seed + 100).standard_normal(N)
    for k in range(STEPS):
        expected = first_control(by_state[k:], by_control[k:], state[k:], control[k:], error)
        assert -gains[k] @ error == pytest.approx(expected, rel=1e-8)


def test_riccati_gain_far_from_the_end_is_the_stationary_one():
    by_state, by_control, state, control = (part[:1] for part in random_regulator(7, 2))
    count = 400
    gains = riccati_gains(
        np.repeat(by_state, count, 0),
        np.repeat(by_control, count, 0),
        np.repeat(state, count + 1, 0),
        np.repeat(control, count, 0),
    )
    slope, push = by_state[0], by_control[0]
    value = scipy.linalg.solve_discrete_are(slope, push, np.diag(state[0]), np.diag(control[0]))
    stiffness = np.diag(control[0]) + push.T @ value @ push
    assert gains[0] == pytest.approx(np.linalg.solve(stiffness, push.T @ value @ slope))


def test_weights_follow_their_schedule():
    schedule = WeightSchedule(state=((1.0, -2.0), (0.5, 3.0)), control=(0.2, -1.0), decay_time=0.4)
    state, control = schedule.at(np.array([0.0, 0.4, 50.0]))
    fading = np.array([1.0, np.exp(-1.0), 0.0])
    assert np.log(state[:, 0]) == pytest.approx(1.0 + 0.5 * fading)
    assert np.log(state[:, 1]) == pytest.approx(-2.0 + 3.0 * fading)
    assert np.log(control) == pytest.approx(0.2 - fading)
    with pytest.raises(ValueError, match="weights"):
        WeightSchedule(state=((1.0,),), control=(0.2, 0.1))


@pytest.fixture(scope="module")
def table(oracle, plans):
    states, controls = plans
    nominal = states[:, :-1].astype(complex)
    by_state = oracle.jacobian(lambda x: oracle.step(x, controls), nominal)
    by_control = oracle.jacobian(lambda u: oracle.step(nominal, u), controls.astype(complex))
    times = 0.1 * np.arange(91)
    return (
        by_state,
        by_control[..., 0],
        gain_table(FeedbackSettings(), by_state, by_control[..., 0], times),
    )


def test_table_holds_both_gains_and_the_loop_closed_by_the_tight_one(table):
    by_state, by_control, gains = table
    settings = FeedbackSettings()
    for plan in (0, 5):
        for schedule, found in ((settings.tight, gains.tight), (settings.gentle, gains.gentle)):
            state, control = schedule.at(0.1 * np.arange(91))
            pushes, weights = by_control[plan][..., None], control[:-1, None]
            expected = riccati_gains(by_state[plan], pushes, state, weights)[:, 0]
            assert found[plan] == pytest.approx(expected, rel=1e-6, abs=1e-6)
        closed = by_state[plan] - by_control[plan][:, :, None] * gains.tight[plan][:, None, :]
        assert gains.closed[plan, :90] == pytest.approx(closed, rel=1e-9, abs=1e-9)


def test_preferred_deviation_is_the_blend_that_its_settings_describe(table):
    by_state, by_control, gains = table
    settings = FeedbackSettings()
    rng = np.random.default_rng(6)
    plan, step = rng.integers(12, size=50), rng.integers(80, size=50)
    step[:10] = np.arange(10)
    errors = rng.uniform(-1.0, 1.0, (50, 4)) * rng.choice([0.02, 0.3], (50, 1))
    found = preferred_deviation(settings, gains, plan, step, errors, 0.1 * step, 0.1)
    for p, k, error, value in zip(plan, step, errors, found, strict=True):
        tight, gentle = -gains.tight[p, k] @ error, -gains.gentle[p, k] @ error
        foreseen = []
        ahead = error
        for later in range(settings.lookahead + 1):
            radius = 3.15 * (1.0 - np.exp(-0.6 * 0.1 * max(k + later, 1)))
            foreseen.append(np.linalg.norm(ahead) / radius)
            loop = by_state[p, k + later] - np.outer(
                by_control[p, k + later], gains.tight[p, k + later]
            )
            ahead = loop @ ahead
        soft = np.log(np.sum(np.exp(settings.sharpness * np.array(foreseen)))) / settings.sharpness
        share = 1.0 / (1.0 + np.exp(-settings.gate_offset - settings.gate_slope * soft))
        share *= np.exp(-0.6 * 0.1 * k)
        assert value == pytest.approx((1.0 - share) * tight + share * gentle, rel=1e-6, abs=1e-9)
    assert np.any(np.abs(found) > 1.0)


def test_preferred_deviation_is_finite_at_the_end_of_the_plan_and_zero_without_error(table):
    gains = table[2]
    plan, step = np.arange(12), np.full(12, 89)
    none = preferred_deviation(
        FeedbackSettings(), gains, plan, step, np.zeros((12, 4)), 0.1 * step, 0.1
    )
    assert np.all(none == 0.0)
    some = preferred_deviation(
        FeedbackSettings(), gains, plan, step, np.full((12, 4), 0.1), 0.1 * step, 0.1
    )
    assert np.all(np.isfinite(some))


def test_whatever_the_expert_prefers_it_contracts(metric, oracle, plans, region):
    states, controls = plans
    rng = np.random.default_rng(4)
    count = 400
    plan, step = rng.integers(12, size=count), rng.integers(90, size=count)
    nominal = states[plan, step]
    state = nominal + rng.uniform(-1.0, 1.0, (count, 4)) * [0.3, 0.05, 0.3, 0.2]
    idle = WeightSchedule(state=((0.0,) * 4,), control=(20.0,))
    lazy = replace(FeedbackSettings(), tight=idle, gentle=idle)
    limit = np.exp(-2.0 * metric.contraction_rate * 0.1) * oracle.energy(metric, state, nominal)
    forces = []
    for feedback in (None, lazy):
        expert = CartPoleExpert(metric, feedback=feedback, law="tuned")
        force = expert.control(expert.track(states, controls), plan, step, state)
        forces.append(force)
        following = oracle.step(state, force)
        after = oracle.energy(metric, following, states[plan, step + 1])
        # The law predicts linearly in v.
        assert np.mean(after <= 1.05 * limit) > 0.97
    assert np.abs(forces[0] - forces[1]).max() > 0.5


def test_expert_takes_a_plan_that_begins_later(metric, plans):
    expert = CartPoleExpert(metric)
    states, controls = plans
    whole = expert.track(states, controls)
    rest = expert.track(states[:, 30:], controls[:, 30:], first_step=30)
    plan, step = np.arange(12), np.full(12, 55)
    state = states[plan, step] + 0.05
    assert expert.control(rest, plan, step, state) == pytest.approx(
        expert.control(whole, plan, step, state)
    )


def test_expert_of_one_row_is_that_of_the_batch(metric, plans):
    expert = CartPoleExpert(metric)
    tracked = expert.track(*plans)
    plan, step = np.arange(12), np.arange(12) * 7
    state = plans[0][plan, step] + 0.05
    batch = expert.control(tracked, plan, step, state)
    assert batch.shape == (12, 1)
    for row in range(12):
        one = slice(row, row + 1)
        single = expert.control(tracked, plan[one], step[one], state[one])
        assert single[0] == pytest.approx(batch[row], rel=1e-9, abs=1e-9)
