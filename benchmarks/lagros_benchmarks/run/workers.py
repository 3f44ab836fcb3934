"""Work in chunks, in this process or in several, with the same results in the same order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from lagros_benchmarks.run.keeping import Kept
from lagros_policies.backends import LOKY, Backend, each

# (what is being done, units done, units in all).
Progress = Callable[[str, int, int], None]
Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def untold(title: str, done: int, total: int) -> None:
    """Tell nobody: the `Progress` of who does not ask."""


def gather(
    title: str,
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    jobs: int,
    progress: Progress | None,
    backend: Backend = LOKY,
    keeper: Kept | None = None,
) -> list[Outcome]:
    """Return the results of the work, in the order of the items, whatever the jobs.

    `progress` is called with the title at once and after every item. What `work` closes over
    travels to the workers; one job works in this process. The keeper has what an earlier run has
    finished, and takes what this one finishes.

    Raises:
        BackendError: The backend is not installed, not reachable, or loses its workers.
    """
    joined: dict[int, Outcome] = {} if keeper is None else keeper.found(title, len(items))
    missing = [index for index in range(len(items)) if index not in joined]
    tell = progress or untold
    tell(title, len(joined), len(items))
    for one, outcome in each(work, [items[index] for index in missing], jobs, backend):
        index = missing[one]
        joined[index] = outcome
        if keeper is not None:
            keeper.add(title, index, outcome)
        tell(title, len(joined), len(items))
    return [joined[index] for index in range(len(items))]


def split(items: Sequence[Item], size: int) -> Iterator[Sequence[Item]]:
    """Yield consecutive parts of at most this size."""
    for begin in range(0, len(items), size):
        yield items[begin : begin + size]
