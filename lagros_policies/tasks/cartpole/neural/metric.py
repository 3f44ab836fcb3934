"""A neural contraction metric of the cart-pole: a small network for the Cholesky factor of M.

The remark after Theorem 2: the metric may be a network (NCM, Tsukamoto and Chung 2021). Here

    M(x) = S L(theta) L(theta)' S,   L lower triangular with a positive diagonal,

so that M is positive definite whatever the weights are; S holds the units in which chi is measured.
The network sees cos(theta) alone. Three reasons: the condition of Theorem 2 depends on no position
and on no speed of the cart; a metric of the angle changes at the rate theta', which needs neither
the force nor the disturbance; and an even function keeps the symmetry of left and right.

dM/dtheta is computed layer by layer beside M, exactly. `NeuralMetric` is a
`ContractionMetric` like `Metric`, so that `HeldControl`, `robust_control`, `contraction_residual`,
`verify_metric` and `certified_tube` take it in its place. `design` makes one.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_positive
from lagros_envs.reading import Record, named, parse_json
from lagros_envs.tasks.cartpole.physics import ANGLE
from lagros_policies.contraction.metric import Verification
from lagros_policies.contraction.metric_files import design_arguments, design_record, naming
from lagros_policies.contraction.places import along
from lagros_policies.learning.networks import Mlp
from lagros_policies.tasks.cartpole.region import Region

SIZE = 4
OUTPUTS = SIZE * (SIZE + 1) // 2
_ROWS, _COLUMNS = np.tril_indices(SIZE)
_DIAGONAL = _ROWS == _COLUMNS
# Angles at which M must be positive definite.
_ANGLES = 41
_FORMAT = "lagros-neural-metric-1"


@dataclass(frozen=True)
class NeuralMetric:
    """M = S L L' S from a network; used wherever a `Metric` is.

    Attributes:
        network: Maps the feature of `feature` to the ten entries of L by rows; the diagonal as its
            logarithm.
        contraction_rate: alpha [1/s].
        condition_bound: chi, with I / chi <= L L' <= I at the angles of a grid (observed).
        control_weight: nu, the weight of B B' in the condition.
        scaling: Diagonal of S, shape (4,).
        region: Where the metric was designed.
        verification: The independent check, or None.

    Raises:
        ValueError: The network has other inputs or outputs, or a number is out of range.
    """

    network: Mlp
    contraction_rate: float
    condition_bound: float
    control_weight: float
    scaling: FloatArray
    region: Region
    verification: Verification | None = None

    def __post_init__(self) -> None:
        if (self.network.inputs, self.network.outputs) != (1, OUTPUTS):
            raise ValueError(
                f"the network has {self.network.inputs} inputs and {self.network.outputs} outputs; "
                f"a Cholesky factor of size {SIZE} needs 1 and {OUTPUTS}"
            )
        for name in ("contraction_rate", "condition_bound", "control_weight"):
            check_positive(name, getattr(self, name))
        if self.scaling.shape != (SIZE,):
            raise ValueError(f"scaling has shape {self.scaling.shape}; it must be ({SIZE},)")
        for entry in self.scaling:
            check_positive("scaling", entry)

        angles = np.linspace(0.0, self.region.angle, _ANGLES)
        matrices = self.matrix(along(angles, ANGLE, SIZE))
        if not np.all(np.isfinite(matrices)) or np.linalg.eigvalsh(matrices).min() <= 0.0:
            raise ValueError(
                "the network's M is not finite and positive definite on the region: its weights "
                "are too large, or no numbers"
            )

    @property
    def coordinates(self) -> tuple[int, ...]:
        """The angle: M depends on nothing else."""
        return (ANGLE,)

    def matrix(self, state: FloatArray) -> FloatArray:
        """Return M(x), shape (..., 4, 4), for states (..., 4)."""
        self._check_width(state)
        factor, _ = self._factor(state[..., ANGLE])
        return factor @ np.swapaxes(factor, -1, -2)

    def matrix_rate(self, state: FloatArray, motion: FloatArray) -> FloatArray:
        """Return dM/dt where the state moves at dx/dt, both (..., 4), shape (..., 4, 4)."""
        self._check_width(state)
        self._check_width(motion)
        factor, slope = self._factor(state[..., ANGLE])
        half = slope @ np.swapaxes(factor, -1, -2)
        rate = motion[..., ANGLE, None, None]
        value: FloatArray = rate * (half + np.swapaxes(half, -1, -2))
        return value

    def dual(self, state: FloatArray) -> FloatArray:
        """Return W_bar(x) = M^-1, shape (..., 4, 4)."""
        return np.asarray(np.linalg.inv(self.matrix(state)), dtype=np.float64)

    def dual_rate(self, state: FloatArray, motion: FloatArray) -> FloatArray:
        """Return dW_bar/dt = -W_bar (dM/dt) W_bar, shape (..., 4, 4)."""
        dual = self.dual(state)
        return -dual @ self.matrix_rate(state, motion) @ dual

    def verified(self, check: Verification) -> Self:
        """Return the metric with the outcome of a check."""
        return replace(self, verification=check)

    def _check_width(self, state: FloatArray) -> None:
        if np.shape(state)[-1:] != (SIZE,):
            raise ValueError(f"states of shape {np.shape(state)} must be (..., {SIZE})")

    def _factor(self, angle: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return S L and d(S L)/dtheta, both (..., 4, 4), at angles (...)."""
        value = feature(angle, self.region)[..., None]
        slope = feature_slope(angle, self.region)[..., None]
        weights, biases = self.network.weights, self.network.biases
        # The weights are stored in single precision and used in double, for the derivative's sake.
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            value = np.tanh(value @ weight.astype(np.float64) + bias)
            slope = (1.0 - value * value) * (slope @ weight.astype(np.float64))
        last = weights[-1].astype(np.float64)
        entries, entry_slopes = value @ last + biases[-1], slope @ last
        grown = np.exp(entries[..., _DIAGONAL])
        entry_slopes[..., _DIAGONAL] *= grown
        entries[..., _DIAGONAL] = grown
        shape = (*np.shape(angle), SIZE, SIZE)
        factor, factor_slope = np.zeros(shape), np.zeros(shape)
        factor[..., _ROWS, _COLUMNS] = entries
        factor_slope[..., _ROWS, _COLUMNS] = entry_slopes
        return self.scaling[:, None] * factor, self.scaling[:, None] * factor_slope


def feature(angle: FloatArray, region: Region) -> FloatArray:
    """Return the network's input: cos(theta), from -1 at the region's end to 1 at the upright."""
    lowest = math.cos(region.angle)
    value: FloatArray = 2.0 * (np.cos(angle) - lowest) / (1.0 - lowest) - 1.0
    return value


def feature_slope(angle: FloatArray, region: Region) -> FloatArray:
    """Return the derivative of `feature` by the angle [1/rad]."""
    value: FloatArray = -2.0 * np.sin(angle) / (1.0 - math.cos(region.angle))
    return value


def save_neural_metric(metric: NeuralMetric, path: Path | str) -> None:
    """Write a metric as safetensors, atomically; its numbers go into the metadata."""
    record = {"kind": _FORMAT, **design_record(metric)}
    network = Mlp(
        metric.network.weights,
        metric.network.biases,
        {"metric": json.dumps(record, sort_keys=True)},
    )
    network.save(path)


def load_neural_metric(path: Path | str | None = None) -> NeuralMetric:
    """Read a metric; nothing in the file is executed.

    Args:
        path: A file written by `save_neural_metric`; None for the shipped one.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not such a metric, or is damaged.
    """
    if path is None:
        path = Path(__file__).parents[3] / "pretrained" / "cartpole_neural_metric.safetensors"
    network = Mlp.load(path)
    text = network.metadata.get("metric", "")
    name = f"the record of {named(path)}"
    record = Record(parse_json(text, name, "that of a metric written by save_neural_metric"), name)
    record.must("kind", _FORMAT)
    with naming(path):
        arguments = design_arguments(record)
        if not isinstance(arguments["region"], Region):
            raise ValueError("'region' must be that of the cart-pole, without a kind")
        return NeuralMetric(network, **arguments)
