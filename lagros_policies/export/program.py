"""What is exported: features and network of a policy, from what is observed to controls.

The features are functions over the kinds of number; recorded, they become lines of C or nodes of an
ONNX graph.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Any

from lagros_envs.arrays import Float32Array
from lagros_envs.dynamics.straight_line import StraightLine, straight_line
from lagros_envs.numbers import functions
from lagros_policies.learning.layers import Alike

Layers = Sequence[tuple[Float32Array, Float32Array]]
Numbers = Sequence[Any]


@dataclass(frozen=True)
class Part:
    """Numbers that go in or come out.

    Attributes:
        name: As C and ONNX call them.
        size: How many; 0 for one that is passed by value.
        text: What they are, with units.
    """

    name: str
    size: int
    text: str

    @property
    def places(self) -> list[str]:
        """The names of its numbers, which are expressions in C."""
        return [f"{self.name}[{index}]" for index in range(self.size)] or [self.name]


@dataclass(frozen=True)
class Bodies:
    """Bodies of one kind that are sensed, any number of them: what the network adds up.

    Attributes:
        each: Numbers of one of them; its name is in the singular.
        slots: Places for them in an observation, followed by the mask of these places.
        see: From the numbers of one and the context to its features and its weight in the sum.
        layers: What its features run through, a ReLU after each.
    """

    each: Part
    slots: int
    see: Callable[[Numbers, Numbers], tuple[Numbers, Any]]
    layers: Layers

    @property
    def name(self) -> str:
        """Of one body."""
        return self.each.name

    @property
    def width(self) -> int:
        """Numbers that each adds to the input of the network."""
        return len(self.layers[-1][1])


@dataclass(frozen=True)
class Repeated:
    """Layers of a network that treats some of its inputs alike, each kept once.

    Attributes:
        alike: Which inputs.
        layers: As `learning.layers.written_out` takes them.
    """

    alike: Alike
    layers: Layers


@dataclass(frozen=True)
class Program:
    """A policy as functions and layers.

    Attributes:
        parts: An observation begins with them.
        look: From their numbers to the features, which the network begins with, and the context,
            which is left for `act` and for what is seen of the bodies.
        layers: Of the network, without an activation after the last.
        act: From the network's outputs and the context to the controls, or to what `last` makes
            controls of.
        control: The controls.
        tanh: Whether tanh stands between the layers; else it is a ReLU.
        repeated: The same network without the repetitions of `layers`; None where it has none.
        bodies: In the order of the observation, and of the network's inputs.
        last: Matrix that makes controls of what `act` returns, followed by a ReLU.
        notes: What else there is to say, a sentence each.
        metadata: The same for machines.
    """

    parts: tuple[Part, ...]
    look: Callable[[Numbers], tuple[Numbers, Numbers]]
    layers: Layers
    act: Callable[[Numbers, Numbers], Numbers]
    control: Part
    tanh: bool = True
    repeated: Repeated | None = None
    bodies: tuple[Bodies, ...] = ()
    last: Float32Array | None = None
    notes: tuple[str, ...] = ()
    metadata: tuple[tuple[str, str], ...] = ()

    @property
    def places(self) -> list[str]:
        """The names of the numbers of all parts."""
        return [place for part in self.parts for place in part.places]

    @property
    def inputs(self) -> int:
        """Length of an observation."""
        return len(self.places) + sum(kind.slots * (kind.each.size + 1) for kind in self.bodies)

    @cached_property
    def contexts(self) -> list[str]:
        """The names of the context's numbers."""
        width = sum(kind.width for kind in self.bodies)
        features = len(self.layers[0][0]) - width
        count = len(self.looking.outputs) - features
        return [f"context[{index}]" for index in range(count)]

    @cached_property
    def looking(self) -> StraightLine:
        """`look`, recorded: features, then context; what is read and NaN makes the first NaN."""
        record = straight_line(lambda given: [*chain(*self.look(given))], self.places)
        hidden = [place for place in _read(record) if not _noticed(record, place)]

        def look(given: Numbers) -> Numbers:
            found = dict(zip(self.places, given, strict=True))
            (first, *features), context = self.look(given)
            for place in hidden:
                first = first + 0.0 * found[place]
            return [first, *features, *context]

        return straight_line(look, self.places) if hidden else record

    def seeing(self, kind: Bodies) -> StraightLine:
        """Record what is seen of a body: its features, then its weight."""
        places = kind.each.places

        def see(given: Numbers) -> Numbers:
            features, weight = kind.see(given[: len(places)], given[len(places) :])
            return [*features, weight]

        return straight_line(see, [*places, *self.contexts])

    @cached_property
    def acting(self) -> StraightLine:
        """`act`, recorded."""
        outputs = [f"output[{index}]" for index in range(len(self.layers[-1][1]))]
        return straight_line(
            lambda given: self.act(given[: len(outputs)], given[len(outputs) :]),
            [*outputs, *self.contexts],
        )


@dataclass(frozen=True)
class Vector:
    """A vector of the plane as a complex number, of two numbers of any kind."""

    real: Any
    imag: Any

    def __add__(self, other: float) -> Vector:
        """Add a real number."""
        return Vector(self.real + other, self.imag)

    def __neg__(self) -> Vector:
        """Turn it around."""
        return Vector(-self.real, -self.imag)

    def __mul__(self, other: Any) -> Vector:
        """Turn and stretch it by another, or stretch it by a number."""
        if not isinstance(other, Vector):
            return Vector(self.real * other, self.imag * other)
        return Vector(
            self.real * other.real - self.imag * other.imag,
            self.imag * other.real + self.real * other.imag,
        )

    def __truediv__(self, other: Any) -> Vector:
        """Divide it by a number."""
        return Vector(self.real / other, self.imag / other)

    def __abs__(self) -> Any:
        """Return its length."""
        return functions.sqrt(self.real * self.real + self.imag * self.imag)

    def conj(self) -> Vector:
        """Return its mirror image, which turns back."""
        return Vector(self.real, -self.imag)


def is_bound(line: StraightLine, operation: Any) -> bool:
    """Return whether a `where` is a minimum or a maximum: "a > b ? b : a", "a <= b ? b : a"."""
    if operation.symbol != "where":
        return False
    condition, yes, no = operation.operands
    tested = line.operations.get(condition)
    return tested is not None and tested.symbol in ("<=", ">") and tested.operands == (no, yes)


def _read(line: StraightLine) -> list[str]:
    used = {name for one in line.operations.values() for name in one.operands} | {*line.outputs}
    return [name for name in line.inputs if name in used]


def _noticed(line: StraightLine, place: str) -> bool:
    """Return whether an output is NaN wherever this input is, whatever is chosen on the way."""
    spoiled = {place}
    for name, operation in line.operations.items():
        hit = [one in spoiled for one in operation.operands]
        if operation.symbol == "where":
            kept = hit[2] if is_bound(line, operation) else hit[1] and hit[2]
        else:
            kept = any(hit) and operation.symbol not in ("<=", ">", "&", "|")
        if kept:
            spoiled.add(name)
    return any(output in spoiled for output in line.outputs)
