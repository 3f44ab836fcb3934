"""What a run ran on: machine, versions, threads and command, for its rows."""

from __future__ import annotations

import os
import platform
import sys
from functools import cache
from importlib import metadata
from typing import Any

_PACKAGES = (
    "lagros",
    "numpy",
    "scipy",
    "gymnasium",
    "torch",
    "piqp",
    "clarabel",
    "stable-baselines3",
)
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def machine() -> dict[str, Any]:
    """Return what the run ran on."""
    return {
        # Not platform.platform(): the release of a kernel may name its host.
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cpu_count": os.cpu_count(),
        "cpus_usable": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
    }


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that bear on results."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def threads() -> dict[str, Any]:
    """Return the thread settings of this process, which are read and never changed.

    Set them by environment variables before the start: `OMP_NUM_THREADS=1 lagros bench ...`.
    """
    found: dict[str, Any] = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    # Asking torch must not import it.
    torch = sys.modules.get("torch")
    found["torch"] = None if torch is None else torch.get_num_threads()
    return found


def own_command() -> list[str]:
    """Return the command line of this process, without the folder of the program."""
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    # `python -m lagros_benchmarks` is the same command under the name of its file.
    return ["lagros" if name == "__main__.py" else name, *sys.argv[1:]]


@cache
def _processor() -> str:
    # platform.processor() is empty or only the architecture on Linux.
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as stream:
            for line in stream:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
