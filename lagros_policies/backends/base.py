"""What every backend shares: its name and address, its errors, what is said of lost chunks."""

from __future__ import annotations

import importlib
import logging
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from lagros_envs.checks import check_fields, shown, suggestion

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

BACKENDS = ("loky", "ray", "dask")
# How often a chunk may lose its worker: what kills so many (too little memory, say) will go on.
ATTEMPTS = 4
# How long a cluster may take to answer the first time [s].
PATIENCE = 10.0
# What keeps Python from searching the folder that it is started in.
SAFE_PATH = "PYTHONSAFEPATH"

_LOG = logging.getLogger(__name__)


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
        check_fields(self)
        if self.name not in BACKENDS:
            hint = suggestion(self.name, BACKENDS)
            raise ValueError(
                f"unknown backend {shown(self.name)}.{hint} Valid: {', '.join(BACKENDS)}."
            )
        if self.name == "loky" and self.address is not None:
            raise ValueError(
                f"address={shown(self.address)} is for a cluster of ray or dask; leave it out for "
                "loky, whose workers run on this machine"
            )

    def in_parallel(self, jobs: int) -> bool:
        """Return whether chunks run in other processes than this one."""
        return jobs > 1 or self.name != "loky"


LOKY = Backend()


@contextmanager
def without_folder() -> Iterator[None]:
    """Let the interpreters that are started here not look for modules in the folder we are in.

    They would do so first, before the search path of this process reaches them: a file there that
    is called as one of Python's own modules would run in its place.
    """
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before


def sheltered(work: Callable[[Item], Outcome], item: Item) -> Outcome:
    """Do the work in a worker, where an exit that it asks for must not end the process.

    Raises:
        RuntimeError: The work asked to end the process, or was ended in another odd way.
    """
    try:
        return work(item)
    except (Exception, KeyboardInterrupt):
        raise
    except BaseException as error:  # SystemExit(0) would end the whole run with status 0
        raise RuntimeError(f"{type(error).__name__}: {error}") from error


def say_lost(chunks: int) -> None:
    """Log that so many chunks lost their worker and are run again."""
    _LOG.warning("a worker died: %d chunk(s) of work are run again", chunks)


def gave_up(deaths: int, error: Exception) -> BackendError:
    """Return the error that ends a run whose chunk lost so many workers."""
    return BackendError(
        f"a chunk of work lost its worker {deaths} times ({type(error).__name__}); most often the "
        "memory is too small: take fewer jobs; or what it runs ends its own process"
    )


def installed(module: str) -> Any:
    """Import what a backend needs.

    Raises:
        BackendError: It is not installed.
    """
    extra = "dask" if module == "distributed" else module
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise BackendError(
            f"the backend {extra} is not installed; pip install 'lagros[{extra}]'"
        ) from error


def knock(address: str, speaks: bool) -> None:
    """Raise at once where no cluster listens: Ray and Dask themselves go on asking, up to minutes.

    Args:
        address: host:port, or scheme://host:port.
        speaks: Whether a cluster says something there before it is asked.

    Raises:
        ValueError: That is no such address.
        OSError: Nothing listens there, or it says nothing.
    """
    host, colon, port = address.rpartition("//")[2].rpartition(":")
    if not (colon and host and port.isdecimal()):
        raise ValueError("it must be host:port")
    with socket.create_connection((host.strip("[]"), int(port)), timeout=PATIENCE) as line:
        try:
            silent = speaks and not line.recv(1)
        except TimeoutError:
            silent = True
    if silent:
        raise OSError("what listens there is something else")
