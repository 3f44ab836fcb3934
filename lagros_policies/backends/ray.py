"""Chunks of work as tasks of Ray.

A result lies outside the process that made it as soon as the task is done, so that a worker process
that dies takes nothing with it but what it was running. A whole machine of the cluster that goes
takes more: what its processes were running, and those of their results over 100 KiB that nobody had
fetched yet.

Also where it is started on this machine alone, Ray's processes listen on every network that the
machine is on, and execute what they are sent: behind no firewall take loky or Dask.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from lagros_policies.backends.base import (
    ATTEMPTS,
    BackendError,
    Item,
    Outcome,
    gave_up,
    installed,
    knock,
    sheltered,
)


def run(
    ray: Any,
    work: Callable[[Item], Outcome],
    items: Sequence[Item],
    on_lost: Callable[[int], None],
) -> Iterator[tuple[int, Outcome]]:
    """Yield index and result of every item, as `backends.each` does.

    Raises:
        BackendError: A chunk lost too many workers.
    """
    errors = ray.exceptions
    losses = (
        errors.WorkerCrashedError,
        errors.NodeDiedError,
        errors.ObjectLostError,
        errors.OutOfMemoryError,
    )
    # We run again what is lost: Ray would do it in silence.
    remote = ray.remote(max_retries=0)(sheltered)
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
                    raise gave_up(attempt, error) from error
                begun[remote.remote(shared, items[index])] = index, attempt + 1
                on_lost(1)
                continue
            except errors.RayTaskError as error:
                raise error.cause from error
            yield index, outcome
    finally:
        for reference in begun:
            ray.cancel(reference, force=True)


@contextmanager
def connected(address: str | None, jobs: int) -> Iterator[Any]:
    """Connect to a cluster, or start Ray on this machine, and yield the module.

    Args:
        address: Of the cluster; None starts Ray here.
        jobs: Worker processes, where it is started here.

    Raises:
        BackendError: Ray is not installed, does not answer or does not start.
    """
    # Nobody asked for Ray's telemetry.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray = installed("ray")
    if ray.is_initialized():
        yield ray
        return
    quiet = {"log_to_driver": False, "logging_level": logging.CRITICAL}
    try:
        if address is None:
            _start(ray, num_cpus=jobs, **quiet)
        else:
            if ":" in address.rpartition("//")[2]:  # not "auto", which Ray looks up by itself
                knock(address, speaks=True)
            ray.init(address=address, **quiet)
    except BackendError:
        raise
    except Exception as error:  # of many classes, where something else listens
        raise BackendError(
            f"no Ray cluster answers at {address!r} ({error}); start one with `ray start --head` "
            "and name it as auto, host:6379 or ray://host:10001, with RAY_AUTH_MODE=token if it "
            "has a token, or leave the address out to start workers on this machine"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _start(ray: Any, **settings: Any) -> None:
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
