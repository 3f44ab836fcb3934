"""One seed, three independent streams: the scenario, the disturbance, and what the policy draws.

Because the streams are separate, every policy meets the same starts and the same disturbances
whatever it draws itself, and a larger disturbance bound scales the same realisation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Namespace of the episodes that a policy is judged on ("eval" in ASCII). Training draws from the
# empty namespace, so that no evaluation meets a training scenario, whatever the two seeds are.
EVALUATION = 0x6576616C


class Streams(NamedTuple):
    """Random generators of one episode."""

    scenario: np.random.Generator
    disturbance: np.random.Generator
    policy: np.random.Generator


def episode_streams(seed: int) -> Streams:
    """Return the streams of the episode with this seed.

    Args:
        seed: Non-negative integer, as given to `env.reset(seed=...)`.

    Returns:
        Generators for the scenario, the disturbance and the policy.

    Raises:
        ValueError: The seed is negative.
    """
    if seed < 0:
        raise ValueError(f"seed={seed!r} must be a non-negative integer")
    return Streams(
        *(np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3))
    )


def episode_seeds(seed: int, count: int, namespace: int | None = None) -> list[int]:
    """Return seeds of `count` episodes that belong to one run; a longer run begins with a shorter.

    Args:
        seed: Seed of the run.
        count: Number of episodes.
        namespace: Separates runs of one seed that must not share episodes: `EVALUATION`, or None
            for training.

    Returns:
        Integers below 2**63, statistically independent of those of any other run or namespace.
    """
    # A spawn key, not further entropy: SeedSequence((s, n)) is SeedSequence(s + n * 2**32).
    spawn_key = () if namespace is None else (namespace,)
    words = np.random.SeedSequence(seed, spawn_key=spawn_key).generate_state(count, np.uint64)
    return [int(word >> np.uint64(1)) for word in words]
