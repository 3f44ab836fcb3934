"""What an exported file costs: time of one call on this machine, bytes of code, RAM and stack."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lagros_envs.arrays import Float32Array
from lagros_policies.export.check import CompiledPolicy, compiler, onnx_function
from lagros_policies.export.source import Source

# What runs anywhere.
PLAIN = ("-std=c99", "-O2")
_ROUNDS = 21
_CALLS = 200


@dataclass(frozen=True)
class Footprint:
    """Bytes of a compiled C file.

    Attributes:
        code: Code and constants, the weights among them [B].
        ram: Variables that outlive a call [B].
        stack: Sum over all functions: what a call could need were none inlined into another [B].
    """

    code: int
    ram: int
    stack: int

    def __str__(self) -> str:
        return f"code and weights {self.code} B, RAM {self.ram} B, stack at most {self.stack} B"


def footprint(text: str, flags: Sequence[str] = PLAIN) -> Footprint:
    """Return the bytes of a C file, compiled with these flags for this machine.

    Raises:
        FileNotFoundError: There is no compiler, or no `size` (of binutils).
        RuntimeError: The compiler refuses the file or does not tell of the stack; or `size` is not
            that of binutils.
    """
    tool, size = compiler(), shutil.which("size")
    if tool is None or size is None:
        raise FileNotFoundError("bytes need gcc and size (binutils) on the path")
    with tempfile.TemporaryDirectory(prefix="lagros-export-") as folder:
        code, built = Path(folder) / "policy.c", Path(folder) / "policy.o"
        code.write_text(text)
        try:
            _tell(tool, *flags, "-fstack-usage", "-c", str(code), "-o", str(built))
            names, numbers = (line.split() for line in _tell(size, str(built)).splitlines()[:2])
            usage = built.with_suffix(".su").read_text().splitlines()
        except (subprocess.CalledProcessError, OSError, ValueError) as error:
            raise RuntimeError(f"{tool} and {size} do not tell the bytes: {error}") from error
    if names[:3] != ["text", "data", "bss"]:
        raise RuntimeError(f"{size} is not that of binutils")
    constant, data, zero = map(int, numbers[:3])
    return Footprint(constant, data + zero, sum(int(line.split("\t")[1]) for line in usage))


def _tell(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def c_time(text: str, source: Source, flags: Sequence[str] = PLAIN) -> tuple[float, float]:
    """Return the times of one call of a C file and of NumPy's `predict` [s].

    Raises:
        FileNotFoundError: There is no compiler.
        RuntimeError: The compiler refuses the file.
    """
    rows = source.examples(_CALLS)
    with CompiledPolicy(text, source, flags) as compiled:
        return _by_turns(lambda: compiled.answer(rows), source, rows)


def onnx_time(model: bytes, source: Source) -> tuple[float, float]:
    """Return the times of one call of ONNX Runtime and of NumPy's `predict` [s].

    Raises:
        ImportError: ONNX Runtime is not installed.
    """
    rows = source.examples(_CALLS)
    answer = onnx_function(model)
    return _by_turns(lambda: [answer(rows[i : i + 1]) for i in range(_CALLS)], source, rows)


def _by_turns(
    export: Callable[[], object], source: Source, rows: Float32Array
) -> tuple[float, float]:
    """Return medians over rounds in which both take their turn, of processor time."""

    def predict() -> None:
        for row in rows:
            source.policy.predict(row)

    times = np.empty((_ROUNDS, 2))
    for taken in times:
        for place, work in enumerate((export, predict)):
            begun = time.process_time()
            work()
            taken[place] = (time.process_time() - begun) / _CALLS
    ours, numpys = np.median(times, axis=0)
    return float(ours), float(numpys)
