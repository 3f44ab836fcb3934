"""Chunks of work as tasks of Dask.

Dask leaves a result in the memory of the process that made it until somebody asks. Here the client
takes every result the moment it is there, whatever the caller is doing, and a process begins its
next chunk only when the last one was taken: a process that dies loses one chunk, and nothing of
what it did before. The wait is some 10 to 20 ms per chunk.
"""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from queue import SimpleQueue
from typing import Any

from joblib.externals.loky.backend.reduction import dumps, loads

from lagros_policies.backends.base import (
    BackendError,
    Item,
    Outcome,
    gave_up,
    installed,
    knock,
    sheltered,
    without_folder,
)

# Where a cluster that is started here listens: no other machine reaches it.
LOOPBACK = "127.0.0.1"
# How often a process looks whether its last result was taken [s].
_LOOK = 0.002
# A worker of Dask may have threads; the chunks share its process and run one at a time.
_ALONE = threading.Lock()
# The last task that this process, a worker, finished, by run.
_LAST: dict[str, str] = {}


def run(
    client: Any,
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    on_lost: Callable[[int], None],
) -> Iterator[tuple[int, Outcome]]:
    """Yield index and result of every item, as `backends.each` does.

    Raises:
        BackendError: A chunk lost too many workers, or the scheduler is gone.
    """
    from distributed import KilledWorker, as_completed

    # Dask runs again what a dead worker had; every start is an event, which tells us of it.
    topic = f"lagros-{uuid.uuid4().hex}"
    starts: Counter[int] = Counter()
    client.subscribe_topic(topic, lambda event: starts.update([event[1]]))
    futures = {
        client.submit(_chunk, work, index, item, topic, key=_key(topic, index)): index
        for index, item in enumerate(items)
    }
    taken: SimpleQueue[tuple[Any, str, Any]] = SimpleQueue()
    completed = as_completed(list(futures), loop=client.loop, with_results=True, raise_errors=False)
    threading.Thread(target=_take, args=(completed, taken), daemon=True).start()
    told = 0
    try:
        for _ in items:
            future, status, result = taken.get()
            if status == "error":
                _, error, trace = result
                if isinstance(error, KilledWorker):
                    # How many, the scheduler's settings say; by default it is ATTEMPTS, too.
                    raise gave_up(error.allowed_failures + 1, error) from error
                raise error.with_traceback(trace)
            if status == "cancelled":
                raise BackendError(f"Dask gave a chunk of work up: {result}")
            again = starts.total() - len(starts)
            if again > told:
                on_lost(again - told)
                told = again
            yield futures[future], loads(result)
    finally:
        if client.status == "running":  # where the scheduler is gone, there is nobody to tell
            client.cancel([future for future in futures if not future.done()])
            client.unsubscribe_topic(topic)


def _take(completed: Iterable[tuple[Any, Any]], taken: SimpleQueue[tuple[Any, str, Any]]) -> None:
    """Take every result as it comes, and let the worker that made it forget it."""
    for future, result in completed:
        taken.put((future, future.status, result))
        future.release()


def _chunk(work: Callable[[Item], Outcome], index: int, item: Item, topic: str) -> bytes:
    """Run a chunk, once the last result of this process is elsewhere."""
    from distributed import Reschedule, Status, get_worker, sync

    worker = get_worker()
    with _ALONE:
        # A worker knows a task until the client has its result and lets it go.
        while _LAST.get(topic) in worker.state.tasks:
            if worker.status in (Status.closing, Status.closed, Status.failed):
                raise Reschedule  # nobody will take it any more, here
            time.sleep(_LOOK)
        _LAST.pop(topic, None)
        # The scheduler knows of the start before the work, which may kill this process, begins.
        sync(worker.loop, worker.scheduler.log_event, topic=topic, msg=index)
        # The client reads it in the caller's thread, where an error has somewhere to go.
        packed = bytes(dumps(sheltered(work, item)))
        _LAST[topic] = _key(topic, index)
        return packed


def _key(topic: str, index: int) -> str:
    return f"{topic}-{index}"


@contextmanager
def connected(address: str | None, jobs: int) -> Iterator[Any]:
    """Connect to a scheduler, or start a cluster on this machine, and yield the client.

    Args:
        address: Of the scheduler; None starts one here.
        jobs: Worker processes, where they are started here.

    Raises:
        BackendError: Dask is not installed, or no scheduler answers.
    """
    distributed = installed("distributed")
    client = _current(distributed, address)
    if client is not None:
        yield client
        return
    with ExitStack() as stack:
        place = _started(stack, distributed, jobs) if address is None else address
        try:
            if address is not None:
                _knock(address)
            client = stack.enter_context(distributed.Client(place))
        except Exception as error:  # of many classes, where something else listens
            raise BackendError(
                f"no Dask scheduler answers at {address!r} ({error}); start one with `dask "
                "scheduler` and name it as tcp://host:8786 (not the dashboard), or leave the "
                "address out to start workers on this machine"
            ) from error
        yield client


def _started(stack: ExitStack, distributed: Any, jobs: int) -> Any:
    """Start a cluster on this machine that no other can reach, until the stack is closed.

    Raises:
        BackendError: It does not start.
    """
    # A dead worker is started again at once. LocalCluster gives up one that is dead again so long
    # after a death, by default after 15 s, until none is left.
    lost = {"distributed.deploy.lost-worker-timeout": "7 days"}
    stack.enter_context(installed("dask").config.set(lost))
    stack.enter_context(without_folder())
    try:
        cluster = distributed.LocalCluster(
            n_workers=jobs,
            threads_per_worker=1,
            host=LOOPBACK,
            dashboard_address=f"{LOOPBACK}:0",  # any free port, and no warning if 8787 is taken
            silence_logs=logging.CRITICAL,
        )
    except Exception as error:  # Dask wraps what happened in errors of its own
        raise BackendError(f"Dask does not start ({error}); try --backend loky") from error
    return stack.enter_context(cluster)


def _knock(address: str) -> None:
    """Raise at once where no scheduler listens; of Dask's own transports only some have a port."""
    scheme, colon, _ = address.rpartition("://")
    if not colon or scheme in ("tcp", "tls"):
        # A scheduler greets who connects; under TLS, it waits to be greeted.
        knock(address, speaks=scheme != "tls")


def _current(distributed: Any, address: str | None) -> Any:
    """Return the client that is connected already, to this address if one is given; or None."""
    try:
        client = distributed.Client.current()
    except ValueError:
        return None
    return client if address in (None, client.scheduler.address) else None
