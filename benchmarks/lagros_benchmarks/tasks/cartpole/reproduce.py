"""The cart-pole experiment from nothing: metric, expert data, networks (a) and (c).

Every stage leaves a file in the run's folder and is skipped where that file is whole, so that an
interrupted run goes on where it was. The same settings give the same files, bit for bit on one
machine.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.experiment import Progress
from lagros_benchmarks.run.reproduction import Say, made_before
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_envs.checks import check_fields
from lagros_envs.files import write_atomic
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.backends import LOKY, Backend
from lagros_policies.contraction import Metric, load_metric, save_metric
from lagros_policies.learning.dataset import ExpertData, ExpertDataSettings, generate
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.train import TrainingSettings, fit, learning_error
from lagros_policies.tasks.cartpole.features import FEATURES, cartpole_features
from lagros_policies.tasks.cartpole.metric_design import (
    MetricDesignSettings,
    design_cartpole_metric,
)
from lagros_policies.trained_for import training_of, weights_record

Float32Array = NDArray[np.float32]


@dataclass(frozen=True)
class ReproduceSettings:
    """All that the weights and the table depend on.

    Attributes:
        metric: Design of the contraction metric.
        data: Expert data of Algorithm 1.
        lagros: Training of (c).
        learned: Training of (a).
        episodes: Paired episodes of the table.
        bound: d_bar of the table, uniform in the ball.
        seed: Seed of the table.
        jobs: Processes; they change no result.
        backend: Whose processes they are; those of a cluster must see the run's folder.

    Raises:
        ValueError: A setting of the table is not valid.
    """

    metric: MetricDesignSettings = field(default_factory=MetricDesignSettings)
    data: ExpertDataSettings = field(default_factory=ExpertDataSettings)
    lagros: TrainingSettings = field(default_factory=TrainingSettings)
    learned: TrainingSettings = field(default_factory=lambda: TrainingSettings(epochs=150))
    episodes: int = 50
    bound: float = 0.75
    seed: int = 0
    jobs: int = 2
    backend: Backend = LOKY

    free: ClassVar[tuple[str, ...]] = ("jobs", "backend", "episodes", "seed", "bound")

    @classmethod
    def for_task(cls, task: str, episodes: int | None, **asked: Any) -> ReproduceSettings:
        """Return the settings of a run; see `run.reproduction.Reproduction`."""
        return cls(**asked | ({} if episodes is None else {"episodes": episodes}))

    def __post_init__(self) -> None:
        """Check, before hours of work, what the benchmark at their end will ask."""
        check_fields(self)
        self.benchmark(None)

    def make(self, folder: Path, progress: Progress, say: Say) -> None:
        """Make metric, data and networks; see `reproduction.reproduce`."""
        task = CartPoleSettings()
        metric = _metric(folder, self, task, progress, say)
        begun = perf_counter()
        data = generate(
            folder / "data",
            metric,
            self.data,
            task,
            self.jobs,
            lambda done: progress("expert data", done, self.data.shards),
            self.backend,
        )
        say(
            f"expert data ({perf_counter() - begun:.0f} s): {len(data.observation)} samples around "
            f"{len(data.plan_states)} plans; "
            f"{data.drawn - len(data.observation)} states outside the verified region were rejected"
        )
        # (c) imitates u* in the tube, (a) imitates u_d on the plans.
        targets = {
            "lagros": (self.lagros, data.observation, data.control, data.plan),
            "learned": (self.learned, *data.nominal_pairs(task), _plan_of_pairs(data)),
        }
        for name, (training, observation, control, plan) in targets.items():
            _network(folder, name, training, observation, control, plan, progress, say)

    def benchmark(self, folder: Path | None) -> BenchmarkSettings:
        """Return the benchmark of (a), (b), (c) and LQR.

        Args:
            folder: Where metric and weights lie; None takes the shipped ones.
        """
        made: dict[str, Any] = {}
        if folder is not None:
            metric = str(folder / "metric.json")
            made = {
                "metric": metric,
                "policy_settings": {
                    "learned": {"weights": str(_weights(folder, "learned"))},
                    "tube-mpc": {"metric": metric},
                    "lagros": {"weights": str(_weights(folder, "lagros"))},
                },
            }
        return BenchmarkSettings(
            policies=_POLICIES,
            episodes=self.episodes,
            bounds=(self.bound,),
            seed=self.seed,
            jobs=self.jobs,
            backend=self.backend,
            **made,
        )


_POLICIES = ("learned", "tube-mpc", "lagros", "lqr")


def _weights(folder: Path, name: str) -> Path:
    return folder / f"cartpole_{name}.safetensors"


def _metric(
    folder: Path,
    settings: ReproduceSettings,
    task: CartPoleSettings,
    update: Progress,
    note: Say,
) -> Metric:
    path = folder / "metric.json"
    begun = perf_counter()
    update("metric", 0, 1)
    metric = made_before(lambda: load_metric(path, states=4), note)
    if metric is None:
        save_metric(design_cartpole_metric(settings.metric, task), path)
        metric = load_metric(path, states=4)
    update("metric", 1, 1)
    check = metric.verification
    if check is not None:
        note(
            f"metric ({perf_counter() - begun:.0f} s): alpha = {metric.contraction_rate:g} 1/s, "
            f"chi = {metric.condition_bound:.4g}, nu = {metric.control_weight:.4g}; "
            f"the condition fails on {check.violations} of {check.samples} fresh states"
        )
    return metric


def _network(
    folder: Path,
    name: str,
    training: TrainingSettings,
    observation: NDArray[np.float64],
    control: NDArray[np.float64],
    plan: NDArray[np.intp],
    update: Progress,
    note: Say,
) -> None:
    """Fit one network, unless its file is whole, and write its training record beside it."""
    weights = _weights(folder, name)
    features, side = cartpole_features(observation.astype(np.float32))
    labels: Float32Array = (control * side[:, None]).astype(np.float32)
    held_out = _held_out(plan, training.held_out)
    begun = perf_counter()
    if made_before(lambda: Mlp.load(weights), note) is None:
        network = fit(
            features[~held_out],
            labels[~held_out],
            training,
            folder / f"{name}_checkpoint.safetensors",
            lambda epoch, _: update(f"train {name}", epoch, training.epochs),
        )
        trained_for = training_of(CartPoleSettings()).range(timed=True)
        network.metadata.update(weights_record("cartpole", name, trained_for))
        network.metadata["inputs"] = ", ".join(FEATURES)
        network.save(weights)
    error = learning_error(Mlp.load(weights), features[held_out], labels[held_out])
    record: dict[str, Any] = {
        "policy": name,
        "command": "lagros reproduce cartpole",
        "training": asdict(training),
        "samples": int(np.sum(~held_out)),
        "learning_error": {**asdict(error), "unit": "N", "kind": "observed"},
    }
    write_atomic(weights.with_suffix(".json"), json.dumps(record, indent=1) + "\n")
    note(
        f"{name} ({perf_counter() - begun:.0f} s): learning error on {error.samples} held-out "
        f"samples: mean {error.mean:.3g} N, p99 {error.p99:.3g} N, max {error.maximum:.3g} N"
    )


def _held_out(plan: NDArray[np.intp], share: float) -> NDArray[np.bool_]:
    """Hold out whole plans: samples of one tube are too much alike to test each other."""
    every = max(2, round(1.0 / share))
    chosen: NDArray[np.bool_] = plan % every == 0
    return chosen


def _plan_of_pairs(data: ExpertData) -> NDArray[np.intp]:
    plans, steps = data.plan_controls.shape[:2]
    return np.repeat(np.arange(plans), steps)
