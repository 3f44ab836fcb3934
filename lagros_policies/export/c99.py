"""A policy as one C99 file: features, network and what its outputs stand for, in float.

No dependency but the functions of <math.h> that the features call. Bodies that are sensed are taken
one after the other and added up, so that their number has no limit and costs no memory.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import Literal, get_args

import numpy as np

from lagros_envs.dynamics.straight_line import StraightLine, statements
from lagros_envs.numbers.recorded import Operation
from lagros_policies.export.c_layers import (
    TANH_ERROR,
    Activation,
    array,
    layer,
    literal,
    rational_tanh_source,
)
from lagros_policies.export.program import Bodies, Layers, Program
from lagros_policies.export.source import Source

__all__ = ["TANHS", "Tanh", "c_file", "observation_call"]

Tanh = Literal["rational", "libm"]
TANHS: tuple[str, ...] = get_args(Tanh)

_SAMPLES = 8  # of the self-test
_NUMBER = re.compile(r"-?\d")
_HEADER = """/*
 * {name}: a policy as a function. C99, one file, no heap, no state.
 *
{signatures}
 *
{texts}
 *
 * A NaN in any number that is read, a mask included, is answered by NaN; compile without
 * -ffast-math and -Ofast, which take it that there is none.
{notes}
 * Weights: {file}, SHA-256
 *     {digest}
 * Self-test: cc -std=c99 -O2 -DLAGROS_SELF_TEST THIS_FILE -lm && ./a.out
 * Written by `lagros export`; do not edit.
 */
#include <math.h>

{declarations}"""
_SELF_TEST = """#ifdef LAGROS_SELF_TEST
#include <stdio.h>

/* Answers by NumPy; single precision and another order of summation move the last digits. */
{observations}
{answers}
#define TOLERANCE {tolerance} /* 1e-5 of the largest */

int main(void)
{{
    int i, j, failures = 0;
    for (i = 0; i < {count}; i++) {{
        float control[{size}];
        int agrees = 1;
        {call};
        for (j = 0; j < {size}; j++) {{
            const float wanted = test_answers[{size} * i + j];
            const float error = control[j] > wanted ? control[j] - wanted : wanted - control[j];
            /* Written so that a NaN fails. */
            if (!(error <= TOLERANCE)) {{
                printf("case %d, control %d: %.7g, wanted %.7g\\n", i, j, (double)control[j],
                       (double)wanted);
                agrees = 0;
            }}
        }}
        failures += !agrees;
    }}
    printf("%d of {count} cases agree\\n", {count} - failures);
    return failures != 0;
}}
#endif
"""


def c_file(source: Source, tanh: Tanh = "rational") -> str:
    """Return the C99 file of a policy.

    It defines a function of the parts of an observation and `NAME_observation`, of an observation
    as it is, with NAME the policy's, and with -DLAGROS_SELF_TEST a `main` that compares with stored
    answers. Weights are `static const float`; nothing is allocated or kept between calls. One
    control is returned, several are written.

    Args:
        source: The policy.
        tanh: "rational" is a quotient of two polynomials, within `TANH_ERROR` of tanh, relative;
            "libm" calls `tanhf`, several times slower and no closer to NumPy.

    Raises:
        ValueError: `tanh` is unknown.
    """
    if tanh not in TANHS:
        raise ValueError(f"tanh={tanh!r} must be one of {', '.join(TANHS)}")
    program = source.program
    rational = tanh == "rational" and program.tanh and len(program.layers) > 1
    hidden: Activation = tanh if program.tanh else "relu"
    return "\n".join(
        [
            _header(source, tanh),
            *([rational_tanh_source()] if rational else []),
            *(part for kind in program.bodies for part in _see(program, kind)),
            *_forward(program, hidden),
            *_answer(program),
            *_interface(source),
            _self_test(source),
        ]
    )


def observation_call(source: Source, row: str, answers: str) -> str:
    """Return the C statement that answers an observation, without its semicolon.

    Args:
        source: The policy.
        row: The observation, an expression.
        answers: Where the controls go, a pointer.
    """
    arguments = [row, *(str(kind.slots) for kind in source.program.bodies)]
    function = f"{source.identifier}_observation"
    if _returns(source.program):
        return f"*({answers}) = {function}({', '.join(arguments)})"
    return f"{function}({', '.join([*arguments, answers])})"


def _header(source: Source, tanh: Tanh) -> str:
    program = source.program
    order = "; then the places for bodies of each kind and their mask" if program.bodies else ""
    texts = [
        *((part.name, part.text) for part in program.parts),
        *((f"{one.name}s", f"of each, in any order: {one.each.text}") for one in program.bodies),
        ("observation", f"all of it in a row, as the environment gives it{order}"),
        ("returns" if _returns(program) else program.control.name, program.control.text),
    ]
    between = "ReLU"
    if program.tanh and tanh == "libm":
        between = "tanhf of libm (link with -lm)"
    elif program.tanh:
        between = f"a tanh that is rational, within {TANH_ERROR:.0e} of tanh, relative"
    shapes = [*_shapes(program), *((one.name, one.layers) for one in program.bodies)]
    widths = "; ".join(f"{name} {_widths(layers)}" for name, layers in shapes)
    notes = (*program.notes, f"Layers: {widths}; between them {between}.")
    declarations = "".join(f"{head};\n" for head in _signatures(source))
    return _HEADER.format(
        name=source.name,
        signatures=textwrap.indent(declarations.rstrip(), " *     "),
        texts="\n".join(_comment(f"{name}: {text}") for name, text in texts),
        notes="\n".join(map(_comment, notes)),
        file=source.file,
        digest=source.digest,
        declarations=declarations,
    )


def _comment(text: str) -> str:
    return textwrap.fill(text, 98, initial_indent=" * ", subsequent_indent=" *     ")


def _shapes(program: Program) -> list[tuple[str, Layers]]:
    """Return the parts of the network by name."""
    if program.repeated is None:
        return [("the network", program.layers)]
    (things, _), layers = program.repeated.alike, program.repeated.layers
    names = (f"each of {things} alike, with the rest", "the rest", "what both add up to")
    return [*zip(names, (layers[0:4:2], layers[1:4:2], layers[4:]), strict=True)]


def _widths(layers: Layers) -> str:
    return "-".join(str(width) for width in [len(layers[0][0]), *(len(bias) for _, bias in layers)])


def _returns(program: Program) -> bool:
    return program.control.size == 1


def _signatures(source: Source) -> tuple[str, str]:
    """Return the heads of the two functions that are called from outside."""
    program, control = source.program, source.program.control
    written = [] if _returns(program) else [f"float {control.name}[{control.size}]"]
    counted = [f"const float *{one.name}s, int {one.name}_count" for one in program.bodies]
    slots = [f"int {one.name}_slots" for one in program.bodies]
    flat = "*observation" if slots else f"observation[{program.inputs}]"
    head = f"{'float' if _returns(program) else 'void'} {source.identifier}"
    return (
        _head(f"{head}_{control.name}", [*_own(program), *counted, *written]),
        _head(f"{head}_observation", [f"const float {flat}", *slots, *written]),
    )


def _own(program: Program) -> list[str]:
    """Return the parameters of the parts of an observation."""
    return [
        f"const float {part.name}[{part.size}]" if part.size else f"float {part.name}"
        for part in program.parts
    ]


def _network(name: str, layers: Layers, hidden: Activation, final: Activation) -> Iterator[str]:
    """Yield the layers and a function that runs through them."""
    last = len(layers) - 1
    between = ["input", *(f"hidden{index}" for index in range(last)), "output"]
    memory, calls = [], []
    for index, (weight, bias) in enumerate(layers):
        yield layer(f"{name}{index}", weight, bias, final if index == last else hidden)
        calls.append(f"{name}{index}({between[index]}, {between[index + 1]});")
        if index < last:
            memory.append(f"float {between[index + 1]}[{len(bias)}];")
    head = f"static void {name}(const float *restrict input, float *restrict output)"
    yield _function(head, [*memory, *calls])


def _forward(program: Program, hidden: Activation) -> Iterator[str]:
    """Yield the layers of the network and the function `network`."""
    if program.repeated is None:
        yield from _network("network", program.layers, hidden, "none")
        return
    (things, size), layers = program.repeated.alike, program.repeated.layers
    (weight, bias), second = layers[0], layers[2]
    rest, wide, last = len(weight) - size, len(bias), len(second[1])
    # What all of them see is the same for all, and goes through the first layer once.
    yield layer("shared", weight[:rest], bias, "none")
    yield layer("each0", weight[rest:], None, hidden)
    yield layer("each1", *second, hidden)
    yield from _network("rest", layers[1:4:2], hidden, hidden)
    yield from _network("sum", layers[4:], hidden, "none")
    yield _function(
        "static void network(const float *restrict input, float *restrict output)",
        [
            f"float start[{wide}], first[{wide}], second[{last}], both[{2 * last}];",
            "int i, j;",
            f"for (j = 0; j < {last}; j++)",
            "    both[j] = 0.0f;",
            "shared(input, start);",
            f"for (i = 0; i < {things}; i++) {{",
            f"    each0(input + {rest} + {size} * i, start, first);",
            "    each1(first, second);",
            f"    for (j = 0; j < {last}; j++)",
            "        both[j] += second[j];",
            "}",
            f"rest(input, both + {last});",
            "sum(both, output);",
        ],
    )


def _see(program: Program, kind: Bodies) -> Iterator[str]:
    """Yield the layers of a kind of body and what adds one body to the input of the network."""
    yield from _network(f"{kind.name}_layer", kind.layers, "relu", "relu")
    line = program.seeing(kind)
    features = [f"feature[{index}]" for index in range(len(line.outputs) - 1)]
    yield _function(
        f"static void see_{kind.name}("
        f"const float *{kind.name}, const float *context, float *restrict sum)",
        [
            f"float feature[{len(features)}], seen[{kind.width}], weight;",
            "int i;",
            *_lines(line, [*features, "weight"]),
            f"{kind.name}_layer(feature, seen);",
            f"for (i = 0; i < {kind.width}; i++)",
            "    sum[i] += weight * seen[i];",
        ],
    )


def _answer(program: Program) -> Iterator[str]:
    """Yield what does it all, from the parts of an observation and the bodies to the controls."""
    control, looking, acting = program.control, program.looking, program.acting
    inputs, made, end = len(program.layers[0][0]), control.name, []
    own = inputs - sum(kind.width for kind in program.bodies)
    arrays = {"input": inputs, "context": len(program.contexts)}
    arrays["output"] = len(program.layers[-1][1])
    if program.last is not None:
        yield layer("last", program.last, np.zeros(control.size, np.float32), "relu")
        made, arrays["made"], end = "made", len(acting.outputs), [f"last(made, {control.name});"]
    walks, place = [], own
    for kind in program.bodies:
        mask = f"{kind.name}_mask"
        walks += [
            f"for (i = 0; i < {kind.name}_count; i++)",
            f"    if (!{mask} || {mask}[i] > 0.0f)",
            f"        see_{kind.name}("
            f"{kind.name}s + {kind.each.size} * i, context, input + {place});",
            "    else /* Zero times the mask: a NaN there must not hide a body. */",
            f"        input[{own}] += 0.0f * {mask}[i];",
        ]
        place += kind.width
    if walks:
        walks[:0] = [f"for (i = {own}; i < {inputs}; i++)", "    input[i] = 0.0f;"]
    masked = [
        f"const float *{one.name}s, const float *{one.name}_mask, int {one.name}_count"
        for one in program.bodies
    ]
    read = {*looking.last_uses}
    yield _function(
        _head("static void answer", [*_own(program), *masked, f"float {control.name}[]"]),
        [
            "float " + ", ".join(f"{name}[{size}]" for name, size in arrays.items() if size) + ";",
            *(["int i;"] if walks else []),
            *(f"(void){part.name};" for part in program.parts if read.isdisjoint(part.places)),
            *_block(looking, [*(f"input[{index}]" for index in range(own)), *program.contexts]),
            *walks,
            "network(input, output);",
            *_block(acting, [f"{made}[{index}]" for index in range(len(acting.outputs))]),
            *end,
        ],
    )


def _interface(source: Source) -> Iterator[str]:
    """Yield the two functions that are called from outside."""
    program, name = source.program, source.program.control.name
    given = [part.name for part in program.parts]
    given += [f"{one.name}s, 0, {one.name}_count" for one in program.bodies]
    taken, pointers, begin = [], [], 0
    for part in program.parts:
        taken.append(f"observation + {begin}" if part.size else f"observation[{begin}]")
        begin += part.size or 1
    at = f"observation + {begin}"
    for one in program.bodies:
        some, mask, slots = f"{one.name}s", f"{one.name}_mask", f"{one.name}_slots"
        pointers += [
            f"const float *{some} = {at};",
            f"const float *{mask} = {some} + {one.each.size} * {slots};",
        ]
        at = f"{mask} + {slots}"
        taken.append(f"{some}, {mask}, {slots}")
    first, end = ([f"float {name}[1];"], [f"return {name}[0];"]) if _returns(program) else ([], [])
    for head, begun, each in zip(_signatures(source), ([], pointers), (given, taken), strict=True):
        yield _function(head, [*begun, *first, f"answer({', '.join([*each, name])});", *end])


def _self_test(source: Source) -> str:
    observations = source.examples(_SAMPLES)
    answers = source.answer(observations)
    row = f"test_observations + {observations.shape[1]} * i"
    return _SELF_TEST.format(
        observations=array("test_observations", observations),
        answers=array("test_answers", answers),
        tolerance=literal(1e-5 * float(np.max(np.abs(answers)))),
        count=_SAMPLES,
        size=answers.shape[1],
        call=observation_call(source, row, "control"),
    )


def _block(line: StraightLine, targets: Sequence[str]) -> list[str]:
    return ["{", *(f"    {one}" for one in _lines(line, targets)), "}"]


def _lines(line: StraightLine, targets: Sequence[str]) -> list[str]:
    """Return recorded operations as C statements that end with assignments to the targets."""
    steps, outputs = statements(line, _expression)
    assigned = zip(targets, map(_operand, outputs), strict=True)
    return [
        *(f"const float {step};" for step in steps),
        *(f"{target} = {output};" for target, output in assigned),
    ]


def _expression(operation: Operation, operands: Sequence[str]) -> str:
    """Return an operation on expressions."""
    texts = [_operand(one) for one in operands]
    if operation.symbol == "where":
        return f"({texts[0]} ? {texts[1]} : {texts[2]})"
    if operation.symbol == "abs":
        return f"fabsf({texts[0]})"
    if len(texts) == 1:
        return f"{operation.symbol}f({texts[0]})"
    symbol = operation.symbol * 2 if operation.symbol in "&|" else operation.symbol
    return f"({texts[0]} {symbol} {texts[1]})"


def _operand(text: str) -> str:
    return literal(float(text)) if _NUMBER.match(text) else text


def _head(name: str, parameters: Sequence[str]) -> str:
    """Return the head of a function, in several lines where it is long."""
    text = f"{name}({', '.join(parameters)})"
    return text if len(text) < 92 else f"{name}(\n    " + ",\n    ".join(parameters) + ")"


def _function(head: str, lines: Sequence[str]) -> str:
    return "\n".join([head, "{", *(f"    {line}" for line in lines), "}", ""])
