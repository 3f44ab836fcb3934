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
    own, sizes = len(program.places), []
    for kind in program.bodies:
        sizes += [kind.slots * kind.each.size, kind.slots]
    given = graph.split("observation", [own, *sizes]) if sizes else ["observation"]
    # With bodies there are three axes: batch, slots (one, of what belongs to nobody), numbers.
    deep = bool(sizes)
    first = graph.do("Reshape", given[0], np.array([0, 1, own])) if deep else given[0]
    names = dict(zip(program.places, graph.split(first, [1] * own), strict=True))
    seen = graph.lines(program.looking, names, program.places)
    count = len(seen) - len(program.contexts)
    context = dict(zip(program.contexts, seen[count:], strict=True))
    inputs = seen[:count]
    for place, kind in enumerate(program.bodies):
        line = program.seeing(kind)
        inputs.append(graph.pooled(kind, line, given[1 + 2 * place : 3 + 2 * place], context))
    between = "Tanh" if program.tanh else "Relu"
    answer = graph.layers(graph.joined(inputs), program.layers, between)
    outputs = len(program.layers[-1][1])
    pieces = graph.split(answer, [1] * outputs)
    acting = program.acting
    named = {**dict(zip(acting.inputs, pieces, strict=False)), **context}
    control = graph.joined(graph.lines(acting, named, acting.inputs))
    if program.last is not None:
        control = graph.do("Relu", graph.do("MatMul", control, program.last))
    size = program.control.size
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

    def lines(
        self, line: StraightLine, names: dict[str, str], places: Sequence[str], zeros: str = ""
    ) -> list[str]:
        """Add recorded operations.

        Args:
            line: The operations.
            names: Of inputs to those of values.
            places: Inputs that have the shape of the outputs.
            zeros: Of that shape; made of the first input if left out.
        """
        known = dict(names)

        def value(operand: str) -> str:
            if operand not in known:
                known[operand] = self.constant(float(operand))
            return known[operand]

        # The comparison of a minimum is added only where something else asks for it.
        asked = {one for out in line.operations.values() if not is_bound(line, out)
                 for one in out.operands}  # fmt: skip
        for name, operation in line.operations.items():
            if is_bound(line, operation):
                tested = line.operations[operation.operands[0]]
                bound = "Min" if tested.symbol == ">" else "Max"
                known[name] = self.do(bound, *map(value, tested.operands))
            elif operation.symbol not in ("<=", ">") or name in asked:
                operands = map(value, operation.operands)
                known[name] = self.do(_OPERATORS[operation.symbol], *operands)
        shaped = _depending(line, places)
        results = []
        for output in line.outputs:
            result = value(output)
            if output not in shaped:
                zeros = zeros or self.do("Mul", value(places[0]), 0.0)
                result = self.do("Add", result, zeros)
            results.append(result)
        return results

    def pooled(
        self, kind: Bodies, line: StraightLine, given: Sequence[str], context: dict[str, str]
    ) -> str:
        """Add up what is seen of the bodies of one kind.

        Args:
            kind: The kind.
            line: What is seen of one.
            given: Their numbers, and the mask.
            context: Values that do not differ among them.
        """
        size = kind.each.size
        slots = self.do("Reshape", given[0], np.array([0, kind.slots, size]))
        mask = self.do("Reshape", given[1], np.array([0, kind.slots, 1]))
        places = dict(zip(kind.each.places, self.split(slots, [1] * size), strict=True))
        zeros = self.do("Mul", mask, 0.0)
        names = {**places, **context}
        *features, weight = self.lines(line, names, kind.each.places, zeros)
        seen = self.layers(self.joined(features), kind.layers, "Relu", "Relu")
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


def _depending(line: StraightLine, places: Sequence[str]) -> set[str]:
    """Return the names of what depends on some inputs."""
    found = set(places)
    for name, operation in line.operations.items():
        if not found.isdisjoint(operation.operands):
            found.add(name)
    return found
