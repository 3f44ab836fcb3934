"""The baselines, the training of the PPO baseline, and its environment adapter."""

import base64
import json
import pickle
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from lagros_benchmarks import train_ppo
from lagros_benchmarks.sb3_vector import LinearFeatures, SB3VectorEnv
from lagros_envs.cartpole import CartPoleEnv
from lagros_envs.cartpole_task import CartPoleSettings
from lagros_envs.cartpole_vector import CartPoleVectorEnv
from lagros_envs.dynamics import hold_step
from lagros_policies.baselines import (
    ALGORITHMS,
    PRETRAINED_PPO,
    LqrPolicy,
    PpoActor,
    PpoPolicy,
    RandomPolicy,
    StableBaselines3Policy,
    detect_algorithm,
    goal_frame,
    load_stable_baselines3,
)
from lagros_policies.imitation.networks import Mlp

TINY = train_ppo.PpoTraining(
    segments=2,
    rollouts=1,
    rollout_steps=24,
    worlds=8,
    batch_size=64,
    epochs=2,
    hidden=(16, 8),
    curve_episodes=10,
    final_episodes=10,
)
CLASSES = {"A2C": A2C, "DDPG": DDPG, "PPO": PPO, "SAC": SAC, "TD3": TD3}


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def trained():
    """Return a PPO agent after a few steps, far from its initial zeros, and its normalisation."""
    model, normalised = train_ppo.build(TINY)
    model.learn(TINY.segment_steps)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=torch.Generator())
    return model, normalised


@pytest.fixture
def observations():
    env = CartPoleVectorEnv(200, disturbance="sphere", autoreset_mode="disabled")
    observation, _ = env.reset(seed=3)
    rng = np.random.default_rng(4)
    for _ in range(5):
        observation, *_ = env.step(rng.uniform(-1.0, 1.0, (200, 1)))
    return observation


@pytest.fixture(scope="module")
def zips(tmp_path_factory):
    """Return one saved model per algorithm, under names that do not tell the algorithm."""
    folder = tmp_path_factory.mktemp("zips")
    paths = {}
    for index, (name, algorithm) in enumerate(CLASSES.items()):
        off_policy = {"buffer_size": 10} if name in ("DDPG", "SAC", "TD3") else {}
        model = algorithm(
            "MlpPolicy", CartPoleEnv(), policy_kwargs={"net_arch": [8]}, device="cpu", **off_policy
        )
        paths[name] = folder / f"model{index}.zip"
        model.save(paths[name])
    return paths


# LQR


@pytest.mark.parametrize("settings", [CartPoleSettings(), CartPoleSettings(control_period=0.05)])
def test_the_lqr_gain_is_the_limit_of_the_riccati_recursion(settings):
    policy = LqrPolicy(settings, state_weights=[0.3, 2.0, 0.1, 0.5], force_weight=0.02)
    # Central differences of the true step instead of its linearisation.
    step = 1e-5
    points = step * np.concatenate([np.eye(5), -np.eye(5)])
    ends = hold_step(settings.system, points[:, :4], points[:, 4:], settings.control_period)
    slopes = ((ends[:5] - ends[5:]) / (2.0 * step)).T
    A, B = slopes[:, :4], slopes[:, 4:]
    Q, R = np.diag([0.3, 2.0, 0.1, 0.5]), np.array([[0.02]])
    P = Q
    for _ in range(2000):
        K = np.linalg.inv(R + B.T @ P @ B) @ B.T @ P @ A
        P = Q + K.T @ R @ K + (A - B @ K).T @ P @ (A - B @ K)
    np.testing.assert_allclose(policy.gain, K, rtol=1e-6)
    assert np.max(np.abs(np.linalg.eigvals(A - B @ policy.gain))) < 1.0


def test_lqr_weights_follow_brysons_rule():
    settings = CartPoleSettings()
    angle = settings.initial_angle
    weights = [1 / 25, 1 / angle**2, 1 / 25, 1 / angle**2]
    by_hand = LqrPolicy(settings, state_weights=weights, force_weight=1 / 1600)
    np.testing.assert_allclose(LqrPolicy(settings).gain, by_hand.gain, rtol=1e-12)


def test_lqr_brings_the_cart_to_the_goal_and_no_force_unit_changes_that():
    for scale in (40.0, 7.0):
        settings = CartPoleSettings(force_scale=scale)
        policy = LqrPolicy(settings, force_weight=1 / 1600)
        env = CartPoleEnv(settings=settings)
        options = {"initial_state": [0.0, 0.3, 0.0, 0.0], "goal": 1.0}
        observation, _ = env.reset(seed=0, options=options)
        for _ in range(settings.steps):
            action, _ = policy.predict(observation)
            observation, _, fallen, _, info = env.step(action)
            assert not fallen
        assert info["goal_distance"] < 0.05
        assert info["effort"] == pytest.approx(10.4, abs=3.0)


@pytest.mark.parametrize(
    "weights",
    [
        {"state_weights": [1.0, 1.0, 1.0]},
        {"state_weights": [0.0, 1.0, 1.0, 1.0]},
        {"state_weights": [1.0, -1.0, 1.0, 1.0]},
        {"state_weights": [1.0, np.nan, 1.0, 1.0]},
        {"force_weight": 0.0},
        {"force_weight": np.inf},
    ],
)
def test_lqr_rejects_weights_without_a_solution(weights):
    with pytest.raises(ValueError, match="must be"):
        LqrPolicy(**weights)


# Random


def test_random_draws_are_its_own_and_follow_the_seed():
    observation = np.zeros((500, 13), np.float32)
    first, again, other = (RandomPolicy(seed=seed).predict(observation)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)
    assert np.all(np.abs(first) <= 1.0)
    assert abs(float(first.mean())) < 0.1
    assert float(first.std()) == pytest.approx(1 / np.sqrt(3), abs=0.05)


# The common interface


def all_policies(zips):
    return [
        LqrPolicy(),
        RandomPolicy(seed=0),
        PpoPolicy(),
        load_stable_baselines3(zips["PPO"]),
    ]


def test_every_policy_keeps_the_contract(zips, observations):
    for policy in all_policies(zips):
        assert policy.observes == "local"
        single, memory = policy.predict(observations[0])
        assert (single.shape, single.dtype, memory) == ((1,), np.float32, None)
        kept = single.copy()
        batch, memory = policy.predict(observations, None, np.ones(len(observations), bool))
        assert (batch.shape, batch.dtype, memory) == ((len(observations), 1), np.float32, None)
        assert np.all(np.isfinite(batch))
        np.testing.assert_array_equal(single, kept)
        if policy.name != "random":
            np.testing.assert_allclose(batch[0], single, atol=1e-6)
            policy.predict(observations[1])
            np.testing.assert_array_equal(single, kept)


def test_stable_baselines3_evaluates_every_policy(zips):
    env = Monitor(CartPoleEnv(disturbance="uniform"))
    for policy in all_policies(zips):
        env.reset(seed=1)
        rewards, lengths = evaluate_policy(
            policy, env, n_eval_episodes=2, return_episode_rewards=True
        )
        assert len(rewards) == len(lengths) == 2
        assert np.all(np.isfinite(rewards))
        if policy.name in ("lqr", "ppo"):
            assert lengths == [90, 90]


# The PPO actor


def test_the_numpy_actor_acts_as_torch(trained, observations):
    model, normalised = trained
    policy = PpoPolicy(weights=train_ppo.extract_actor(model, normalised))
    features = observations @ goal_frame().T.astype(np.float32)
    expected, _ = model.predict(normalised.normalize_obs(features), deterministic=True)
    actions, _ = policy.predict(observations)
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(policy.predict(observations[7])[0], expected[7], atol=1e-5)
    # Features far beyond the normalisation are clipped, and so are the actions.
    far = 1e4 * observations
    expected, _ = model.predict(normalised.normalize_obs(1e4 * features), deterministic=True)
    np.testing.assert_allclose(policy.predict(far)[0], expected, atol=1e-5)


def test_an_agent_on_the_plain_observation_is_exported_as_well(tmp_path, observations):
    model = PPO("MlpPolicy", CartPoleEnv(), policy_kwargs={"net_arch": [8]}, device="cpu", seed=1)
    path = tmp_path / "plain.safetensors"
    train_ppo.export_actor(model, None, path)
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(PpoPolicy.load(path).predict(observations)[0], expected, atol=1e-5)
    assert list(tmp_path.iterdir()) == [path]


def test_the_actor_survives_its_file_and_another_force_unit(trained, observations, tmp_path):
    path = tmp_path / "actor.safetensors"
    actor = train_ppo.export_actor(*trained, path, {"seed": 0})
    expected, _ = PpoPolicy(weights=actor).predict(observations)
    np.testing.assert_array_equal(PpoPolicy.load(path).predict(observations)[0], expected)
    weaker = PpoPolicy.load(path, CartPoleSettings(force_scale=10.0))
    np.testing.assert_allclose(10.0 * weaker.predict(observations)[0], 40.0 * expected, rtol=1e-6)
    assert json.loads((tmp_path / "actor.json").read_text()) == {"seed": 0}
    assert sorted(tmp_path.iterdir()) == [tmp_path / "actor.json", path]


def test_networks_of_other_kinds_are_not_exported():
    relu = PPO("MlpPolicy", CartPoleEnv(), policy_kwargs={"activation_fn": torch.nn.ReLU})
    with pytest.raises(ValueError, match="plain network of tanh"):
        train_ppo.extract_actor(relu, None)
    exploring = PPO("MlpPolicy", CartPoleEnv(), use_sde=True)
    with pytest.raises(ValueError, match="exploration"):
        train_ppo.extract_actor(exploring, None)


def damage(kind, content):
    header = int.from_bytes(content[:8], "little")
    if kind == "empty":
        return b""
    if kind == "cut":
        return content[: len(content) // 2]
    if kind == "header":
        return content[:8] + b"\xff" * header + content[8 + header :]
    if kind == "length":
        return b"\xff" * 8 + content[8:]
    return b"weights" * 100  # text


@pytest.mark.parametrize("kind", ["empty", "cut", "header", "length", "text"])
def test_a_damaged_actor_is_named(trained, tmp_path, kind):
    path = tmp_path / "actor.safetensors"
    train_ppo.extract_actor(*trained).save(path)
    path.write_bytes(damage(kind, path.read_bytes()))
    with pytest.raises(ValueError, match=r"actor\.safetensors is damaged"):
        PpoPolicy.load(path)


def test_files_that_hold_something_else_are_named(trained, tmp_path):
    actor = train_ppo.extract_actor(*trained)
    path = tmp_path / "other.safetensors"
    actor.network.save(path)
    with pytest.raises(ValueError, match="is not a PPO actor"):
        PpoPolicy.load(path)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.safetensors"):
        PpoPolicy.load(tmp_path / "nowhere.safetensors")
    nan = Mlp([np.ones((4, 1))], [np.ones(1)])
    nan.weights[0][0, 0] = np.nan
    broken = replace(actor, network=nan)
    broken.save(path)
    with pytest.raises(ValueError, match="not finite"):
        PpoPolicy.load(path)


@pytest.mark.parametrize(
    "change",
    [
        {"std": np.zeros(4, np.float32)},
        {"mean": np.zeros(3, np.float32)},
        {"features": np.zeros((4, 5), np.float32)},
        {"action_clip": 0.0},
        {"force_scale": float("nan")},
    ],
)
def test_actors_that_cannot_act_are_rejected(trained, change):
    actor = train_ppo.extract_actor(*trained)
    with pytest.raises(ValueError, match=next(iter(change))):
        replace(actor, **change)


def test_the_shipped_actor_balances_and_its_record_says_how():
    policy = PpoPolicy()
    record = json.loads(PRETRAINED_PPO.with_suffix(".json").read_text())
    assert record["curve"]["steps"][-1] == record["budget"]["steps"]
    assert record["training"]["hidden"] == [
        policy.actor.network.weights[0].shape[1],
        policy.actor.network.weights[1].shape[1],
    ]
    figures = train_ppo.evaluate(policy, 300, 77, "uniform", 0.75)
    assert figures["success"] >= 0.98
    assert figures["strict"] >= 0.98
    assert figures["effort"] == pytest.approx(record["final"]["uniform 0.75"]["effort"], rel=0.1)


# stable-baselines3 files


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_saved_model_is_detected_loaded_and_acts_the_same(zips, observations, name):
    assert detect_algorithm(zips[name]) == name
    policy = load_stable_baselines3(zips[name])
    assert isinstance(policy, StableBaselines3Policy)
    assert policy.name == zips[name].stem
    model = CLASSES[name].load(zips[name], device="cpu")
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_array_equal(policy.predict(observations)[0], expected)
    named = load_stable_baselines3(zips[name], name.lower())
    np.testing.assert_array_equal(named.predict(observations)[0], expected)


class Trap:
    """Unpickling it makes a file."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return (Path.touch, (self.marker,))


def write_zip(path, data):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", data)
    return path


def test_detection_unpickles_nothing(zips, tmp_path, monkeypatch):
    marker = tmp_path / "ran"
    trap = base64.b64encode(pickle.dumps(Trap(marker))).decode()
    with zipfile.ZipFile(zips["PPO"]) as archive:
        data = json.loads(archive.read("data"))
    for entry in data.values():
        if isinstance(entry, dict) and ":serialized:" in entry:
            entry[":serialized:"] = trap
    path = write_zip(tmp_path / "trap.zip", json.dumps(data))
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)  # nor is it needed
    assert detect_algorithm(path) == "PPO"
    assert not marker.exists()
    monkeypatch.undo()
    with pytest.raises(ValueError, match="could not be loaded"):
        load_stable_baselines3(path)
    assert marker.exists(), "the trap does not work, so that the test shows nothing"


def test_missing_and_foreign_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.zip"):
        load_stable_baselines3(tmp_path / "nowhere.zip")
    path = tmp_path / "text.zip"
    path.write_text("not a zip")
    with pytest.raises(ValueError, match=r"text\.zip is not a model"):
        load_stable_baselines3(path)
    for data in ("{", "[]", "{}", '{"policy_class": {"__module__": "sb3_contrib.tqc"}}'):
        with pytest.raises(ValueError, match=r"entry 'data'|prefix, e\.g\. ppo:"):
            load_stable_baselines3(write_zip(path, data))
    with pytest.raises(ValueError, match="could not be loaded as a SAC model"):
        load_stable_baselines3(path, "sac")


def test_algorithms_that_are_not_known_are_named(zips, tmp_path):
    with pytest.raises(ValueError, match=r"'trpo' is not known; use one of a2c, ddpg"):
        load_stable_baselines3(zips["PPO"], "trpo")
    path = tmp_path / "dqn.zip"
    DQN("MlpPolicy", gym.make("CartPole-v1"), buffer_size=10, device="cpu").save(path)
    with pytest.raises(ValueError, match=r"prefix, e\.g\. ppo:"):
        load_stable_baselines3(path)


def test_models_of_other_tasks_are_rejected(tmp_path):
    path = tmp_path / "pendulum.zip"
    PPO("MlpPolicy", gym.make("Pendulum-v1"), device="cpu").save(path)
    with pytest.raises(ValueError, match=r"observations of shape \(3,\)"):
        load_stable_baselines3(path)


def test_the_missing_extra_is_named(zips, monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(ImportError, match=r"lagros\[rl\]"):
        load_stable_baselines3(zips["PPO"])


# The adapter of the vector environment


def test_the_adapter_ends_episodes_as_the_environment_does():
    worlds, steps = 40, 90
    options = {"disturbance": "uniform", "disturbance_bound": 0.75}
    adapter = SB3VectorEnv(CartPoleVectorEnv(worlds, autoreset_mode="same_step", **options))
    plain = CartPoleVectorEnv(worlds, autoreset_mode="disabled", **options)
    adapter.seed(5)
    ours = adapter.reset()
    theirs, _ = plain.reset(seed=5)
    np.testing.assert_array_equal(ours, theirs)
    policy = LqrPolicy()
    # Every other world is felled, at a time of its own.
    falls = np.where(np.arange(worlds) % 2 == 0, np.arange(worlds) * 3 % 60 + 10, steps)
    ended, returns = np.zeros(worlds, bool), np.zeros(worlds)
    outcomes = []
    for step in range(steps):
        action, _ = policy.predict(theirs)
        action[falls <= step] = 20.0
        theirs, reward, terminated, truncated, info = plain.step(action)
        ours, rewards, done, infos = adapter.step(action)
        assert rewards.dtype == np.float32
        returns += np.where(ended, 0.0, reward)
        for world in np.flatnonzero(~ended):
            assert done[world] == (terminated[world] or truncated[world])
            if not done[world]:
                np.testing.assert_array_equal(ours[world], theirs[world])
                assert infos[world] == {}
                continue
            np.testing.assert_array_equal(infos[world]["terminal_observation"], theirs[world])
            assert infos[world]["TimeLimit.truncated"] == (not terminated[world])
            assert infos[world]["episode"]["l"] == step + 1
            assert infos[world]["episode"]["r"] == pytest.approx(returns[world])
            assert infos[world]["success"] == info["success"][world]
            assert ours[world, 12] == 0.0
            assert np.any(ours[world] != theirs[world])
            outcomes.append((bool(terminated[world]), bool(truncated[world])))
        ended |= done
    assert np.all(ended)
    assert {(True, False), (False, True)} <= set(outcomes)


def test_a_fall_at_the_time_limit_is_not_bootstrapped():
    settings = CartPoleSettings(time_limit=0.1)
    env = CartPoleVectorEnv(2, settings=settings, autoreset_mode="same_step")
    adapter = SB3VectorEnv(env)
    adapter.reset()
    _, _, done, infos = adapter.step(np.array([[1e3], [0.0]], np.float32))
    assert done.tolist() == [True, True]
    assert [bool(info["fallen"]) for info in infos] == [True, False]
    assert [info["TimeLimit.truncated"] for info in infos] == [False, True]


def test_the_adapter_seeds_worlds_apart_and_repeats():
    def start(seed):
        adapter = SB3VectorEnv(CartPoleVectorEnv(6, autoreset_mode="same_step"))
        adapter.seed(seed)
        first = adapter.reset()
        assert np.any(adapter.reset() != first)
        return first

    np.testing.assert_array_equal(start(1), start(1))
    assert len(np.unique(np.concatenate([start(1), start(2)])[:, 4])) == 12


def test_the_adapter_needs_the_same_step_mode_and_shares_its_attributes():
    with pytest.raises(ValueError, match='autoreset_mode="same_step"'):
        SB3VectorEnv(CartPoleVectorEnv(2))
    adapter = SB3VectorEnv(CartPoleVectorEnv(3, autoreset_mode="same_step"))
    with pytest.raises(RuntimeError, match="step_async"):
        adapter.step_wait()
    assert adapter.get_attr("num_envs", [0, 2]) == [3, 3]
    adapter.set_attr("label", "x")
    assert adapter.get_attr("label", 1) == ["x"]
    with pytest.raises(ValueError, match="all of them"):
        adapter.set_attr("label", "y", [0])
    assert adapter.env_is_wrapped(Monitor) == [True] * 3
    with pytest.raises(ValueError, match="matrix has shape"):
        LinearFeatures(adapter, np.eye(4))


def test_features_map_the_last_observation_too():
    def adapter():
        settings = CartPoleSettings(time_limit=0.2)
        return SB3VectorEnv(CartPoleVectorEnv(3, settings=settings, autoreset_mode="same_step"))

    plain, mapped = adapter(), LinearFeatures(adapter(), goal_frame())
    plain.seed(2)
    mapped.seed(2)
    matrix = goal_frame()
    np.testing.assert_allclose(mapped.reset(), plain.reset() @ matrix.T, atol=1e-6)
    for _ in range(2):
        action = np.full((3, 1), 0.1, np.float32)
        expected, _, done, infos = plain.step(action)
        features, _, _, mapped_infos = mapped.step(action)
        np.testing.assert_allclose(features, expected @ matrix.T, atol=1e-6)
    assert done.all()
    for info, mapped_info in zip(infos, mapped_infos, strict=True):
        terminal = info["terminal_observation"]
        assert mapped_info["terminal_observation"] == pytest.approx(matrix @ terminal, abs=1e-6)
        assert matrix @ terminal == pytest.approx(
            [terminal[0] - terminal[4], *terminal[1:4]], abs=1e-6
        )


def test_a_model_learns_through_the_adapter():
    venv = SB3VectorEnv(CartPoleVectorEnv(4, autoreset_mode="same_step"))
    model = A2C("MlpPolicy", venv, n_steps=8, device="cpu")
    model.learn(320)
    assert len(model.ep_info_buffer) > 0
    assert DummyVecEnv not in type(model.get_env()).__mro__


# The training


def test_an_interrupted_training_ends_with_the_same_weights(tmp_path, monkeypatch):
    whole = train_ppo.train(TINY, tmp_path / "whole.safetensors", tmp_path / "whole.pt")
    calls = []
    evaluate = train_ppo.evaluate

    def killed(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return evaluate(*arguments)

    monkeypatch.setattr(train_ppo, "evaluate", killed)
    out, checkpoint = tmp_path / "cut.safetensors", tmp_path / "cut.pt"
    with pytest.raises(KeyboardInterrupt):
        train_ppo.train(TINY, out, checkpoint)
    assert not out.exists()
    cut = train_ppo.train(TINY, out, checkpoint)
    layers = [*whole.network.weights, *whole.network.biases, whole.mean, whole.std]
    others = [*cut.network.weights, *cut.network.biases, cut.mean, cut.std]
    for layer, other in zip(layers, others, strict=True):
        np.testing.assert_array_equal(layer, other)
    record = json.loads(out.with_suffix(".json").read_text())
    assert record["curve"]["steps"] == [TINY.segment_steps, 2 * TINY.segment_steps]
    with pytest.raises(ValueError, match="belongs to another run"):
        train_ppo.train(replace(TINY, seed=1), out, checkpoint)
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(ValueError, match="is damaged"):
        train_ppo.train(TINY, out, checkpoint)


def test_the_command_line_checks_its_arguments(capsys):
    for arguments in (["--seed", "-1"], ["--segments", "0"]):
        with pytest.raises(SystemExit):
            train_ppo.main(arguments)
        assert arguments[0] in capsys.readouterr().err


def test_the_figures_count_what_happens_before_the_first_fall():
    class Never(PpoPolicy):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.zeros((len(observation), 1), np.float32), state

    actor = PpoActor(
        network=Mlp([np.zeros((4, 1))], [np.zeros(1)]),
        features=goal_frame().astype(np.float32),
        mean=np.zeros(4, np.float32),
        std=np.ones(4, np.float32),
        feature_clip=1.0,
        action_clip=1.0,
        force_scale=40.0,
    )
    figures = train_ppo.evaluate(Never(weights=actor), 50, 1, "none", 0.0)
    assert figures["fallen"] == 1.0
    assert figures["strict"] == 0.0
    assert figures["effort"] == 0.0
    assert figures["success"] < 0.5
