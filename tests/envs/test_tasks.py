"""The one environment of single-body tasks: shipped ones, one of a file, and their vector forms."""

import copy
import math
import pickle
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from lagros_envs import find_task
from lagros_envs.env import TaskEnv
from lagros_envs.rules import StepRules
from lagros_envs.vector import TaskVectorEnv
from tests.found import SINGLE_BODY, task_of

FILE = Path(__file__).parent / "files" / "puck.py"
PUCK = find_task(str(FILE))
SWING = find_task(str(FILE.with_name("swing.py")))
TASKS = {(task := task_of(text)).name: task for text in SINGLE_BODY} | {
    "puck": PUCK,
    "swing": SWING,
}
NAMES = list(TASKS)
# Two that stand still in the way, and room for a third.
DISCS = [[1.0, 0.0, 0.2], [2.0, 1.0, 0.3]]


def play(env, seed, steps=30):
    """Return all that an environment says over some steps, and stop where an episode ends."""
    said = [env.reset(seed=seed)]
    rng = np.random.default_rng(seed)
    shape = env.action_space.shape
    for _ in range(steps):
        said.append(env.step(rng.uniform(-1.0, 1.0, shape).astype(np.float32)))
        if np.any(said[-1][2]) or np.any(said[-1][3]):
            break
    return said


def same(first, second):
    """Tell whether two values are equal, arrays entry by entry, however deep they lie."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[k], second[k]) for k in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(same, first, second))
    return np.array_equal(first, second, equal_nan=True)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.* value is -?infinity")
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
def test_the_checkers_of_other_libraries_find_nothing(name):
    env = gym.make(TASKS[name].env_id, render_mode="rgb_array").unwrapped
    check_env(env)
    pytest.importorskip("stable_baselines3.common.env_checker").check_env(env)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("kind", ["none", "uniform", "gust"])
@pytest.mark.parametrize("name", NAMES)
def test_each_world_flies_the_episode_of_the_single_environment(name, kind, compiled):
    if compiled:
        pytest.importorskip("numba")
    task = TASKS[name]
    env = TaskEnv(kind, task=task, compiled=compiled)
    worlds = TaskVectorEnv(3, kind, task=task, compiled=False, autoreset_mode="disabled")
    firsts = [env.reset(seed=5 + world) for world in range(3)]
    observations, info = worlds.reset(seed=5)
    for world, (first, said) in enumerate(firsts):
        assert same(first, observations[world])
        assert same(said, {key: value[world] for key, value in info.items()})
    rng = np.random.default_rng(0)
    # `env` has begun what the last world flies.
    for _ in range(25):
        actions = rng.uniform(-1.0, 1.0, worlds.action_space.shape).astype(np.float32)
        *batch, info = worlds.step(actions)
        *single, said = env.step(actions[2])
        assert same(single, [part[2] for part in batch])
        assert same(said, {key: value[2] for key, value in info.items()})
        if single[2] or single[3]:
            break


@pytest.mark.parametrize("name", NAMES)
def test_a_seed_is_an_episode_and_a_copy_goes_its_own_way(name):
    task = TASKS[name]
    env = TaskEnv("uniform", task=task)
    said = play(env, 3)
    assert same(said, play(env, 3))
    assert same(said, play(TaskEnv("uniform", settings=task), 3))
    assert same(said, play(gym.make(task.env_id, disturbance="uniform").unwrapped, 3))
    assert not same(said[0], env.reset(seed=4))
    for twin in (copy.copy(env), copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        env.reset(seed=9)
        assert same(play(twin, 3), said)
    worlds = TaskVectorEnv(2, "uniform", task=task)
    assert same(play(pickle.loads(pickle.dumps(worlds)), 3), play(worlds, 3))


@pytest.mark.parametrize("name", NAMES)
def test_parts_of_an_observation_lie_where_the_layout_says(name):
    task = TASKS[name]
    env = TaskEnv(task=task)
    observation, _ = env.reset(seed=1)
    parts = gym.spaces.unflatten(env.named_space, observation)
    layout = task.layout
    assert observation.shape == (layout.size,)
    np.testing.assert_array_equal(parts["state"], observation[layout.state])
    np.testing.assert_array_equal(parts["goal"], observation[layout.goal])
    np.testing.assert_array_equal(parts["initial_state"], observation[layout.initial_state])
    assert parts["time"] == observation[layout.time] == 0.0
    np.testing.assert_allclose(env.scenario.goal, parts["goal"], rtol=1e-6)
    if task.most_discs:
        discs = layout.discs_of(observation)
        np.testing.assert_array_equal(parts["discs"], discs)
        found = discs[discs[:, 2] > 0.0]
        np.testing.assert_allclose(env.scenario.discs, found, rtol=1e-6)
        assert not discs[len(found) :].any()


@pytest.mark.parametrize("name", NAMES)
def test_actions_are_scaled_and_clipped_as_the_task_says(name):
    task = TASKS[name]
    env = TaskEnv(task=task)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    parts = (task.control_centre, task.control_scale, task.control_low, task.control_high)
    for size in (0.3, 1.0, 50.0):
        action = size * rng.uniform(-1.0, 1.0, env.action_space.shape)
        expected = [
            min(max(centre + scale * one, low), high)
            for one, centre, scale, low, high in zip(action.tolist(), *parts, strict=True)
        ]
        np.testing.assert_array_equal(task.control(action), expected)
        np.testing.assert_array_equal(env._control(action), expected)
    inside = rng.uniform(-0.5, 0.5, (4, *env.action_space.shape))
    np.testing.assert_allclose(task.action(task.control(inside)), inside, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_the_way_between_two_instants_touches_as_its_points_do(seed):
    """Against many points of each way, but for grazes that rounding decides."""
    rng = np.random.default_rng(seed)
    rules = StepRules(PUCK)
    share = np.linspace(0.0, 1.0, 4001)[:, None]
    seen = set()
    for _ in range(150):
        start, end = rng.uniform(-1.5, 1.5, (2, 2))
        if rng.random() < 0.2:
            end = start
        discs = np.column_stack([rng.uniform(-1.0, 1.0, (3, 2)), rng.uniform(0.0, 0.5, 3)])
        discs[rng.integers(3), 2] = 0.0  # a row of nothing
        gaps = np.linalg.norm((start + share * (end - start))[:, None] - discs[:, :2], axis=-1)
        real = discs[:, 2] > 0.0
        deepest = np.max((discs[:, 2] + PUCK.body_radius - gaps.min(axis=0))[real])
        if abs(deepest) < 1e-3:
            continue
        given = [(x, y, (r + PUCK.body_radius) ** 2 if r else 0.0) for x, y, r in discs.tolist()]
        found = rules.touching(start.tolist(), end.tolist(), given)
        assert found == (deepest > 0.0)
        arrays = [[np.array([one]) for one in disc] for disc in given]
        ways = [[np.array([one]) for one in place] for place in (start, end)]
        assert bool(rules.touching(*ways, arrays)[0]) == found
        seen.add(bool(found))
    assert seen == {True, False}


def crossing(compiled):
    """Return an environment whose puck is past a disc after one step, and never in it."""
    env = TaskEnv(task=PUCK, compiled=compiled)
    start = [0.5, 0.0, 10.0, 0.0]
    env.reset(options={"initial_state": start, "goal": [1.5, 0.0, 10.0, 0.0], "discs": DISCS})
    return env


@pytest.mark.parametrize("compiled", [False, True])
def test_a_disc_that_is_crossed_between_instants_ends_the_episode(compiled):
    if compiled:
        pytest.importorskip("numba")
    env = crossing(compiled)
    observation, _, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert np.linalg.norm(observation[:2] - DISCS[0][:2]) > 0.2 + PUCK.body_radius
    assert (terminated, truncated) == (True, False)
    assert info["collided"] is True
    # It has come to the goal, but not without collision.
    assert info["inside_tube"] is True
    assert info["success"] is info["is_success"] is False
    calm = TaskEnv(task=PUCK)
    start = {"initial_state": [0.5, 0.0, 10.0, 0.0], "goal": [1.5, 0.0, 10.0, 0.0], "discs": []}
    calm.reset(options=start)
    *_, terminated, truncated, info = calm.step(np.zeros(2, np.float32))
    assert (terminated, info["collided"], info["success"]) == (False, False, True)


def test_a_collision_is_not_forgotten_in_a_batch_that_goes_on():
    worlds = TaskVectorEnv(2, task=PUCK, compiled=False, autoreset_mode="disabled")
    start = np.array([[0.5, 0.0, 10.0, 0.0], [0.0, 3.0, 0.0, 0.0]])
    discs = np.array([DISCS, np.zeros((2, 3))])
    worlds.reset(seed=0, options={"initial_state": start, "discs": discs})
    for _ in range(3):
        *_, terminated, _, info = worlds.step(np.zeros((2, 2), np.float32))
        assert terminated.tolist() == info["collided"].tolist() == [True, False]


def test_effort_is_counted_from_the_centre_and_a_fall_ends_the_episode():
    env = TaskEnv(task=PUCK)
    env.reset(options={"initial_state": [4.9, 0.0, 9.0, 0.0], "discs": []})
    *_, terminated, _, info = env.step(np.float32([0.5, -1.0]))
    # Of the scales 2 and 3, clipped at -3, which is 2.8 from the centre -0.2.
    assert info["effort"] == pytest.approx(0.1 * (1.0**2 + 2.8**2))
    assert terminated
    assert info["fallen"] is True
    assert info["collided"] is False


def test_the_state_is_kept_where_it_cannot_be_integrated():
    unbounded = replace(PUCK)
    object.__setattr__(unbounded, "control_high", (math.inf, math.inf))
    env = TaskEnv(settings=unbounded)
    env.reset(seed=0)
    before = env.state
    _, reward, terminated, _, info = env.step(np.array([1e200, 0.0]))
    np.testing.assert_array_equal(env.state, before)
    assert terminated
    assert info["fallen"]
    assert math.isfinite(reward)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"discs": [[0.0, 0.0]]}, r"shape \(1, 2\).*x, y and radius of each disc"),
        ({"discs": np.ones((4, 3))}, r"shape \(4, 3\)"),
        ({"discs": [[0.0, 0.0, -1.0]]}, "holds the radius -1; it must be >= 0"),
        ({"initial_state": [6.0, 0.0, 0.0, 0.0]}, "episode of puck has already ended"),
        ({"goal": 1.0}, r"shape \(\)"),
        (
            {"obstacles": []},
            "its entries may be initial_state, initial_error, goal, nominal, discs",
        ),
    ],
)
def test_options_that_cannot_be_are_refused(options, message):
    env = TaskEnv(task=PUCK)
    env.reset(seed=0)
    before = env.state
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    np.testing.assert_array_equal(env.state, before)


def test_discs_of_one_world_are_not_looked_at_where_it_is_not_started():
    worlds = TaskVectorEnv(2, task=PUCK, compiled=False)
    worlds.reset(seed=0)
    discs = np.full((2, 1, 3), np.nan)
    discs[1] = 3.0, 3.0, 0.1
    mask = np.array([False, True])
    before = worlds._kept[:, 0].copy()
    observations, _ = worlds.reset(options={"discs": discs, "reset_mask": mask})
    np.testing.assert_array_equal(worlds._kept[:, 0], before)
    np.testing.assert_allclose(observations[1, -9:-6], [3.0, 3.0, 0.1])


def test_settings_change_the_task_and_its_time_limit():
    env = gym.make(PUCK.env_id, settings={"time_limit": 0.4, "rink": 9.0}, max_episode_steps=4)
    env.reset(seed=0, options={"initial_state": [8.0, 0.0, 0.0, 0.0], "discs": []})
    ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(4)]
    assert ends == [(False, False)] * 3 + [(False, True)]
    with pytest.raises(ValueError, match="pass max_episode_steps=40"):
        gym.make(PUCK.env_id, settings={"time_limit": 4.0})
    with pytest.raises(ValueError, match="settings has no entry 'rinks'"):
        gym.make(PUCK.env_id, settings={"rinks": 9.0})


@pytest.mark.parametrize("name", [name for name in NAMES if name != "cartpole"])
def test_what_is_drawn_shows_body_goal_and_discs(name):
    env = TaskEnv("uniform", task=TASKS[name], render_mode="rgb_array")
    env.reset(seed=0)
    empty = env.render()
    assert empty.shape == (500, 800, 3)
    for _ in range(4):
        env.step(np.zeros(env.action_space.shape, np.float32))
    assert np.any(env.render() != empty)
    env.close()


@pytest.mark.parametrize(
    ("names", "unit", "squared"),
    [
        ((), "", ""),
        (("F [N]", "G [N]"), "N", "N²"),
        (("a [m/s^2]", "b [m/s^2]"), "m/s^2", "(m/s^2)²"),
        (("tau [N m]", "sigma [N m]"), "N m", "(N m)²"),
        (("a [m/s^2]", "omega [rad/s]"), "", ""),
    ],
)
def test_the_unit_of_effort_is_that_of_the_controls_squared(names, unit, squared):
    task = type("Named", (type(PUCK),), {"control_names": names})()
    assert (task.control_unit, task.squared_unit) == (unit, squared)
