"""Fit the quotient of polynomials that stands for tanh in exported C files.

tanh(x) = x P(x²) / Q(x²) for |x| <= 9 with P and Q of degree 4, constant beyond. The linearised
problem tanh(x)/x Q - P = 0 is solved by least squares again and again, each time divided by the
last Q and weighted by the error that was left (Lawson's iteration), so that the largest relative
error falls. The coefficients are rounded to float32 and judged as the C code uses them, in float32
without fused multiplication, on every float32 from 2⁻²⁰ to 16; below, P/Q is 1 to float32.

    OMP_NUM_THREADS=1 python benchmarks/tuning/rational_tanh.py [--every N]

prints the coefficients, as in lagros_policies/export/c_layers.py, and their largest relative error.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from lagros_policies.export.c_layers import TANH_ERROR, TANH_LIMIT, TANH_P, TANH_Q

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

_DEGREE = 4
_NODES = 4000
_ROUNDS = 200
_CHUNK = 1 << 20


def fit() -> tuple[Float32Array, Float32Array]:
    """Return the coefficients of P and Q, shape (5,), the first of Q being 1."""
    nodes = 0.5 * TANH_LIMIT * (1.0 - np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES))
    wanted = np.tanh(nodes) / nodes
    square = (nodes / TANH_LIMIT) ** 2
    powers = np.vander(square, _DEGREE + 1, increasing=True)
    system = np.hstack([powers, -wanted[:, None] * powers[:, 1:]])
    weight, below = np.ones(_NODES), np.ones(_NODES)
    best, least = np.zeros(2 * _DEGREE + 1), np.inf
    for _ in range(_ROUNDS):
        scale = np.sqrt(weight) / (wanted * below)
        found = np.linalg.lstsq(system * scale[:, None], wanted * scale, rcond=None)[0]
        below = 1.0 + powers[:, 1:] @ found[_DEGREE + 1 :]
        error = np.abs(powers @ found[: _DEGREE + 1] / below / wanted - 1.0)
        if error.max() < least:
            best, least = found, error.max()
        weight *= np.sqrt(error / error.max() + 1e-3)
        weight /= weight.mean()
    units = TANH_LIMIT ** (-2.0 * np.arange(_DEGREE + 1))
    p, q = best[: _DEGREE + 1] * units, np.append(1.0, best[_DEGREE + 1 :]) * units
    return p.astype(np.float32), q.astype(np.float32)


def largest_error(p: Float32Array, q: Float32Array, every: int) -> float:
    """Return the largest relative error over every `every`-th float32 from 2⁻²⁰ to 16."""
    first, last = (int(np.float32(x).view(np.int32)) for x in (2.0**-20, 16.0))
    worst = 0.0
    for begin in range(first, last, _CHUNK * every):
        bits = np.arange(begin, min(begin + _CHUNK * every, last), every, dtype=np.int32)
        x = bits.view(np.float32)
        held = np.minimum(x, np.float32(TANH_LIMIT))
        square = held * held
        value = held * _horner(p, square) / _horner(q, square)
        wanted = np.tanh(x.astype(np.float64))
        worst = max(worst, float(np.max(np.abs(value / wanted - 1.0))))
    return worst


def _horner(coefficients: Float32Array, square: Float32Array) -> Float32Array:
    value = np.full_like(square, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * square + coefficient
    return value


def main() -> None:
    """Fit, judge and print."""
    parser = argparse.ArgumentParser(description="Fit the rational tanh of exported C files.")
    parser.add_argument("--every", type=int, default=1, help="judge on every N-th float32")
    every = parser.parse_args().every
    shipped = np.array(TANH_P, np.float32), np.array(TANH_Q, np.float32)
    for title, (p, q) in {"fitted": fit(), "shipped": shipped}.items():
        print(f"{title}: P {[str(x) for x in p]}")  # noqa: T201
        print(f"{title}: Q {[str(x) for x in q]}")  # noqa: T201
        error = largest_error(p, q, every)
        print(f"{title}: relative error at most {error:.2e} (stated {TANH_ERROR:.0e})")  # noqa: T201


if __name__ == "__main__":
    main()
