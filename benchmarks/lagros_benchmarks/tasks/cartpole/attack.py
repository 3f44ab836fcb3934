"""What an attack on the cart-pole says besides."""

from __future__ import annotations

import numpy as np

from lagros_benchmarks.worst_case.flights import Flights
from lagros_benchmarks.worst_case.single import SingleBench


class CartPoleBench(SingleBench):
    """See `SingleBench`."""

    def measures(self, flight: Flights) -> dict[str, float]:
        """Return the largest angle [rad] of a single flight."""
        return {"largest_angle": float(np.abs(flight.states[0, :, 1][flight.alive[0]]).max())}
