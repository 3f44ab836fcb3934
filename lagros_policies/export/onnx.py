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
    "where": "Where",
    "sin": "Sin",
    "cos": "Cos",
    "tan": "Tan",
    "exp": "Exp",
    "sqrt": "Sqrt",
    "abs": "Abs",
}

# A row of numbers in the graph, and what each is called.
Named = tuple[str, Sequence[str]]


def onnx_file(source: Source) -> bytes:
    """Return the ONNX model of a policy.

    Args:
        source: The policy.

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
    if sizes:
        first = graph.do("Reshape", first, np.array([0, 1, own]))
    looking, contexts = program.looking, program.contexts
    seen = _Rows(graph, looking, [(first, program.places)])
    count = len(looking.outputs) - len(contexts)
    inputs = [seen.row(looking.outputs[:count])]
    context = [(seen.row(looking.outputs[count:]), contexts)] if contexts else []
    for place, kind in enumerate(program.bodies):
        parts = given[2 * place : 2 * place + 2]
        inputs.append(graph.pooled(kind, program.seeing(kind), parts, context))
    between = "Tanh" if program.tanh else "Relu"
    answer = graph.layers(graph.joined(inputs), program.layers, between)
    acting = program.acting
    outputs = acting.inputs[: len(acting.inputs) - len(contexts)]
    control = _Rows(graph, acting, [(answer, outputs), *context]).row(acting.outputs)
    if program.last is not None:
        control = graph.do("Relu", graph.do("MatMul", control, program.last))
    graph.do("Reshape", control, np.array([0, size]), name=program.control.name)
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
    graph = _Graph()
    answer = graph.layers("x", list(zip(network.weights, network.biases, strict=True)), "Tanh")
    graph.do("Identity", answer, name="y")
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

    def do(
        self, operation: str, *inputs: str | NDArray[Any] | float, name: str = "", **attributes: Any
    ) -> str:
        """Add a node with one output."""
        names = [one if isinstance(one, str) else self.constant(one) for one in inputs]
        result = name or f"v{len(self._nodes)}"
        made = self._onnx.helper.make_node(operation, names, [result], **attributes)
        self._nodes.append(made)
        return result

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
        # What does not differ among the slots takes their shape.
        shaped = [(self.do("Add", value, zeros), names) for value, names in context]
        rows = _Rows(self, line, [(slots, kind.each.places), *shaped])
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
    """Recorded operations in a graph: those of one kind and depth are one node on a row of numbers.

    Args:
        graph: The graph, to which they are added.
        line: The operations.
        given: Rows of the inputs, and their names.
    """

    def __init__(self, graph: _Graph, line: StraightLine, given: Sequence[Named]) -> None:
        self._graph, self._first = graph, given[0][0]
        self._width = {value: len(names) for value, names in given}
        self._at = {name: (value, k) for value, names in given for k, name in enumerate(names)}
        self._joined: dict[tuple[str, ...], str] = {}
        depth = dict.fromkeys(self._at, 0)
        alike: dict[tuple[int, str], list[tuple[str, Sequence[str]]]] = {}
        for name, operation in line.operations.items():
            operator, operands = _OPERATORS[operation.symbol], operation.operands
            if is_bound(line, operation):
                tested = line.operations[operands[0]]
                operator, operands = "Min" if tested.symbol == ">" else "Max", tested.operands
            depth[name] = 1 + max(depth.get(one, 0) for one in operands)
            alike.setdefault((depth[name], operator), []).append((name, operands))
        for (_, operator), found in sorted(alike.items()):
            columns = zip(*(operands for _, operands in found), strict=True)
            value = graph.do(operator, *(self.row(column, whole=False) for column in columns))
            self._width[value] = len(found)
            self._at |= {name: (value, k) for k, (name, _) in enumerate(found)}

    def row(self, names: Sequence[str], whole: bool = True) -> str:
        """Return the numbers with these names beside each other.

        Args:
            names: Of the numbers.
            whole: Whether all are needed, even if they are one or do not depend on the input.
        """
        constants = [name for name in names if name not in self._at]
        if len(constants) == len(names) and not whole:
            return self._graph.constant(np.array([float(name) for name in names]))
        for name in constants:
            zero = self._graph.do("Mul", self.row([next(iter(self._at))]), 0.0)
            self._at[name] = self._graph.do("Add", zero, float(name)), 0
            self._width[self._at[name][0]] = 1
        if not whole and len(set(names)) == 1:
            names = names[:1]
        places = [self._at[name] for name in names]
        values = tuple(dict.fromkeys(value for value, _ in places))
        if values not in self._joined:
            self._joined[values] = self._graph.joined(values)
        widths = [self._width[value] for value in values]
        begins = dict(zip(values, np.cumsum([0, *widths]).tolist(), strict=False))
        wanted = [begins[value] + place for value, place in places]
        if wanted == list(range(sum(widths))):
            return self._joined[values]
        return self._graph.do("Gather", self._joined[values], np.array(wanted), axis=-1)
