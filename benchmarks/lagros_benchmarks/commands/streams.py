"""Printing that fails takes nothing else with it.

A pipe whose reader has gone, a terminal without the letters of a table and a full disk behind a
redirection are no reason to end a run or to leave out its files. Inside `patient_streams` nothing
that is printed raises, and in the end the exit status says that it was lost.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO


class _Patient(io.BufferedIOBase):
    """Bytes to a stream that may fail; the first error is kept.

    Args:
        stream: Takes the bytes; None if the process was started without it.
        kept: Collects what is written.
    """

    def __init__(self, stream: Any, kept: bytearray | None = None) -> None:
        # Unbuffered: what waits in a buffer would fail once more when Python ends.
        self._stream = getattr(stream, "raw", stream)
        self._kept = kept
        self.error: OSError | None = None

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        return self._stream is not None and bool(self._stream.isatty())

    def fileno(self) -> int:
        if self._stream is None:
            raise io.UnsupportedOperation("fileno")
        return int(self._stream.fileno())

    def write(self, data: Any) -> int:
        content = bytes(data)
        if self._kept is not None:
            self._kept += content
        if self.error is None:
            try:
                self._pass_on(content)
            except OSError as error:
                self.error = error
            except ValueError as error:  # somebody has closed it
                self.error = OSError(errno.EBADF, str(error))
        return len(content)

    def _pass_on(self, content: bytes) -> None:
        if self._stream is None:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        left = memoryview(content)
        while left:
            taken = self._stream.write(left)
            if taken is None:  # a terminal that is set not to block
                time.sleep(0.01)
                continue
            left = left[taken:]
        self._stream.flush()


def printing_failed() -> OSError | None:
    """Return why what was printed has not arrived; None if it has, or if this is no command."""
    buffer = getattr(sys.stdout, "buffer", None)
    return buffer.error if isinstance(buffer, _Patient) else None


@contextlib.contextmanager
def patient_streams() -> Iterator[None]:
    """Let nothing raise that is printed, and end with status 1 if it did not arrive.

    What was to be printed is then kept in a temporary folder, which is named on the error stream.
    Only where a pipe's reader has gone nothing is said: that is how `| head` ends a command.
    """
    _open_closed()
    before = sys.stdout, sys.stderr
    kept = bytearray()
    sys.stdout, sys.stderr = _patient(sys.stdout, kept), _patient(sys.stderr)
    try:
        yield
    except SystemExit as ending:
        problem = printing_failed()
        if problem is None:
            raise
        if problem.errno != errno.EPIPE:
            reason = f"{problem.strerror or problem}; {_keep(bytes(kept))}"
            sys.stderr.write(f"lagros: cannot print: {reason}\n")
        raise SystemExit(ending.code or 1) from None
    finally:
        sys.stdout, sys.stderr = before


def _patient(stream: Any, kept: bytearray | None = None) -> TextIO:
    """Return a text stream in the place of another; of letters that it lacks it makes a "?"."""
    if stream is not None and not hasattr(stream, "buffer"):
        text: TextIO = stream  # no file, as in a notebook
        return text
    if stream is not None:
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    buffer: Any = _Patient(getattr(stream, "buffer", None), kept)
    return io.TextIOWrapper(
        buffer, getattr(stream, "encoding", None) or "utf-8", "replace", write_through=True
    )


def _keep(text: bytes) -> str:
    try:
        path = Path(tempfile.mkdtemp(prefix="lagros-")) / "printed.txt"
        path.write_bytes(text)
    except OSError:
        return "there is no room in the temporary folder either"
    return f"it is kept as {path}"


def _open_closed() -> None:
    """Open the standard streams that the process was started without.

    The next file that is opened would take the place of one, and what is printed would go there.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            # For the processes that we start, too.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
