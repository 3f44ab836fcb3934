"""Training of C3M: a neural metric W(x) and a neural controller, on sampled (x, x_d, u_d).

The loss is what is lacking of the conditions of `c3m_conditions` and of W < w_ub I: of each
inequality, with room, the mean of what is missing along random directions, and of the equality the
mean square (Sun, Jha & Fan, CoRL 2020). Conditions are observed on samples, never proved.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_fields, check_positive, check_seed, check_whole
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.task import Task
from lagros_policies.c3m import Scaled
from lagros_policies.contraction import BoxRegion
from lagros_policies.expert import Expert
from lagros_policies.learning.c3m_conditions import (
    Conditions,
    Hold,
    Networks,
    lacking,
    motion_at,
    scaled_of,
    single,
)
from lagros_policies.learning.dataset import ExpertDataSettings, plan_arrays, planned_episodes
from lagros_policies.learning.fitting import Fit, IntArray, one_thread
from lagros_policies.learning.tubes import tube_states

if TYPE_CHECKING:
    import torch

# Of the boxes of tasks without a metric: plans, and what widens every side.
_PLANS, _LEAST = 64, 1e-3


@dataclass(frozen=True)
class C3mSettings:
    """How to train; the defaults are those that docs/baselines.md compares with the published ones.

    Attributes:
        samples: Triples (x, x_d, u_d).
        epochs: Passes over them.
        held: Whether the loop is that of a control that is held, (H), or of a continuous one, (C).
        batch: Triples per step.
        learning_rate: Adam's step at first; a cosine takes it to a hundredth of that.
        rate: lambda [1/s].
        room: By how much (C) and (C1) are to hold, as a share of lambda.
        least: w_lb, in scaled coordinates.
        largest: w_ub, in scaled coordinates.
        width: Of the hidden layer of each network.
        directions: Random directions along which an inequality is looked at.
        equality_weight: Of (C2) in the loss.
        checks: Fresh triples on which the outcome is looked at.
        checkpoint_every: Epochs between checkpoints.
        seed: Seed of the triples, initial weights and order.

    Raises:
        ValueError: A value is out of range.
    """

    samples: int = 16_384
    epochs: int = 12
    held: bool = True
    batch: int = 256
    learning_rate: float = 3e-3
    rate: float = 0.5
    room: float = 0.1
    least: float = 0.1
    largest: float = 10.0
    width: int = 128
    directions: int = 128
    equality_weight: float = 1.0
    checks: int = 8192
    checkpoint_every: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        for name in ("samples", "epochs", "batch", "width", "directions", "checks"):
            check_whole(name, getattr(self, name))
        check_whole("checkpoint_every", self.checkpoint_every)
        check_seed(self.seed)
        for name in ("learning_rate", "rate", "room", "least", "largest"):
            check_positive(name, getattr(self, name))
        if not self.least < self.largest:
            raise ValueError(f"largest={self.largest!r} must be above least={self.least!r}")


def region_of(task: Task, seed: int = 0, met: bool = False) -> BoxRegion:
    """Return where the networks of a task are to work: x_d, u_d and x - x_d, each in a box.

    That of the metric that the task describes. Of a task without one, or if `met`, what random
    plans of the training ask for, with a tenth more, and what a regulator along them leaves under
    random disturbances up to the task's bound: the error that it exceeds once in a hundred steps.

    Args:
        task: The task.
        seed: Of the plans.
        met: Whether to ask plans although the task describes a metric.

    Raises:
        RuntimeError: There is no plan.
    """
    wanted = task.metric
    if wanted is not None and not met:
        return BoxRegion(
            wanted.low, wanted.high, wanted.error, wanted.control_low, wanted.control_high
        )
    expert = Expert(task, law="lqr")
    episodes = [task.sample(episode_streams(one).scenario) for one in episode_seeds(seed, _PLANS)]
    held = planned_episodes(expert, episodes)
    if not held:
        raise RuntimeError(f"none of {_PLANS} episodes of {task.name} has a plan to learn around")
    made = plan_arrays(task, held)
    tracked = expert.track(made["plan_states"], made["plan_controls"])
    data = ExpertDataSettings(disturbance_bound=task.defaults.bound)
    reached, plan, step = tube_states(np.random.default_rng([seed, 2]), expert, tracked, data)
    error = np.quantile(np.abs(reached - tracked.states[plan, step]), 0.99, axis=0)
    return BoxRegion(
        *_ends(tracked.states), tuple((error + _LEAST).tolist()), *_ends(tracked.controls)
    )


def _ends(values: FloatArray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    low, high = values.min(axis=(0, 1)), values.max(axis=(0, 1))
    more = 0.05 * (high - low) + _LEAST
    return tuple((low - more).tolist()), tuple((high + more).tolist())


class C3mFit(Fit[C3mSettings]):
    """A run over samples of a region.

    Args:
        task: The task.
        region: Where x_d, u_d and x - x_d are drawn.
        settings: How to train.
        checkpoint: File that holds the progress; resumed from if it fits.

    Raises:
        ValueError: The checkpoint is damaged, or of other settings.
    """

    def __init__(
        self, task: Task, region: BoxRegion, settings: C3mSettings, checkpoint: Path
    ) -> None:
        import torch

        self.task = task
        rng = np.random.default_rng([settings.seed, 0])
        self.scaled = scaled_of(task, region, rng)
        self.triples = scaled_triples(task, self.scaled, region, rng, settings.samples)
        self.networks = Networks(self.scaled, settings.width, settings.least, settings.seed)
        self.generator = torch.Generator()
        data = hashlib.sha256()
        for part in self.triples:
            data.update(part.tobytes())
        parameters = self.networks.parameters
        super().__init__(settings, checkpoint, parameters, settings.samples, data.hexdigest())

    def batches(self, order: IntArray) -> list[IntArray]:
        """Cut off full batches; what is left over is not used in this epoch."""
        size = min(self.settings.batch, len(order))
        return [order[first : first + size] for first in range(0, len(order) - size + 1, size)]

    def loss(self, batch: IntArray) -> torch.Tensor:
        """Return what is lacking of all conditions on a batch."""
        import torch

        settings = self.settings
        state, nominal, control = (part[batch] for part in self.triples)
        found = self.conditions(state, nominal, control, settings.rate)
        # Directions depend on epoch and batch alone, so that a resumed run meets the same.
        self.generator.manual_seed(int(batch[0]) + (self.epoch << 32))
        room = settings.room * settings.rate
        total = settings.equality_weight * found.turned.square().sum(dim=(1, 2, 3)).mean()
        for matrix in (
            found.closed + room * torch.eye(found.closed.shape[-1]),
            found.open + room * torch.eye(found.open.shape[-1]),
            found.dual - settings.largest * torch.eye(found.dual.shape[-1]),
        ):
            size = settings.directions, matrix.shape[-1]
            ways = torch.randn(size, generator=self.generator)
            total = total + lacking(matrix, ways / ways.norm(dim=1, keepdim=True))
        return total

    def conditions(
        self, state: FloatArray, nominal: FloatArray, control: FloatArray, rate: float
    ) -> Conditions:
        """Return the left sides of the conditions at scaled samples."""
        here = state * self.scaled.scale
        motion = motion_at(self.task, self.scaled, here)
        hold = Hold(self.task, self.scaled, here) if self.settings.held else None
        return self.networks.conditions(
            single(state), single(nominal), single(control), motion, rate, hold
        )


def scaled_triples(
    task: Task, scaled: Scaled, region: BoxRegion, rng: np.random.Generator, count: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Draw x, x_d and u_d, the last from the reference control, all in scaled coordinates."""
    drawn = region.sample(rng, count)
    off = (drawn.nominal_control - np.array(task.control_centre)) / scaled.control_scale
    return drawn.state / scaled.scale, drawn.nominal / scaled.scale, off


def fit_c3m(
    task: Task,
    region: BoxRegion,
    settings: C3mSettings,
    checkpoint: Path,
    on_epoch: Callable[[int, float], None] | None = None,
) -> tuple[Networks, dict[str, Any]]:
    """Train, and look at the outcome on fresh samples.

    Returns:
        The networks, and the shares of fresh samples on which (C) and (C1) hold (observed).

    Raises:
        ValueError: The checkpoint is damaged, or of other settings.
    """
    with one_thread():
        run = C3mFit(task, region, settings, checkpoint)
        run.finish(on_epoch)
        return run.networks, observed(run, region)


def observed(run: C3mFit, region: BoxRegion) -> dict[str, Any]:
    """Return on which shares of fresh samples the conditions hold at lambda, and at zero."""
    import torch

    settings = run.settings
    rng = np.random.default_rng([settings.seed, 1])
    triples = scaled_triples(run.task, run.scaled, region, rng, settings.checks)
    held: dict[str, list[FloatArray]] = {"closed": [], "closed_at_zero": [], "open": []}
    spread = []
    for first in range(0, settings.checks, settings.batch):
        batch = slice(first, first + settings.batch)
        state, nominal, control = (part[batch] for part in triples)
        for rate, name in ((settings.rate, "closed"), (0.0, "closed_at_zero")):
            found = run.conditions(state, nominal, control, rate)
            held[name].append(_holds(found.closed))
            if rate:
                held["open"].append(_holds(found.open))
                with torch.no_grad():
                    ends = torch.linalg.eigvalsh(found.dual)
                spread.append((ends[:, -1] / ends[:, 0]).numpy())
    shares = {name: float(np.concatenate(parts).mean()) for name, parts in held.items()}
    return {
        "kind": "observed",
        "samples": settings.checks,
        **shares,
        "condition_number_p99": float(np.percentile(np.concatenate(spread), 99)),
    }


def _holds(matrix: torch.Tensor) -> Any:
    import torch

    with torch.no_grad():
        return (torch.linalg.eigvalsh(matrix)[:, -1] < 0.0).numpy()
