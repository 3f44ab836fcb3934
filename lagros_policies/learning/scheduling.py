"""Outputs that are affine in some inputs, in training: y = c(z) + K(z) s, each part scaled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]

# No gain is taken to vary by less than this share of the labels' spread over its input's.
_LEAST = 1e-2


@dataclass(frozen=True)
class Schedule:
    """What the numbers that a network gives are in units of: c and K, as means and spreads.

    Attributes:
        mean: Of c, (m,), then of the rows of K, (m, k); shape (m (1 + k),).
        spread: Likewise.
        inputs: k.
    """

    mean: Float32Array
    spread: Float32Array
    inputs: int

    def answers(
        self, found: Sequence[torch.Tensor], states: Sequence[torch.Tensor]
    ) -> list[torch.Tensor]:
        """Return y, shape (s, m), and its slope along a direction if there is one.

        Args:
            found: What the layers give, shape (s, m (1 + k)), and its slope along the direction.
            states: s, shape (s, k), and the direction.
        """
        import torch

        mean, spread = torch.from_numpy(self.mean), torch.from_numpy(self.spread)
        offset, gain = self._parts(found[0] * spread + mean)
        state = states[0]
        answers = [offset + (gain * state[:, None]).sum(-1)]
        if len(found) > 1:
            shift, turn = self._parts(found[1] * spread)
            slope = (turn * state[:, None] + gain * states[1][:, None]).sum(-1)
            answers.append(shift + slope)
        return answers

    def _parts(self, numbers: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        size = numbers.shape[1] // (1 + self.inputs)
        return numbers[:, :size], numbers[:, size:].reshape(-1, size, self.inputs)

    def folded(
        self, weight: FloatArray, bias: FloatArray, units: Float32Array
    ) -> tuple[FloatArray, FloatArray]:
        """Return a last layer that gives c and K in the units of the control.

        Args:
            weight: Its weights, shape (width, m (1 + k)).
            bias: Its biases, shape (m (1 + k),).
            units: Rows of which labels are sums, shape (m, m).
        """
        rows = np.concatenate([weight * self.spread, (bias * self.spread + self.mean)[None]])
        m = len(units)
        gains = rows[:, m:].reshape(-1, m, self.inputs)
        turned = np.einsum("wmk,mu->wuk", gains, units.astype(np.float64))
        both = np.concatenate([rows[:, :m] @ units, turned.reshape(len(rows), -1)], axis=1)
        return both[:-1], both[-1]


def schedule_of(
    states: Float32Array, labels: Float32Array, moves: tuple[Float32Array, Float32Array] | None
) -> Schedule:
    """Return on which scales c and K lie.

    Args:
        states: s of samples, shape (s, k).
        labels: y, shape (s, m).
        moves: Directions in which s moves and the slopes of y along them, shapes (s, k) and (s, m);
            None where they are not known.
    """
    inputs, outputs = states.shape[1], labels.shape[1]
    # In double precision: sums of many rows.
    state, label = states.astype(np.float64), labels.astype(np.float64)
    least = _LEAST * label.std(axis=0) / np.maximum(state.std(axis=0)[:, None], 1e-12)
    gain: FloatArray = np.zeros((inputs, outputs))
    vary: FloatArray = np.square(least / _LEAST)
    if moves is not None:
        along, slope = (part.astype(np.float64) for part in moves)
        gain = np.asarray(np.linalg.lstsq(along, slope, rcond=None)[0], np.float64)
        # Along v the gain moves a slope by sum_j dK_j v_j, whose square is that of the spreads.
        left = np.square(slope - along @ gain)
        vary = np.asarray(np.linalg.lstsq(np.square(along), left, rcond=None)[0], np.float64)
    spread = np.maximum(np.sqrt(np.maximum(vary, 0.0)), least)
    offset = label - state @ gain
    mean = np.concatenate([offset.mean(axis=0), gain.T.ravel()])
    size = np.concatenate([np.maximum(offset.std(axis=0), _LEAST), spread.T.ravel()])
    return Schedule(mean.astype(np.float32), size.astype(np.float32), inputs)
