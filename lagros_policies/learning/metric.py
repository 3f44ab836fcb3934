"""From a task's description to its metric: CV-STEM over its region, and a check of the outcome."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np

from lagros_envs.checks import check_fields, check_seed, check_whole
from lagros_envs.task import Task
from lagros_policies.contraction import (
    Basis,
    BoxRegion,
    CvStemSettings,
    Metric,
    design_on_region,
    verify_metric,
)
from lagros_policies.room import part_of

_PENALTY = 0.05  # of nu, beside chi
_CHECK = 1  # beside the seed of the design, that of the check


@dataclass(frozen=True)
class MetricSettings:
    """How a metric that a task describes is made.

    Attributes:
        pool: Triples of the region at which the condition is looked at first.
        checks: Fresh triples of the independent check.
        seed: Seed of both.

    Raises:
        ValueError: A number is not positive.
    """

    pool: int = 20_000
    checks: int = 10_000
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_fields(self)
        check_seed(self.seed)
        for name in ("pool", "checks"):
            check_whole(name, getattr(self, name))

    def design(self, task: Task) -> Metric:
        """Return the metric of a task with its verification (observed, not proved).

        Raises:
            ValueError: The task describes none.
            InfeasibleError: No such metric exists.
            RuntimeError: The solver stopped, or the condition was not met everywhere.
        """
        region, design = described(task)
        metric = design_on_region(task.system, region, design, self.pool, seed=self.seed)
        fresh = region.sample(np.random.default_rng([self.seed, _CHECK]), self.checks)
        return verify_metric(task.system, metric, fresh, self.seed)


def described(task: Task) -> tuple[BoxRegion, CvStemSettings]:
    """Return where a task's metric has to hold, and which it is to be.

    Raises:
        ValueError: The task describes none.
    """
    wanted = task.metric
    if wanted is None:
        raise ValueError(
            f"{task.name} describes no contraction metric: give its class `metric = "
            "MetricDesign(...)`"
        )
    region = BoxRegion(
        wanted.low, wanted.high, wanted.error, wanted.control_low, wanted.control_high
    )
    design = CvStemSettings(
        contraction_rate=wanted.rate,
        control_penalty=_PENALTY,
        margin=wanted.margin,
        scaling=wanted.scaling or (1.0,) * task.system.state_dim,
        basis=Basis(wanted.basis),
        point=cast(Literal["state", "nominal"], wanted.point),
    )
    return region, design


def metric_settings(task: Task) -> Any:
    """Return what makes the metric of a task, with its default settings."""
    return part_of(task, "METRIC", "lagros_policies.learning.metric:MetricSettings")()
