"""The whole experiment at a small size: every stage, an interruption, and the same files again."""

from __future__ import annotations

import filecmp
import os
from dataclasses import replace

import numpy as np
import pytest

from lagros_benchmarks.run.reproduce import ReproduceSettings
from lagros_benchmarks.run.reproduction import reproduce
from lagros_benchmarks.run.runner import run_benchmark
from lagros_benchmarks.tasks.spacecraft.reproduce import (
    SpacecraftReproduceSettings,
    training_part,
)
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_policies.learning.dataset import ExpertDataSettings
from lagros_policies.learning.metric import MetricSettings
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.train import TrainingSettings
from lagros_policies.learning.train_deep_set import DeepSetTraining
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.cartpole.metric_design import MetricDesignSettings
from lagros_policies.tasks.spacecraft.crowds import CrowdSettings
from lagros_policies.tasks.spacecraft.flights import FlightData, FlightSettings
from lagros_policies.tasks.spacecraft.station import StationSettings

FILES = (
    "metric.json",
    "cartpole_lagros.safetensors",
    "cartpole_lagros.json",
    "cartpole_learned.safetensors",
    "cartpole_learned.json",
    "cartpole_learned-mpc.safetensors",
    "cartpole_learned-mpc.json",
)
# A task in a file of one's own.
GLIDE = """
from lagros_envs.task import Defaults, Learning
from tests.policies.toys import Slide


class Glide(Slide):
    name, title = "glide", "Glide"
    learning = Learning()
    defaults = Defaults(bounds=(0.4,), bound=0.4)


task = Glide()
"""
DAMAGED = (".json", ".npz", ".safetensors")


class InterruptedRunError(Exception):
    pass


def small(**changes):
    training = TrainingSettings(hidden=(16,), epochs=4, checkpoint_every=1, held_out=0.25)
    settings = {
        "metric": MetricDesignSettings(plans=12, pool=1200, checks=200),
        "data": ExpertDataSettings(plans=8, samples=400, shards=2),
        "lagros": training,
        "learned": training,
        "replanned": tuple(ExpertDataSettings(4, 80, 2, seed=seed) for seed in range(2)),
        "mpc_between": training,
        "learned_mpc": training,
        "episodes": 2,
        "jobs": 1,
    }
    return ReproduceSettings(**(settings | changes))


@pytest.mark.slow
def test_an_interrupted_run_ends_with_the_files_of_one_that_was_not(tmp_path):
    benchmark = reproduce(tmp_path / "whole", small())

    def stop_in_training(title, done, total):
        if title == "train lagros" and done == 2:
            raise InterruptedRunError

    with pytest.raises(InterruptedRunError):
        reproduce(tmp_path / "broken", small(), progress=stop_in_training)
    assert not (tmp_path / "broken" / "cartpole_lagros.safetensors").exists()
    reproduce(tmp_path / "broken", small())
    same, different, missing = filecmp.cmpfiles(
        tmp_path / "whole", tmp_path / "broken", FILES, shallow=False
    )
    assert (sorted(same), different, missing) == (sorted(FILES), [], [])

    # A stage counts only if its files are whole.
    damaged = [path for path in (tmp_path / "broken").rglob("*") if path.suffix in DAMAGED]
    damaged = [path for path in damaged if path.stem not in ("settings", "manifest")]
    damaged = [path for path in damaged if "checkpoint" not in path.stem]
    # And two shards of each data set, and the network before the round of `learned-mpc`.
    assert len(damaged) == len(FILES) + 3 * 2 + 1
    for path in damaged:
        path.write_bytes(path.read_bytes()[:-20])
    said = []
    reproduce(tmp_path / "broken", small(), say=said.append)
    assert sum("it is made again" in line for line in said) == 5
    same, different, missing = filecmp.cmpfiles(
        tmp_path / "whole", tmp_path / "broken", FILES, shallow=False
    )
    assert (sorted(same), different, missing) == (sorted(FILES), [], [])

    shipped = Mlp.load(PRETRAINED / "cartpole_lagros.safetensors").metadata
    assert Mlp.load(tmp_path / "whole" / "cartpole_lagros.safetensors").metadata == shipped

    run = run_benchmark(benchmark)
    policies = {"learned", "learned-mpc", "tube-mpc", "lagros", "lqr"}
    assert {case.policy for case in run.episodes} == policies
    assert all(len(records) == 2 for records in run.episodes.values())

    other = TrainingSettings(hidden=(16,), epochs=5)
    with pytest.raises(ValueError, match="other settings"):
        reproduce(tmp_path / "whole", small(lagros=other))


@pytest.mark.slow
def test_a_task_of_ones_own_is_made_with_a_round_of_flights_and_gone_on_with(tmp_path):
    own = tmp_path / "glide.py"
    own.write_text(GLIDE, encoding="utf-8")
    training = TrainingSettings(hidden=(8, 8, 8), epochs=2, checkpoint_every=1)
    data = ExpertDataSettings(plans=20, samples=400, shards=2, disturbance_bound=0.4)
    settings = ReproduceSettings(
        str(own),
        MetricSettings(pool=1000, checks=500),
        data,
        rounds=(replace(data, seed=1),),
        between=training,
        lagros=training,
        learned=training,
        replanned=(data, replace(data, seed=1)),
        mpc_between=training,
        learned_mpc=training,
        episodes=2,
        jobs=1,
    )
    assert settings.bound == 0.4

    def stop_in_the_round(title, done, total):
        if title == "round 1" and done == 1:
            raise InterruptedRunError

    reproduce(tmp_path / "whole", settings)
    with pytest.raises(InterruptedRunError):
        reproduce(tmp_path / "broken", settings, stop_in_the_round)
    benchmark = reproduce(tmp_path / "broken", settings)
    files = [name.replace("cartpole", "glide") for name in FILES]
    same, different, missing = filecmp.cmpfiles(
        tmp_path / "whole", tmp_path / "broken", files, shallow=False
    )
    assert (sorted(same), different, missing) == (sorted(files), [], [])
    run = run_benchmark(benchmark)
    policies = {"learned", "learned-mpc", "tube-mpc", "lagros", "lqr"}
    assert {case.policy for case in run.episodes} == policies
    flown = next(records for case, records in run.episodes.items() if case.policy == "tube-mpc")
    assert all(record.success for record in flown)


def test_what_a_task_does_not_say_is_asked_for():
    with pytest.raises(ValueError, match="slide does not say how its networks are made"):
        ReproduceSettings("tests.policies.toys:Slide")


SPACECRAFT_FILES = tuple(
    f"spacecraft_{name}.{suffix}"
    for name in ("lagros", "learned", "crowds")
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
        station=StationSettings(
            flights=FlightSettings(worlds=2, worlds_per_shard=1, agents=(2,), seed=3)
        ),
        kept=StationSettings(
            flights=FlightSettings(worlds=2, worlds_per_shard=1, agents=(2,), seed=4)
        ),
        crowds=tuple(
            (
                CrowdSettings(
                    FlightSettings(
                        worlds=2, worlds_per_shard=1, agents=(2,), preset=preset, seed=seed
                    )
                ),
            )
            for preset, seed in (("swarm-45", 5), ("gcbf", 6))
        ),
        held_out=0.5,
        intermediate=training,
        lagros=training,
        crowd_training=training,
        learned=training,
        worlds=1,
        bounds=(0.4,),
        jobs=1,
    )


@pytest.mark.slow
def test_the_spacecraft_run_is_resumed_and_ends_with_the_same_files(tmp_path):
    benchmark = reproduce(tmp_path / "whole", small_spacecraft())

    def stop_in_flight(title, done, total):
        if title == "relabelled1" and done == 1:
            raise InterruptedRunError

    with pytest.raises(InterruptedRunError):
        reproduce(tmp_path / "broken", small_spacecraft(), stop_in_flight)
    assert not (tmp_path / "broken" / "spacecraft_lagros.safetensors").exists()
    reproduce(tmp_path / "broken", small_spacecraft())
    same, different, missing = filecmp.cmpfiles(
        tmp_path / "whole", tmp_path / "broken", SPACECRAFT_FILES, shallow=False
    )
    assert (sorted(same), different, missing) == (sorted(SPACECRAFT_FILES), [], [])
    assert {"learned", "tube-mpc", "lagros", "centralized"} == set(benchmark.policies)
    assert str(tmp_path) in benchmark.policy_settings["lagros"]["weights"]


def test_what_is_learned_from_a_network_has_sane_labels_and_nobody_at_rest():
    settings = SpacecraftReproduceSettings(label_limit=2.0, least_speed=0.1, held_out=0.5)
    layout = Layout(1, 1, 45.0)
    observation = np.zeros((5, layout.size), np.float32)
    observation[:, layout.slices["goal"]] = (3.0, 0.0)
    observation[:, layout.slices["velocity"]] = (0.0, 0.2)
    observation[:, layout.slices["time"]] = 10.0
    observation[1, layout.slices["velocity"]] = 0.01  # at rest under way
    observation[2, layout.slices["velocity"]] = 0.01  # at rest at the goal
    observation[2, layout.slices["goal"]] = 0.1
    label = np.array([[6.0, -8.0, 1.0], [1, 1, 1], [0.1, 0.2, 9.0], [1, 1, 1], [0, 0, 0]])
    world = np.array([1, 1, 3, 2, 3])  # of every second world nothing is learned
    data = FlightData(observation, label.astype(np.float32), world, layout, 1, 0)
    kept = training_part(data, settings)
    np.testing.assert_array_equal(kept.world, [1, 3, 3])
    np.testing.assert_allclose(
        kept.acceleration, [[1.2, -1.6, 1.0], [0.1, 0.2, 9.0], [0, 0, 0]], rtol=1e-6
    )


SWAY = """
from dataclasses import dataclass

import numpy as np

from lagros_envs.task import Learning, MetricDesign, Scenario, Task


class Pendulum:
    state_dim, control_dim = 2, 1

    def derivative(self, state, control, functions):
        return state[1], functions.sin(state[0]) - 0.2 * state[1] + control[0]


@dataclass(frozen=True)
class Sway(Task):
    system: Pendulum = Pendulum()
    time_limit: float = 2.0
    name, title = "sway", "Sway"
    control_scale = (9.0,)
    metric = MetricDesign((-1.0, -2.0), (1.0, 2.0), (0.3, 0.3), (-9.0,), (9.0,))
    learning = Learning()

    def sample(self, rng):
        return Scenario(rng.uniform(-0.5, 0.5, 2), np.zeros(2))
"""


def test_a_task_of_ones_own_that_has_changed_does_not_go_on_with_a_run(tmp_path, monkeypatch):
    """Whatever of it has changed; what it looks like, and how it is called, may."""
    monkeypatch.setattr("lagros_benchmarks.run.making.Making.run", lambda making: None)
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "sway.py"
    path.write_text(SWAY)
    reproduce(tmp_path / "run", ReproduceSettings("./sway.py", jobs=1))
    path.write_text(SWAY + "\n    def outline(self, state):\n        return ()\n")
    os.utime(path, ns=(1, 1))
    reproduce(tmp_path / "run", ReproduceSettings(f"{path}:Sway", jobs=1))
    changes = [
        ("0.2 * state[1]", "0.3 * state[1]"),
        ("(9.0,)\n    metric", "(9.0,)\n    control_high = (9.0,)\n    metric"),
        ("(0.3, 0.3)", "(0.3, 0.2)"),
        ("rng.uniform(-0.5", "rng.uniform(-0.4"),
        ("time_limit: float = 2.0", "time_limit: float = 3.0"),
    ]
    for number, change in enumerate(changes, 2):
        path.write_text(SWAY.replace(*change))
        os.utime(path, ns=(number, number))
        with pytest.raises(ValueError, match="holds a run of other settings; name another folder"):
            reproduce(tmp_path / "run", ReproduceSettings("sway.py", jobs=1))
