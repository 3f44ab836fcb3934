"""Fit a network to expert data; interrupted, it goes on from its last checkpoint."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import (
    check_at_least,
    check_each,
    check_fields,
    check_not_negative,
    check_positive,
    check_seed,
    check_whole,
)
from lagros_policies.learning.checkpoint import load_values
from lagros_policies.learning.fitting import Fit, IntArray, one_thread
from lagros_policies.learning.layers import Alike, moved_outputs, new_layers
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.scheduling import Schedule, schedule_of

if TYPE_CHECKING:
    import torch

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]

# Labels that spread less than this share of the largest spread, squared, are the same all over.
_STILL = 1e-12
# An input that spreads by no more is the same all over, but for what a solver leaves of its goal;
# scaled up, single precision would lose it.
_STEADY = 1e-6
_ONE = np.float32(1.0)


@dataclass(frozen=True)
class TrainingSettings:
    """How to fit.

    Attributes:
        hidden: Width of each hidden layer; the paper's network is 3 layers of 100. Where some
            inputs are of things that are alike, such as discs, those of the first two layers are
            for each of these, and for the rest.
        epochs: Passes over the data.
        batch: Samples per step.
        learning_rate: Adam's step at first; a cosine takes it to a hundredth of that.
        scheduled: How many of the first inputs the outputs are affine in, see `Mlp`.
        slope_weight: Of the error of the slope along a random direction, beside that of the value.
        held_out: Share of the plans whose samples are never trained on.
        checkpoint_every: Epochs between checkpoints.
        seed: Seed of initial weights and sample order.

    Raises:
        ValueError: A value is out of range.
    """

    hidden: tuple[int, ...] = (100, 100, 100)
    epochs: int = 600
    batch: int = 512
    learning_rate: float = 3e-3
    scheduled: int = 0
    slope_weight: float = 0.0
    held_out: float = 0.1
    checkpoint_every: int = 25
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        check_each("hidden", self.hidden, 1)
        for name in ("epochs", "batch", "checkpoint_every"):
            check_whole(name, getattr(self, name))
        check_seed(self.seed)
        check_positive("learning_rate", self.learning_rate)
        check_at_least("scheduled", self.scheduled, 0)
        check_not_negative("slope_weight", self.slope_weight)
        if not 0.0 < self.held_out < 1.0:
            raise ValueError(f"held_out={self.held_out!r} must be in (0, 1)")


class Moves(NamedTuple):
    """How inputs and labels move together, along one direction for each sample.

    Attributes:
        features: Derivatives of the inputs, shape (s, inputs).
        labels: Derivatives of the labels, shape (s, outputs).
    """

    features: Float32Array
    labels: Float32Array


@dataclass(frozen=True)
class LearningError:
    """The learning error eps_l on held-out samples, in units of the control (observed).

    Attributes:
        mean: Mean of ||u_L - u*||.
        p99: 99th percentile.
        maximum: Largest.
        samples: Number of held-out samples.
    """

    mean: float
    p99: float
    maximum: float
    samples: int


def learning_error(network: Mlp, features: Float32Array, labels: Float32Array) -> LearningError:
    """Measure ||u_L - u*|| over samples, features (s, inputs) and labels (s, outputs)."""
    distance = np.linalg.norm(network(features) - labels, axis=-1)
    return LearningError(
        float(distance.mean()),
        float(np.quantile(distance, 0.99)),
        float(distance.max()),
        len(distance),
    )


def fit(
    features: Float32Array,
    labels: Float32Array,
    settings: TrainingSettings,
    checkpoint: Path,
    on_epoch: Callable[[int, float], None] | None = None,
    alike: Alike | None = None,
    after: Path | None = None,
    first: int | None = None,
    moves: Moves | None = None,
) -> Mlp:
    """Fit a network by Adam on the mean of ||u_L - u*||, the loss of the paper.

    Where the labels are known to move with the inputs, as u* does by K, the mean error of that
    slope is added, with a weight: what is proved of the loop depends on it.

    Args:
        features: Inputs, shape (s, inputs).
        labels: Expert controls, shape (s, outputs).
        settings: How to fit.
        checkpoint: File that holds the progress; removed by nobody, resumed from if it fits.
        on_epoch: Called with the epochs done and the last epoch's loss.
        alike: Which inputs are of things that are alike; None for none.
        after: Checkpoint of a fit that ended, with whose weights this one begins.
        first: How many of the samples say how inputs and outputs are scaled, the first ones, as
            they did in that fit; None for all.
        moves: How inputs and labels move together; None where that is not known.

    Returns:
        The network, with the normalisation folded in.

    Raises:
        ValueError: A checkpoint is damaged, or of other settings or data; slopes are asked for that
            are not known; or a schedule where inputs are of things that are alike.
    """
    if settings.slope_weight > 0.0 and moves is None:
        raise ValueError(
            f"slope_weight={settings.slope_weight:g} needs labels that are known to move with the "
            "inputs: the law behind them has no linear gain"
        )
    if settings.scheduled and alike is not None:
        raise ValueError(
            f"scheduled={settings.scheduled} is for networks without things that are alike"
        )
    with one_thread():
        run = _Run(features, labels, settings, checkpoint, alike, after, first, moves)
        run.finish(on_epoch)
        return run.network()


class _Run(Fit[TrainingSettings]):
    """A run over features and labels, each scaled to mean zero and deviation one.

    Labels are uncorrelated as well: of two rotors the sum moves far more than the difference, which
    turns the body and would be drowned.
    """

    def __init__(
        self,
        features: Float32Array,
        labels: Float32Array,
        settings: TrainingSettings,
        checkpoint: Path,
        alike: Alike | None,
        after: Path | None,
        first: int | None,
        moves: Moves | None,
    ) -> None:
        import torch

        self.alike = alike
        count = settings.scheduled
        given = features[:, count:]
        self.input_mean, self.input_scale = _statistics(given[:first], _STEADY, alike)
        self.output_mean, self.output_units = _units(labels[:first])
        wanted = _in_units(labels - self.output_mean, self.output_units)
        self.features = torch.from_numpy((given - self.input_mean) / self.input_scale)
        self.labels = torch.from_numpy(wanted)
        self.moved: list[torch.Tensor] = []
        if moves is not None:
            slopes = _in_units(moves.labels, self.output_units)
            along = [moves.features[:, count:] / self.input_scale, moves.features[:, :count]]
            self.moved = [torch.from_numpy(part) for part in (*along, slopes)]
        self.affine = torch.from_numpy(np.ascontiguousarray(features[:, :count]))
        self.schedule: Schedule | None = None
        if count:
            pair = None if moves is None else (moves.features[:first, :count], slopes[:first])
            self.schedule = schedule_of(features[:first, :count], wanted[:first], pair)
        torch.manual_seed(settings.seed)
        widths = [given.shape[1], *settings.hidden, labels.shape[1] * (1 + count)]
        self.layers = new_layers(widths, alike)
        data = hashlib.sha256(features.tobytes() + labels.tobytes())
        for part in moves or ():
            data.update(part.tobytes())
        parameters = [value for layer in self.layers for value in layer.parameters()]
        if after is not None:
            load_values(after, parameters)
            for value in parameters:
                data.update(value.detach().numpy().tobytes())
        super().__init__(settings, checkpoint, parameters, len(features), data.hexdigest())

    def batches(self, order: IntArray) -> list[IntArray]:
        """Cut off full batches; the last one holds the rest."""
        size = self.settings.batch
        return [order[first : first + size] for first in range(0, len(order), size)]

    def loss(self, batch: IntArray) -> torch.Tensor:
        """Return the mean of ||u_L - u*|| over a batch, and of the error of the slope."""
        import torch

        rows = torch.from_numpy(batch)
        weight = self.settings.slope_weight
        ways = [part[rows] for part in self.moved] if weight else []
        found = moved_outputs(self.layers, [self.features[rows], *ways[:1]], self.alike)
        if self.schedule is not None:
            found = self.schedule.answers(found, [self.affine[rows], *ways[1:2]])
        total = _norms(found[0] - self.labels[rows])
        return total + weight * _norms(found[1] - ways[2]) if ways else total

    def network(self) -> Mlp:
        """Return the network with the normalisation folded into its first and last layer."""
        state = [value.detach().numpy().astype(np.float64) for value in self.parameters]
        weights, biases = [weight.T for weight in state[0::2]], state[1::2]
        # The first layer; where things are alike, that of each and that of the rest.
        for index in range(1 if self.alike is None else 2):
            seen = slice(len(weights[index]))
            weights[index] = weights[index] / self.input_scale[seen, None]
            biases[index] = biases[index] - self.input_mean[seen] @ weights[index]
        if self.schedule is not None:
            weights[-1], biases[-1] = self.schedule.folded(
                weights[-1], biases[-1], self.output_units
            )
            biases[-1][: len(self.output_mean)] += self.output_mean
        else:
            weights[-1] = weights[-1] @ self.output_units
            biases[-1] = biases[-1] @ self.output_units + self.output_mean
        return Mlp(weights, biases, alike=self.alike, scheduled=self.settings.scheduled)


def _norms(error: torch.Tensor) -> torch.Tensor:
    """Return the mean norm of errors (s, m)."""
    import torch

    # The paper's loss is the norm of the error; smoothed at zero so that it has a gradient.
    return torch.sqrt((error * error).sum(1) + 1e-6).mean()


def _statistics(
    values: Float32Array, least: float, alike: Alike | None = None
) -> tuple[Float32Array, Float32Array]:
    """Return mean and spread of each column; one where it spreads by no more than `least`."""
    deviation = values.std(axis=0, dtype=np.float64).astype(np.float32)
    mean = values.mean(axis=0, dtype=np.float64).astype(np.float32)
    if alike is not None:
        # One scale for all discs; the zeros of those that are not there say nothing of it.
        rows = values[:, -alike.things * alike.size :].reshape(-1, alike.size)
        there = _statistics(rows[rows[:, -1] > 0.0], least)
        for part, scale in zip((mean, deviation), there, strict=True):
            part[-alike.things * alike.size :] = np.tile(scale, alike.things)
    return mean, np.where(deviation > least * np.maximum(np.abs(mean), 1.0), deviation, _ONE)


def _units(labels: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Return the mean of labels, (m,), and the rows of which they are uncorrelated sums, (m, m)."""
    mean, deviation = _statistics(labels, 0.0)
    if len(mean) == 1:
        return mean, deviation[:, None]
    values, vectors = np.linalg.eigh(np.cov(labels, rowvar=False, dtype=np.float64))
    # What never moves keeps its unit.
    lengths = np.sqrt(np.where(values > _STILL * values[-1], values, 1.0))
    return mean, (lengths[:, None] * vectors.T).astype(np.float32)


def _in_units(labels: Float32Array, units: Float32Array) -> Float32Array:
    if len(units) == 1:
        quotient: Float32Array = labels / units[0]
        return quotient
    return np.asarray(labels @ np.linalg.inv(units.astype(np.float64)), np.float32)
