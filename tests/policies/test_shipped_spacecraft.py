"""The spacecraft's policies by name, with the weights in the package, on worlds they never saw."""

import json

import numpy as np
import pytest

import lagros_policies
from lagros_envs import spacecraft_v0
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.learning.deep_set import DeepSet
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.spacecraft import SPACECRAFT_NAMES
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter

WORLDS, AGENTS = 12, 6


def fly(name, bound, filtered=False, preset="paper"):
    """Fly a policy to the end of the episode and return the last info."""
    env = SpacecraftVectorEnv(
        WORLDS * AGENTS, AGENTS, preset, "uniform", bound, autoreset_mode="disabled"
    )
    policy = lagros_policies.make(name, env)
    if filtered:
        policy = SafetyFilter(policy, env.settings, env.preset, disturbance_bound=bound)
    observation, info = env.reset(seed=episode_seeds(17, WORLDS, EVALUATION))
    state = None
    for _ in range(env.settings.steps):
        action, state = policy.predict(observation, state)
        observation, _, _, _, info = env.step(action)
    return info


@pytest.mark.parametrize("name", SPACECRAFT_NAMES)
def test_every_policy_is_built_by_name_and_acts(name):
    env = spacecraft_v0.parallel_env(num_agents=3, disturbance="uniform", disturbance_bound=0.3)
    observations, _ = env.reset(seed=4)
    policy = lagros_policies.make(name, env)
    assert policy.name == name
    seen = env.state() if policy.observes == "global" else np.stack(list(observations.values()))
    action, _ = policy.predict(seen)
    assert action.shape == (3, 8)
    assert np.all(action >= 0.0)
    assert np.all(np.isfinite(action))


def test_planners_are_told_the_bound_of_the_environment():
    margins = []
    for bound in (0.2, 1.0):
        env = spacecraft_v0.parallel_env(num_agents=2, disturbance_bound=bound)
        planner = lagros_policies.make("centralized", env).planner
        margins.append(planner.settings.margins[0])
    assert margins[1] > 2.0 * margins[0]


def test_lagros_arrives_and_the_filter_keeps_it_from_colliding():
    alone, filtered = fly("lagros", 0.6), fly("lagros", 0.6, filtered=True)
    assert alone["success"].mean() > 0.8
    assert filtered["success"].mean() > 0.93
    assert filtered["collided"].mean() < 0.03


def test_without_feedback_the_learned_plan_does_not_survive_the_disturbance():
    info = fly("learned", 0.6)
    assert info["success"].mean() < 0.5


@pytest.mark.parametrize("name", ["lagros", "learned"])
def test_the_training_record_describes_the_weights(name):
    record = json.loads((PRETRAINED / f"spacecraft_{name}.json").read_text())
    network = DeepSet.load(PRETRAINED / f"spacecraft_{name}.safetensors")
    assert (network.metadata["policy"], network.metadata["task"]) == (name, "spacecraft")
    assert record["policy"] == name
    assert record["weights"] == network.weights
    assert tuple(record["training"]["element"]) == tuple(
        bias.size for _, bias in network.layers["neighbour"]
    )
