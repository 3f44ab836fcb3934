"""CV-STEM, the program of a contraction metric, written in CVXPY, to read and to change.

`lagros_policies.contraction` hands the same matrices to Clarabel directly, several times as fast,
and adds samples and bounds where they are broken. Here the program can be read line by line and be
given another objective or constraint; it designs a metric of a car, which is then proved on a whole
box. Needs `pip install 'lagros[train]'`.

    python examples/metric_in_cvxpy.py
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cvxpy
import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics import (
    System,
    control_matrix,
    state_dependent_coefficient,
    vector_field,
)
from lagros_policies.contraction import Basis, BoxRegion, Metric, Samples
from lagros_policies.proof.condition import prove

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Car:
    """[x, y, theta, v] under turn rate [rad/s] and acceleration [m/s^2]."""

    state_dim: int = 4
    control_dim: int = 2

    def derivative(self, state: Any, control: Any, functions: Any) -> Any:
        """Return dx/dt."""
        _, _, heading, speed = state
        return speed * functions.cos(heading), speed * functions.sin(heading), *control


def cvstem(
    system: System, samples: Samples, basis: Basis, rate: float, penalty: float, places: FloatArray
) -> tuple[cvxpy.Problem, list[Any], Any, Any]:
    """State Theorem 2, equations (14)-(16): W = sum_i W_i phi_i(x) with the least tube.

    Args:
        system: The system.
        samples: Where (14) is imposed.
        basis: The phi_i, functions of x that no control moves.
        rate: alpha [1/s].
        penalty: lambda, the weight of nu.
        places: Where I <= W <= chi I is imposed, shape (p, n).

    Returns:
        The program, and its variables W_i, nu and chi.
    """
    n = system.state_dim
    state, control = samples.state, samples.nominal_control
    slopes = state_dependent_coefficient(system, state, samples.nominal, control)
    gains, motion = control_matrix(system, state), vector_field(system, state, control)
    parts = [cvxpy.Variable((n, n), symmetric=True) for _ in range(basis.size)]
    nu, chi = cvxpy.Variable(), cvxpy.Variable()

    def combined(values: FloatArray) -> Any:
        return sum(value * part for value, part in zip(values, parts, strict=True))

    constraints = []
    values, rates = basis.at(state), basis.rate(state, motion)
    for a, b, value, change in zip(slopes, gains, values, rates, strict=True):
        w = combined(value)
        left = a @ w + w @ a.T - combined(change) + 2.0 * rate * w
        constraints.append(left - 2.0 * nu * (b @ b.T) << 0)
    for value in basis.at(places):
        w = combined(value)
        constraints += [w >> np.eye(n), w << chi * np.eye(n)]
    return cvxpy.Problem(cvxpy.Minimize(chi + penalty * nu), constraints), parts, nu, chi


def main() -> None:
    """Design a metric of the car, prove it and say what was proved."""
    inf, half = np.inf, (-1.0, -1.0)
    box = BoxRegion(
        (-inf, -inf, -0.6, 1.0), (inf, inf, 0.6, 2.0), (inf, inf, 1.2, 1.0), half, (1.0, 1.0)
    )
    # A larger box and a margin of 0.1 1/s make up for what lies between the samples.
    samples = box.scaled(1.2).sample(np.random.default_rng(0), 200)
    program, parts, nu, chi = cvstem(Car(), samples, Basis(("1",)), 0.4, 0.1, np.zeros((1, 4)))
    program.solve(solver="CLARABEL")
    coefficients = np.stack([0.5 * (part.value + part.value.T) for part in parts])
    metric = Metric(coefficients, 0.3, float(chi.value), float(nu.value), np.ones(4), box)
    for line in prove(Car(), metric, box, period=0.1).statements:
        print(f"{line.verdict}: {line.text}")


if __name__ == "__main__":
    main()
