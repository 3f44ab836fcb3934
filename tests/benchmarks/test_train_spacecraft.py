"""The shared PPO agent of the spacecraft: its view, its reward, its training, its actor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from lagros_benchmarks.sb3_vector import SB3VectorEnv
from lagros_benchmarks.training import spacecraft as training
from lagros_benchmarks.training.agent import actor_network, make_agent
from lagros_benchmarks.training.run import Place, train
from lagros_benchmarks.training.settings import Ppo, SpacecraftTraining
from lagros_envs import spacecraft_v0
from lagros_envs.observation import Layout
from lagros_envs.scenarios import PRESETS, Scenario
from lagros_envs.seeding import episode_seeds
from lagros_envs.spacecraft_task import SpacecraftSettings
from lagros_envs.spacecraft_vector import SpacecraftVectorEnv
from lagros_policies.imitation.networks import Mlp
from lagros_policies.spacecraft_ppo import FEATURES, SpacecraftPpoPolicy, body_features

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
)
LAYOUT = Layout(5, 1, 45.0)


def observation(goal, velocity, heading, neighbours, layout=LAYOUT):
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
    return row[None]


def random_parts(rng):
    neighbours = rng.normal(size=(rng.integers(0, 5), 4))
    return rng.normal(size=2), rng.normal(size=2), rng.uniform(-3, 3), neighbours


# What the agent sees


def test_what_an_agent_sees_turns_with_the_world():
    rng = np.random.default_rng(0)
    for _ in range(30):
        goal, velocity, heading, neighbours = random_parts(rng)
        angle = rng.uniform(-3, 3)
        # A positive heading turns clockwise.
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        both = np.hstack([neighbours[:, :2] @ turn.T, neighbours[:, 2:] @ turn.T])
        plain = body_features(LAYOUT, observation(goal, velocity, heading, neighbours))
        turned = body_features(
            LAYOUT, observation(turn @ goal, turn @ velocity, heading + angle, both)
        )
        np.testing.assert_allclose(turned, plain, atol=1e-5)
        assert np.any(plain != 0.0)


def test_neither_order_nor_number_of_slots_matters():
    rng = np.random.default_rng(1)
    for _ in range(30):
        goal, velocity, heading, neighbours = random_parts(rng)
        plain = body_features(LAYOUT, observation(goal, velocity, heading, neighbours))
        mixed = body_features(
            LAYOUT, observation(goal, velocity, heading, rng.permutation(neighbours))
        )
        np.testing.assert_array_equal(mixed, plain)
        wide = Layout(9, 4, 45.0)
        more = body_features(wide, observation(goal, velocity, heading, neighbours, wide))
        np.testing.assert_array_equal(more, plain)
        # The fourth is not looked at; nobody near is nothing seen.
        apart = np.linalg.norm(neighbours[:, :2], axis=1)
        nearest = neighbours[np.argsort(apart)[:3]]
        same = body_features(LAYOUT, observation(goal, velocity, heading, nearest))
        np.testing.assert_array_equal(same, plain)
    alone = Layout(1, 1, 45.0)
    features = body_features(alone, observation([2.0, 0.0], [0.0, 0.1], 0.0, [], alone))[0]
    np.testing.assert_allclose(features[:6], [2 / 2.3, 0.0, 1.0, 0.0, 0.3, 0.2], atol=1e-6)
    assert not features[6:].any()


@pytest.mark.parametrize(("pair", "axis"), [((4, 5), 0), ((6, 7), 1)])
@pytest.mark.parametrize("heading", [0.0, 1.1, -2.5])
def test_the_same_thrusters_push_along_the_same_feature(pair, axis, heading):
    env = spacecraft_v0.parallel_env(1, "open")
    start = np.array([[2.0, 2.0]])
    scenario = Scenario(start, [heading], start + 1.0, [], [])
    env.reset(seed=0, options={"scenario": scenario})
    layout = env.episode.layout
    action = np.isin(np.arange(8), pair).astype(np.float32)
    observations, *_ = env.step({"agent_0": action})
    moved = body_features(layout, observations["agent_0"][None])[0, 3:5]
    assert moved[axis] > 0.1
    assert abs(moved[1 - axis]) < 1e-6


# What it is paid


def test_nearness_costs_what_the_distances_say():
    settings = SpacecraftSettings(time_limit=1.0)
    crowd = replace(PRESETS["open"], agents=4, arena=2.0, margin=0.02, least_way=0.5)
    envs = [
        SB3VectorEnv(
            SpacecraftVectorEnv(12, 4, crowd, settings=settings, autoreset_mode="same_step")
        )
        for _ in range(2)
    ]
    plain, venv = envs[0], training.KeepDistance(envs[1], envs[1].venv.layout, 0.5, 3.0, 0.4, 0.1)
    for env in (plain, venv):
        env.seed(4)
        env.reset()
    rng = np.random.default_rng(0)
    costs = []
    for step in range(10):
        actions = rng.uniform(0.0, 1.0, (12, 8)).astype(np.float32)
        goals = np.moveaxis(plain.venv.world.goals, 0, -1).copy()
        _, reward, done, infos = plain.step(actions)
        _, lowered, _, _ = venv.step(actions)
        if step < 9:
            places = plain.venv.states[..., :2]
        else:
            # The last step counts with where it led to, not with the next start.
            assert done.all()
            part = plain.venv.layout.slices["goal"]
            places = goals - np.stack(
                [info["terminal_observation"][part] for info in infos]
            ).reshape(3, 4, 2)
        expected = np.zeros((3, 4))
        for world in range(3):
            for first in range(4):
                for second in set(range(4)) - {first}:
                    apart = np.linalg.norm(places[world, first] - places[world, second])
                    expected[world, first] += max(0.0, min(1.0, 1.0 - (apart - 0.5) / 0.4))
        np.testing.assert_allclose(reward - lowered, 0.3 * expected.ravel(), atol=1e-5)
        costs.append(expected.max())
    assert max(costs) > 0.2


# The training


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
    for name in ("success", "steps", "effort_to_success"):
        assert cut["curve"][name] == whole["curve"][name]
    assert cut["final"] == whole["final"]
    assert [(row["agents"], row["bound"], row["worlds"]) for row in cut["final"]] == [
        (1, 0.2, 2),
        (3, 0.2, 2),
    ]
    assert cut["training"]["preset"] == "open"


def test_the_evaluation_counts_agents_as_the_environment_does():
    network = Mlp([np.zeros((FEATURES, 8))], [np.full(8, -1.0)])
    policy = SpacecraftPpoPolicy(num_agents=2, weights=network)
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
    run = SpacecraftTraining(segments=3, final_agents=(3,), final_bounds=(0.2,))
    record = train(run, Place(tmp_path), lambda: training.SpacecraftLesson(run))
    reached = record["final"][0]
    assert reached["success"] > 0.8
    assert reached["collided"] < 0.1


# The actor


def test_the_actor_is_the_model(tmp_path):
    model = make_agent(TINY, training.SpacecraftLesson(TINY).venv)
    path = tmp_path / "a.safetensors"
    actor_network(model).save(path)
    env = SpacecraftVectorEnv(8, 4, "paper", disturbance="uniform")
    rows, _ = env.reset(seed=1)
    policy = SpacecraftPpoPolicy(env.settings, env.preset, weights=path)
    features = body_features(env.layout, rows)
    expected, _ = model.predict(features, deterministic=True)
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
    with pytest.raises(FileNotFoundError, match="no weight file"):
        SpacecraftPpoPolicy(weights=tmp_path / "none.safetensors")
    with pytest.raises(ValueError, match="this agent maps 27 to 8"):
        SpacecraftPpoPolicy(weights=Mlp([np.zeros((4, 1))], [np.zeros(1)]))
