"""The weights of the cart-pole's regulator about the upright."""

from __future__ import annotations

from lagros_envs.task import Feedback
from lagros_envs.tasks.cartpole.task import CartPoleSettings


def upright_weights(task: CartPoleSettings) -> Feedback:
    """Return one over the square of the largest acceptable values (Bryson's rule).

    For p `task.goal_range` [m], for theta `task.initial_angle` [rad], for the rates what crosses
    these ranges in one second, for u `task.force_scale` [N]; 1 where a range is zero.
    """
    ranges = [task.goal_range or 1.0, task.initial_angle or 1.0] * 2
    return Feedback(tuple(1.0 / (value * value) for value in ranges), (1.0 / task.force_scale**2,))
