"""A policy as an ONNX model: features, network and what its outputs stand for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics.straight_line import StraightLine
from lagros_policies.export.program import Bodies, Layers, is_bound
from lagros_policies.export.source import Source
from lagros_policies.learning.networks import Mlp

if TYPE_CHECKING:
    import onnx

INSTALL = 'pip install "lagros[onnx]"'
_IR_VERSION, _OPSET = 8, 13
_OPERATORS = {
    "+": "Add",
    "-": "Sub",
    "*": "Mul",
    "/": "Div",
    "<=": "LessOrEqual",
    ">": "Greater",
    "&": "And",
    "|": "Or",
    "where": "Where",
    "sin": "Sin",
    "cos": "Cos",
    "tan": "Tan",
    "exp": "Exp",
    "sqrt": "Sqrt",
    "abs": "Abs",
}

_MANY, _LONG = 5, 10  # operations that one node on a row outweighs; numbers that one Gather does
# A row of numbers in the graph, and what each is called.
Named = tuple[str, Sequence[str]]


def onnx_file(source: Source) -> bytes:
    """Return the ONNX model of a policy.

    Returns:
        A model of input "observation", shape (batch, o), as the environment gives it, and of one
        output, shape (batch, m), called as the control. The weights' name and digest, and what the
        source adds, are in its metadata.

    Raises:
        ImportError: onnx is not installed.
    """
    graph, program = _Graph(), source.program
    own, size = len(program.places), program.control.size
    sizes = [n for kind in program.bodies for n in (kind.slots * kind.each.size, kind.slots)]
    # With bodies there are three axes: batch, slots (one, of what belongs to nobody), numbers.
    first, *given = graph.split("observation", [own, *sizes])
    deep = bool(sizes)
    if deep:
        first = graph.do("Reshape", first, np.array([0, 1, own]))
    looking, contexts = program.looking, program.contexts
    seen = _Rows(graph, looking, [(first, program.places)], deep)
    count = len(looking.outputs) - len(contexts)
    inputs = [seen.row(looking.outputs[:count])]
    context = [
        (seen.row([output]), [name])
        for name, output in zip(contexts, looking.outputs[count:], strict=True)
    ]
    for place, kind in enumerate(program.bodies):
        parts = given[2 * place : 2 * place + 2]
        inputs.append(graph.pooled(kind, program.seeing(kind), parts, context))
    between = "Tanh" if program.tanh else "Relu"
    answer = graph.layers(graph.joined(inputs), program.layers, between)
    acting = program.acting
    outputs = acting.inputs[: len(acting.inputs) - len(contexts)]
    control = _Rows(graph, acting, [(answer, outputs), *context], deep).row(acting.outputs)
    if program.last is not None:
        control = graph.do("Relu", graph.do("MatMul", control, program.last))
    if deep:
        control = graph.do("Reshape", control, np.array([0, size]))
    graph.call(control, program.control.name)
    metadata = {
        "policy": source.name,
        "weights": source.file,
        "weights_sha256": source.digest,
        **dict(program.metadata),
    }
    return graph.model(("observation", "batch", program.inputs),
                       (program.control.name, "batch", size), metadata)  # fmt: skip


def network_model(network: Mlp) -> bytes:
    """Return a network alone: input "x" of shape (1, inputs), output "y" of shape (1, outputs).

    Raises:
        ImportError: onnx is not installed.
    """
    graph, count, size = _Graph(), network.scheduled, network.outputs
    layers = list(zip(network.weights, network.biases, strict=True))
    if not count:
        graph.call(graph.layers("x", layers, "Tanh"), "y")
    else:
        state, rest = graph.split("x", [count, network.inputs - count])
        offset, rows = graph.split(graph.layers(rest, layers, "Tanh"), [size, size * count])
        gain = graph.do("Reshape", rows, np.array([-1, size, count]))
        column = graph.do("Reshape", state, np.array([-1, count, 1]))
        product = graph.do("Reshape", graph.do("MatMul", gain, column), np.array([-1, size]))
        graph.call(graph.do("Add", product, offset), "y")
    return graph.model(("x", 1, network.inputs), ("y", 1, network.outputs), {})


class _Graph:
    """A graph that grows: every method adds operations and returns the name of the result."""

    def __init__(self) -> None:
        try:
            import onnx
        except ImportError as error:
            raise ImportError(f"writing an ONNX file needs onnx: {INSTALL}") from error
        self._onnx = onnx
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[tuple[str, tuple[int, ...], bytes], onnx.TensorProto] = {}

    def constant(self, values: NDArray[Any] | float) -> str:
        """Store numbers, once; integers as int64, everything else as float32."""
        found = np.asarray(values)
        stored = found.astype(np.int64 if found.dtype.kind == "i" else np.float32)
        key = stored.dtype.str, stored.shape, stored.tobytes()
        if key not in self._constants:
            name = f"c{len(self._constants)}"
            self._constants[key] = self._onnx.numpy_helper.from_array(stored, name)
        return self._constants[key].name

    def do(self, operation: str, *inputs: str | NDArray[Any] | float, **attributes: Any) -> str:
        """Add a node with one output."""
        names = [one if isinstance(one, str) else self.constant(one) for one in inputs]
        result = f"v{len(self._nodes)}"
        made = self._onnx.helper.make_node(operation, names, [result], **attributes)
        self._nodes.append(made)
        return result

    def call(self, value: str, name: str) -> None:
        """Give the result of the last node the name of the model's output."""
        if [value] == list(self._nodes[-1].output):
            self._nodes[-1].output[0] = name
        else:
            self._nodes.append(self._onnx.helper.make_node("Identity", [value], [name]))

    def split(self, value: str, sizes: Sequence[int]) -> list[str]:
        """Cut the last axis into pieces."""
        if len(sizes) == 1:
            return [value]
        names = [f"v{len(self._nodes)}.{index}" for index in range(len(sizes))]
        cut = [value, self.constant(np.array(sizes))]
        self._nodes.append(self._onnx.helper.make_node("Split", cut, names, axis=-1))
        return names

    def joined(self, values: Sequence[str]) -> str:
        """Put values beside each other along the last axis."""
        return values[0] if len(values) == 1 else self.do("Concat", *values, axis=-1)

    def layers(self, value: str, layers: Layers, between: str, end: str = "") -> str:
        """Run through layers, with an activation between them and perhaps one at the end."""
        for index, (weight, bias) in enumerate(layers):
            value = self.do("Add", self.do("MatMul", value, weight), bias)
            activation = end if index == len(layers) - 1 else between
            value = self.do(activation, value) if activation else value
        return value

    def pooled(
        self, kind: Bodies, line: StraightLine, given: Sequence[str], context: Sequence[Named]
    ) -> str:
        """Add up what is seen of the bodies of one kind.

        Args:
            kind: The kind.
            line: What is seen of one.
            given: Their numbers, and the mask.
            context: What does not differ among them.
        """
        size = kind.each.size
        slots = self.do("Reshape", given[0], np.array([0, kind.slots, size]))
        mask = self.do("Reshape", given[1], np.array([0, kind.slots, 1]))
        zeros = self.do("Mul", mask, 0.0)
        rows = _Rows(self, line, [(slots, kind.each.places), *context], True, zeros)
        features, weight = rows.row(line.outputs[:-1]), rows.row(line.outputs[-1:])
        seen = self.layers(features, kind.layers, "Relu", "Relu")
        # Zero times the mask: a NaN there must not hide a body.
        sensed = self.do("Where", self.do("Greater", mask, 0.0), weight, zeros)
        return self.do("ReduceSum", self.do("Mul", seen, sensed), np.array([1]), keepdims=1)

    def model(
        self, given: tuple[str, Any, int], answer: tuple[str, Any, int], metadata: dict[str, str]
    ) -> bytes:
        """Return the model, of ports (name, rows, columns), after ONNX's own check."""
        helper, kind = self._onnx.helper, self._onnx.TensorProto.FLOAT
        ports = [
            helper.make_tensor_value_info(name, kind, shape) for name, *shape in (given, answer)
        ]
        constants = list(self._constants.values())
        graph = helper.make_graph(self._nodes, "policy", [ports[0]], [ports[1]], constants)
        made = helper.make_model(
            graph,
            producer_name="lagros",
            ir_version=_IR_VERSION,
            opset_imports=[helper.make_opsetid("", _OPSET)],
        )
        helper.set_model_props(made, metadata)
        self._onnx.checker.check_model(made)
        return bytes(made.SerializeToString())


class _Rows:
    """Recorded operations in a graph: many of one kind and depth are one node on a row of numbers.

    Args:
        graph: The graph, to which they are added.
        line: The operations.
        given: Rows of the inputs, and their names.
        one_by_one: Whether every operation is a node: where a row has more axes than batch and
            numbers, to cut it and to put it together costs more than the nodes.
        zeros: In the shape of the first row, for results that do not depend on it.
    """

    def __init__(
        self,
        graph: _Graph,
        line: StraightLine,
        given: Sequence[Named],
        one_by_one: bool = False,
        zeros: str = "",
    ) -> None:
        self._graph, self._one_by_one, self._zeros = graph, one_by_one, zeros
        self._differing = {*given[0][1]}
        self._joined: dict[tuple[str, ...], str] = {}
        self._rows = dict(given)
        self._at = {name: value for value, names in given for name in names}
        self._pieces: dict[str, str] = {}
        depth = dict.fromkeys(self._at, 0)
        alike: dict[tuple[int, str], list[tuple[str, Sequence[str]]]] = {}
        asked = {*line.outputs}
        for name, operation in reversed(line.operations.items()):
            if name in asked:
                bound = is_bound(line, operation)
                asked.update(operation.operands[1:] if bound else operation.operands)
        for name, operation in line.operations.items():
            operator, operands = _OPERATORS[operation.symbol], operation.operands
            if is_bound(line, operation):
                tested = line.operations[operands[0]]
                operator, operands = "Min" if tested.symbol == ">" else "Max", tested.operands
            if not self._differing.isdisjoint(operands):
                self._differing.add(name)
            depth[name] = 1 + max(depth.get(one, 0) for one in operands)
            if name in asked:
                alike.setdefault((depth[name], operator), []).append((name, operands))
        for (_, operator), found in sorted(alike.items()):
            single = self._one_by_one or len(found) < _MANY
            for some in [[one] for one in found] if single else [found]:
                columns = zip(*(operands for _, operands in some), strict=True)
                value = graph.do(operator, *(self.row(one, whole=False) for one in columns))
                self._rows[value] = [name for name, _ in some]
                self._at |= {name: value for name, _ in some}

    def row(self, names: Sequence[str], whole: bool = True) -> str:
        """Return the numbers with these names beside each other.

        Args:
            names: Of the numbers.
            whole: Whether all are needed, even if they are one or do not depend on the input.
        """
        if not whole and self._at.keys().isdisjoint(names):
            return self._graph.constant(np.array([float(name) for name in names]))
        if not whole and len(set(names)) == 1:
            return self._piece(names[0])
        if self._one_by_one or len(names) < _LONG or not self._at.keys() >= {*names}:
            return self._graph.joined(self._parts(names, whole))
        values = tuple(dict.fromkeys(self._at[name] for name in names))
        if values not in self._joined:
            self._joined[values] = self._graph.joined(values)
        order = [name for value in values for name in self._rows[value]]
        if order == list(names):
            return self._joined[values]
        place = {name: index for index, name in enumerate(order)}
        wanted = np.array([place[name] for name in names])
        return self._graph.do("Gather", self._joined[values], wanted, axis=-1)

    def _parts(self, names: Sequence[str], whole: bool) -> list[str]:
        """Return rows and single numbers that, side by side, have these names."""
        parts, left = [], list(names)
        while left:
            together = list(self._rows.get(self._at.get(left[0], ""), ()))
            if len(together) > 1 and left[: len(together)] == together:
                parts.append(self._at[left[0]])
                del left[: len(together)]
                continue
            name = left.pop(0)
            part = self._piece(name)
            if whole and self._zeros and name not in self._differing:
                part = self._graph.do("Add", part, self._zeros)
            parts.append(part)
        return parts

    def _piece(self, name: str) -> str:
        """Return a number on its own."""
        if name not in self._pieces:
            if name in self._at:
                row = self._rows[self._at[name]]
                cut = self._graph.split(self._at[name], [1] * len(row))
                self._pieces |= dict(zip(row, cut, strict=True))
            else:
                zero = self._graph.do("Mul", self._piece(next(iter(self._at))), 0.0)
                self._pieces[name] = self._graph.do("Add", zero, float(name))
        return self._pieces[name]
