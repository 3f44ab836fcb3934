"""A policy of a task of one body, taken apart: what it sees, a perceptron, and signs."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, cast

import numpy as np

from lagros_envs.arrays import Float32Array
from lagros_envs.numbers import functions
from lagros_envs.task import Task
from lagros_policies.export.program import Numbers, Part, Program, Repeated
from lagros_policies.export.source import Exported
from lagros_policies.learning.features import See, seen
from lagros_policies.learning.networks import Mlp


def exported(policy: Any) -> Exported:
    """Take a `NetworkPolicy` apart."""
    task, network, see = cast(Task, policy.settings), cast(Mlp, policy.network), policy.see
    count = network.scheduled

    def look(given: Numbers) -> tuple[Numbers, Numbers]:
        found = see(given, functions)
        return found.features[count:], [*found.features[:count], *found.signs]

    def act(outputs: Numbers, context: Numbers) -> Numbers:
        controls, signs = affine(outputs, context[:count]), context[count:]
        return [u * sign for u, sign in zip(controls, signs, strict=True)] if signs else controls

    program = Program(
        _parts(task),
        look,
        list(zip(network.weights, network.biases, strict=True)),
        act,
        _control(task),
        repeated=None if network.alike is None else Repeated(network.alike, network.stored),
        notes=(f"The task: {task.env_id}.",),
        metadata=(("unit", ", ".join(name.partition("[")[2][:-1] for name in task.control_names)),),
    )
    return Exported(program, partial(_answer, network, see), partial(example_observations, task))


def affine(outputs: Numbers, state: Numbers) -> Numbers:
    """Return c + K s of what the layers of a network give, c and the rows of K; see `Mlp`."""
    count = len(state)
    size = len(outputs) // (1 + count)
    answers = list(outputs[:size])
    for row in range(size):
        for column, one in enumerate(state):
            answers[row] = answers[row] + outputs[size + row * count + column] * one
    return answers


def _answer(network: Mlp, see: See, observation: Float32Array) -> Float32Array:
    features, signs = seen(see, observation)
    return network(features) if signs is None else network(features) * signs


def _parts(task: Task) -> tuple[Part, ...]:
    count = task.system.state_dim
    names = ", ".join(task.state_names or (f"x{index}" for index in range(count)))
    parts = [
        Part("state", count, f"x = [{names}]"),
        Part("goal", count, "x_f, likewise"),
        Part("initial_state", count, "x(0) of the episode, likewise"),
        Part("time", 0, "since the start of the episode [s]"),
    ]
    if task.most_discs:
        text = "x [m], y [m] and radius [m] of each; zeros in places where there is none"
        parts.append(Part("discs", 3 * task.most_discs, text))
    return tuple(parts)


def _control(task: Task) -> Part:
    """Return the controls; one alone has the name that the task gives it."""
    count = task.system.control_dim
    names = task.control_names or tuple(f"u{index}" for index in range(count))
    kept = [
        f"{name.split(' [')[0]} in [{low:g}, {high:g}]"
        for name, low, high in zip(names, task.control_low, task.control_high, strict=True)
        if math.isfinite(low) or math.isfinite(high)
    ]
    bounds = f" (the environment keeps {', '.join(kept)})" if kept else ""
    text = (
        f"u = [{', '.join(names)}], not saturated{bounds}; hold it for one control step of "
        f"{task.control_period:g} s"
    )
    name = names[0].split(" [")[0]
    return Part(name if count == 1 and name.isidentifier() else "control", count, text)


def example_observations(task: Task, count: int, seed: int = 0) -> Float32Array:
    """Return random observations, shape (count, o), over the range of the task.

    Scenarios are drawn as in an episode. States lie anywhere around the goal, as far to either side
    as starts do (where none does, up to 3 units), and times within the episode.
    """
    rng = np.random.default_rng(seed)
    drawn, layout = task.sample_many(rng, count), task.layout
    rows = np.zeros((count, layout.size), np.float32)
    spread = np.max(np.abs(drawn.initial_state - drawn.goal), axis=0)
    spread = np.where(spread > 0.0, spread, 3.0)
    rows[:, layout.state] = drawn.goal + spread * rng.uniform(-1.0, 1.0, drawn.goal.shape)
    rows[:, layout.goal] = drawn.goal
    rows[:, layout.initial_state] = drawn.initial_state
    rows[:, layout.time] = rng.uniform(0.0, task.time_limit, count)
    discs = drawn.discs.reshape(count, -1)
    rows[:, layout.discs.start : layout.discs.start + discs.shape[1]] = discs
    return rows
