"""Affine enclosures of a tanh network over boxes, rounded outwards.

Two ways, of which `enclose` keeps the narrower one for each box:

- relaxations: over its range every tanh lies between two parallel lines; the gaps between them are
  carried to the outputs with their signs (the linear relaxations of Zhang et al., "Efficient neural
  network robustness certification with general activation functions", 2018, with one slope for
  both sides, so that what comes out is one affine map and an error);
- second order: value and slope at the middle of the box, and the range of what is left, from second
  derivatives over the box (`network_expansion`): it falls with the square of the box.

The network is the one of real numbers. By how much its evaluation in float32 may differ is bounded
beside it (Higham, "Accuracy and Stability of Numerical Algorithms", ch. 3) and added.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import FloatArray
from lagros_envs.numbers import Interval
from lagros_envs.numbers.interval import ordered
from lagros_policies.learning.networks import Mlp
from lagros_policies.proof.network_expansion import Expansion, expand
from lagros_policies.proof.rounded import above, product_error

Layers = Sequence[tuple[NDArray[np.floating], NDArray[np.floating]]]

# What is added for the rounding of the few operations behind the gap of one tanh, whose terms are
# at most one in size.
_GAP_ERROR = 1e-14


@dataclass(frozen=True)
class AffineEnclosure:
    """What a map y of a vector x does on boxes: |y - offset - gain (x - centre)| <= error.

    Attributes:
        centre: Middle of each box, shape (b, n).
        reach: Half its sides, shape (b, n); the enclosure holds there only.
        offset: c, shape (b, m).
        gain: K, shape (b, m, n).
        error: rho, shape (b, m), rounded upwards.
    """

    centre: FloatArray
    reach: FloatArray
    offset: FloatArray
    gain: FloatArray
    error: FloatArray

    def range(self) -> Interval:
        """Enclose the outputs over each box, shape (b, m)."""
        spread = np.einsum("bmn,bn->bm", np.abs(self.gain), self.reach)
        size = above(self.error + spread + product_error(self.centre.shape[-1]) * spread)
        return Interval(self.offset, self.offset) + ordered(-size, size)

    def scaled(self, signs: FloatArray) -> AffineEnclosure:
        """Return the enclosure of the outputs times signs of +-1, shape (b, m) or (m,)."""
        signs = np.broadcast_to(signs, self.offset.shape)
        return AffineEnclosure(
            self.centre, self.reach, signs * self.offset, signs[..., None] * self.gain, self.error
        )


def enclose(network: Mlp, inputs: Expansion, relaxed: bool = True) -> AffineEnclosure:
    """Enclose what a network answers in float32, over boxes of what its inputs depend on.

    Args:
        network: The network.
        inputs: Its inputs as functions of x over boxes (b, n); `box_inputs` where x are they.
        relaxed: Whether relaxations are tried, too; they cost five times as much and are narrower
            on wide boxes only.
    """
    expansion = expand(network, inputs)
    found = second_order(expansion)
    if relaxed:
        other = relaxation(list(zip(network.weights, network.biases, strict=True)), inputs)
        found = _narrower(found, other)
    error = above(found.error + expansion.rounding)
    return AffineEnclosure(found.centre, found.reach, found.offset, found.gain, error)


def second_order(expansion: Expansion) -> AffineEnclosure:
    """Return the enclosure that value, slope and second derivatives give, of real numbers."""
    remainder = expansion.remainder()
    gain = expansion.slope.midpoint
    # What the slope at the middle is not known to, over the box.
    loose = np.einsum("bnm,bn->bm", expansion.slope.radius, expansion.reach)
    total = expansion.value + remainder
    offset = total.midpoint
    error = above(total.radius + above(loose))
    return AffineEnclosure(
        expansion.centre, expansion.reach, offset, np.swapaxes(gain, -1, -2), error
    )


def relaxation(layers: Layers, inputs: Expansion) -> AffineEnclosure:
    """Return the enclosure by parallel lines around every tanh, of real numbers.

    Args:
        layers: Weights (inputs, outputs) and biases (outputs,), tanh between them.
        inputs: The inputs as functions of x over boxes.
    """
    first = second_order(inputs)
    count = inputs.reach.shape[-1]
    # y = centre + sum_g spread_g s_g +- loose, |s_g| <= 1: the first n are x, in units of the box.
    centre = first.offset
    spread = np.swapaxes(first.gain, -1, -2) * inputs.reach[..., None]
    loose = above(first.error + 2.0**-52 * np.abs(spread).sum(axis=-2))
    last = len(layers) - 1
    for index, (weight, bias) in enumerate(layers):
        matrix, offset = np.asarray(weight, float), np.asarray(bias, float)
        sizes = np.abs(matrix)
        rounding = product_error(len(matrix)) * (
            (np.abs(centre) + np.abs(spread).sum(axis=-2)) @ sizes + np.abs(offset)
        )
        loose = above(loose @ sizes + rounding)
        centre, spread = centre @ matrix + offset, spread @ matrix
        if index == last:
            break
        radius = above(np.abs(spread).sum(axis=-2) + loose)
        low, high = above(centre + radius), -above(radius - centre)
        slope, middle, gap = _lines(high, low)
        rounding = 2.0**-50 * (np.abs(slope * centre) + np.abs(middle) + radius)
        loose = above(slope * loose + rounding)
        centre, spread = slope * centre + middle, slope[..., None, :] * spread
        spread = np.concatenate([spread, gap[..., None, :] * np.eye(gap.shape[-1])], axis=-2)
    error = above(loose + np.abs(spread[..., count:, :]).sum(axis=-2))
    reach = inputs.reach[..., None]
    own = spread[..., :count, :]
    gain = np.divide(own, reach, out=np.zeros_like(own), where=reach > 0.0)
    error = above(error + 2.0**-51 * np.abs(own).sum(axis=-2))
    return AffineEnclosure(inputs.centre, inputs.reach, centre, np.swapaxes(gain, -1, -2), error)


def _lines(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return lines around tanh: |tanh(y) - slope y - middle| <= gap for low <= y <= high.

    The slope is that of the chord, any number from 0 to 1 as far as what follows is concerned:
    tanh(y) - slope y is largest and least at an end or where tanh' = slope, at +-y*.
    """
    first, second = np.tanh(low), np.tanh(high)
    wide = high > low + 1e-9
    chord = np.divide(second - first, high - low, out=1.0 - first * first, where=wide)
    slope = np.clip(chord, 0.0, 1.0)
    peak = np.sqrt(1.0 - slope)
    with np.errstate(divide="ignore"):
        place = np.where(slope > 0.0, np.arctanh(np.minimum(peak, 1.0 - 2.0**-53)), math.inf)
    height = np.where(np.isfinite(place), peak - slope * np.where(slope > 0.0, place, 0.0), 1.0)
    one, two = first - slope * low, second - slope * high
    largest, least = np.maximum(one, two), np.minimum(one, two)
    # A stationary point that is counted although it lies outside only widens.
    near = 1e-9 * (1.0 + np.where(np.isfinite(place), place, 0.0))
    largest = np.where((low <= place + near) & (place - near <= high), height, largest)
    least = np.where((low <= -place + near) & (-place - near <= high), -height, least)
    middle = 0.5 * largest + 0.5 * least
    size = 1.0 + slope * np.maximum(np.abs(low), np.abs(high))
    gap = above(np.maximum(largest - middle, middle - least) + _GAP_ERROR * size)
    return slope, middle, gap


def _narrower(one: AffineEnclosure, other: AffineEnclosure) -> AffineEnclosure:
    """Return for each box and output the enclosure with the smaller error."""
    first = one.error <= other.error
    return AffineEnclosure(
        one.centre,
        one.reach,
        np.where(first, one.offset, other.offset),
        np.where(first[..., None], one.gain, other.gain),
        np.where(first, one.error, other.error),
    )
