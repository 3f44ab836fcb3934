"""The spacecraft's ellipsoid: exact proof, the exact worst case, and brute force."""

from dataclasses import replace

import numpy as np
import pytest

from lagros_policies.tasks.spacecraft.ellipsoid_axis import (
    design_axis_ellipsoid,
    prove_axis_ellipsoid,
    worst_output,
)

PERIOD = 0.1


@pytest.fixture(scope="module", params=["state", "position"])
def tube(request):
    return design_axis_ellipsoid(PERIOD, request.param)


def fine_step(state, acceleration, push, duration):
    """Integrate position and velocity exactly for constant acceleration and disturbance."""
    p, v = state
    total = acceleration + push[1]
    return np.array([p + (v + push[0]) * duration + total * duration**2 / 2, v + total * duration])


def test_it_is_proved_and_a_smaller_one_is_not(tube):
    assert prove_axis_ellipsoid(tube)
    assert not prove_axis_ellipsoid(replace(tube, dual=0.99 * tube.dual))
    assert not prove_axis_ellipsoid(replace(tube, gain=0.5 * tube.gain))
    assert not prove_axis_ellipsoid(replace(tube, share=1.5))


@pytest.mark.parametrize("seed", range(4))
def test_disturbances_that_change_within_a_hold_stay_inside(tube, seed):
    rng = np.random.default_rng(seed)
    inverse, state = np.linalg.inv(tube.dual), np.zeros(2)
    parts = 8
    for step in range(100):
        acceleration = float(tube.gain @ state)
        ahead = inverse @ state if seed % 2 else rng.standard_normal(2)
        for part in range(parts):
            push = ahead + 0.3 * rng.standard_normal(2) if step or part else rng.standard_normal(2)
            push /= np.linalg.norm(push)
            state = fine_step(state, acceleration, push, PERIOD / parts)
            assert abs(state[0]) <= tube.position
        assert state @ inverse @ state <= 1.0 + 1e-9


def test_between_the_instants_the_position_may_go_further_and_stays_in_its_bound(tube):
    """A push that changes sign in a hold bulges the path, with the narrow one beyond its ends."""
    root = np.linalg.cholesky(tube.dual)
    largest = 0.0
    for angle in np.linspace(0.0, 2.0 * np.pi, 181):
        start = root @ np.array([np.cos(angle), np.sin(angle)])
        acceleration, state = float(tube.gain @ start), start
        for part in range(40):
            way = 1.0 if part < 20 else -1.0
            state = fine_step(state, acceleration, np.array([way, 0.0]), PERIOD / 40)
            largest = max(largest, abs(state[0]))
            assert abs(state[0]) <= tube.position
    assert largest > 0.999 * tube.position_at_instants
    if tube.position_at_instants < 0.2:
        assert largest > tube.position_at_instants


def test_a_matrix_that_is_not_symmetric_is_refused(tube):
    # Its symmetric part is that of one that is proved.
    skew = np.array([[0.0, 1e-3], [-1e-3, 0.0]])
    assert not prove_axis_ellipsoid(replace(tube, dual=tube.dual * 1.5 + skew))
    assert prove_axis_ellipsoid(tube)


def test_the_worst_output_is_reached_by_its_own_disturbance_and_bounded_by_the_tube(tube):
    position = np.array([1.0, 0.0])
    worst = worst_output(tube.gain, PERIOD, position)
    assert worst <= tube.position_at_instants * (1 + 1e-9)
    # The adversary of the linear loop: d along what moves the position at the end.
    holds, parts = 60, 20
    closed = np.array([[1.0, PERIOD], [0.0, 1.0]])
    closed = closed + np.outer([PERIOD**2 / 2, PERIOD], tube.gain)
    rows = [position]
    for _ in range(holds):
        rows.append(rows[-1] @ closed)
    state = np.zeros(2)
    for hold in range(holds):
        row, acceleration = rows[holds - 1 - hold], float(tube.gain @ state)
        for part in range(parts):
            left = PERIOD * (1.0 - (part + 0.5) / parts)
            push = row @ np.array([[1.0, left], [0.0, 1.0]])
            state = fine_step(state, acceleration, push / np.linalg.norm(push), PERIOD / parts)
    assert state[0] == pytest.approx(worst, rel=2e-3)


def test_no_other_pair_of_numbers_gives_a_smaller_ellipsoid(tube):
    """The two free numbers of the design, tau and c, on a grid around those that were found."""
    share, velocity = tube.share, tube.dual[1, 1]
    for tau in (0.8 * share, share, min(1.2 * share, 0.99)):
        for c in (0.8 * velocity, velocity, 1.2 * velocity):
            other = replace(tube, share=tau, dual=tube.dual * np.array([[0.98, 1.0], [1.0, 1.0]]))
            other = replace(other, dual=other.dual + np.diag([0.0, c - velocity]))
            assert not prove_axis_ellipsoid(other) or other.state > 0.98 * tube.state


def test_a_period_of_zero_is_refused():
    with pytest.raises(ValueError, match="period=0"):
        design_axis_ellipsoid(0.0)
