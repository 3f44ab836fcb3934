"""Frames of a spacecraft world: what is where, in which colour."""

import sys

import numpy as np
import pytest

from lagros_envs import spacecraft_v0
from lagros_envs.tasks.spacecraft.scenarios import Scenario

pygame = pytest.importorskip("pygame")

from lagros_envs.canvas import BLUE, VERMILLION  # noqa: E402
from lagros_envs.tasks.spacecraft.draw import BORDER, PANEL, VIEW  # noqa: E402

STILL = np.zeros(8)
SIDE = 5.0 + 2.0 * BORDER  # of the view of an arena of 5 m [m]


def drawn(starts, goals, actions=None, obstacles=(), steps=0, heading=0.0, **options):
    env = spacecraft_v0.parallel_env(
        num_agents=len(starts), preset="paper", render_mode="rgb_array"
    )
    radii = np.full(len(obstacles), 0.5)
    scenario = Scenario(starts, np.full(len(starts), heading), goals, obstacles, radii)
    env.reset(seed=0, options={"scenario": scenario, **options})
    for _ in range(steps):
        env.step(dict.fromkeys(env.agents, STILL if actions is None else actions))
    frame = env.render()
    env.close()
    return frame


def place(point):
    """Pixel of a point of the arena (row, column)."""
    column, row = (np.asarray(point) + BORDER) * VIEW / SIDE
    return round(VIEW - row), round(column)


def pixels(frame, colour):
    """Rows and columns of the scene where the colour is."""
    return np.nonzero(np.all(frame[:, :VIEW] == colour, axis=-1))


def test_a_frame_is_an_image():
    frame = drawn([[1.0, 1.0]], [[4.0, 4.0]])
    assert frame.shape == (VIEW, VIEW + PANEL, 3)
    assert frame.dtype == np.uint8
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) > 30


def test_agents_goals_and_obstacles_are_where_they_are():
    frame = drawn([[1.0, 1.0]], [[4.0, 1.5]], obstacles=[[2.0, 4.0]])
    rows, columns = pixels(frame, BLUE)
    near = np.hypot(rows - place([1.0, 1.0])[0], columns - place([1.0, 1.0])[1]) < 30
    assert near.sum() > 100
    white = frame[place([2.0, 2.5])]
    obstacle = frame[place([2.0, 4.0])]
    goal = frame[place([4.1, 1.6])]
    assert obstacle.max() < 170
    assert np.ptp(obstacle.astype(int)) == 0
    assert goal[2] > goal[0]  # bluish
    assert white.min() > 240
    # 0.5 m in the picture.
    row, _ = place([2.0, 4.0])
    grey = np.all(frame[row, :VIEW] == obstacle, axis=-1)
    assert grey.sum() == pytest.approx(1.0 * VIEW / SIDE, abs=4)


@pytest.mark.parametrize(
    ("fires", "side"),
    [
        ([0, 1], [1.0, 0.0]),
        ([4, 5], [-1.0, 0.0]),
        ([2, 3], [0.0, 1.0]),
        ([6, 7], [0.0, -1.0]),
    ],
)
@pytest.mark.parametrize("heading", [0.0, 0.5 * np.pi, 2.0])
def test_plumes_leave_against_the_force(fires, side, heading):
    """So that the agent moves away from its plume."""
    actions = np.isin(np.arange(8), fires).astype(float)
    env = spacecraft_v0.parallel_env(num_agents=1, render_mode="rgb_array")
    start = np.array([[2.5, 2.5]])
    env.reset(seed=0, options={"scenario": Scenario(start, [heading], start + 2.0, [], [])})
    env.step({"agent_0": actions})
    moved = env.states[0, :2] - start[0]
    rows, columns = pixels(env.render(), VERMILLION)
    centre = place(env.states[0, :2])
    plume = np.array([columns.mean() - centre[1], centre[0] - rows.mean()])
    cosine = plume @ moved / np.linalg.norm(plume) / np.linalg.norm(moved)
    assert cosine == pytest.approx(-1.0, abs=0.02)
    first = np.array([np.cos(heading), -np.sin(heading)])
    second = np.array([np.sin(heading), np.cos(heading)])
    outward = side[0] * first + side[1] * second
    assert plume @ outward / np.linalg.norm(plume) == pytest.approx(1.0, abs=0.02)
    env.close()


def test_each_thruster_turns_the_body_as_its_place_says():
    """The torque about the middle, from where the plume is drawn, has the sign of the model."""
    for thruster in range(8):
        env = spacecraft_v0.parallel_env(num_agents=1, render_mode="rgb_array")
        start = np.array([[2.5, 2.5]])
        env.reset(seed=0, options={"scenario": Scenario(start, [0.3], start + 2.0, [], [])})
        env.step({"agent_0": np.eye(8)[thruster]})
        state = env.states[0]
        rows, columns = pixels(env.render(), VERMILLION)
        centre = place(state[:2])
        lever = np.array([columns.mean() - centre[1], centre[0] - rows.mean()])
        force = state[3:5]
        counterclockwise = lever[0] * force[1] - lever[1] * force[0]
        # A positive heading turns clockwise.
        assert np.sign(counterclockwise) == -np.sign(state[5])
        env.close()


def test_a_collision_is_marked():
    apart = drawn([[1.0, 2.0], [3.0, 2.0]], [[4.0, 4.0], [4.0, 1.0]])
    assert pixels(apart, VERMILLION)[0].size == 0
    env = spacecraft_v0.parallel_env(num_agents=3, render_mode="rgb_array")
    scenario = Scenario(
        [[1.0, 2.0], [1.52, 2.0], [4.0, 1.0]], [0.0, 0.0, 0.0], [[4, 4], [4, 2], [2, 1]], [], []
    )
    env.reset(seed=0, options={"scenario": scenario})
    actions = {agent: np.zeros(8) for agent in env.agents}
    actions["agent_0"][[4, 5]] = 3.0
    env.step(actions)
    env.step(dict.fromkeys(env.agents, STILL))
    rows, columns = pixels(env.render(), VERMILLION)
    assert rows.size > 50
    assert columns.max() < place([2.2, 2.0])[1]
    env.close()


def test_the_nominal_is_drawn():
    starts, goals = [[1.0, 1.0]], [[4.0, 1.0]]
    nominal = np.zeros((451, 1, 6))
    nominal[:, 0, :2] = [2.5, 4.0]
    frames = [drawn(starts, goals, **options) for options in ({}, {"nominal": nominal})]
    rows, columns = np.nonzero(np.any(frames[0] != frames[1], axis=-1)[:, :VIEW])
    row, column = place([2.5, 4.0])
    assert rows.mean() == pytest.approx(row, abs=2)
    assert columns.mean() == pytest.approx(column, abs=2)


def test_what_is_left_of_a_plan_is_as_wide_as_the_tube():
    """The band at the middle of the way, before the plan has passed there and after."""
    nominal = np.zeros((451, 1, 6))
    nominal[:, 0, 0] = np.linspace(1.0, 4.0, 451)
    nominal[:, 0, 1] = 3.5
    widths = []
    for steps in (0, 300):
        frame = drawn([[1.0, 1.0]], [[4.0, 1.0]], nominal=nominal, steps=steps)
        row, column = place([2.5, 3.5])
        strip = frame[row - 30 : row + 31, column].astype(int)
        widths.append(np.sum(np.ptp(strip, axis=1) > 20))
    # At 22.5 s the radius of the published tube is 0.125 m, to a part in a thousand.
    assert widths[0] == pytest.approx(0.25 * VIEW / SIDE, abs=3)
    assert widths[1] == 0


def test_an_agent_that_has_arrived_has_a_dark_rim():
    def dark(start, goal):
        frame = drawn([start], [goal])
        rows, columns = np.nonzero(np.all(frame[:, :VIEW] < 90, axis=-1))
        row, column = place(start)
        apart = np.hypot(rows - row, columns - column) * SIDE / VIEW
        return np.sum(np.abs(apart - 0.25) < 0.03)

    assert dark([2.0, 2.0], [2.1, 2.0]) > 5 * dark([2.0, 2.0], [4.0, 2.0])


def test_the_view_widens_for_an_agent_that_leaves():
    frame = drawn([[1.0, 1.0]], [[9.0, 1.0]])
    assert pixels(frame, BLUE)[0].size > 30
    # The goal at 9 m is in the picture, the arena no longer fills it.
    shares = np.all(frame[:, :VIEW] == 248, axis=-1).mean()
    assert shares < 0.35


def test_a_window_opens_and_closes(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = spacecraft_v0.parallel_env(num_agents=2, render_mode="human")
    env.reset(seed=0)
    assert pygame.display.get_surface().get_size() == (VIEW + PANEL, VIEW)
    env.step(dict.fromkeys(env.agents, STILL))
    assert env.render() is None
    env.close()
    assert not pygame.display.get_init()


def test_drawing_without_pygame_names_the_extra(monkeypatch):
    env = spacecraft_v0.parallel_env(num_agents=2, render_mode="rgb_array")
    env.reset(seed=0)
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ImportError, match=r"pip install \"lagros\[render\]\""):
        env.render()


def test_render_without_a_mode_warns_and_returns_none():
    env = spacecraft_v0.parallel_env(num_agents=2)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without a render mode"):
        assert env.render() is None


def test_a_crowd_is_drawn_where_it_is_and_as_it_fares():
    env = spacecraft_v0.parallel_env(80, "swarm", render_mode="rgb_array")
    env.reset(seed=0)
    world = env.episode.world
    world.collision_time[0, 3] = 1.0
    world.success_time[0, 4] = 1.0
    frame = env.render()
    ends = np.concatenate([[[0.0, 0.0]], [[env.preset.arena] * 2], world.goals[:, 0].T])
    ends = np.concatenate([ends, world.parts[:2, 0].T])
    low, high = ends.min(axis=0) - BORDER, ends.max(axis=0) + BORDER
    side = np.max(high - low)
    corner = 0.5 * (low + high) - 0.5 * side

    def shown(agent):
        column, row = (world.parts[:2, 0, agent] - corner) * VIEW / side
        return frame[round(VIEW - row), round(column)].tolist()

    assert shown(0) == list(BLUE)
    assert shown(6) == list(BLUE)
    assert shown(3) == list(VERMILLION)
    assert pixels(frame, VERMILLION)[0].size > 20
    env.close()


def test_infos_of_a_crowd_are_each_agents_own():
    env = spacecraft_v0.parallel_env(40, "swarm", disturbance="uniform")
    _, infos = env.reset(seed=0)
    *_, infos = env.step(dict.fromkeys(env.agents, STILL))
    measures = env.episode.world.info()
    for index, agent in enumerate(env.agents):
        for name, value in infos[agent].items():
            assert type(value) in (bool, float, np.ndarray)
            np.testing.assert_array_equal(value, measures[name][0, index])
    infos["agent_0"]["disturbance"][:] = 9.0
    assert not np.any(infos["agent_1"]["disturbance"] == 9.0)
