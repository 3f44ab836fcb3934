"""Systems that are no cart-pole, and what the theory says of them by brute force.

Jacobians by complex steps, means by Simpson's rule, rates of a metric by moving the state along the
flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_policies.contraction import Samples


@dataclass(frozen=True)
class Ramp:
    """Two states; its reach depends on the one that is no angle."""

    state_dim = 2
    control_dim = 1

    def derivative(self, state, control, functions):
        first, second = state
        sine = functions.sin(first)
        return second, (1.0 + 50.0 * sine * sine) * control[0] - second


@dataclass(frozen=True)
class Unicycle:
    """Three states [x, y, heading] and two controls, which turn and push it."""

    state_dim = 3
    control_dim = 2

    def derivative(self, state, control, functions):
        heading = state[2]
        speed = 1.0 + control[0]
        return speed * functions.cos(heading), speed * functions.sin(heading), control[1]


@dataclass(frozen=True)
class Pvtol:
    """Six states [x, z, roll, v_x, v_z, spin] in the body's axes, and two rotors."""

    state_dim = 6
    control_dim = 2

    def derivative(self, state, control, functions):
        _, _, roll, ahead, up, spin = state
        sine, cosine = functions.sin(roll), functions.cos(roll)
        return (
            ahead * cosine - up * sine,
            ahead * sine + up * cosine,
            spin,
            up * spin - 9.8 * sine,
            -9.8 * cosine - ahead * spin + (control[0] + control[1]) / 0.5,
            (control[0] - control[1]) * 10.0,
        )


@dataclass(frozen=True, slots=True)
class Reordered(CartPole):
    """The cart-pole as [theta, dtheta/dt, p, dp/dt], derived from the class."""

    def derivative(self, state, control, functions):
        angle, turn, place, speed = state
        rates = CartPole.derivative(self, (place, angle, speed, turn), control, functions)
        return rates[1], rates[3], rates[0], rates[2]


@dataclass(frozen=True, slots=True)
class Swapped(CartPole):
    """The cart-pole as [theta, p, dtheta/dt, dp/dt]: state 1 moves at the rate of state 3."""

    def derivative(self, state, control, functions):
        angle, place, turn, speed = state
        rates = CartPole.derivative(self, (place, angle, speed, turn), control, functions)
        return rates[1], rates[0], rates[3], rates[2]


@dataclass(frozen=True)
class Car:
    """Four states [x, y, heading, speed]; the controls move what its motion depends on."""

    state_dim = 4
    control_dim = 2

    def derivative(self, state, control, functions):
        _, _, heading, speed = state
        return (
            speed * functions.cos(heading),
            speed * functions.sin(heading),
            control[0],
            control[1],
        )


@dataclass(frozen=True)
class Triple:
    """Four states and three controls, whose reach depends on the state."""

    state_dim = 4
    control_dim = 3

    def derivative(self, state, control, functions):
        first, second, third, angle = state
        sine, cosine = functions.sin(angle), functions.cos(angle)
        return (
            second * cosine - first + control[0] * cosine,
            third + 0.5 * first * second + control[0] * sine + control[1],
            sine + 0.3 * third + control[2] * (2.0 + cosine),
            first - 2.0 * angle,
        )


# Brute force.


def moved(system, state, control):
    """Return dx/dt, real or complex."""
    parts = [state[..., i] for i in range(system.state_dim)]
    inputs = [control[..., i] for i in range(system.control_dim)]
    return np.stack(np.broadcast_arrays(*system.derivative(parts, inputs, np)), axis=-1)


def slopes(system, state, control):
    """Return the Jacobian by the state, by complex steps."""
    columns = []
    for index in range(system.state_dim):
        there = state.astype(complex)
        there[..., index] += 1e-30j
        columns.append(moved(system, there, control).imag / 1e-30)
    return np.stack(columns, axis=-1)


def reach(system, state):
    zero = np.zeros((*state.shape[:-1], system.control_dim))
    still = moved(system, state, zero)
    columns = [moved(system, state, zero + unit) - still for unit in np.eye(system.control_dim)]
    return np.stack(columns, axis=-1)


def brute_left(system, metric, samples, share=1.0):
    """Return Theorem 2's left side by Simpson's rule and by moving along the flow."""
    weight = np.ones(401)
    weight[1:-1:2], weight[2:-1:2] = 4.0, 2.0
    way = np.linspace(0.0, 1.0, 401)[:, None]
    points = way * samples.state[:, None] + (1.0 - way) * samples.nominal[:, None]
    slope = slopes(system, points, samples.nominal_control[:, None])
    slope = np.einsum("q,sqij->sij", weight / weight.sum(), slope)
    h, place = 1e-6, where(metric, samples)
    flow = moved(system, place, samples.nominal_control)
    change = metric.dual(place + h * flow) - metric.dual(place - h * flow)
    dual, gain = metric.dual(place), reach(system, samples.state)
    product = slope @ dual
    left = product + np.swapaxes(product, 1, 2) - change / (2.0 * h)
    left += 2.0 * metric.contraction_rate * dual
    return left - 2.0 * share * metric.control_weight * gain @ np.swapaxes(gain, 1, 2)


def where(metric, samples):
    return samples.nominal if getattr(metric, "point", "state") == "nominal" else samples.state


def brute_residual(system, metric, samples):
    lefts, duals = brute_left(system, metric, samples), metric.dual(where(metric, samples))
    return np.array(
        [scipy.linalg.eigh(a, b, eigvals_only=True)[-1] for a, b in zip(lefts, duals, strict=True)]
    )


def drawn(system, count=50, seed=0):
    rng = np.random.default_rng(seed)
    nominal = rng.uniform(-0.4, 0.4, (count, system.state_dim))
    error = rng.uniform(-0.3, 0.3, nominal.shape)
    return Samples(nominal + error, nominal, rng.uniform(-1.0, 1.0, (count, system.control_dim)))


def positive(n, seed=0):
    root = np.random.default_rng(seed).standard_normal((n, n))
    return root @ root.T + n * np.eye(n)
