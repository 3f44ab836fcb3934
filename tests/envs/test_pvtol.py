"""The planar quadrotor: its equation against mechanics in the world's axes, and its episodes."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from lagros_envs.dynamics import check_system, hold_step, vector_field
from lagros_envs.tasks.pvtol.physics import Pvtol
from lagros_envs.tasks.pvtol.task import PvtolSettings


def test_motion_is_newtons_in_the_axes_of_the_world():
    body, rng = Pvtol(), np.random.default_rng(0)
    state, thrust = rng.normal(size=(50, 6)), rng.uniform(0.0, 4.0, (50, 2))
    rates = vector_field(body, state, thrust)
    turn = np.exp(1j * state[:, 2])
    velocity = (state[:, 3] + 1j * state[:, 4]) * turn
    np.testing.assert_allclose(rates[:, 0] + 1j * rates[:, 1], velocity, atol=1e-12)
    np.testing.assert_allclose(rates[:, 2], state[:, 5])
    # d(v e^{i phi})/dt is gravity and the thrust across the rod.
    change = (rates[:, 3] + 1j * rates[:, 4]) * turn + 1j * state[:, 5] * velocity
    force = 1j * turn * thrust.sum(axis=1) / body.mass - 1j * body.gravity
    np.testing.assert_allclose(change, force, atol=1e-12)
    torque = body.arm * (thrust[:, 0] - thrust[:, 1])
    np.testing.assert_allclose(body.inertia * rates[:, 5], torque)


def test_rests_in_a_hover_and_keeps_its_energy_in_free_fall():
    body = Pvtol()
    assert not np.any(vector_field(body, np.array([1.0, 2, 0, 0, 0, 0]), np.full(2, body.hover)))
    falling = np.array([0.0, 0.0, 0.4, 1.0, -0.5, 2.0])

    def energy(state):
        speeds = body.mass * (state[3] ** 2 + state[4] ** 2) + body.inertia * state[5] ** 2
        return 0.5 * speeds + body.mass * body.gravity * state[1]

    later = hold_step(body, falling, np.zeros(2), 0.5, substeps=50)
    assert energy(later) == pytest.approx(energy(falling), rel=1e-7)
    assert later[0] == pytest.approx(
        0.5 * (falling[3] * np.cos(0.4) - falling[4] * np.sin(0.4)), rel=1e-6
    )


def test_every_kind_of_number_takes_the_equation():
    check_system(Pvtol())


@pytest.mark.parametrize("bad", [{"mass": 0.0}, {"inertia": -1.0}, {"arm": float("nan")}])
def test_unphysical_bodies_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        Pvtol(**bad)


def test_episodes_are_hover_to_hover_past_discs_that_leave_every_passage_open():
    task, counts = PvtolSettings(), set()
    for seed in range(100):
        drawn = task.sample(np.random.default_rng(seed))
        counts.add(len(drawn.discs))
        assert not np.any(drawn.initial_state[[0, 2, 3, 4, 5]])
        assert not np.any(drawn.goal[2:])
        assert drawn.goal[0] == 6.0
        assert max(abs(drawn.initial_state[1]), abs(drawn.goal[1])) <= 1.5
        centres = drawn.discs[:, :2]
        apart = np.linalg.norm(centres[:, None] - centres, axis=-1) + 9.0 * np.eye(len(centres))
        assert apart.min() >= 2.0 * (0.5 + 0.2 + 0.15)
        for end in (drawn.initial_state, drawn.goal):
            assert np.linalg.norm(centres - end[:2], axis=1).min() >= 0.5 + 0.2 + 0.25
    assert {3, 4} <= counts <= {3, 4, 5}


def test_hovers_at_the_action_zero_and_falls_when_it_turns_over():
    env = gym.make("lagros/Pvtol-v0")
    start, _ = env.reset(seed=3)
    for _ in range(5):
        observation, *_, info = env.step(np.zeros(2, np.float32))
    np.testing.assert_allclose(observation[:6], start[:6], atol=1e-6)
    assert info["effort"] == pytest.approx(0.0, abs=1e-9)
    over = False
    while not over:
        _, _, over, late, info = env.step(np.array([0.2, -0.2], np.float32))
        assert not late
    assert info["fallen"]
    assert not info["success"]


def test_picture_turns_with_the_body():
    task = PvtolSettings()
    rod, *rotors = task.outline(np.array([1.0, 2.0, np.pi / 2, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(rod.mean(axis=0), (1.0, 2.0))
    # Upended, the rod stands; thrust points to the left.
    assert np.ptp(rod[:, 1]) == pytest.approx(0.4)
    assert all(rotor[:, 0].max() < 1.0 for rotor in rotors)
