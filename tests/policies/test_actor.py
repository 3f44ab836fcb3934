"""Actors that reinforcement learning trained: against torch, their files, what is shipped."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.vec_env import VecNormalize

from lagros_benchmarks.training.sb3_vector import LinearFeatures, SB3VectorEnv
from lagros_benchmarks.training.single import evaluate, extract_actor
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.cartpole.vector import CartPoleVectorEnv
from lagros_policies.actor import (
    Actor,
    ActorPolicy,
    PpoPolicy,
    SacPolicy,
    Td3Policy,
    goal_frame,
)
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.learning.networks import Mlp, read_safetensors, write_safetensors
from lagros_policies.residual import ResidualPolicy
from lagros_policies.room import PRETRAINED

TANH = {"net_arch": [16, 8], "activation_fn": torch.nn.Tanh}
FRAME = goal_frame(CartPoleSettings())
FORCE = (40.0,)  # [N]
CLASSES = {"ppo": PPO, "sac": SAC, "td3": TD3}


def agent(algorithm, features=None):
    """Return an agent far from its initial weights, and the environment without normalisation."""
    venv = SB3VectorEnv(CartPoleVectorEnv(8, disturbance="uniform", autoreset_mode="same_step"))
    seen = venv if features is None else LinearFeatures(venv, features)
    off_policy = {} if algorithm is PPO else {"buffer_size": 10}
    env = VecNormalize(seen) if algorithm is PPO and features is not None else seen
    model = algorithm(
        "MlpPolicy", env, policy_kwargs=dict(TANH), device="cpu", seed=1, **off_policy
    )
    if isinstance(env, VecNormalize):
        env.reset()
        for _ in range(30):
            env.step(np.random.default_rng(0).uniform(-1.0, 1.0, (8, 1)).astype(np.float32))
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=generator)
    return model


@pytest.fixture(scope="module")
def observations():
    env = CartPoleVectorEnv(200, disturbance="sphere", autoreset_mode="disabled")
    observation, _ = env.reset(seed=3)
    rng = np.random.default_rng(4)
    for _ in range(5):
        observation, *_ = env.step(rng.uniform(-1.0, 1.0, (200, 1)))
    return observation


@pytest.fixture(scope="module")
def actor():
    return extract_actor(agent(PPO, FRAME), FORCE)


@pytest.mark.parametrize("name", CLASSES)
@pytest.mark.parametrize("plain", [True, False])
def test_the_numpy_actor_acts_as_torch(name, plain, observations):
    features = None if plain else FRAME / np.array([5.0, 1.0, 5.0, 3.0])[:, None]
    model = agent(CLASSES[name], features)
    # Rows that no episode would show, far ones among them.
    policy = ActorPolicy(weights=extract_actor(model, FORCE), allow_other_settings=True)
    normalised = model.get_vec_normalize_env()

    def expected(rows):
        seen = rows if features is None else rows @ features.T.astype(np.float32)
        seen = seen if normalised is None else normalised.normalize_obs(seen)
        return model.predict(seen, deterministic=True)[0]

    wanted = expected(observations)
    assert np.ptp(wanted) > 0.3
    np.testing.assert_allclose(policy.predict(observations)[0], wanted, atol=1e-5)
    np.testing.assert_allclose(policy.predict(observations[7])[0], wanted[7], atol=1e-5)
    # Features far beyond the normalisation are clipped, and so are the actions.
    far = 1e4 * observations
    np.testing.assert_allclose(policy.predict(far)[0], expected(far), atol=1e-5)
    assert np.all(np.abs(policy.predict(far)[0]) <= 1.0)


def test_the_actor_survives_its_file_and_another_force_unit(actor, observations, tmp_path):
    path = tmp_path / "actor.safetensors"
    for squash in ("clip", "tanh"):
        own = replace(actor, squash=squash)
        own.save(path)
        expected, _ = ActorPolicy(weights=own).predict(observations)
        np.testing.assert_array_equal(ActorPolicy.load(path).predict(observations)[0], expected)
        weaker = ActorPolicy.load(path, CartPoleSettings(force_scale=10.0))
        np.testing.assert_allclose(
            10.0 * weaker.predict(observations)[0], 40.0 * expected, rtol=1e-6
        )
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_without_a_squash_clips(actor, observations, tmp_path):
    path = tmp_path / "actor.safetensors"
    actor.save(path)
    tensors, metadata = read_safetensors(path)
    del metadata["squash"]
    write_safetensors(path, tensors, {**metadata, "format": "lagros-ppo-actor-1"})
    expected, _ = ActorPolicy(weights=actor).predict(observations)
    np.testing.assert_array_equal(ActorPolicy.load(path).predict(observations)[0], expected)
    write_safetensors(path, tensors, metadata)
    with pytest.raises(ValueError, match=r"damaged: squash=None"):
        ActorPolicy.load(path)


def test_networks_of_other_kinds_are_not_exported():
    with pytest.raises(ValueError, match="plain network of tanh"):
        extract_actor(
            PPO("MlpPolicy", CartPoleEnv(), policy_kwargs={"activation_fn": torch.nn.ReLU}), FORCE
        )
    with pytest.raises(ValueError, match="plain network of tanh"):
        extract_actor(SAC("MlpPolicy", CartPoleEnv(), buffer_size=10), FORCE)
    with pytest.raises(ValueError, match="exploration"):
        extract_actor(PPO("MlpPolicy", CartPoleEnv(), use_sde=True), FORCE)
    with pytest.raises(ValueError, match="A2C is not one of"):
        extract_actor(A2C("MlpPolicy", CartPoleEnv()), FORCE)


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
def test_a_damaged_actor_is_named(actor, tmp_path, kind):
    path = tmp_path / "actor.safetensors"
    actor.save(path)
    path.write_bytes(damage(kind, path.read_bytes()))
    with pytest.raises(ValueError, match=r"actor\.safetensors is damaged"):
        ActorPolicy.load(path)


def test_files_that_hold_something_else_are_named(actor, tmp_path):
    path = tmp_path / "other.safetensors"
    actor.network.save(path)
    with pytest.raises(ValueError, match="is not an actor"):
        ActorPolicy.load(path)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.safetensors"):
        ActorPolicy.load(tmp_path / "nowhere.safetensors")
    nan = Mlp([np.ones((4, 1))], [np.ones(1)])
    nan.weights[0][0, 0] = np.nan
    replace(actor, network=nan).save(path)
    with pytest.raises(ValueError, match="not finite"):
        ActorPolicy.load(path)


@pytest.mark.parametrize(
    "change",
    [
        {"std": np.zeros(4, np.float32)},
        {"mean": np.zeros(3, np.float32)},
        {"features": np.zeros((3, 13), np.float32)},
        {"action_clip": 0.0},
        {"control_scale": (float("nan"),)},
        {"squash": "round"},
    ],
)
def test_actors_that_cannot_act_are_rejected(actor, change):
    with pytest.raises(ValueError, match=next(iter(change))):
        replace(actor, **change)


# The correction of LAG-ROS


def constant(force, scale=4.0):
    """Return an actor that always asks for one force [N]."""
    return Actor(
        network=Mlp([np.zeros((4, 1))], [np.array([force / scale])]),
        features=FRAME.astype(np.float32),
        mean=np.zeros(4, np.float32),
        std=np.ones(4, np.float32),
        feature_clip=10.0,
        action_clip=1.0,
        control_scale=(scale,),
    )


@pytest.mark.parametrize("unit", [40.0, 10.0])
@pytest.mark.parametrize(("asked", "given"), [(1.5, 1.5), (-3.0, -3.0), (100.0, 4.0)])
def test_the_correction_is_added_in_newtons_and_bounded(observations, unit, asked, given):
    settings = CartPoleSettings(force_scale=unit)
    policy = ResidualPolicy(settings, constant(asked))
    assert policy.largest_correction == 4.0
    base, _ = LagrosPolicy(settings).predict(observations)
    action, memory = policy.predict(observations, "memory")
    assert memory == "memory"
    np.testing.assert_allclose(unit * (action - base), given, atol=1e-4)
    np.testing.assert_allclose(policy.predict(observations[3])[0], action[3], atol=1e-6)


# What is shipped


@pytest.mark.parametrize("policy", [PpoPolicy, SacPolicy, Td3Policy, ResidualPolicy])
def test_the_shipped_actors_balance_and_their_records_say_how(policy):
    name = policy.name
    record = json.loads((PRETRAINED / f"cartpole_{name}.json").read_text())
    figures = evaluate(policy(), episode_seeds(77, 300), "uniform", 0.75)
    assert figures["success"] >= 0.98
    assert figures["strict"] >= 0.98
    stated = record["final"]
    row = stated["uniform 0.75"] if isinstance(stated, dict) else stated[-1]
    assert figures["effort"] == pytest.approx(row["effort"], rel=0.1)
    if name != "ppo":
        assert row["disturbance"] == "uniform"
        assert record["command"].startswith("lagros train cartpole --algo")


def test_the_shipped_correction_is_as_large_as_its_record_says():
    record = json.loads((PRETRAINED / "cartpole_residual.json").read_text())
    assert ResidualPolicy().largest_correction == record["training"]["largest_correction"]
