"""Optimisers over unconstrained vectors, one question and one answer at a time.

They maximise. `ask` gives a population, which the caller evaluates in one batch together with the
populations of other searches; `tell` takes the scores back.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray

# Share of a population that the cross-entropy method learns from, and how slowly it learns.
_ELITE = 0.2
_SMOOTHING = 0.7
# It must not stand still before the budget is spent.
_LEAST_SPREAD = 0.02


class RandomSearch:
    """Independent normal points: what every other search, which derives from it, must beat.

    Args:
        dimension: Number of parameters, at least two.
        population: Points per question.
        rng: Random generator.
    """

    def __init__(self, dimension: int, population: int, rng: np.random.Generator) -> None:
        self._dimension, self._population, self._rng = dimension, population, rng

    def ask(self) -> FloatArray:
        """Return points to evaluate, shape (population, dimension)."""
        return self._rng.standard_normal((self._population, self._dimension))

    def tell(self, points: FloatArray, scores: FloatArray) -> None:
        """Take the scores (population,) of those points; larger is better."""


class CrossEntropySearch(RandomSearch):
    """The cross-entropy method: a normal law with a diagonal spread, fitted to the best fifth."""

    def __init__(self, dimension: int, population: int, rng: np.random.Generator) -> None:
        super().__init__(dimension, population, rng)
        self._mean, self._spread = np.zeros(dimension), np.ones(dimension)

    def ask(self) -> FloatArray:
        """Return points drawn from the present law."""
        return self._mean + self._spread * super().ask()

    def tell(self, points: FloatArray, scores: FloatArray) -> None:
        """Move mean and spread towards those of the best points."""
        count = max(2, round(_ELITE * len(points)))
        elite = points[np.argsort(-scores)[:count]]
        spread = np.maximum(elite.std(axis=0), _LEAST_SPREAD)
        self._mean += _SMOOTHING * (elite.mean(axis=0) - self._mean)
        self._spread += _SMOOTHING * (spread - self._spread)


class CmaSearch(RandomSearch):
    """CMA-ES by the package `cmaes`, begun anew when it has converged.

    Raises:
        ImportError: The package `cmaes` is not installed.
    """

    def __init__(self, dimension: int, population: int, rng: np.random.Generator) -> None:
        super().__init__(dimension, population, rng)
        self._strategy = self._begin(np.zeros(dimension))

    def ask(self) -> FloatArray:
        """Return points drawn from the present law."""
        if self._strategy.should_stop():
            self._strategy = self._begin(self._rng.standard_normal(self._dimension))
        return np.stack([self._strategy.ask() for _ in range(self._population)])

    def tell(self, points: FloatArray, scores: FloatArray) -> None:
        """Adapt the law."""
        # The package minimises.
        self._strategy.tell([(x, -float(y)) for x, y in zip(points, scores, strict=True)])

    def _begin(self, mean: FloatArray) -> Any:
        from cmaes import CMA

        seed = int(self._rng.integers(2**31))
        return CMA(mean=mean, sigma=1.0, population_size=self._population, seed=seed)


_KINDS: dict[str, type[RandomSearch]] = {
    "cma": CmaSearch,
    "cross-entropy": CrossEntropySearch,
    "random": RandomSearch,
}
OPTIMISERS = tuple(_KINDS)


def make_search(
    name: str, dimension: int, population: int, rng: np.random.Generator
) -> RandomSearch:
    """Return an optimiser by its name, one of `OPTIMISERS`.

    Raises:
        ValueError: The name is unknown, or a number is below two.
        ImportError: "cma" without the package `cmaes`.
    """
    if min(dimension, population) < 2:
        raise ValueError(f"dimension={dimension} and population={population} must be at least 2")
    if name not in _KINDS:
        raise ValueError(f"optimiser {name!r} must be one of {', '.join(OPTIMISERS)}")
    return _KINDS[name](dimension, population, rng)
