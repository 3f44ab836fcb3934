"""What a network sees of an observation: written once, for NumPy, for training and for export.

The features of a task are one function over the kinds of number of `lagros_envs.numbers`: called
with floats or arrays it gives features, called with recorded numbers the list of its operations, of
which `lagros export` makes C and ONNX. It may use `+ - * /`, integer powers, `abs`, comparisons,
`&`, `|` and the functions that are passed to it, and nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import chain
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics.held import float_function
from lagros_envs.dynamics.straight_line import plain_source, straight_line
from lagros_envs.numbers import functions
from lagros_envs.task import Task
from lagros_policies.learning.layers import Alike
from lagros_policies.room import part_of

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]


class Seen(NamedTuple):
    """What is made of one observation.

    Attributes:
        features: What goes into the network.
        signs: What each of its outputs is multiplied by to be the control u, in units of u, not of
            the action; () for nothing. A task that is its own mirror image learns one side only.
    """

    features: Sequence[Any]
    signs: Sequence[Any] = ()


Vector = Sequence[Any]
_PLACES = 3  # where features are looked at for being affine
_STILL = 1e-8  # what differences leave of slopes that are zero
_STEP = 1e-4  # of central differences, in units of the direction
_SMALL = 1e-3  # lengths below are none [m, m/s]
_MOTION = (
    "distance of the goal [m]",
    "ahead x",
    "ahead y",
    "motion x [m/s]",
    "motion y [m/s]",
    "speed [m/s]",
    "motion ahead [m/s]",
    "motion aside [m/s]",
)
_BEGUN = ("ahead", "aside", "side")
_DISC = (
    "x [m]",
    "y [m]",
    "place ahead [m]",
    "place aside [m]",
    "place along the motion [m]",
    "place across it [m]",
    "gap [m]",
    "nearness",
    "presence",
)
# (components of an observation, functions) -> features and signs.
See = Callable[[Sequence[Any], Any], Seen]


def seen(see: See, observation: Float32Array) -> tuple[Float32Array, Float32Array | None]:
    """Return the features and the signs of observations.

    Args:
        see: The function.
        observation: Shape (o,) or (..., o).

    Returns:
        Features, shape (f,) or (..., f), and signs, likewise; None where there are none.
    """
    # In double precision, rounded at the end; Python's floats are the quickest for one.
    if observation.ndim == 1:
        one = see(observation.tolist(), functions)
        signs = np.array(one.signs, np.float32) if one.signs else None
        return np.array(one.features, np.float32), signs
    rows = observation.reshape(-1, observation.shape[-1])
    components: Any = rows.T.astype(np.float64, order="C")
    many = see(components, functions)
    features, signs = (_table(columns, observation.shape[:-1]) for columns in many)
    return features, signs if many.signs else None


class RecordedView:
    """Sees as a view does, bit for bit, and one observation several times as fast.

    Args:
        see: The view; one that cannot be recorded is asked itself.
        size: Numbers of an observation.
    """

    def __init__(self, see: View, size: int) -> None:
        """Record it once."""
        self._made_from = see, size
        self._see, self._count = see, len(see.names)
        self._one: Any = None
        names = [f"x{place}" for place in range(size)]
        with suppress(TypeError):  # `lagros export` says what it is that cannot be recorded
            line = straight_line(lambda given: [*chain(*see(given, functions))], names)
            self._one = float_function(plain_source(line))

    def __call__(self, observation: Sequence[Any], functions: Any) -> Seen:
        """See an observation, given by its components."""
        if self._one is None or not isinstance(observation, list):
            return self._see(observation, functions)
        found = self._one(observation)
        return Seen(found[: self._count], found[self._count :])

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what was recorded, not the function made of it."""
        return RecordedView, self._made_from


def moved(see: See, observation: FloatArray, way: FloatArray) -> FloatArray:
    """Return how features move with an observation, by central differences in double precision.

    Args:
        see: The function.
        observation: Shape (s, o).
        way: Direction in which each moves, shape (s, o).

    Returns:
        Derivatives of the features, shape (s, f).
    """

    def at(place: FloatArray) -> FloatArray:
        columns: Any = place.T
        return np.stack(np.broadcast_arrays(*see(columns, functions).features), axis=-1)

    slope: FloatArray = at(observation + _STEP * way) - at(observation - _STEP * way)
    return slope / (2.0 * _STEP)


class View(Protocol):
    """What the networks of a task see of an observation; built of the task.

    Attributes:
        names: Of the features.
        alike: Which of them are of things that are alike; None for none.
        affine: How many of them, the first ones, are affine in the state while the others do not
            depend on it; a network may be affine in these.
    """

    names: tuple[str, ...]
    alike: Alike | None
    affine: int

    def __call__(self, observation: Sequence[Any], functions: Any) -> Seen:
        """See an observation, given by its components."""


def view_of(task: Task) -> View:
    """Return what the networks of a task see: what the task says, or the usual view."""
    if task.features is not None:
        return Stated(task)
    view: View = part_of(task, "VIEW", "lagros_policies.learning.features:Usual")(task)
    return view


class Stated:
    """What `task.features` says.

    Args:
        task: The task.

    Attributes:
        affine: How many of the features, the first ones, are affine in the state at a few places,
            while the others do not move with it there.
    """

    alike: Alike | None = None

    def __init__(self, task: Task) -> None:
        """Count what it says."""
        self.task = task
        count = len(self([1.0] * task.layout.size, functions).features)
        self.names = tuple(f"feature {index}" for index in range(count))
        self.affine = _affine(self, task)

    def __call__(self, observation: Sequence[Any], functions: Any) -> Seen:
        """See an observation, given by its components."""
        assert self.task.features is not None
        return Seen(self.task.features(observation, functions))


def _affine(see: See, task: Task) -> int:
    """Return how many of the first features are affine in the state, the others not moved by it."""
    rng, n = np.random.default_rng(0), task.system.state_dim
    rows = np.tile(rng.uniform(0.1, 1.0, task.layout.size), (n, 1))
    ways, slopes = np.zeros_like(rows), []
    ways[:, task.layout.state] = np.eye(n)
    for _ in range(_PLACES):
        rows[:, task.layout.state] = rng.standard_normal(n)
        slopes.append(moved(see, rows, ways))
    first = slopes[0]
    count = int(np.flatnonzero(np.any(np.abs(first) > _STILL, axis=0)).max(initial=-1)) + 1
    return count if np.allclose(slopes, first, rtol=1e-6, atol=_STILL) else 0


class Usual:
    """What is seen of any task of one body: itself, its goal, and each disc alike.

    Of the body: where the goal is, the other coordinates of state and goal, sine and cosine of
    angles, how the position moves when the control rests, and the time that is left. Of a disc:
    where it is, in the axes of the world, of the way to the goal and of the motion, and how far its
    edge is from the body's; zeros where there is none. With `Learning.keeps_plan` also where the
    episode began, on which its plan depends, and where each disc is from there.

    Args:
        task: The task; a coordinate whose unit is "[rad]" is an angle.

    Attributes:
        names: Of the features.
        alike: How many discs the last features are of.
    """

    affine = 0

    def __init__(self, task: Task) -> None:
        """Look at the coordinates."""
        n = task.system.state_dim
        self.task, self._discs = task, task.most_discs if task.position else 0
        self._begun = task.learning is not None and task.learning.keeps_plan
        of_disc = (*(f"{part} of the start" for part in _BEGUN), *_DISC) if self._begun else _DISC
        self.alike = Alike(self._discs, len(of_disc)) if self._discs else None
        names = task.state_names or tuple(f"x{index}" for index in range(n))
        self._plane = len(task.position) == 2
        self._placed = task.position or tuple(range(n))
        self._others = tuple(index for index in range(n) if index not in self._placed)
        self._angles = tuple(index for index in range(n) if names[index].endswith("[rad]"))
        self._reach = max(task.body_radius + task.margin, _SMALL)
        self.names = (
            *(f"{names[index]} of the goal from here" for index in self._placed),
            *(names[index] for index in self._others),
            *(f"{names[index]} of the goal" for index in self._others),
            *(f"{part} {names[index]}" for index in self._angles for part in ("sin", "cos")),
            "time left [s]",
            *(_MOTION if self._plane else ()),
            *(self._names_of_start(names) if self._begun else ()),
            *(f"{part} of disc {disc}" for disc in range(self._discs) for part in of_disc),
        )

    def __call__(self, observation: Sequence[Any], functions: Any) -> Seen:
        """See an observation, given by its components."""
        task, layout = self.task, self.task.layout
        state, goal = observation[layout.state], observation[layout.goal]
        features = [goal[index] - state[index] for index in self._placed]
        features += [state[index] for index in self._others]
        features += [goal[index] for index in self._others]
        for index in self._angles:
            features += [functions.sin(state[index]), functions.cos(state[index])]
        features.append(task.time_limit - observation[layout.time])
        if self._plane:
            rates = task.system.derivative(state, task.control_centre, functions)
            way, motion = features[:2], [rates[index] for index in task.position]
            (ahead, distance), (course, speed) = (_unit(one, functions) for one in (way, motion))
            features += [distance, *ahead, *motion, speed, *_turned(motion, ahead)]
        start = observation[layout.initial_state]
        if self._begun:
            features += [start[index] - state[index] for index in self._placed]
            features += [start[index] for index in self._others]
            features += [goal[index] - start[index] for index in self._placed]
        if self._discs:
            here, discs = [state[index] for index in task.position], observation[layout.discs]
            if self._begun:
                begun = [start[index] for index in task.position]
                route, _ = _unit([goal[index] - start[index] for index in task.position], functions)
            for place in range(0, 3 * self._discs, 3):
                disc = discs[place : place + 3]
                if self._begun:
                    features += self._from_start(disc, begun, route, functions)
                features += self._disc(disc, here, ahead, course, functions)
        return Seen(features)

    def _names_of_start(self, names: Sequence[str]) -> tuple[str, ...]:
        return (
            *(f"{names[index]} of the start from here" for index in self._placed),
            *(f"{names[index]} of the start" for index in self._others),
            *(f"{names[index]} of the goal from the start" for index in self._placed),
        )

    def _from_start(self, disc: Vector, begun: Vector, route: Vector, functions: Any) -> list[Any]:
        """Return where a disc is along the way from start to goal, and how much in it."""
        ahead, aside = _turned((disc[0] - begun[0], disc[1] - begun[1]), route)
        seen = ahead, aside, functions.exp(-aside * aside)
        return [functions.where(disc[2] > 0.0, one, 0.0) for one in seen]

    def _disc(
        self, disc: Vector, here: Vector, ahead: Vector, course: Vector, functions: Any
    ) -> list[Any]:
        x, y, radius = disc
        apart = x - here[0], y - here[1]
        gap = functions.sqrt(apart[0] * apart[0] + apart[1] * apart[1]) - radius
        gap = gap - self.task.body_radius
        near = functions.exp(-gap / self._reach)
        seen = *apart, *_turned(apart, ahead), *_turned(apart, course), gap, near, 1.0
        there = radius > 0.0
        return [functions.where(there, one, 0.0) for one in seen]


def _unit(vector: Vector, functions: Any) -> tuple[Vector, Any]:
    """Return a vector of the plane at length one, or less where it is almost zero; its length."""
    x, y = vector
    length = functions.sqrt(x * x + y * y + _SMALL * _SMALL)
    return (x / length, y / length), length


def _turned(vector: Vector, axis: Vector) -> Vector:
    """Return a vector of the plane along an axis and across it."""
    (x, y), (cosine, sine) = vector, axis
    return x * cosine + y * sine, y * cosine - x * sine


def _table(columns: Sequence[Any], shape: tuple[int, ...]) -> Float32Array:
    table = np.empty((math.prod(shape), len(columns)), np.float32)
    for place, column in enumerate(columns):
        table[:, place] = column
    return table.reshape(*shape, len(columns))
