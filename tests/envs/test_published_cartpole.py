"""C3M's cart-pole beside mechanics and beside ours: benchmarks/studies/published.md."""

import numpy as np

from lagros_envs.dynamics.system import jacobian
from lagros_envs.tasks.cartpole.physics import CartPole

CART = POLE = LENGTH = 1.0
GRAVITY = 9.8
TOTAL = CART + POLE


def published(state, force=0.0):
    """The accelerations of sundw2014/C3M, systems/system_CARTPOLE.py."""
    _, angle, _, rate = state.T
    sine, cosine = np.sin(angle), np.cos(angle)
    divisor = CART + POLE * sine**2
    along = POLE * sine * (LENGTH * rate**2 - GRAVITY * cosine) + force
    turn = POLE * LENGTH * rate**2 * cosine * sine - TOTAL * GRAVITY * sine + force * cosine
    return along / divisor, turn / (LENGTH * divisor)


def drawn():
    wide = np.array([1.0, np.pi / 3, 1.0, 1.0])
    return np.random.default_rng(0).uniform(-wide, wide, (200, 4))


def power(state, accelerations, up=1.0, side=1.0):
    """dE/dt of a point mass on a rod, up or hanging, the angle turned to one side or the other."""
    _, angle, speed, rate = state.T
    along, turn = accelerations
    sine, cosine = np.sin(angle), side * POLE * LENGTH * np.cos(angle)
    moving = TOTAL * speed * along + POLE * LENGTH**2 * rate * turn
    coupled = cosine * (along * rate + speed * turn)
    coupled -= side * POLE * LENGTH * sine * rate**2 * speed
    return moving + coupled - up * POLE * GRAVITY * LENGTH * sine * rate


def momentum(state, accelerations, side):
    """d/dt of the momentum along the ground."""
    _, angle, _, rate = state.T
    along, turn = accelerations
    return TOTAL * along + side * POLE * LENGTH * (np.cos(angle) * turn - np.sin(angle) * rate**2)


def test_energy_and_momentum_of_the_published_motion_are_kept_in_no_reading():
    state = drawn()
    accelerations = published(state)
    for side in (1.0, -1.0):
        assert np.abs(momentum(state, accelerations, side)).max() > 0.1
        for up in (1.0, -1.0):
            assert np.abs(power(state, accelerations, up, side)).max() > 0.1


def test_with_the_other_sign_of_the_angular_acceleration_both_are_kept():
    state = drawn()
    along, turn = published(state)
    assert np.abs(power(state, (along, -turn))).max() < 1e-12
    assert np.abs(momentum(state, (along, -turn), 1.0)).max() < 1e-12
    # A force does work on the cart alone.
    along, turn = published(state, 2.5)
    np.testing.assert_allclose(power(state, (along, -turn)), 2.5 * state[:, 2], atol=1e-12)


def test_the_published_upright_is_stable_and_ours_falls():
    step = np.array([[0.0, 1e-6, 0.0, 0.0]])
    slope = (published(step)[1] - published(-step)[1])[0] / 2e-6
    assert abs(slope + 19.6) < 1e-3
    ours, _ = jacobian(CartPole(), np.zeros(4), np.zeros(1))
    assert ours[3, 1] > 10.0
    assert np.linalg.eigvals(ours).real.max() > 3.0
