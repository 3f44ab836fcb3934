"""Where chunks of work run: in this process, in others of this machine, on Ray or on Dask.

A chunk depends on nothing but its item, so that every backend gives the same results, bit for bit
on machines of one kind. A worker that dies costs what it was running: that is run again, and
counted. Ray and Dask execute pickles that come over the network: name only a cluster of your own.
"""

from __future__ import annotations

import importlib
import logging
import os
import socket
import threading
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

BACKENDS = ("loky", "ray", "dask")
# How often a chunk may lose its worker: what kills so many (too little memory, say) will go on.
ATTEMPTS = 4

_LOG = logging.getLogger(__name__)
# A worker of Dask may have threads; the chunks share its process and run one at a time.
_ALONE = threading.Lock()


class BackendError(RuntimeError):
    """A backend is not installed, not reachable, or loses its workers again and again."""


@dataclass(frozen=True)
class Backend:
    """What runs chunks of work.

    Attributes:
        name: "loky" (processes of this machine, by joblib), "ray" or "dask".
        address: Of a running cluster, as Ray ("auto", "ray://host:10001") or Dask
            ("tcp://host:8786") writes it; None starts workers on this machine.

    Raises:
        ValueError: The name is unknown, or loky has an address.
    """

    name: str = "loky"
    address: str | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        if self.name not in BACKENDS:
            raise ValueError(f"unknown backend {self.name!r}. Valid: {', '.join(BACKENDS)}.")
        if self.name == "loky" and self.address is not None:
            raise ValueError(
                f"address={self.address!r} is for a cluster of ray or dask; leave it out for loky, "
                "whose workers run on this machine"
            )

    def in_parallel(self, jobs: int) -> bool:
        """Return whether chunks run in other processes than this one."""
        return jobs > 1 or self.name != "loky"


LOKY = Backend()


def say_lost(chunks: int) -> None:
    """Log that so many chunks lost their worker and are run again."""
    _LOG.warning("a worker died: %d chunk(s) of work are run again", chunks)


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
        on_lost: Told how many chunks lost their worker and are run again. On loky these are also
            those of its other workers, which it ends with the one that died.

    Raises:
        BackendError: See the class. What the work raises is raised here as it is.
    """
    if not items:
        return
    if not backend.in_parallel(jobs):
        yield from enumerate(map(work, items))
    elif backend.name == "loky":
        yield from _on_loky(work, items, jobs, on_lost)
    else:
        with running(backend, jobs) as cluster:
            run = _on_ray if backend.name == "ray" else _on_dask
            yield from run(cluster, work, items, on_lost)


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
        with _ray(backend.address, jobs) as ray:
            yield ray
    elif backend.name == "dask":
        with _dask(backend.address, jobs) as client:
            yield client
    else:
        yield None


def _on_loky(
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    jobs: int,
    on_lost: Callable[[int], None],
) -> Iterator[tuple[int, Outcome]]:
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    left = dict(enumerate(items))
    deaths = told = 0
    # joblib ends its pool with the worker, and drops what is done but not yet taken. How much that
    # was, marks on the disk tell, one for every start.
    with TemporaryDirectory(prefix="lagros-", ignore_cleanup_errors=True) as marks:
        while left:
            # joblib allows each worker cpu_count // jobs threads of BLAS and OpenMP.
            parallel = Parallel(
                n_jobs=jobs, backend="loky", batch_size=1, return_as="generator_unordered"
            )
            calls = [delayed(_marked)(work, index, item, marks) for index, item in left.items()]
            try:
                for index, outcome in parallel(calls):
                    del left[index]
                    deaths = 0
                    yield index, outcome
            except TerminatedWorkerError as error:
                deaths += 1
                if deaths == ATTEMPTS:
                    raise _gave_up(deaths, error) from error
            again = len(os.listdir(marks)) - (len(items) - len(left))
            if again > told:
                on_lost(again - told)
                told = again


def _on_ray(
    ray: Any,
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    on_lost: Callable[[int], None],
) -> Iterator[tuple[int, Outcome]]:
    errors = ray.exceptions
    losses = (
        errors.WorkerCrashedError,
        errors.NodeDiedError,
        errors.ObjectLostError,
        errors.OutOfMemoryError,
    )
    # We run again what is lost: Ray would do it in silence.
    remote = ray.remote(max_retries=0)(_call)
    shared = ray.put(work)
    begun = {remote.remote(shared, item): (index, 1) for index, item in enumerate(items)}
    try:
        while begun:
            (reference,), _ = ray.wait(list(begun), num_returns=1)
            index, attempt = begun.pop(reference)
            try:
                outcome = ray.get(reference)
            except losses as error:
                if attempt == ATTEMPTS:
                    raise _gave_up(attempt, error) from error
                begun[remote.remote(shared, items[index])] = index, attempt + 1
                on_lost(1)
                continue
            except errors.RayTaskError as error:
                raise error.cause from error
            yield index, outcome
    finally:
        for reference in begun:
            ray.cancel(reference, force=True)


def _on_dask(
    client: Any,
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    on_lost: Callable[[int], None],
) -> Iterator[tuple[int, Outcome]]:
    from distributed import KilledWorker, as_completed

    # Dask runs again what a dead worker had; every start is an event, which tells us of it.
    topic = f"lagros-{uuid.uuid4().hex}"
    starts: Counter[int] = Counter()
    client.subscribe_topic(topic, lambda event: starts.update([event[1]]))
    futures = {
        client.submit(_announced, work, index, item, topic, key=f"{topic}-{index}"): index
        for index, item in enumerate(items)
    }
    told = 0
    try:
        for future in as_completed(list(futures)):
            index = futures.pop(future)
            try:
                outcome = future.result()
            except KilledWorker as error:
                # How many, the scheduler's settings say; by default it is ATTEMPTS, too.
                raise _gave_up(error.allowed_failures + 1, error) from error
            again = starts.total() - len(starts)
            if again > told:
                on_lost(again - told)
                told = again
            yield index, outcome
    finally:
        client.cancel(list(futures))
        client.unsubscribe_topic(topic)


def _marked(
    work: Callable[[Item], Outcome], index: int, item: Item, marks: str
) -> tuple[int, Outcome]:
    Path(marks, uuid.uuid4().hex).touch()
    return index, work(item)


def _call(work: Callable[[Item], Outcome], item: Item) -> Outcome:
    return work(item)


def _announced(work: Callable[[Item], Outcome], index: int, item: Item, topic: str) -> Outcome:
    from distributed import get_worker

    with _ALONE:
        get_worker().log_event(topic, index)
        return work(item)


def _gave_up(deaths: int, error: Exception) -> BackendError:
    return BackendError(
        f"a chunk of work lost its worker {deaths} times ({type(error).__name__}); most often the "
        "memory is too small: take fewer jobs"
    )


@contextmanager
def _ray(address: str | None, jobs: int) -> Iterator[Any]:
    # Nobody asked for Ray's telemetry.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray = _installed("ray")
    if ray.is_initialized():
        yield ray
        return
    quiet = {"log_to_driver": False, "logging_level": logging.CRITICAL}
    try:
        if address is None:
            _start_ray(ray, num_cpus=jobs, **quiet)
        else:
            _knock(address)
            ray.init(address=address, **quiet)
    except (OSError, ValueError) as error:
        raise BackendError(f"no Ray cluster answers at {address!r}: {error}") from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _start_ray(ray: Any, **settings: Any) -> None:
    """Start Ray on this machine, again if need be: it gives its own processes 15 s to start."""
    for attempt in range(1, ATTEMPTS + 1):
        try:
            ray.init(address="local", include_dashboard=False, **settings)
            return
        except Exception as error:  # Ray raises no other class here
            ray.shutdown()
            if attempt == ATTEMPTS:
                raise BackendError(
                    f"Ray does not start ({error}); where the machine is busy, start it by hand "
                    "with `ray start --head` and name it with --address auto"
                ) from error


def _knock(address: str) -> None:
    """Raise OSError at once where nothing listens: Ray itself goes on asking for minutes."""
    host, colon, port = address.rpartition("//")[2].rpartition(":")
    if colon:
        socket.create_connection((host.strip("[]"), int(port)), timeout=10.0).close()


@contextmanager
def _dask(address: str | None, jobs: int) -> Iterator[Any]:
    distributed = _installed("distributed")
    client = _current(distributed, address)
    if client is not None:
        yield client
        return
    with ExitStack() as stack:
        if address is None:
            place = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=jobs,
                    threads_per_worker=1,
                    dashboard_address=":0",  # any free port, and no warning where 8787 is taken
                    silence_logs=logging.CRITICAL,
                )
            )
        else:
            place = address
        try:
            client = stack.enter_context(distributed.Client(place))
        except (OSError, ValueError) as error:
            raise BackendError(f"no Dask scheduler answers at {address!r}: {error}") from error
        yield client


def _current(distributed: Any, address: str | None) -> Any:
    """Return the client that is connected already, to this address if one is given; or None."""
    try:
        client = distributed.Client.current()
    except ValueError:
        return None
    return client if address in (None, client.scheduler.address) else None


def _installed(module: str) -> Any:
    extra = "dask" if module == "distributed" else module
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise BackendError(
            f"the backend {extra} is not installed; pip install 'lagros[{extra}]'"
        ) from error
