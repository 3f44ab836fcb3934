"""A task's experiment from nothing: metric, expert data, networks (a) and (c).

Every stage leaves a file in the run's folder and is skipped where that file is whole, so that an
interrupted run goes on where it was. The same settings give the same files, bit for bit on one
machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from lagros_benchmarks.run.experiment import Progress
from lagros_benchmarks.run.fingerprints import described
from lagros_benchmarks.run.making import MPC, Making, weights_file
from lagros_benchmarks.run.reproduction import Say
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_envs.checks import check_fields
from lagros_envs.registry import find_task, task_names
from lagros_envs.task import Learning, Task
from lagros_envs.tasks import SHIPPED
from lagros_policies.backends import LOKY, Backend
from lagros_policies.learning.dataset import ExpertDataSettings
from lagros_policies.learning.features import view_of
from lagros_policies.learning.layers import check_widths
from lagros_policies.learning.metric import metric_settings
from lagros_policies.learning.shards import claim
from lagros_policies.learning.train import TrainingSettings

_SHARDS = 20  # pieces of work, where they divide plans and samples
_LEAST = 10  # plans in each


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
        replanned: States labelled by planning from them, for `learned-mpc`: in the tube of u*, then
            of each of its rounds; () for none.
        mpc_between: Training before each of these rounds.
        learned_mpc: Training of `learned-mpc`.
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
    replanned: tuple[ExpertDataSettings, ...] | None = None
    mpc_between: TrainingSettings | None = None
    learned_mpc: TrainingSettings | None = None
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
            "replanned": _replanned_data(how),
            "mpc_between": TrainingSettings(how.hidden, how.round_epochs, how.batch),
            "learned_mpc": TrainingSettings(how.hidden, how.epochs, how.batch),
            "episodes": task.defaults.episodes,
            "bound": task.defaults.bound,
        }
        for name, value in said.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        fits = self.between, self.lagros, self.learned, self.mpc_between, self.learned_mpc
        for training in fits:
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
        Making(self, folder, progress, say).run()

    def benchmark(self, folder: Path | None) -> BenchmarkSettings:
        """Return the benchmark of (a), (b), (c) and LQR, of a folder's files or those shipped."""
        made: dict[str, Any] = {}
        imitators = ("learned", MPC) if self.replanned else ("learned",)
        if folder is not None:
            metric = str(folder / "metric.json")
            weights = {
                name: {"weights": str(weights_file(folder, self.description, name))}
                for name in (*imitators, "lagros")
            }
            made = {
                "metric": metric,
                "policy_settings": weights,
            }
        return BenchmarkSettings.for_task(
            self.task,
            policies=(*imitators, "tube-mpc", "lagros", "lqr"),
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


def _replanned_data(how: Learning) -> tuple[ExpertDataSettings, ...]:
    """Return the parts of the data of `learned-mpc`; () for none."""
    samples = how.mpc_samples
    if samples is None:
        samples = how.samples + how.rounds * how.round_samples
    if not samples:
        return ()
    parts = 1 + how.mpc_rounds
    return tuple(_data(how, how.plans, samples // parts, seed) for seed in range(parts))
