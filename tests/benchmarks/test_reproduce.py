"""The whole experiment at a small size: every stage, an interruption, and the same files again."""

from __future__ import annotations

import filecmp

import pytest

from lagros_benchmarks.reproduce import ReproduceSettings, reproduce_cartpole
from lagros_benchmarks.reproduce_spacecraft import (
    SpacecraftReproduceSettings,
    reproduce_spacecraft,
)
from lagros_benchmarks.runner import run_benchmark
from lagros_policies.imitation.dataset import ExpertDataSettings
from lagros_policies.imitation.spacecraft_flights import FlightSettings
from lagros_policies.imitation.train import TrainingSettings
from lagros_policies.imitation.train_deep_set import DeepSetTraining
from lagros_policies.metric_design import MetricDesignSettings

FILES = (
    "metric.json",
    "cartpole_lagros.safetensors",
    "cartpole_lagros.json",
    "cartpole_learned.safetensors",
    "cartpole_learned.json",
)


class InterruptedRunError(Exception):
    pass


def small(**changes):
    training = TrainingSettings(hidden=(16,), epochs=4, checkpoint_every=1, held_out=0.25)
    settings = {
        "metric": MetricDesignSettings(plans=12, pool=1200, checks=200),
        "data": ExpertDataSettings(plans=8, samples=400, shards=2),
        "lagros": training,
        "learned": training,
        "episodes": 2,
        "jobs": 1,
    }
    return ReproduceSettings(**(settings | changes))


@pytest.mark.slow
def test_an_interrupted_run_ends_with_the_files_of_one_that_was_not(tmp_path):
    benchmark = reproduce_cartpole(tmp_path / "whole", small())

    def stop_in_training(title, done, total):
        if title == "train lagros" and done == 2:
            raise InterruptedRunError

    with pytest.raises(InterruptedRunError):
        reproduce_cartpole(tmp_path / "broken", small(), progress=stop_in_training)
    assert not (tmp_path / "broken" / "cartpole_lagros.safetensors").exists()
    reproduce_cartpole(tmp_path / "broken", small())
    same, different, missing = filecmp.cmpfiles(
        tmp_path / "whole", tmp_path / "broken", FILES, shallow=False
    )
    assert (sorted(same), different, missing) == (sorted(FILES), [], [])

    run = run_benchmark(benchmark)
    assert {case.policy for case in run.episodes} == {"learned", "tube-mpc", "lagros", "lqr"}
    assert all(len(records) == 2 for records in run.episodes.values())

    other = TrainingSettings(hidden=(16,), epochs=5)
    with pytest.raises(ValueError, match="other settings"):
        reproduce_cartpole(tmp_path / "whole", small(lagros=other))


SPACECRAFT_FILES = tuple(
    f"spacecraft_{name}.{suffix}"
    for name in ("lagros", "learned")
    for suffix in ("safetensors", "json")
)


def small_spacecraft():
    flights = FlightSettings(worlds=2, worlds_per_shard=1, agents=(2,))
    training = DeepSetTraining((8,), (8,), epochs=2)
    return SpacecraftReproduceSettings(
        flights=flights,
        calm=FlightSettings(
            worlds=1, worlds_per_shard=1, agents=(2,), disturbance_bound=0.0, seed=1
        ),
        rounds=(
            FlightSettings(worlds=2, worlds_per_shard=1, agents=(2,), replan_period=9.0, seed=2),
        ),
        held_out=0.5,
        intermediate=training,
        lagros=training,
        learned=training,
        worlds=1,
        bounds=(0.4,),
        jobs=1,
    )


@pytest.mark.slow
def test_the_spacecraft_run_is_resumed_and_ends_with_the_same_files(tmp_path):
    benchmark = reproduce_spacecraft(tmp_path / "whole", small_spacecraft())

    def stop_in_flight(title, done, total):
        if title == "relabelled1" and done == 1:
            raise InterruptedRunError

    with pytest.raises(InterruptedRunError):
        reproduce_spacecraft(tmp_path / "broken", small_spacecraft(), stop_in_flight)
    assert not (tmp_path / "broken" / "spacecraft_lagros.safetensors").exists()
    reproduce_spacecraft(tmp_path / "broken", small_spacecraft())
    same, different, missing = filecmp.cmpfiles(
        tmp_path / "whole", tmp_path / "broken", SPACECRAFT_FILES, shallow=False
    )
    assert (sorted(same), different, missing) == (sorted(SPACECRAFT_FILES), [], [])
    assert {"learned", "tube-mpc", "lagros", "centralized"} == set(benchmark.policies)
    assert str(tmp_path) in benchmark.policy_settings["lagros"]["weights"]
