"""A spacecraft policy as an ONNX model: the flat observation to the forces of the thrusters.

The same equations as `spacecraft_features` and `SpacecraftNetworkPolicy.thrust`, with a slot of the
observation as an axis of its own: bodies that are not sensed are computed too, and weigh nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lagros_envs.tasks.spacecraft.sensing import NEIGHBOUR_DIM, OBSTACLE_DIM
from lagros_policies.export.onnx_bytes import BATCH, model, node, tensor
from lagros_policies.export.source import SpacecraftSource
from lagros_policies.tasks.spacecraft import features
from lagros_policies.tasks.spacecraft.pace import CRUISE_SPEED, LEAST_TIME
from lagros_policies.tasks.spacecraft.thrusters import allocation_matrix

Float32Array = NDArray[np.float32]
Vector = tuple[str, str]  # names of its two components

_SLOT = 1  # axis of the slots, between the batch and the columns


class _Graph:
    """A graph that grows: every method adds an operation and returns the name of its result."""

    def __init__(self) -> None:
        self.nodes: list[bytes] = []
        self.tensors: list[bytes] = []

    def constant(self, values: NDArray[np.generic] | float | Sequence[int]) -> str:
        name = f"c{len(self.tensors)}"
        whole = isinstance(values, Sequence)
        self.tensors.append(tensor(name, np.asarray(values, np.int64 if whole else np.float32)))
        return name

    def do(
        self, operation: str, *inputs: str | float, name: str | None = None, **attributes: int
    ) -> str:
        names = [item if isinstance(item, str) else self.constant(item) for item in inputs]
        result = name or f"v{len(self.nodes)}"
        self.nodes.append(node(operation, names, result, **attributes))
        return result

    def columns(self, value: str, indices: Sequence[int]) -> str:
        """Take some columns of the last of three axes."""
        return self.do("Gather", value, self.constant(list(indices)), axis=2)

    def pair(self, value: str, first: int) -> Vector:
        """Take two columns as a vector."""
        return self.columns(value, [first]), self.columns(value, [first + 1])

    def part(self, observation: str, where: slice, shape: Sequence[int]) -> str:
        """Take a part of the observation, with axes (batch, *shape)."""
        taken = self.do(
            "Gather", observation, self.constant(list(range(where.stop))[where]), axis=1
        )
        return self.do("Reshape", taken, self.constant([0, *shape]))

    def sum_of_products(self, first: Vector, second: Vector) -> str:
        return self.do(
            "Add",
            self.do("Mul", first[0], second[0]),
            self.do("Mul", first[1], second[1]),
        )

    def difference_of_products(self, first: Vector, second: Vector) -> str:
        return self.do(
            "Sub",
            self.do("Mul", first[0], second[0]),
            self.do("Mul", first[1], second[1]),
        )

    def turned(self, vector: Vector, axis: Vector) -> Vector:
        """Turn a vector by the angle of a unit vector: the product of complex numbers."""
        swapped = (vector[1], vector[0])
        return self.difference_of_products(vector, axis), self.sum_of_products(swapped, axis)

    def turned_back(self, vector: Vector, axis: Vector) -> Vector:
        """Turn a vector by minus that angle."""
        swapped = (vector[1], vector[0])
        return self.sum_of_products(vector, axis), self.difference_of_products(swapped, axis)

    def length(self, vector: Vector) -> str:
        return self.do("Sqrt", self.sum_of_products(vector, vector))

    def negative(self, vector: Vector) -> Vector:
        return self.do("Neg", vector[0]), self.do("Neg", vector[1])

    def layers(self, value: str, layers: list[tuple[Float32Array, Float32Array]]) -> str:
        """Run through layers, each followed by a ReLU."""
        for weight, bias in layers:
            product = self.do("MatMul", value, self.constant(weight))
            value = self.do("Relu", self.do("Add", product, self.constant(bias)))
        return value


def spacecraft_model(source: SpacecraftSource) -> bytes:
    """Return a spacecraft policy, from the flat observation to u >= 0.

    Args:
        source: The policy; its preset and number of agents fix the slots of the observation.

    Returns:
        A model of input "observation", shape (batch, o), that of lagros/Spacecraft-v0, and output
        "thrust", shape (batch, 8) [N]. The weights' name and digest, the numbers of slots and the
        radii are in its metadata.
    """
    graph, layout = _Graph(), source.layout
    at = layout.slices
    agent_radius, core_radius = source.radii
    # Three axes everywhere: batch, slots (one, of what belongs to the agent itself), columns.
    own = graph.part("observation", slice(0, at["neighbours"].start), (1, -1))
    velocity, facing = graph.pair(own, 2), graph.pair(own, 4)
    ahead, inputs = _own_features(graph, source, own)

    neighbours = graph.part("observation", at["neighbours"], (layout.neighbours, NEIGHBOUR_DIM))
    sums = _pooled(
        graph,
        source,
        "neighbour",
        (graph.pair(neighbours, 0), graph.pair(neighbours, 2)),
        ahead,
        (graph.constant(2.0 * agent_radius), graph.constant(source.policy.settings.sensing_radius)),
    )
    discs = graph.part("observation", at["obstacles"], (layout.obstacles, OBSTACLE_DIM))
    radius = graph.columns(discs, [2])
    reach = graph.do("Add", radius, source.policy.settings.sensing_radius)
    others = _pooled(
        graph,
        source,
        "obstacle",
        (graph.pair(discs, 0), graph.negative(velocity)),
        ahead,
        (graph.do("Add", radius, core_radius), reach),
    )
    *hidden, (weight, bias) = source.network.layers["agent"]
    seen = graph.do("Concat", inputs, sums, others, axis=2)
    product = graph.do("MatMul", graph.layers(seen, hidden), graph.constant(weight))
    acceleration = graph.do("Add", product, graph.constant(bias))
    _thrust(graph, source, acceleration, ahead, facing)
    metadata = {
        "policy": source.name,
        "weights": source.file,
        "weights_sha256": source.digest,
        "unit": "N",
        "neighbour_slots": str(layout.neighbours),
        "obstacle_slots": str(layout.obstacles),
        "agent_radius": str(agent_radius),
        "core_radius": str(core_radius),
    }
    return model(
        graph.nodes,
        graph.tensors,
        ("observation", BATCH, source.inputs),
        ("thrust", BATCH, source.outputs),
        metadata,
    )


def _own_features(graph: _Graph, source: SpacecraftSource, own: str) -> tuple[Vector, str]:
    """Return the axis to the goal and what the agent knows of itself, shape (batch, 1, 9)."""
    goal = graph.pair(own, 0)
    goal = (graph.do("Add", goal[0], features.SMALL), goal[1])
    distance = graph.length(goal)
    ahead = (graph.do("Div", goal[0], distance), graph.do("Div", goal[1], distance))
    course = graph.turned_back(graph.pair(own, 2), ahead)
    left = graph.do("Sub", source.policy.settings.horizon, graph.columns(own, [8]))
    needed = graph.do("Max", graph.do("Div", distance, CRUISE_SPEED), LEAST_TIME)
    left = graph.do("Max", needed, left)
    soon = float(features.SOON)
    columns = (
        distance,
        graph.do("Min", distance, float(features.CLOSE)),
        *course,
        left,
        graph.do("Min", left, soon),
        graph.do("Div", distance, graph.do("Add", left, soon)),
        graph.columns(own, [6, 7]),
    )
    return ahead, graph.do("Concat", *columns, axis=2)


def _pooled(
    graph: _Graph,
    source: SpacecraftSource,
    kind: str,
    body: tuple[Vector, Vector],
    ahead: Vector,
    distances: tuple[str, str],
) -> str:
    """Return the weighted sum over the slots of one kind, shape (batch, 1, width).

    Args:
        graph: The graph.
        source: The policy.
        kind: "neighbour" or "obstacle".
        body: Where the bodies are and how they move, relative to the agent.
        ahead: The axis to the goal.
        distances: Of the centres at touch, and at the rim of what is sensed.
    """
    apart, motion = (graph.turned_back(vector, ahead) for vector in body)
    touch, rim = distances
    centre = graph.do("Add", graph.length(apart), features.SMALL)
    unit = (graph.do("Div", apart[0], centre), graph.do("Div", apart[1], centre))
    gap = graph.do("Sub", centre, touch)
    near = features.NEAR
    nearness = graph.do("Exp", graph.do("Div", graph.do("Max", gap, -near), -near))
    closing = graph.do("Neg", graph.sum_of_products(unit, motion))
    # What does not differ among the slots takes their shape.
    zeros = graph.do("Mul", centre, 0.0)
    columns = [*unit, gap, nearness, *(graph.do("Add", part, zeros) for part in motion), closing]
    if kind == "obstacle":
        columns.append(touch)
    values = graph.do("Concat", *columns, axis=2)
    fading = graph.do("Div", graph.do("Sub", rim, centre), features.FADE)
    weight = graph.do("Max", graph.do("Min", fading, 1.0), 0.0)
    layout = source.layout
    mask = graph.part(
        "observation", layout.slices[f"{kind}_mask"], (getattr(layout, f"{kind}s"), 1)
    )
    # Zero times the mask: a NaN there must not hide a body.
    absent = graph.do("Mul", mask, 0.0)
    sensed = graph.do("Where", graph.do("Greater", mask, 0.0), weight, absent)
    weighted = graph.do("Mul", graph.layers(values, source.network.layers[kind]), sensed)
    return graph.do("ReduceSum", weighted, graph.constant([_SLOT]), keepdims=1)


def _thrust(
    graph: _Graph, source: SpacecraftSource, acceleration: str, ahead: Vector, facing: Vector
) -> None:
    """Add the turns into the body's axes and the allocation; the result is "thrust"."""
    body = source.policy.settings.system
    push = graph.turned(graph.turned(graph.pair(acceleration, 0), ahead), facing)
    wrench = graph.do("Concat", *push, graph.columns(acceleration, [2]), axis=2)
    scale = np.array([body.mass, body.mass, 2.0 * body.inertia])
    matrix = scale[:, None] * allocation_matrix(body)
    forces = graph.do("Relu", graph.do("MatMul", wrench, graph.constant(matrix)))
    graph.do("Reshape", forces, graph.constant([0, source.outputs]), name="thrust")
