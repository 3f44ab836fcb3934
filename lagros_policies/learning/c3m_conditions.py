"""What C3M asks of a metric and a controller, of any control-affine system.

With M = W^-1, A the slope of f + B u with u held, K = du/dx and a rate lambda (Sun, Jha & Fan
2020):

    M' + (A + B K)'M + M (A + B K) + 2 lambda M < 0                                        (C)
    B_'(-dW/dt|f + Df W + W Df' + 2 lambda W) B_ < 0                                       (C1)
    B_'(dW/dt|b_j - Db_j W - W Db_j') B_ = 0,  B_ the null space of B'                     (C2)

Where the control is held for h, with x+ = Phi(x, u), F = dPhi/dx and G = dPhi/du, (C) is replaced
by what it says of V = e'M e from one hold to the next,

    ((F + G K)'M(x+)(F + G K) - exp(-2 lambda h) M(x)) / h < 0,                            (H)

which is (C) as h goes to zero. F, G and x+ are those of the control of the moment: that they move
with the controller is left out of the gradient.

Everything that the equation of motion says is exact and in NumPy (`lagros_envs.dynamics`); torch
differentiates the networks alone.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics import jacobian, linearise_hold, vector_field
from lagros_envs.task import Task
from lagros_policies.c3m import ContractionNetworks, Scaled, mlp_of
from lagros_policies.contraction import BoxRegion
from lagros_policies.learning.fitting import layers_in

if TYPE_CHECKING:
    import torch

# Random points at which a slope is looked at, and what counts as a change, in units.
_LOOKS, _CHANGE = 64, 1e-6
_WIDTHS = 6.0
# Runge-Kutta steps of a hold behind its slopes.
_SUBSTEPS = 2


class Motion(NamedTuple):
    """What the equation of motion says at samples, in scaled coordinates.

    Attributes:
        drift: f at the reference control, shape (s, n).
        drift_slope: Df, shape (s, n, n).
        reach: B, shape (s, n, m).
        reach_slope: Db_j, shape (s, m, n, n).
        unmoved: Orthonormal basis B_ of the null space of B', shape (s, n, n - m).
    """

    drift: FloatArray
    drift_slope: FloatArray
    reach: FloatArray
    reach_slope: FloatArray
    unmoved: FloatArray


def scaled_of(task: Task, region: BoxRegion, rng: np.random.Generator) -> Scaled:
    """Return the coordinates of the networks: units, and what depends on what.

    Units are those of the task; where it names none, the largest error of the region, and a sixth
    of what its controls range over.

    Args:
        task: The task.
        region: Where the networks are to work.
        rng: Of the points at which slopes are compared.
    """
    system = task.system
    drawn = region.sample(rng, _LOOKS)
    state, control = drawn.state, drawn.nominal_control
    width = np.subtract(region.control_high, region.control_low)
    scale = np.array(task.state_scale or region.error)
    reach = np.array(task.control_spread) if task.control_spread else width / _WIDTHS
    slope, effect = jacobian(system, state, control)
    seen = []
    for index in range(system.state_dim):
        other = state.copy()
        other[:, index] = np.roll(other[:, index], 1)
        moved = jacobian(system, other, control)
        change = max(np.abs(moved[0] - slope).max(), np.abs(moved[1] - effect).max())
        if change > _CHANGE:
            seen.append(index)
    still = np.abs(effect).max(axis=(0, 2)) <= _CHANGE
    # Where controls move everything no part of W is apart.
    free = np.flatnonzero(still) if still.any() else np.arange(system.state_dim)
    sides = np.array([region.low, region.high])
    middle = np.where(np.isfinite(sides).all(axis=0), sides, 0.0).mean(axis=0)
    return Scaled(middle, scale, reach, tuple(seen), tuple(int(index) for index in free))


def motion_at(task: Task, scaled: Scaled, state: FloatArray) -> Motion:
    """Return f, B and their exact slopes at states (s, n), in scaled coordinates."""
    system, m = task.system, task.system.control_dim
    centre = np.array(task.control_centre, np.float64)
    unit = scaled.scale
    slope, effect = jacobian(system, state, centre)
    drift_slope = slope * unit / unit[:, None]
    reach = effect * scaled.control_scale / unit[:, None]
    turned = []
    for index in range(m):
        pushed = centre + scaled.control_scale * np.eye(m)[index]
        moved, _ = jacobian(system, state, pushed)
        turned.append((moved - slope) * unit / unit[:, None])
    basis, _ = np.linalg.qr(reach, mode="complete")
    return Motion(
        vector_field(system, state, centre) / unit,
        drift_slope,
        reach,
        np.stack(turned, axis=1),
        basis[..., m:],
    )


class Hold:
    """One hold of the control from samples, in scaled coordinates.

    Args:
        task: The task.
        scaled: The coordinates.
        state: x, shape (s, n), not scaled.

    Attributes:
        period: h [s].
    """

    def __init__(self, task: Task, scaled: Scaled, state: FloatArray) -> None:
        self.task, self.scaled, self.state = task, scaled, state
        self.period = task.control_period

    def __call__(self, control: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x+ (s, n), F (s, n, n) and G (s, n, m) under controls (s, m) from the centre."""
        scaled, unit = self.scaled, self.scaled.scale
        held = np.array(self.task.control_centre) + scaled.control_scale * control
        after, by_state, by_control = linearise_hold(
            self.task.system, self.state, held, self.period, _SUBSTEPS
        )
        return (
            after / unit,
            by_state * unit / unit[:, None],
            by_control * scaled.control_scale / unit[:, None],
        )


class Conditions(NamedTuple):
    """Left sides of the conditions, symmetric matrices.

    Attributes:
        closed: (C) or (H), shape (s, n, n).
        open: (C1), shape (s, n - m, n - m).
        turned: (C2), shape (s, m, n - m, n - m).
        dual: W, shape (s, n, n).
    """

    closed: torch.Tensor
    open: torch.Tensor
    turned: torch.Tensor
    dual: torch.Tensor


class Networks:
    """The networks in training.

    Args:
        scaled: The coordinates.
        width: Of the hidden layer of each.
        least: w_lb.
        seed: Of the initial weights.
    """

    def __init__(self, scaled: Scaled, width: int, least: float, seed: int) -> None:
        import torch

        torch.manual_seed(seed)
        n, m = len(scaled.scale), len(scaled.control_scale)
        self.scaled, self.least = scaled, least
        count, moved = len(scaled.free), len(scaled.moved)
        inner = 3 * n  # as published
        seen, free = max(len(scaled.seen), 1), max(len(scaled.seen_free), 1)
        sizes = {
            "inner": (2 * seen, inner * n),
            "outer": (2 * seen, m * inner),
            "base": (free, count * count),
            **({"rest": (seen, n * moved)} if moved else {}),
        }
        self.parts = {
            part: torch.nn.Sequential(
                torch.nn.Linear(before, width),
                torch.nn.Tanh(),
                torch.nn.Linear(width, after),
            )
            for part, (before, after) in sizes.items()
        }
        self._centre = single(scaled.centre / scaled.scale)

    @property
    def parameters(self) -> list[torch.nn.Parameter]:
        """All weights and biases."""
        return [value for part in self.parts.values() for value in part.parameters()]

    def deviation(self, state: torch.Tensor, nominal: torch.Tensor) -> torch.Tensor:
        """Return (u - u_d) / S_u, shape (s, m), at scaled x and x_d."""
        import torch

        shown = torch.cat([self._seen(state), self._seen(nominal)], dim=-1)
        n, m = len(self.scaled.scale), len(self.scaled.control_scale)
        first = self.parts["inner"](shown).reshape(len(state), -1, n)
        second = self.parts["outer"](shown).reshape(len(state), m, -1)
        inner = torch.tanh(first @ (state - nominal).unsqueeze(-1))
        answer: torch.Tensor = (second @ inner).squeeze(-1)
        return answer

    def dual(self, state: torch.Tensor) -> torch.Tensor:
        """Return W, shape (s, n, n), at scaled x."""
        return self.dual_along(state, state.new_zeros(0, *state.shape))[0]

    def dual_along(
        self, state: torch.Tensor, ways: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return W at scaled x (s, n), and its rates along ways (q, s, n), shape (q, s, n, n)."""
        import torch

        scaled, n, count = self.scaled, len(self.scaled.scale), len(self.scaled.free)
        value, rate = self._along("base", state, ways, scaled.seen_free)
        below = (0, 0, 0, n - count)
        parts = [
            torch.nn.functional.pad(one.reshape(*one.shape[:-1], count, count), below)
            for one in (value, rate)
        ]
        if "rest" in self.parts:
            rest = self._along("rest", state, ways, scaled.seen)
            parts = [
                torch.cat([one, other.reshape(*other.shape[:-1], n, n - count)], dim=-1)
                for one, other in zip(parts, rest, strict=True)
            ]
        place = np.argsort([*scaled.free, *scaled.moved]).tolist()
        factor, change = (one[..., place] for one in parts)
        half = factor.mT @ change
        return factor.mT @ factor + self.least * torch.eye(n), half + half.mT

    def _along(
        self, part: str, state: torch.Tensor, ways: torch.Tensor, which: tuple[int, ...]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return what a network says, and how that moves along ways; both of one hidden layer."""
        import torch

        layers: Any = self.parts[part]
        first, _, second = layers
        hidden = torch.tanh(first(self._seen(state, which)))
        shown = ways[..., list(which)] if which else 0.0 * ways[..., :1]
        moved = (1.0 - hidden.square()) * (shown @ first.weight.T)
        return second(hidden), moved @ second.weight.T

    def _seen(self, state: torch.Tensor, which: tuple[int, ...] | None = None) -> torch.Tensor:
        index = list(self.scaled.seen if which is None else which)
        if not index:
            return 0.0 * state[:, :1]
        return state[:, index] - self._centre[index]

    def conditions(
        self,
        state: torch.Tensor,
        nominal: torch.Tensor,
        nominal_control: torch.Tensor,
        motion: Motion,
        rate: float,
        hold: Hold | None = None,
    ) -> Conditions:
        """Return the left sides at scaled samples.

        Args:
            state: x, shape (s, n).
            nominal: x_d, shape (s, n).
            nominal_control: u_d, from the reference control, shape (s, m).
            motion: What the equation of motion says there.
            rate: lambda [1/s].
            hold: Of the control that is held: (H) takes the place of (C); None for (C).
        """
        import torch

        drift, drift_slope, reach, reach_slope, unmoved = map(single, motion)
        state = state.detach().requires_grad_(True)
        control = nominal_control + self.deviation(state, nominal)
        gain = torch.stack(
            [
                torch.autograd.grad(control[:, index].sum(), state, create_graph=True)[0]
                for index in range(control.shape[1])
            ],
            dim=1,
        )
        # W along f and along every column of B, and along the loop where its rate matters.
        ways = [drift, *reach.unbind(-1)]
        if hold is None:
            ways.append(drift + (reach @ control.unsqueeze(-1)).squeeze(-1))
        dual, changes = self.dual_along(state.detach(), torch.stack(ways))
        metric = torch.linalg.inv(dual)
        if hold is None:
            slope = drift_slope + torch.einsum("sj,sjik->sik", control, reach_slope)
            half = metric @ (slope + reach @ gain)
            closed = half + half.mT + 2.0 * rate * metric - metric @ changes[-1] @ metric
        else:
            after, by_state, by_control = hold(control.detach().double().numpy())
            moved = single(by_state) + single(by_control) @ gain
            ahead = moved.mT @ torch.linalg.solve(self.dual(single(after)), moved)
            closed = (ahead - math.exp(-2.0 * rate * hold.period) * metric) / hold.period
        half = drift_slope @ dual
        inside = -changes[0] + half + half.mT + 2.0 * rate * dual
        turn = reach_slope @ dual.unsqueeze(1)
        turned = changes[1 : 1 + reach.shape[-1]].transpose(0, 1) - turn - turn.mT
        basis = unmoved.unsqueeze(1)
        return Conditions(closed, unmoved.mT @ inside @ unmoved, basis.mT @ turned @ basis, dual)

    def frozen_copy(self, metadata: dict[str, str]) -> ContractionNetworks:
        """Return the networks as arrays that run without torch."""
        made = {part: mlp_of(layers_in(one)) for part, one in self.parts.items()}
        return ContractionNetworks(
            self.scaled,
            made["inner"],
            made["outer"],
            made["base"],
            made.get("rest"),
            self.least,
            metadata,
        )


def lacking(matrix: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Return by how much z'Pz of matrices (s, n, n) is positive on average where it is.

    Args:
        matrix: P.
        directions: z, of length one, shape (q, n).
    """
    outer = directions.unsqueeze(-1) * directions.unsqueeze(-2)
    values = matrix.flatten(1) @ outer.flatten(1).mT
    above = values > 0.0
    return (values * above).sum() / above.sum().clamp(min=1)


def single(values: FloatArray) -> torch.Tensor:
    """Return an array as a tensor in single precision."""
    import torch

    return torch.tensor(values, dtype=torch.float32)
