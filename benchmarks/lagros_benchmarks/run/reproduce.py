"""A task's experiment from nothing: metric, expert data, networks (a) and (c).

Every stage leaves a file in the run's folder and is skipped where that file is whole, so that an
interrupted run goes on where it was. The same settings give the same files, bit for bit on one
machine.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.experiment import Progress
from lagros_benchmarks.run.fingerprints import described
from lagros_benchmarks.run.reproduction import Say, made_before
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_envs.arrays import BoolArray, Float32Array, IntArray
from lagros_envs.checks import check_fields
from lagros_envs.files import write_atomic
from lagros_envs.registry import find_task, task_names
from lagros_envs.task import Learning, Task
from lagros_envs.tasks import SHIPPED
from lagros_policies.backends import LOKY, Backend
from lagros_policies.contraction import Metric, load_metric, save_metric
from lagros_policies.learning.dataset import ExpertData, ExpertDataSettings, generate
from lagros_policies.learning.features import moved, seen, view_of
from lagros_policies.learning.layers import check_widths
from lagros_policies.learning.metric import metric_settings
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.shards import claim
from lagros_policies.learning.train import Moves, TrainingSettings, fit, learning_error
from lagros_policies.trained_for import training_of, weights_record

_SHARDS = 20  # pieces of work, where they divide plans and samples
_LEAST = 10  # plans in each
_MOVES = 0x6D6F7665  # seed of the directions in which slopes are learned
_POLICIES = ("learned", "tube-mpc", "lagros", "lqr")


@dataclass(frozen=True)
class ReproduceSettings:
    """All that the weights and the table of a task depend on; what is None, the task says.

    Attributes:
        task: Name of the task, or where it is: module:attribute or a .py file.
        metric: Design of the contraction metric.
        data: Expert data of Algorithm 1.
        rounds: Expert data of each round of DAgger.
        between: Training before each round.
        lagros: Training of (c).
        learned: Training of (a).
        episodes: Paired episodes of the table.
        bound: d_bar of the table, uniform in the ball.
        seed: Seed of the table.
        jobs: Processes; they change no result.
        backend: Whose processes they are; those of a cluster must see the run's folder.

    Raises:
        ValueError: A setting of the table is not valid, or the task does not say how its networks
            are made.
    """

    task: str = field(default_factory=lambda: task_names()[0])
    metric: Any = None
    data: ExpertDataSettings | None = None
    rounds: tuple[ExpertDataSettings, ...] | None = None
    between: TrainingSettings | None = None
    lagros: TrainingSettings | None = None
    learned: TrainingSettings | None = None
    episodes: int | None = None
    bound: float | None = None
    seed: int = 0
    jobs: int = 2
    backend: Backend = LOKY

    free: ClassVar[tuple[str, ...]] = ("jobs", "backend", "episodes", "seed", "bound")

    @classmethod
    def for_task(cls, task: str, episodes: int | None, **asked: Any) -> ReproduceSettings:
        """Return the settings of a run; see `run.reproduction.Reproduction`."""
        return cls(task=task, episodes=episodes, **asked)

    def __post_init__(self) -> None:
        """Fill in what the task says, and check what the benchmark at the end will ask."""
        check_fields(self)
        task = self.description
        how = task.learning
        if how is None:
            raise ValueError(
                f"{task.name} does not say how its networks are made: give its class `learning = "
                "Learning(...)`"
            )
        form: dict[str, Any] = {
            "scheduled": _affine_features(task) if how.scheduled else 0,
            "slope_weight": how.slope_weight,
        }
        said = {
            "metric": metric_settings(task),
            "data": _data(how, how.plans, how.samples, 0),
            # Each round on episodes of its own.
            "rounds": tuple(
                _data(how, how.round_plans, how.round_samples, seed)
                for seed in range(1, how.rounds + 1)
            ),
            "between": TrainingSettings(how.hidden, how.round_epochs, how.batch, **form),
            "lagros": TrainingSettings(how.hidden, how.epochs, how.batch, **form),
            "learned": TrainingSettings(how.hidden, how.learned_epochs, how.batch),
            "episodes": task.defaults.episodes,
            "bound": task.defaults.bound,
        }
        for name, value in said.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        for training in (self.between, self.lagros, self.learned):
            assert training is not None
            check_widths(training.hidden, view_of(task).alike)
        self.benchmark(None)

    @property
    def description(self) -> Task:
        """The task.

        Raises:
            ValueError: There is no such task, or it is not of one body.
        """
        found = find_task(self.task)
        if not isinstance(found, Task):
            raise ValueError(f"{found.name} is not of one body")
        return found

    def make(self, folder: Path, progress: Progress, say: Say) -> None:
        """Make metric, data and networks; see `reproduction.reproduce`."""
        if self.description.name not in SHIPPED:
            claim(folder / "described.json", described(self.description), "a run")
        _Making(self, folder, progress, say).run()

    def benchmark(self, folder: Path | None) -> BenchmarkSettings:
        """Return the benchmark of (a), (b), (c) and LQR, of a folder's files or those shipped."""
        made: dict[str, Any] = {}
        if folder is not None:
            metric = str(folder / "metric.json")
            weights = {
                name: {"weights": str(_weights(folder, self.description, name))}
                for name in ("learned", "lagros")
            }
            made = {
                "metric": metric,
                "policy_settings": weights,
            }
        return BenchmarkSettings.for_task(
            self.task,
            policies=_POLICIES,
            episodes=self.episodes,
            bounds=(self.bound,),
            seed=self.seed,
            jobs=self.jobs,
            backend=self.backend,
            **made,
        )


def _affine_features(task: Task) -> int:
    """Return how many features are affine in the state.

    Raises:
        ValueError: None are.
    """
    count = view_of(task).affine
    if not count:
        raise ValueError(
            f"{task.name}: learning.scheduled needs features that are affine in the state, and "
            "others that do not depend on it: its view has none (affine = 0)"
        )
    return count


def _data(how: Learning, plans: int, samples: int, seed: int) -> ExpertDataSettings:
    # A piece without any plan is an error: where there are few, they are in few pieces.
    shards = math.gcd(max(1, min(_SHARDS, plans // _LEAST)), plans, samples)
    return ExpertDataSettings(
        plans, samples, shards, disturbance_bound=how.disturbance_bound, seed=seed
    )


def _weights(folder: Path, task: Task, name: str) -> Path:
    return folder / f"{task.name}_{name}.safetensors"


class _Making:
    """One run: what it makes of its settings in a folder; see `reproduction.reproduce`."""

    def __init__(
        self, settings: ReproduceSettings, folder: Path, progress: Progress, say: Say
    ) -> None:
        self.settings, self.task, self.folder = settings, settings.description, folder
        self.progress, self.say = progress, say
        self.see = view_of(self.task)

    def run(self) -> None:
        """Make all stages."""
        settings = self.settings
        assert settings.data is not None
        assert settings.rounds is not None
        metric = self._metric()
        parts = [self._data("data", "expert data", metric, settings.data)]
        samples = [self._labelled(parts[0], 0)]
        after = None
        for number, data in enumerate(settings.rounds, 1):
            name = f"round{number}"
            network = self._network(f"before_{name}", settings.between, samples, after)
            after = self.folder / f"before_{name}_checkpoint.safetensors"
            parts.append(self._data(name, f"round {number}", metric, data, network))
            samples.append(self._labelled(parts[-1], number))
        # (c) imitates u* in the tube, (a) imitates u_d on the plans.
        self._final("lagros", settings.lagros, samples, after)
        plans = [self._samples(*parts[0].nominal_pairs(self.task))]
        self._final("learned", settings.learned, plans, None)

    def _metric(self) -> Metric:
        path = self.folder / "metric.json"
        states = self.task.system.state_dim
        begun = perf_counter()
        self.progress("metric", 0, 1)
        metric = made_before(lambda: load_metric(path, states=states), self.say)
        if metric is None:
            save_metric(self.settings.metric.design(self.task), path)
            metric = load_metric(path, states=states)
        self.progress("metric", 1, 1)
        check = metric.verification
        if check is not None:
            self.say(
                f"metric ({perf_counter() - begun:.0f} s): alpha = {metric.contraction_rate:g} "
                f"1/s, chi = {metric.condition_bound:.4g}, nu = {metric.control_weight:.4g}; "
                f"the condition fails on {check.violations} of {check.samples} fresh states"
            )
        return metric

    def _data(
        self,
        name: str,
        title: str,
        metric: Metric,
        settings: ExpertDataSettings,
        network: Mlp | None = None,
    ) -> ExpertData:
        begun = perf_counter()
        data = generate(
            self.folder / name,
            metric,
            settings,
            self.task,
            self.settings.jobs,
            lambda done: self.progress(title, done, settings.shards),
            self.settings.backend,
            network,
        )
        self.say(
            f"{title} ({perf_counter() - begun:.0f} s): {len(data.observation)} samples around "
            f"{len(data.plan_states)} plans; "
            f"{data.drawn - len(data.observation)} states outside the verified region were rejected"
        )
        return data

    def _samples(self, observation: NDArray[Any], control: NDArray[Any], plan: IntArray) -> Samples:
        """Return features, labels and plans of samples."""
        features, signs = seen(self.see, observation.astype(np.float32))
        labels = control if signs is None else control * signs
        return Samples(features, labels.astype(np.float32), plan)

    def _labelled(self, data: ExpertData, number: int) -> Samples:
        """Return the samples of (c), and how features and labels move where that is asked for."""
        found = self._samples(data.observation, data.control, data.plan)
        assert self.settings.lagros is not None
        if not self.settings.lagros.slope_weight:
            return found
        task = self.task
        way, slope = data.moves(task, np.random.default_rng([_MOVES, number]))
        ways = np.zeros_like(data.observation)
        ways[:, task.layout.state] = way
        # The signs depend on the episode alone.
        _, signs = seen(self.see, data.observation.astype(np.float32))
        slope = slope if signs is None else slope * signs
        along = moved(self.see, data.observation, ways)
        return found._replace(moves=Moves(along.astype(np.float32), slope.astype(np.float32)))

    def _network(
        self,
        name: str,
        training: TrainingSettings | None,
        parts: Sequence[Samples],
        after: Path | None,
    ) -> Mlp:
        """Return the network of a stage, fitted unless its file is whole."""
        assert training is not None
        path = _weights(self.folder, self.task, name)
        found = made_before(lambda: Mlp.load(path), self.say)
        if found is None:
            kept = [_split(part, training.held_out)[0] for part in parts]
            found = fit(
                np.concatenate([part.features for part in kept]),
                np.concatenate([part.labels for part in kept]),
                training,
                self.folder / f"{name}_checkpoint.safetensors",
                lambda epoch, _: self.progress(f"train {name}", epoch, training.epochs),
                self.see.alike,
                after,
                len(kept[0].features),
                _together([part.moves for part in kept]),
            )
            trained_for = training_of(self.task).range(timed=True)
            found.metadata.update(weights_record(self.task.name, name, trained_for))
            found.metadata["inputs"] = ", ".join(self.see.names)
            found.save(path)
        return Mlp.load(path)

    def _final(
        self,
        name: str,
        training: TrainingSettings | None,
        parts: Sequence[Samples],
        after: Path | None,
    ) -> None:
        """Make a network that is kept, and write its training record beside it."""
        assert training is not None
        begun = perf_counter()
        network = self._network(name, training, parts, after)
        halves = [_split(part, training.held_out) for part in parts]
        features = np.concatenate([held.features for _, held in halves])
        labels = np.concatenate([held.labels for _, held in halves])
        error = learning_error(network, features, labels)
        unit = self.task.control_unit
        record: dict[str, Any] = {
            "policy": name,
            "command": f"lagros reproduce {self.settings.task}",
            "training": asdict(training),
            "samples": sum(len(kept.features) for kept, _ in halves),
            "learning_error": {**asdict(error), "unit": unit, "kind": "observed"},
        }
        path = _weights(self.folder, self.task, name).with_suffix(".json")
        write_atomic(path, json.dumps(record, indent=1) + "\n")
        shown = {"mean": error.mean, "p99": error.p99, "max": error.maximum}
        figures = ", ".join(f"{what} {value:.3g} {unit}".strip() for what, value in shown.items())
        self.say(
            f"{name} ({perf_counter() - begun:.0f} s): learning error on {error.samples} held-out "
            f"samples: {figures}"
        )


class Samples(NamedTuple):
    """What a network is fitted to.

    Attributes:
        features: Shape (s, f).
        labels: Shape (s, m).
        plan: Which plan each belongs to, shape (s,).
        moves: How features and labels move together; None where that is not known or not asked for.
    """

    features: Float32Array
    labels: Float32Array
    plan: IntArray
    moves: Moves | None = None


def _split(part: Samples, share: float) -> tuple[Samples, Samples]:
    """Hold out whole plans: samples of one tube are too much alike to test each other."""
    held = part.plan % max(2, round(1.0 / share)) == 0

    def taken(which: BoolArray) -> Samples:
        moves = None if part.moves is None else Moves(*(one[which] for one in part.moves))
        return Samples(part.features[which], part.labels[which], part.plan[which], moves)

    return taken(~held), taken(held)


def _together(parts: Sequence[Moves | None]) -> Moves | None:
    """Join what is known of the moves of several rounds: of all of them, or of none."""
    known = [part for part in parts if part is not None]
    return Moves(*map(np.concatenate, zip(*known, strict=True))) if known else None
