"""Chunks of work in processes of this machine, started and spoken to by means of joblib.

joblib's own pool ends with the first of its processes that dies, and takes with it what the others
were doing. Here every process has a pipe of its own, and two parts of joblib are used: loky starts
the processes, which share nothing with this one, and its pickles carry functions by value. A
process that dies closes its pipe, even in the middle of an answer; another one is started and runs
its chunk again. What was handed over whole is kept.

Processes are kept for later calls, and end when nobody has asked them for five minutes and when
this process ends, at once if it is killed.
"""

from __future__ import annotations

import atexit
import faulthandler
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any

from joblib import cpu_count
from joblib.externals.loky.backend import get_context
from joblib.externals.loky.backend.reduction import dumps, loads
from joblib.externals.loky.backend.utils import kill_process_tree

from lagros_policies.backends.base import (
    ATTEMPTS,
    SAFE_PATH,
    Item,
    Outcome,
    gave_up,
    sheltered,
    without_folder,
)

# How long a worker waits to be asked again [s]; as in joblib.
PATIENCE = 300.0
# A worker that waited so long may be about to go, and is not asked any more [s].
_STALE = 0.8 * PATIENCE
# What bounds the threads of BLAS, OpenMP and numba in a process.
THREAD_LIMITS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMBA_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)


class WorkerTraceback(Exception):  # noqa: N818 (it says where, not what)
    """Where in a worker an exception was raised; the cause of that exception here."""


class _Worker:
    """A process of this machine and this end of its pipe."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Start the process with these variables in its environment."""
        self.environment = environment
        self.idle_since = time.monotonic()
        self.connection, theirs = Pipe()
        # Nothing is ever sent on it: it breaks when this process dies, whatever kills it.
        there, self._alive = Pipe(duplex=False)
        self._process = get_context("loky").Process(
            target=_serve, args=(theirs, there), env=dict(environment)
        )
        with without_folder():
            self._process.start()
        # Theirs only: the pipe must break when the process dies.
        theirs.close()
        there.close()
        self._work: bytes | None = None
        _ALL.add(self)

    def begin(self, work: bytes, item: Any) -> None:
        """Give it an item, and the work if it does not have it yet."""
        message = dumps((None if self._work is work else work, item))
        self._work = work
        # One that died in the meantime is found out when its answer is awaited.
        with suppress(OSError):
            self.connection.send_bytes(message)

    def is_fit(self, environment: Mapping[str, str]) -> bool:
        """Return whether it is alive and was started with these variables."""
        fresh = time.monotonic() - self.idle_since < _STALE
        # An idle worker says nothing: what can be read is the end of its pipe.
        return fresh and self.environment == environment and not self.connection.poll()

    def rest(self) -> None:
        """Keep it for the next call."""
        self._work = None
        self.idle_since = time.monotonic()
        _IDLE.append(self)

    def dismiss(self) -> None:
        """Let the process end by itself, which it does when it waits and its pipe is closed."""
        _ALL.discard(self)
        self.connection.close()
        self._alive.close()

    def end(self) -> None:
        """End the process, whatever it is doing, and those that it started."""
        self.dismiss()
        kill_process_tree(self._process)
        self._process.join()


_ALL: set[_Worker] = set()
_IDLE: list[_Worker] = []


def run(
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    jobs: int,
    on_lost: Callable[[int], None],
) -> Iterator[tuple[int, Outcome]]:
    """Yield index and result of every item, as `backends.each` does.

    Raises:
        BackendError: A chunk lost too many workers.
    """
    packed = bytes(dumps(work))
    environment = limits(jobs)
    # Which item, and how often it was begun with this time.
    todo = deque((index, 1) for index in range(len(items)))
    ready: list[_Worker] = []
    busy: dict[Any, tuple[_Worker, int, int]] = {}
    finished: list[tuple[int, Outcome]] = []
    try:
        while len(ready) < min(jobs, len(items)):
            ready.append(_hire(environment))
        while todo or busy:
            while todo and ready:
                worker, (index, attempt) = ready.pop(), todo.popleft()
                busy[worker.connection] = worker, index, attempt
                worker.begin(packed, items[index])
            # Now that everybody has something to do.
            yield from finished
            finished = []
            for connection in wait(list(busy)):
                worker, index, attempt = busy[connection]
                try:
                    answer = worker.connection.recv_bytes()
                except (EOFError, OSError) as error:
                    if attempt == ATTEMPTS:
                        raise gave_up(attempt, error) from error
                    del busy[connection]
                    worker.end()
                    on_lost(1)
                    todo.appendleft((index, attempt + 1))
                    ready.append(_hire(environment))
                    continue
                del busy[connection]
                ready.append(worker)
                done, outcome = loads(answer)
                if not done:
                    reason, trace = outcome
                    raise reason from WorkerTraceback(trace)
                finished.append((index, outcome))
        yield from finished
    finally:
        for worker in ready:
            worker.rest()
        for worker, _, _ in busy.values():
            worker.end()


def limits(jobs: int) -> dict[str, str]:
    """Return the limits of a worker's threads: its share of the processors, as joblib gives it.

    A limit that is set for this process is kept.
    """
    share = str(max(cpu_count() // jobs, 1))
    return {name: os.environ.get(name, share) for name in THREAD_LIMITS}


def _hire(environment: Mapping[str, str]) -> _Worker:
    while _IDLE:
        worker = _IDLE.pop()
        if worker.is_fit(environment):
            return worker
        worker.dismiss()
    return _Worker(environment)


def _watch(alive: Connection) -> None:
    """End this process, a worker, with the one that started it, even amid a chunk."""
    with suppress(EOFError, OSError):
        alive.recv_bytes()
    os._exit(1)


def _serve(connection: Connection, alive: Connection) -> None:
    """Answer one item after the other, in a worker, until nobody asks."""
    threading.Thread(target=_watch, args=(alive,), daemon=True).start()
    os.environ.pop(SAFE_PATH, None)
    # The output of this command is its own; what the work prints is not part of it.
    with suppress(OSError):
        os.dup2(2, 1)
    # The terminal's Ctrl-C goes to every process: what becomes of us, the one that asked decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable()
    work = b""
    with suppress(EOFError, OSError):
        while connection.poll(PATIENCE):
            message = connection.recv_bytes()
            try:
                new, item = loads(message)
                work = new or work
                # A copy for every chunk: nothing that one leaves behind is there for the next.
                answer = dumps((True, sheltered(loads(work), item)))
            except BaseException as error:  # whatever it is belongs to the one that asked
                answer = _refusal(error)
            connection.send_bytes(answer)


def _refusal(error: BaseException) -> Any:
    """Return an answer that carries an exception, or its text where it cannot be sent."""
    trace = "".join(traceback.format_exception(error))
    try:
        packed = dumps((False, (error, trace)))
        loads(packed)
    except Exception:  # pickle calls the class anew, which may raise anything
        text = f"{type(error).__name__}: {error}"
        packed = dumps((False, (RuntimeError(text), trace)))
    return packed


def _end_all() -> None:
    """Leave nothing for multiprocessing to wait for, which it does at the end of this process."""
    while _IDLE:
        _IDLE.pop().dismiss()
    for worker in list(_ALL):
        worker.end()


def _forget_all() -> None:
    """A forked copy of this process has no workers."""
    _ALL.clear()
    _IDLE.clear()


atexit.register(_end_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_all)
