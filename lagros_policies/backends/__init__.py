"""Where chunks of work run: in this process, in others of this machine, on Ray or on Dask.

A chunk depends on nothing but its item, so that every backend gives the same results, bit for bit
on machines of one kind. A worker process that dies costs one chunk: the one that it was running,
or had finished and was handing over. That is run again, and counted. Ray and Dask execute pickles
that come over the network: name only a cluster of your own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from lagros_policies.backends.base import (
    ATTEMPTS,
    BACKENDS,
    LOKY,
    Backend,
    BackendError,
    Item,
    Outcome,
    say_lost,
)

__all__ = [
    "ATTEMPTS",
    "BACKENDS",
    "LOKY",
    "Backend",
    "BackendError",
    "each",
    "running",
    "say_lost",
]


def each(
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    jobs: int = 1,
    backend: Backend = LOKY,
    on_lost: Callable[[int], None] = say_lost,
) -> Iterator[tuple[int, Outcome]]:
    """Yield the index of every item with the work's result, in the order in which they finish.

    Args:
        work: Called with each item; what it closes over travels to the workers.
        items: The items.
        jobs: Worker processes to start; a cluster with an address uses those that it has.
        backend: Where the work is done. loky with one job does it in this process.
        on_lost: Told how many chunks lost their worker and are run again.

    Raises:
        BackendError: See the class. What the work raises is raised here as it is.
    """
    if not items:
        return
    if not backend.in_parallel(jobs):
        yield from enumerate(map(work, items))
    elif backend.name == "loky":
        from lagros_policies.backends import loky

        yield from loky.run(work, items, jobs, on_lost)
    else:
        with running(backend, jobs) as cluster:
            if backend.name == "ray":
                from lagros_policies.backends import ray

                yield from ray.run(cluster, work, items, on_lost)
            else:
                from lagros_policies.backends import dask

                yield from dask.run(cluster, work, items, on_lost)


@contextmanager
def running(backend: Backend, jobs: int) -> Iterator[Any]:
    """Keep the workers of a backend from one call of `each` to the next.

    A connection that is there already is used and left open.

    Args:
        backend: The backend; loky keeps its workers by itself.
        jobs: Worker processes to start, where it has no address.

    Raises:
        BackendError: See the class.
    """
    if backend.name == "ray":
        from lagros_policies.backends import ray

        with ray.connected(backend.address, jobs) as module:
            yield module
    elif backend.name == "dask":
        from lagros_policies.backends import dask

        with dask.connected(backend.address, jobs) as client:
            yield client
    else:
        yield None
