"""The car: its equation against geometry, its episodes, its picture."""

from __future__ import annotations

import gymnasium as gym
import numpy as np

from lagros_envs.dynamics import check_system, hold_step, vector_field
from lagros_envs.tasks.car.physics import Car
from lagros_envs.tasks.car.task import CarSettings


def test_moves_where_it_heads_at_its_speed():
    rng = np.random.default_rng(0)
    state, control = rng.normal(size=(50, 4)), rng.normal(size=(50, 2))
    rates = vector_field(Car(), state, control)
    np.testing.assert_allclose(
        rates[:, 0] + 1j * rates[:, 1], state[:, 3] * np.exp(1j * state[:, 2]), atol=1e-12
    )
    np.testing.assert_array_equal(rates[:, 2:], control)


def test_drives_a_circle_at_a_constant_turn_and_a_spiral_of_known_length():
    start = np.array([1.0, -2.0, 0.3, 1.5])
    end = hold_step(Car(), start, np.array([0.5, 0.0]), 2.0 * np.pi / 0.5, substeps=200)
    np.testing.assert_allclose(end, start + np.array([0, 0, 2.0 * np.pi, 0]), atol=1e-6)
    # The centre is v / omega to the left.
    half = hold_step(Car(), start, np.array([0.5, 0.0]), np.pi / 0.5, substeps=200)
    centre = start[:2] + 3.0 * np.array([-np.sin(0.3), np.cos(0.3)])
    np.testing.assert_allclose(half[:2], 2.0 * centre - start[:2], atol=1e-6)
    straight = hold_step(Car(), start, np.array([0.0, -0.5]), 2.0)
    way = (1.5 * 2.0 - 0.5 * 0.5 * 4.0) * np.array([np.cos(0.3), np.sin(0.3)])
    np.testing.assert_allclose(straight, [*(start[:2] + way), 0.3, 0.5], atol=1e-9)


def test_every_kind_of_number_takes_the_equation():
    check_system(Car())


def test_episodes_cross_discs_that_leave_every_passage_open():
    task, counts = CarSettings(), set()
    for seed in range(100):
        drawn = task.sample(np.random.default_rng(seed))
        counts.add(len(drawn.discs))
        for place, along in ((drawn.initial_state, 0.0), (drawn.goal, 9.0)):
            assert place[0] == along
            assert place[3] == 1.5
            assert abs(place[1]) <= 2.0
            assert abs(place[2]) <= 0.5
        centres = drawn.discs[:, :2]
        apart = np.linalg.norm(centres[:, None] - centres, axis=-1) + 9.0 * np.eye(len(centres))
        assert apart.min() >= 2.0 * (0.5 + 0.2 + 0.15)
        for end in (drawn.initial_state, drawn.goal):
            assert np.linalg.norm(centres - end[:2], axis=1).min() >= 0.5 + 0.2 + 0.25
    assert {3, 4} <= counts <= {3, 4, 5}


def test_the_action_zero_drives_straight_on_and_costs_nothing():
    env = gym.make("lagros/Car-v0")
    start, _ = env.reset(seed=1)
    assert start.shape == (3 * 4 + 1 + 3 * 5,)
    for _ in range(5):
        observation, *_, info = env.step(np.zeros(2, np.float32))
    way = 0.75 * np.array([np.cos(start[2]), np.sin(start[2])])
    np.testing.assert_allclose(observation[:4], start[:4] + np.array([*way, 0, 0]), atol=1e-6)
    assert info["effort"] == 0.0


def test_picture_points_where_the_car_heads_and_lies_in_what_collides():
    task = CarSettings()
    (body,) = task.outline(np.array([1.0, 2.0, np.pi / 2, 1.5]))
    apart = body - [1.0, 2.0]
    lengths = np.linalg.norm(apart, axis=1)
    assert lengths.max() <= task.body_radius + 1e-12
    np.testing.assert_allclose(apart[lengths.argmax()], (0.0, task.body_radius), atol=1e-12)
