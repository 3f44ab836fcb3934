"""One seed, independent streams: scenario, disturbance, what the policy draws, initial error.

Because the streams are separate, every policy meets the same starts and the same disturbances
whatever it draws itself, and a larger disturbance bound scales the same realisation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_seed

_Words = NDArray[np.uint32]

# Namespace of the episodes that a policy is judged on ("eval" in ASCII). Training draws from the
# empty namespace, so that no evaluation meets a training scenario, whatever the two seeds are.
EVALUATION = 0x6576616C
# In the order in which the seed of an episode is split.
_STREAMS = ("scenario", "disturbance", "policy", "initial_error")


class Streams:
    """Random generators of one episode, each made when it is asked for first.

    Iteration gives them in the order scenario, disturbance, policy.

    Args:
        seed: Non-negative integer, the seed of the episode.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed

    @cached_property
    def scenario(self) -> np.random.Generator:
        """What the start, the goal and the obstacles are drawn from."""
        return self._generator("scenario")

    @cached_property
    def disturbance(self) -> np.random.Generator:
        """What the disturbance is drawn from."""
        return self._generator("disturbance")

    @cached_property
    def policy(self) -> np.random.Generator:
        """What a policy may draw from."""
        return self._generator("policy")

    @cached_property
    def initial_error(self) -> np.random.Generator:
        """What the error at the start of an episode is drawn from, where it has one."""
        return self._generator("initial_error")

    def __iter__(self) -> Iterator[np.random.Generator]:
        """Give the three streams."""
        yield self.scenario
        yield self.disturbance
        yield self.policy

    def _generator(self, stream: str) -> np.random.Generator:
        # The child of that place, without spawning those before it.
        sequence = np.random.SeedSequence(self.seed, spawn_key=(_STREAMS.index(stream),))
        return np.random.Generator(np.random.PCG64(sequence))


def episode_streams(seed: int) -> Streams:
    """Return the streams of the episode with this seed.

    Args:
        seed: Non-negative integer, as given to `env.reset(seed=...)`.

    Returns:
        Generators for the scenario, the disturbance and the policy.

    Raises:
        ValueError: The seed is negative.
    """
    check_seed(seed)
    return Streams(seed)


def seeded_streams(seeds: Sequence[int], stream: str) -> Iterator[np.random.Generator]:
    """Give one stream of many episodes, several times faster than `episode_streams`.

    Args:
        seeds: Of the episodes, non-negative.
        stream: "scenario" or "disturbance" or "policy".

    Yields:
        For each seed the generator in the state that `getattr(episode_streams(seed), stream)`
        begins in. It is one object, set anew: what is yielded is used up before the next one.
    """
    if not seeds:
        return
    if max(seeds) >= 2**64:
        yield from (getattr(episode_streams(seed), stream) for seed in seeds)
        return
    generator = np.random.Generator(np.random.PCG64(0))
    state = generator.bit_generator.state
    for numbers in _pcg64_states(np.array(seeds, np.uint64), _STREAMS.index(stream)):
        state["state"]["state"], state["state"]["inc"] = numbers
        generator.bit_generator.state = state
        yield generator


class SharedStreams:
    """Generators of all episodes that begin without a seed of their own.

    Args:
        source: What they are seeded from.

    Attributes:
        source: The same.
        scenario: What starts and goals are drawn from.
        disturbance: What disturbances are drawn from; apart, so that a larger bound, under which
            episodes end earlier, does not shift them.
    """

    def __init__(self, source: np.random.Generator) -> None:
        self.source = source
        words = source.integers(2**63, size=(2, _POOL))
        self.scenario, self.disturbance = map(np.random.default_rng, words)


# The constants of NumPy's SeedSequence (O'Neill's seed_seq) and of PCG64. NumPy promises that what
# they give never changes; a test compares the two.
_POOL = 4  # words of 32 bits
_MIX = (0xCA01F9DD, 0x4973F715)
_ENTROPY_HASH = (0x43B0D7E5, 0x931E8875)
_STATE_HASH = (0x8B51F9DD, 0x58F38DED)
_PCG64_FACTOR = 0x2360ED051FC65DA44385DF649FCCF645
_HALF_WORD = np.uint32(16)


def _pcg64_states(seeds: NDArray[np.uint64], key: int) -> list[tuple[int, int]]:
    """Return state and increment of `PCG64(SeedSequence(seed, spawn_key=(key,)))` of each seed."""
    nothing = np.zeros(seeds.size, np.uint32)
    low, high = seeds.astype(np.uint32), (seeds >> np.uint64(32)).astype(np.uint32)
    hashed = _Hash(*_ENTROPY_HASH)
    pool = [hashed(word) for word in (low, high, nothing, nothing)]
    for source, target in permutations(range(_POOL), 2):
        pool[target] = _mixed(pool[target], hashed(pool[source]))
    for target in range(_POOL):
        pool[target] = _mixed(pool[target], hashed(nothing + np.uint32(key)))
    hashed = _Hash(*_STATE_HASH)
    words = np.stack([hashed(pool[k % _POOL]) for k in range(2 * _POOL)]).astype(np.uint64)
    halves = words[0::2] | (words[1::2] << np.uint64(32))
    found = []
    for first, second, third, fourth in zip(*halves.tolist(), strict=True):
        increment = (((third << 64 | fourth) << 1) | 1) % 2**128
        begin = (first << 64 | second) + increment
        found.append(((begin * _PCG64_FACTOR + increment) % 2**128, increment))
    return found


class _Hash:
    """SeedSequence's hash of words, whose constant changes with every call."""

    def __init__(self, constant: int, factor: int) -> None:
        self.constant, self.factor = constant, factor

    def __call__(self, words: _Words) -> _Words:
        words = words ^ np.uint32(self.constant)
        self.constant = self.constant * self.factor % 2**32
        words = words * np.uint32(self.constant)
        return words ^ (words >> _HALF_WORD)


def _mixed(first: _Words, second: _Words) -> _Words:
    words: _Words = first * np.uint32(_MIX[0]) - second * np.uint32(_MIX[1])
    return words ^ (words >> _HALF_WORD)


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
