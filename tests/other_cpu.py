"""Print the variables with which the numerical libraries take this processor for a plainer one.

    env $(python tests/other_cpu.py) python -m pytest

Sums and products are then rounded otherwise than before: what a test says must hold all the same.
"""

from __future__ import annotations

import ctypes
import os
import platform
from pathlib import Path

import numpy as np
from numpy._core import _multiarray_umath as core

# Kernels of OpenBLAS that every processor of the family can run, the plainest last.
KERNELS = {"x86_64": ("Nehalem", "Prescott"), "aarch64": ("ARMV8", "CORTEXA57")}
FAMILIES = {"AMD64": "x86_64", "arm64": "aarch64"}


def wide_features() -> list[str]:
    """Return what NumPy would use of this processor beyond what it needs; no other can be off."""
    return [name for name in core.__cpu_dispatch__ if core.__cpu_features__.get(name)]


def blas_kernel() -> str | None:
    """Return the kernel that NumPy's OpenBLAS uses in this process; None if it has none."""
    for library in (Path(np.__file__).parents[1] / "numpy.libs").glob("*openblas*"):
        for name in ("scipy_openblas_get_corename64_", "openblas_get_corename64_"):
            function = getattr(ctypes.CDLL(os.fspath(library)), name, None)
            if function is not None:
                function.restype = ctypes.c_char_p
                return str(function().decode())
    return None


def settings() -> dict[str, str]:
    """Return the variables; without a space in them, so that a shell can take them apart."""
    machine = platform.machine()
    used = (blas_kernel() or "").lower()
    kernels = KERNELS.get(FAMILIES.get(machine, machine), ())
    other = next((name for name in kernels if name.lower() != used), None)
    off = os.environ.get("NPY_DISABLE_CPU_FEATURES", "").replace(",", " ").split()
    return {
        **({} if other is None else {"OPENBLAS_CORETYPE": other}),
        "NPY_DISABLE_CPU_FEATURES": ",".join([*off, *wide_features()]),
        "ATEN_CPU_CAPABILITY": "default",  # torch
        "NUMBA_CPU_NAME": "generic",
    }


if __name__ == "__main__":
    print(*(f"{name}={value}" for name, value in settings().items()))
