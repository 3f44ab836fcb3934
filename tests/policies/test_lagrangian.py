"""The sliding-variable law against the equation of motion, random and worst disturbances."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lagros_envs.dynamics import hold_step
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_policies.remarks.lagrangian import (
    SlidingAxis,
    hierarchical_bound,
    peak_position_error,
    steady_position_bound,
)
from lagros_policies.tasks.spacecraft.sliding import SlidingTracking

BODY, PERIOD = Spacecraft(), 0.1
RATES = st.floats(0.2, 8.0)


def law(position_rate=2.0, sliding_rate=2.0):
    axis = SlidingAxis(position_rate, sliding_rate, PERIOD)
    return SlidingTracking(BODY, axis, axis)


def fly(tracking, start, pushes, nominal=None, accelerations=None):
    """Track with the package's physics; return states (steps + 1, agents, 6) and mean effort."""
    states, effort = [start], 0.0
    for step, push in enumerate(pushes):
        target = np.zeros(6) if nominal is None else nominal[step]
        wanted = np.zeros(3) if accelerations is None else accelerations[step]
        thrust = tracking.control(states[-1], target, wanted)
        assert np.all(thrust >= 0.0)
        effort += PERIOD * np.mean(np.sum(thrust**2, axis=-1))
        states.append(hold_step(BODY, states[-1], thrust, PERIOD, push, substeps=2))
    return np.array(states), effort


@given(RATES, RATES, st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
@settings(max_examples=50, deadline=None)
def test_the_sliding_variable_shrinks_exactly_under_the_hold(rate, sliding_rate, error, speed):
    axis = SlidingAxis(rate, sliding_rate, PERIOD)
    # No turning: the plane alone, along x, by the package's own integrator.
    state = np.array([error, 0.0, 0.0, speed, 0.0, 0.0])
    (_, after), _ = fly(law(rate, sliding_rate), state, [np.zeros(6)])
    before_s = speed + rate * error
    after_s = after[3] + rate * after[0]
    assert after_s == pytest.approx(np.exp(-sliding_rate * PERIOD) * before_s, abs=1e-9)
    wanted = axis.position_factor * error + axis.coupling * before_s
    assert after[0] == pytest.approx(wanted, abs=1e-9)


def test_without_hold_it_is_the_law_of_the_textbook():
    axis = SlidingAxis(1.7, 0.6, 1e-7)
    error, speed = np.array([0.3, -1.0]), np.array([0.2, 0.9])
    textbook = -1.7 * speed - 0.6 * (speed + 1.7 * error)
    assert axis.deviation(error, speed) == pytest.approx(textbook, abs=1e-5)


def test_any_smooth_trajectory_is_reached_from_any_start():
    rng = np.random.default_rng(0)
    accelerations = np.repeat(rng.uniform(-0.3, 0.3, (120, 1, 3)), 5, axis=1)
    accelerations[..., 2] = 0.0
    # A nominal that the held dynamics can follow exactly: on it the law adds nothing.
    nominal = [np.zeros((5, 6))]
    for wanted in accelerations:
        force = law().control(nominal[-1], nominal[-1], wanted)
        nominal.append(hold_step(BODY, nominal[-1], force, PERIOD, substeps=2))
    start = rng.uniform(-1.0, 1.0, (5, 6))
    reached, _ = fly(law(), start, np.zeros((120, 1, 6)), nominal, accelerations)
    assert np.abs(reached[0] - nominal[0]).max() > 0.5
    assert np.abs(reached[-1] - nominal[-1]).max() < 1e-4


@given(RATES, RATES, st.integers(0, 2**31))
@settings(max_examples=8, deadline=None)
def test_no_disturbance_crosses_the_bounds(rate, sliding_rate, seed):
    tracking, bound, steps = law(rate, sliding_rate), 0.4, 120
    axis = tracking.plane
    rng = np.random.default_rng(seed)
    # Held in one direction, switching at random, and random at every step; all of full length.
    pushes = rng.standard_normal((3, steps, 6, 6))
    pushes[..., [2, 5]] = 0.0
    pushes[0] = pushes[0, :1]
    pushes[1] = np.repeat(pushes[1, ::20], 20, axis=0)
    pushes *= bound / np.linalg.norm(pushes, axis=-1, keepdims=True)
    pushes = np.concatenate(list(pushes), axis=1)
    states, _ = fly(tracking, np.zeros((18, 6)), pushes)
    limits = hierarchical_bound(axis, bound, steps)
    position = np.linalg.norm(states[..., :2], axis=-1).max(axis=1)
    velocity = np.linalg.norm(states[..., 3:5], axis=-1).max(axis=1)
    assert np.all(position <= limits.position + 1e-9)
    assert np.all(velocity <= limits.velocity + 1e-9)
    assert np.all(np.hypot(position, velocity) <= limits.state + 1e-9)
    assert position.max() <= peak_position_error(axis, bound) + 1e-9
    assert limits.position[-1] <= steady_position_bound(axis, bound)


def test_the_peak_is_reached_by_the_disturbance_that_it_names():
    tracking, bound, steps = law(3.0, 1.6), 0.3, 120
    axis = tracking.plane
    # Brute force: the position at the end is linear in every push, so probe each of them alone.
    probes = np.zeros((steps, 2, steps, 6))
    for step in range(steps):
        probes[step, 0, step, 0] = probes[step, 1, step, 3] = 1.0
    states, _ = fly(tracking, np.zeros((2 * steps, 6)), probes.reshape(steps, 2 * steps, 6))
    effects = states[-1, :, 0].reshape(2, steps).T
    worst = np.zeros((steps, 6))
    lengths = np.maximum(np.linalg.norm(effects, axis=1), 1e-300)
    worst[:, 0], worst[:, 3] = bound * effects[:, 0] / lengths, bound * effects[:, 1] / lengths
    states, _ = fly(tracking, np.zeros(6), worst)
    peak = peak_position_error(axis, bound)
    assert states[-1, 0] == pytest.approx(peak, rel=1e-6)
    assert peak < hierarchical_bound(axis, bound, 600).position[-1]


def test_the_bound_for_ever_counts_what_happens_between_instants():
    axis, bound = SlidingAxis(8.0, 8.0, PERIOD), 0.3
    limits = hierarchical_bound(axis, bound, 400)
    by_sliding, by_error = axis.gains
    # A deviation v bends the path by h^2/8 v at the middle of a hold, d by half a hold and h^2/8.
    bend = PERIOD**2 / 8 * (by_sliding * limits.sliding[-1] + by_error * limits.position[-1])
    drift = (PERIOD / 2 + PERIOD**2 / 8) * bound
    assert steady_position_bound(axis, bound) == pytest.approx(limits.position[-1] + bend + drift)


@given(st.floats(1e-3, 19.0), st.floats(1e-3, 50.0))
def test_the_bound_for_ever_is_never_below_the_exact_one(rate, sliding_rate):
    """In 50 digits: the two integrals themselves are below it, by less than the trapezoid's excess.

    The limits of the recursion are geometric series; the integrals are by Gauss' rule.
    """
    import mpmath

    with mpmath.workdps(50):
        h, lam, k = (mpmath.mpf(value) for value in (PERIOD, rate, sliding_rate))

        def hold(ends):
            by_sliding = [mpmath.hypot(lam, 1 + lam * (h - t)) for t in ends]
            by_position = [mpmath.hypot(1, h - t) for t in ends]
            return h * sum(by_sliding) / len(ends), h * sum(by_position) / len(ends)

        def for_ever(sliding_push, position_push):
            shrinks, follows = mpmath.exp(-k * h), (2 - lam * h) / (2 + lam * h)
            sliding = sliding_push / (1 - shrinks)
            coupling = h * (1 + shrinks) / (2 + lam * h)
            position = (coupling * sliding + position_push) / (1 - follows)
            share = 1 + lam * h / 2
            deviation = (1 - shrinks + lam * h) / (h * share) * sliding + lam**2 / share * position
            return position + h**2 / 8 * deviation + h / 2 + h**2 / 8

        exact = for_ever(*hold((mpmath.mpf(0), h)))
        # Gauss' rule of two points is below the integral of a function whose fourth derivative is
        # positive, and near it; the trapezoid of a convex one is above it.
        inner = [h * (1 - one / mpmath.sqrt(3)) / 2 for one in (-1, 1)]
        assert for_ever(*hold(inner)) < exact
        found = mpmath.mpf(steady_position_bound(SlidingAxis(rate, sliding_rate, PERIOD), 1.0))
        assert exact < found < exact * (1 + mpmath.mpf(10) ** -7)
        # The bounds at the instants, step by step.
        limits = hierarchical_bound(SlidingAxis(rate, sliding_rate, PERIOD), 1.0, 20, 0.1, 0.2)
        by_sliding, by_position = hold((mpmath.mpf(0), h))
        sliding, position = mpmath.mpf(0.1), mpmath.mpf(0.2)
        for step in range(21):
            assert limits.sliding[step] >= sliding
            assert limits.position[step] >= position
            assert limits.velocity[step] >= sliding + lam * position
            coupling = h * (1 + mpmath.exp(-k * h)) / (2 + lam * h)
            position = (2 - lam * h) / (2 + lam * h) * position + coupling * sliding + by_position
            sliding = mpmath.exp(-k * h) * sliding + by_sliding


def test_the_bounds_at_the_instants_rise_to_those_for_ever():
    axis = SlidingAxis(0.7, 1.9, PERIOD)
    limits = hierarchical_bound(axis, 1.0, 2000)
    assert np.all(np.diff(limits.position) >= 0.0)
    by_sliding, by_error = axis.gains
    deviation = by_sliding * limits.sliding[-1] + by_error * limits.position[-1]
    whole = limits.position[-1] + PERIOD**2 / 8 * (deviation + 1.0) + PERIOD / 2
    assert steady_position_bound(axis, 1.0) == pytest.approx(whole, rel=1e-7)


def test_bound_from_an_initial_error_holds_without_disturbance():
    axis = SlidingAxis(2.0, 1.0, PERIOD)
    start = np.array([0.4, 0.0, 0.0, -0.2, 0.0, 0.0])
    states, _ = fly(law(2.0, 1.0), start, np.zeros((60, 6)))
    limits = hierarchical_bound(axis, 0.0, 60, abs(-0.2 + 2.0 * 0.4), 0.4)
    assert np.all(np.abs(states[:, 0]) <= limits.position + 1e-12)
    assert limits.position[-1] < 0.01


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: SlidingAxis(0.0, 1.0, 0.1), "position_rate"),
        (lambda: SlidingAxis(1.0, float("nan"), 0.1), "sliding_rate"),
        (lambda: SlidingAxis(20.0, 1.0, 0.1), "below 2"),
        (
            lambda: SlidingTracking(BODY, SlidingAxis(period=0.1), SlidingAxis(period=0.2)),
            "one period",
        ),
        (lambda: hierarchical_bound(SlidingAxis(), -1.0, 3), "disturbance_bound"),
    ],
)
def test_wrong_values_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()
