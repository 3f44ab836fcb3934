"""The shipped PPO actor of the spacecraft: its file, its rows, what it does and what it refuses."""

import json

import numpy as np
import pytest

import lagros_policies
from lagros_envs import spacecraft_v0
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.learning.networks import Mlp
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.spacecraft import SPACECRAFT_NAMES
from lagros_policies.tasks.spacecraft.ppo import FEATURES, WRENCH, SpacecraftPpoPolicy

WEIGHTS = PRETRAINED / SpacecraftPpoPolicy.weights_file


def flown(preset, agents, worlds, kind="uniform", bound=0.4):
    """Fly the shipped actor to the end and return the last info."""
    env = SpacecraftVectorEnv(worlds * agents, agents, preset, kind, bound)
    policy = lagros_policies.make("ppo", env)
    rows, info = env.reset(seed=episode_seeds(31, worlds))
    for _ in range(env.settings.steps):
        actions, _ = policy.predict(rows)
        rows, _, _, _, info = env.step(actions)
    return info


def test_it_has_a_name_and_a_file_in_the_package():
    assert "ppo" in SPACECRAFT_NAMES
    network = Mlp.load(WEIGHTS)
    assert (network.inputs, network.outputs) == (FEATURES, WRENCH)
    record = json.loads(WEIGHTS.with_suffix(".json").read_text())
    assert record["command"] == "lagros train spacecraft --algo ppo --seed 0"
    assert record["training"]["seed"] == 0
    assert [bias.size for bias in network.biases[:-1]] == record["training"]["algorithm"]["hidden"]


def test_it_avoids_what_it_meets():
    paper, open_field = flown("paper", 6, 30), flown("open", 6, 30)
    assert paper["success"].mean() > 0.75
    assert open_field["success"].mean() > 0.9
    # Who does not look at obstacles collides in three of four flights.
    assert paper["collided"].mean() < 0.2


@pytest.mark.parametrize(("preset", "agents"), [("paper", 1), ("open", 3), ("swarm", 12)])
def test_one_row_at_a_time_is_all_rows_at_once(preset, agents):
    env = SpacecraftVectorEnv(2 * agents, agents, preset, "uniform", 0.4)
    policy = SpacecraftPpoPolicy(env.settings, preset, agents)
    rows, _ = env.reset(seed=3)
    for _ in range(20):
        actions, memory = policy.predict(rows, "memory")
        assert memory == "memory"
        assert actions.shape == (2 * agents, 8)
        assert actions.dtype == np.float32
        assert actions.min() >= 0.0
        for row, action in zip(rows, actions, strict=True):
            np.testing.assert_allclose(policy.predict(row)[0], action, atol=1e-5)
        rows, *_ = env.step(actions)
    # An agent decides by itself: what the other rows are changes nothing.
    backwards, _ = policy.predict(rows[::-1])
    np.testing.assert_allclose(backwards[::-1], policy.predict(rows)[0], atol=1e-5)


def test_it_flies_in_the_environment_of_pettingzoo():
    env = spacecraft_v0.parallel_env(num_agents=4)
    policy = lagros_policies.make("ppo", env)
    observations, _ = env.reset(seed=1)
    before = np.linalg.norm(np.stack(list(observations.values()))[:, :2], axis=1)
    for _ in range(60):
        actions, _ = policy.predict(np.stack(list(observations.values())))
        observations, *_ = env.step(dict(zip(observations, actions, strict=True)))
    after = np.linalg.norm(np.stack(list(observations.values()))[:, :2], axis=1)
    assert np.mean(after - before) < -0.3


def test_errors_say_what_to_do(tmp_path):
    policy = SpacecraftPpoPolicy(preset="paper", num_agents=6)
    with pytest.raises(ValueError, match="build the policy with the environment's preset"):
        policy.predict(np.zeros(7, np.float32))
    rows = np.full((2, policy.layout.size), np.nan, np.float32)
    with pytest.raises(ValueError, match="not finite"):
        policy.predict(rows)
    with pytest.raises(FileNotFoundError, match="there is no file"):
        SpacecraftPpoPolicy(weights=tmp_path / "none.safetensors")
    path = tmp_path / "cut.safetensors"
    path.write_bytes(WEIGHTS.read_bytes()[:-100])
    with pytest.raises(ValueError, match="damaged"):
        SpacecraftPpoPolicy(weights=path)
    with pytest.raises(ValueError, match=r"this agent maps 53 to 3; .*lagros train spacecraft"):
        SpacecraftPpoPolicy(weights=Mlp([np.zeros((27, 8))], [np.zeros(8)]))
    with pytest.raises(ValueError, match="preset='papers' is not known"):
        SpacecraftPpoPolicy(preset="papers")
    with pytest.raises(ValueError, match="Did you mean 'ppo'"):
        lagros_policies.make("poo", spacecraft_v0.parallel_env(1, PRESETS["open"]))
