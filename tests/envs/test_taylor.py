"""Taylor models against dense sampling, mpmath and flint, and where nothing is known."""

import math

import numpy as np
import pytest

from lagros_envs.numbers import TaylorModel, functions, monomials

mpmath = pytest.importorskip("mpmath")

FUNCTIONS = {
    "sin": lambda f, a, b, c: f.sin(a) * b - c,
    "cos": lambda f, a, b, c: f.cos(a * b) + 2.0 * c * c,
    "tan": lambda f, a, b, c: f.tan(0.5 * a) - 1.0 / (3.0 + b) + c,
    "exp": lambda f, a, b, c: f.exp(a - b) * c,
    "sqrt": lambda f, a, b, c: f.sqrt(4.0 + a * b) / (2.0 - c),
    "powers": lambda f, a, b, c: a**3 - b**2 * c + abs(3.0 + a) - abs(-5.0 + b) / 7.0,
    "kink": lambda f, a, b, c: abs(a) + b * c,
    "fractions": lambda f, a, b, c: (1.0 - a) / (3.0 + f.cos(b) * c),
}


def numbers(kept, places, width):
    """Return numbers at places (3, k): one for each variable of that width, and all of them."""
    found = []
    for index, place in enumerate(places):
        parts = np.zeros((kept.count, len(place)))
        parts[0], parts[1 + index] = place, width
        found.append(TaylorModel(kept, parts, np.zeros(len(place))))
    return found


def value(model, point):
    """Evaluate the polynomial at a point (v,) of the domain."""
    return np.prod(point**model.monomials.exponents, axis=1) @ model.parts


@pytest.mark.parametrize("name", FUNCTIONS)
def test_everything_between_polynomial_and_rest_and_not_much_besides(name):
    rng = np.random.default_rng(4)
    kept, width = monomials(3, 0, 0), 0.2
    places = rng.uniform(-0.9, 0.9, (3, 6))
    model = FUNCTIONS[name](functions, *numbers(kept, places, width))
    worst = np.zeros(6)
    for _ in range(3000):
        point = rng.normal(size=3)
        point *= rng.choice([1.0, rng.random()]) / np.linalg.norm(point)
        true = FUNCTIONS[name](np, *(places + width * point[:, None]))
        worst = np.maximum(worst, np.abs(true - value(model, point)))
    assert np.all(worst <= model.rest)
    # A rest of fourth order: the cut-off terms are not many times what they come to.
    assert np.all(model.rest <= 60.0 * worst + 1e-12)


@pytest.mark.parametrize("name", sorted(set(FUNCTIONS) - {"kink", "powers"}))
def test_coefficients_are_the_derivatives_that_mpmath_finds(name):
    kept = monomials(3, 0, 0)
    place = np.array([0.3, -0.4, 0.7])
    model = FUNCTIONS[name](functions, *numbers(kept, place[:, None], 1e-3))

    def exact(*z):
        return FUNCTIONS[name](mpmath, *(mpmath.mpf(a) + b for a, b in zip(place, z, strict=True)))

    with mpmath.workdps(40):
        for exponent, part in zip(kept.exponents, model.parts[:, 0], strict=True):
            slope = mpmath.diff(exact, (0, 0, 0), tuple(int(k) for k in exponent))
            expected = float(slope) / math.prod(map(math.factorial, exponent))
            assert part * 1e3 ** exponent.sum() == pytest.approx(expected, rel=1e-6, abs=1e-9)


def random_formula(rng, numbers, depth=4):
    """Return a random expression of numbers of any kind, whose denominators stay off zero."""
    if depth == 0 or rng.random() < 0.1:
        return numbers[rng.integers(len(numbers))]
    one = random_formula(rng, numbers, depth - 1)
    name = str(rng.choice(["add", "sub", "mul", "div", "sin", "cos", "exp", "sqrt", "tan", "cube"]))
    if name in ("add", "sub", "mul", "div"):
        two = random_formula(rng, numbers, depth - 1)
        if name == "div":
            return one / (2.5 + functions.sin(two))
        return {"add": one + two, "sub": one - 0.5 * two, "mul": one * two}[name]
    small = functions.sin(one)
    return {
        "sin": lambda: small,
        "cos": lambda: functions.cos(one),
        "exp": lambda: functions.exp(small),
        "sqrt": lambda: functions.sqrt(1.5 + small),
        "tan": lambda: functions.tan(0.7 * small),
        "cube": lambda: one**3 - one / 3.0,
    }[name]()


@pytest.mark.parametrize("seed", range(40))
def test_random_formulas_are_enclosed_by_what_flint_proves_of_them(seed):
    flint = pytest.importorskip("flint")
    rng = np.random.default_rng(seed)
    kept, width = monomials(3, 0, 0), 0.125
    places = rng.integers(-64, 65, (3, 1)) / 64.0
    found = random_formula(np.random.default_rng(seed), numbers(kept, places, width))
    before, flint.ctx.prec = flint.ctx.prec, 200
    try:
        for _ in range(40):
            point = rng.normal(size=3)
            point *= 0.999 / np.linalg.norm(point)
            # Fractions of 2^20 are exact in both, and so are these products.
            point = np.round(point * 2**20) / 2**20
            exact = [
                flint.arb(float(a)) + flint.arb(width) * float(b)
                for a, b in zip(places[:, 0], point, strict=True)
            ]
            true = random_formula(np.random.default_rng(seed), exact)
            polynomial = flint.arb(0)
            for exponent, part in zip(kept.exponents.tolist(), found.parts[:, 0], strict=True):
                term = flint.arb(float(part))
                for power, one in zip(exponent, point, strict=True):
                    term = term * flint.arb(float(one)) ** power
                polynomial = polynomial + term
            assert abs(true - polynomial) <= flint.arb(float(found.rest[0]))
    finally:
        flint.ctx.prec = before


def test_rounding_is_in_the_rest():
    # Sums that cancel: what floats give differs from the true value, which fractions know.
    kept = monomials(1, 0, 0)
    parts = np.zeros((kept.count, 1))
    parts[0] = 0.1
    one = TaylorModel(kept, parts, np.zeros(1))
    found = (one * 3.0 - 0.3) * 1e16
    with mpmath.workdps(60):
        true = (mpmath.mpf(0.1) * 3 - mpmath.mpf(0.3)) * mpmath.mpf(1e16)
        assert abs(true - mpmath.mpf(found.constant[0])) <= found.rest[0]
        assert true != found.constant[0]


def test_pushes_and_lone_variables_are_kept_alone_and_times_one_variable():
    rng = np.random.default_rng(5)
    kept = monomials(2, 1, 2)
    parts = rng.normal(size=(2, kept.count, 1)) * 0.3
    one, two = (TaylorModel(kept, part, np.zeros(1)) for part in parts)
    product = one * two
    worst = 0.0
    for _ in range(3000):
        point = rng.normal(size=5)
        point[:2] /= np.linalg.norm(point[:2])
        point[2] = np.sign(point[2])
        point[3:] /= np.linalg.norm(point[3:])
        both = value(one, point) * value(two, point)
        worst = max(worst, abs(both - value(product, point))[0])
        assert worst <= product.rest[0]
    assert worst > 0.1 * product.rest[0]
    assert np.all(one.norms >= 0.0)


def test_kinds_are_cut_off_as_a_whole():
    kept = monomials(3, 2, 2)
    places = {tuple(row) for row in kept.exponents.tolist()}
    ends = [*kept.starts[1:], kept.count]
    for i, j in np.ndindex(len(kept.starts), len(kept.starts)):
        for one in kept.exponents[kept.starts[i] : ends[i]]:
            for two in kept.exponents[kept.starts[j] : ends[j]]:
                assert (tuple((one + two).tolist()) in places) == (kept.cuts[i, j] == 0.0)


@pytest.mark.parametrize(
    "function", [lambda a: 1.0 / a, functions.sqrt, functions.tan, lambda a: a / a]
)
def test_where_there_may_be_a_pole_nothing_is_known_and_its_neighbours_do_not_mind(function):
    kept = monomials(1, 0, 0)
    parts = np.zeros((kept.count, 2))
    parts[0], parts[1] = [0.0, 1.0], 0.1
    if function is functions.tan:
        parts[0, 0] = 0.5 * math.pi
    with np.errstate(all="ignore"):
        found = function(TaylorModel(kept, parts, np.zeros(2)))
    assert not np.isfinite(found.rest[0])
    assert found.rest[1] < 1e-2
