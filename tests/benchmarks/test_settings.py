"""Settings are checked when they are built; evaluation never meets a training scenario."""

from __future__ import annotations

import pytest

import lagros_policies
from lagros_benchmarks.run.settings import BenchmarkSettings, check_policy
from lagros_benchmarks.worst_case.attack import AttackSettings
from lagros_envs import spacecraft_v0
from lagros_envs.registry import task_named, task_names
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_policies.tasks.spacecraft import SPACECRAFT_NAMES


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "cartpol"}, "Did you mean 'cartpole'"),
        ({"disturbances": ("unifrom",)}, "Did you mean 'uniform'.*none, uniform, sphere"),
        ({"bounds": (float("nan"),)}, "finite"),
        ({"bounds": (-0.1,)}, ">= 0"),
        ({"bounds": ()}, "bounds must not be empty"),
        ({"policies": ("lqr", "lqr")}, "twice"),
        ({"channels": "rate"}, "Did you mean 'rates'"),
        ({"episodes": 0}, "episodes=0 must be a whole number"),
        ({"jobs": -1}, "jobs=-1 must be a whole number"),
        ({"chunk": 0}, "chunk"),
        ({"seed": -1}, "non-negative"),
        ({"policy_settings": {"ppo": {}}}, "ppo"),
    ],
)
def test_a_wrong_setting_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        BenchmarkSettings(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"preset": "papper"}, "Did you mean 'paper'. Valid: paper, released, crossing"),
        ({"safety_filter": "some"}, "Valid: none, all, both"),
        ({"agents": ()}, "agents must not be empty"),
        ({"agents": (0,)}, "agents=0 must be a whole number"),
        ({"agents": (3, 3)}, "twice"),
        ({"disturbances": ("uniform", "worst")}, "'worst' pushes away from one nominal"),
    ],
)
def test_a_wrong_setting_of_the_spacecraft_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        BenchmarkSettings.for_task("spacecraft", **changes)


SINGLE = [name for name in task_names() if task_named(name).most_agents == 1]


@pytest.mark.parametrize(
    "changes", [{"preset": "paper"}, {"agents": (6,)}, {"safety_filter": "both"}]
)
@pytest.mark.parametrize("task", SINGLE)
def test_one_body_has_no_settings_of_many_agents(task, changes):
    with pytest.raises(ValueError, match=f"does not fit: {task} is one body; leave it out"):
        BenchmarkSettings.for_task(task, **changes)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_has_its_own_number_of_agents(preset):
    own = PRESETS[preset].agents
    bench = BenchmarkSettings.for_task("spacecraft", preset=preset)
    assert (bench.preset, bench.agents) == (preset, (own,))
    attack = AttackSettings.for_task("spacecraft", "hybrid", None, preset=preset)
    assert (attack.preset, attack.agents) == (preset, own)
    assert BenchmarkSettings.for_task("spacecraft", preset=preset, agents=(3,)).agents == (3,)
    assert AttackSettings.for_task("spacecraft", "hybrid", 99, preset=preset, agents=2).agents == 2


@pytest.mark.parametrize("preset", PRESETS)
def test_what_flies_where_nobody_is_named_is_made_for_the_preset(preset):
    env = spacecraft_v0.parallel_env(preset=preset)
    for policy in BenchmarkSettings.for_task("spacecraft", preset=preset).policies:
        assert lagros_policies.make(policy, env).settings == env.settings


def test_each_task_has_its_own_defaults():
    assert BenchmarkSettings.for_task("cartpole", bounds=None) == BenchmarkSettings()
    settings = BenchmarkSettings.for_task("spacecraft", episodes=None, jobs=2)
    # The four of the paper; other laws, and what reinforcement learning trained, by name.
    assert settings.policies == ("learned", "tube-mpc", "lagros", "centralized")
    assert settings.bounds == (0.2, 0.4, 0.6, 0.8, 1.0)
    assert (settings.preset, settings.agents, settings.jobs) == ("paper", (6,), 2)
    # Every policy with and without the filter.
    assert len(settings.cases) == 4 * 2 * 5
    # A comparison of numbers of agents has one bound, unless more are asked for.
    assert BenchmarkSettings.for_task("spacecraft", agents=(1, 6)).bounds == (0.4,)
    assert BenchmarkSettings.for_task("spacecraft", agents=(1, 6), bounds=(1.0,)).bounds == (1.0,)
    with pytest.raises(ValueError, match="Did you mean 'spacecraft'"):
        BenchmarkSettings.for_task("spacecrafts")


def test_every_kind_meets_every_bound_and_none_comes_once():
    settings = BenchmarkSettings(disturbances=("none", "gust"), bounds=(0.1, 0.2))
    assert settings.conditions == (("none", 0.0), ("gust", 0.1), ("gust", 0.2))


def test_a_longer_run_begins_with_a_shorter():
    assert (
        BenchmarkSettings(episodes=20).episode_seeds()[:5]
        == BenchmarkSettings(episodes=5).episode_seeds()
    )


@pytest.mark.parametrize("seed", [0, 1, 12345])
def test_evaluation_never_meets_a_training_scenario(seed):
    evaluation = set(BenchmarkSettings(seed=seed, episodes=2000).episode_seeds())
    # Also not of a training seed that holds the namespace itself in its next word.
    for training_seed in (0, 1, seed, seed + (EVALUATION << 32), EVALUATION):
        assert evaluation.isdisjoint(episode_seeds(training_seed, 2000))


@pytest.mark.parametrize("name", lagros_policies.NAMES)
def test_every_name_of_the_library_is_a_policy(name):
    check_policy(name)


def test_the_names_are_those_of_the_task():
    for name in SPACECRAFT_NAMES:
        check_policy(name, "spacecraft")
    with pytest.raises(ValueError, match="unknown policy 'centralized'"):
        check_policy("centralized")
    with pytest.raises(ValueError, match=f"Valid: {', '.join(SPACECRAFT_NAMES)},"):
        check_policy("lqr", "spacecraft")


def test_a_policy_may_be_a_file(tmp_path):
    model = tmp_path / "model.zip"
    model.write_bytes(b"")
    check_policy(str(model))
    check_policy(f"sac:{model}")
    with pytest.raises(ValueError, match=r"there is no file 'missing.zip'"):
        check_policy("missing.zip")


def test_a_mistyped_policy_gets_a_suggestion_and_the_list():
    with pytest.raises(ValueError, match=r"Did you mean 'tube-mpc'\? Valid: learned, learned-mpc"):
        check_policy("tubempc")
