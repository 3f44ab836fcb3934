"""Numbers that record what is done to them: an equation becomes a list of operations."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from lagros_envs.numbers.functions import power


class Operation(NamedTuple):
    """One operation; its result is called `%i` for its place i on the tape.

    Attributes:
        symbol: `+`, `-`, `*`, `/`, `sin`, `cos`, `tan`, `exp`, `sqrt`, `abs`; or, of rules, `<=`,
            `>`, `&` and `|`, which are 1 where they hold and 0 elsewhere, and `where`.
        operands: Names of inputs, results, or the text of a constant.
    """

    symbol: str
    operands: tuple[str, ...]


_NEUTRAL = {"*": "1.0", "+": "-0.0"}


class Tape:
    """Operations in the order in which they were recorded, equal ones only once."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.operations: list[Operation] = []
        self._known: dict[Operation, Recorded] = {}

    def record(self, symbol: str, *operands: Any) -> Recorded:
        """Note an operation and return its result; a product with one is the other factor.

        So is a sum with -0.0, which changes no bit of anything. (A sum with 0.0 would.)

        Raises:
            TypeError: An operand is neither a `Recorded` nor a finite number.
        """
        neutral = _NEUTRAL.get(symbol, "")
        if neutral in map(operand_text, operands):
            first, second = operands
            other = second if operand_text(first) == neutral else first
            if isinstance(other, Recorded):
                return other
        operation = Operation(symbol, tuple(map(operand_text, operands)))
        if operation not in self._known:
            self._known[operation] = Recorded(self, f"%{len(self.operations)}")
            self.operations.append(operation)
        return self._known[operation]


class Recorded:
    """A number whose operations go onto a tape; it has no value to branch on.

    Attributes:
        tape: Where they go.
        name: Name of the number on the tape.
    """

    __slots__ = ("name", "tape")

    def __init__(self, tape: Tape, name: str) -> None:
        self.tape, self.name = tape, name

    def __add__(self, other: Any) -> Recorded:
        """Record a sum."""
        return self.tape.record("+", self, other)

    def __radd__(self, other: Any) -> Recorded:
        """Record a sum with a constant on the left."""
        return self.tape.record("+", other, self)

    def __sub__(self, other: Any) -> Recorded:
        """Record a difference."""
        return self.tape.record("-", self, other)

    def __rsub__(self, other: Any) -> Recorded:
        """Record a difference with a constant on the left."""
        return self.tape.record("-", other, self)

    def __mul__(self, other: Any) -> Recorded:
        """Record a product."""
        return self.tape.record("*", self, other)

    def __rmul__(self, other: Any) -> Recorded:
        """Record a product with a constant on the left."""
        return self.tape.record("*", other, self)

    def __truediv__(self, other: Any) -> Recorded:
        """Record a quotient."""
        return self.tape.record("/", self, other)

    def __rtruediv__(self, other: Any) -> Recorded:
        """Record a quotient with a constant on the left."""
        return self.tape.record("/", other, self)

    def __neg__(self) -> Recorded:
        """Record a change of sign, which is a product: it is as exact."""
        return self.tape.record("*", self, -1.0)

    def __pow__(self, exponent: int) -> Any:
        """Record an integer power as products."""
        return power(self, exponent)

    def __abs__(self) -> Recorded:
        """Record an absolute value."""
        return self.tape.record("abs", self)

    def __le__(self, other: Any) -> Recorded:
        """Record whether it is at most another."""
        return self.tape.record("<=", self, other)

    def __gt__(self, other: Any) -> Recorded:
        """Record whether it is more than another."""
        return self.tape.record(">", self, other)

    def __lt__(self, other: Any) -> Recorded:
        """Record whether it is less than another."""
        return self.tape.record(">", other, self)

    def __ge__(self, other: Any) -> Recorded:
        """Record whether it is at least another."""
        return self.tape.record("<=", other, self)

    def __and__(self, other: Any) -> Recorded:
        """Record whether both of two comparisons hold."""
        return self.tape.record("&", self, other)

    def __or__(self, other: Any) -> Recorded:
        """Record whether at least one of two comparisons holds."""
        return self.tape.record("|", self, other)

    def where(self, yes: Any, no: Any) -> Recorded:
        """Record the choice between two numbers, by this comparison."""
        return self.tape.record("where", self, yes, no)

    def sin(self) -> Recorded:
        """Record a sine."""
        return self.tape.record("sin", self)

    def cos(self) -> Recorded:
        """Record a cosine."""
        return self.tape.record("cos", self)

    def tan(self) -> Recorded:
        """Record a tangent."""
        return self.tape.record("tan", self)

    def exp(self) -> Recorded:
        """Record an exponential."""
        return self.tape.record("exp", self)

    def sqrt(self) -> Recorded:
        """Record a square root."""
        return self.tape.record("sqrt", self)

    def __bool__(self) -> bool:
        """Refuse: what is recorded may not branch."""
        raise TypeError("an equation of motion must not branch on its state: it is recorded once")


def operand_text(operand: Any) -> str:
    """Return the name of a recorded number, or a constant as text.

    Raises:
        TypeError: It is neither a `Recorded` nor a finite number.
    """
    if isinstance(operand, Recorded):
        return operand.name
    if isinstance(operand, float | int) and math.isfinite(operand):
        return repr(float(operand))
    raise TypeError(f"{operand!r} is no finite number; an equation of motion works on numbers")
