"""The cart-pole experiment from nothing: metric, expert data, networks (a) and (c).

Every stage leaves a file in the run's folder and is skipped where that file is there, so that an
interrupted run goes on where it was. The same settings give the same files, bit for bit on one
machine.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.runner import Progress
from lagros_benchmarks.settings import BenchmarkSettings
from lagros_envs.cartpole_task import CartPoleSettings
from lagros_envs.files import write_atomic
from lagros_policies.backends import LOKY, Backend
from lagros_policies.contraction import Metric, load_metric, save_metric
from lagros_policies.imitation.dataset import ExpertData, ExpertDataSettings, generate
from lagros_policies.imitation.features import FEATURES, cartpole_features
from lagros_policies.imitation.networks import Mlp
from lagros_policies.imitation.shards import claim
from lagros_policies.imitation.train import TrainingSettings, fit, learning_error
from lagros_policies.metric_design import MetricDesignSettings, design_cartpole_metric

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

    @property
    def shipped_benchmark(self) -> BenchmarkSettings:
        """Return the benchmark of the shipped metric and weights."""
        return BenchmarkSettings(
            policies=_POLICIES,
            episodes=self.episodes,
            bounds=(self.bound,),
            seed=self.seed,
            jobs=self.jobs,
            backend=self.backend,
        )


_POLICIES = ("learned", "tube-mpc", "lagros", "lqr")


def reproduce_cartpole(
    folder: Path,
    settings: ReproduceSettings | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> BenchmarkSettings:
    """Make metric, data and networks of the cart-pole.

    Args:
        folder: Where everything is kept.
        settings: What to make.
        progress: Called with a title, the units done and the units in all.
        say: Called with a line after each stage.

    Returns:
        The benchmark of (a), (b), (c) and LQR with what was made, ready to run.

    Raises:
        ValueError: The folder holds a run of other settings.
    """
    settings = settings or ReproduceSettings()
    folder = folder.absolute()
    update = progress or (lambda title, done, total: None)
    note = say or (lambda line: None)
    task = CartPoleSettings()
    _claim(folder, settings)
    metric = _metric(folder, settings, task, update, note)
    begun = perf_counter()
    data = generate(
        folder / "data",
        metric,
        settings.data,
        task,
        settings.jobs,
        lambda done: update("expert data", done, settings.data.shards),
        settings.backend,
    )
    note(
        f"expert data ({perf_counter() - begun:.0f} s): {len(data.observation)} samples around "
        f"{len(data.plan_states)} plans; "
        f"{data.drawn - len(data.observation)} states outside the verified region were rejected"
    )
    # (c) imitates u* in the tube, (a) imitates u_d on the plans.
    targets = {
        "lagros": (settings.lagros, data.observation, data.control, data.plan),
        "learned": (settings.learned, *data.nominal_pairs(task), _plan_of_pairs(data)),
    }
    for name, (training, observation, control, plan) in targets.items():
        _network(folder, name, training, observation, control, plan, update, note)
    return replace(
        settings.shipped_benchmark,
        metric=str(folder / "metric.json"),
        policy_settings={
            "learned": {"weights": str(folder / "cartpole_learned.safetensors")},
            "tube-mpc": {"metric": str(folder / "metric.json")},
            "lagros": {"weights": str(folder / "cartpole_lagros.safetensors")},
        },
    )


def _metric(
    folder: Path,
    settings: ReproduceSettings,
    task: CartPoleSettings,
    update: Progress,
    note: Callable[[str], None],
) -> Metric:
    path = folder / "metric.json"
    begun = perf_counter()
    update("metric", 0, 1)
    if not path.exists():
        save_metric(design_cartpole_metric(settings.metric, task), path)
    metric = load_metric(path)
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
    note: Callable[[str], None],
) -> None:
    """Fit one network, unless its file is there, and write its training record beside it."""
    weights = folder / f"cartpole_{name}.safetensors"
    features, side = cartpole_features(observation.astype(np.float32))
    labels: Float32Array = (control * side[:, None]).astype(np.float32)
    held_out = _held_out(plan, training.held_out)
    begun = perf_counter()
    if not weights.exists():
        network = fit(
            features[~held_out],
            labels[~held_out],
            training,
            folder / f"{name}_checkpoint.safetensors",
            lambda epoch, _: update(f"train {name}", epoch, training.epochs),
        )
        network.metadata.update(policy=name, task="cartpole", inputs=", ".join(FEATURES))
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


def _claim(folder: Path, settings: ReproduceSettings) -> None:
    """Refuse to go on with files of other settings; the jobs do not matter."""
    record = asdict(settings)
    for free in ("jobs", "backend", "episodes", "seed", "bound"):
        del record[free]
    folder.mkdir(parents=True, exist_ok=True)
    claim(folder / "settings.json", record, "a run")
