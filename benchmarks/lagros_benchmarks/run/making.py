"""How a task's metric, expert data and networks are made of the settings of a run.

Every stage leaves a file in the run's folder and is skipped where that file is whole.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.experiment import Progress
from lagros_benchmarks.run.reproduction import Say, made_before
from lagros_envs.arrays import BoolArray, Float32Array, IntArray
from lagros_envs.files import write_atomic
from lagros_envs.task import Task
from lagros_policies.contraction import Metric, load_metric, save_metric
from lagros_policies.learning.dataset import ExpertData, ExpertDataSettings, generate
from lagros_policies.learning.features import moved, seen, view_of
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.replanned import generate_replanned
from lagros_policies.learning.train import Moves, TrainingSettings, fit, learning_error
from lagros_policies.trained_for import training_of, weights_record

if TYPE_CHECKING:
    from lagros_benchmarks.run.reproduce import ReproduceSettings

_MOVES = 0x6D6F7665  # seed of the directions in which slopes are learned
MPC = "learned-mpc"


def weights_file(folder: Path, task: Task, name: str) -> Path:
    """Return where a run keeps a network."""
    return folder / f"{task.name}_{name}.safetensors"


class Making:
    """One run: what it makes of its settings in a folder; see `reproduction.reproduce`."""

    def __init__(
        self, settings: ReproduceSettings, folder: Path, progress: Progress, say: Say
    ) -> None:
        self.settings, self.task, self.folder = settings, settings.description, folder
        self.progress, self.say = progress, say
        self.see = view_of(self.task)
        learning = self.task.learning
        self._keeps_plan = learning is not None and learning.keeps_plan

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
            along = parts[0] if self._keeps_plan else None
            parts.append(self._data(name, f"round {number}", metric, data, network, along))
            samples.append(self._labelled(parts[-1], number))
        # (c) imitates u* in the tube, (a) imitates u_d on the plans.
        self._final("lagros", settings.lagros, samples, after)
        plans = [self._samples(*parts[0].nominal_pairs(self.task))]
        self._final("learned", settings.learned, plans, None)
        if settings.replanned:
            self._mpc(metric, settings.replanned)

    def _mpc(self, metric: Metric, settings: Sequence[ExpertDataSettings]) -> None:
        """Make the network that imitates the planner from wherever flights come to."""
        samples: list[Samples] = []
        after = network = None
        for number, data in enumerate(settings):
            name = f"mpc_round{number}"
            if number:
                network = self._network(f"before_{name}", self.settings.mpc_between, samples, after)
                after = self.folder / f"before_{name}_checkpoint.safetensors"
            title = f"re-plans of round {number}" if number else "re-plans in the tube"
            samples.append(self._replans(name, title, metric, data, network))
        self._final(MPC, self.settings.learned_mpc, samples, after)

    def _replans(
        self,
        name: str,
        title: str,
        metric: Metric,
        settings: ExpertDataSettings,
        network: Mlp | None,
    ) -> Samples:
        begun = perf_counter()
        data = generate_replanned(
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
            f"{title} ({perf_counter() - begun:.0f} s): {len(data.control)} samples of "
            f"{data.asked - data.failed} plans; {data.failed} others do not hold"
        )
        return self._samples(data.observation, data.control, data.plan)

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
        along: ExpertData | None = None,
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
            along,
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
        path = weights_file(self.folder, self.task, name)
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
        path = weights_file(self.folder, self.task, name).with_suffix(".json")
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
