"""Training of a neural contraction metric: the Cholesky factors first, then the condition."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.checks import (
    check_each,
    check_fields,
)
from lagros_envs.dynamics import System, control_matrix, state_dependent_coefficient
from lagros_envs.tasks.cartpole.physics import ANGLE, ANGULAR_RATE
from lagros_policies.contraction.condition import Samples
from lagros_policies.learning.networks import Mlp
from lagros_policies.tasks.cartpole.neural.design import AngleSolution
from lagros_policies.tasks.cartpole.neural.metric import (
    OUTPUTS,
    SIZE,
    NeuralMetric,
    feature,
    feature_slope,
)
from lagros_policies.tasks.cartpole.region import Region
from lagros_policies.tasks.cartpole.systems import check_cartpole

_CHECK_ANGLES = 1001
_ROWS, _COLUMNS = np.tril_indices(SIZE)
# Share by which chi exceeds what a grid shows.
_SLACK = 1e-5
# Steps after which the triples of largest residual are looked for anew.
_REFRESH = 50
# nu over that of the program: a larger one never hurts the condition, and leaves the network room.
_CONTROL = 2.0
# Weight of staying near the factors while the condition is fitted.
_STAY = 0.1


@dataclass(frozen=True)
class NeuralTrainingSettings:
    """How the network is made.

    Attributes:
        hidden: Neurons of each hidden layer.
        fit_steps: Steps of regression on the Cholesky factors.
        condition_steps: Steps on the condition.
        batch: Triples in a step on the condition.
        learning_rate: Of Adam, at the start; it falls to a hundredth.
        margin: How far below zero the condition is pushed [1/s].
        seed: Of initial weights and batches.

    Raises:
        ValueError: A number is not positive.
    """

    hidden: tuple[int, ...] = (24, 24)
    fit_steps: int = 1500
    condition_steps: int = 2500
    batch: int = 256
    learning_rate: float = 3e-3
    margin: float = 0.03
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(
            self,
            positive=["learning_rate"],
            not_negative=["margin"],
            least={"fit_steps": 1, "batch": 1, "condition_steps": 0},
        )
        check_each("hidden", self.hidden, 1)


def fit_network(
    system: System,
    pool: Samples,
    solution: AngleSolution,
    region: Region,
    settings: NeuralTrainingSettings | None = None,
) -> NeuralMetric:
    """Fit the network to the solution, then to the condition on the pool.

    Args:
        system: The cart-pole.
        pool: Triples at which the condition is pushed below zero.
        solution: What the network learns first; its rate and scaling stay.
        region: The region.
        settings: Network and training.

    Returns:
        The metric, not yet verified.
    """
    check_cartpole(system, "fit_network")
    settings = settings or NeuralTrainingSettings()
    weights, biases = _train(system, pool, solution, region, settings)
    angles = np.linspace(0.0, region.angle, _CHECK_ANGLES)
    metric = NeuralMetric(
        Mlp(weights, biases),
        solution.contraction_rate,
        1.0,
        _CONTROL * solution.control_weight,
        solution.scaling,
        region,
    )
    states = np.zeros((_CHECK_ANGLES, SIZE))
    states[:, ANGLE] = angles
    scale = metric.scaling
    values = np.linalg.eigvalsh(metric.matrix(states) / (scale[:, None] * scale[None, :]))
    # M is scaled so that its largest eigenvalue is one, I <= S W_bar S: L by the root, nu by the
    # inverse, which changes nothing in the condition.
    largest = float(values.max())
    diagonal = _ROWS == _COLUMNS
    shrink = np.where(diagonal, 1.0, largest**-0.5)
    weights[-1], biases[-1] = weights[-1] * shrink, biases[-1] * shrink
    biases[-1] -= np.where(diagonal, 0.5 * math.log(largest), 0.0)
    return NeuralMetric(
        Mlp(weights, biases),
        solution.contraction_rate,
        # Single precision and the gaps of the grid may exceed the ratio by a little.
        (1.0 + _SLACK) * largest / float(values.min()),
        _CONTROL * solution.control_weight * largest,
        scale,
        region,
    )


def _train(
    system: System,
    pool: Samples,
    solution: AngleSolution,
    region: Region,
    settings: NeuralTrainingSettings,
) -> tuple[list[FloatArray], list[FloatArray]]:
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        trainer = _Trainer(system, pool, solution, region, settings)
        trainer.fit_factors()
        trainer.fit_condition()
        return trainer.layers()
    finally:
        torch.set_num_threads(threads)


class _Trainer:
    """The network in torch, which is imported only here."""

    def __init__(
        self,
        system: System,
        pool: Samples,
        solution: AngleSolution,
        region: Region,
        settings: NeuralTrainingSettings,
    ) -> None:
        import torch

        torch.manual_seed(settings.seed)
        self.torch, self.settings, self.solution = torch, settings, solution
        self.region, self.rate = region, solution.contraction_rate
        sizes = (1, *settings.hidden, OUTPUTS)
        self._layers = [
            torch.nn.Linear(inputs, outputs, dtype=torch.float64)
            for inputs, outputs in itertools.pairwise(sizes)
        ]
        self._rng = np.random.default_rng(settings.seed)
        scale = solution.scaling
        slope = state_dependent_coefficient(system, pool.state, pool.nominal, pool.nominal_control)
        self._slope = torch.tensor(slope * scale[:, None] / scale[None, :])
        gain = control_matrix(system, pool.state) * scale[:, None]
        self._reach = torch.tensor(gain @ np.swapaxes(gain, -1, -2))
        angle = pool.state[:, ANGLE]
        self._value = torch.tensor(feature(angle, region))[:, None]
        change = feature_slope(angle, region) * pool.state[:, ANGULAR_RATE]
        self._change = torch.tensor(change)[:, None]

    def layers(self) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return weights (inputs, outputs) and biases."""
        weights = [layer.weight.detach().numpy().T.copy() for layer in self._layers]
        return weights, [layer.bias.detach().numpy().copy() for layer in self._layers]

    def fit_factors(self) -> None:
        """Regress on the Cholesky factors of M at random angles."""
        optimiser, schedule = self._optimiser(self.settings.fit_steps)
        for _ in range(self.settings.fit_steps):
            angle = self._rng.uniform(0.0, self.region.angle, 64)
            factor, _ = self._factor(*self._still(angle))
            error = factor - self._target(angle)
            self._descend((error * error).mean(), optimiser, schedule)

    def fit_condition(self) -> None:
        """Push the largest eigenvalue of the condition, and those of M, to where they belong."""
        torch, settings = self.torch, self.settings
        optimiser, schedule = self._optimiser(settings.condition_steps)
        count = len(self._value)
        half = max(1, min(settings.batch, count) // 2)
        hardest = np.arange(half)
        for step in range(settings.condition_steps):
            if step % _REFRESH == 0:
                with torch.no_grad():
                    excess = self._excess(np.arange(count)).numpy()
                hardest = np.argsort(excess)[::-1][: 2 * half].copy()
            index = np.concatenate(
                [self._rng.choice(hardest, half), self._rng.integers(count, size=half)]
            )
            loss = (torch.relu(self._excess(index) + settings.margin) ** 2).mean()
            angle = self._rng.uniform(0.0, self.region.angle, 32)
            factor, _ = self._factor(*self._still(angle))
            values = torch.linalg.eigvalsh(factor @ factor.mT)
            low = -torch.log(values[:, 0] * self.solution.condition_bound)
            loss = loss + (torch.relu(low) ** 2 + torch.relu(torch.log(values[:, -1])) ** 2).mean()
            drift = factor - self._target(angle)
            self._descend(loss + _STAY * (drift * drift).mean(), optimiser, schedule)

    def _target(self, angle: FloatArray) -> Any:
        states = np.zeros((len(angle), SIZE))
        states[:, ANGLE] = angle
        scale = self.solution.scaling
        dual = self.solution.dual(states) * scale[:, None] * scale[None, :]
        return self.torch.tensor(np.linalg.cholesky(np.linalg.inv(dual)))

    def _still(self, angle: FloatArray) -> tuple[Any, Any]:
        value = self.torch.tensor(feature(angle, self.region))[:, None]
        return value, self.torch.zeros_like(value)

    def _excess(self, index: IntArray) -> Any:
        """Return the residual of the condition in the units of `contraction_residual` [1/s]."""
        torch = self.torch
        factor, rate = self._factor(self._value[index], self._change[index])
        matrix = factor @ factor.mT
        half = rate @ factor.mT + matrix @ self._slope[index] + self.rate * matrix
        pull = matrix @ self._reach[index] @ matrix
        left = half + half.mT - 2.0 * _CONTROL * self.solution.control_weight * pull
        once = torch.linalg.solve_triangular(factor, left, upper=False)
        twice = torch.linalg.solve_triangular(factor, once.mT, upper=False)
        return torch.linalg.eigvalsh(0.5 * (twice + twice.mT))[:, -1]

    def _factor(self, value: Any, slope: Any) -> tuple[Any, Any]:
        """Return L and its rate, both (b, 4, 4), for a feature and its rate, (b, 1)."""
        torch = self.torch
        for layer in self._layers[:-1]:
            value = torch.tanh(layer(value))
            slope = (1.0 - value * value) * (slope @ layer.weight.T)
        entries, slopes = self._layers[-1](value), slope @ self._layers[-1].weight.T
        diagonal = torch.tensor(_ROWS == _COLUMNS)
        grown = torch.exp(torch.where(diagonal, entries, torch.zeros_like(entries)))
        parts = torch.where(diagonal, grown, entries), grown * slopes
        factors = []
        for part in parts:
            full = torch.zeros((len(part), SIZE, SIZE), dtype=torch.float64)
            full[:, _ROWS, _COLUMNS] = part
            factors.append(full)
        return factors[0], factors[1]

    def _optimiser(self, steps: int) -> tuple[Any, Any]:
        torch = self.torch
        parameters = [parameter for layer in self._layers for parameter in layer.parameters()]
        optimiser = torch.optim.Adam(parameters, lr=self.settings.learning_rate)
        last = 0.01 * self.settings.learning_rate
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(steps, 1), last)
        return optimiser, schedule

    def _descend(self, loss: Any, optimiser: Any, schedule: Any) -> None:
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
