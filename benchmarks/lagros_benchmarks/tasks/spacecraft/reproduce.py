"""The spacecraft experiment from nothing: expert flights, networks (a) and (c), their benchmark.

The networks of (c) are fitted in rounds: the first to flights of the expert, each later one also to
what the one before it met when it flew, labelled by the expert (DAgger). A further stage teaches
how station is kept, and the last how crowds are flown. Every stage leaves its files in the run's
folder and is skipped where they are whole. The same settings give the same files, bit for bit on
one machine.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from lagros_benchmarks.run.experiment import Progress
from lagros_benchmarks.run.reproduction import Say, made_before
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_envs.arrays import BoolArray, IntArray
from lagros_envs.checks import check_fields
from lagros_envs.files import write_atomic
from lagros_envs.tasks.spacecraft.scenarios import preset_named
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.backends import LOKY, Backend
from lagros_policies.learning.deep_set import DeepSet
from lagros_policies.learning.train_deep_set import (
    DeepSetTraining,
    SetSamples,
    fit_deep_set,
    join,
    only,
)
from lagros_policies.tasks.spacecraft.crowds import CrowdSettings, fly_crowd, usual_rounds
from lagros_policies.tasks.spacecraft.expert import SpacecraftExpertSettings
from lagros_policies.tasks.spacecraft.flights import (
    FlightData,
    FlightSettings,
    flight_samples,
    fly_expert,
)
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.setup import CROWDED, PUBLISHED, spacecraft_range
from lagros_policies.tasks.spacecraft.station import StationSettings, fly_station
from lagros_policies.trained_for import weights_record

BOUNDS = (0.2, 0.4, 0.6, 0.8, 1.0)
_RELABELLED = "relabelled"
# Who is slow here is at rest, and not at the start or the goal.
_FAR = 0.4  # [m]
_UNDER_WAY = 2.0  # [s]


def _rounds() -> tuple[FlightSettings, ...]:
    # The network knows no plan, only what is near: stiffer labels make up for that.
    stiff = SpacecraftExpertSettings(contraction_rate=3.0, start_weight=0.25)
    # One round: in later ones agents come to rest, and labels that would move them left or right
    # add up to nothing (docs/results-spacecraft.md).
    return (FlightSettings(worlds=800, replan_period=4.0, expert=stiff, seed=11),)


@dataclass(frozen=True)
class SpacecraftReproduceSettings:
    """All that the weights and the table depend on.

    Attributes:
        flights: Flights of the expert under disturbance.
        calm: Its flights without, which (a) imitates.
        rounds: Flights of one network after the other, labelled by the expert.
        station: Flights of the last of these networks, labelled at the goal by one gain.
        crowds: Flights of crowds, in rounds; the guide flies the first, networks the others.
        kept: Flights of the network before these, labelled by itself: what it is not to forget.
        kept_weight: How often the samples of these count, those of crowds once.
        relabelled_weight: How often the samples of these flights count, others once.
        label_limit: Longer labels of these flights are shortened to this [m/s^2]: a plan that
            begins well beside an agent asks for more than it takes to get there.
        least_speed: Samples of these flights of agents slower than this [m/s], under way and far
            from the goal, are left out: rest has no side, and teaches to rest.
        held_out: Share of the worlds of the last round whose samples are never trained on.
        intermediate: Training of the networks of the rounds.
        lagros: Training of (c), from the weights of the last network.
        crowd_training: Training of the networks that fly crowds, each from the weights of the one
            before; the last is (c) of worlds of many.
        learned: Training of (a).
        worlds: Paired worlds of the table at each bound.
        bounds: d_bar of the table, uniform in the ball.
        seed: Seed of the table.
        jobs: Processes; they change no result.
        backend: Whose processes they are; those of a cluster must see the run's folder.

    Raises:
        ValueError: A setting of the table is not valid.
    """

    flights: FlightSettings = field(
        default_factory=lambda: FlightSettings(worlds=2000, sample_every=12, seed=0)
    )
    calm: FlightSettings = field(
        default_factory=lambda: FlightSettings(worlds=300, disturbance_bound=0.0, seed=1)
    )
    rounds: tuple[FlightSettings, ...] = field(default_factory=_rounds)
    station: StationSettings = field(default_factory=StationSettings)
    crowds: tuple[tuple[CrowdSettings, ...], ...] = field(default_factory=usual_rounds)
    kept: StationSettings = field(
        default_factory=lambda: StationSettings(
            flights=FlightSettings(worlds=150, sample_every=9, seed=31)
        )
    )
    kept_weight: int = 4
    relabelled_weight: int = 3
    label_limit: float = 2.0
    least_speed: float = 0.12
    held_out: float = 0.1
    intermediate: DeepSetTraining = field(default_factory=DeepSetTraining)
    lagros: DeepSetTraining = field(
        default_factory=lambda: DeepSetTraining(epochs=4, learning_rate=1e-3)
    )
    crowd_training: DeepSetTraining = field(default_factory=lambda: DeepSetTraining(epochs=6))
    learned: DeepSetTraining = field(default_factory=lambda: DeepSetTraining(epochs=4))
    worlds: int = 20
    bounds: tuple[float, ...] = BOUNDS
    seed: int = 0
    jobs: int = 2
    backend: Backend = LOKY
    free: ClassVar[tuple[str, ...]] = ("jobs", "backend", "worlds", "seed", "bounds")

    @classmethod
    def for_task(cls, task: str, episodes: int | None, **asked: Any) -> SpacecraftReproduceSettings:
        """Return the settings of a run; see `run.reproduction.Reproduction`."""
        return cls(**asked | ({} if episodes is None else {"worlds": episodes}))

    def __post_init__(self) -> None:
        """Check, before hours of work, what the benchmark at their end will ask."""
        check_fields(self)
        self.benchmark(None)

    def make(self, folder: Path, progress: Progress, say: Say) -> None:
        """Make expert flights and networks; see `reproduction.reproduce`."""
        stage = _Stage(folder, self, progress, say)
        calm = stage.fly("calm flights", self.calm, None)
        stage.fit("learned", self.learned, [stage.samples(calm)], stage.samples(calm))
        parts = [stage.samples(stage.fly("flights", self.flights, None))]
        learner = stage.fit("round0", self.intermediate, parts, parts[0])
        for index, flights in enumerate(self.rounds, start=1):
            met = stage.fly(f"{_RELABELLED}{index}", flights, learner)
            kept = stage.samples(training_part(met, self))
            parts += [kept] * self.relabelled_weight
            test = stage.samples(_only(met, _split(met, self.held_out)))
            learner = stage.fit(f"round{index}", self.intermediate, parts, test)
        stage.crowds(stage.station(learner))

    def benchmark(self, folder: Path | None) -> BenchmarkSettings:
        """Return the benchmark of (a), (b), (c) and (d), with a folder's weights or ours."""
        weights = {}
        if folder is not None:
            weights = {name: {"weights": str(_weights(folder, name))} for name in _NETWORKS}
        return BenchmarkSettings.for_task(
            "spacecraft",
            episodes=self.worlds,
            bounds=self.bounds,
            seed=self.seed,
            policy_settings=weights,
            jobs=self.jobs,
            backend=self.backend,
            # Tube MPC takes most of the time of a timing pass, which is serial.
            timing_episodes=2,
        )


_NETWORKS = ("lagros", "learned")


@dataclass
class _Stage:
    """The stages of one run, each resumable."""

    folder: Path
    settings: SpacecraftReproduceSettings
    progress: Progress
    say: Say
    task: SpacecraftSettings = field(default_factory=SpacecraftSettings)

    def fly(self, name: str, flights: FlightSettings, learner: Path | None) -> FlightData:
        """Fly and label."""
        begun = perf_counter()
        data = fly_expert(
            self.folder / name.replace(" ", "_"),
            flights,
            self.task,
            learner,
            self.settings.jobs,
            lambda done: self.progress(name, done, flights.shards),
            self.settings.backend,
        )
        self.say(
            f"{name} ({perf_counter() - begun:.0f} s): {len(data.observation)} samples in "
            f"{flights.worlds} worlds, {data.failed_plans} of {data.plans} plans failed"
        )
        return data

    def station(self, learner: Path) -> Path:
        """Teach the last network how station is kept: (c)."""
        data = self._fly_station("station", self.settings.station, learner)
        held_out = _split(data, self.settings.held_out)
        parts, test = [self.samples(_only(data, ~held_out))], self.samples(_only(data, held_out))
        training = self.settings.lagros
        return self.fit("lagros", training, parts, test, learner, _labels_error(learner))

    def crowds(self, learner: Path) -> None:
        """Teach that network how crowds are flown: (c) of worlds of many."""
        settings = self.settings
        kept = self.samples(self._fly_station("kept", settings.kept, learner))
        parts = [kept] * settings.kept_weight
        rounds = settings.crowds
        more = json.loads(learner.with_suffix(".json").read_text())
        for index, scenes in enumerate(rounds):
            tests = []
            for scene, crowd in enumerate(scenes):
                samples = self._fly_crowd(f"crowd{index}_{scene}", crowd, learner, index == 0)
                held_out = _held_out(samples.world, settings.held_out)
                parts.append(only(samples, ~held_out))
                tests.append(only(samples, held_out))
            name = "crowds" if index == len(rounds) - 1 else f"crowd{index}"
            said = {key: more[key] for key in ("labels_error",) if key in more}
            learner = self.fit(
                name, settings.crowd_training, parts, join(tests), learner, said, CROWDED
            )

    def _fly_station(self, name: str, station: StationSettings, learner: Path) -> FlightData:
        begun = perf_counter()
        data = fly_station(
            self.folder / name,
            station,
            self.task,
            learner,
            self.settings.jobs,
            lambda done: self.progress(name, done, station.flights.shards),
            self.settings.backend,
        )
        self.say(f"{name} ({perf_counter() - begun:.0f} s): {len(data.observation)} samples")
        return data

    def _fly_crowd(
        self, name: str, crowd: CrowdSettings, learner: Path, guided: bool
    ) -> SetSamples:
        begun = perf_counter()
        samples = fly_crowd(
            self.folder / name,
            crowd,
            learner,
            guided,
            self.settings.jobs,
            lambda done: self.progress(name, done, crowd.flights.shards),
            self.settings.backend,
        )
        self.say(f"{name} ({perf_counter() - begun:.0f} s): {len(samples)} samples")
        return samples

    def fit(
        self,
        name: str,
        training: DeepSetTraining,
        parts: list[SetSamples],
        test: SetSamples,
        begun_from: Path | None = None,
        more: Mapping[str, Any] | None = None,
        presets: tuple[str, ...] = PUBLISHED,
    ) -> Path:
        """Fit one network, unless its file is whole, and write its record beside it."""
        weights = _weights(self.folder, name)
        begun = perf_counter()
        if made_before(lambda: DeepSet.load(weights), self.say) is None:
            network = fit_deep_set(
                join(parts),
                training,
                self.folder / f"{name}_checkpoint.safetensors",
                lambda epoch, _: self.progress(f"fit {name}", epoch, training.epochs),
                None if begun_from is None else DeepSet.load(begun_from),
            )
            trained_for = spacecraft_range(self.task, presets)
            flown_as = "lagros" if name.startswith("crowd") else name
            network.metadata.update(weights_record("spacecraft", flown_as, trained_for))
            network.save(weights)
        fitted = DeepSet.load(weights)
        error = _learning_error(fitted, test)
        record = {
            "policy": name,
            "command": "lagros reproduce spacecraft",
            "training": asdict(training),
            "samples": sum(len(part) for part in parts),
            "weights": fitted.weights,
            "learning_error": error,
            **(more or {}),
        }
        write_atomic(weights.with_suffix(".json"), json.dumps(record, indent=1) + "\n")
        self.say(
            f"{name} ({perf_counter() - begun:.0f} s): error of the acceleration, mean "
            f"{error['mean']:.3g}, p99 {error['p99']:.3g} m/s² on {error['samples']} samples"
        )
        return weights

    def samples(self, data: FlightData) -> SetSamples:
        """Return features and labels of flights in worlds of the paper."""
        preset = preset_named(self.settings.flights.preset)
        return flight_samples(data, self.task, preset.agent_radius, preset.core)


def _weights(folder: Path, name: str) -> Path:
    return folder / f"spacecraft_{name}.safetensors"


def _learning_error(network: DeepSet, samples: SetSamples) -> dict[str, Any]:
    """Return ||a_L - a*|| in the plane, observed; the labels of one observation scatter."""
    distance = np.linalg.norm(network(samples.features) - samples.target, axis=-1)
    return {
        "mean": float(distance.mean()),
        "p99": float(np.quantile(distance, 0.99)),
        "maximum": float(distance.max()),
        "label_mean": float(np.linalg.norm(samples.target, axis=-1).mean()),
        "samples": len(distance),
        "unit": "m/s^2",
        "kind": "observed",
    }


def _labels_error(learner: Path) -> dict[str, Any]:
    """Return how far a network was from its labels, for those who learn from it."""
    return {"labels_error": json.loads(learner.with_suffix(".json").read_text())["learning_error"]}


def _split(data: FlightData, share: float) -> BoolArray:
    return _held_out(data.world, share)


def _held_out(world: IntArray, share: float) -> BoolArray:
    every = max(2, round(1.0 / share))
    return np.asarray(world % every == 0)


def training_part(data: FlightData, settings: SpacecraftReproduceSettings) -> FlightData:
    """Return what is learned from flights of a network: labels of a sane size, nobody at rest."""
    sensed = Sensed.of(data.layout, data.observation)
    slow = np.linalg.norm(sensed.velocity, axis=-1) < settings.least_speed
    far = np.linalg.norm(sensed.goal, axis=-1) > _FAR
    resting = slow & far & (sensed.time > _UNDER_WAY)
    kept = _only(data, ~_split(data, settings.held_out) & ~resting)
    size = np.linalg.norm(kept.acceleration[:, :2], axis=-1, keepdims=True)
    share = np.minimum(1.0, settings.label_limit / np.maximum(size, 1e-9)).astype(np.float32)
    turn = kept.acceleration[:, 2:]
    label = np.concatenate([kept.acceleration[:, :2] * share, turn], axis=-1)
    return replace(kept, acceleration=label)


def _only(data: FlightData, chosen: BoolArray) -> FlightData:
    rows = {name: getattr(data, name)[chosen] for name in ("observation", "acceleration", "world")}
    return replace(data, **rows)
