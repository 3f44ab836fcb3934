"""What was trained or designed for one task flies no other, unless it is told to by name."""

import dataclasses
import json
import re

import numpy as np
import pytest

from lagros_envs import spacecraft_v0
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from lagros_envs.tasks.spacecraft.scenarios import PRESETS, Preset
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tube import PaperTube
from lagros_policies import NAMES, make
from lagros_policies.actor import Actor
from lagros_policies.export.source import load_source
from lagros_policies.learning.networks import read_safetensors, write_safetensors
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.spacecraft import SPACECRAFT_NAMES
from lagros_policies.trained_for import SETTINGS, training_of, weights_record
from tests.policies.shipped import shipped_metric

CARTPOLE_NETWORKS = ("learned", "lagros", "ppo", "sac", "td3", "residual")
SPACECRAFT_NETWORKS = ("learned", "lagros", "ppo")
# Every number of the task that a network of the cart-pole must be told of: by hand, as a new one
# must be thought about.
OTHER_TASKS = {
    "control_period": {"control_period": 0.05},
    "time_limit": {"time_limit": 18.0},
    "initial_angle": {"initial_angle": 1.2},
    "goal_range": {"goal_range": 6.0},
    "force_limit": {"force_limit": 30.0},
    **{
        f"system.{item.name}": {"system": dataclasses.replace(CartPole(), **{item.name: 0.07})}
        for item in dataclasses.fields(CartPole)
    },
}
# What changes nothing that a policy meets: how it is scored, and the unit of the action.
SAME_TASK = {
    "force_scale": 10.0,
    "effort_weight": 0.5,
    "distance_weight": 0.5,
    "upright_bonus": 1.0,
    "success_bonus": 1.0,
    "tube": PaperTube(1.0, 0.5),
    "initial_angle": 0.5,
    "goal_range": 2.0,
}
OTHER_BODIES = {
    "control_period": {"control_period": 0.05},
    "horizon": {"horizon": 20.0},
    "time_limit": {"time_limit": 60.0},
    "sensing_radius": {"sensing_radius": 3.0},
    "thrust_limit": {"thrust_limit": 0.5},
    **{
        f"system.{item.name}": {"system": dataclasses.replace(Spacecraft(), **{item.name: 2.0})}
        for item in dataclasses.fields(Spacecraft)
    },
}


SAME_SPACECRAFT = {
    "speed_limit",  # who stays below it meets nothing new
    "goal_radius",
    "tube",
    "thrust_scale",
    "progress_weight",
    "effort_weight",
    "success_bonus",
    "collision_penalty",
}


def test_every_setting_is_either_held_or_free():
    names = {item.name for item in dataclasses.fields(CartPoleSettings)} - {"system"}
    held = {name for name in OTHER_TASKS if not name.startswith("system.")}
    assert held | set(SAME_TASK) == names
    names = {item.name for item in dataclasses.fields(SpacecraftSettings)} - {"system"}
    held = {name for name in OTHER_BODIES if not name.startswith("system.")}
    assert held | SAME_SPACECRAFT == names


@pytest.mark.parametrize("name", CARTPOLE_NETWORKS)
@pytest.mark.parametrize("changed", OTHER_TASKS)
def test_a_network_flies_no_other_cart_pole(name, changed):
    env = CartPoleEnv(settings=CartPoleSettings(**OTHER_TASKS[changed]))
    with pytest.raises(ValueError, match=rf"^{re.escape(changed)}=.* was made for"):
        make(name, env)
    policy = make(name, env, allow_other_settings=True)
    assert np.isfinite(policy.predict(env.reset(seed=0)[0])[0]).all()


@pytest.mark.parametrize("name", CARTPOLE_NETWORKS)
def test_a_network_flies_what_is_within_its_training(name):
    for changed, value in SAME_TASK.items():
        assert make(name, CartPoleEnv(settings=CartPoleSettings(**{changed: value})))


def test_shorter_episodes_are_others_for_who_counts_on_their_end():
    env = CartPoleEnv(settings=CartPoleSettings(time_limit=5.0))
    for name in ("ppo", "sac", "td3"):
        assert make(name, env).name == name
    for name in ("learned", "lagros", "residual"):
        with pytest.raises(ValueError, match=r"^time_limit=5\.0: "):
            make(name, env)


@pytest.mark.parametrize("name", SPACECRAFT_NETWORKS)
@pytest.mark.parametrize("changed", OTHER_BODIES)
def test_a_network_flies_no_other_spacecraft(name, changed):
    env = spacecraft_v0.parallel_env(2, settings=SpacecraftSettings(**OTHER_BODIES[changed]))
    with pytest.raises(ValueError, match=rf"^{re.escape(changed)}=.* was made for"):
        make(name, env)
    assert make(name, env, allow_other_settings=True).name == name


@pytest.mark.parametrize("name", SPACECRAFT_NETWORKS)
def test_a_network_flies_any_number_of_bodies_that_it_has_met(name):
    for preset in PRESETS:
        if PRESETS[preset].task:
            # Limits of its own are another task, but for those networks that have learned there.
            env = spacecraft_v0.parallel_env(8, preset)
            if name in ("lagros", "ppo"):
                assert make(name, env).name == name
            else:
                with pytest.raises(ValueError, match=r"was made for"):
                    make(name, env)
            continue
        if name == "ppo" and preset == "released":
            continue
        for agents in (1, 6, 32):
            env = spacecraft_v0.parallel_env(agents, "swarm" if agents > 6 else preset)
            assert make(name, env).name == name
    for radii in ({"agent_radius": 0.4}, {"core_radius": 0.1}, {"obstacle_radius": 0.2}):
        env = spacecraft_v0.parallel_env(2, Preset(obstacle_count=(1, 1), **radii))
        with pytest.raises(ValueError, match=r"^radii=\[.* was made for one of"):
            make(name, env)
        assert make(name, env, allow_other_settings=True).name == name


def test_the_agent_that_knows_one_size_of_body_says_so():
    with pytest.raises(ValueError, match=r"^radii=\[0\.5, 0\.0, 0\.5\]"):
        make("ppo", spacecraft_v0.parallel_env(3, "released"))


@pytest.mark.parametrize("name", CARTPOLE_NETWORKS)
def test_weights_fly_only_as_the_policy_that_they_are(name):
    env = CartPoleEnv()
    for other in CARTPOLE_NETWORKS:
        file = PRETRAINED / f"cartpole_{other}.safetensors"
        if other == name:
            assert make(name, env, weights=file).name == name
            continue
        with pytest.raises(ValueError, match=re.escape(str(file))):
            make(name, env, weights=file, allow_other_settings=True)


@pytest.mark.parametrize("name", SPACECRAFT_NETWORKS)
def test_weights_of_the_spacecraft_fly_only_as_the_policy_that_they_are(name):
    env = spacecraft_v0.parallel_env(2)
    files = [PRETRAINED / f"spacecraft_{other}.safetensors" for other in SPACECRAFT_NETWORKS]
    files += [PRETRAINED / f"cartpole_{name}.safetensors"]
    for file in files:
        if file.stem == f"spacecraft_{name}":
            assert make(name, env, weights=file).name == name
            continue
        with pytest.raises(ValueError, match=re.escape(str(file))):
            make(name, env, weights=file)


def test_weights_of_another_policy_are_not_exported():
    with pytest.raises(ValueError, match="holds the policy 'learned' of the cartpole"):
        load_source("lagros-cartpole", PRETRAINED / "cartpole_learned.safetensors")
    with pytest.raises(ValueError, match="holds the policy 'learned' of the spacecraft"):
        load_source("lagros-spacecraft", PRETRAINED / "spacecraft_learned.safetensors")


def test_a_file_without_a_record_counts_as_of_the_papers_task(tmp_path):
    tensors, metadata = read_safetensors(PRETRAINED / "cartpole_ppo.safetensors")
    old = {name: text for name, text in metadata.items() if name not in ("task", "policy")}
    del old[SETTINGS]
    file = tmp_path / "old.safetensors"
    write_safetensors(file, tensors, old)
    assert make("ppo", CartPoleEnv(), weights=file).name == "ppo"
    assert make("sac", CartPoleEnv(), weights=file).name == "sac"
    longer = CartPoleEnv(settings=CartPoleSettings(time_limit=18.0))
    with pytest.raises(ValueError, match=r"^time_limit=18\.0: .*old\.safetensors"):
        make("ppo", longer, weights=file)


def test_a_record_of_another_task_is_for_that_task(tmp_path):
    longer = CartPoleSettings(time_limit=18.0, control_period=0.2)
    actor = Actor.load(PRETRAINED / "cartpole_ppo.safetensors")
    metadata = weights_record("cartpole", "ppo", training_of(longer).range(timed=True))
    file = tmp_path / "longer.safetensors"
    dataclasses.replace(actor, metadata=metadata).save(file)
    assert Actor.load(file).metadata == metadata
    assert make("ppo", CartPoleEnv(settings=longer), weights=file).name == "ppo"
    with pytest.raises(ValueError, match=r"^control_period=0\.1: .*longer"):
        make("ppo", CartPoleEnv(), weights=file)


@pytest.mark.parametrize("text", ["{", "[1]", '{"equal": 3}', "[" * 100_000])
def test_a_record_that_cannot_be_read_is_named(tmp_path, text):
    actor = Actor.load(PRETRAINED / "cartpole_ppo.safetensors")
    file = tmp_path / "odd.safetensors"
    dataclasses.replace(actor, metadata={SETTINGS: text}).save(file)
    with pytest.raises(ValueError, match=r"odd\.safetensors: its 'trained_for'"):
        make("ppo", CartPoleEnv(), weights=file)


def test_shipped_records_are_those_of_the_settings():
    metadata = read_safetensors(PRETRAINED / "cartpole_lagros.safetensors")[1]
    said = json.loads(metadata[SETTINGS])
    assert said["equal"]["time_limit"] == 9.0
    assert said["equal"]["system.half_length"] == 0.5
    assert said["at_most"] == {"goal_range": 5.0, "initial_angle": np.pi / 3}


def test_the_shipped_metric_tracks_no_other_cart_pole():
    longer = CartPoleSettings(system=dataclasses.replace(CartPole(), half_length=1.0))
    env = CartPoleEnv(settings=longer)
    for name in (
        "tube-mpc:least-norm",
        "tube-mpc:tuned",
        "lagros_policies.tasks.cartpole.remarks:AdaptiveTubeMpcPolicy",
        "lagros_policies.tasks.cartpole.remarks:NeuralTubeMpcPolicy",
    ):
        with pytest.raises(ValueError, match=r"^system\.half_length=1\.0: the shipped metric"):
            make(name, env)
        assert make(name, env, allow_other_settings=True)
    # Who names a metric says that it is for this cart-pole.
    assert make("tube-mpc", env, metric=shipped_metric()).name == "tube-mpc"
    assert make("tube-mpc:tuned", CartPoleEnv(settings=CartPoleSettings(time_limit=18.0)))
    # The metric along a plan is made for whatever system is planned for.
    assert make("tube-mpc", env)


def test_every_policy_takes_the_permission():
    for name in NAMES:
        assert make(name, CartPoleEnv(), allow_other_settings=True).name == name
    for name in SPACECRAFT_NAMES:
        env = spacecraft_v0.parallel_env(2)
        assert make(name, env, allow_other_settings=True).name == name


@pytest.mark.parametrize("name", ["learned", "lagros", "residual", "ppo", "sac", "td3"])
def test_a_network_flies_no_episode_that_asks_for_more_than_its_training(name):
    env = CartPoleEnv()
    policy = make(name, env)
    free = make(name, env, allow_other_settings=True)
    edge = {"initial_state": [0.0, -np.pi / 3, 0.0, 0.0], "goal": 5.0}
    observation, _ = env.reset(options=edge)
    assert np.array_equal(policy.predict(observation)[0], free.predict(observation)[0])
    for more in ({"goal": 6.0}, {"goal": -40.0}, {"initial_state": [0.0, 1.1, 0.0, 0.0]}):
        far, _ = env.reset(options=edge | more)
        for seen in (far, np.stack([observation, far])):
            with pytest.raises(ValueError, match=r"trained for at most 5 m and 1\.05 rad"):
                policy.predict(seen)
            assert np.isfinite(free.predict(seen)[0]).all()
