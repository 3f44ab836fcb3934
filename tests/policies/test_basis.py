"""The functions of which a metric is a sum: on arrays, along motions, on intervals, by name."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.numbers import Interval
from lagros_policies.contraction import Basis, cosines, harmonics, powers, products
from lagros_policies.contraction.basis import CONSTANT

EVERY = [
    pytest.param(CONSTANT, id="constant"),
    pytest.param(cosines(1, 4), id="cosines"),
    pytest.param(harmonics(2, 3), id="harmonics"),
    pytest.param(products(harmonics(0, 2), powers(3, 2)), id="products"),
    pytest.param(Basis(("x[0]*x[2]^3", "sin(x[1])^2*cos(x[3])", "1")), id="written"),
]


def meant(term, state):
    """Return a term by Python's own reading of it."""
    names = {"x": np.moveaxis(state, -1, 0), "sin": np.sin, "cos": np.cos}
    return eval(term.replace("^", "**"), {"__builtins__": {}}, names)


@pytest.mark.parametrize("basis", EVERY)
def test_the_functions_are_what_their_names_say(basis):
    state = np.random.default_rng(0).uniform(-2.0, 2.0, (6, 5, 4))
    found = basis.at(state)
    assert found.shape == (6, 5, basis.size)
    for index, term in enumerate(basis.terms):
        assert found[..., index] == pytest.approx(meant(term, state) * np.ones((6, 5)), rel=1e-13)


@pytest.mark.parametrize("basis", EVERY)
def test_their_rate_is_the_derivative_along_any_motion(basis):
    rng = np.random.default_rng(1)
    state, motion = rng.uniform(-2.0, 2.0, (2, 40, 4))
    h = 1e-6
    moving = (basis.at(state + h * motion) - basis.at(state - h * motion)) / (2 * h)
    assert basis.rate(state, motion) == pytest.approx(moving, rel=1e-6, abs=1e-7)
    # One motion for all of them, and one state.
    assert basis.rate(state, motion[0])[3] == pytest.approx(basis.rate(state[3], motion[0]))


def test_the_fast_way_of_cosines_is_the_general_one():
    fast = cosines(1, 6)
    slow = Basis((*fast.terms, "x[0]"))  # no longer of cosines alone
    assert fast.cosine == 1
    assert slow.cosine is None
    rng = np.random.default_rng(2)
    state, motion = rng.uniform(-3.0, 3.0, (2, 500, 4))
    np.testing.assert_allclose(slow.at(state)[:, :-1], fast.at(state), rtol=1e-12)
    rates = fast.rate(state, motion)
    np.testing.assert_allclose(slow.rate(state, motion)[:, :-1], rates, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("degree", range(4))
def test_harmonics_span_every_trigonometric_polynomial(degree):
    angle = np.linspace(0.0, 2.0 * np.pi, 50)[:, None]
    basis = harmonics(0, degree)
    assert basis.size == 2 * degree + 1
    for multiple in range(degree + 2):
        for function in (np.sin, np.cos):
            wanted = function(multiple * angle[:, 0])
            _, left, *_ = np.linalg.lstsq(basis.at(angle), wanted, rcond=None)
            spanned = float(left.sum()) < 1e-20 or np.abs(wanted).max() < 1e-12
            assert spanned == (multiple <= degree or np.abs(wanted).max() < 1e-12)


@given(
    low=st.lists(st.floats(-3.0, 3.0), min_size=4, max_size=4),
    width=st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4),
    shares=st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4),
)
def test_intervals_enclose_the_functions_of_every_state_in_a_box(low, width, shares):
    basis = EVERY[-1].values[0]
    box = [Interval(a, a + w) for a, w in zip(low, width, strict=True)]
    inside = [min(a + s * w, a + w) for a, w, s in zip(low, width, shares, strict=True)]
    for bound, value in zip(basis.values(box), basis.values(inside), strict=True):
        ends = bound if isinstance(bound, Interval) else Interval(bound, bound)
        assert ends.contains(value)


def test_what_they_depend_on_and_their_degree():
    basis = products(harmonics(2, 1), powers(5, 2))
    assert basis.coordinates == (2, 5)
    assert basis.degree == 3
    assert basis.terms[:3] == ("1", "cos(x[2])", "sin(x[2])")
    assert basis.terms[-1] == "sin(x[2])*x[5]^2"
    assert CONSTANT.coordinates == ()
    assert Basis(("1", "x[0]")) == Basis(["1", "x[0]"])


@pytest.mark.parametrize(
    ("terms", "why"),
    [
        ((), "terms"),
        (("tan(x[0])",), "must be '1' or a product"),
        (("x[0] * x[1]",), "must be '1' or a product"),
        (("__import__('os')",), "must be '1' or a product"),
        (("x[-1]",), "must be '1' or a product"),
        (("x[0]^-1",), "must be '1' or a product"),
        (("x[0]^0.5",), "must be '1' or a product"),
        (("",), "must be '1' or a product"),
        ((7,), "must be '1' or a product"),
        (("x[٣]",), "must be '1' or a product"),
        (("x[0]*x[1]", "x[1]*x[0]"), "again"),
        (("x[0]^2", "x[0]*x[0]"), "again"),
        (("1", "1"), "again"),
        (("x[0]^40*x[1]",), "degree 41"),
        (tuple(f"x[{i}]" for i in range(1001)), "1001"),
    ],
)
def test_what_is_no_basis_is_refused_in_one_line(terms, why):
    with pytest.raises(ValueError, match=why) as caught:
        Basis(terms)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("make", [cosines, harmonics, powers])
def test_degrees_out_of_range_are_refused(make):
    for degree in (-1, 41, 1.5):
        with pytest.raises(ValueError, match="degree"):
            make(0, degree)
