"""What a stranger does to the process, a policy of the user's own, is undone after it."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

# How long threads that a policy has started may go on after the command [s].
_PATIENCE = 5.0


class ProcessState:
    """Working folder, streams, arguments, path, umask and recursion limit of this process, as now.

    Not the environment variables: a module may set those that its own libraries read later.
    """

    def __init__(self) -> None:
        try:
            self._folder: str | None = os.getcwd()
        except OSError:  # it has been removed
            self._folder = None
        self._arguments, self._path = list(sys.argv), list(sys.path)
        self._streams = sys.stdout, sys.stderr
        self._depth = sys.getrecursionlimit()
        self._umask = _umask()

    def restore(self) -> None:
        """Put back what is another by now."""
        sys.setrecursionlimit(max(self._depth, sys.getrecursionlimit()))
        sys.argv[:] = self._arguments
        # What was added may be needed by what was imported.
        sys.path += [place for place in self._path if place not in sys.path]
        sys.stdout, sys.stderr = self._streams
        if _umask() != self._umask:
            os.umask(self._umask)
        if self._folder is not None:
            with contextlib.suppress(OSError):
                os.chdir(self._folder)


@contextmanager
def undone() -> Iterator[None]:
    """Restore the state of the process at the end of a block."""
    state = ProcessState()
    try:
        yield
    finally:
        state.restore()


@contextmanager
def no_exit() -> Iterator[None]:
    """Let `os._exit`, which ends a process with no word to anybody, raise SystemExit in this one.

    A run that a policy ends so would pass, with the status 0, for one that is complete.
    """
    owner, real = os.getpid(), os._exit

    def leave(status: int) -> NoReturn:
        if os.getpid() == owner:
            raise SystemExit(status)
        real(status)

    changed: Any = os
    changed._exit = leave
    try:
        yield
    finally:
        changed._exit = real


def end_with_threads(status: int) -> None:
    """See that the process ends, with its status, even if threads that a policy started do not."""
    own = threading.main_thread()
    if all(one is own or one.daemon for one in threading.enumerate()):
        return

    def end() -> None:
        time.sleep(_PATIENCE)
        os._exit(status)

    threading.Thread(target=end, daemon=True).start()


def _umask() -> int:
    # It cannot be read but by setting it.
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
