"""Work in chunks, in this process or in several, with the same results in the same order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from lagros_policies.backends import LOKY, Backend, each

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
    backend: Backend = LOKY,
) -> list[Outcome]:
    """Return the results of the work, in the order of the items, whatever the jobs.

    Args:
        title: What is being done, for the progress.
        work: Called with each item; what it closes over travels to the workers.
        items: The items.
        jobs: Worker processes; 1 works in this one.
        progress: Called after every item.
        backend: Whose processes they are.

    Raises:
        BackendError: The backend is not installed, not reachable, or loses its workers.
    """
    joined: dict[int, Outcome] = {}
    for index, outcome in each(work, items, jobs, backend):
        joined[index] = outcome
        if progress is not None:
            progress(title, len(joined), len(items))
    return [joined[index] for index in range(len(items))]


def split(items: Sequence[Item], size: int) -> Iterator[Sequence[Item]]:
    """Yield consecutive parts of at most this size."""
    for begin in range(0, len(items), size):
        yield items[begin : begin + size]
