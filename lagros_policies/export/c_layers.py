"""Layers of a network as C99, laid out so that a compiler turns their loops into vectors.

A layer adds the rows of its matrix, each times one input, into as many sums as it has outputs:
loops that a compiler may vectorise without changing the result. Two things make them fast.
Four rows are added at a time, so that the sums are read and written once for them;
and outputs beyond a multiple of 16 (the longest vectors) have a matrix of their own, so that the
rows of the first stay aligned and both loops are unrolled whole.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from lagros_envs.arrays import Float32Array

Activation = Literal["none", "relu", "libm", "rational"]

# tanh(x) = x P(x^2) / Q(x^2) for |x| <= 9, where tanh(9) is 1 to half a unit of float32; constant
# beyond. Fitted by benchmarks/tuning/rational_tanh.py for the least largest relative error.
TANH_LIMIT = 9.0
TANH_P = (1.0, 0.13381027, 0.0034955884, 2.0609088e-05, 1.3354667e-08)
TANH_Q = (1.0, 0.46714342, 0.025876984, 0.00032856353, 7.7765606e-07)
# Relative; observed (3.81e-7) on every second float32 from 2^-20 to 16.
TANH_ERROR = 4e-7

VECTOR = 16  # floats in the longest vector of a processor in use
_ROWS = 4  # that are added at a time
# Sums of a single output, kept apart so that they can be formed side by side.
_LANES = (20, 16, 8, 4, 2, 1)


def layer(
    name: str, weight: Float32Array, bias: Float32Array | None, activation: Activation
) -> str:
    """Return the weights of a layer and `static void NAME(const float *input, float *output)`.

    Args:
        name: Of the function, and the beginning of the names of its arrays.
        weight: Shape (inputs, outputs).
        bias: Shape (outputs,); None where the function takes it, `const float *bias`, after its
            input.
        activation: What follows. "rational" calls `rational_tanh`, of `rational_tanh_source`, and
            "libm" `tanhf`; "relu" gives NaN for NaN.
    """
    narrow = weight.shape[1] < VECTOR and weight.shape[0] > weight.shape[1]
    arrays, lines = (_narrow if narrow else _wide)(name, weight)
    if bias is not None:
        arrays.append(array(f"{name}_bias", bias))
        lines = [line.replace("bias[", f"{name}_bias[") for line in lines]
    given = ", const float *restrict bias" if bias is None else ""
    return "\n".join(
        [
            *arrays,
            f"static void {name}(const float *restrict input{given}, float *restrict output)",
            "{",
            *lines,
            *_activation(activation, weight.shape[1]),
            "}",
            "",
        ]
    )


def _wide(name: str, weight: Float32Array) -> tuple[list[str], list[str]]:
    """Return arrays and lines of a layer of many outputs: the rows of its matrix, added up."""
    inputs, outputs = weight.shape
    split = outputs - outputs % VECTOR
    # Of each part: what its names end with, its width and its first output.
    parts = [("", split, 0), ("_rest", outputs - split, split)]
    parts = [part for part in parts if part[1]]
    arrays = [
        array(f"{name}_weight{end}", weight[:, first : first + width])
        for end, width, first in parts
    ]
    sums = ", ".join(f"sum{end}[{width}]" for end, width, _ in parts)
    whole = inputs - inputs % _ROWS
    lines = [
        *(f"    const float *restrict row{end} = {name}_weight{end};" for end, _, _ in parts),
        f"    float {sums};",
        "    int i, j;" if whole else "    int j;",
    ]
    for end, width, first in parts:
        lines += [_loop(width), f"        sum{end}[j] = bias[{_index('j', first)}];"]
    if whole:
        steps = ", ".join(f"row{end} += {_ROWS * width}" for end, width, _ in parts)
        lines.append(f"    for (i = 0; i < {whole}; i += {_ROWS}, {steps}) {{")
        for end, width, _ in parts:
            terms = _terms(end, width, [_index("i", row) for row in range(_ROWS)])
            lines += [f"    {_loop(width)}", f"            sum{end}[j] += {terms};"]
        lines.append("    }")
    if inputs > whole:
        for end, width, _ in parts:
            terms = _terms(end, width, [str(row) for row in range(whole, inputs)])
            lines += [_loop(width), f"        sum{end}[j] += {terms};"]
    for end, width, first in parts:
        lines += [_loop(width), f"        output[{_index('j', first)}] = sum{end}[j];"]
    return arrays, lines


def _loop(count: int) -> str:
    return f"    for (j = 0; j < {count}; j++)"


def _terms(end: str, width: int, inputs: list[str]) -> str:
    """Return the sum of the next rows, each times its input."""
    rows = (_index("j", place * width) for place in range(len(inputs)))
    return " + ".join(
        f"input[{one}] * row{end}[{row}]" for one, row in zip(inputs, rows, strict=True)
    )


def _narrow(name: str, weight: Float32Array) -> tuple[list[str], list[str]]:
    """Return a layer of few outputs: for each a product of its column and the inputs."""
    inputs, outputs = weight.shape
    lanes = next(count for count in _LANES if inputs % count == 0)
    lines = [
        f"    const float *restrict column = {name}_weight;",
        "    int i, j, k;",
        f"    for (k = 0; k < {outputs}; k++, column += {inputs}) {{",
        f"        float sums[{lanes}] = {{0.0f}};",
        "        float sum = bias[k];",
        f"        for (i = 0; i < {inputs}; i += {lanes})",
        f"            for (j = 0; j < {lanes}; j++)",
        "                sums[j] += input[i + j] * column[i + j];",
        f"        for (j = 0; j < {lanes}; j++)",
        "            sum += sums[j];",
        "        output[k] = sum;",
        "    }",
    ]
    return [array(f"{name}_weight", weight.T)], lines


def _activation(activation: Activation, outputs: int) -> list[str]:
    head = f"    for (j = 0; j < {outputs}; j++)"
    if activation == "relu":
        return [head, "        output[j] = output[j] < 0.0f ? 0.0f : output[j];"]
    if activation == "libm":
        return [head, "        output[j] = tanhf(output[j]);"]
    if activation == "rational":
        limit = literal(TANH_LIMIT)
        return [
            "    /* Loops of their own: in one, compilers take branches instead of vectors. */",
            head,
            f"        output[j] = output[j] > {limit} ? {limit} : output[j];",
            head,
            f"        output[j] = output[j] < -{limit} ? -{limit} : output[j];",
            head,
            "        output[j] = rational_tanh(output[j]);",
        ]
    return []


def rational_tanh_source() -> str:
    """Return `rational_tanh`, for arguments up to `TANH_LIMIT` in size."""
    return f"""static inline float rational_tanh(float x)
{{
    const float s = x * x;
    return x * ({_horner(TANH_P)}) / ({_horner(TANH_Q)});
}}
"""


def _horner(coefficients: tuple[float, ...]) -> str:
    text = literal(coefficients[-1])
    for value in coefficients[-2::-1]:
        text = f"{literal(value)} + s * ({text})"
    return text


def _index(variable: str, offset: int) -> str:
    return f"{variable} + {offset}" if offset else variable


def array(name: str, values: Float32Array) -> str:
    """Return the definition of an array, its numbers in rows of six."""
    texts = [literal(float(value)) for value in values.ravel()]
    rows = (", ".join(texts[begin : begin + 6]) for begin in range(0, len(texts), 6))
    return f"static const float {name}[{len(texts)}] = {{\n    " + ",\n    ".join(rows) + "};\n"


def literal(value: float) -> str:
    """Return a float32 as a C99 hexadecimal constant, which every compiler reads exactly."""
    mantissa, exponent = float(np.float32(value)).hex().split("p")
    return f"{mantissa.rstrip('0').removesuffix('.')}p{exponent}f"
