"""The shared PPO agent of the spacecraft: its view, its reward, its training, its actor."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from lagros_benchmarks.tasks.spacecraft import training
from lagros_benchmarks.tasks.spacecraft.course import SpacecraftTraining
from lagros_benchmarks.training.agent import actor_network, make_agent
from lagros_benchmarks.training.course import default_training
from lagros_benchmarks.training.run import Place, train
from lagros_benchmarks.training.sb3_vector import SB3VectorEnv
from lagros_benchmarks.training.settings import (
    CURVE,
    FINAL,
    Ppo,
)
from lagros_envs import spacecraft_v0
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.spacecraft.scenarios import Preset, Scenario
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.learning.networks import Mlp
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.spacecraft.ppo import (
    FEATURES,
    SpacecraftPpoPolicy,
    look,
    thrust_of,
)

TINY = SpacecraftTraining(
    Ppo(rollout_steps=30, batch_size=60, epochs=2),
    segments=2,
    segment_steps=30,
    worlds=2,
    agents=2,
    time_limit=2.0,
    curve_episodes=2,
    final_episodes=2,
    final_agents=(1, 3),
    final_bounds=(0.2,),
    final_presets=("open",),
)
LAYOUT = Layout(5, 4, 45.0)
# Lets the agents drift.
IDLE = Mlp([np.zeros((FEATURES, 3))], [np.zeros(3)])


def observation(goal, velocity, heading, neighbours, obstacles=(), layout=LAYOUT):
    """One row, written down part by part."""
    row = np.zeros(layout.size, np.float32)
    at = layout.slices
    row[at["goal"]], row[at["velocity"]] = goal, velocity
    row[at["heading"]] = [np.cos(heading), np.sin(heading), 0.3]
    row[at["spin"]] = 0.2
    count = len(neighbours)
    slots = np.zeros((layout.neighbours, 4))
    if count:
        slots[:count] = neighbours
    row[at["neighbours"]] = slots.ravel()
    row[at["neighbour_mask"]] = np.arange(layout.neighbours) < count
    count = len(obstacles)
    slots = np.zeros((layout.obstacles, 3))
    if count:
        slots[:count] = obstacles
    row[at["obstacles"]] = slots.ravel()
    row[at["obstacle_mask"]] = np.arange(layout.obstacles) < count
    return row[None]


def random_parts(rng):
    """Goal, velocity, heading, neighbours and obstacles of one agent."""
    neighbours = rng.normal(size=(rng.integers(0, 5), 4))
    obstacles = rng.normal(size=(rng.integers(0, 5), 3))
    obstacles[:, 2] = rng.uniform(0.1, 0.6, len(obstacles))
    return rng.normal(size=2), rng.normal(size=2), rng.uniform(-3, 3), neighbours, obstacles


# What the agent sees


def test_what_an_agent_sees_does_not_turn_with_the_world():
    rng = np.random.default_rng(0)
    for _ in range(30):
        goal, velocity, heading, neighbours, obstacles = random_parts(rng)
        angle = rng.uniform(-3, 3)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        both = np.hstack([neighbours[:, :2] @ turn.T, neighbours[:, 2:] @ turn.T])
        centres = np.hstack([obstacles[:, :2] @ turn.T, obstacles[:, 2:]])
        plain = look(LAYOUT, observation(goal, velocity, heading, neighbours, obstacles))
        # Nor does the heading matter to what is seen.
        other = rng.uniform(-3, 3)
        turned = look(LAYOUT, observation(turn @ goal, turn @ velocity, other, both, centres))
        np.testing.assert_allclose(turned.features, plain.features, atol=2e-5)
        assert np.any(plain.features != 0.0)


def test_neither_order_nor_number_of_slots_matters():
    rng = np.random.default_rng(1)
    for _ in range(30):
        goal, velocity, heading, neighbours, obstacles = random_parts(rng)

        def features(near, discs, layout=LAYOUT, own=(goal, velocity, heading)):
            return look(layout, observation(*own, near, discs, layout)).features

        plain = features(neighbours, obstacles)
        mixed = features(rng.permutation(neighbours), rng.permutation(obstacles))
        np.testing.assert_array_equal(mixed, plain)
        np.testing.assert_array_equal(features(neighbours, obstacles, Layout(9, 7, 45.0)), plain)
        # The fourth is not looked at. It is the rim of an obstacle that counts, not its centre.
        apart = np.linalg.norm(neighbours[:, :2], axis=1)
        rims = np.linalg.norm(obstacles[:, :2], axis=1) - obstacles[:, 2]
        nearest = neighbours[np.argsort(apart)[:3]], obstacles[np.argsort(rims)[:3]]
        np.testing.assert_array_equal(features(*nearest), plain)
    # Nobody near is nothing seen.
    alone = Layout(1, 1, 45.0)
    seen = look(alone, observation([2.0, 0.0], [0.0, 0.1], 0.7, [], [], alone)).features[0]
    np.testing.assert_allclose(seen[:5], [2 / 2.3, 1.0, 0.0, 0.3, 0.2], atol=1e-6)
    assert not seen[5:].any()


def test_what_is_seen_of_a_body_is_what_the_documentation_says():
    # The goal is along y: in its frame x is backwards to the right. A neighbour 1 m ahead comes
    # closer with 0.2 m/s; the rim of an obstacle of 0.5 m at the left is 0.75 m away.
    row = observation([0.0, 3.0], [-0.3, 0.1], 0.4, [[0.0, 1.0, -0.1, -0.2]], [[-1.25, 0.0, 0.5]])
    seen = look(LAYOUT, row).features[0]
    near = 1.0 - 0.5 / 1.5
    np.testing.assert_allclose(
        seen[5:13], [1.0, 0.0, near, 0.0, -0.4, 0.2, near, 0.4 * near], atol=1e-6
    )
    near = 1.0 - 0.5 / 1.75
    np.testing.assert_allclose(
        seen[29:37], [0.0, 1.0, 0.0, near, -0.2, -0.6, near, 0.6 * near], atol=1e-6
    )
    assert seen.shape == (FEATURES,) == (53,)
    assert not seen[13:29].any()
    assert not seen[37:].any()


def test_at_the_goal_itself_all_is_finite():
    seen = look(LAYOUT, observation([0.0, 0.0], [0.1, 0.0], 0.0, [], []))
    assert np.all(np.isfinite(seen.features))
    assert abs(seen.axes[0]) == pytest.approx(1.0)


def test_a_force_becomes_the_least_thrusts_that_make_it():
    settings = SpacecraftSettings(thrust_scale=2.0)
    rng = np.random.default_rng(2)
    action = rng.uniform(-1.0, 1.0, (50, 3))
    axes = np.exp(1j * rng.uniform(-3.0, 3.0, 50))
    thrust = thrust_of(settings, axes, action)
    assert thrust.dtype == np.float32
    assert thrust.min() >= 0.0
    # The wrench of eight thrusters, as the equations of motion have it; arms of 1 m.
    matrix = np.array(
        [
            [-1, -1, 0, 0, 1, 1, 0, 0],
            [0, 0, -1, -1, 0, 0, 1, 1],
            [-1, 1, -1, 1, -1, 1, -1, 1],
        ]
    )
    wrench = 2.0 * thrust @ matrix.T
    turned = axes * (action[:, 0] + 1j * action[:, 1])
    np.testing.assert_allclose(wrench[:, 0] + 1j * wrench[:, 1], turned, atol=1e-6)
    np.testing.assert_allclose(wrench[:, 2], action[:, 2], atol=1e-6)
    # Adding to both of a pair would change nothing but the effort.
    assert np.all(thrust[:, [0, 1, 2, 3]] * thrust[:, [5, 4, 7, 6]] == 0.0)
    # No more than 1 N and 1 N m, whatever is asked for.
    np.testing.assert_array_equal(
        thrust_of(settings, axes, 7.0 * np.sign(action)),
        thrust_of(settings, axes, np.sign(action)),
    )


@pytest.mark.parametrize("heading", [0.0, 1.1, -2.5])
def test_the_first_axis_of_the_force_is_towards_the_goal(heading):
    """Flown in the environment: the frames of the agent against the equations of motion."""
    env = spacecraft_v0.parallel_env(1, "open")
    start = np.array([[2.0, 2.0]])
    towards = np.array([0.6, 0.8])
    scenario = Scenario(start, [heading], start + 2.0 * towards, [], [])
    for action, expected in (
        ([0.5, 0.0, 0.0], 0.05 * towards),
        ([0.0, 0.5, 0.0], 0.05 * np.array([-0.8, 0.6])),
        ([0.0, 0.0, 0.5], np.zeros(2)),
    ):
        observations, _ = env.reset(seed=0, options={"scenario": scenario})
        seen = look(env.episode.layout, observations["agent_0"][None])
        thrust = thrust_of(env.episode.settings, seen.axes, np.array([action]))[0]
        observations, *_ = env.step({"agent_0": thrust})
        part = env.episode.layout.slices
        velocity = observations["agent_0"][part["velocity"]]
        np.testing.assert_allclose(velocity, expected, atol=1e-6)
        spin = observations["agent_0"][part["spin"]][0]
        assert bool(spin > 0.01) is (action[2] > 0.0)


def test_the_worlds_in_training_are_flown_as_the_policy_flies_them():
    run = replace(TINY, worlds=2)
    network = Mlp([np.random.default_rng(0).normal(0.0, 0.1, (FEATURES, 3))], [np.zeros(3)])
    lesson = training.SpacecraftLesson(run)
    env = SpacecraftVectorEnv(
        4,
        2,
        run.preset,
        "uniform",
        0.4,
        settings=SpacecraftSettings(time_limit=run.time_limit),
    )
    policy = SpacecraftPpoPolicy(env.settings, run.preset, 2, network)
    lesson.venv.seed(5)
    seen = lesson.venv.reset()
    rows, _ = env.reset(seed=5)
    assert lesson.venv.action_space.shape == (3,)
    for _ in range(10):
        np.testing.assert_array_equal(seen, look(env.layout, rows).features)
        seen, *_ = lesson.venv.step(np.array(network(seen)))
        rows, *_ = env.step(policy.predict(rows)[0])


# What it is paid


def test_the_reward_is_shaped_as_the_distances_say():
    settings = SpacecraftSettings(time_limit=1.0)
    crowd = Preset(
        arena=2.2, obstacle_count=(1, 2), obstacle_radius=0.2, margin=0.02, least_way=0.0
    )
    envs = [
        SB3VectorEnv(
            SpacecraftVectorEnv(12, 4, crowd, settings=settings, autoreset_mode="same_step")
        )
        for _ in range(2)
    ]
    run = replace(
        TINY,
        goal_weight=0.7,
        nearness_weight=3.0,
        nearness_range=0.4,
        obstacle_weight=2.0,
        obstacle_range=0.3,
    )
    plain = envs[0]
    venv = training.ShapedReward(envs[1], envs[1].venv.layout, run, 0.1, 0.2, 0.25)
    venv.share = 0.5
    for env in (plain, venv):
        env.seed(5)
        env.reset()
    rng = np.random.default_rng(0)
    seen = {"neighbour": 0.0, "obstacle": 0.0, "goal": 0.0}
    for step in range(10):
        actions = rng.uniform(0.0, 1.0, (12, 8)).astype(np.float32)
        goals = np.moveaxis(plain.venv.world.goals, 0, -1).copy()
        scenarios = plain.venv.scenarios
        _, reward, done, infos = plain.step(actions)
        _, shaped, _, _ = venv.step(actions)
        places = plain.venv.states[..., :2]
        if step == 9:
            # The last step counts with where it led to, not with the next start.
            assert done.all()
            part = plain.venv.layout.slices["goal"]
            last = np.stack([info["terminal_observation"][part] for info in infos])
            places = goals - last.reshape(3, 4, 2)
        expected = np.zeros((3, 4))
        for world, agent in np.ndindex(3, 4):
            here = places[world, agent]
            for other in set(range(4)) - {agent}:
                gap = np.linalg.norm(here - places[world, other]) - 0.5
                cost = 3.0 * max(0.0, min(1.0, 1.0 - gap / 0.4)) ** 2
                expected[world, agent] -= 0.5 * cost
                seen["neighbour"] += cost
            for centre in scenarios[world].obstacles:
                gap = np.linalg.norm(here - centre) - 0.2 - 0.25
                cost = 2.0 * max(0.0, min(1.0, 1.0 - gap / 0.3)) ** 2
                expected[world, agent] -= 0.5 * cost
                seen["obstacle"] += cost
            paid = 0.7 * (np.linalg.norm(goals[world, agent] - here) <= 0.2)
            expected[world, agent] += paid
            seen["goal"] += paid
        np.testing.assert_allclose(shaped - reward, 0.1 * expected.ravel(), atol=1e-5)
    assert all(value > 0.1 for value in seen.values())


def test_the_cost_of_being_near_grows_along_the_run():
    run = replace(TINY, segments=10, growth=0.4, first_share=0.2)
    lesson = training.SpacecraftLesson(run)
    shares = []
    for segment in range(run.segments):
        lesson.begin(segment)
        shares.append(lesson.shaped.share)
    np.testing.assert_allclose(shares, [0.2, 0.4, 0.6, 0.8, *[1.0] * 6])
    # It is a matter of the segment alone: a run that goes on meets what it would have met.
    other = training.SpacecraftLesson(run)
    other.begin(2)
    assert other.shaped.share == pytest.approx(0.6)


@pytest.mark.parametrize("name", ["growth", "first_share", "obstacle_range"])
def test_settings_of_the_reward_are_positive(name):
    with pytest.raises(ValueError, match=f"{name}=0.0 must be finite and > 0"):
        replace(TINY, **{name: 0.0})


# The training


def test_the_figures_are_of_worlds_that_neither_training_nor_the_benchmark_meets(monkeypatch):
    run = replace(TINY, curve_episodes=20, final_episodes=30)
    lesson = training.SpacecraftLesson(run)
    flown = []

    def spy(policy, preset, agents, seeds, *condition):
        flown.append((preset, agents, seeds, *condition))
        measures = dict.fromkeys(training.RATES, np.ones(agents * len(seeds), bool))
        return {**measures, "effort_to_success": np.ones(4), "success_time": np.ones(4)}

    monkeypatch.setattr(training, "evaluate", spy)
    model = make_agent(run, lesson.venv)
    lesson.figures(model)
    lesson.final(model)
    final = episode_seeds(0, 30, FINAL)
    assert flown == [
        ("paper", 2, episode_seeds(0, 20, CURVE), "uniform", 0.4),
        ("open", 1, final, "uniform", 0.2),
        ("open", 3, final, "uniform", 0.2),
    ]


@pytest.mark.parametrize("parallel_env", [False, True])
def test_the_worlds_in_training_are_those_of_the_settings(parallel_env):
    run = replace(TINY, disturbance="gust", disturbance_bound=0.3, preset="open", agents=3)
    venv = training.SpacecraftLesson(run, parallel_env).venv
    disturbance, settings = venv.get_attr("disturbance")[0], venv.get_attr("settings")[0]
    assert (disturbance.kind, disturbance.bound) == ("gust", 0.3)
    assert (settings.effort_weight, settings.progress_weight) == (0.05, 1.5)
    assert settings.time_limit == run.time_limit
    assert venv.num_envs == 6
    assert venv.get_attr("preset")[0].agents == 3
    assert venv.gamma == run.algorithm.discount


def test_in_other_worlds_as_many_agents_learn_for_the_same_share_of_the_time():
    run = SpacecraftTraining()
    assert run.in_worlds(None, None) == replace(run, final_presets=("paper",))
    other = run.in_worlds("gcbf", 16)
    assert (other.preset, other.agents, other.worlds) == ("gcbf", 16, 9)
    assert (other.final_presets, other.final_agents) == (("gcbf",), (16,))
    # 77 s and 45 s are the limits of the presets, and the side of gcbf grows with sqrt(N / 8).
    assert other.time_limit == round(20.0 * 77.0 * 2.0**0.5 / 45.0)
    small = replace(TINY.in_worlds("gcbf", 4), time_limit=1.0)
    venv = training.SpacecraftLesson(small).venv
    settings = venv.get_attr("settings")[0]
    assert (settings.speed_limit, settings.thrust_limit) == (0.5, 1.0)
    assert venv.num_envs == 4 * small.worlds


def test_both_routes_train_the_same_agent():
    weights = []
    for parallel_env in (False, True):
        lesson = training.SpacecraftLesson(TINY, parallel_env)
        model = make_agent(TINY, lesson.venv)
        model.set_random_seed(3)
        model.learn(TINY.steps_of_segment)
        assert model.num_timesteps == TINY.steps_of_segment == 120
        weights.append(actor_network(model).weights)
    for ours, theirs in zip(*weights, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_an_interrupted_training_ends_with_the_same_weights(tmp_path, monkeypatch):
    calls = []

    def quick(policy, preset, agents, seeds, *condition):
        """Figures that tell one network from another."""
        share = np.resize(policy.network.biases[-1], agents * len(seeds))
        rates = dict.fromkeys(training.RATES, share > 0.0)
        return {**rates, "effort_to_success": share, "success_time": share}

    def killed(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return quick(*arguments)

    def run(folder):
        return train(TINY, Place(folder), lambda: training.SpacecraftLesson(TINY))

    monkeypatch.setattr(training, "evaluate", quick)
    whole = run(tmp_path / "whole")
    monkeypatch.setattr(training, "evaluate", killed)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "cut")
    cut = run(tmp_path / "cut")
    weights = [tmp_path / name / "weights.safetensors" for name in ("cut", "whole")]
    assert weights[0].read_bytes() == weights[1].read_bytes()
    metadata = Mlp.load(weights[0]).metadata
    assert (metadata["task"], metadata["policy"]) == ("spacecraft", "ppo")
    assert json.loads(metadata["trained_for"])["equal"]["horizon"] == 30.0
    for name in ("success", "steps", "effort_to_success"):
        assert cut["curve"][name] == whole["curve"][name]
    assert cut["final"] == whole["final"]
    assert [(row["agents"], row["bound"], row["worlds"]) for row in cut["final"]] == [
        (1, 0.2, 2),
        (3, 0.2, 2),
    ]
    assert {row["preset"] for row in cut["final"]} == {"open"}


def test_the_evaluation_counts_agents_as_the_environment_does():
    policy = SpacecraftPpoPolicy(preset="open", num_agents=2, weights=IDLE)
    seeds = episode_seeds(5, 3)
    measures = training.evaluate(policy, "open", 2, seeds, "uniform", 0.4)
    expected = []
    for seed in seeds:
        env = spacecraft_v0.parallel_env(2, "open", disturbance="uniform", disturbance_bound=0.4)
        env.reset(seed=seed)
        while env.agents:
            *_, infos = env.step(dict.fromkeys(env.agents, np.zeros(8)))
        expected += [infos[agent] for agent in env.possible_agents]
    for name, values in measures.items():
        np.testing.assert_allclose(values, [info[name] for info in expected], atol=1e-9)
    figures = training.summary(measures)
    assert figures["effort_to_success"] == 0.0
    assert figures["collided"] == np.mean([info["collided"] for info in expected])
    never = {**measures, "success_time": np.full(6, np.inf)}
    assert training.summary(never)["success_time"] == 0.0


@pytest.mark.slow
def test_it_learns_to_reach_goals(tmp_path):
    run = SpacecraftTraining(segments=5, final_presets=("open",))
    record = train(run, Place(tmp_path), lambda: training.SpacecraftLesson(run))
    assert record["final"][0]["success"] > 0.6


# The actor


@pytest.mark.parametrize(("preset", "agents"), [("paper", 6), ("gcbf", 8)])
def test_the_shipped_actor_flies_as_its_record_says(preset, agents):
    """The file and the record are of one run: on the record's own episodes, its own figures."""
    name = "spacecraft_ppo" if preset == "paper" else f"spacecraft_ppo_{preset}"
    record = json.loads((PRETRAINED / f"{name}.json").read_text())
    run = default_training("spacecraft", "ppo")
    if preset != "paper":
        run = replace(run.in_worlds(preset, None), segments=20)
    assert record["training"] == json.loads(json.dumps(run.record()))
    seeds = episode_seeds(0, run.final_episodes, FINAL)
    row = record["final"][0]
    assert (row["preset"], row["agents"], row["worlds"]) == (preset, agents, len(seeds))
    policy = SpacecraftPpoPolicy(preset=preset, num_agents=agents)
    flown = training.evaluate(policy, preset, agents, seeds, row["disturbance"], row["bound"])
    for name, value in training.summary(flown).items():
        # Another processor may round differently, and a flight then end otherwise.
        assert value == pytest.approx(row[name], rel=0.01, abs=0.003)


def test_the_actor_is_the_model(tmp_path):
    model = make_agent(TINY, training.SpacecraftLesson(TINY).venv)
    path = tmp_path / "a.safetensors"
    actor_network(model).save(path)
    env = SpacecraftVectorEnv(8, 4, "paper", disturbance="uniform")
    rows, _ = env.reset(seed=1)
    policy = SpacecraftPpoPolicy(env.settings, env.preset, weights=path)
    seen = look(env.layout, rows)
    action, _ = model.predict(seen.features, deterministic=True)
    expected = thrust_of(env.settings, seen.axes, action)
    actions, state = policy.predict(rows, "memory")
    assert state == "memory"
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, expected, atol=1e-6)
    np.testing.assert_allclose(policy.predict(rows[3])[0], expected[3], atol=1e-6)
    # The same forces where the action means another.
    strong = replace(env.settings, thrust_scale=2.0)
    halved, _ = SpacecraftPpoPolicy(strong, env.preset, weights=path).predict(rows)
    np.testing.assert_allclose(halved, 0.5 * actions, atol=1e-7)


def test_other_weights_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        SpacecraftPpoPolicy(weights=tmp_path / "none.safetensors")
    with pytest.raises(ValueError, match="this agent maps 53 to 3"):
        SpacecraftPpoPolicy(weights=Mlp([np.zeros((4, 1))], [np.zeros(1)]))
