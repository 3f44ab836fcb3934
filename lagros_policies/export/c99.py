"""A cart-pole policy as one C99 file: weights, features, mirror, no dependency but `tanhf`.

A layer adds the rows of its matrix, each times one input, into as many sums as it has outputs:
the order of memory, and a loop that compilers turn into vector instructions without being allowed
to change the result.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from lagros_policies.export.source import NetworkSource, example_observations

Float32Array = NDArray[np.float32]
Tanh = Literal["libm", "rational"]
TANHS: tuple[str, ...] = get_args(Tanh)

# tanh(x) = x P(x^2) / Q(x^2) for |x| <= 9, where tanh(9) is 1 to half a unit of float32; constant
# beyond. Fitted by benchmarks/tuning/rational_tanh.py for the least largest relative error.
TANH_LIMIT = 9.0
TANH_P = (1.0, 0.13381027, 0.0034955884, 2.0609088e-05, 1.3354667e-08)
TANH_Q = (1.0, 0.46714342, 0.025876984, 0.00032856353, 7.7765606e-07)
# Relative; observed (3.81e-7) on every second float32 from 2^-20 to 16.
TANH_ERROR = 4e-7

_SAMPLES = 8  # of the self-test
# Sums of a single output, kept apart so that they can be formed side by side.
_LANES = (20, 16, 8, 4, 2, 1)


def c_source(source: NetworkSource, tanh: Tanh = "libm") -> str:
    """Return the C99 file of a policy.

    It defines `float NAME_force(state, goal, initial_state, time)` and
    `float NAME_observation(observation)`, both [N], with NAME the policy's, and with
    -DLAGROS_SELF_TEST a `main` that compares with stored forces. Weights are `static const float`;
    nothing is allocated, nothing is kept between calls.

    Args:
        source: The policy.
        tanh: "libm" calls `tanhf`; "rational" is a quotient of two polynomials, several times
            faster, within `TANH_ERROR` of tanh, relative.

    Raises:
        ValueError: `tanh` is unknown.
    """
    if tanh not in TANHS:
        raise ValueError(f"tanh={tanh!r} must be one of {', '.join(TANHS)}")
    name = source.name.replace("-", "_")
    parts = [
        _header(source, name, tanh),
        _tanh(tanh) if len(_widths(source)) > 2 else "",
        *_weights(source),
        _network(source),
        _interface(name),
        _self_test(source, name),
    ]
    return "\n".join(parts)


def _header(source: NetworkSource, name: str, tanh: Tanh) -> str:
    shape = "-".join(str(width) for width in _widths(source))
    libm = (
        "tanhf of libm: link with -lm"
        if tanh == "libm"
        else f"rational, within {TANH_ERROR:.0e} of tanh, relative; no library"
    )
    return f"""/*
 * {source.name}: the force of a cart-pole policy. C99, one file, no heap, no state.
 *
 *     float {name}_force(const float state[4], const float goal[4],
 *                        const float initial_state[4], float time);
 *     float {name}_observation(const float observation[13]);
 *
 * state          x = [position m, angle rad, velocity m/s, angular rate rad/s], angle 0 upright
 * goal           x_f, the same units; only its position is read
 * initial_state  x(0) of the episode; only its position and angle are read
 * time           since the start of the episode [s]
 * observation    the four above in a row, as lagros/CartPole-v0 gives them
 * returns        the force on the cart [N], not saturated; hold it for one control step of 0.1 s
 *
 * Network: {shape}, tanh between the layers. tanh: {libm}.
 * Weights: {source.file}, SHA-256
 *     {source.digest}
 * Self-test: cc -std=c99 -O2 -DLAGROS_SELF_TEST THIS_FILE -lm && ./a.out
 * Written by `lagros export`; do not edit.
 */
float {name}_force(const float state[4], const float goal[4],
                   const float initial_state[4], float time);
float {name}_observation(const float observation[13]);
"""


def _tanh(tanh: Tanh) -> str:
    if tanh == "libm":
        return "#include <math.h>\n#define LAGROS_TANH tanhf\n"
    limit = _literal(TANH_LIMIT)
    return f"""static float rational_tanh(float value)
{{
    const float below = value > {limit} ? {limit} : value;
    const float x = below < -{limit} ? -{limit} : below;
    const float s = x * x;
    return x * ({_horner(TANH_P)}) / ({_horner(TANH_Q)});
}}
#define LAGROS_TANH rational_tanh
"""


def _horner(coefficients: tuple[float, ...]) -> str:
    text = _literal(coefficients[-1])
    for value in coefficients[-2::-1]:
        text = f"{_literal(value)} + s * ({text})"
    return text


def _weights(source: NetworkSource) -> list[str]:
    network = source.network
    parts = []
    for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        parts.append(_array(f"weight{index}", weight))
        parts.append(_array(f"bias{index}", bias))
    return parts


def _network(source: NetworkSource) -> str:
    widths = _widths(source)
    layers = [_layer(index, *widths[index : index + 2]) for index in range(len(widths) - 2)]
    last = len(layers)
    calls = [f"    layer{index}(layer_{index}, layer_{index + 1});" for index in range(last)]
    memory = [f"    float layer_{index + 1}[{widths[index + 1]}];" for index in range(last)]
    lanes = next(count for count in _LANES if widths[-2] % count == 0)
    lines = [
        *layers,
        "static float network(const float *layer_0)",
        "{",
        *memory,
        f"    float sums[{lanes}] = {{0.0f}};",
        f"    float sum = bias{last}[0];",
        "    int i, j;",
        *calls,
        f"    for (i = 0; i < {widths[-2]}; i += {lanes})",
        f"        for (j = 0; j < {lanes}; j++)",
        f"            sums[j] += layer_{last}[i + j] * weight{last}[i + j];",
        f"    for (j = 0; j < {lanes}; j++)",
        "        sum += sums[j];",
        "    return sum;",
        "}",
        "",
    ]
    return "\n".join(lines)


def _layer(index: int, inputs: int, outputs: int) -> str:
    return f"""static void layer{index}(const float *restrict input, float *restrict output)
{{
    const float *restrict row = weight{index};
    float sum[{outputs}];
    int i, j;
    for (j = 0; j < {outputs}; j++)
        sum[j] = bias{index}[j];
    for (i = 0; i < {inputs}; i++, row += {outputs}) {{
        const float value = input[i];
        for (j = 0; j < {outputs}; j++)
            sum[j] += value * row[j];
    }}
    for (j = 0; j < {outputs}; j++)
        output[j] = LAGROS_TANH(sum[j]);
}}
"""


def _interface(name: str) -> str:
    return f"""float {name}_force(const float state[4], const float goal[4],
                   const float initial_state[4], float time)
{{
    /* An episode that starts leaning left is the mirror image of one that starts leaning right. */
    const float side = initial_state[1] < 0.0f ? -1.0f : 1.0f;
    float features[7];
    features[0] = side * (state[0] - goal[0]);
    features[1] = side * state[1];
    features[2] = side * state[2];
    features[3] = side * state[3];
    features[4] = side * (goal[0] - initial_state[0]);
    features[5] = side * initial_state[1];
    features[6] = time;
    return side * network(features);
}}

float {name}_observation(const float observation[13])
{{
    return {name}_force(observation, observation + 4, observation + 8, observation[12]);
}}
"""


def _self_test(source: NetworkSource, name: str) -> str:
    observations = example_observations(_SAMPLES)
    forces = source.force(observations)
    return f"""#ifdef LAGROS_SELF_TEST
#include <stdio.h>

/* Forces by NumPy in float32; another order of summation moves them in the last digits. */
{_array("test_observations", observations)}
{_array("test_forces", forces)}
int main(void)
{{
    int i, failures = 0;
    for (i = 0; i < {_SAMPLES}; i++) {{
        const float force = {name}_observation(test_observations + 13 * i);
        const float wanted = test_forces[i];
        const float error = force > wanted ? force - wanted : wanted - force;
        const float size = wanted < 0.0f ? -wanted : wanted;
        /* Written so that a NaN fails. */
        if (!(error <= 1e-5f * (1.0f + size))) {{
            printf("case %d: %.7g N, wanted %.7g N\\n", i, (double)force, (double)wanted);
            failures++;
        }}
    }}
    printf("%d of {_SAMPLES} cases agree\\n", {_SAMPLES} - failures);
    return failures != 0;
}}
#endif
"""


def _widths(source: NetworkSource) -> list[int]:
    network = source.network
    return [network.inputs, *(len(bias) for bias in network.biases)]


def _array(name: str, values: Float32Array) -> str:
    """Return the definition of an array, its numbers in rows of six."""
    texts = [_literal(float(value)) for value in values.ravel()]
    rows = (", ".join(texts[begin : begin + 6]) for begin in range(0, len(texts), 6))
    return f"static const float {name}[{len(texts)}] = {{\n    " + ",\n    ".join(rows) + "};\n"


def _literal(value: float) -> str:
    """Return a float32 as a C99 hexadecimal constant, which every compiler reads exactly."""
    mantissa, exponent = float(np.float32(value)).hex().split("p")
    return f"{mantissa.rstrip('0').removesuffix('.')}p{exponent}f"
