"""Work in chunks, in this process or in several, with the same results in the same order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

# (what is being done, units done, units in all).
Progress = Callable[[str, int, int], None]
Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def gather(
    title: str,
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    jobs: int,
    progress: Progress | None,
) -> list[Outcome]:
    """Return the results of the work, in the order of the items, whatever the jobs.

    Args:
        title: What is being done, for the progress.
        work: Called with each item; what it closes over travels to the workers.
        items: The items.
        jobs: Worker processes; 1 works in this one.
        progress: Called after every item.
    """
    outcomes: Iterator[Outcome] = map(work, items)
    if jobs > 1:
        from joblib import Parallel, delayed

        # joblib allows each worker cpu_count // jobs threads of BLAS and OpenMP.
        outcomes = Parallel(n_jobs=jobs, backend="loky", return_as="generator")(
            delayed(work)(item) for item in items
        )
    joined: list[Outcome] = []
    for done, outcome in enumerate(outcomes, start=1):
        joined.append(outcome)
        if progress is not None:
            progress(title, done, len(items))
    return joined


def split(items: Sequence[Item], size: int) -> Iterator[Sequence[Item]]:
    """Yield consecutive parts of at most this size."""
    for begin in range(0, len(items), size):
        yield items[begin : begin + size]
