"""The Segway: Lagrange's equations by another way, the published coefficients, its episodes."""

import gymnasium as gym
import numpy as np
import pytest

from lagros_envs.dynamics import check_system, vector_field
from lagros_envs.tasks.segway.physics import Segway
from lagros_envs.tasks.segway.task import SegwaySettings

# Of C3M's Segway: the coefficient, and the digits after its point that are printed.
PRINTED = {
    "g": 9.8,
    "cos v in dv": 11.5,
    "v in dv": 68.4,
    "omega^2 in dv": 1.2,
    "determinant": 24.7,
    "cos u in dv": 1.8,
    "u in dv": 10.9,
    "cos v in domega": 58.8,
    "v in domega": 243.5,
    "gravity in domega": 208.3,
    "cos u in domega": 9.3,
    "u in domega": 38.6,
}


def published(state, voltage):
    """The accelerations that C3M's code gives (sundw2014/C3M, systems/system_SEGWAY.py)."""
    _, lean, speed, rate = state.T
    sine, cosine = np.sin(lean), np.cos(lean)
    along = cosine * (9.8 * sine + 11.5 * speed) + 68.4 * speed - 1.2 * rate**2 * sine
    turn = -58.8 * speed * cosine - 243.5 * speed - sine * (208.3 + rate**2 * cosine)
    along += (-1.8 * cosine - 10.9) * voltage
    turn += (9.3 * cosine + 38.6) * voltage
    return along / (cosine - 24.7), turn / (cosine**2 - 24.7)


def drawn(count=200, seed=0):
    wide = np.array([5.0, np.pi / 3, 1.0, np.pi])
    return np.random.default_rng(seed).uniform(-wide, wide, (count, 4))


def momentum_defect(moving_mass, state, accelerations):
    """d/dt of (a/b) v + cos(theta) omega, which no force is to change: none acts on the base."""
    along, turn = accelerations
    sine, cosine = np.sin(state[:, 1]), np.cos(state[:, 1])
    return moving_mass * along + cosine * turn - sine * state[:, 3] ** 2


def test_accelerations_solve_the_equations_of_lagrange():
    body, state = Segway(), drawn()
    voltage = np.random.default_rng(1).uniform(-20.0, 20.0, (len(state), 1))
    rates = vector_field(body, state, voltage)
    np.testing.assert_array_equal(rates[:, :2], state[:, 2:])
    _, lean, speed, rate = state.T
    for row, accelerations in enumerate(rates[:, 2:]):
        mass = np.array(
            [[body.moving_mass, np.cos(lean[row])], [np.cos(lean[row]), body.leaning_inertia]]
        )
        wheel = speed[row] - body.wheel_radius * rate[row]
        push = body.motor * voltage[row, 0] - body.drag * wheel
        forces = [
            rate[row] ** 2 * np.sin(lean[row]) + push,
            body.gravity * np.sin(lean[row]) - body.wheel_radius * push,
        ]
        np.testing.assert_allclose(accelerations, np.linalg.solve(mass, forces), rtol=1e-10)


def test_the_published_coefficients_are_those_of_one_body_to_the_printed_digits():
    body = Segway()
    a, c, r = body.moving_mass, body.leaning_inertia, body.wheel_radius
    ours = {
        "g": body.gravity,
        "cos v in dv": r * body.drag,
        "v in dv": c * body.drag,
        "omega^2 in dv": c,
        "determinant": a * c,
        "cos u in dv": r * body.motor,
        "u in dv": c * body.motor,
        "cos v in domega": body.drag,
        "v in domega": a * r * body.drag,
        "gravity in domega": a * body.gravity,
        "cos u in domega": body.motor,
        "u in domega": a * r * body.motor,
    }
    assert {name: round(value, 1) for name, value in ours.items()} == PRINTED


def test_motion_at_rest_is_the_published_one_but_for_rounding():
    """Without rates nothing is left of what is wrong but the square that is missing, 1 %."""
    state = drawn()
    state[:, 2:] = 0.0
    voltage = np.random.default_rng(2).uniform(-10.0, 10.0, len(state))
    ours = vector_field(Segway(), state, voltage[:, None])[:, 2:].T
    for one, other in zip(ours, published(state, voltage), strict=True):
        assert np.abs(one - other).max() <= 0.02 * np.abs(other).max()


def test_the_published_motion_breaks_the_conservation_of_momentum_and_ours_does_not():
    """Motor off; a/b is taken as kindly as possible: the least squares of the defect itself."""
    body, state = Segway(drag=1e-9), drawn()
    state[:, 2] = 0.0  # the published drag is off at v = 0
    still = np.zeros(len(state))
    ours = vector_field(body, state, still[:, None])[:, 2:].T
    assert np.abs(momentum_defect(body.moving_mass, state, ours)).max() < 1e-8
    along, turn = published(state, still)
    rest = np.cos(state[:, 1]) * turn - np.sin(state[:, 1]) * state[:, 3] ** 2
    kindest = -(along @ rest) / (along @ along)
    defect = momentum_defect(kindest, state, (along, turn))
    centrifugal = np.abs(np.sin(state[:, 1]) * state[:, 3] ** 2).max()
    assert np.abs(defect).max() > 0.05 * centrifugal
    # With the sign turned and the cosine squared, what is left is the rounding of the digits.
    sine, cosine = np.sin(state[:, 1]), np.cos(state[:, 1])
    along = along * (cosine - 24.7) / (cosine**2 - 24.7)
    turn = turn + 2.0 * sine * cosine * state[:, 3] ** 2 / (cosine**2 - 24.7)
    rest = cosine * turn - sine * state[:, 3] ** 2
    kindest = -(along @ rest) / (along @ along)
    assert np.abs(momentum_defect(kindest, state, (along, turn))).max() < 0.05 * centrifugal


def test_a_motor_that_is_off_may_feed_energy_in_the_published_drag_and_not_in_ours():
    """The power of the drag is f (v - R omega): of one sign only if f is of the same speed."""
    body, state = Segway(), drawn()
    _, _, speed, rate = state.T
    wheel = speed - body.wheel_radius * rate
    assert np.any(-body.drag * speed * wheel > 1.0)
    assert np.all(-body.drag * wheel * wheel <= 0.0)


def test_every_kind_of_number_takes_the_equation():
    check_system(Segway())


@pytest.mark.parametrize(
    "bad", [{"gravity": 0.0}, {"wheel_radius": -1.0}, {"moving_mass": 0.5}, {"drag": float("nan")}]
)
def test_unphysical_bodies_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        Segway(**bad)


def test_episodes_begin_leaning_and_end_at_rest():
    task = SegwaySettings()
    drawn = task.sample_many(np.random.default_rng(0), 300)
    most = np.abs(drawn.initial_state).max(axis=0)
    assert most[0] == 0.0
    assert np.all(most[1:] <= [np.pi / 4, 0.5, 1.0])
    assert np.all(most[1:] >= 0.9 * np.array([np.pi / 4, 0.5, 1.0]))
    assert 2.7 <= np.abs(drawn.goal[:, 0]).max() <= 3.0
    assert not np.any(drawn.goal[:, 1:])


def test_falls_over_when_left_alone():
    env = gym.make("lagros/Segway-v0")
    env.reset(seed=0, options={"initial_state": np.array([0.0, 0.4, 0.0, 0.0])})
    over = False
    while not over:
        *_, over, late, info = env.step(np.zeros(1, np.float32))
        assert not late
    assert info["fallen"]


def test_picture_leans_with_the_body():
    task = SegwaySettings()
    wheel, body = task.outline(np.array([1.0, np.pi / 2, 0.0, 0.0]))
    np.testing.assert_allclose(np.linalg.norm(wheel - [1.0, 0.0], axis=1), 0.195)
    # Lying forwards, it reaches out along the ground.
    assert body[:, 0].max() == pytest.approx(1.0 + task.system.leaning_inertia)
    assert np.ptp(body[:, 1]) == pytest.approx(0.12)
