"""What an exported file answers: C compiled and called, ONNX run by ONNX Runtime."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from lagros_policies.export.source import NetworkSource, example_observations

Float32Array = NDArray[np.float32]

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
# Called with many observations, so that the time of a call from Python does not count.
_MANY = """
void many(const float *observations, int count, float *forces);
void many(const float *observations, int count, float *forces)
{{
    int i;
    for (i = 0; i < count; i++)
        forces[i] = {function}_observation(observations + 13 * i);
}}
"""


def compiler() -> str | None:
    """Return the C compiler on the path, gcc before cc; None where there is none."""
    return shutil.which("gcc") or shutil.which("cc")


def has_onnxruntime() -> bool:
    """Return whether ONNX Runtime is installed."""
    return importlib.util.find_spec("onnxruntime") is not None


class CompiledPolicy:
    """The C file of a policy as a function, compiled into a temporary folder.

    Args:
        text: The file, from `c_source`.
        source: The policy that it was made of.
        flags: Flags of the compiler, beside those for a shared library.

    Raises:
        FileNotFoundError: There is no C compiler.
        RuntimeError: The compiler refuses the file; the message is its own.

    Use as a context manager, or `close` it.
    """

    def __init__(
        self, text: str, source: NetworkSource, flags: Sequence[str] = (*STRICT, "-O2")
    ) -> None:
        """Compile and load."""
        tool = compiler()
        if tool is None:
            raise FileNotFoundError("no C compiler (gcc, cc) is on the path; install one")
        self._folder = tempfile.TemporaryDirectory(prefix="lagros-export-")
        folder = Path(self._folder.name)
        code, library = folder / "policy.c", folder / "policy.so"
        code.write_text(text + _MANY.format(function=source.name.replace("-", "_")))
        command = [tool, *flags, "-shared", "-fPIC", str(code), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            self.close()
            raise RuntimeError(f"{tool} refuses the exported file:\n{done.stderr}")
        self._many = ctypes.CDLL(str(library)).many
        self._many.restype = None
        self._many.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p]

    def __enter__(self) -> CompiledPolicy:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Remove the temporary folder; the loaded function stays usable."""
        self._folder.cleanup()

    def force(self, observation: Float32Array) -> Float32Array:
        """Return the force [N], shape (B,), of observations (B, 13), one C call each."""
        rows = np.ascontiguousarray(observation, np.float32)
        if rows.ndim != 2 or rows.shape[1] != 13:
            raise ValueError(f"observation has shape {rows.shape}; it must be (B, 13)")
        forces = np.empty(len(rows), np.float32)
        self._many(rows.ctypes.data, len(rows), forces.ctypes.data)
        return forces


def onnx_force(model: bytes, observation: Float32Array) -> Float32Array:
    """Return the force [N], shape (B,), that ONNX Runtime gives for observations (B, 13).

    Raises:
        ImportError: ONNX Runtime is not installed.
    """
    try:
        onnxruntime = importlib.import_module("onnxruntime")
    except ImportError as error:
        raise ImportError(
            "running an ONNX file needs ONNX Runtime: pip install onnxruntime"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    answer: Float32Array = session.run(["force"], {"observation": observation})[0]
    return answer[:, 0]


@dataclass(frozen=True)
class Agreement:
    """How far an export is from NumPy over some observations.

    Attributes:
        largest_difference: Largest |u - u_NumPy| [N]; NaN where a force is NaN.
        largest_force: Largest |u_NumPy| [N].
    """

    largest_difference: float
    largest_force: float

    @property
    def relative(self) -> float:
        """The largest difference in units of the largest force.

        Near a force of zero float32 cannot do better: terms of that size cancel.
        """
        return self.largest_difference / self.largest_force

    def __str__(self) -> str:
        return f"{self.largest_difference:.1e} N at forces up to {self.largest_force:.1f} N"


def agreement(forces: Float32Array, source: NetworkSource, observation: Float32Array) -> Agreement:
    """Compare forces (B,) [N] with those of the NumPy policy for observations (B, 13)."""
    wanted = source.force(observation).astype(np.float64)
    return Agreement(float(np.max(np.abs(forces - wanted))), float(np.max(np.abs(wanted))))


def check_c(text: str, source: NetworkSource, count: int = 1000) -> Agreement:
    """Compare a C file with NumPy over random observations; raises as `CompiledPolicy`."""
    observation = example_observations(count, seed=1)
    with CompiledPolicy(text, source) as compiled:
        return agreement(compiled.force(observation), source, observation)


def check_onnx(model: bytes, source: NetworkSource, count: int = 1000) -> Agreement:
    """Compare an ONNX model with NumPy over random observations; raises as `onnx_force`."""
    observation = example_observations(count, seed=1)
    return agreement(onnx_force(model, observation), source, observation)
