"""Networks and cart-pole policies as the bytes of an ONNX model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.physics import ANGLE
from lagros_policies.export.onnx_bytes import BATCH, model, node, tensor
from lagros_policies.export.source import NetworkSource
from lagros_policies.learning.networks import Mlp
from lagros_policies.tasks.cartpole.features import FEATURES, cartpole_features

Float32Array = NDArray[np.float32]


def network_model(network: Mlp) -> bytes:
    """Return a network alone: input "x" of shape (1, inputs), output "y" of shape (1, outputs)."""
    nodes, tensors = _layers(network, "x", "y")
    return model(nodes, tensors, ("x", 1, network.inputs), ("y", 1, network.outputs))


def policy_model(source: NetworkSource) -> bytes:
    """Return a cart-pole policy with its features and its mirror.

    Args:
        source: The policy.

    Returns:
        A model of input "observation", shape (batch, 13), that of lagros/CartPole-v0, and output
        "force", shape (batch, 1) [N]. The weights' name and digest are in its metadata.
    """
    # A feature of the right side is a number of the observation, or the difference of two. (As the
    # product with a matrix of ones and zeros, one infinite number would make all of them NaN.)
    features, _ = cartpole_features(np.eye(task.OBSERVATION_DIM, dtype=np.float32))
    lean = np.array([task.INITIAL_STATE.start + ANGLE])
    mirror = np.ones(len(FEATURES), np.float32)
    mirror[: FEATURES.index("time [s]")] = -1.0  # time has no side
    layers, tensors = _layers(source.network, "mirrored", "answer")
    tensors = [
        tensor("seen.columns", features.argmax(axis=0)),
        tensor("origin.columns", features.argmin(axis=0)),
        tensor("origin.counts", -features.min(axis=0)),
        tensor("lean.column", lean),
        tensor("zero", np.zeros(1, np.float32)),
        tensor("one", np.ones(1, np.float32)),
        tensor("minus.one", -np.ones(1, np.float32)),
        tensor("left.signs", mirror),
        tensor("right.signs", np.ones_like(mirror)),
        *tensors,
    ]
    nodes = [
        node("Gather", ["observation", "seen.columns"], "seen", axis=1),
        node("Gather", ["observation", "origin.columns"], "beside", axis=1),
        node("Greater", ["origin.counts", "zero"], "has.origin"),
        node("Where", ["has.origin", "beside", "zero"], "origin"),
        node("Sub", ["seen", "origin"], "features"),
        node("Gather", ["observation", "lean.column"], "initial.angle", axis=1),
        node("Less", ["initial.angle", "zero"], "left"),
        node("Where", ["left", "left.signs", "right.signs"], "signs"),
        node("Mul", ["features", "signs"], "mirrored"),
        *layers,
        node("Where", ["left", "minus.one", "one"], "side"),
        node("Mul", ["answer", "side"], "force"),
    ]
    metadata = {"policy": source.name, "weights": source.file, "weights_sha256": source.digest}
    return model(
        nodes,
        tensors,
        ("observation", BATCH, task.OBSERVATION_DIM),
        ("force", BATCH, 1),
        {**metadata, "unit": "N"},
    )


def _layers(network: Mlp, name: str, answer: str) -> tuple[list[bytes], list[bytes]]:
    """Return the nodes and the weights of a network from one value of the graph to another."""
    nodes, tensors = [], []
    last = len(network.weights) - 1
    for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors += [tensor(f"w{index}", weight), tensor(f"b{index}", bias)]
        output = answer if index == last else f"z{index}"
        nodes.append(node("Gemm", [name, f"w{index}", f"b{index}"], output))
        if index != last:
            nodes.append(node("Tanh", [output], f"a{index}"))
            name = f"a{index}"
    return nodes, tensors
