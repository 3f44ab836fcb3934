"""The cart-pole environment through Gymnasium, and the definitions of its task."""

import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import lagros_envs  # noqa: F401 - registers the ids
from lagros_envs.disturbances import KINDS, OPEN_LOOP
from lagros_envs.dynamics import hold_step
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tube import PaperTube

METRIC = np.diag([1.0, 8.0, 0.5, 2.0])
UPRIGHT = np.zeros(4)
ZERO = np.zeros(1, np.float32)


def cartpole(**settings):
    return gym.make("lagros/CartPole-v0", **settings).unwrapped


def roll_out(env, policy, **reset):
    """Return the episode as one list of (obs, reward, terminated, truncated, info, x, u)."""
    observation, info = env.reset(**reset)
    episode = [(observation, 0.0, False, False, info, env.state, 0.0)]
    while not (episode[-1][2] or episode[-1][3]):
        action = policy(env.state, env.scenario.goal)
        episode.append((*env.step(action), env.state, 40.0 * float(action[0])))
    return episode


# Imports.


def test_importing_and_making_imports_no_heavy_library(run_python):
    printed = run_python(
        "import sys, gymnasium, lagros_envs\n"
        "env = gymnasium.make('lagros/CartPole-v0', disturbance='gust')\n"
        "env.reset(seed=0); env.step(env.action_space.sample())\n"
        # Compiled, many worlds need numba, which imports scipy.
        "envs = gymnasium.make_vec('lagros/CartPole-v0', num_envs=3, compiled=False)\n"
        "envs.reset(seed=0); envs.step(envs.action_space.sample())\n"
        "heavy = {'torch', 'pygame', 'scipy', 'cvxpy', 'matplotlib', 'stable_baselines3'}\n"
        "print(sorted(heavy & set(sys.modules)), 'lagros_envs.tasks.cartpole.draw' in sys.modules)"
    )
    assert printed == "[] False\n"


# Starts and observations.


def test_starts_and_goals_follow_the_paper():
    env = cartpole()
    starts, goals = [], []
    for seed in range(600):
        env.reset(seed=seed)
        starts.append(env.scenario.initial_state)
        goals.append(env.scenario.goal)
        np.testing.assert_array_equal(env.state, env.scenario.initial_state)
    starts, goals = np.array(starts), np.array(goals)
    assert not np.any(starts[:, [0, 2, 3]])
    assert not np.any(goals[:, 1:])
    for values, limit in ((starts[:, 1], math.pi / 3), (goals[:, 0], 5.0)):
        assert np.all(np.abs(values) <= limit)
        # Uniform: a tenth in every tenth, up to four standard deviations.
        counts, _ = np.histogram(values, bins=10, range=(-limit, limit))
        assert np.all(np.abs(counts - 60) < 4 * math.sqrt(600 * 0.1 * 0.9))
    assert abs(np.corrcoef(starts[:, 1], goals[:, 0])[0, 1]) < 4 / math.sqrt(600)


def test_observation_names_its_parts(hold):
    env = cartpole(disturbance="uniform")
    for index, (observation, *_, state, _) in enumerate(roll_out(env, hold, seed=1)):
        parts = spaces.unflatten(env.named_space, observation)
        assert list(parts) == ["state", "goal", "initial_state", "time"]
        np.testing.assert_array_equal(parts["state"], state.astype(np.float32))
        np.testing.assert_array_equal(parts["goal"], env.scenario.goal.astype(np.float32))
        start = env.scenario.initial_state.astype(np.float32)
        np.testing.assert_array_equal(parts["initial_state"], start)
        assert parts["time"][0] == pytest.approx(0.1 * index, rel=1e-6)
        assert observation.dtype == np.float32
        assert observation.shape == (13,)
        flat = spaces.flatten(env.named_space, parts)
        np.testing.assert_array_equal(flat, observation)


def test_options_set_start_and_goal():
    env = cartpole()
    start, goal = np.array([1.0, 0.2, -0.3, 0.4]), np.array([-2.0, 0.1, 0.0, 0.0])
    observation, _ = env.reset(seed=0, options={"initial_state": start, "goal": goal})
    np.testing.assert_allclose(observation[:4], start, rtol=1e-6)
    np.testing.assert_allclose(observation[4:8], goal, rtol=1e-6)
    np.testing.assert_allclose(observation[8:12], start, rtol=1e-6)
    start[:] = 99.0  # the environment keeps its own copy
    assert env.scenario.initial_state[0] == 1.0
    observation, _ = env.reset(seed=0, options={"goal": 3.5})
    np.testing.assert_array_equal(observation[4:8], [3.5, 0.0, 0.0, 0.0])


def test_options_do_not_change_what_is_drawn():
    env = cartpole(disturbance="uniform")
    env.reset(seed=5)
    drawn, pushes = env.scenario, [env.step(ZERO)[4]["disturbance"] for _ in range(5)]
    env.reset(seed=5, options={"goal": 1.0})
    np.testing.assert_array_equal(env.scenario.initial_state, drawn.initial_state)
    again = [env.step(ZERO)[4]["disturbance"] for _ in range(5)]
    np.testing.assert_array_equal(pushes, again)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"initial_state": np.zeros(3)}, r"options\['initial_state'\]"),
        ({"initial_state": [0.0, math.nan, 0.0, 0.0]}, "finite"),
        ({"initial_state": [0.0, 1.6, 0.0, 0.0]}, "already fallen"),
        ({"goal": np.zeros((4, 1))}, r"options\['goal'\]"),
        ({"goal": math.inf}, "finite"),
        ({"nominal": np.zeros((90, 4))}, r"\(91, 4\)"),
        ({"nominal": np.full((91, 4), np.nan)}, "finite"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        cartpole().reset(seed=0, options=options)


# One step.


def test_a_step_holds_force_and_disturbance():
    env = cartpole(disturbance="uniform", disturbance_bound=0.6)
    env.reset(seed=4)
    for force in (3.0, -20.0, 55.0, 0.0):
        before = env.state
        info = env.step(np.array([force / 40.0]))[4]
        push = info["disturbance"]
        assert 0.0 < np.linalg.norm(push) <= 0.6
        expected = hold_step(CartPole(), before, np.array([force]), 0.1, push)
        np.testing.assert_allclose(env.state, expected, rtol=1e-12, atol=1e-12)


def test_actions_beyond_one_are_applied_unless_a_limit_is_set():
    start = {"initial_state": [0.0, 0.1, 0.0, 0.0], "goal": 0.0}
    reached = {}
    for limit in (None, 60.0, 10.0):
        env = cartpole(settings=CartPoleSettings(force_limit=limit))
        for action in (2.0, -2.0):
            env.reset(seed=0, options=start)
            info = env.step(np.array([action], np.float32))[4]
            reached[limit, action] = env.state, info["effort"]
    for sign in (1.0, -1.0):
        for limit, force in ((None, 80.0), (60.0, 60.0), (10.0, 10.0)):
            state, effort = reached[limit, 2.0 * sign]
            held = np.array([sign * force])
            expected = hold_step(CartPole(), np.array(start["initial_state"]), held, 0.1)
            np.testing.assert_allclose(state, expected, rtol=1e-12)
            assert effort == pytest.approx(0.1 * force**2)


def test_force_scale_is_the_force_of_the_action_one():
    env = cartpole(settings=CartPoleSettings(force_scale=7.0))
    env.reset(seed=0)
    assert env.step(np.ones(1))[4]["effort"] == pytest.approx(0.1 * 49.0)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(2), r"shape \(2,\); it must be numbers of shape \(1,\), the force"),
        (np.zeros((1, 1)), r"shape \(1, 1\)"),
        (0.5, r"shape \(\)"),
        (np.array([np.nan]), "not finite: nan"),
        (np.array([-np.inf]), "not finite: -inf"),
    ],
)
def test_actions_that_are_not_one_finite_number_are_refused(action, message):
    env = cartpole()
    env.reset(seed=0)
    before = env.state
    with pytest.raises(ValueError, match=message):
        env.step(action)
    np.testing.assert_array_equal(env.state, before)


@pytest.mark.parametrize("action", [1e8, -1e20, 3e38, 1e150])
def test_a_force_too_large_to_integrate_is_a_fall(action):
    env = cartpole()
    env.reset(seed=0)
    env.step(ZERO)
    before = env.state
    observation, reward, terminated, _, info = env.step(np.array([action]))
    assert terminated
    assert info["fallen"]
    assert not info["inside_tube"]
    assert math.isfinite(reward)
    assert env.observation_space.contains(observation)
    np.testing.assert_array_equal(env.state, before)


def test_step_before_reset_is_refused():
    with pytest.raises(RuntimeError, match="call reset"):
        CartPoleEnv().step(ZERO)


# Reward, success, effort and the end of an episode.


def redefine(states, forces, goal, radius, fallen):
    """Recompute an episode's reward and success from its states and forces alone."""
    success_time, effort, rows = math.inf, 0.0, []
    for index, (state, force) in enumerate(zip(states, forces, strict=True)):
        distance = math.dist(state, goal)
        inside = distance <= radius(0.1 * index) and not fallen[index]
        effort += 0.1 * force**2
        reward = -0.01 * 0.1 * force**2
        if not fallen[index]:
            # 10 a second for standing, less the distance, of which no more than that counts.
            reward += 0.1 * (10.0 - min(distance, 10.0))
        if inside and success_time == math.inf:
            success_time = 0.1 * index
            reward += 10.0
            effort_to_success = effort
        if success_time == math.inf:
            effort_to_success = effort
        rows.append((reward, inside, success_time, effort, effort_to_success, distance))
    return rows


@pytest.mark.parametrize("policy", ["hold", "fall"])
@pytest.mark.parametrize("kind", sorted(OPEN_LOOP))
def test_reward_and_info_follow_their_definitions(kind, policy, hold):
    env = cartpole(disturbance=kind, disturbance_bound=0.5)
    act = hold if policy == "hold" else lambda *_: np.array([0.4])
    for seed in range(3):
        episode = roll_out(env, act, seed=seed)
        rewards, infos = ([row[column] for row in episode] for column in (1, 4))
        states, forces = ([row[column] for row in episode] for column in (5, 6))
        fallen = [bool(abs(state[1]) > math.pi / 2) for state in states]
        expected = redefine(
            states,
            forces,
            env.scenario.goal,
            lambda time: 3.15 * (1.0 - math.exp(-0.6 * time)),
            fallen,
        )
        for index, (info, row) in enumerate(zip(infos, expected, strict=True)):
            reward, inside, success_time, effort, effort_to_success, distance = row
            if index > 0:
                assert rewards[index] == pytest.approx(reward, abs=1e-9)
            assert info["inside_tube"] is inside
            assert info["success"] is (success_time < math.inf)
            assert info["success_time"] == pytest.approx(success_time)
            assert info["effort"] == pytest.approx(effort)
            assert info["effort_to_success"] == pytest.approx(effort_to_success)
            assert info["goal_distance"] == pytest.approx(distance)
            assert info["fallen"] is fallen[index]
            radius = 3.15 * (1.0 - math.exp(-0.06 * index))
            assert info["tube_radius"] == pytest.approx(radius)
        # The episode ended where it should, and not before.
        assert not any(row[2] or row[3] for row in episode[:-1])
        assert episode[-1][2] == fallen[-1]
        assert not any(fallen[:-1])
        assert episode[-1][3] == (len(episode) == 91)
        if policy == "fall":
            assert fallen[-1]


def test_the_policies_of_these_tests_meet_success_and_failure(hold):
    env = cartpole(disturbance="uniform", disturbance_bound=0.5)
    infos = [roll_out(env, hold, seed=seed)[-1][4] for seed in range(12)]
    assert sum(info["success"] for info in infos) > 0
    assert any(info["success_time"] > 1.0 for info in infos if info["success"])
    falls = [roll_out(env, lambda *_: np.array([0.4]), seed=seed) for seed in range(3)]
    assert all(row[-1][4]["fallen"] for row in falls)


def test_a_goal_one_metre_away_is_reached_when_the_tube_is_a_metre_wide():
    # At rest upright nothing moves, so r(t) = 1 decides: t* = -ln(1 - 1/3.15)/0.6 = 0.637 s.
    env = cartpole()
    _, info = env.reset(seed=0, options={"initial_state": UPRIGHT, "goal": 1.0})
    assert not info["success"]
    for index in range(1, 91):
        _, reward, terminated, truncated, info = env.step(ZERO)
        assert info["success"] is (index >= 7)
        assert reward == pytest.approx(0.9 + (10.0 if index == 7 else 0.0))
        assert terminated is False
        assert truncated is (index == 90)
    assert info["success_time"] == pytest.approx(0.7)
    np.testing.assert_array_equal(env.state, UPRIGHT)


def test_success_is_kept_when_the_tube_is_left_again():
    env = cartpole()
    env.reset(seed=0, options={"initial_state": UPRIGHT, "goal": 1.0})
    for _ in range(10):
        info = env.step(ZERO)[4]
    terminated, effort = False, 0.0
    while not terminated:
        _, _, terminated, _, info = env.step(np.array([-0.5]))
        effort += 0.1 * 20.0**2
    assert info["success"]
    assert info["success_time"] == pytest.approx(0.7)
    assert info["effort_to_success"] == 0.0
    assert info["effort"] == pytest.approx(effort)
    assert not info["inside_tube"]


def test_a_fallen_pole_is_never_inside_the_tube():
    # A tube so wide from the start that only the fall can be outside of it.
    settings = CartPoleSettings(tube=PaperTube(1e6, 100.0))
    env = cartpole(settings=settings)
    _, info = env.reset(seed=0, options={"initial_state": [0.0, 1.5, 0.0, 0.0], "goal": 0.0})
    assert not info["success"]  # r(0) = 0
    terminated = False
    while not terminated:
        _, _, terminated, _, info = env.step(ZERO)
        assert info["inside_tube"] is (not terminated)
        assert info["goal_distance"] < info["tube_radius"]


def test_starting_at_the_goal_is_success_at_time_zero():
    _, info = cartpole().reset(seed=0, options={"initial_state": UPRIGHT, "goal": 0.0})
    assert info["success"]
    assert info["success_time"] == 0.0


def test_falling_never_pays():
    """However far away the goal is, one more step upright earns no less than a fall."""
    env = cartpole()
    for position in (0.0, 5.0, 100.0):
        env.reset(seed=0, options={"initial_state": UPRIGHT, "goal": position})
        standing = env.step(ZERO)[1]
        env.reset(seed=0, options={"initial_state": [0.0, 1.57, 0.0, 1.0], "goal": position})
        _, falling, terminated, _, _ = env.step(ZERO)
        assert terminated
        assert standing >= falling


def test_a_shorter_episode_has_fewer_steps():
    env = cartpole(settings=CartPoleSettings(time_limit=0.5, control_period=0.05))
    env.reset(seed=0, options={"initial_state": UPRIGHT})
    ends = [env.step(ZERO)[3] for _ in range(10)]
    assert ends == [False] * 9 + [True]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"control_period": 0.0}, "control_period=0.0 must be finite and > 0"),
        ({"time_limit": 9.05}, "whole number"),
        ({"time_limit": -9}, "time_limit=-9"),
        ({"force_limit": 0.0}, "None for no limit"),
        ({"force_limit": -5}, "force_limit=-5"),
        ({"initial_angle": 1.6}, "below pi/2"),
        ({"goal_range": math.nan}, "goal_range=nan"),
        ({"effort_weight": -0.1}, "effort_weight=-0.1"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        CartPoleSettings(**change)


def test_another_cart_obeys_another_equation():
    heavy = CartPole(cart_mass=5.0)
    env = cartpole(settings=CartPoleSettings(system=heavy))
    env.reset(seed=2)
    before = env.state
    env.step(np.array([0.5]))
    expected = hold_step(heavy, before, np.array([20.0]), 0.1)
    np.testing.assert_allclose(env.state, expected, rtol=1e-12)


# Disturbances in the environment.


def test_a_larger_bound_scales_what_the_episode_meets(hold):
    pushes = {}
    for bound in (0.1, 0.75):
        env = cartpole(disturbance="uniform", disturbance_bound=bound)
        episode = roll_out(env, hold, seed=7)
        pushes[bound] = np.array([row[4]["disturbance"] for row in episode[1:]])
    np.testing.assert_allclose(7.5 * pushes[0.1], pushes[0.75], rtol=1e-12)
    assert np.all(np.linalg.norm(pushes[0.75], axis=1) <= 0.75)


def test_only_the_chosen_channels_are_disturbed(hold):
    for channels, mask in (("rates", [0, 0, 1, 1]), ([True, False, False, False], [1, 0, 0, 0])):
        env = cartpole(disturbance="sphere", disturbance_channels=channels)
        episode = roll_out(env, hold, seed=0)
        pushes = np.array([row[4]["disturbance"] for row in episode[1:]])
        np.testing.assert_array_equal(np.any(pushes != 0.0, axis=0), np.array(mask, bool))


def test_worst_pushes_away_from_the_nominal(hold):
    env = cartpole(disturbance="worst", disturbance_bound=0.3, metric=METRIC)
    nominal = np.random.default_rng(0).uniform(-0.5, 0.5, (91, 4))
    env.reset(seed=0, options={"nominal": nominal})
    for index in range(20):
        gradient = METRIC @ (env.state - nominal[index])
        info = env.step(hold(env.state, env.scenario.goal))[4]
        expected = 0.3 * gradient / np.linalg.norm(gradient)
        np.testing.assert_allclose(info["disturbance"], expected, rtol=1e-10)
        error = math.dist(env.state, nominal[index + 1])
        assert info["tracking_error"] == pytest.approx(error)


def test_worst_without_a_nominal_says_what_to_pass():
    env = cartpole(disturbance="worst", metric=METRIC)
    with pytest.raises(ValueError, match=r"reset\(options=\{\"nominal\""):
        env.reset(seed=0)


def test_a_callable_sees_each_step():
    seen = []

    def wind(now):
        seen.append((float(now.time), now.state.copy(), now.nominal))
        return np.array([0.0, 0.0, 5.0, 0.0])

    env = cartpole(disturbance=wind, disturbance_bound=0.2)
    env.reset(seed=0, options={"initial_state": UPRIGHT})
    states = []
    for _ in range(5):
        states.append(env.state)
        info = env.step(ZERO)[4]
        np.testing.assert_allclose(info["disturbance"], [0.0, 0.0, 0.2, 0.0], rtol=1e-12)
    np.testing.assert_allclose([row[0] for row in seen], 0.1 * np.arange(5))
    np.testing.assert_array_equal([row[1] for row in seen], states)
    assert all(row[2] is None for row in seen)


def test_an_unknown_disturbance_is_refused_when_the_environment_is_made():
    with pytest.raises(ValueError, match="disturbance='wind' is not known"):
        gym.make("lagros/CartPole-v0", disturbance="wind")


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_the_same_seed_gives_the_same_episode(kind, hold):
    options = {"nominal": np.zeros((91, 4))}
    metric = METRIC if kind == "worst" else None
    first, second, other = (
        roll_out(cartpole(disturbance=kind, metric=metric), hold, seed=seed, options=options)
        for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal([row[5] for row in first], [row[5] for row in second])
    assert not np.array_equal(first[0][0], other[0][0])


def test_infos_of_different_steps_share_no_array():
    env = cartpole(disturbance="uniform")
    _, info = env.reset(seed=0)
    kept = [info["disturbance"], *(env.step(ZERO)[4]["disturbance"] for _ in range(3))]
    for index, array in enumerate(kept):
        for other in kept[index + 1 :]:
            assert not np.shares_memory(array, other)
