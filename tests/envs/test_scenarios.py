"""Scenarios: what the presets promise, files, and refusals."""

import dataclasses
import hashlib
import json
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from lagros_envs.seeding import episode_streams
from lagros_envs.tasks.spacecraft.placement import most_apart
from lagros_envs.tasks.spacecraft.reachable import flood, shut_in, way_exists
from lagros_envs.tasks.spacecraft.scenarios import PRESETS, Preset, Scenario, preset_named
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings, before_growth, settings_for


def drawn(preset, agents=None, seeds=range(25)):
    return [preset_named(preset).sample(episode_streams(seed).scenario, agents) for seed in seeds]


def apart(points, others=None):
    """Distances of all pairs; of different points if there is one set."""
    distances = np.linalg.norm(points[:, None] - (points if others is None else others), axis=-1)
    return distances[np.triu_indices(len(points), 1)] if others is None else distances


def scenario(**changes):
    values = {
        "starts": [[0.0, 0.0], [1.0, 0.0]],
        "headings": [0.0, 1.0],
        "goals": [[3.0, 0.0], [3.0, 1.0]],
        "obstacles": [[2.0, 2.0]],
        "obstacle_radii": [0.5],
    }
    return Scenario(**{**values, **changes})


# The presets.


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_samples_what_it_promises(name):
    preset = PRESETS[name]
    for sample in drawn(name):
        assert sample.num_agents == preset.agents
        assert (sample.agent_radius, sample.core) == (preset.agent_radius, preset.core)
        assert preset.obstacle_count[0] <= len(sample.obstacles) <= preset.obstacle_count[1]
        ways = np.linalg.norm(sample.starts - sample.goals, axis=1)
        assert np.all((ways >= preset.least_way) & (ways <= preset.longest_way + 1e-12))
        room = 2.0 * (sample.agent_radius + preset.margin)
        assert np.all(apart(sample.starts) >= room - 1e-12)
        assert np.all(apart(sample.goals) >= room - 1e-12)
        clearance = sample.obstacle_radii + sample.core + preset.aside
        for ends in (sample.starts, sample.goals):
            assert np.all(apart(ends, sample.obstacles) >= clearance - 1e-12)
            assert np.all((ends >= 0.0) & (ends <= preset.arena))
        assert np.all((sample.obstacles >= 0.0) & (sample.obstacles <= preset.arena))
        # An agent with its margin fits between any two obstacles.
        if len(sample.obstacles) > 1 and preset.open_passages:
            clearance = preset.obstacle_radius + sample.core + preset.margin
            assert np.min(apart(sample.obstacles)) >= 2.0 * clearance
        assert np.all(np.abs(sample.headings) <= preset.heading_range)


def test_the_presets_are_the_paper_and_its_released_code():
    paper, released = drawn("paper", seeds=range(60)), drawn("released", seeds=range(5))
    assert {len(sample.obstacles) for sample in paper} == {3, 4, 5, 6}
    assert all(sample.agent_radius == 0.25 and sample.core == 0.25 for sample in paper)
    assert (PRESETS["paper"].core, PRESETS["released"].core) == (0.25, 0.0)
    assert np.ptp([sample.headings[0] for sample in paper]) > 5.0
    for sample in released:
        assert 2.0 * sample.agent_radius == 1.0
        assert len(sample.obstacles) == 6
        assert np.all(np.linalg.norm(sample.starts - sample.goals, axis=1) > 5.0)
        assert not sample.headings.any()
    for sample in (*drawn("open"), *drawn("crossing")):
        assert sample.obstacles.shape == (0, 2)


@pytest.mark.parametrize("agents", [1, 2, 6, 17])
def test_crossing_swaps_opposite_places(agents):
    for sample in drawn("crossing", agents, range(5)):
        middle = np.full(2, 2.5)
        np.testing.assert_allclose(sample.starts + sample.goals, 2.0 * middle + 0 * sample.starts)
        radii = np.linalg.norm(sample.starts - middle, axis=1)
        np.testing.assert_allclose(radii, radii[0])
        way = PRESETS["crossing"].for_agents(agents).longest_way
        np.testing.assert_allclose(2.0 * radii, way)
        if agents > 1:
            assert np.min(apart(sample.starts)) >= 0.8 - 1e-9


@pytest.mark.parametrize("agents", [1, 6, 12, 64])
def test_a_swarm_grows_at_its_density(agents):
    preset = PRESETS["swarm"].for_agents(agents)
    share = max(1.0, agents / 6)
    assert preset.arena**2 == pytest.approx(25.0 * share)
    assert preset.obstacle_count == (round(3 * share), round(6 * share))
    (sample,) = drawn("swarm", agents, [0])
    assert sample.num_agents == agents
    assert np.min(apart(sample.starts), initial=9.0) >= 0.8
    assert np.max(sample.starts) <= preset.arena


# SHA-256 of forty scenarios each as the preset `swarm` drew them when it had 45 s for any number.
FORMER_SWARMS = {
    1: "808c2f178018f40a",
    6: "4aaed15518761b82",
    12: "a3a5552f04d93462",
    32: "ca7bb85e2f5f2a78",
}


@pytest.mark.parametrize("agents", FORMER_SWARMS)
def test_swarm_45_is_the_former_swarm_to_the_bit(agents):
    digest = hashlib.sha256()
    for sample in drawn("swarm-45", agents, range(40)):
        digest.update(json.dumps(sample.to_dict()).encode())
    assert digest.hexdigest().startswith(FORMER_SWARMS[agents])
    task = settings_for(PRESETS["swarm-45"].for_agents(agents))
    assert task == SpacecraftSettings()
    assert (task.horizon, task.time_limit) == (30.0, 45.0)


@pytest.mark.parametrize("name", ["swarm", "gcbf"])
@pytest.mark.parametrize("agents", [1, 8, 32, 1024])
def test_time_grows_with_the_ways(name, agents):
    own, preset = PRESETS[name], PRESETS[name].for_agents(agents)
    task, usual = settings_for(preset), settings_for(own)
    side = preset.arena / own.arena
    for duration, before in (
        (task.horizon, usual.horizon),
        (task.time_limit, usual.time_limit),
    ):
        assert side * before - 1e-6 <= duration < side * before + 0.5
        assert 2.0 * duration == round(2.0 * duration)
    assert before_growth(task, preset) == usual
    # Who says otherwise is heard.
    assert settings_for(preset, {"time_limit": 50.0}).time_limit == 50.0
    assert settings_for(preset, usual) is usual
    assert before_growth(replace(task, horizon=20.0), preset).horizon == 20.0


def test_the_task_of_gcbf_is_its_double_integrator_five_times_as_large_and_slow():
    """Against the defaults of its repository: `env/double_integrator.py` and `env/__init__.py`."""
    radius, sensing, mass, force, speed = 0.05, 0.5, 0.1, 1.0, 0.5
    # Twice the steps of an episode that is not told otherwise, in whole half seconds.
    period, steps, side = 0.03, 2 * 256, 4.0
    for agents in (8, 32, 1024):
        preset = PRESETS["gcbf"].for_agents(agents)
        task = settings_for(preset)
        assert preset.arena == pytest.approx(5.0 * math.sqrt(2.0 * agents))
        assert preset.obstacle_count == (agents, agents)
        assert preset.agent_radius == preset.core == pytest.approx(5.0 * radius)
        assert 2.0 * (preset.agent_radius + preset.margin) == pytest.approx(5.0 * 4.0 * radius)
        assert preset.core + preset.aside == pytest.approx(5.0 * 4.0 * radius)
        assert task.goal_radius == pytest.approx(5.0 * 2.0 * radius)
        assert task.sensing_radius == pytest.approx(5.0 * sensing)
        assert task.speed_limit == pytest.approx(5.0 * speed / 5.0)
        thrust = 2.0 * task.thrust_limit / task.system.mass
        assert thrust == pytest.approx(5.0 * force / mass / 5.0**2)
        share = preset.arena / (5.0 * side)
        assert task.time_limit == pytest.approx(5.0 * steps * period * share, rel=0.005)
    assert PRESETS["gcbf-free"].for_agents(64).obstacle_count == (0, 0)
    # The area of its rectangles: both sides uniform from 0.1 to 0.5.
    radii = np.concatenate([sample.obstacle_radii for sample in drawn("gcbf", 32, range(40))])
    assert np.mean(math.pi * radii**2) == pytest.approx((5.0 * 0.3) ** 2, rel=0.05)
    assert np.min(math.sqrt(math.pi) * radii) >= 5.0 * 0.1
    assert np.max(math.sqrt(math.pi) * radii) <= 5.0 * 0.5


def cut_off(points, apart, centres, radii, cell):
    """Who is not connected to the outside among the others, one by one, with SciPy's labels."""
    corners = np.concatenate([points, centres - radii[:, None], centres + radii[:, None]])
    low, high = corners.min(axis=0) - 1.0, corners.max(axis=0) + 1.0
    x, y = (np.arange(a, b, cell) for a, b in zip(low, high, strict=True))
    across, along = np.meshgrid(x, y, indexing="ij")
    cells = np.stack([across.ravel(), along.ravel()], axis=-1)
    obstacles = np.all(np.linalg.norm(cells[:, None] - centres, axis=-1) >= radii, axis=1)
    near = np.linalg.norm(cells[:, None] - points, axis=-1)
    found = []
    for agent in range(len(points)):
        free = obstacles & np.all(np.delete(near, agent, axis=1) >= apart, axis=1)
        labels, _ = ndimage.label(free.reshape(across.shape))
        found.append(labels.ravel()[np.argmin(near[:, agent])] != labels[0, 0])
    return np.array(found)


@pytest.mark.parametrize("seed", range(12))
def test_who_is_shut_in_by_the_others_is_found(seed):
    """Rings of parked bodies with and without a gap, bodies that do no harm, and obstacles."""
    rng = np.random.default_rng(seed)
    angles = 2.0 * math.pi * np.arange(9) / 9
    ring = 1.0 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    ring = ring if seed % 3 else ring[:7]
    far = np.array([4.0, 0.0]) + rng.uniform(0.0, 3.0, (30, 2))
    kept = [np.zeros(2), *ring]
    for point in far:
        if np.min(np.linalg.norm(np.array(kept) - point, axis=1)) > 0.62:
            kept.append(point)
    points = np.array(kept)
    centres, radii = np.array([[5.5, 1.5], [-3.0, 0.0]]), np.array([0.4, 0.7])
    points = points[np.all(np.linalg.norm(points[:, None] - centres, axis=-1) > radii + 0.1, 1)]
    found = shut_in(points, 0.5, centres, radii, 0.05)
    truth = cut_off(points, 0.5, centres, radii, 0.05)
    # Never is someone let go who is shut in; a gap narrower than the cells may be missed.
    assert np.all(found | ~truth)
    assert found[0] == bool(seed % 3)
    assert np.count_nonzero(found ^ truth) <= 1


@pytest.mark.parametrize(("name", "agents"), [("swarm", 40), ("gcbf", 24)])
def test_every_goal_can_be_reached_when_the_others_are_parked(name, agents):
    preset = PRESETS[name]
    for sample in drawn(name, agents, range(2)):
        blocked = sample.obstacle_radii + sample.core
        for points in (sample.starts, sample.goals):
            cell = 0.1 if name == "swarm" else 0.2
            assert not cut_off(points, 0.5, sample.obstacles, blocked, cell).any()
    assert preset.parked


def test_who_is_shut_in_is_placed_anew_and_nobody_else():
    """At a density at which some are, which the plain draws do not see."""
    crowded = dataclasses.replace(
        PRESETS["swarm-45"],
        agents=100,
        arena=13.0,
        margin=0.1,
        obstacle_count=(12, 12),
        grows=False,
    )
    changed = 0
    for seed in range(6):
        plain = crowded.sample(np.random.default_rng(seed))
        parked = dataclasses.replace(crowded, parked=True).sample(np.random.default_rng(seed))
        moved = np.any((plain.starts != parked.starts) | (plain.goals != parked.goals), axis=1)
        blocked = plain.obstacle_radii + plain.core
        shut = shut_in(plain.starts, 0.5, plain.obstacles, blocked, 0.15)
        shut |= shut_in(plain.goals, 0.5, plain.obstacles, blocked, 0.15)
        assert moved[shut].all()
        assert moved.any() == shut.any()
        changed += int(moved.sum())
    assert changed


def test_drawing_a_thousand_ends():
    for name in ("swarm", "gcbf", "gcbf-free"):
        (sample,) = drawn(name, 1024, [5])
        assert sample.num_agents == 1024
    # Where everybody is shut in by the obstacles, drawing ends, too, and says so.
    walls = dataclasses.replace(
        PRESETS["gcbf"], agents=2, arena=6.0, obstacle_count=(60, 60), grows=False
    )
    with pytest.raises(ValueError, match="no scenario with 2 agents"):
        walls.sample(np.random.default_rng(0))


def test_every_sample_has_ways_around_the_inflated_obstacles():
    """Fifteen draws of this law, of which three more would wall an agent in."""
    closed = dataclasses.replace(
        PRESETS["paper"],
        open_passages=False,
        obstacle_count=(14, 14),
        arena=4.0,
        obstacle_radius=0.3,
        agent_radius=0.15,
        margin=0.1,
        least_way=2.0,
    )
    for seed in range(15):
        sample = closed.sample(np.random.default_rng(seed), 4)
        assert np.min(apart(sample.obstacles)) < 1.1  # the passages alone do not tell
        inflated = np.full(14, 0.3 + 0.15 + 0.1)
        args = (sample.starts, sample.goals, sample.obstacles, inflated)
        assert way_exists(*args, cell=0.15)


def test_a_density_that_cannot_be_met_is_refused():
    with pytest.raises(ValueError, match=r"no scenario with 40 agents .* fewer agents"):
        dataclasses.replace(PRESETS["paper"], margin=0.3).sample(np.random.default_rng(0), 40)


def test_the_same_stream_gives_the_same_scenario():
    for name in PRESETS:
        first, second = drawn(name, seeds=[7, 7])
        assert first.to_dict() == second.to_dict()
        (other,) = drawn(name, seeds=[8])
        assert first.to_dict() != other.to_dict()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"arena": 0.0}, "arena=0.0"),
        ({"margin": -0.1}, "margin=-0.1"),
        ({"obstacle_count": (4, 3)}, r"obstacle_count=\(4, 3\)"),
        ({"agents": 0}, "agents=0"),
        ({"layout": "ring"}, "layout='ring'"),
        ({"least_way": math.inf}, "least_way=inf"),
    ],
)
def test_presets_that_make_no_sense_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Preset(**values)


def test_unknown_names_and_numbers_are_refused():
    with pytest.raises(ValueError, match=r"preset='papers' is not known; use one of paper, rel"):
        preset_named("papers")
    with pytest.raises(ValueError, match="num_agents=0 must be a whole number"):
        PRESETS["paper"].for_agents(0)


# Ways.


def ring(count, radius, opening=0):
    angles = 2.0 * math.pi * np.arange(count - opening) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


@pytest.mark.parametrize(("opening", "found"), [(0, False), (3, True)])
def test_an_agent_that_is_walled_in_has_no_way(opening, found):
    wall = ring(12, 2.0, opening)
    radii = np.full(len(wall), 0.55)
    inside, outside = np.array([[0.1, 0.0]]), np.array([[4.0, 3.0]])
    assert way_exists(inside, outside, wall, radii, 0.1) is found
    assert way_exists(outside, inside, wall, radii, 0.1) is found
    # Both in the same pocket.
    assert way_exists(inside, np.array([[-0.5, 0.2]]), wall, radii, 0.1)
    # One agent without a way is enough to refuse.
    both = np.concatenate([outside, inside])
    assert way_exists(both, np.array([[5.0, 5.0], [4.0, 4.0]]), wall, radii, 0.1) is found


@given(st.integers(0, 2**32), st.floats(0.2, 0.8))
def test_flooding_finds_what_a_search_finds(seed, density):
    free = np.random.default_rng(seed).random((9, 14)) > density
    free[2, 3] = True
    stack, found = [(2, 3)], set()
    while stack:
        row, column = cell = stack.pop()
        if 0 <= row < 9 and 0 <= column < 14 and free[cell] and cell not in found:
            found.add(cell)
            stack += [(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)]
    reached = flood(free, (2, 3))
    assert {tuple(cell) for cell in np.argwhere(reached)} == found


# One scenario.


def test_a_scenario_round_trips_through_json(tmp_path):
    for name in PRESETS:
        (first,) = drawn(name, seeds=[3])
        path = tmp_path / "sub" / f"{name}.json"
        first.save(path)
        second = Scenario.load(path)
        for field in dataclasses.fields(Scenario):
            ours, theirs = (getattr(sample, field.name) for sample in (first, second))
            np.testing.assert_array_equal(ours, theirs)
        assert [file.name for file in path.parent.glob(f"*{name}*")] == [path.name]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "bad.json is not a scenario: Expecting"),
        ("[]", "bad.json must be an object"),
        ('{"format": "other"}', "bad.json: 'format' is 'other' and must be 'lagros-scenario-1'"),
        ('{"format": "lagros-scenario-1", "starts": []}', "bad.json has no entry 'headings'"),
    ],
)
def test_files_that_are_no_scenario_are_refused(tmp_path, text, message):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        Scenario.load(path)


def test_a_scenario_with_a_nan_is_refused_when_read(tmp_path):
    path = tmp_path / "nan.json"
    scenario().save(path)
    record = json.loads(path.read_text())
    record["goals"][0][0] = math.nan
    path.write_text(json.dumps(record))
    with pytest.raises(ValueError, match="goals"):
        Scenario.load(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"goals": [[3.0, 0.0]]}, r"goals has shape \(1, 2\).*\(2, 2\)"),
        ({"headings": [0.0]}, "headings has shape"),
        ({"obstacles": [[2.0, math.nan]]}, "obstacles has shape .* finite"),
        ({"obstacle_radii": [0.5, 0.5]}, "obstacles has shape"),
        ({"obstacle_radii": [0.0]}, r"obstacle_radii=\[0.0\] must be > 0"),
        ({"agent_radius": 0.0}, "agent_radius=0.0"),
        ({"core_radius": -1.0}, "core_radius=-1.0"),
        ({"starts": [[0.0, 0.0], [0.4, 0.0]]}, r"agents 0 and 1 start 0.400 m apart.* 0.5 m"),
        ({"starts": [[0.0, 0.0], [2.0, 1.3]]}, "agent 1 starts 0.200 m from .* obstacle 0"),
        (
            {"starts": [], "headings": [], "goals": []},
            "agents=0",
        ),
    ],
)
def test_scenarios_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        scenario(**changes)


def test_a_scenario_keeps_its_own_read_only_copies():
    starts = np.array([[0.0, 0.0], [1.0, 0.0]])
    made = scenario(starts=starts)
    starts[:] = 9.0
    assert made.starts[1, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        made.starts[0, 0] = 5.0


# Drawing is quick, and what cannot be is refused at once.


def by_the_book(rng, preset, count):
    """Return obstacles, starts and goals as the first accepted draws, looked for one by one."""

    def clear(point, others, distance):
        squares = [(point[0] - x) ** 2 + (point[1] - y) ** 2 for x, y in others]
        return all(square >= distance**2 for square in squares)

    room = preset.core + preset.margin
    gap = 2.0 * (preset.obstacle_radius + room)
    apart = 2.0 * (preset.agent_radius + preset.margin)
    obstacles, starts, goals = [], [], []
    while len(obstacles) < count:
        draws = rng.uniform(0.0, preset.arena, (16, 2))
        obstacles += [draw for draw in draws if clear(draw, obstacles, gap)][:1]
    clearance = preset.obstacle_radius + room
    while len(starts) < preset.agents:
        for start, goal in zip(*rng.uniform(0.0, preset.arena, (2, 16, 2)), strict=True):
            ends = ((start, starts), (goal, goals))
            fits = all(
                clear(end, obstacles, clearance) and clear(end, placed, apart)
                for end, placed in ends
            )
            if fits and np.sum((start - goal) ** 2) >= preset.least_way**2:
                starts.append(start)
                goals.append(goal)
                break
    return np.array(obstacles), np.array(starts), np.array(goals)


@pytest.mark.parametrize("agents", [1, 6, 12])
def test_the_first_draw_that_fits_is_taken_to_the_bit(agents):
    preset = dataclasses.replace(PRESETS["paper"], agents=agents, obstacle_count=(3, 3))
    agreed = 0
    for seed in range(12):
        found = preset.sample(np.random.default_rng(seed))
        rng = np.random.default_rng(seed)
        assert rng.integers(3, 3, endpoint=True) == 3
        obstacles, starts, goals = by_the_book(rng, preset, 3)
        # A scenario that took a second attempt began anew in between.
        if np.array_equal(found.obstacles, obstacles) and np.array_equal(found.starts, starts):
            assert np.array_equal(found.goals, goals)
            agreed += 1
    assert agreed >= 8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"agents": 60}, "no more than .* agents fit"),
        ({"agents": 1000, "arena": 1.8}, "no more than .* agents fit"),
        ({"obstacle_count": (40, 60)}, "no more than .* obstacles fit"),
        ({"least_way": 7.1}, "longer than the diagonal"),
        ({"margin": 1e8}, "no more than"),
        ({"agent_radius": 1e200}, "no more than"),
    ],
)
def test_what_the_arena_cannot_hold_is_refused_before_the_first_draw(change, message):
    preset = dataclasses.replace(PRESETS["paper"], **change)
    rng = np.random.default_rng(0)
    before = rng.bit_generator.state
    with pytest.raises(ValueError, match=message):
        preset.sample(rng)
    assert rng.bit_generator.state == before


def test_the_bound_of_points_apart_refuses_none_that_fit():
    for side in range(1, 9):
        # A square lattice and a hexagonal one, which is the densest there is.
        assert most_apart(side - 1.0, 1.0) >= side**2
        rows = 1 + int((side - 1.0) / (math.sqrt(3.0) / 2.0))
        points = sum(side if row % 2 == 0 else side - 1 for row in range(rows))
        assert most_apart(side - 1.0, 1.0) >= points
    assert most_apart(0.0, 1.0) == 1


def test_a_grid_of_too_many_cells_is_named():
    centres = np.array([[0.0, 0.0], [5e4, 0.0]])
    ends = np.array([[-4e4, 0.0]]), np.array([[9e4, 0.0]])
    with pytest.raises(ValueError, match="2 overlapping obstacles"):
        way_exists(*ends, centres, np.full(2, 3e4), 0.15)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_what_is_drawn_is_what_a_check_would_take(name):
    preset = PRESETS[name]
    for seed in range(20):
        drawn = preset.sample(np.random.default_rng(seed))
        # Built anew from its own numbers, which looks at all of them.
        assert Scenario(**drawn.to_dict()) == drawn
        assert pickle.loads(pickle.dumps(drawn)) == drawn
        for array in (drawn.starts, drawn.goals, drawn.obstacles, drawn.headings):
            with pytest.raises(ValueError, match="read-only"):
                array[:] = 0.0
