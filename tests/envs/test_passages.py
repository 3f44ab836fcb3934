"""Fields of discs: open by brute force, and the same law one at a time and many at once."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.stats import ks_2samp

from lagros_envs.passages import passages_open
from lagros_envs.registry import find_task, task_names
from lagros_envs.task import Task

SINGLE = [name for name in task_names() if isinstance(find_task(name), Task)]


def test_open_is_open_by_brute_force():
    rng = np.random.default_rng(0)
    centres = rng.uniform(-2.0, 2.0, (400, 4, 2))
    count = rng.integers(0, 5, 400)
    centres[np.arange(4) >= count[:, None]] = np.inf
    ends = rng.uniform(-3.0, 3.0, (400, 2, 2))
    with np.errstate(invalid="ignore"):
        found = passages_open(centres, ends, 0.6)
    for row, opened in enumerate(found):
        there = centres[row, : count[row]]
        clear = all(math.dist(one, end) >= 0.7 for one in there for end in ends[row])
        apart = all(math.dist(*pair) >= 1.2 for pair in itertools.combinations(there, 2))
        assert opened == (clear and apart)
    assert 20 < np.sum(found) < 380


@pytest.mark.parametrize("name", SINGLE)
def test_many_scenarios_are_drawn_by_the_law_of_one(name):
    task, count = find_task(name), 600
    rng = np.random.default_rng(7)
    many = task.sample_many(rng, count)
    each = task.sample_each(np.random.default_rng(index) for index in range(count))
    for part in ("initial_state", "goal", "discs"):
        assert getattr(many, part).shape == getattr(each, part).shape
        first, second = (getattr(one, part).reshape(count, -1) for one in (many, each))
        for column in range(first.shape[-1]):
            # Of a hundred comparisons none of the same law comes below by chance.
            assert ks_2samp(first[:, column], second[:, column], method="asymp").pvalue > 1e-5, (
                part,
                column,
            )
    radii = many.discs[..., 2]
    np.testing.assert_array_equal(many.discs[radii == 0.0], 0.0)
