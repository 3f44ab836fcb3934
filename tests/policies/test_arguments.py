"""Arguments of every policy that make no sense: one line that names them, whatever they are."""

import inspect
import math
from pathlib import Path

import numpy as np
import pytest

from lagros_envs.registry import task_named
from lagros_envs.tasks.spacecraft.scenarios import Scenario
from lagros_policies import make
from lagros_policies.actor import Actor
from lagros_policies.contraction import load_metric
from lagros_policies.learning.deep_set import DeepSet
from lagros_policies.learning.networks import Mlp
from lagros_policies.policy import _places
from lagros_policies.sb3_model import load_stable_baselines3
from lagros_policies.tasks.cartpole.neural.metric import load_neural_metric
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter
from tests.policies.test_objects import CARTPOLE, SLIDING, SPACECRAFT, world

HUGE = 10**400
# None of them is a value of any argument.
SENSELESS = [math.nan, 1j, [1], np.zeros(2), object(), b"1", {"a": 1}, HUGE, -1, "\nx"]


def kind_of(task, name):
    module, _, attribute = _places(task_named(task)).get(name, name).partition(":")
    return getattr(__import__(module, fromlist=[attribute]), attribute)


def arguments(task, name):
    found = {}
    for kind in kind_of(task, name).__mro__:
        parameters = inspect.signature(kind).parameters.values()
        rest = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        passed_on = [one for one in parameters if one.kind in rest]
        found |= dict.fromkeys(one.name for one in parameters if one not in passed_on)
        if not passed_on:
            break
    return list(found)


POLICIES = [("cartpole", name) for name in CARTPOLE]
POLICIES += [("spacecraft", name) for name in SPACECRAFT if "+" not in name]
EACH = [(task, name, argument) for task, name in POLICIES for argument in arguments(task, name)]


def refused(build, argument, value):
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        build()
    text = str(caught.value)
    assert "\n" not in text
    # A file is named by its path.
    path = isinstance(value, str) and repr(value) in text
    assert path or any(word in text for word in (argument, "path of a file")), text


@pytest.mark.parametrize(("task", "name", "argument"), EACH)
def test_an_argument_that_makes_no_sense_is_refused_by_name(task, name, argument):
    env = world(task)
    for value in SENSELESS:
        if argument == "replan_every" and value is HUGE:
            continue  # a whole number: it plans once
        if argument == "control_weights" and isinstance(value, list):
            continue  # one weight of the one control
        if argument == "settings":
            refused(lambda value=value: kind_of(task, name)(value), argument, value)
        else:
            refused(lambda value=value: make(name, env, **{argument: value}), argument, value)


@pytest.mark.parametrize("permission", ["allow_wrappers", "allow_other_settings"])
@pytest.mark.parametrize("value", ["no", "", 1, 0, None, [True]])
def test_only_true_permits(permission, value):
    for task, name in (("cartpole", "lqr"), ("spacecraft", "centralized"), ("cartpole", "lagros")):
        with pytest.raises(ValueError, match=f"{permission}=.* must be True or False"):
            make(name, world(task), **{permission: value})


def test_settings_come_with_the_environment():
    with pytest.raises(ValueError, match="settings: a policy takes those of the environment"):
        make("lqr", world("cartpole"), settings={"force_limit": 5.0})


@pytest.mark.parametrize("name", ["lagros", "tube-mpc", "centralized"])
def test_the_preset_comes_with_the_environment(name):
    env = world("spacecraft")
    for other in ({"preset": "released"}, {"preset": {"agents": 3}}, {"num_agents": 3}):
        with pytest.raises(ValueError, match=f"{next(iter(other))}: a policy takes those of the"):
            make(name, env, **other)
    for same in ({"preset": env.preset}, {"preset": "open", "num_agents": 2}, {"num_agents": 2}):
        assert make(name, env, **same).preset == env.preset


@pytest.mark.parametrize("name", [None, 3, ["lqr"], Path("lqr"), b"lqr"])
def test_the_name_of_a_policy_is_text(name):
    with pytest.raises(ValueError, match=r"name=.* must be text"):
        make(name, world("cartpole"))


def test_a_class_takes_the_settings_that_an_environment_takes():
    slow = kind_of("cartpole", "tube-mpc")({"time_limit": 3.0})
    assert slow.settings.time_limit == 3.0
    far = kind_of("spacecraft", "tube-mpc")({"thrust_limit": 0.5}, {"agents": 3})
    assert (far.settings.thrust_limit, far.preset.agents) == (0.5, 3)


def test_weights_of_a_regulator_that_have_no_gain_are_named():
    with pytest.raises(ValueError, match=r"force_weight=\[1e\+300\] .* no gain is found"):
        make("lqr", world("cartpole"), force_weight=1e300)
    with pytest.raises(ValueError, match=r"state_weights=.* must be 4 finite numbers"):
        make("lqr", world("cartpole"), state_weights=["1"] * 4)


@pytest.mark.parametrize("name", ["tube-mpc", "centralized", SLIDING])
def test_nothing_is_prepared_for_a_bound_that_no_world_has(name):
    with pytest.raises(ValueError, match=r"disturbance_bound=1e\+300 must be .* at most"):
        make(name, world("spacecraft"), disturbance_bound=1e300)


def test_the_filter_is_for_a_policy_and_a_task():
    policy = make("lagros", world("spacecraft"))
    for settings in (3, "x", [1]):
        with pytest.raises(ValueError, match="settings="):
            SafetyFilter(policy, settings)
    for bound in (-1, math.nan, "x", 1e300):
        with pytest.raises(ValueError, match="disturbance_bound="):
            SafetyFilter(policy, disturbance_bound=bound)
    with pytest.raises(ValueError, match="barrier="):
        SafetyFilter(policy, barrier=3)


READERS = [
    Scenario.load,
    Mlp.load,
    DeepSet.load,
    Actor.load,
    load_metric,
    load_neural_metric,
    load_stable_baselines3,
]


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("path", [3, b"file", True, ["file"], object()])
def test_what_is_no_path_is_said_in_one_line(read, path):
    with pytest.raises(ValueError, match=r"must be the path of a file$"):
        read(path)
