"""Policies that are objects: the same run as by their names, and none sees what another left."""

from __future__ import annotations

import dataclasses
import threading
from importlib import resources

import numpy as np
import pytest

from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.run.library import SetupError, Toolbox
from lagros_benchmarks.run.runner import fly_scene, kept_in, run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from tests.benchmarks import fakes, spacecraft_fakes


@dataclasses.dataclass
class Tiring(fakes.LinearPolicy):
    """Balances worse with each of its calls, so that what it has flown before is seen."""

    calls: int = 0

    @classmethod
    def made_for(cls, name, env, settings):
        return cls()

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.calls += 1
        action, state = super().predict(observation, state, episode_start, deterministic)
        return action * np.float32(1.0 - 1e-4 * self.calls), state


def settings_of(*policies, **changes):
    return BenchmarkSettings(**{"policies": policies, "episodes": 6, "chunk": 3, **changes})


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_object_flies_as_the_class_that_makes_it(jobs):
    by_name = dataclasses.replace(fakes.EASY, make_policy=Tiring.made_for)
    named = run_benchmark(settings_of("mine", jobs=jobs), by_name)
    tiring = Tiring()
    given = run_benchmark(settings_of("mine", jobs=jobs), fakes.EASY, policies={"mine": tiring})
    assert given.episodes == named.episodes
    assert tiring.calls == 0
    for case, records in given.episodes.items():
        for one, two in zip(records, named.episodes[case], strict=True):
            np.testing.assert_array_equal(one.tracking_error, two.tracking_error)


def test_objects_fly_beside_names_and_after_them():
    objects = {"mine": fakes.LinearPolicy(scale=0.9), "idler": fakes.IdlePolicy()}
    run = run_benchmark(settings_of("idler", "steady"), fakes.EASY, policies=objects)
    rows = summarise(run, ["here"])
    assert [row["policy"] for row in rows] == ["idler", "steady", "mine"]
    assert [row["success_rate"] for row in rows] == [0.0, 1.0, 1.0]
    assert set(rows[2]["versus"]) == {"idler", "steady"}


def test_objects_fly_spacecraft_and_scenes():
    settings = BenchmarkSettings.for_task(
        "spacecraft", policies=("mine",), episodes=1, agents=(2,), bounds=(0.3,), timing_episodes=1
    )
    toolbox, objects = spacecraft_fakes.TOOLBOX, {"mine": spacecraft_fakes.IdlePolicy()}
    run = run_benchmark(settings, toolbox, policies=objects)
    assert [case.safety_filter for case in run.episodes] == [False, True]
    (panel,) = fly_scene(settings, 0, toolbox, objects).panels
    assert panel.world.seed == settings.episode_seeds()[0]


def test_what_is_no_policy_is_refused_before_the_first_episode(tmp_path):
    plain = dataclasses.replace(fakes.EASY, make_policy=Toolbox().make_policy)
    with pytest.raises(SetupError, match="'mine' is the class IdlePolicy; it must be an object"):
        run_benchmark(
            settings_of("mine"), plain, policies={"mine": lambda settings: fakes.IdlePolicy}
        )
    with pytest.raises(SetupError, match="'mine' cannot fly: a object has no method predict"):
        run_benchmark(settings_of("mine"), fakes.EASY, policies={"mine": object()})
    locked = fakes.IdlePolicy()
    locked.lock = threading.Lock()
    with pytest.raises(SetupError, match="'mine' cannot be built: TypeError: cannot pickle"):
        run_benchmark(settings_of("mine"), fakes.EASY, policies={"mine": locked})
    with pytest.raises(ValueError, match="'lqr' is a policy of this package"):
        run_benchmark(settings_of("mine"), fakes.EASY, policies={"lqr": fakes.IdlePolicy()})
    settings = settings_of("mine", policy_settings={"mine": {"scale": 1.0}})
    with pytest.raises(SetupError, match="'mine' is an object, which is not built with settings"):
        run_benchmark(settings, fakes.EASY, policies={"mine": fakes.IdlePolicy()})
    kept = kept_in(tmp_path, settings_of("mine"), Toolbox())
    with pytest.raises(ValueError, match="cannot tell policies that are objects apart"):
        run_benchmark(settings_of("mine"), kept=kept, policies={"mine": fakes.IdlePolicy()})


@pytest.mark.parametrize("name", [1, None, "", " ", " mine", "mi\nne", "mine\x1b", "lqr+filter"])
def test_an_object_has_a_name_that_a_table_can_hold(name):
    with pytest.raises(ValueError, match=r"policies: .* is no name; take text of one line"):
        run_benchmark(settings_of("lqr"), fakes.EASY, policies={name: fakes.IdlePolicy()})


@pytest.mark.parametrize("policies", [[fakes.IdlePolicy()], fakes.IdlePolicy(), "mine"])
def test_objects_come_by_name(policies):
    with pytest.raises(ValueError, match=r"policies=.* must be a dictionary"):
        run_benchmark(settings_of("lqr"), fakes.EASY, policies=policies)


@pytest.mark.parametrize("settings", [None, {"episodes": 2}, "lqr"])
def test_what_are_no_settings_is_said_in_one_line(settings, tmp_path):
    for run in (run_benchmark, lambda settings: kept_in(tmp_path, settings)):
        with pytest.raises(ValueError, match=r"settings=.* must be a BenchmarkSettings$"):
            run(settings)
    with pytest.raises(ValueError, match=r"kept=.* must be a Kept, as kept_in gives"):
        run_benchmark(settings_of("lqr"), fakes.EASY, kept="folder")


def test_the_package_says_that_it_is_typed():
    assert resources.files("lagros_benchmarks").joinpath("py.typed").is_file()
