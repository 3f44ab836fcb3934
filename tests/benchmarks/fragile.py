"""Work that kills its own process, once or always, and writes down each time that it begins."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from lagros_policies.backends.loky import THREAD_LIMITS
from tests.benchmarks import fakes


@dataclass
class Fragile:
    """Squares a number, or makes bytes of it; where it is `deadly`, the process dies before.

    Attributes:
        folder: Where beginnings and deaths are written down.
        deadly: The number at which the process kills itself.
        deaths: How often it does.
        lasting: How long each number takes [s].
        bulk: How many bytes are made; 0 squares.
    """

    folder: Path
    deadly: int = -1
    deaths: int = 1
    lasting: float = 0.2
    bulk: int = 0

    def __call__(self, number):
        with (self.folder / "begun").open("a") as log:
            log.write(f"{number} {os.getpid()}\n")
        time.sleep(self.lasting)
        if number == self.deadly:
            die(self.folder, self.deaths)
        return bytes([number % 256]) * self.bulk if self.bulk else number**2

    def log(self):
        """Return every beginning as (number, process), in their order."""
        path = self.folder / "begun"
        lines = path.read_text().splitlines() if path.exists() else []
        return [tuple(map(int, line.split())) for line in lines]

    def begun(self):
        """Return the processes in which each number was begun, in their order."""
        processes = {}
        for number, process in self.log():
            processes.setdefault(number, []).append(process)
        return processes


@dataclass
class Endless(Fragile):
    """Answers 0 at once, raises for 1 soon, and outlasts every test for others."""

    lasting: float = 0.0

    def __call__(self, number):
        super().__call__(number)
        if number == 1:
            time.sleep(1.0)
            raise ZeroDivisionError("number 1")
        time.sleep(600.0 if number else 0.0)
        return number


@dataclass
class Tearing:
    """Answers with some bytes; once, for the number 3, the process dies in the middle of them."""

    folder: Path

    def __call__(self, number):
        first = self.folder / "torn"
        if number == 3 and not first.exists():
            first.touch()
            Connection._send = send_half
        return bytes([number]) * 1000


def send_half(connection, message):
    os.write(connection.fileno(), bytes(message)[: len(message) // 2])
    os.kill(os.getpid(), signal.SIGKILL)


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


class AwkwardError(Exception):
    """An exception that can be pickled, and not read back."""

    def __init__(self, number, why):
        super().__init__(f"{number} is {why}")


def be_awkward(number):
    raise AwkwardError(number, "odd")


def leave(number):
    raise SystemExit(0)


def close(number):
    raise GeneratorExit


def say(number):
    sys.stdout.write("said\n")
    sys.stdout.flush()


def safe_path(number):
    return os.environ.get("PYTHONSAFEPATH")


def process(number):
    time.sleep(0.1)
    return os.getpid()


def limits(number):
    return {name: os.environ.get(name) for name in THREAD_LIMITS}


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
