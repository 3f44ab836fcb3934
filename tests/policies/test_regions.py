"""Regions: what they draw lies in them, what they contain is what they say, searches find."""

import numpy as np
import pytest

from lagros_policies.contraction import BoxRegion, PlanRegion, Samples
from lagros_policies.contraction.regions import search_region
from lagros_policies.tasks.cartpole.region import Region

BOX = BoxRegion((-1.0, 0.0, 2.0), (1.0, 3.0, 2.5), (0.5, 4.0, 0.1), (-1.0, 0.0), (0.0, 2.0))
NODES = np.random.default_rng(0).uniform(-3.0, 3.0, (40, 5))
CLOUD = PlanRegion(
    NODES[:, :3],
    NODES[:, 3:],
    np.array([0.1, 0.2, 0.3]),
    np.array([0.2, 0.4]),
    np.array([0.5, 0.3, 0.1]),
)
SIZES = {Region: (4, 1), BoxRegion: (3, 2), PlanRegion: (3, 2)}
every = pytest.mark.parametrize("region", [Region(), BOX, CLOUD], ids=lambda r: type(r).__name__)


def inside_box(box, x, x_d, u_d):
    return (
        all(a <= v <= b for v, a, b in zip(x, box.low, box.high, strict=True))
        and all(a <= v <= b for v, a, b in zip(x_d, box.low, box.high, strict=True))
        and all(abs(a - b) <= e for a, b, e in zip(x, x_d, box.error, strict=True))
        and all(a <= v <= b for v, a, b in zip(u_d, box.control_low, box.control_high, strict=True))
    )


def inside_cloud(cloud, x, x_d, u_d):
    near = any(
        np.all(np.abs(x_d - node) <= cloud.reach) and np.all(np.abs(u_d - u) <= cloud.control_reach)
        for node, u in zip(cloud.nominal, cloud.nominal_control, strict=True)
    )
    return near and bool(np.all(np.abs(x - x_d) <= cloud.error))


@every
def test_what_a_region_draws_lies_in_it_and_fills_it(region):
    drawn = region.sample(np.random.default_rng(1), 3000)
    states, controls = SIZES[type(region)]
    assert drawn.state.shape == (3000, states)
    assert drawn.nominal_control.shape == (3000, controls)
    assert np.all(region.contains(drawn.state, drawn.nominal, drawn.nominal_control))
    again = region.sample(np.random.default_rng(1), 3000)
    assert np.array_equal(again.state, drawn.state)
    # A little more of everything that is bounded, and most are outside.
    far = drawn.nominal + 3.0 * (drawn.state - drawn.nominal)
    assert region.contains(far, drawn.nominal, drawn.nominal_control).mean() < 0.4


@pytest.mark.parametrize(("region", "inside"), [(BOX, inside_box), (CLOUD, inside_cloud)])
def test_what_a_region_contains_is_what_its_bounds_say(region, inside):
    drawn = region.sample(np.random.default_rng(2), 600)
    rng = np.random.default_rng(3)
    parts = [
        part + rng.normal(0.0, 0.15, part.shape) * (rng.random((600, 1)) < 0.4)
        for part in (drawn.state, drawn.nominal, drawn.nominal_control)
    ]
    found = region.contains(*parts)
    assert found.tolist() == [inside(region, *triple) for triple in zip(*parts, strict=True)]
    assert 50 < found.sum() < 550
    assert region.contains(*(part[0] for part in parts)) == found[0]


@every
def test_triples_of_other_sizes_are_refused(region):
    with pytest.raises(ValueError, match="states and control end in"):
        region.contains(np.zeros(7), np.zeros(7), np.zeros(1))


@every
def test_a_search_finds_the_corner_that_samples_miss(region):
    def score(drawn: Samples):
        return drawn.state.sum(axis=1) + drawn.nominal_control.sum(axis=1)

    drawn = region.sample(np.random.default_rng(0), 200_000)
    found, figures = search_region(region, score, np.random.default_rng(4), 400)
    assert np.all(np.diff(figures) <= 0.0)
    assert figures == pytest.approx(score(found))
    assert np.all(region.contains(found.state, found.nominal, found.nominal_control))
    assert figures[0] > score(drawn).max()
    if region is BOX:
        assert figures[0] == pytest.approx(1.0 + 3.0 + 2.5 + 0.0 + 2.0, abs=0.05)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"low": (-1.0, 0.0)}, "low"),
        ({"low": (2.0, 0.0, 2.0)}, "low"),
        ({"low": (-np.inf, 0.0, 2.0)}, "low"),
        ({"error": (0.5, 0.0, 0.1)}, "error"),
        ({"error": (0.5,)}, "error"),
        ({"control_high": (2.0,)}, "control_low"),
        ({"control_low": (np.nan, 0.0)}, "control_low"),
        ({"high": "wide"}, "high"),
    ],
)
def test_boxes_that_are_none_are_refused(change, name):
    whole = {key: getattr(BOX, key) for key in BOX.__dataclass_fields__}
    with pytest.raises(ValueError, match=name):
        BoxRegion(**{**whole, **change})


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"reach": np.zeros(3)}, "reach"),
        ({"error": np.ones(2)}, "error"),
        ({"control_reach": np.array([1.0, np.inf])}, "control_reach"),
        ({"nominal": np.zeros((0, 3)), "nominal_control": np.zeros((0, 2))}, "node"),
        ({"nominal": np.full((40, 3), np.nan)}, "finite"),
    ],
)
def test_clouds_that_are_none_are_refused(change, name):
    whole = {key: getattr(CLOUD, key) for key in CLOUD.__dataclass_fields__}
    with pytest.raises(ValueError, match=name):
        PlanRegion(**{**whole, **change})
