"""The spacecraft's proof: exact, for all states, and refused where it is not so."""

import math
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.dynamics import control_matrix
from lagros_envs.dynamics.spacecraft import Spacecraft
from lagros_policies.contraction.double_integrator import AxisMetric, design_axis
from lagros_policies.contraction.proof import spacecraft as module
from lagros_policies.contraction.proof.spacecraft import (
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


@dataclass(frozen=True)
class Lopsided(Spacecraft):
    """A body one of whose thrusters is weaker."""

    def wrench(self, control):
        first, second, torque = super().wrench(control)
        return first + (control[0] * Fraction(1, 2**40)), second, torque


def test_a_body_whose_reach_depends_on_the_heading_is_refused():
    assert control_square(Lopsided()) is None
    assert not any(part.holds for part in prove_spacecraft(design_axis(0.3), body=Lopsided()))


@dataclass(frozen=True)
class Oblong(Spacecraft):
    """A body that is pushed harder along one axis: at no heading but its own is B B' the same."""

    def wrench(self, control):
        first, second, torque = super().wrench(control)
        return 2 * first, second, torque


def test_a_reach_that_is_diagonal_at_one_heading_alone_is_refused():
    gain = control_matrix(Oblong(), np.zeros(6))
    np.testing.assert_allclose(gain @ gain.T, np.diag([0.0, 0.0, 0.0, 16.0, 4.0, 2.0]))
    assert control_square(Oblong()) is None


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
