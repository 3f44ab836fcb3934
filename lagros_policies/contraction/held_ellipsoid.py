"""Proof of a tube of a held control, at the control instants and between them."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from lagros_envs.dynamics import System
from lagros_envs.numbers import Interval, exact
from lagros_policies.contraction.held_design import HeldTube, bernstein_rate
from lagros_policies.proof.cells import Search, search
from lagros_policies.proof.families import BoxCondition, Violation, lifted_matrices
from lagros_policies.proof.matrices import matmul, negative_definite, transpose
from lagros_policies.proof.sets import triples

# The shortest hold that is covered, as a share of the longest, where shorter ones are.
SHORTEST = 1e-6
# Cells of one pass, and of a whole search.
_BATCH = 100
_MOST_CELLS = 100_000


@dataclass(frozen=True)
class HeldTubeProof:
    """What the proof of a tube of a held control came to.

    Attributes:
        tube: The tube asked about.
        conditions: The searches for a proof of (*) for each coefficient; up to the first that was
            not proved.
        jumps: Whether V does not rise at an instant, (**).
        proved: Whether the tube is proved: (*), (**), every Q_i positive definite, and the tube
            inside the box.
        seconds: Time taken [s].
    """

    tube: HeldTube
    conditions: tuple[Search[Violation], ...]
    jumps: bool
    proved: bool
    seconds: float

    @property
    def cells(self) -> int:
        """Cells examined."""
        return sum(one.cells for one in self.conditions)


def prove_held_tube(system: System, tube: HeldTube, most_seconds: float = 60.0) -> HeldTubeProof:
    """Prove the tube of a held control, or say that there is no proof.

    What is proved: for every target trajectory in `tube.plan`, from e(0) = 0, under every
    disturbance (with what a learning error adds) of norm at most w_bar, which may change within a
    hold, and under u = u_d + K e(t_k) held for h (with `aperiodic` for any times from a millionth
    of h to h), |c'e(t)| <= tube.output_radius(c, t) at every time t. It is a statement on the exact
    motion.

    Args:
        system: The system.
        tube: The tube.
        most_seconds: Processor time after which each of N + 1 searches gives up [s].

    Raises:
        TypeError: The system is not that of the tube.
    """
    start = time.monotonic()
    definite = bool(np.all(negative_definite(exact(-tube.duals))))
    jumps = _falls_at_instants(tube)
    found: list[Search[Violation]] = []
    where = triples(tube.proof_box, system, "state")
    if definite and jumps and tube.contained:
        for dual, rest in zip(tube.duals, _rests(tube), strict=True):
            condition = BoxCondition(where, lifted_matrices(system, dual, rest))
            found.append(search(condition, _BATCH, _MOST_CELLS, most_seconds))
            if not found[-1].proved:
                break
    proved = len(found) == len(tube.duals) and found[-1].proved
    return HeldTubeProof(tube, tuple(found), jumps, proved, time.monotonic() - start)


def _falls_at_instants(tube: HeldTube) -> bool:
    """Show Q_0 > L W L' with L = (I; K) for every W of an instant.

    For holds of any length from `SHORTEST` h to h, W = sum_i b_i W_i with b_0 <= r (1 - b_0),
    r = 1 / `SHORTEST`. So Q_0 - L W L' is a convex combination, but for a factor, of the matrices
    D_i + c D_0 with D_i = Q_0 - L W_i L', i >= 1 and c from 0 to r, whose ends decide. D_0 alone is
    zero but for its last entry, and K is rounded: holds as short as one likes are out of reach.
    """
    joined = exact(np.concatenate([np.eye(tube.states), tube.gain]))

    def rises(index: int) -> Interval:
        block = exact(tube.duals[index, : tube.states, : tube.states])
        return matmul(matmul(joined, block), transpose(joined)) - exact(tube.duals[0])

    if not tube.design.aperiodic:
        return bool(negative_definite(rises(len(tube.duals) - 1)))
    first = rises(0) * (1.0 / SHORTEST)
    every = [rises(index) for index in range(1, len(tube.duals))]
    return all(negative_definite(one) and negative_definite(one + first) for one in every)


def _rests(tube: HeldTube) -> list[Interval]:
    """Enclose 2 alpha Q_i - (dQ/ds)_i + w_bar^2 / (2 alpha) E E', each (n + m, n + m)."""
    design = tube.design
    period, rate = exact(design.period), exact(design.rate)
    source = exact(design.disturbance_bound).square() / (rate * 2.0)
    pushed = np.diag(np.arange(tube.duals.shape[-1]) < tube.states).astype(np.float64)
    rests = []
    for index, row in enumerate(bernstein_rate(design.degree)):
        total = exact(tube.duals[index]) * (rate * 2.0) + source * pushed
        for place, weight in row.items():
            total = total - exact(tube.duals[place]) * weight / period
        rests.append(total)
    return rests
