"""What a training run depends on: the algorithm, the task, and how long.

The defaults are the hyperparameters that were found (docs/baselines.md); a run writes its own
beside its weights.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, field, fields
from typing import Any, ClassVar

from lagros_envs.aliases import moved_names
from lagros_envs.checks import (
    check_disturbance_bound,
    check_each,
    check_fields,
    check_name,
    check_not_negative,
    check_positive,
    check_whole,
)
from lagros_envs.disturbances import OPEN_LOOP
from lagros_envs.registry import find_task, first_task
from lagros_envs.seeding import EVALUATION
from lagros_envs.task import Numbers, Task

# Segments are namespaces of their own in `lagros_envs.seeding`'s sense, far below `EVALUATION`.
MOST_SEGMENTS = 1 << 16
# Of what is counted, and the width of a layer: beyond are slips, and no memory holds them.
MOST, MOST_WIDTH = 10**9, 1 << 16
MOST_SEEDS = 1 << 32  # what stable-baselines3 and NumPy's old generator take
# Namespaces of the held-out episodes of a learning curve and of those at its end ("curv" and "last"
# in ASCII): neither training nor `lagros bench` ever meets them.
CURVE, FINAL = 0x63757276, 0x6C617374
assert min(EVALUATION, CURVE, FINAL) >= MOST_SEGMENTS


class _Ranged:
    """Settings whose ranges are checked when they are built."""

    # Names of the attributes that must be positive, that may also be zero, that are shares of one,
    # that count something, and that are widths of layers.
    positive: ClassVar[tuple[str, ...]] = ()
    not_negative: ClassVar[tuple[str, ...]] = ()
    shares: ClassVar[tuple[str, ...]] = ()
    counts: ClassVar[tuple[str, ...]] = ()
    widths: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        check_fields(self)
        for name in self.positive:
            check_positive(name, getattr(self, name))
        for name in self.not_negative:
            check_not_negative(name, getattr(self, name))
        for name in self.shares:
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name}={getattr(self, name)!r} must be in (0, 1]")
        for name in self.counts:
            check_whole(name, getattr(self, name), 1, MOST)
        for name in self.widths:
            check_each(name, getattr(self, name), 1, MOST_WIDTH)


@dataclass(frozen=True)
class Ppo(_Ranged):
    """Proximal policy optimisation.

    Attributes:
        rollout_steps: Control steps in every world between two updates.
        batch_size: Samples of one gradient step.
        epochs: Passes over a rollout.
        learning_rate: At the start; it falls linearly, by segments, to a tenth.
        discount: gamma per control step.
        gae_decay: lambda of the generalised advantage estimate.
        clip_range: Clip of the probability ratio.
        initial_log_std: Logarithm of the spread of the first actions. -2 is 14 % of the control's
            scale; the usual 0 explores with all of it, which ends many an episode at once.
        hidden: Widths of the hidden tanh layers, of actor and critic each.

    Raises:
        ValueError: A value is out of range.
    """

    name: ClassVar[str] = "ppo"
    positive: ClassVar[tuple[str, ...]] = ("learning_rate", "clip_range")
    shares: ClassVar[tuple[str, ...]] = ("discount", "gae_decay")
    counts: ClassVar[tuple[str, ...]] = ("rollout_steps", "batch_size", "epochs")
    widths: ClassVar[tuple[str, ...]] = ("hidden",)
    rollout_steps: int = 90
    batch_size: int = 1440
    epochs: int = 10
    learning_rate: float = 3e-4
    discount: float = 0.99
    gae_decay: float = 0.95
    clip_range: float = 0.2
    initial_log_std: float = -2.0
    hidden: tuple[int, ...] = (64, 64)


@dataclass(frozen=True)
class OffPolicy(_Ranged):
    """What soft actor-critic and TD3 share: learning from a buffer of all that was met.

    Attributes:
        batch_size: Samples of one gradient step.
        gradient_steps: Gradient steps after each control step of all worlds.
        warm_up: Control steps, over all worlds, of uniform random actions before the first of them.
        buffer_size: Control steps that are kept.
        learning_rate: At the start; it falls linearly, by segments, to a tenth.
        discount: gamma per control step.
        averaging: tau, the share of the new weights in the target networks.
        hidden: Widths of the hidden tanh layers, of actor and critics each.

    Raises:
        ValueError: A value is out of range.
    """

    name: ClassVar[str] = ""
    positive: ClassVar[tuple[str, ...]] = ("learning_rate",)
    not_negative: ClassVar[tuple[str, ...]] = ("warm_up",)
    shares: ClassVar[tuple[str, ...]] = ("discount", "averaging")
    counts: ClassVar[tuple[str, ...]] = ("batch_size", "gradient_steps", "buffer_size")
    widths: ClassVar[tuple[str, ...]] = ("hidden",)
    batch_size: int = 256
    gradient_steps: int = 2
    warm_up: int = 128
    buffer_size: int = 400_000
    learning_rate: float = 2e-3
    discount: float = 0.98
    averaging: float = 0.01
    hidden: tuple[int, ...] = (64, 64)


@dataclass(frozen=True)
class Sac(OffPolicy):
    """Soft actor-critic; attributes as in `OffPolicy`, and this.

    Attributes:
        initial_entropy_weight: The weight of the entropy before it is tuned.
    """

    name: ClassVar[str] = "sac"
    positive: ClassVar[tuple[str, ...]] = (*OffPolicy.positive, "initial_entropy_weight")
    initial_entropy_weight: float = 0.1


@dataclass(frozen=True)
class Td3(OffPolicy):
    """Twin delayed deep deterministic policy gradients; attributes as in `OffPolicy`, and these.

    Attributes:
        action_noise: Standard deviation of the exploration, in units of the action.
        policy_delay: Updates of the critics for each of the actor.
    """

    name: ClassVar[str] = "td3"
    not_negative: ClassVar[tuple[str, ...]] = (*OffPolicy.not_negative, "action_noise")
    counts: ClassVar[tuple[str, ...]] = (*OffPolicy.counts, "policy_delay")
    action_noise: float = 0.1
    policy_delay: int = 2


Algorithm = Ppo | Sac | Td3


@dataclass(frozen=True)
class Training(_Ranged):
    """A training run, besides the task's physics.

    Attributes:
        algorithm: What learns, with its hyperparameters.
        seed: Seed of the run.
        segments: Number of segments, each followed by an evaluation and a checkpoint.
        segment_steps: Control steps of every world in a segment.
        worlds: Worlds side by side.
        effort_weight: Replaces that of the task's reward in training; None leaves it.
        disturbance: Kind of disturbance in training.
        disturbance_bound: Its bound d_bar, in units of the state per second.
        curve_episodes: Held-out episodes (worlds) after every segment.
        final_episodes: Others at the end.

    Raises:
        ValueError: A value is out of range.
    """

    # A name, which a task of one body makes a field of it.
    task = ""
    counts: ClassVar[tuple[str, ...]] = (
        "segments",
        "segment_steps",
        "worlds",
        "curve_episodes",
        "final_episodes",
    )
    algorithm: Algorithm = field(default_factory=Ppo)
    seed: int = 0
    segments: int = 20
    segment_steps: int = 270
    worlds: int = 64
    effort_weight: float | None = None
    disturbance: str = "uniform"
    disturbance_bound: float = 0.75
    curve_episodes: int = 200
    final_episodes: int = 1000

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.effort_weight is not None:
            check_not_negative("effort_weight", self.effort_weight)
        check_whole("seed", self.seed, 0, MOST_SEEDS - 1)
        check_name("disturbance", self.disturbance, OPEN_LOOP)
        check_disturbance_bound("disturbance_bound", self.disturbance_bound)
        if self.segments >= MOST_SEGMENTS:
            raise ValueError(
                f"segments={self.segments} must be below {MOST_SEGMENTS}; make segment_steps larger"
            )
        algorithm = self.algorithm
        if isinstance(algorithm, Ppo) and self.segment_steps % algorithm.rollout_steps:
            raise ValueError(
                f"segment_steps={self.segment_steps} must be a multiple of "
                f"rollout_steps={algorithm.rollout_steps}"
            )

    @property
    def label(self) -> str:
        """Name of the runs that differ in the seed alone."""
        return self.algorithm.name

    @property
    def rows(self) -> int:
        """Agents that learn side by side."""
        return self.worlds

    @property
    def steps_of_segment(self) -> int:
        """Control steps of a segment, over all agents of all worlds."""
        return self.segment_steps * self.rows

    def learning_rate(self, segment: int) -> float:
        """Return the learning rate of a segment."""
        return self.algorithm.learning_rate * (1.0 - 0.9 * segment / self.segments)

    def record(self) -> dict[str, Any]:
        """Return all settings as JSON knows them, with the names of task and algorithm."""
        own = {item.name: getattr(self, item.name) for item in fields(self)}
        own["algorithm"] = {"name": self.algorithm.name, **asdict(self.algorithm)}
        return {"task": self.task, **own}


@dataclass(frozen=True)
class SingleTraining(Training):
    """A run with a task of one body; attributes as in `Training`, and these.

    Attributes:
        largest_correction: The agent corrects LAG-ROS by at most so much, in the units of the
            control; None for an agent that controls the body alone.
        task: The task.
        feature_scales: What is large on the task, for the features of an agent that learns from a
            buffer; () for the task's `state_scale`.

    Raises:
        ValueError: A value is out of range.
    """

    feature_scales: ClassVar[Numbers] = ()
    largest_correction: float | None = None
    task: str = field(default_factory=first_task)

    def __post_init__(self) -> None:
        super().__post_init__()
        described = self.described
        names = {item.name for item in fields(described)}
        if self.effort_weight is not None and "effort_weight" not in names:
            raise ValueError(
                f"effort_weight={self.effort_weight!r}: {self.task} has no such setting; leave it "
                "out for the weight of its reward"
            )
        if self.largest_correction is not None:
            check_positive("largest_correction", self.largest_correction)
            most = min(described.control_scale)
            if self.largest_correction > most:
                raise ValueError(
                    f"largest_correction={self.largest_correction!r} is more than the actuator's "
                    f"{most:g} {described.control_unit}".rstrip()
                    + f"; leave it out for an agent that controls {self.task} alone"
                )

    @property
    def described(self) -> Task:
        """The task."""
        found = find_task(self.task)
        assert isinstance(found, Task)
        return found

    @property
    def label(self) -> str:
        """Name of the runs that differ in the seed alone."""
        if self.largest_correction is None:
            return super().label
        # A part of the name of a folder.
        unit = re.sub(r"\W", "", self.described.control_unit)
        return f"residual-{self.algorithm.name}-{self.largest_correction:g}{unit}"


moved_names(__name__)
