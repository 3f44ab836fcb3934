"""What an attack on the cart-pole says besides, and its bound of the control's gain."""

from __future__ import annotations

import numpy as np

from lagros_benchmarks.worst_case.certificate import TubeCheck
from lagros_benchmarks.worst_case.flights import Flights
from lagros_benchmarks.worst_case.single import SingleBench
from lagros_envs.dynamics import control_matrix
from lagros_policies.contraction.metric import even_region
from lagros_policies.tasks.cartpole.expert import CartPoleExpert


class CartPoleBench(SingleBench):
    """See `SingleBench`."""

    def check_of(self) -> TubeCheck:
        """Return the tube of Theorem 1 around the plans."""
        gain = largest_gain(self.expert)
        return TubeCheck(self.expert, self.episodes, self.settings.bound, gain)

    def measures(self, flight: Flights) -> dict[str, float]:
        """Return the largest angle [rad] of a single flight."""
        return {"largest_angle": float(np.abs(flight.states[0, :, 1][flight.alive[0]]).max())}


def largest_gain(expert: CartPoleExpert, points: int = 1001) -> float:
    """Return b_bar, the largest ||B(x)|| over a grid of the region's angles (observed)."""
    states = np.zeros((points, 4))
    states[:, 1] = np.linspace(0.0, even_region(expert.metric)[1], points)
    matrices = control_matrix(expert.task.system, states)
    return float(np.linalg.norm(matrices, axis=(1, 2)).max())
