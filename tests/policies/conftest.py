"""An oracle written from the equations, and a small metric, plans and weights, made once.

Nothing here needs the shipped metric or weights.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_policies.contraction import CvStemSettings, Samples, design_on_pool
from lagros_policies.learning.networks import Mlp
from lagros_policies.tasks.cartpole.planner import CartPolePlanner
from lagros_policies.tasks.cartpole.region import Region

ROOT = Path(__file__).resolve().parents[2]
PERIOD = 0.1


class Oracle:
    """The cart-pole of the paper and the terms of Theorem 2, by the plainest means there are."""

    gravity, cart, pole, mu_cart, mu_pole, half = 9.8, 1.0, 0.1, 0.5, 0.002, 0.5
    period = PERIOD

    def rates(self, state, control):
        """Return dx/dt for states (..., 4) and controls (..., 1), real or complex."""
        state, force = np.asarray(state), np.asarray(control)[..., 0]
        angle, speed, turn = state[..., 1], state[..., 2], state[..., 3]
        mass, moment = self.cart + self.pole, self.pole * self.half
        push = (-force - moment * turn**2 * np.sin(angle) + self.mu_cart * speed) / mass
        above = self.gravity * np.sin(angle) + np.cos(angle) * push - self.mu_pole * turn / moment
        spin = above / (self.half * (4.0 / 3.0 - self.pole * np.cos(angle) ** 2 / mass))
        swing = turn**2 * np.sin(angle) - spin * np.cos(angle)
        drive = (force + moment * swing - self.mu_cart * speed) / mass
        return np.stack(np.broadcast_arrays(speed, turn, drive, spin), axis=-1)

    def step(self, state, control, duration=PERIOD, substeps=4, disturbance=0.0):
        """Return the state after a hold of the control, by classical Runge-Kutta."""
        h = duration / substeps

        def slope(x):
            return self.rates(x, control) + disturbance

        for _ in range(substeps):
            k1 = slope(state)
            k2 = slope(state + h / 2 * k1)
            k3 = slope(state + h / 2 * k2)
            k4 = slope(state + h * k3)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return state

    def input_matrix(self, state):
        """Return B(x), shape (..., 4, 1): the rates are affine in the control."""
        difference = self.rates(state, np.ones(1)) - self.rates(state, np.zeros(1))
        return difference[..., None]

    def jacobian(self, function, point):
        """Differentiate a function of (..., k) by complex steps, exact to rounding."""
        columns = []
        for index in range(point.shape[-1]):
            moved = point.astype(complex)
            moved[..., index] += 1e-30j
            columns.append(function(moved).imag / 1e-30)
        return np.stack(columns, axis=-1)

    def sdc(self, state, nominal, control, intervals=200):
        """Return A by its definition: the mean Jacobian on the way from x_d to x (Simpson)."""
        share = np.linspace(0.0, 1.0, intervals + 1)[:, None]
        weight = np.ones(intervals + 1)
        weight[1:-1:2], weight[2:-1:2] = 4.0, 2.0
        points = share * state[..., None, :] + (1.0 - share) * nominal[..., None, :]
        slopes = self.jacobian(lambda x: self.rates(x, control[..., None, :]), points)
        return np.einsum("q,...qij->...ij", weight / weight.sum(), slopes)

    def energy(self, metric, state, nominal):
        """Return V = e'Me with M = W_bar^-1 by a linear solve."""
        error = state - nominal
        solved = np.linalg.solve(metric.dual(state), error[..., None])[..., 0]
        return np.sum(error * solved, axis=-1)

    def energy_rate(self, metric, state, nominal, nominal_control, control, h=1e-5):
        """Return dV/dt by moving x under u and x_d under u_d a little forwards and backwards."""

        def moved(time):
            return self.energy(
                metric,
                self.step(state, control, time, substeps=1),
                self.step(nominal, nominal_control, time, substeps=1),
            )

        return (moved(h) - moved(-h)) / (2 * h)


@pytest.fixture(scope="session")
def oracle():
    return Oracle()


@pytest.fixture(scope="session")
def system():
    return CartPole()


def fresh_plans(count, seed):
    """Return x_d (count, 91, 4) and u_d (count, 90, 1) of random episodes."""
    planner = CartPolePlanner()
    plans = []
    for index in range(count):
        rng = np.random.default_rng([seed, index])
        scenario = planner.task.sample(rng)
        plans.append(planner.plan(scenario.initial_state, scenario.goal))
    assert all(plan.solved for plan in plans)
    return np.stack([plan.states for plan in plans]), np.stack([plan.controls for plan in plans])


def draw_samples(region, plans, count, seed):
    """Return (x, x_d, u_d) around the plans: errors uniform in the box of the region."""
    rng = np.random.default_rng(seed)
    states, controls = plans
    kept, found = [], 0
    while found < count:
        plan = rng.integers(len(states), size=4 * count)
        step = rng.integers(controls.shape[1], size=4 * count)
        box = [1.0, region.angle_error, 2.0, region.angular_rate_error]
        nominal, control = states[plan, step], controls[plan, step]
        state = nominal + rng.uniform(-1.0, 1.0, nominal.shape) * box
        inside = region.contains(state, nominal, control)
        kept.append((state[inside], nominal[inside], control[inside]))
        found += int(inside.sum())
    return Samples(*(np.concatenate(part)[:count] for part in zip(*kept, strict=True)))


@pytest.fixture(scope="session")
def make_plans():
    return fresh_plans


@pytest.fixture(scope="session")
def make_samples():
    return draw_samples


@pytest.fixture(scope="session")
def region():
    return Region(angle=1.15, angular_rate=4.0, angle_error=0.2, angular_rate_error=1.0, force=40.0)


@pytest.fixture(scope="session")
def plans():
    return fresh_plans(12, seed=0)


@pytest.fixture(scope="session")
def pool(region, plans):
    """Return 2000 triples; the metrics below satisfy the condition at each of them."""
    return draw_samples(region, plans, 2000, seed=1)


@pytest.fixture(scope="session")
def samples(pool):
    return pool.take(np.arange(200))


@pytest.fixture(scope="session")
def metric(system, region, pool):
    """Return a metric that depends on the angle, designed in scaled states."""
    settings = CvStemSettings(0.5, 2, 0.1, margin=0.1, scaling=(1.0, 3.0, 1.0, 1.5))
    return design_on_pool(system, pool, region, settings)


@pytest.fixture(scope="session")
def constant_metric(system, region, pool):
    settings = CvStemSettings(0.5, 0, 0.1, margin=0.1, scaling=(1.0, 1.0, 1.0, 1.0))
    return design_on_pool(system, pool, region, settings)


@pytest.fixture(scope="session")
def network():
    """Return a network of the cart-pole's shape with random weights."""
    rng = np.random.default_rng(5)
    shapes = [(7, 20), (20, 20), (20, 1)]
    weights = [rng.standard_normal(shape) / np.sqrt(shape[0]) for shape in shapes]
    return Mlp(weights, [rng.standard_normal(shape[1]) for shape in shapes])


@pytest.fixture(scope="session")
def weights_file(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "network.safetensors"
    network.save(path)
    return path


@pytest.fixture(scope="session")
def run_python():
    """Run a script in a fresh interpreter and return what it prints."""

    def run(script, *arguments):
        finished = subprocess.run(
            [sys.executable, "-W", "error", "-c", script, *map(str, arguments)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert finished.returncode == 0, finished.stderr
        return finished.stdout

    return run
