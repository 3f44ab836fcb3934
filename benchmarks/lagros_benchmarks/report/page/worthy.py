"""Which episodes are worth watching: what failed, what came near it, and what is usual."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from lagros_benchmarks.run.settings import Case

# Why an episode is kept, the most telling first.
FAILURE, WORST, MEDIAN = "fails", "at its worst", "as usual"
_MOST_FAILURES = 3  # of one policy under one condition


class Merit(NamedTuple):
    """How an episode went.

    Attributes:
        failed: It is a failure.
        badness: How near to failing it came; compared within one policy and condition.
    """

    failed: bool
    badness: float


class Pick(NamedTuple):
    """An episode that is kept for every policy of a condition.

    Attributes:
        group: Index of the condition.
        episode: Its index, from 0.
        why: Policies and reasons.
    """

    group: int
    episode: int
    why: tuple[tuple[Case, str], ...]


def ranked(merits: Sequence[Merit]) -> list[tuple[int, str]]:
    """Return the episodes of a policy that are worth watching, the best to keep first.

    They are its first failure, the success that came nearest to one, the median success, and
    further failures.
    """
    failures = [index for index, merit in enumerate(merits) if merit.failed]
    rest = [index for index, merit in enumerate(merits) if not merit.failed]
    by_badness = sorted(rest, key=lambda index: (merits[index].badness, -index))
    found = [(index, FAILURE) for index in failures[:1]]
    if by_badness:
        found.append((by_badness[-1], WORST))
        found.append((by_badness[(len(by_badness) - 1) // 2], MEDIAN))
    found += [(index, FAILURE) for index in failures[1:_MOST_FAILURES]]
    kept: dict[int, str] = {}
    for index, why in found:
        kept.setdefault(index, why)  # the only success of a policy is both
    return list(kept.items())


def worthy(groups: Sequence[Mapping[Case, Sequence[Merit]]], most: int) -> list[Pick]:
    """Return at most so many episodes, in turns between conditions and their policies.

    Args:
        groups: How every episode of every policy went, by condition.
        most: Episodes in all.
    """
    queues = [_turns(merits) for merits in groups]
    order: list[tuple[int, int]] = []
    for turn in range(max((len(queue) for queue in queues), default=0)):
        order += [(group, queue[turn]) for group, queue in enumerate(queues) if turn < len(queue)]
    return [Pick(group, index, _reasons(groups[group], index)) for group, index in order[:most]]


def _turns(merits: Mapping[Case, Sequence[Merit]]) -> list[int]:
    """Return the episodes of one condition, the policies' first choices before their second."""
    lists = [[index for index, _ in ranked(one)] for one in merits.values()]
    longest = max((len(one) for one in lists), default=0)
    chosen = (one[turn] for turn in range(longest) for one in lists if turn < len(one))
    return list(dict.fromkeys(chosen))


def _reasons(merits: Mapping[Case, Sequence[Merit]], index: int) -> tuple[tuple[Case, str], ...]:
    reasons = []
    for case, one in merits.items():
        if one[index].failed:
            reasons.append((case, FAILURE))
        else:
            reasons += [(case, why) for found, why in ranked(one) if found == index]
    return tuple(reasons)
