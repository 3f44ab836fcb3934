"""Fit a network to expert data; interrupted, it goes on from its last checkpoint.

The order of the samples in epoch k depends on (seed, k) alone, so that a resumed run gives the
weights that an uninterrupted one gives, bit for bit on the same machine.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagros_policies.imitation.checkpoint import load_progress, save_progress
from lagros_policies.imitation.networks import Mlp

if TYPE_CHECKING:
    import torch

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class TrainingSettings:
    """How to fit.

    Attributes:
        hidden: Width of each hidden layer; the paper's network is 3 layers of 100.
        epochs: Passes over the data.
        batch: Samples per step.
        learning_rate: Adam's step at first; a cosine takes it to a hundredth of that.
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
    held_out: float = 0.1
    checkpoint_every: int = 25
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden={self.hidden!r} must name at least one positive width")
        if min(self.epochs, self.batch, self.checkpoint_every) < 1:
            raise ValueError("epochs, batch and checkpoint_every must be at least 1")
        if not (0.0 < self.held_out < 1.0 and self.learning_rate > 0.0):
            raise ValueError("held_out must be in (0, 1) and learning_rate > 0")


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
) -> Mlp:
    """Fit a network by Adam on the mean of ||u_L - u*||, the loss of the paper.

    Args:
        features: Inputs, shape (s, inputs).
        labels: Expert controls, shape (s, outputs).
        settings: How to fit.
        checkpoint: File that holds the progress; removed by nobody, resumed from if it fits.
        on_epoch: Called with the epochs done and the last epoch's loss.

    Returns:
        The network, with the normalisation folded in.
    """
    import torch

    # More threads are slower at this size, and one makes the sums repeatable.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        run = _Run(features, labels, settings, checkpoint)
        while run.epoch < settings.epochs:
            loss = run.one_epoch()
            if run.epoch % settings.checkpoint_every == 0 or run.epoch == settings.epochs:
                run.save()
            if on_epoch is not None:
                on_epoch(run.epoch, loss)
        return run.network()
    finally:
        torch.set_num_threads(threads)


class _Run:
    """One training run: model, optimiser and the number of epochs done."""

    def __init__(
        self,
        features: Float32Array,
        labels: Float32Array,
        settings: TrainingSettings,
        checkpoint: Path,
    ) -> None:
        import torch

        self.settings = settings
        self.checkpoint = checkpoint
        self.input_mean, self.input_scale = _statistics(features)
        self.output_mean, self.output_scale = _statistics(labels)
        self.features = torch.from_numpy((features - self.input_mean) / self.input_scale)
        self.labels = torch.from_numpy((labels - self.output_mean) / self.output_scale)
        torch.manual_seed(settings.seed)
        widths = [features.shape[1], *settings.hidden, labels.shape[1]]
        layers: list[torch.nn.Module] = []
        for width, following in itertools.pairwise(widths):
            layers += [torch.nn.Linear(width, following), torch.nn.Tanh()]
        self.model = torch.nn.Sequential(*layers[:-1])
        self.optimiser = torch.optim.Adam(self.model.parameters(), lr=settings.learning_rate)
        data = hashlib.sha256(features.tobytes() + labels.tobytes()).hexdigest()
        self._fingerprint = json.dumps({"settings": asdict(settings), "data": data})
        self.epoch = load_progress(
            checkpoint, list(self.model.parameters()), self.optimiser, self._fingerprint
        )

    def one_epoch(self) -> float:
        """Pass once over the data and return the mean loss."""
        import torch

        settings = self.settings
        rng = np.random.default_rng([settings.seed, self.epoch])
        order = torch.from_numpy(rng.permutation(len(self.features)))
        batches = torch.split(order, settings.batch)
        total = 0.0
        for index, batch in enumerate(batches):
            progress = (self.epoch + index / len(batches)) / settings.epochs
            rate = settings.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress)))
            self.optimiser.param_groups[0]["lr"] = rate
            error = self.model(self.features[batch]) - self.labels[batch]
            # The paper's loss is the norm of the error; smoothed at zero so that it has a gradient.
            size = torch.sqrt((error * error).sum(1) + 1e-6)
            loss = size.mean()
            self.optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.optimiser.step()
            total += float(loss.detach()) * len(batch)
        self.epoch += 1
        return total / len(self.features)

    def network(self) -> Mlp:
        """Return the network with the normalisation folded into its first and last layer."""
        state = [tensor.detach().numpy().astype(np.float64) for tensor in self.model.parameters()]
        weights, biases = [w.T for w in state[0::2]], state[1::2]
        weights[0] = weights[0] / self.input_scale[:, None]
        biases[0] = biases[0] - self.input_mean @ weights[0]
        weights[-1] = weights[-1] * self.output_scale
        biases[-1] = biases[-1] * self.output_scale + self.output_mean
        return Mlp(weights, biases)

    def save(self) -> None:
        """Write model and optimiser."""
        save_progress(
            self.checkpoint,
            list(self.model.parameters()),
            self.optimiser,
            self._fingerprint,
            self.epoch,
        )


def _statistics(values: Float32Array) -> tuple[Float32Array, Float32Array]:
    deviation = values.std(axis=0, dtype=np.float64).astype(np.float32)
    mean = values.mean(axis=0, dtype=np.float64).astype(np.float32)
    return mean, np.where(deviation > 0.0, deviation, np.float32(1.0))
