"""The published tube."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.tube import PaperTube


def test_the_default_is_that_of_the_paper():
    tube = PaperTube()
    # 3.15 (1 - exp(-0.6 t)), computed by hand to six digits.
    for time, radius in ((0.0, 0.0), (1.0, 1.421243), (9.0, 3.135773)):
        assert tube.radius(time) == pytest.approx(radius, abs=1e-6)


@given(st.floats(1e-3, 10.0), st.floats(1e-3, 10.0), st.floats(0.0, 50.0))
def test_the_radius_solves_its_differential_equation(steady, rate, time):
    """dr/dt = alpha (R - r), r(0) = 0: a bounded disturbance against contraction."""
    tube = PaperTube(steady, rate)
    assert tube.radius(0.0) == 0.0
    width = 1e-4 / rate
    slope = (tube.radius(time + width) - tube.radius(time)) / width
    between = rate * (steady - 0.5 * (tube.radius(time) + tube.radius(time + width)))
    assert slope == pytest.approx(between, rel=1e-6, abs=1e-9 * steady * rate)
    assert 0.0 <= tube.radius(time) <= steady


def test_floats_integers_and_arrays_agree():
    tube, times = PaperTube(2.0, 0.3), np.linspace(0.0, 9.0, 7).reshape(7, 1)
    radii = tube.radius(times)
    assert radii.shape == times.shape
    np.testing.assert_allclose(
        radii[:, 0], [tube.radius(t) for t in times[:, 0].tolist()], rtol=1e-15
    )
    assert isinstance(tube.radius(1.5), float)
    assert tube.radius(3) == tube.radius(3.0)
    assert np.all(np.diff(radii[:, 0]) > 0.0)


def test_a_small_time_keeps_its_digits():
    # 1 - exp(-x) would lose them: r is R alpha t to first order.
    assert PaperTube().radius(1e-12) == pytest.approx(3.15 * 0.6 * 1e-12, rel=1e-9, abs=0.0)


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_values_that_are_not_positive_are_refused(value):
    with pytest.raises(ValueError, match="steady_radius="):
        PaperTube(steady_radius=value)
    with pytest.raises(ValueError, match="contraction_rate="):
        PaperTube(contraction_rate=value)
