"""What an exported file answers: C compiled and called, ONNX run by ONNX Runtime."""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from lagros_envs.arrays import Float32Array
from lagros_policies.export.c99 import observation_call
from lagros_policies.export.onnx import INSTALL
from lagros_policies.export.source import Source

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
# Called with many observations, so that the time of a call from Python does not count.
_MANY = """
void many(const float *observations, int count, float *answers);
void many(const float *observations, int count, float *answers)
{{
    int i;
    for (i = 0; i < count; i++)
        {call};
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
        text: The file, from `c_file`.
        source: The policy that it was made of.
        flags: Flags of the compiler, beside those for a shared library.

    Raises:
        FileNotFoundError: There is no C compiler.
        RuntimeError: The compiler refuses the file; the message is its own.

    Use as a context manager, or `close` it.
    """

    def __init__(self, text: str, source: Source, flags: Sequence[str] = (*STRICT, "-O2")) -> None:
        tool = compiler()
        if tool is None:
            raise FileNotFoundError("no C compiler (gcc, cc) is on the path; install one")
        self._folder = tempfile.TemporaryDirectory(prefix="lagros-export-")
        folder = Path(self._folder.name)
        inputs, outputs = source.program.inputs, source.program.control.size
        code, library = folder / "policy.c", folder / "policy.so"
        call = observation_call(source, f"observations + {inputs} * i", f"answers + {outputs} * i")
        code.write_text(text + _MANY.format(call=call))
        command = [tool, *flags, "-shared", "-fPIC", str(code), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            self.close()
            raise RuntimeError(f"{tool} refuses the exported file:\n{done.stderr}")
        self._inputs, self._outputs = inputs, outputs
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

    def answer(self, observation: Float32Array) -> Float32Array:
        """Return the controls, shape (B, m), of observations (B, o), one C call each."""
        rows = np.ascontiguousarray(observation, np.float32)
        if rows.ndim != 2 or rows.shape[1] != self._inputs:
            raise ValueError(f"observation has shape {rows.shape}; it must be (B, {self._inputs})")
        answers = np.empty((len(rows), self._outputs), np.float32)
        self._many(rows.ctypes.data, len(rows), answers.ctypes.data)
        return answers


def onnx_function(model: bytes) -> Callable[[Float32Array], Float32Array]:
    """Return ONNX Runtime's function of a model, on one thread: observations (B, o) to controls.

    Raises:
        ImportError: ONNX Runtime is not installed.
    """
    try:
        onnxruntime = importlib.import_module("onnxruntime")
    except ImportError as error:
        raise ImportError(f"running an ONNX file needs ONNX Runtime: {INSTALL}") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])

    def answer(observation: Float32Array) -> Float32Array:
        controls: Float32Array = session.run(None, {"observation": observation})[0]
        return controls

    return answer


def onnx_answer(model: bytes, observation: Float32Array) -> Float32Array:
    """Return the controls, shape (B, m), of observations (B, o); see `onnx_function`."""
    return onnx_function(model)(observation)


@dataclass(frozen=True)
class Agreement:
    """How far an export is from NumPy over some observations.

    Attributes:
        largest_difference: Largest |u - u_NumPy|; NaN where a control is NaN.
        largest: Largest |u_NumPy|.
    """

    largest_difference: float
    largest: float

    @property
    def relative(self) -> float:
        """The largest difference in units of the largest control.

        Near zero float32 cannot do better: terms of that size cancel.
        """
        return self.largest_difference / self.largest

    def __str__(self) -> str:
        return f"{self.largest_difference:.1e}, of controls up to {self.largest:.3g}"


def agreement(answers: Float32Array, source: Source, observation: Float32Array) -> Agreement:
    """Compare controls (B, m) with the NumPy policy's for (B, o)."""
    wanted = source.answer(observation).astype(np.float64)
    difference = np.abs(answers - wanted)
    return Agreement(float(np.max(difference)), float(np.max(np.abs(wanted))))


def check_c(text: str, source: Source, count: int = 1000) -> Agreement:
    """Compare a C file with NumPy over random observations; raises as `CompiledPolicy`."""
    observation = source.examples(count, seed=1)
    with CompiledPolicy(text, source) as compiled:
        return agreement(compiled.answer(observation), source, observation)


def check_onnx(model: bytes, source: Source, count: int = 1000) -> Agreement:
    """Compare an ONNX model with NumPy over random observations; raises as `onnx_answer`."""
    observation = source.examples(count, seed=1)
    return agreement(onnx_answer(model, observation), source, observation)
