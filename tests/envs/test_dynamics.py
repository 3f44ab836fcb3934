"""The equation of motion against mechanics, and what is derived from it against the equation."""

import math

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import sympy as sp
from hypothesis import given
from hypothesis import strategies as st

from lagros_envs.dynamics import (
    control_matrix,
    hold_step,
    jacobian,
    linearise_hold,
    state_dependent_coefficient,
    vector_field,
)
from lagros_envs.dynamics.integrate import SUBSTEPS, rk4_hold
from lagros_envs.numbers import dual, functions
from lagros_envs.tasks.cartpole.physics import CartPole

PERIOD = 0.1
# Not the defaults, and all different, so that no two parameters can be mistaken for each other.
ODD = CartPole(
    gravity=9.1,
    cart_mass=1.7,
    pole_mass=0.43,
    cart_friction=0.61,
    pole_friction=0.037,
    half_length=0.83,
)
SYSTEMS = [pytest.param(CartPole(), id="default"), pytest.param(ODD, id="odd")]

angles = st.floats(-1.5, 1.5)
rates = st.floats(-4.0, 4.0)
states = st.tuples(st.floats(-10.0, 10.0), angles, rates, rates).map(np.array)
controls = st.floats(-60.0, 60.0).map(lambda force: np.array([force]))


def random_states(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (count, 4)) * [10.0, 1.5, 4.0, 4.0]


def random_controls(count, seed=1):
    return np.random.default_rng(seed).uniform(-60.0, 60.0, (count, 1))


class Mechanics:
    """Lagrange's equations of a cart and a uniform rod, derived from energies alone."""

    def __init__(self):
        time = sp.Symbol("t")
        self.constants = sp.symbols("g m_c m mu_c mu_p l", positive=True)
        gravity, cart_mass, pole_mass, cart_friction, pole_friction, half = self.constants
        self.state = sp.symbols("p theta v w")
        self.force = sp.Symbol("u")
        path = [sp.Function(name)(time) for name in ("p", "theta")]
        velocity = [coordinate.diff(time) for coordinate in path]

        # The rod's middle, from the geometry; its moment of inertia about that, m (2 l)^2 / 12.
        middle = [path[0] + half * sp.sin(path[1]), half * sp.cos(path[1])]
        inertia = pole_mass * (2 * half) ** 2 / 12
        kinetic = (
            cart_mass * velocity[0] ** 2
            + pole_mass * sum(coordinate.diff(time) ** 2 for coordinate in middle)
            + inertia * velocity[1] ** 2
        ) / 2
        lagrangian = kinetic - pole_mass * gravity * middle[1]
        # The force acts on the cart; friction of the cart on the rail and of the hinge is viscous.
        generalised = [
            self.force - cart_friction * velocity[0],
            -pole_friction * velocity[1],
        ]

        # Symbols for the accelerations, then for velocities, then for coordinates.
        rates = sp.symbols("a b")
        plain = [
            *zip([speed.diff(time) for speed in velocity], rates, strict=True),
            *zip(velocity, self.state[2:], strict=True),
            *zip(path, self.state[:2], strict=True),
        ]
        equations = [
            (lagrangian.diff(speed).diff(time) - lagrangian.diff(coordinate) - push).subs(plain)
            for coordinate, speed, push in zip(path, velocity, generalised, strict=True)
        ]
        solution = sp.solve(equations, rates, dict=True)[0]
        self.rates = sp.Matrix([*self.state[2:], *(solution[rate] for rate in rates)])

    def function(self, system, expression):
        values = (
            system.gravity,
            system.cart_mass,
            system.pole_mass,
            system.cart_friction,
            system.pole_friction,
            system.half_length,
        )
        known = expression.subs(dict(zip(self.constants, values, strict=True)))
        function = sp.lambdify((*self.state, self.force), known, "numpy")
        return lambda state, control: np.array(function(*state, *control), dtype=float)

    def energy_function(self, system):
        """Kinetic and potential energy of the rod, by integration of its mass elements."""
        nodes, weights = np.polynomial.legendre.leggauss(5)
        along = system.half_length * (nodes + 1.0)
        mass = system.pole_mass * weights / 2.0

        def energy(state):
            _, angle, velocity, rate = state
            across = velocity + along * rate * math.cos(angle)
            up = -along * rate * math.sin(angle)
            kinetic = 0.5 * np.sum(mass * (across**2 + up**2))
            potential = np.sum(mass * system.gravity * along * math.cos(angle))
            return 0.5 * system.cart_mass * velocity**2 + kinetic + potential

        return energy


@pytest.fixture(scope="module")
def mechanics():
    return Mechanics()


@pytest.mark.parametrize("system", SYSTEMS)
def test_accelerations_are_those_of_lagrange(mechanics, system):
    expected = mechanics.function(system, mechanics.rates)
    for state, control in zip(random_states(200), random_controls(200), strict=True):
        rates = vector_field(system, state, control)
        np.testing.assert_allclose(rates, expected(state, control)[:, 0], rtol=1e-11, atol=1e-11)


def test_without_friction_the_energy_of_the_rod_changes_by_the_work_of_the_force(mechanics):
    system = CartPole(cart_friction=0.0, pole_friction=0.0)
    energy = mechanics.energy_function(system)
    start = state = np.array([0.0, 0.7, -0.3, 0.5])
    force = 3.0
    for _ in range(20):
        state = hold_step(system, state, np.array([force]), PERIOD, substeps=64)
        # A constant force does the work force times way.
        work = force * (state[0] - start[0])
        assert energy(state) - energy(start) == pytest.approx(work, abs=1e-6)


@pytest.mark.parametrize("system", SYSTEMS)
def test_upright_at_rest_is_an_equilibrium_wherever_the_cart_stands(system):
    state = np.array([3.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(vector_field(system, state, np.zeros(1)), np.zeros(4))


def test_mirrored_state_and_force_give_mirrored_rates():
    state, control = random_states(50), random_controls(50)
    mirrored = vector_field(ODD, -state, -control)
    np.testing.assert_allclose(mirrored, -vector_field(ODD, state, control), rtol=1e-14)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("pole_mass", 0.0, "pole_mass=0.0 must be finite and > 0"),
        ("half_length", -0.5, "half_length=-0.5"),
        ("gravity", math.inf, "gravity=inf"),
        ("cart_friction", -1e-9, "cart_friction=-1e-09 must be finite and >= 0"),
        ("pole_friction", math.nan, "pole_friction=nan"),
    ],
)
def test_parameters_that_are_not_physical_are_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        CartPole(**{field: value})


@pytest.mark.parametrize("system", SYSTEMS)
def test_jacobians_are_those_of_the_lagrangian_mechanics(mechanics, system):
    by_state = mechanics.function(system, mechanics.rates.jacobian(mechanics.state))
    by_force = mechanics.function(system, mechanics.rates.diff(mechanics.force))
    state, control = random_states(60), random_controls(60)
    slopes, matrix = jacobian(system, state, control)
    assert slopes.shape == (60, 4, 4)
    assert matrix.shape == (60, 4, 1)
    for index in range(60):
        expected = by_state(state[index], control[index])
        np.testing.assert_allclose(slopes[index], expected, rtol=1e-10, atol=1e-10)
        expected = by_force(state[index], control[index])
        np.testing.assert_allclose(matrix[index], expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(control_matrix(system, state), matrix)


def test_jacobian_broadcasts_one_control_over_many_states():
    state, control = random_states(6).reshape(2, 3, 4), np.array([7.0])
    slopes, matrix = jacobian(CartPole(), state, control)
    assert slopes.shape == (2, 3, 4, 4)
    assert matrix.shape == (2, 3, 4, 1)
    alone, _ = jacobian(CartPole(), state[1, 2], control)
    np.testing.assert_allclose(slopes[1, 2], alone, rtol=1e-14)


def test_linearised_hold_agrees_with_central_differences_of_the_step():
    state, control = random_states(20), random_controls(20)
    following, by_state, by_control = linearise_hold(ODD, state, control, PERIOD)
    np.testing.assert_allclose(following, hold_step(ODD, state, control, PERIOD), rtol=1e-14)
    width = 1e-5
    for column in range(4):
        shift = width * np.eye(4)[column]
        ahead = hold_step(ODD, state + shift, control, PERIOD)
        behind = hold_step(ODD, state - shift, control, PERIOD)
        expected = (ahead - behind) / (2.0 * width)
        np.testing.assert_allclose(by_state[..., column], expected, rtol=1e-6, atol=1e-7)
    ahead = hold_step(ODD, state, control + width, PERIOD)
    behind = hold_step(ODD, state, control - width, PERIOD)
    expected = (ahead - behind) / (2.0 * width)
    np.testing.assert_allclose(by_control[..., 0], expected, rtol=1e-6, atol=1e-7)


@given(states, states, controls)
def test_sdc_matrix_carries_the_difference_of_the_vector_fields(state, nominal, control):
    system = CartPole()
    matrix = state_dependent_coefficient(system, state, nominal, control)
    difference = vector_field(system, state, control) - vector_field(system, nominal, control)
    np.testing.assert_allclose(matrix @ (state - nominal), difference, rtol=0.0, atol=1e-9)


def test_sdc_matrix_of_two_equal_states_is_the_jacobian():
    state, control = random_states(10), random_controls(10)
    matrix = state_dependent_coefficient(ODD, state, state, control)
    np.testing.assert_allclose(matrix, jacobian(ODD, state, control)[0], rtol=1e-12, atol=1e-12)


@given(states, controls)
def test_floats_arrays_and_duals_give_the_same_rates(state, control):
    system = ODD
    floats = system.derivative(tuple(state.tolist()), tuple(control.tolist()), math)
    assert all(isinstance(rate, float) for rate in floats)
    batch = vector_field(system, np.stack([state, -state]), np.stack([control, control]))
    duals = system.derivative(dual.seed(list(state[:, None])), list(control[:, None]), functions)
    np.testing.assert_allclose(batch[0], floats, rtol=1e-13, atol=1e-13)
    values = [rate.value[0] for rate in duals]
    np.testing.assert_allclose(values, floats, rtol=1e-13, atol=1e-13)


@given(
    st.floats(-3.0, 3.0), st.floats(0.5, 3.0), st.sampled_from(["+", "-", "*", "/", "sin", "cos"])
)
def test_duals_obey_the_rules_of_calculus(first, second, operation):
    """Derivatives by both operands, in every mix of duals and constants."""
    x, y = sp.symbols("x y")
    operations = {
        "+": lambda a, b, f: a + b,
        "-": lambda a, b, f: a - b,
        "*": lambda a, b, f: a * b,
        "/": lambda a, b, f: a / b,
        "sin": lambda a, b, f: f.sin(a) * b,
        "cos": lambda a, b, f: -f.cos(a) / b,
    }
    compute = operations[operation]
    point = {x: first, y: second}
    expected = [float(compute(x, y, sp).diff(symbol).subs(point)) for symbol in (x, y)]
    one, two = dual.seed([np.array([first]), np.array([second])])
    result = compute(one, two, functions)
    np.testing.assert_allclose(result.gradient[:, 0], expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(result.value[0], float(compute(x, y, sp).subs(point)), rtol=1e-13)
    left = compute(one, second, functions)
    np.testing.assert_allclose(left.gradient[:, 0], [expected[0], 0.0], rtol=1e-13, atol=1e-13)
    if operation in "+-*/":
        right = compute(np.array([first]), two, functions)
        np.testing.assert_allclose(right.gradient[:, 0], [0.0, expected[1]], rtol=1e-13, atol=1e-13)


def test_step_of_floats_and_step_of_a_batch_agree():
    system, push = CartPole(), np.random.default_rng(2).uniform(-0.75, 0.75, (40, 4))
    state, control = random_states(40), random_controls(40)
    batch = hold_step(system, state, control, PERIOD, push)
    for index in range(40):
        parts = (state[index].tolist(), control[index].tolist(), push[index].tolist())
        single = rk4_hold(system, *parts, PERIOD, math)
        np.testing.assert_allclose(single, batch[index], rtol=1e-12, atol=1e-12)


def test_step_agrees_with_an_adaptive_integrator():
    system, push = CartPole(), np.array([0.2, -0.1, 0.3, 0.4])
    state, control = random_states(20) * [1.0, 0.6, 0.5, 0.5], random_controls(20) / 3.0
    reached = hold_step(system, state, control, PERIOD, push)
    for index in range(20):
        solution = scipy.integrate.solve_ivp(
            lambda _, x, u: vector_field(system, x, u) + push,
            (0.0, PERIOD),
            state[index],
            method="DOP853",
            rtol=1e-12,
            atol=1e-12,
            args=(control[index],),
        )
        np.testing.assert_allclose(reached[index], solution.y[:, -1], rtol=0.0, atol=2e-5)


def test_runge_kutta_is_of_fourth_order():
    system, state, control = CartPole(), np.array([0.0, 0.4, 0.5, -1.0]), np.array([10.0])
    exact = hold_step(system, state, control, 0.4, substeps=512)
    errors = [
        np.max(np.abs(hold_step(system, state, control, 0.4, substeps=count) - exact))
        for count in (4, 8, 16)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 4.0, atol=0.4)


def test_a_disturbance_is_added_to_every_rate():
    # Over a very short step x moves by (f + B u + d) h, whatever channel d is in.
    system, state, control = ODD, np.array([1.0, 0.3, -0.5, 0.8]), np.array([4.0])
    for channel in range(4):
        push = 0.6 * np.eye(4)[channel]
        moved = (hold_step(system, state, control, 1e-6, push) - state) / 1e-6
        expected = vector_field(system, state, control) + push
        np.testing.assert_allclose(moved, expected, rtol=1e-4, atol=1e-4)


def test_halving_the_substep_moves_no_controlled_trajectory_by_one_part_in_ten_thousand():
    """Over 9 s, for starts and goals of the task, with a discrete LQR in the loop.

    Without feedback the fall would blow any difference up; with it, the roll-out of each substep
    closes its own loop, and what is left is what the integrator is answerable for. Forces reach
    25 N and angles 60 degrees, like those of least-effort plans.
    """
    system, worlds, steps = CartPole(), 300, 90
    _, slope, entry = linearise_hold(system, np.zeros(4), np.zeros(1), PERIOD, substeps=64)
    weight, cost = np.diag([0.1, 1.0, 0.1, 0.1]), np.eye(1)
    riccati = scipy.linalg.solve_discrete_are(slope, entry, weight, cost)
    gain = np.linalg.solve(entry.T @ riccati @ entry + cost, entry.T @ riccati @ slope)

    rng = np.random.default_rng(0)
    start, goal = np.zeros((worlds, 4)), np.zeros((worlds, 4))
    start[:, 1] = rng.uniform(-math.pi / 3, math.pi / 3, worlds)
    goal[:, 0] = rng.uniform(-5.0, 5.0, worlds)
    pushes = 0.35 * rng.uniform(-1.0, 1.0, (steps, worlds, 4))
    coarse = fine = start
    largest = 0.0
    for push in pushes:
        stepped = []
        for state, substeps in ((coarse, SUBSTEPS), (fine, 2 * SUBSTEPS)):
            error = state - goal
            error[:, 0] = np.clip(error[:, 0], -3.0, 3.0)
            force = -(error @ gain.T)
            stepped.append(hold_step(system, state, force, PERIOD, push, substeps))
        coarse, fine = stepped
        largest = max(largest, np.max(np.abs(coarse - fine)))
    assert np.all(np.abs(fine[:, 1]) < 0.5), "the loop must hold every pole"
    assert 1e-8 < largest <= 1e-4
