"""What is large on the cart-pole, for an agent that learns from a buffer."""

from __future__ import annotations

from lagros_benchmarks.training.single import SingleLesson


class CartPoleLesson(SingleLesson):
    """The cart-pole's part of a training run; see `SingleLesson`."""

    # The farthest goal [m], a start [rad], and the rates of a cart that hurries there [m/s, rad/s].
    feature_scales = (5.0, 1.0, 5.0, 3.0)
