"""Records the arithmetic of a function once and runs it again without the function's overhead.

Physics and integrator are written for any kind of number. Called with `Recorded` numbers they leave
the list of their operations on a `Tape`. The list is run on floats, as Python source
(`scalar_source`), on arrays, in fixed buffers (`ArrayFunction`), or compiled (`compiled`). Nothing
is reordered, so that every result has the bits that calling the function would give.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics.integrate import SUBSTEPS, rk4_hold
from lagros_envs.dynamics.system import System
from lagros_envs.numbers import functions as elementary
from lagros_envs.numbers.recorded import Operation, Recorded, Tape, operand_text

_UFUNCS: dict[str, Any] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "exp": np.exp,
    "sqrt": np.sqrt,
    "abs": np.absolute,
    "<=": np.less_equal,
    ">": np.greater,
    "&": np.logical_and,
    "|": np.logical_or,
    "where": lambda condition, yes, no, out: np.copyto(out, np.where(condition, yes, no)),
}
# What the sources that are written here begin with.
IMPORTS = "from math import cos, exp, sin, sqrt, tan"
# (x, u, given, functions) -> what else to compute from the state at the end of a step.
Measure = Callable[[Sequence[Any], Sequence[Any], Sequence[Any], Any], Sequence[Any]]

# (operation, its operands as expressions) -> the expression in some language.
Write = Callable[[Operation, Sequence[str]], str]


class StraightLine(NamedTuple):
    """A function as a list of operations.

    Attributes:
        inputs: Names of the arguments.
        operations: The operations that the outputs need, as `Operation` describes them.
        outputs: Names of what is returned.
    """

    inputs: tuple[str, ...]
    operations: dict[str, Operation]
    outputs: tuple[str, ...]

    @property
    def last_uses(self) -> dict[str, int]:
        """For each name the place of the last operation that needs it; outputs are not freed."""
        last: dict[str, int] = {}
        for place, operation in enumerate(self.operations.values()):
            last.update(dict.fromkeys(operation.operands, place))
        last.update(dict.fromkeys(self.outputs, len(self.operations)))
        return last


def straight_line(
    function: Callable[[Sequence[Recorded]], Sequence[Any]], inputs: Sequence[str]
) -> StraightLine:
    """Record a function of numbers.

    Args:
        function: Maps recorded numbers, one per input, to its results.
        inputs: Names of the inputs.

    Returns:
        Its operations, without those that no result needs.

    Raises:
        TypeError: The function branches on its arguments, or works with something else than
            numbers.
    """
    tape = Tape()
    results = [
        operand_text(result) for result in function([Recorded(tape, name) for name in inputs])
    ]
    needed = set(results)
    kept: dict[str, Operation] = {}
    for place in range(len(tape.operations) - 1, -1, -1):
        if f"%{place}" in needed:
            kept[f"%{place}"] = tape.operations[place]
            needed.update(tape.operations[place].operands)
    return StraightLine(tuple(inputs), dict(reversed(kept.items())), tuple(results))


def recorded_hold(
    system: System,
    duration: float,
    substeps: int = SUBSTEPS,
    functions: Any = elementary,
    measure: Measure | None = None,
    given: int = 0,
    pushed: bool = True,
) -> StraightLine:
    """Record `rk4_hold` of a system: inputs x0..., u0..., d0..., outputs the state at the end.

    Args:
        system: The system.
        duration: Length of the step [s].
        substeps: Runge-Kutta steps in it.
        functions: Elementary functions of recorded numbers.
        measure: Computes further outputs from the state at the end.
        given: Number of further inputs g0..., which only the measure sees.
        pushed: Whether there are disturbances d0... at all.

    Returns:
        The operations of the step.
    """
    n, m = system.state_dim, system.control_dim
    pushes = n if pushed else 0
    sizes = {"x": n, "u": m, "d": pushes, "g": given}
    names = [f"{kind}{k}" for kind, count in sizes.items() for k in range(count)]

    def hold(numbers: Sequence[Recorded]) -> Sequence[Any]:
        state, control = numbers[:n], numbers[n : n + m]
        push = numbers[n + m : n + m + n] if pushed else [-0.0] * n
        end = rk4_hold(system, state, control, push, duration, functions, substeps)
        if measure is None:
            return end
        return [*end, *measure(end, control, numbers[n + m + pushes :], functions)]

    return straight_line(hold, names)


def recorded_measure(
    system: System, measure: Measure, given: int = 0, functions: Any = elementary
) -> StraightLine:
    """Record a measure alone: inputs x0... at the end of a step, u0..., g0...."""
    n, m = system.state_dim, system.control_dim
    sizes = {"x": n, "u": m, "g": given}
    names = [f"{kind}{k}" for kind, count in sizes.items() for k in range(count)]
    return straight_line(
        lambda numbers: measure(numbers[:n], numbers[n : n + m], numbers[n + m :], functions), names
    )


def scalar_source(
    step: StraightLine,
    repeats: int,
    tail: StraightLine | None = None,
    grouped: bool = False,
) -> str:
    """Return a module in Python that feeds the outputs to the first inputs, repeatedly.

    Args:
        step: What is repeated; it has no more outputs than inputs.
        repeats: How often.
        tail: What is computed at the end, from inputs of the step and from others.
        grouped: Whether `held` takes one sequence for the inputs of each first letter, which is
            quicker than many arguments, and returns two tuples.

    Returns:
        Source of a function `held` of the inputs, those of the step first, as floats, that returns
        the outputs of the step and of the tail as a tuple.
    """
    lines, outputs = statements(step)
    fed = ", ".join(step.inputs[: len(outputs)])
    ending, measured = statements(tail) if tail is not None else ([], [])
    others = [name for name in tail.inputs if name not in step.inputs] if tail is not None else []
    arguments, unpacked = [*step.inputs, *others], []
    result = ", ".join([fed, *measured])
    if grouped:
        groups = {letter: list(names) for letter, names in groupby(arguments, lambda one: one[0])}
        unpacked = [f"{', '.join(names)}, = {letter}" for letter, names in groups.items()]
        arguments = list(groups)
        result = f"({fed},), ({''.join(f'{one}, ' for one in measured)})"
    return "\n".join(
        [
            IMPORTS,
            "",
            f"def held({', '.join(arguments)}):",
            *(f"    {line}" for line in unpacked),
            # Written out: a loop in Python costs as much as a few operations.
            *[f"    {line}" for line in [*lines, f"{fed} = {', '.join(outputs)}"]] * repeats,
            *(f"    {line}" for line in ending),
            f"    return {result}",
            "",
        ]
    )


def plain_source(line: StraightLine) -> str:
    """Return a module in Python: a function `held` of one sequence, of the inputs, to a tuple."""
    lines, outputs = statements(line)
    return "\n".join(
        [
            IMPORTS,
            "",
            "def held(given):",
            f"    {', '.join(line.inputs)}, = given",
            *(f"    {one}" for one in lines),
            f"    return {', '.join(outputs)},",
            "",
        ]
    )


def statements(step: StraightLine, write: Write | None = None) -> tuple[list[str], list[str]]:
    """Return the operations as assignments, and the outputs as expressions.

    What is used once is written where it is used: it never becomes a variable.

    Args:
        step: The operations.
        write: Writes one, on operands that are expressions; as Python if None.
    """
    write = write or expression
    counts: dict[str, int] = {}
    for used in [*(one.operands for one in step.operations.values()), step.outputs]:
        for operand in used:
            counts[operand] = counts.get(operand, 0) + 1
    lines: list[str] = []
    texts: dict[str, str] = {}
    for place, (name, operation) in enumerate(step.operations.items()):
        text = write(operation, [texts.get(one, one) for one in operation.operands])
        if counts.get(name, 0) > 1:
            lines.append(f"v{place} = {text}")
            text = f"v{place}"
        texts[name] = text
    return lines, [texts.get(output, output) for output in step.outputs]


def expression(operation: Operation, operands: Sequence[str]) -> str:
    """Return an operation on operands, which are expressions again, as Python writes it."""
    if operation.symbol == "where":
        condition, yes, no = operands
        return f"({yes} if {condition} else {no})"
    if len(operands) == 2:
        return f"({operands[0]} {operation.symbol} {operands[1]})"
    return f"{operation.symbol}({operands[0]})"


class ArrayFunction:
    """A straight line on arrays of one shape, in buffers that are allocated once.

    Args:
        step: The operations.
        shape: Shape of every input and output.

    Attributes:
        inputs: To be filled in before a call, shape (inputs, *shape).
        outputs: What the last call gave, shape (outputs, *shape).
    """

    def __init__(self, step: StraightLine, shape: tuple[int, ...]) -> None:
        """Give every result a buffer; one that nobody needs any more is used again."""
        self.inputs = np.zeros((len(step.inputs), *shape))
        self.outputs = np.empty((len(step.outputs), *shape))
        self._calls: list[tuple[Any, tuple[FloatArray, ...]]] = []
        arrays: dict[str, FloatArray] = dict(zip(step.inputs, self.inputs, strict=True))
        last = step.last_uses
        free: list[FloatArray] = []
        for place, (name, operation) in enumerate(step.operations.items()):
            operands = [_array(operand, arrays) for operand in operation.operands]
            # An operation may write over its operands: all of them work entry by entry.
            done = {name for name in operation.operands if last[name] == place}
            free += [arrays[name] for name in sorted(done & step.operations.keys())]
            arrays[name] = free.pop() if free else np.empty(shape)
            self._calls.append((_UFUNCS[operation.symbol], (*operands, arrays[name])))
        for output, row in zip(step.outputs, self.outputs, strict=True):
            self._calls.append((np.copyto, (row, _array(output, arrays))))

    def __call__(self) -> FloatArray:
        """Evaluate at `inputs` and return `outputs`."""
        for function, arguments in self._calls:
            function(*arguments)
        return self.outputs


def _array(name: str, arrays: dict[str, FloatArray]) -> FloatArray:
    # A constant as an array of no dimension: a Python float would be converted in every call.
    return arrays[name] if name in arrays else np.array(float(name))
