"""What every fit of a network shares: Adam, the falling step, batches by epoch, checkpoints.

The order of the samples in epoch k depends on (seed, k) alone, so that a resumed run gives the
weights that an uninterrupted one gives, bit for bit on the same machine.
"""

from __future__ import annotations

import itertools
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from lagros_policies.learning.checkpoint import load_progress, save_progress

if TYPE_CHECKING:
    import torch

IntArray = NDArray[np.intp]
FloatArray = NDArray[np.float64]


class FitSettings(Protocol):
    """How to fit, whatever the network; a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def epochs(self) -> int:
        """Passes over the data."""

    @property
    def learning_rate(self) -> float:
        """Adam's step at first; a cosine takes it to a hundredth of that."""

    @property
    def checkpoint_every(self) -> int:
        """Epochs between checkpoints."""

    @property
    def seed(self) -> int:
        """Seed of initial weights and sample order."""


Settings = TypeVar("Settings", bound=FitSettings)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread: more are slower at this size, and one makes sums repeatable."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def dense(widths: Sequence[int], activation: type[torch.nn.Module]) -> torch.nn.Sequential:
    """Return fully connected layers of these widths, the activation after each."""
    import torch

    layers: list[torch.nn.Module] = []
    for width, following in itertools.pairwise(widths):
        layers += [torch.nn.Linear(width, following), activation()]
    return torch.nn.Sequential(*layers)


def layers_in(module: torch.nn.Module) -> list[tuple[FloatArray, FloatArray]]:
    """Return weights (inputs, outputs) and biases of fully connected layers, in float64."""
    state = [value.detach().numpy().astype(np.float64) for value in module.parameters()]
    return [(weight.T, bias) for weight, bias in zip(state[0::2], state[1::2], strict=True)]


class Fit(ABC, Generic[Settings]):
    """One training run by Adam: parameters, optimiser and the number of epochs done.

    Args:
        settings: How to fit.
        checkpoint: File that holds the progress; removed by nobody, resumed from if it fits.
        parameters: What is fitted, with its initial values.
        count: Number of samples.
        data: Hash of the samples.

    Raises:
        ValueError: The checkpoint is damaged, or of other settings or data.
    """

    def __init__(
        self,
        settings: Settings,
        checkpoint: Path,
        parameters: Sequence[torch.nn.Parameter],
        count: int,
        data: str,
    ) -> None:
        """Build the optimiser and take up the checkpoint, if there is one."""
        import torch

        self.settings, self.checkpoint = settings, checkpoint
        self.parameters, self.count = parameters, count
        self.optimiser = torch.optim.Adam(parameters, lr=settings.learning_rate)
        self._fingerprint = json.dumps({"settings": asdict(settings), "data": data})
        self.epoch = load_progress(checkpoint, parameters, self.optimiser, self._fingerprint)

    @abstractmethod
    def batches(self, order: IntArray) -> Sequence[IntArray]:
        """Cut the samples of an epoch, shape (count,), into batches."""

    @abstractmethod
    def loss(self, batch: IntArray) -> torch.Tensor:
        """Return the mean loss of some samples, a scalar."""

    def finish(self, on_epoch: Callable[[int, float], None] | None = None) -> None:
        """Fit to the end of the last epoch.

        Args:
            on_epoch: Called with the epochs done and the last epoch's loss.
        """
        while self.epoch < self.settings.epochs:
            loss = self.one_epoch()
            if self.epoch % self.settings.checkpoint_every == 0 or (
                self.epoch == self.settings.epochs
            ):
                self.save()
            if on_epoch is not None:
                on_epoch(self.epoch, loss)

    def one_epoch(self) -> float:
        """Pass once over the data and return the mean loss."""
        settings = self.settings
        order = np.random.default_rng([settings.seed, self.epoch]).permutation(self.count)
        batches = self.batches(order)
        total = 0.0
        for index, batch in enumerate(batches):
            progress = (self.epoch + index / len(batches)) / settings.epochs
            rate = settings.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress)))
            self.optimiser.param_groups[0]["lr"] = rate
            loss = self.loss(batch)
            self.optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.optimiser.step()
            total += float(loss.detach()) * len(batch)
        self.epoch += 1
        return total / self.count

    def save(self) -> None:
        """Write parameters and optimiser."""
        save_progress(
            self.checkpoint, self.parameters, self.optimiser, self._fingerprint, self.epoch
        )
