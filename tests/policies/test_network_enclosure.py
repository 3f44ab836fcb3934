"""Enclosures of tanh networks: dense sampling, exact arithmetic and torch's derivatives."""

from __future__ import annotations

import itertools
from fractions import Fraction
from functools import partial

import numpy as np
import pytest

from lagros_envs.numbers import Interval
from lagros_policies.learning.networks import Mlp
from lagros_policies.proof.network_enclosure import enclose, relaxation, second_order
from lagros_policies.proof.network_expansion import (
    box_inputs,
    evaluated,
    expand,
    pairs,
    tanh_derivatives,
)
from lagros_policies.proof.rounded import linear

WIDTHS = (3, 20, 20, 2)


def random_network(seed, widths=WIDTHS, gain=1.5):
    rng = np.random.default_rng(seed)
    weights = [
        gain * rng.standard_normal(pair) / np.sqrt(pair[0]) for pair in itertools.pairwise(widths)
    ]
    return Mlp(weights, [0.3 * rng.standard_normal(width) for width in widths[1:]])


def layers_of(network):
    return list(zip(network.weights, network.biases, strict=True))


def in_double(network, x):
    for index, (weight, bias) in enumerate(layers_of(network)):
        x = x @ weight.astype(float) + bias.astype(float)
        x = np.tanh(x) if index < len(network.weights) - 1 else x
    return x


def boxes(seed, size, count=6):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((count, 3)), size * rng.uniform(0.2, 1.0, (count, 3))


def places(seed, reach, count=4000):
    rng = np.random.default_rng(seed)
    share = rng.uniform(-1.0, 1.0, (len(reach), count, reach.shape[-1]))
    share[:, ::2] = np.sign(share[:, ::2])
    return share * reach[:, None]


def distance(found, network, moved):
    """Return |y - offset - K e| at points of each box, (b, points, m)."""
    values = in_double(network, found.centre[:, None] + moved)
    line = found.offset[:, None] + np.einsum("bmn,bsn->bsm", found.gain, moved)
    return np.abs(values - line)


@pytest.mark.parametrize("size", [1e-3, 0.03, 0.2, 1.0, 8.0])
@pytest.mark.parametrize("seed", range(3))
def test_nothing_sampled_leaves_either_enclosure(size, seed):
    network = random_network(seed)
    centre, reach = boxes(seed, size)
    inputs = box_inputs(centre, reach)
    moved = places(seed, reach)
    for found in (second_order(expand(network, inputs)), relaxation(layers_of(network), inputs)):
        assert np.all(distance(found, network, moved).max(axis=1) <= found.error)
        inside = found.range().contains(in_double(network, centre))
        assert np.all(inside)


@pytest.mark.parametrize("seed", range(3))
def test_the_gap_of_second_order_is_the_curvature_of_small_boxes(seed):
    network = random_network(seed)
    centre, reach = boxes(seed, 0.01)
    found = second_order(expand(network, box_inputs(centre, reach)))
    seen = distance(found, network, places(seed, reach)).max(axis=1)
    # What correlates between the coordinates of a box is lost, no more.
    assert np.median(found.error / seen) < 2.5
    tenth = second_order(expand(network, box_inputs(centre, 0.1 * reach)))
    assert np.all(tenth.error <= 0.01 * found.error + 1e-12)


def test_relaxations_win_on_wide_boxes_and_enclose_keeps_the_narrower():
    network = random_network(0)
    wide, narrow = (box_inputs(*boxes(1, size)) for size in (1.0, 0.01))
    for inputs, wins in ((wide, relaxation), (narrow, None)):
        ends = second_order(expand(network, inputs)), relaxation(layers_of(network), inputs)
        both = enclose(network, inputs)
        least = np.minimum(ends[0].error, ends[1].error)
        assert np.all(both.error >= least)
        np.testing.assert_allclose(both.error, least, atol=2e-4)
        assert np.all(ends[1].error < ends[0].error) == (wins is relaxation)


@pytest.fixture
def precise():
    """Return flint with numbers of 200 bits."""
    flint = pytest.importorskip("flint")
    before, flint.ctx.prec = flint.ctx.prec, 200
    yield flint
    flint.ctx.prec = before


def in_flint(flint, network, point):
    values = list(point)
    for index, (weight, bias) in enumerate(layers_of(network)):
        values = [
            sum(
                (one * float(w) for one, w in zip(values, column, strict=True)), flint.arb(float(b))
            )
            for column, b in zip(weight.T, bias, strict=True)
        ]
        if index < len(network.weights) - 1:
            values = [one.tanh() for one in values]
    return values


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.1])
def test_what_flint_proves_of_points_is_inside(size, precise):
    network = random_network(4)
    centre, reach = boxes(4, size)
    inputs = box_inputs(centre, reach)
    moved = places(4, reach, 5)
    for found in (second_order(expand(network, inputs)), relaxation(layers_of(network), inputs)):
        if size < 1e-3:
            # Of what rounding leaves nothing is lost.
            assert np.all(found.error < 1e-11)
        for row in range(len(centre)):
            for e in moved[row]:
                # The point is where these numbers lead, not where their rounded sum does.
                point = [
                    precise.arb(float(c)) + float(d) for c, d in zip(centre[row], e, strict=True)
                ]
                values = in_flint(precise, network, point)
                for out, value in enumerate(values):
                    line = precise.arb(float(found.offset[row, out]))
                    for k, d in zip(found.gain[row, out], e, strict=True):
                        line += precise.arb(float(k)) * float(d)
                    assert abs(value - line) < precise.arb(float(found.error[row, out]))


@pytest.mark.parametrize("size", [0.02, 0.3])
def test_derivatives_are_those_of_torch(size):
    torch = pytest.importorskip("torch")
    hessian, jacobian = torch.autograd.functional.hessian, torch.autograd.functional.jacobian
    network = random_network(5)
    centre, reach = boxes(5, size, count=2)
    found = expand(network, box_inputs(centre, reach))
    tensors = [(torch.tensor(w).double(), torch.tensor(b).double()) for w, b in layers_of(network)]

    def of_torch(x, row=slice(None)):
        for index, (weight, bias) in enumerate(tensors):
            x = x @ weight + bias
            x = torch.tanh(x) if index < len(tensors) - 1 else x
        return x[row]

    first, second, _ = pairs(3)
    slack = 1e-12
    for box in range(2):
        middle = torch.tensor(centre[box])
        slope = jacobian(of_torch, middle).numpy().T
        assert np.all(np.abs(slope - found.slope.midpoint[box]) <= found.slope.radius[box] + slack)
        for moved in places(6, reach, 40)[box]:
            at = middle + torch.tensor(moved)
            slope = jacobian(of_torch, at).numpy().T
            curve = np.stack(
                [hessian(partial(of_torch, row=row), at)[first, second] for row in range(2)], -1
            )
            for part, seen in ((found.slopes, slope), (found.curves, curve)):
                assert np.all(part.lower[box] - slack <= seen)
                assert np.all(seen <= part.upper[box] + slack)


@pytest.mark.parametrize("size", [1e-3, 0.3])
def test_single_precision_stays_within_what_is_added_for_it(size):
    network = random_network(7, (3, 60, 60, 2))
    centre, reach = boxes(7, size)
    found = expand(network, box_inputs(centre, reach))
    points = centre[:, None] + places(7, reach)
    flown = network(points.reshape(-1, 3).astype(np.float32)).reshape(*points.shape[:2], 2)
    error = np.abs(flown - in_double(network, points)).max(axis=1)
    assert np.all(error <= found.rounding)
    assert np.all(found.rounding < 5e-3)


@pytest.mark.parametrize("size", [0.02, 0.5])
def test_boxes_may_lie_along_any_axes(size):
    network = random_network(12)
    centre, reach = boxes(12, size)
    axes = np.random.default_rng(12).standard_normal((len(centre), 3, 3))
    moved = places(12, reach)
    values = in_double(network, centre[:, None] + np.einsum("bij,bsj->bsi", axes, moved))
    inputs = box_inputs(centre, reach, axes)
    for found in (second_order(expand(network, inputs)), relaxation(layers_of(network), inputs)):
        line = found.offset[:, None] + np.einsum("bmn,bsn->bsm", found.gain, moved)
        assert np.all(np.abs(values - line) <= found.error[:, None])


def test_numbers_at_points_are_those_of_a_box_of_no_size():
    network = random_network(13)
    points = np.random.default_rng(13).standard_normal((20, 3)).astype(np.float32)
    values, rounding = evaluated(network, points.astype(np.float64))
    exact = in_double(network, points.astype(np.float64))
    assert np.all(np.abs(values.midpoint - exact) <= values.radius + 1e-14)
    assert np.all(values.radius < 1e-11)
    assert np.all(np.abs(network(points) - exact) <= rounding)
    whole = expand(network, box_inputs(points.astype(np.float64), np.zeros(points.shape)))
    # There the inputs are rounded, too.
    assert np.all(rounding <= whole.rounding)
    assert np.all(rounding > 0.1 * whole.rounding)


def test_a_network_with_one_weight_changed_leaves_the_enclosure():
    network = random_network(8)
    centre, reach = boxes(8, 0.05)
    found = enclose(network, box_inputs(centre, reach))
    moved = places(8, reach)
    rng = np.random.default_rng(8)
    for _ in range(10):
        other = random_network(8)
        layer = rng.integers(len(other.weights))
        place = tuple(rng.integers(size) for size in other.weights[layer].shape)
        other.weights[layer][place] += 0.5
        assert np.any(distance(found, other, moved) > found.error[:, None])


def test_signs_turn_an_enclosure_around():
    network = random_network(9)
    centre, reach = boxes(9, 0.3)
    found = enclose(network, box_inputs(centre, reach)).scaled(np.array([-1.0, 1.0]))
    moved = places(9, reach)
    values = in_double(network, centre[:, None] + moved) * [-1.0, 1.0]
    line = found.offset[:, None] + np.einsum("bmn,bsn->bsm", found.gain, moved)
    assert np.all(np.abs(values - line) <= found.error[:, None])


def test_derivatives_of_tanh_are_enclosed_wherever_they_turn():
    rng = np.random.default_rng(10)
    middle = np.concatenate([rng.uniform(-3.0, 3.0, 500), [0.6584789484624084, -0.65847894846]])
    half = np.concatenate([10.0 ** rng.uniform(-6, 0.5, 500), [0.0, 0.0]])
    found = tanh_derivatives(Interval(middle - half, middle + half))
    at = middle + half * np.linspace(-1.0, 1.0, 1001)[:, None]
    tanh = np.tanh(at)
    for one, seen in zip(found, (tanh, 1 - tanh**2, -2 * tanh * (1 - tanh**2)), strict=True):
        assert np.all(one.lower - 1e-15 <= seen.min(axis=0))
        assert np.all(seen.max(axis=0) <= one.upper + 1e-15)
        np.testing.assert_allclose(one.lower, seen.min(axis=0), atol=1e-4)
        np.testing.assert_allclose(one.upper, seen.max(axis=0), atol=1e-4)


def test_products_of_intervals_and_a_matrix_hold_the_exact_ones():
    rng = np.random.default_rng(11)
    # Terms that cancel leave nothing but what rounding made of them.
    row = rng.standard_normal(40)
    matrix = np.concatenate([rng.standard_normal(20), np.zeros(20)])
    row[20:], matrix[20:] = row[:20], -matrix[:20]
    found = linear(Interval(row, row), matrix[:, None], np.array([1.0]))
    exact = sum(Fraction(a) * Fraction(b) for a, b in zip(row, matrix, strict=True)) + 1
    assert Fraction(found.lower.item()) <= exact <= Fraction(found.upper.item())
    assert found.radius.item() < 1e-12
