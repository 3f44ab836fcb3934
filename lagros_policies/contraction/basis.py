"""The functions of the state of which a metric is a sum, written over numbers of any kind.

W_bar = sum_i W_i phi_i(z): the phi_i are products of powers of coordinates, sines and cosines. Each
is named by its formula, which is also what the file of a metric holds: "1", "cos(x[1])^2",
"sin(x[2])*x[3]". On arrays they give W_bar at a batch of states, on duals its rate along a motion,
on intervals an enclosure over a box.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_several, check_whole, shown
from lagros_envs.dynamics.system import Components, components
from lagros_envs.numbers import Dual, functions

# sin, cos or nothing; the coordinate; the power.
Factor = tuple[str, int, int]

# Far beyond any design, and far below where binomials overflow.
MOST_DEGREE = 40
_MOST_TERMS = 1000
_CONSTANT = "1"
_FACTOR = re.compile(
    r"(?:(sin|cos)\(x\[(0|[1-9]\d{0,3})\]\)|x\[(0|[1-9]\d{0,3})\])(?:\^([1-9]\d?))?", re.ASCII
)


@dataclass(frozen=True)
class Basis:
    """Functions phi_i of a state, each a product such as "1", "x[3]" or "cos(x[1])^2*x[3]".

    Attributes:
        terms: The formulas, by which two bases are equal.

    Raises:
        ValueError: A formula is none of these, is there twice, or is of a degree above 40.
    """

    terms: tuple[str, ...]

    def __post_init__(self) -> None:
        """Read the formulas."""
        check_several("terms", self.terms, "one formula or more")
        if len(self.terms) > _MOST_TERMS:
            raise ValueError(f"terms: {len(self.terms)} must be at most {_MOST_TERMS}")
        object.__setattr__(self, "terms", tuple(self.terms))
        known: dict[frozenset[Factor], str] = {}
        for term, factors in zip(self.terms, self.factors, strict=True):
            same = known.get(frozenset(factors))
            if same is not None:
                raise ValueError(f"terms: {term!r} is {same!r} again; leave one of them out")
            known[frozenset(factors)] = term
        if self.degree > MOST_DEGREE:
            raise ValueError(f"terms: degree {self.degree} must be at most {MOST_DEGREE}")

    @cached_property
    def factors(self) -> tuple[tuple[Factor, ...], ...]:
        """What each formula multiplies."""
        return tuple(_factors(term) for term in self.terms)

    @property
    def size(self) -> int:
        """Number of functions."""
        return len(self.terms)

    @cached_property
    def degree(self) -> int:
        """Largest sum of the powers in one formula."""
        return max(sum(power for *_, power in factors) for factors in self.factors)

    @cached_property
    def coordinates(self) -> tuple[int, ...]:
        """Which coordinates of the state the functions depend on, in order."""
        return tuple(sorted({place for factors in self.factors for _, place, _ in factors}))

    @cached_property
    def cosine(self) -> int | None:
        """The coordinate i, where the functions are 1, cos(x[i]), ... cos(x[i])^k with k > 0."""
        if len(self.coordinates) != 1 or self != cosines(self.coordinates[0], self.size - 1):
            return None
        return self.coordinates[0]

    def values(self, state: Components) -> list[Any]:
        """Return every phi_i of a state, whose entries are numbers of any kind."""
        known: dict[tuple[str, int], Any] = {}
        for factors in self.factors:
            for name, place, _ in factors:
                if (name, place) not in known:
                    entry = state[place]
                    known[name, place] = getattr(functions, name)(entry) if name else entry
        return [
            math.prod(known[name, place] ** power for name, place, power in factors)
            for factors in self.factors
        ]

    def at(self, state: FloatArray) -> FloatArray:
        """Return the functions at states (..., n), shape (..., size)."""
        if self.cosine is not None:
            return cosine_powers(state[..., self.cosine], self.size - 1)
        return _stacked(self.values(components(state)), np.shape(state)[:-1])

    def rate(self, state: FloatArray, motion: FloatArray) -> FloatArray:
        """Return the derivative of the functions along a motion, shape (..., size).

        Args:
            state: x, shape (..., n).
            motion: dx/dt, shape (..., n).
        """
        if self.cosine is not None:
            angle, turn = state[..., self.cosine], motion[..., self.cosine]
            return cosine_rates(angle, turn, self.size - 1)
        shape = np.broadcast_shapes(np.shape(state), np.shape(motion))
        parts = zip(
            components(np.broadcast_to(state, shape)),
            components(np.broadcast_to(motion, shape)),
            strict=True,
        )
        moved = self.values([Dual(value, change) for value, change in parts])
        slopes = [one.gradient if isinstance(one, Dual) else 0.0 for one in moved]
        return _stacked(slopes, shape[:-1])


def cosine_powers(angle: FloatArray, degree: int) -> FloatArray:
    """Return cos(angle)^k for k = 0 ... degree, shape (..., degree + 1)."""
    powers: FloatArray = np.cos(angle)[..., None] ** np.arange(degree + 1)
    return powers


def cosine_rates(angle: FloatArray, angular_rate: FloatArray, degree: int) -> FloatArray:
    """Return the time derivatives of `cosine_powers`, shape (..., degree + 1)."""
    exponents = np.arange(degree + 1)
    lower = np.cos(angle)[..., None] ** np.maximum(exponents - 1, 0)
    rates: FloatArray = -exponents * lower * (np.sin(angle) * angular_rate)[..., None]
    return rates


@lru_cache(maxsize=64)
def cosines(coordinate: int, degree: int) -> Basis:
    """Return cos(x[i])^k for k = 0 ... degree: an even function of an angle."""
    return Basis(_powers(f"cos(x[{coordinate}])", degree))


def harmonics(coordinate: int, degree: int) -> Basis:
    """Return functions whose sums are all trigonometric polynomials of an angle.

    Args:
        coordinate: i of the angle x[i].
        degree: Largest multiple of the angle.
    """
    cosine = _powers(f"cos(x[{coordinate}])", degree)
    sine = f"sin(x[{coordinate}])"
    return Basis((*cosine, *(_product(sine, one) for one in cosine[:-1])))


def powers(coordinate: int, degree: int) -> Basis:
    """Return x[i]^k for k = 0 ... degree."""
    return Basis(_powers(f"x[{coordinate}]", degree))


def products(*bases: Basis) -> Basis:
    """Return all products of one function of each basis, of different coordinates."""
    terms = [_CONSTANT]
    for basis in bases:
        terms = [_product(one, other) for other in basis.terms for one in terms]
    return Basis(tuple(terms))


def _powers(name: str, degree: int) -> tuple[str, ...]:
    check_whole("degree", degree, 0, MOST_DEGREE)
    return (_CONSTANT, name, *(f"{name}^{power}" for power in range(2, degree + 1)))[: degree + 1]


def _product(one: str, other: str) -> str:
    return "*".join(part for part in (one, other) if part != _CONSTANT) or _CONSTANT


def _factors(term: str) -> tuple[Factor, ...]:
    if term == _CONSTANT:
        return ()
    factors: Counter[tuple[str, int]] = Counter()
    for part in term.split("*") if isinstance(term, str) else [""]:
        found = _FACTOR.fullmatch(part)
        if found is None:
            raise ValueError(
                f"terms: {shown(term)} must be '1' or a product of x[i], sin(x[i]) and cos(x[i]) "
                "with whole powers, such as 'cos(x[1])^2*x[3]'"
            )
        name, angle, place, power = found.groups()
        factors[name or "", int(angle or place)] += int(power or 1)
    return tuple((name, place, power) for (name, place), power in factors.items())


def _stacked(values: list[Any], shape: tuple[int, ...]) -> FloatArray:
    stacked = np.empty((*shape, len(values)))
    for index, value in enumerate(values):
        stacked[..., index] = value
    return stacked


# Of a metric that is the same everywhere.
CONSTANT = Basis((_CONSTANT,))
