"""The rule of reserved ways to a stop: two that keep it stay apart, whatever both choose."""

import numpy as np
import pytest

from lagros_envs.balls import onto_unit_sphere
from lagros_policies.safety.reserve import (
    Reserve,
    limits_beyond_braking,
    restart,
    zones_beside_bodies,
    zones_beside_discs,
)
from lagros_policies.tasks.spacecraft.proved_filter import largest_share, nearest_beyond
from tests.policies.programs import nearest_by_program
from tests.policies.segments import segment_distance


def in_disc(rng, count, radius):
    direction = rng.uniform(-np.pi, np.pi, count)
    size = radius * rng.choice([0.0, 0.5, 1.0], count)
    return size[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)


RESERVE = Reserve(0.1, 0.15, clearance=0.08, place_error=0.07, stop_error=0.06)


def drawn_pairs(rng, count):
    """Draw nominal motions of pairs that are L apart, and actual ones that belong to them."""
    beta, eps, radius = RESERVE.stopping_time, RESERVE.place_error, 0.25
    place = np.stack([np.zeros((count, 2)), in_disc(rng, count, 1.0)], axis=1)
    speed = in_disc(rng, 2 * count, 0.9).reshape(count, 2, 2) * rng.random((count, 2, 1))
    segments = np.stack([place, place + beta * speed], axis=2)
    # Moved apart along the line of centres until they are just L apart, or somewhat more.
    away = onto_unit_sphere(place[:, 1] - place[:, 0], np.array([1.0, 0.0]))
    wanted = RESERVE.distance(radius, radius) + 0.3 * rng.random(count) * rng.integers(0, 2, count)
    low, high = np.zeros(count), np.full(count, 3.0)
    for _ in range(40):
        middle = 0.5 * (low + high)
        moved = segments[:, 1] + (middle[:, None] * away)[:, None]
        near = segment_distance(segments[:, 0], moved) < wanted
        low, high = np.where(near, middle, low), np.where(near, high, middle)
    place[:, 1] += high[:, None] * away
    error = in_disc(rng, 2 * count, eps).reshape(count, 2, 2)
    stop_error = in_disc(rng, 2 * count, RESERVE.stop_error).reshape(count, 2, 2)
    return place, speed, place + error, speed + (stop_error - error) / beta


@pytest.mark.parametrize("moves", [False, True])
def test_two_that_keep_the_rule_stay_apart(moves):
    """Whatever both choose: the segments stay L apart, and the bodies in between."""
    rng, count, beta, h = np.random.default_rng(0), 4000, RESERVE.stopping_time, RESERVE.period
    place, speed, actual, moving = drawn_pairs(rng, count)
    length, kept, bodies = RESERVE.distance(0.25, 0.25), [], []
    chosen = 0
    for own in (0, 1):
        other = 1 - own
        apart = np.concatenate(
            [actual[:, other] - actual[:, own], moving[:, other] - moving[:, own]], axis=1
        )
        zones = zones_beside_bodies(
            RESERVE, 0.25, moving[:, own], apart[:, None], np.ones((count, 1), bool)
        )
        near = place[:, own] - actual[:, own]
        stop = near + beta * speed[:, own]
        inside, pace = zones.hold(near, stop), speed[:, own]
        if moves:
            near, stop, inside = restart(zones, near, stop, beta * moving[:, own])
            pace = (stop - near) / beta
        normals, bounds = limits_beyond_braking(RESERVE, zones, inside, near, pace)
        # Towards the other, across, or anywhere, as far as the rule lets it.
        wish = in_disc(rng, count, 30.0) + 10.0 * rng.random((count, 1)) * apart[:, :2]
        extra = nearest_beyond(wish, normals, bounds)
        chosen += np.sum(np.abs(extra - wish).max(axis=1) > 1e-9)
        pull = extra - RESERVE.braking_rate * pace
        start = actual[:, own] + near
        times = np.linspace(0.0, h, 5)[:, None, None]
        bodies.append(start + times * pace + 0.5 * times**2 * pull)
        end, last = bodies[-1][-1], pace + h * pull
        kept.append(np.stack([end, end + beta * last], axis=1))
    assert chosen > count / 4
    assert segment_distance(*kept).min() > length - 1e-6
    assert np.linalg.norm(bodies[0] - bodies[1], axis=-1).min() > length - 1e-6


def test_braking_keeps_every_segment_within_the_one_before():
    rng, h, beta = np.random.default_rng(1), RESERVE.period, RESERVE.stopping_time
    speed = in_disc(rng, 50, 2.0)
    pull = -RESERVE.braking_rate * speed
    place, last = h * speed + 0.5 * h * h * pull, speed + h * pull
    np.testing.assert_allclose(place, RESERVE.coasting * speed, atol=1e-12)
    np.testing.assert_allclose(place + beta * last, beta * speed, atol=1e-12)
    assert np.all(RESERVE.coasting <= beta)


def test_what_may_be_added_to_braking_always_includes_nothing():
    rng, count = np.random.default_rng(2), 500
    place, speed, actual, moving = drawn_pairs(rng, count)
    apart = np.concatenate([actual[:, 1] - actual[:, 0], moving[:, 1] - moving[:, 0]], axis=1)
    zones = zones_beside_bodies(
        RESERVE, 0.25, moving[:, 0], apart[:, None], np.ones((count, 1), bool)
    )
    near = place[:, 0] - actual[:, 0]
    inside = (
        np.minimum(zones.along(near), zones.along(near + RESERVE.stopping_time * speed[:, 0]))
        >= zones.least
    )
    normals, bounds = limits_beyond_braking(RESERVE, zones, inside, near, speed[:, 0])
    # Braking stays in the zone that is chosen; elsewhere the half-planes go through zero.
    after = near + RESERVE.coasting * speed[:, 0]
    assert np.all((zones.along(after) >= zones.least - 1e-12) | ~inside)
    assert np.all(bounds <= 0.0)
    assert 0.1 < inside.mean() < 0.9
    assert np.all(inside | ((bounds[:, :1] == 0.0) & (bounds[:, 1:] == 0.0)))
    lengths = np.linalg.norm(normals, axis=-1)
    assert np.all((np.abs(lengths - 1.0) < 1e-12) | (lengths == 0.0))


def test_two_see_the_same_zones_from_both_sides():
    """The zones of a pair leave L between them, or each leaves the other where it may be."""
    rng, count = np.random.default_rng(3), 2000
    _, _, actual, moving = drawn_pairs(rng, count)
    edges = []
    for own, other in ((0, 1), (1, 0)):
        apart = np.concatenate(
            [actual[:, other] - actual[:, own], moving[:, other] - moving[:, own]], axis=1
        )
        zones = zones_beside_bodies(
            RESERVE, 0.25, moving[:, own], apart[:, None], np.ones((count, 1), bool)
        )
        normal = np.stack([zones.x, zones.y], axis=-1)[:, 0]
        edges.append((normal, zones.least[:, 0] + np.sum(normal * actual[:, own], axis=1)))
    np.testing.assert_allclose(edges[0][0], -edges[1][0], atol=1e-15)
    assert np.all(edges[0][1] + edges[1][1] > RESERVE.distance(0.25, 0.25) - 1e-12)


def test_a_disc_is_kept_off_by_its_tangent():
    rng, count = np.random.default_rng(4), 500
    place, way = in_disc(rng, count, 0.07), in_disc(rng, count, 0.2)
    centre = 1.2 * onto_unit_sphere(rng.standard_normal((count, 2)), np.array([1.0, 0.0]))
    discs = np.concatenate([centre, np.full((count, 1), 0.5)], axis=1)[:, None]
    zones = zones_beside_discs(RESERVE, 0.25, place, place + way, discs, np.ones((count, 1), bool))
    kept = 0.25 + 0.5 + RESERVE.clearance
    tangent = zones.least[:, 0] - np.sum(np.stack([zones.x, zones.y], -1)[:, 0] * centre, axis=1)
    steps = np.linspace(0.0, 1.0, 201)[:, None, None]
    nearest = np.linalg.norm(place + steps * way - centre, axis=-1).min(axis=0)
    np.testing.assert_allclose(tangent, np.minimum(kept, nearest), atol=1e-4)
    assert np.all(zones.along(place) >= zones.least - 1e-12)
    assert np.all(zones.along(place + way) >= zones.least - 1e-12)


def test_the_change_is_least_by_a_general_solver():
    rng = np.random.default_rng(5)
    for _ in range(60):
        count = rng.integers(1, 14)
        normals = onto_unit_sphere(rng.standard_normal((count, 2)), np.array([1.0, 0.0]))
        bounds = -rng.choice([0.0, 1.0], count) * rng.random(count)
        wanted = 2.0 * rng.standard_normal(2)
        found = nearest_beyond(wanted[None], normals[None], bounds[None])[0]
        np.testing.assert_allclose(found, nearest_by_program(wanted, normals, bounds), atol=1e-5)


def test_the_largest_share_is_by_bisection():
    rng = np.random.default_rng(6)
    start, way = in_disc(rng, 300, 1.0), 3.0 * rng.standard_normal((300, 2))
    low, high = np.zeros(300), np.ones(300)
    for _ in range(60):
        middle = 0.5 * (low + high)
        good = np.linalg.norm(start + middle[:, None] * way, axis=1) <= 1.0 + 1e-12
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    np.testing.assert_allclose(largest_share(start, way, 1.0), low, atol=1e-6)
    assert largest_share(np.zeros((1, 2)), np.zeros((1, 2)), 1.0) == 1.0
