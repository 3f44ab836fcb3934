"""A cart-pole policy as one C99 file: weights, features, mirror, no dependency but `tanhf`."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from lagros_policies.export.c_layers import (
    TANH_ERROR,
    TANH_LIMIT,
    TANH_P,
    TANH_Q,
    Activation,
    array,
    layer,
    rational_tanh_source,
)
from lagros_policies.export.source import NetworkSource, example_observations

__all__ = ["TANHS", "TANH_ERROR", "TANH_LIMIT", "TANH_P", "TANH_Q", "Tanh", "c_source"]

Float32Array = NDArray[np.float32]
Tanh = Literal["rational", "libm"]
TANHS: tuple[str, ...] = get_args(Tanh)

_SAMPLES = 8  # of the self-test


def c_source(source: NetworkSource, tanh: Tanh = "rational") -> str:
    """Return the C99 file of a policy.

    It defines `float NAME_force(state, goal, initial_state, time)` and
    `float NAME_observation(observation)`, both [N], with NAME the policy's, and with
    -DLAGROS_SELF_TEST a `main` that compares with stored forces. Weights are `static const float`;
    nothing is allocated, nothing is kept between calls.

    Args:
        source: The policy.
        tanh: "rational" is a quotient of two polynomials, within `TANH_ERROR` of tanh, relative;
            "libm" calls `tanhf`, several times slower and no closer to NumPy.

    Raises:
        ValueError: `tanh` is unknown.
    """
    if tanh not in TANHS:
        raise ValueError(f"tanh={tanh!r} must be one of {', '.join(TANHS)}")
    name = source.name.replace("-", "_")
    parts = [
        _header(source, name, tanh),
        _network(source, tanh),
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
 * returns        the force on the cart [N], not saturated; hold it for one control step of 0.1 s.
 *                A NaN in any number that is read makes it NaN; compile without -ffast-math and
 *                -Ofast, which take it that there is none
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


def _network(source: NetworkSource, tanh: Tanh) -> str:
    network = source.network
    last = len(network.weights) - 1
    names = ["features", *(f"hidden{index}" for index in range(last)), "force"]
    layers, memory, calls = [], [], []
    for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        activation: Activation = "none" if index == last else tanh
        layers.append(layer(f"layer{index}", weight, bias, activation))
        calls.append(f"    layer{index}({names[index]}, {names[index + 1]});")
        memory.append(f"    float {names[index + 1]}[{len(bias)}];")
    head = "#include <math.h>\n" if tanh == "libm" else rational_tanh_source()
    lines = [
        *([head] if last else []),
        *layers,
        "static float network(const float *features)",
        "{",
        *memory,
        *calls,
        "    return force[0];",
        "}",
        "",
    ]
    return "\n".join(lines)


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
{array("test_observations", observations)}
{array("test_forces", forces)}
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
