"""Work in chunks, in this process or in several, with the same results in the same order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, TypeVar

from lagros_policies.backends import LOKY, Backend, each

# (what is being done, units done, units in all).
Progress = Callable[[str, int, int], None]
Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


class Keeper(Protocol):
    """Where finished work is kept, so that a run that was killed goes on; see `keeping.Kept`."""

    def found(self, title: str, count: int) -> dict[int, Any]:
        """Return what is there of so many items, by index."""
        ...

    def add(self, title: str, index: int, outcome: Any) -> None:
        """Keep the result of an item."""
        ...


def gather(
    title: str,
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    jobs: int,
    progress: Progress | None,
    backend: Backend = LOKY,
    keeper: Keeper | None = None,
) -> list[Outcome]:
    """Return the results of the work, in the order of the items, whatever the jobs.

    Args:
        title: What is being done, for the progress.
        work: Called with each item; what it closes over travels to the workers.
        items: The items.
        jobs: Worker processes; 1 works in this one.
        progress: Called after every item.
        backend: Whose processes they are.
        keeper: Has what an earlier run has finished, and takes what this one finishes.

    Raises:
        BackendError: The backend is not installed, not reachable, or loses its workers.
    """
    joined: dict[int, Outcome] = {} if keeper is None else keeper.found(title, len(items))
    missing = [index for index in range(len(items)) if index not in joined]
    if progress is not None and joined:
        progress(title, len(joined), len(items))
    for one, outcome in each(work, [items[index] for index in missing], jobs, backend):
        index = missing[one]
        joined[index] = outcome
        if keeper is not None:
            keeper.add(title, index, outcome)
        if progress is not None:
            progress(title, len(joined), len(items))
    return [joined[index] for index in range(len(items))]


def split(items: Sequence[Item], size: int) -> Iterator[Sequence[Item]]:
    """Yield consecutive parts of at most this size."""
    for begin in range(0, len(items), size):
        yield items[begin : begin + size]
