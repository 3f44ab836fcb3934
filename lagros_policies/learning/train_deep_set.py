"""Fit a deep set to expert flights; interrupted, it goes on from its last checkpoint."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_each, check_fields, check_positive, check_seed, check_whole
from lagros_policies.learning.deep_set import DeepSet, Elements, SetFeatures
from lagros_policies.learning.fitting import Fit, IntArray, dense, layers_in, one_thread

if TYPE_CHECKING:
    import torch

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class DeepSetTraining:
    """How to fit.

    Attributes:
        element: Widths of the layers of phi_n and phi_o.
        agent: Widths of the hidden layers of rho.
        epochs: Passes over the data; samples of one world resemble each other, and more passes fit
            the worlds.
        batch: Samples per step.
        learning_rate: Adam's step at first; a cosine takes it to a hundredth of that.
        outlier: Error beyond which the loss grows linearly, in units of the labels' root mean
            square: where labels disagree, a small one follows the many and not the mean.
        checkpoint_every: Epochs between checkpoints.
        seed: Seed of initial weights and sample order.

    Raises:
        ValueError: A value is out of range.
    """

    element: tuple[int, ...] = (100, 100)
    agent: tuple[int, ...] = (100, 100)
    epochs: int = 2
    batch: int = 512
    learning_rate: float = 2e-3
    outlier: float = 0.2
    checkpoint_every: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        check_fields(self)
        for name in ("element", "agent"):
            check_each(name, getattr(self, name), 1)
        for name in ("epochs", "batch", "checkpoint_every"):
            check_whole(name, getattr(self, name))
        check_seed(self.seed)
        for name in ("learning_rate", "outlier"):
            check_positive(name, getattr(self, name))


@dataclass(frozen=True)
class SetSamples:
    """Features and labels of many agents.

    Attributes:
        features: Inputs of s samples.
        target: Accelerations in the frame of the features, and of the heading, shape (s, 3).
        world: Which world each sample belongs to, shape (s,).
    """

    features: SetFeatures
    target: Float32Array
    world: IntArray

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.target)


def join(parts: Sequence[SetSamples]) -> SetSamples:
    """Return all samples in one; worlds of different parts stay different."""
    offsets = np.cumsum([0] + [len(part) for part in parts])
    worlds = np.cumsum([0] + [int(part.world.max(initial=-1)) + 1 for part in parts])
    features = [part.features for part in parts]
    return SetSamples(
        SetFeatures(
            np.concatenate([one.own for one in features]),
            _join_elements([one.neighbours for one in features], offsets),
            _join_elements([one.obstacles for one in features], offsets),
            np.concatenate([one.frame for one in features]),
        ),
        np.concatenate([part.target for part in parts]),
        np.concatenate([part.world + first for part, first in zip(parts, worlds, strict=False)]),
    )


def only(samples: SetSamples, chosen: NDArray[np.bool_]) -> SetSamples:
    """Return those samples that are chosen, shape (s,)."""
    place = np.cumsum(chosen) - 1

    def kept(elements: Elements) -> Elements:
        rows = chosen[elements.owner]
        owner = place[elements.owner[rows]]
        return Elements(elements.values[rows], owner, elements.weight[rows])

    own, neighbours, obstacles, frame = samples.features
    features = SetFeatures(own[chosen], kept(neighbours), kept(obstacles), frame[chosen])
    return SetSamples(features, samples.target[chosen], samples.world[chosen])


def _join_elements(parts: Sequence[Elements], offsets: IntArray) -> Elements:
    return Elements(
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.owner + first for part, first in zip(parts, offsets, strict=False)]),
        np.concatenate([part.weight for part in parts]),
    )


class _Ragged:
    """The elements of each of `count` samples, with scaled values, to be picked by samples."""

    def __init__(self, elements: Elements, values: Float32Array, count: int) -> None:
        self.values, self.weight = values, elements.weight
        self.count = np.bincount(elements.owner, minlength=count)
        self.begin = np.cumsum(self.count) - self.count

    def pick(self, samples: IntArray) -> tuple[Float32Array, IntArray, Float32Array]:
        """Return values, owners among the samples, and weights."""
        count = self.count[samples]
        owner = np.repeat(np.arange(len(samples)), count)
        within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        index = within + self.begin[samples][owner]
        return self.values[index], owner, self.weight[index]


def fit_deep_set(
    samples: SetSamples,
    settings: DeepSetTraining,
    checkpoint: Path,
    on_epoch: Callable[[int, float], None] | None = None,
    begun: DeepSet | None = None,
) -> DeepSet:
    """Fit a network by Adam on the Huber loss of the scaled accelerations.

    The labels of one observation scatter, because an agent does not sense what others plan. The
    square of small errors asks for the mean of the labels, the size of large ones for a median.

    Args:
        samples: What to fit.
        settings: How to fit.
        checkpoint: File that holds the progress; resumed from if it fits.
        on_epoch: Called with the epochs done and the last epoch's loss.
        begun: The network whose weights to go on from, of the same widths; None for random ones.

    Returns:
        The network, with the normalisation folded in.
    """
    with one_thread():
        run = _Run(samples, settings, checkpoint, begun)
        run.finish(on_epoch)
        return run.network()


class _Run(Fit[DeepSetTraining]):
    """A run over samples whose inputs and labels are scaled."""

    def __init__(
        self,
        samples: SetSamples,
        settings: DeepSetTraining,
        checkpoint: Path,
        begun: DeepSet | None = None,
    ) -> None:
        import torch

        features, count = samples.features, len(samples)
        inputs = features.own, features.neighbours.values, features.obstacles.values
        self.scales = [_statistics(values) for values in inputs]
        own, neighbours, obstacles = (
            (values - mean) / deviation
            for values, (mean, deviation) in zip(inputs, self.scales, strict=True)
        )
        # One scale for the plane; the torque, which is easy, counts a third of it.
        plane = float(np.sqrt(np.mean(samples.target[:, :2] ** 2)))
        turn = float(np.sqrt(np.mean(samples.target[:, 2] ** 2)))
        self.target_scale = np.array([plane, plane, max(3.0 * turn, 1e-3)], np.float32)
        self.own, self.target = own, samples.target / self.target_scale
        self.neighbours = _Ragged(features.neighbours, neighbours, count)
        self.obstacles = _Ragged(features.obstacles, obstacles, count)
        torch.manual_seed(settings.seed)
        wide, relu = settings.element[-1], torch.nn.ReLU
        self.parts = [
            dense([neighbours.shape[1], *settings.element], relu),
            dense([obstacles.shape[1], *settings.element], relu),
            dense([own.shape[1] + 2 * wide, *settings.agent, self.target.shape[1]], relu)[:-1],
        ]
        data = hashlib.sha256()
        if begun is not None:
            self._go_on_from(begun)
            for name in sorted(begun.layers):
                for weight, bias in begun.layers[name]:
                    data.update(weight.tobytes() + bias.tobytes())
        for array in (own, neighbours, obstacles, self.target):
            data.update(np.ascontiguousarray(array).tobytes())
        parameters = [value for part in self.parts for value in part.parameters()]
        super().__init__(settings, checkpoint, parameters, count, data.hexdigest())

    def _go_on_from(self, begun: DeepSet) -> None:
        """Take the weights of a network, for inputs and outputs as they are scaled here.

        An input that does not vary in these samples has no scale, and what it says goes into the
        biases.

        Raises:
            ValueError: Its widths are others.
        """
        import torch

        own, neighbours, obstacles = self.scales
        layers: list[list[Any]] = [
            list(begun.layers[name]) for name in ("neighbour", "obstacle", "agent")
        ]
        for part, (mean, deviation) in zip(layers, (neighbours, obstacles, own), strict=True):
            first, bias = (np.array(array, np.float64) for array in part[0])
            width = len(mean)
            bias = bias + mean @ first[:width]
            first[:width] *= np.where(np.isfinite(deviation), deviation, 0.0)[:, None]
            part[0] = first, bias
        weight, bias = layers[2][-1]
        layers[2][-1] = weight / self.target_scale, bias / self.target_scale
        for module, part in zip(self.parts, layers, strict=True):
            values = [array for weight, bias in part for array in (np.transpose(weight), bias)]
            parameters = list(module.parameters())
            if [tuple(one.shape) for one in parameters] != [np.shape(value) for value in values]:
                raise ValueError("begun: the network has other widths than are to be fitted")
            for parameter, value in zip(parameters, values, strict=True):
                parameter.data = torch.tensor(np.ascontiguousarray(value), dtype=torch.float32)

    def batches(self, order: IntArray) -> list[IntArray]:
        """Cut into batches of almost equal sizes."""
        return np.array_split(order, max(1, len(order) // self.settings.batch))

    def loss(self, batch: IntArray) -> torch.Tensor:
        """Return the mean Huber loss of a batch."""
        import torch

        target = torch.from_numpy(self.target[batch])
        return torch.nn.functional.smooth_l1_loss(
            self._forward(batch), target, beta=self.settings.outlier
        )

    def _forward(self, batch: IntArray) -> torch.Tensor:
        import torch

        inputs = [torch.from_numpy(self.own[batch])]
        for part, elements in zip(self.parts, (self.neighbours, self.obstacles), strict=False):
            values, owner, weight = (torch.from_numpy(a) for a in elements.pick(batch))
            sums = torch.zeros(len(batch), self.settings.element[-1])
            inputs.append(sums.index_add_(0, owner, part(values) * weight[:, None]))
        answer: torch.Tensor = self.parts[2](torch.cat(inputs, 1))
        return answer

    def network(self) -> DeepSet:
        """Return the network with the normalisation folded into its first and last layers."""
        parts = [layers_in(module) for module in self.parts]
        scaled = zip((parts[2], parts[0], parts[1]), self.scales, strict=True)
        for part, (mean, deviation) in scaled:
            first, width = part[0][0].copy(), len(mean)
            first[:width] /= deviation[:, None]
            part[0] = first, part[0][1] - mean @ first[:width]
        weight, bias = parts[2][-1]
        parts[2][-1] = weight * self.target_scale, bias * self.target_scale
        return DeepSet(parts[0], parts[1], parts[2])


def _statistics(values: Float32Array) -> tuple[Float32Array, Float32Array]:
    mean = values.mean(axis=0, dtype=np.float64).astype(np.float32)
    deviation = values.std(axis=0, dtype=np.float64).astype(np.float32)
    # An input that never varied says nothing; where it does vary, one day, it must not shout.
    return mean, np.where(deviation > 1e-3, deviation, np.float32(np.inf))
