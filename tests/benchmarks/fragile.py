"""Work that kills its own process, once or always, and writes down each time that it begins."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks import fakes


@dataclass
class Fragile:
    """Squares a number; where it is `deadly`, the process dies before the answer.

    Attributes:
        folder: Where beginnings and deaths are written down.
        deadly: The number at which the process kills itself.
        deaths: How often it does.
    """

    folder: Path
    deadly: int = -1
    deaths: int = 1

    def __call__(self, number):
        with (self.folder / "begun").open("a") as log:
            log.write(f"{number} {os.getpid()}\n")
        time.sleep(0.2)
        if number == self.deadly:
            die(self.folder, self.deaths)
        return number**2

    def begun(self):
        """Return the processes in which each number was begun, in their order."""
        processes = {}
        for line in (self.folder / "begun").read_text().splitlines():
            number, process = map(int, line.split())
            processes.setdefault(number, []).append(process)
        return processes


def die(folder, deaths=1):
    """Kill this process as the kernel does where memory runs out, unless it did so often enough."""
    for death in range(deaths):
        try:
            (folder / f"death_{death}").touch(exist_ok=False)
        except FileExistsError:
            continue
        os.kill(os.getpid(), signal.SIGKILL)


def refuse(number):
    if number == 2:
        raise ZeroDivisionError(f"number {number}")
    return number


def lasting(number):
    """Return when the work began and ended [s]."""
    begun = time.monotonic()
    time.sleep(0.05)
    return begun, time.monotonic()


@dataclass
class FragilePolicy(fakes.LinearPolicy):
    """Balances; once, in one episode of a worker, its process dies."""

    folder: Path = Path()
    main: int = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        late = observation[12] > 5.0 and observation[4] > 2.0
        if late and os.getpid() != self.main:
            die(self.folder)
        return super().predict(observation, state, episode_start, deterministic)


@dataclass
class MakeFragile:
    """The policies of the fakes, `steady` replaced by the fragile one."""

    folder: Path
    main: int

    def __call__(self, name, env, settings):
        if name == "steady":
            return FragilePolicy(folder=self.folder, main=self.main)
        return fakes.make_policy(name, env, settings)
