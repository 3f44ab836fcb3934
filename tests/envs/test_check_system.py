"""`check_system` accepts what works everywhere and says in the author's words what does not."""

import math
import random

import numpy as np
import pytest

from lagros_envs.dynamics import check_system
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.spacecraft.physics import Spacecraft


class Pendulum:
    state_dim, control_dim = 2, 1
    state_names, control_names = ("angle", "rate"), ("torque",)

    def derivative(self, state, control, functions):
        angle, rate = state
        (torque,) = control
        return rate, torque - 9.8 * functions.sin(angle) - 0.1 * rate**3


class Plane(Pendulum):
    """Three controls and no angle."""

    state_dim, control_dim = 3, 3
    state_names = control_names = ("x", "y", "z")

    def derivative(self, state, control, functions):
        return [u - 0.2 * abs(x + 5.0) + functions.exp(-x) for x, u in zip(state, control)]  # noqa: B905


@pytest.mark.parametrize("system", [CartPole(), Spacecraft(), Pendulum(), Plane()])
def test_what_works_on_every_kind_of_number_passes(system):
    check_system(system)


def test_a_drag_that_bends_at_rest_is_no_fault():
    """|v| v has no second derivative at rest: it flies and plans, and no proof reaches over it."""

    def drag(self, x, u, f):
        return x[1], u[0] - 0.3 * abs(x[1]) * x[1]

    system = type("Boat", (Pendulum,), {"derivative": drag})()
    rest = np.array([[0.5, 0.0], [0.1, 0.3]])
    check_system(system, rest, np.ones((2, 1)))


def faulty(derivative, **attributes):
    return type("Mine", (Pendulum,), {"derivative": derivative, **attributes})()


def counting():
    calls = iter(range(10**6))
    return lambda self, x, u, f: (x[1], u[0] + next(calls))


FAULTS = {
    "dimension": (faulty(Pendulum.derivative, state_dim=2.0), "state_dim=2.0 must be a whole"),
    "no control": (faulty(Pendulum.derivative, control_dim=0), "control_dim=0"),
    "no derivative": (faulty(None), "has no derivative"),
    "names": (faulty(Pendulum.derivative, state_names=("a", "a")), "2 different names"),
    "one name": (faulty(Pendulum.derivative, control_names="torque"), "sequence of 1 names"),
    "too few rates": (faulty(lambda self, x, u, f: (x[1],)), "returns 1 rates.*must return 2"),
    "no rates": (faulty(lambda self, x, u, f: 1.0), "no sequence"),
    "unpacking": (
        faulty(lambda self, x, u, f: (lambda a, b, c: (a, b))(*x)),
        "fails on floats",
    ),
    "out of range": (faulty(lambda self, x, u, f: (x[2], u[0])), "Check how many states"),
    "own mathematics": (
        faulty(lambda self, x, u, f: (x[1], u[0] - math.sin(x[0]))),
        "fails on arrays.*neither math nor numpy",
    ),
    "own numpy": (
        faulty(lambda self, x, u, f: (x[1], u[0] - np.sin(x[0]))),
        "fails on dual numbers.*neither math nor numpy",
    ),
    "branch": (
        faulty(lambda self, x, u, f: (x[1], u[0] if x[0] > 0 else -x[0])),
        "must not compare or branch",
    ),
    "root as power": (
        faulty(lambda self, x, u, f: (x[1], u[0] + (2.0 + x[0]) ** 0.5)),
        "functions.sqrt",
    ),
    "unknown function": (
        faulty(lambda self, x, u, f: (x[1], u[0] - f.arctan(x[0]))),
        "there are sin, cos, tan, exp and sqrt",
    ),
    "not finite": (
        faulty(lambda self, x, u, f: (x[1], u[0] + x[0] * math.inf)),
        "as rate 1 at state=",
    ),
    "not affine": (faulty(lambda self, x, u, f: (x[1], u[0] * u[0])), "not affine in the control"),
    "not affine by sine": (
        faulty(lambda self, x, u, f: (x[1], f.sin(u[0]))),
        "not affine in the control: rate 1",
    ),
    "random": (
        faulty(lambda self, x, u, f: (x[1], u[0] + random.random())),
        "two answers",
    ),
    "memory": (faulty(counting()), "two answers"),
    "changes its state": (
        faulty(lambda self, x, u, f: (x.reverse(), u[0]) and (x[0], u[0])),
        "changes the state",
    ),
    "value taken out": (
        faulty(lambda self, x, u, f: (x[1], u[0] + getattr(x[0], "value", x[0]) * 1.0)),
        "wrong derivative: rate 1",
    ),
    "text": (faulty(lambda self, x, u, f: (x[1], "fast")), "each rate must be one number"),
    "sum over a batch": (
        faulty(lambda self, x, u, f: (np.sum(x[1]) * 1.0, u[0])),
        "as rate 0 on arrays",
    ),
}


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_each_fault_is_named(name):
    system, message = FAULTS[name]
    with pytest.raises((TypeError, ValueError), match=f"(?s){message}"):
        check_system(system)


def test_states_of_a_wrong_shape_are_refused():
    with pytest.raises(ValueError, match=r"must be \(k, 2\) and \(k, 1\)"):
        check_system(Pendulum(), np.zeros((3, 4)))
