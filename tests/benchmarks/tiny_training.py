"""Training runs of a few steps, for the tests of `lagros train`."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from lagros_benchmarks.tasks.cartpole.course import CartPoleTraining
from lagros_benchmarks.training.settings import Ppo, Sac, Td3

BUFFER = {"batch_size": 32, "gradient_steps": 3, "warm_up": 64, "hidden": (8,)}
ALGORITHMS = {
    "ppo": Ppo(rollout_steps=12, batch_size=48, epochs=2, hidden=(8,)),
    # A buffer that runs over, so that its position matters.
    "sac": Sac(**BUFFER, buffer_size=320),
    "td3": Td3(**BUFFER, buffer_size=1000),
}
TINY = CartPoleTraining(
    ALGORITHMS["ppo"],
    segments=3,
    segment_steps=24,
    worlds=8,
    curve_episodes=6,
    final_episodes=6,
)


def one_thread() -> Iterator[None]:
    """Run torch on one thread until the test is over."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
