"""The nearest point of half-planes, held against general solvers."""

import numpy as np
import pytest

from lagros_policies.safety.half_planes import nearest
from tests.policies.programs import least_violation_by_program, nearest_by_program


def half_planes_of(rng, kind):
    """Return normals, bounds and a wanted point of one random problem."""
    count = int(rng.integers(1, 9))
    angle = rng.uniform(-np.pi, np.pi, count)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    if kind == "opposite" and count > 1:
        normals[1] = -normals[0]
    bounds = rng.normal(size=count) - (1.0 if kind == "open" else 0.0)
    return normals, bounds, 2.0 * rng.normal(size=2)


@pytest.mark.parametrize("kind", ["open", "any", "opposite"])
def test_nearest_is_that_of_osqp_and_of_a_linear_program(kind):
    rng = np.random.default_rng(3)
    infeasible = 0
    for _ in range(80):
        normals, bounds, wanted = half_planes_of(rng, kind)
        point, violation = nearest(wanted[None], normals[None], bounds[None])
        least = least_violation_by_program(normals, bounds, np.ones(len(bounds)))
        assert violation[0] == pytest.approx(least, abs=1e-7)
        assert np.all(normals @ point[0] >= bounds - least - 1e-6)
        if least == 0.0:
            expected = nearest_by_program(wanted, normals, bounds)
            assert point[0] == pytest.approx(expected, abs=1e-5)
        infeasible += least > 1e-6
    assert infeasible > 10 or kind == "open"


def test_what_is_least_violated_is_nearest_among_its_equals():
    # Between two walls that ask for too much, the middle, and as far along them as was wanted.
    normals = np.array([[[1.0, 0.0], [-1.0, 0.0]]])
    point, violation = nearest(np.array([[5.0, 7.0]]), normals, np.array([[2.0, 1.0]]))
    assert violation[0] == pytest.approx(1.5)
    assert point[0] == pytest.approx([0.5, 7.0], abs=1e-6)


def test_the_violation_is_shared_by_softness_and_the_hard_take_none():
    rng = np.random.default_rng(4)
    box = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    violated = 0
    for _ in range(60):
        normals, bounds, wanted = half_planes_of(rng, "any")
        together = np.concatenate([normals, box])
        limits = np.concatenate([bounds, np.full(4, -0.7)])
        softness = np.concatenate([rng.choice([0.3, 1.0], len(bounds)), np.zeros(4)])
        point, violation = nearest(wanted[None], together[None], limits[None], softness)
        least = least_violation_by_program(together, limits, softness)
        assert violation[0] == pytest.approx(least, abs=1e-6)
        assert np.all(together @ point[0] >= limits - softness * least - 1e-6)
        violated += least > 1e-6
    assert violated > 10


def test_rows_are_independent_and_absent_half_planes_do_nothing():
    rng = np.random.default_rng(5)
    problems = [half_planes_of(rng, "any") for _ in range(50)]
    normals, bounds = np.zeros((50, 9, 2)), rng.normal(size=(50, 9))
    for row, (some, limits, _) in enumerate(problems):
        normals[row, : len(limits)], bounds[row, : len(limits)] = some, limits
    wanted = np.array([point for _, _, point in problems])
    points, violation = nearest(wanted, normals, bounds)
    for row, (some, limits, point) in enumerate(problems):
        alone = nearest(point[None], some[None], limits[None])
        assert points[row] == pytest.approx(alone.points[0], abs=1e-6)
        assert violation[row] == pytest.approx(alone.violation[0], abs=1e-6)
    nothing = nearest(wanted, np.zeros((50, 3, 2)), np.ones((50, 3)))
    assert np.array_equal(nothing.points, wanted)
    assert not nothing.violation.any()
