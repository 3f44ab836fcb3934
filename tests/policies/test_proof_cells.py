"""The search over cells: what it proves is so, and a failure between corners is not overlooked."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lagros_envs.numbers import Interval, exact
from lagros_policies.proof.cells import Examined, grid, remainder, search
from lagros_policies.proof.matrices import negative_definite


class Wave:
    """cos(9 x) cos(7 y) < height over the unit square, as matrices of one entry."""

    def __init__(self, height):
        self.height = height

    def start(self):
        return grid(np.zeros(2), np.ones(2), (2, 3))

    def examine(self, cells):
        ends = np.stack([cells.lower, cells.upper], axis=1)
        x, y = ends[:, :, None, 0], ends[:, None, :, 1]
        corners = (np.cos(9 * x) * np.cos(7 * y) - self.height).reshape(-1, 4, 1, 1)
        product = ((cells[:, 0] * 9.0).cos() * (cells[:, 1] * 7.0).cos())[:, None, None]
        width = (cells.upper - cells.lower).T
        parts = [remainder(product * -81.0, width[0]), remainder(product * -49.0, width[1])]
        return Examined(exact(corners), parts, np.zeros(len(cells.lower), dtype=bool))

    def failure(self, cells):
        middle = cells.midpoint
        values = np.cos(9 * middle[:, 0]) * np.cos(7 * middle[:, 1])
        return middle[np.argmax(values)] if values.max() > self.height else None


def test_a_bound_that_holds_is_proved():
    assert search(Wave(1.01), 20, 10_000, 20.0).proved


def test_a_bound_that_fails_on_a_speck_is_refused():
    # Fails within 0.01 of the maxima only, which all corners of the first cells miss by far.
    found = search(Wave(0.999), 20, 10_000, 20.0)
    assert not found.proved
    assert found.failure is not None
    assert np.cos(9 * found.failure[0]) * np.cos(7 * found.failure[1]) > 0.999


def test_a_search_that_gives_up_proves_nothing():
    found = search(Wave(1.0), 20, 30, 20.0)
    assert not found.proved
    assert found.undecided.shape == (2, 2)


class Speck:
    """cos(3 (x - a)) + cos(3 (y - b)) < height over the unit square: fails near (a, b) alone."""

    def __init__(self, place, height):
        self.place, self.height = place, height

    def start(self):
        return grid(np.zeros(2), np.ones(2), (2, 2))

    def examine(self, cells):
        shifted = [(cells[:, axis] - self.place[axis]) * 3.0 for axis in range(2)]
        ends = np.stack([cells.lower, cells.upper], axis=1) - self.place
        waves = np.cos(3.0 * ends)
        corners = waves[:, :, None, 0] + waves[:, None, :, 1] - self.height
        width = (cells.upper - cells.lower).T
        parts = [
            remainder((shifted[axis].cos() * -9.0)[:, None, None], width[axis]) for axis in range(2)
        ]
        empty = np.zeros(len(cells.lower), dtype=bool)
        return Examined(exact(corners.reshape(-1, 4, 1, 1)), parts, empty)

    def failure(self, cells):
        return None


@settings(max_examples=12)
@given(st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)))
def test_a_failure_that_no_corner_shows_is_never_proved_away(place):
    """Wherever it is: no cell is lost, no half forgotten, no remainder left out."""
    # Batches that leave cells waiting.
    assert not search(Speck(place, 1.9999), 3, 300, 20.0).proved
    assert search(Speck(place, 2.002), 20, 2000, 20.0).proved


class Narrow(Wave):
    """The same, where wide cells divide by an interval that holds zero."""

    def examine(self, cells):
        if np.any(cells.upper - cells.lower > 0.2):
            raise ZeroDivisionError
        return super().examine(cells)


def test_cells_too_wide_for_their_intervals_are_halved():
    assert search(Narrow(1.01), 20, 10_000, 20.0).proved
    assert search(Narrow(0.999), 20, 10_000, 20.0).failure is not None


def test_the_grid_covers_the_box_once():
    cells = grid(np.array([-1.0, 0.0]), np.array([1.0, 3.0]), (4, 3))
    area = np.prod(cells.upper - cells.lower, axis=1).sum()
    assert area == pytest.approx(6.0)
    points = np.random.default_rng(0).uniform([-1.0, 0.0], [1.0, 3.0], (100, 2))
    inside = np.all((cells.lower <= points[:, None]) & (points[:, None] <= cells.upper), axis=-1)
    assert np.all(inside.sum(axis=1) == 1)


@given(st.integers(0, 10**6), st.floats(0.0, 0.6))
def test_what_is_added_to_definite_matrices_leaves_them_definite(seed, size):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((4, 4))
    middle = -root @ root.T - 0.3 * np.eye(4)
    push = rng.standard_normal((2, 4, 4))
    push = size * (push + np.swapaxes(push, -1, -2))
    added = [Interval(part - 0.01, part + 0.01) for part in push]
    if negative_definite(exact(middle), added):
        for shares in rng.uniform(-1.0, 1.0, (50, 2)):
            noise = rng.uniform(-0.01, 0.01, (2, 4, 4))
            noise = 0.5 * (noise + np.swapaxes(noise, -1, -2))
            moved = middle + np.einsum("i,ijk->jk", shares, push + noise)
            assert np.linalg.eigvalsh(moved).max() < 0.0
    assert size > 1e-3 or bool(negative_definite(exact(middle - np.eye(4)), added))


@pytest.mark.parametrize("size", [1, 3])
def test_the_test_of_definiteness_is_sharp_on_diagonal_matrices(size):
    """-1 with a radius, or with a multiple added, on either side of where it ceases to be so."""
    middle, eye = -np.eye(size), np.eye(size)

    def shown(radius, centre, around):
        added = [Interval((centre - around) * eye, (centre + around) * eye)]
        return bool(
            negative_definite(Interval(middle - radius * eye, middle + radius * eye), added)
        )

    for parts in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.3, 0.3, 0.4)):
        assert shown(*(0.999 * part for part in parts))
        assert not shown(*(1.001 * part for part in parts))
    assert not shown(0.0, 2.5, 0.0)
    assert not negative_definite(exact(eye))
