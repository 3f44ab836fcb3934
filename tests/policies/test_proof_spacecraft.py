"""The spacecraft's proof: exact, for all states, and refused where it is not so."""

import math
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.dynamics import control_matrix
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_policies.contraction.double_integrator import AxisMetric, design_axis
from lagros_policies.tasks.spacecraft import proof as module
from lagros_policies.tasks.spacecraft.proof import (
    control_square,
    prove_axis,
    prove_spacecraft,
)


@pytest.mark.parametrize("period", [0.0, 0.1])
@pytest.mark.parametrize("rate", [0.3, 1.0, 3.0])
def test_the_metrics_of_least_chi_are_proved(rate, period):
    metric = design_axis(rate, period)
    proof = prove_axis(metric)
    assert proof.holds
    assert proof.rate == pytest.approx(rate, rel=1e-8)
    assert metric.state_condition <= proof.condition * (1.0 + 1e-12)
    assert proof.condition == pytest.approx(metric.state_condition, rel=1e-6)


@given(st.floats(1e-4, 0.5), st.floats(0.9, 1.1))
def test_the_condition_number_is_never_below_the_exact_one(rate, stiffness):
    """In fractions, chi + 1/chi + 2 = trace^2 / det; close to one, where digits cancel."""
    metric = AxisMetric(rate, stiffness, 0.0)
    found = Fraction(prove_axis(metric).condition)
    trace = 1 + Fraction(metric.stiffness)
    determinant = Fraction(metric.stiffness) - Fraction(metric.coupling) ** 2
    assert (found + 1) ** 2 * determinant >= trace**2 * found
    assert float(found) == pytest.approx(metric.state_condition, rel=1e-6)


@dataclass(frozen=True, slots=True)
class Slack(AxisMetric):
    """An axis' metric whose coupling is a little nearer to zero than the rate allows."""

    @property
    def coupling(self):
        return (1.0 - 1e-7) * super(Slack, self).coupling


@pytest.mark.parametrize("period", [0.0, 0.1])
def test_a_metric_that_misses_the_condition_by_a_hair_is_refused(period):
    good = design_axis(0.6, period)
    assert prove_axis(good).holds
    assert not prove_axis(Slack(0.6, good.stiffness, period)).holds


def test_a_matrix_that_is_not_definite_is_refused():
    @dataclass(frozen=True, slots=True)
    class Indefinite(AxisMetric):
        @property
        def coupling(self):
            return -2.0 * math.sqrt(self.stiffness)

        def __post_init__(self):
            pass

    proof = prove_axis(Indefinite(0.3, 1.0, 0.0))
    assert not proof.holds
    assert proof.condition == math.inf


def test_the_control_square_is_that_of_any_heading():
    square = control_square(Spacecraft())
    assert square == (4, 4, 2)
    states = np.zeros((50, 6))
    states[:, 2] = np.linspace(-4.0, 4.0, 50)
    gain = control_matrix(Spacecraft(), states)
    expected = np.diag([0.0, 0.0, 0.0, *map(float, square)])
    difference = gain @ np.swapaxes(gain, -1, -2) - expected
    assert np.abs(difference).max() < 1e-12


def test_other_masses_and_arms_are_exact_too():
    square = control_square(replace(Spacecraft(), mass=0.1, side_arm=0.5))
    assert square[0] == 4 / Fraction(0.1) ** 2
    assert square[2] == (4 + 4 * Fraction(1, 4)) / 4


@pytest.fixture
def pushed(monkeypatch):
    """Return what gives every spacecraft another wrench, made from its own."""
    whole = Spacecraft.wrench

    def change(other):
        monkeypatch.setattr(
            Spacecraft, "wrench", lambda body, control: other(control, *whole(body, control))
        )

    return change


def test_a_body_whose_reach_depends_on_the_heading_is_refused(pushed):
    # One of its thrusters is a little stronger.
    pushed(lambda control, first, second, torque: (first + control[0] / 2**40, second, torque))
    assert control_square(Spacecraft()) is None
    assert not any(part.holds for part in prove_spacecraft(design_axis(0.3)))


def test_a_reach_that_is_diagonal_at_one_heading_alone_is_refused(pushed):
    # Pushed harder along one axis: at no heading but its own is B B' the same.
    pushed(lambda control, first, second, torque: (2 * first, second, torque))
    gain = control_matrix(Spacecraft(), np.zeros(6))
    np.testing.assert_allclose(gain @ gain.T, np.diag([0.0, 0.0, 0.0, 16.0, 4.0, 2.0]))
    assert control_square(Spacecraft()) is None


def test_the_statements_say_for_all_states_and_are_proved():
    statements = prove_spacecraft(design_axis(0.3), design_axis(1.0))
    assert len(statements) == 3
    assert all(part.holds and part.kind == "proved" for part in statements)
    assert sum("for all states" in part.text for part in statements) == 2


@pytest.mark.parametrize("argument", [0.0, 0.01, 0.6, 1.0, 3.7])
def test_the_exponential_is_bounded_from_below_closely(argument):
    found = module._exponential_below(Fraction(argument))
    assert float(found) == pytest.approx(math.exp(-argument), rel=1e-15)
    # The series to twice the order, halved likewise, ends above.
    import mpmath

    with mpmath.workdps(60):
        value = mpmath.mpf(found.numerator) / found.denominator
        assert value <= mpmath.exp(-mpmath.mpf(argument))


def six_states(block, weight, gain, slope, alpha=2.0):
    """Return the left side of (14) of the six states, less -2 alpha W, for a block (2, 2) of W."""
    dual = np.kron(block, np.eye(3))
    a = np.zeros((6, 6))
    a[:3, 3:], a[3:, :3] = np.eye(3), slope
    b = np.diag([0.0] * 3 + [gain] * 3)
    return a @ dual + dual @ a.T - 2.0 * weight * b + 2.0 * alpha * dual


@given(st.integers(0, 2**31), st.floats(0.2, 5.0))
def test_a_weight_that_is_shown_contracts_for_any_slope_of_the_acceleration(seed, size):
    """By the eigenvalues of the whole matrix, where the proof is by blocks."""
    rng = np.random.default_rng(seed)
    block = size * design_axis(2.0).dual
    push = float(rng.uniform(0.0, 3.0))
    low, high = 0.0, 1e6
    while high - low > 1e-6 * high:
        middle = 0.5 * (low + high)
        if module.contracts_at_will(block, 2.0, middle, Fraction(2), push):
            high = middle
        else:
            low = middle
    slopes = rng.standard_normal((200, 3, 3))
    slopes *= push / np.linalg.norm(slopes, 2, axis=(-2, -1))[:, None, None]
    ends = [push * sign * np.eye(3) for sign in (-1.0, 1.0)]
    for slope in (*slopes, *ends):
        assert np.linalg.eigvalsh(six_states(block, high, 2.0, slope))[-1] < 1e-9


def test_the_weight_is_decided_to_the_last_bit():
    """W = [[1, -1], [-1, 3]], alpha = 1/2, g = 1, c = 0: 2 nu > 3 + 2^2 / 1, in closed form."""
    block = np.array([[1.0, -1.0], [-1.0, 3.0]])
    assert not module.contracts_at_will(block, 0.5, 3.5, Fraction(1), 0.0)
    assert module.contracts_at_will(block, 0.5, math.nextafter(3.5, 4.0), Fraction(1), 0.0)
    # W = [[1, -1], [-1, 3/2]], alpha = 3/4, C = -I: 2 nu > 9/4 + 2 + 1^2 / (1/2) is the matrix
    # itself, and no bound of it.
    block, slope = np.array([[1.0, -1.0], [-1.0, 1.5]]), -np.eye(3)
    assert not module.contracts_at_will(block, 0.75, 3.125, Fraction(1), 1.0)
    assert module.contracts_at_will(block, 0.75, math.nextafter(3.125, 4.0), Fraction(1), 1.0)
    assert np.linalg.eigvalsh(six_states(block, 3.12, 1.0, slope, 0.75))[-1] > 0.0
    assert np.linalg.eigvalsh(six_states(block, 3.13, 1.0, slope, 0.75))[-1] < 0.0
    # At q = -alpha there is no finite nu, and a negative W is none.
    block = np.array([[1.0, -1.0], [-1.0, 3.0]])
    assert not module.contracts_at_will(block, 1.0, 1e300, Fraction(1), 0.0)
    assert not module.contracts_at_will(-block, 0.5, 1e300, Fraction(1), 0.0)


def test_the_bounds_of_w_are_decided_to_the_last_bit():
    block = np.array([[3.0, 1.0], [1.0, 3.0]])
    hair = Fraction(1, 2**200)
    assert module.lies_between(block, Fraction(2), Fraction(4))
    assert not module.lies_between(block, 2 + hair, Fraction(4))
    assert not module.lies_between(block, Fraction(2), 4 - hair)
