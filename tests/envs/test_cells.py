"""Looking up what is near by cells: the same as all pairs, wherever things lie."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.cells import Cells, Offsets, Resting, all_beside, all_pairs
from lagros_envs.seeding import episode_streams
from lagros_envs.sweep import Path, swept_agents, swept_obstacles
from lagros_envs.tasks.spacecraft import nearby
from lagros_envs.tasks.spacecraft.nearby import Nearby
from lagros_envs.tasks.spacecraft.placement import most_apart_in_disc
from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_envs.tasks.spacecraft.sensing import Layout, observe
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv

REACH = 2.0


def near_by_hand(points, others, distance):
    """Pairs of (2, worlds, n) and (2, worlds, m) no further apart, one world after the other."""
    found = set()
    _, worlds, count = points.shape
    for world in range(worlds):
        for one in range(count):
            for other in range(others.shape[2]):
                x, y = others[:, world, other] - points[:, world, one]
                if x * x + y * y <= distance * distance:
                    found.add((world * count + one, world * others.shape[2] + other))
    return found


def scattered(kind, rng, worlds, count):
    """Points at random, in a heap, all in one place, on the borders of cells, or far outside."""
    side = 12.0
    points = rng.uniform(0.0, side, (2, worlds, count))
    if kind == "heap":
        points = 6.0 + 0.01 * points
    elif kind == "one place":
        points[:] = 3.0
    elif kind == "borders":
        points = 2.0 * (1.0 + 1e-9) * rng.integers(-2, 9, (2, worlds, count))
        points += rng.choice([-1e-13, 0.0, 1e-13], points.shape)
    elif kind == "outside":
        points *= rng.choice([1.0, -1.0, 50.0, 1e12], (1, worlds, count))
    return points


KINDS = ["random", "heap", "one place", "borders", "outside"]


@given(st.integers(0, 2**32), st.sampled_from(KINDS), st.integers(1, 3), st.integers(1, 30))
def test_cells_find_every_pair_that_is_near_once(seed, kind, worlds, count):
    rng = np.random.default_rng(seed)
    points = scattered(kind, rng, worlds, count)
    cells = Cells(np.zeros((worlds, 2)), np.full((worlds, 2), 12.0), REACH)
    one, other = cells.pairs(cells.keys(points))
    pairs = {(min(pair), max(pair)) for pair in zip(one.tolist(), other.tolist(), strict=True)}
    assert len(pairs) == len(one)
    assert all(a // count == b // count and a != b for a, b in pairs)
    truth = {pair for pair in near_by_hand(points, points, REACH) if pair[0] < pair[1]}
    assert truth <= pairs


@given(st.integers(0, 2**32), st.sampled_from(KINDS), st.integers(1, 3), st.integers(1, 20))
def test_what_rests_is_found_from_everywhere(seed, kind, worlds, count):
    rng = np.random.default_rng(seed)
    points = scattered(kind, rng, worlds, 25)
    where = "borders" if kind == "borders" else "random"
    discs = np.clip(scattered(where, rng, worlds, count), 0.0, 12.0)
    present = rng.random((worlds, count)) < 0.8
    resting = Resting(np.zeros((worlds, 2)), np.full((worlds, 2), 12.0), discs, present, REACH)
    one, other = resting.pairs(resting.cells.keys(points))
    pairs = set(zip(one.tolist(), other.tolist(), strict=True))
    assert len(pairs) == len(one)
    assert all(a // 25 == b // count for a, b in pairs)
    truth = {pair for pair in near_by_hand(points, discs, REACH) if present.reshape(-1)[pair[1]]}
    assert truth <= pairs
    # Not many more are looked at than are near.
    if kind == "random":
        assert len(pairs) <= len(near_by_hand(points, discs, 1.8 * REACH))


@pytest.mark.parametrize("seed", range(30))
def test_collisions_by_cells_are_those_by_all_pairs(seed):
    """Paths of all speeds; where some are too fast for the cells all pairs are looked at."""
    rng = np.random.default_rng(seed)
    worlds, agents, discs = 3, 40, 20
    speed = [0.02, 0.3, 3.0][seed % 3]
    starts, goals = rng.uniform(0.0, 9.0, (2, 2, worlds, agents))
    centres = rng.uniform(0.0, 9.0, (2, worlds, discs))
    radii = rng.uniform(0.2, 0.7, (worlds, discs))
    radii[rng.random(radii.shape) < 0.2] = -np.inf
    points = starts + np.cumsum(speed * rng.normal(size=(3, 2, worlds, agents)), axis=0)
    path = Path.through(points, 0.01 * rng.random((worlds, agents)))
    contact, core = rng.uniform(0.1, 0.5, worlds), rng.uniform(0.0, 0.3, worlds)
    by_cells = Nearby(2.0, starts, goals, contact, centres, radii, core, True)
    near = by_cells.at(points[-1], float(path.reach.max()))
    touch = radii + core[:, None]
    np.testing.assert_array_equal(
        swept_agents(path, contact, near.agents), swept_agents(path, contact)
    )
    np.testing.assert_array_equal(
        swept_obstacles(path, centres, touch, near.obstacles),
        swept_obstacles(path, centres, touch),
    )
    if speed > 1.0:
        return
    flat = points[-1].reshape(2, -1)
    whole = Offsets.between(all_pairs(worlds, agents), flat, flat)
    assert len(near.agents.one) < len(whole.one)
    beside = Offsets.between(all_beside(worlds, agents, discs), flat, centres.reshape(2, -1))
    assert len(near.obstacles.one) < len(beside.one)


@given(st.integers(0, 2**32), st.sampled_from([0.003, 0.05, 0.5]), st.sampled_from([0.0, 0.5, 2.0]))
def test_who_was_near_before_is_who_is_near_as_all_move(seed, speed, sensing):
    """Pairs are looked up anew when somebody has moved further than they allow for, not later."""
    rng = np.random.default_rng(seed)
    worlds, agents, discs = 2, 15, 6
    points = rng.uniform(0.0, 6.0, (2, worlds, agents))
    centres = rng.uniform(0.0, 6.0, (2, worlds, discs))
    contact, radii = np.full(worlds, 0.2), np.full((worlds, discs), 0.4)
    near = Nearby(sensing, points, points, contact, centres, radii, np.zeros(worlds), True)
    for _ in range(12):
        # One of them at a time is the fastest.
        points = points + speed * rng.normal(size=points.shape) * rng.random((1, worlds, agents))
        found = near.at(points, rng.choice([0.01, 0.1]))
        for pairs, others, distance in (
            (found.agents, points, max(sensing, 0.2)),
            (found.obstacles, centres, max(sensing + 0.4, 0.4)),
        ):
            seen = np.flatnonzero(pairs.square <= distance * distance)
            ones = [(int(pairs.one[k]), int(pairs.other[k])) for k in seen]
            assert ones == sorted(set(ones))
            truth = near_by_hand(points, others, distance)
            if others is points:
                truth = {pair for pair in truth if pair[0] != pair[1]}
            assert set(ones) == truth


def flown(monkeypatch, by_cells, preset, worlds, agents, steps=12):
    """Everything that worlds show of themselves, by cells or by all pairs."""
    monkeypatch.setattr(nearby, "MOST_PAIRS", 0 if by_cells else 10**9)
    env = SpacecraftVectorEnv(
        worlds * agents, agents, preset, "uniform", 1.0, compiled=False, max_episode_steps=10
    )
    rng = np.random.default_rng(0)
    observation, _ = env.reset(seed=3)
    seen = [observation]
    for _ in range(steps):
        # A few dash through everything; after ten steps a new episode begins.
        actions = rng.random((worlds * agents, 8)).astype(np.float32)
        actions[rng.random(len(actions)) < 0.05] *= 40.0
        observation, reward, *_, info = env.step(actions)
        seen += [observation, reward, info["collided"], info["success"]]
    return seen


@pytest.mark.parametrize(
    ("preset", "worlds", "agents"),
    [("swarm", 1, 96), ("swarm", 5, 7), ("gcbf", 2, 40), ("crossing", 2, 30)],
)
def test_a_world_is_the_same_by_cells_and_by_all_pairs(monkeypatch, preset, worlds, agents):
    first = flown(monkeypatch, True, preset, worlds, agents)
    second = flown(monkeypatch, False, preset, worlds, agents)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


# Slots.


def sensed(row, layout, kind):
    """What a row shows of a kind, as a set."""
    part = row[layout.slices[f"{kind}s"]].reshape(-1, {"neighbour": 4, "obstacle": 3}[kind])
    mask = row[layout.slices[f"{kind}_mask"]]
    assert not part[mask == 0.0].any()
    return [tuple(entry) for entry in part[mask == 1.0].tolist()]


@pytest.mark.parametrize(("preset", "agents"), [("swarm", 100), ("gcbf", 130)])
def test_the_slots_that_there_are_hold_all_that_is_sensed(preset, agents):
    env = SpacecraftVectorEnv(2 * agents, agents, preset, "uniform", 1.0, compiled=False)
    env.reset(seed=1)
    for _ in range(30):
        env.step(np.zeros((2 * agents, 8), np.float32))
    layout = env.layout
    assert layout.neighbours < agents - 1
    whole = Layout(agents - 1, env.preset.obstacle_count[1], env.settings.time_limit)
    rows, wide = (observe(env.world, one).reshape(2 * agents, -1) for one in (layout, whole))
    both = [0, 0]
    for row, other in zip(rows, wide, strict=True):
        for place, kind in enumerate(("neighbour", "obstacle")):
            # In the same order, too: by their numbers.
            assert sensed(row, layout, kind) == sensed(other, whole, kind)
            both[place] += len(sensed(row, layout, kind))
        np.testing.assert_array_equal(row[:9], other[:9])
    assert min(both) > 20


def test_a_heap_of_bodies_that_touch_shows_the_nearest():
    preset = PRESETS["swarm"]
    agents = 90
    env = SpacecraftVectorEnv(agents, agents, preset, compiled=False)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    env.world.parts[:2, 0] = 5.0 + 0.3 * rng.normal(size=(2, agents))
    row = observe(env.world, env.layout)[0]
    room = env.layout.neighbours
    assert room < agents - 1
    places = env.world.parts[:2, 0].T
    for agent in range(0, agents, 7):
        distances = np.linalg.norm(places - places[agent], axis=1)
        shown = np.array(sensed(row[agent], env.layout, "neighbour"))
        assert len(shown) == room
        nearest = np.sort(distances)[1 : room + 1]
        np.testing.assert_allclose(
            np.sort(np.linalg.norm(shown[:, :2], axis=1)), nearest, atol=1e-6
        )


def test_no_more_bodies_fit_into_the_sensing_disc_than_there_are_slots():
    """The densest lattice there is, around one of its points, at many radii."""
    for apart in (0.5, 1.0):
        steps = apart * np.arange(-20, 21)
        rows = math.sqrt(3.0) / 2.0 * steps
        x = steps[:, None] + 0.5 * apart * (np.arange(-20, 21) % 2)
        y = np.broadcast_to(rows, x.shape)
        distances = np.hypot(x, y)
        for radius in np.linspace(0.0, 8.0 * apart, 60):
            count = np.count_nonzero(distances <= radius + 1e-9)
            assert count <= most_apart_in_disc(radius, apart)
            if radius > 4.0 * apart:
                assert count >= 0.65 * most_apart_in_disc(radius, apart)


def test_layouts_stay_as_they_were_where_everybody_fits():
    for name, agents in (("paper", 6), ("crossing", 32), ("swarm", 12)):
        env = SpacecraftVectorEnv(agents, agents, name, compiled=False)
        assert env.layout.neighbours == agents - 1
        assert env.layout.obstacles == max(1, env.preset.obstacle_count[1])
    large = PRESETS["swarm"].for_agents(1024)
    scenario = large.sample(episode_streams(0).scenario)
    gaps = np.linalg.norm(scenario.starts[:, None] - scenario.obstacles, axis=-1) - 0.5
    assert np.max(np.count_nonzero(gaps <= 2.0, axis=1)) <= large.most_obstacles(2.0) < 20
