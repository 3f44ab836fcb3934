"""What the environment of a task of one body and its vector form share."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, cast

import numpy as np
from gymnasium import spaces

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.checks import check_instance
from lagros_envs.disturbances import Disturbance, channel_mask
from lagros_envs.numbers import functions
from lagros_envs.numbers.functions import where
from lagros_envs.options import nominal_option, option_numbers
from lagros_envs.registry import task_named, with_settings
from lagros_envs.task import LARGEST_CONTROL, Numbers, Scenario, Task

Channels = Literal["all", "rates"] | Sequence[bool]


class Start(NamedTuple):
    """How an episode begins.

    Attributes:
        state: x(0).
        goal: x_f.
        discs: Centre and radius of each, shape (most_discs, 3).
        fixed: What the rules of a step are given of the episode: the discs, then the goal.
        blank: The observation but for state and time, not to be written to.
    """

    state: tuple[float, ...]
    goal: tuple[float, ...]
    discs: FloatArray
    fixed: tuple[float, ...]
    blank: Float32Array


class OfTask:
    """How both find their task.

    Attributes:
        task_name: The task of an environment whose maker names none.
        usual: The task before it was given any settings.
    """

    task_name: ClassVar[str] = ""
    usual: Task

    def _settings(self, task: Task | str | None, settings: Task | Mapping[str, Any] | None) -> Task:
        """Return the task from what the environment was given."""
        if task is None:
            task = settings if isinstance(settings, Task) and not self.task_name else self.task_name
        if not task:
            raise ValueError("this environment is of any task: pass the task, or the name of one")
        found = task_named(task) if isinstance(task, str) else task
        check_instance("task", found, Task)
        self.usual = cast(Task, found)
        return with_settings(self.usual, settings)

    def _usual_steps(self) -> int:
        return self.usual.steps


def disturbance_of(
    task: Task, kind: Any, bound: float | None, channels: Channels, metric: Any
) -> Disturbance:
    """Return the disturbance of an environment from its arguments."""
    n = task.system.state_dim
    rates = tuple(index in task.rates or not task.rates for index in range(n))
    bound = task.defaults.bound if bound is None else bound
    return Disturbance(kind, bound, channel_mask(channels, rates), metric)


def named_space(task: Task) -> spaces.Dict:
    """Return the observation's named parts, in the order in which they are flattened.

    The parts are `state` x, `goal` x_f and `initial_state` x(0), (n,) each, `time` t, (1,) in [s],
    and, where the task has discs, `discs`, (most_discs, 3) in [m].
    """

    def box(low: float, high: float, *shape: int) -> spaces.Box:
        return spaces.Box(np.full(shape, low, np.float32), np.full(shape, high, np.float32))

    n = task.system.state_dim
    parts = [(name, box(-math.inf, math.inf, n)) for name in ("state", "goal", "initial_state")]
    # As the last step computes it, which may differ in the last digit.
    parts.append(("time", box(0.0, task.steps * task.control_period, 1)))
    if task.most_discs:
        parts.append(("discs", box(-math.inf, math.inf, task.most_discs, 3)))
    return spaces.Dict(OrderedDict(parts))


def action_space(task: Task) -> spaces.Box:
    """Return the space of the actions, (m,) in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, (task.system.control_dim,), np.float32)


def actuators(task: Task) -> tuple[Numbers, Numbers, Numbers, Numbers]:
    """Return centre, scale, least and largest control, (m,) each."""
    # A sum with -0.0 changes no bit.
    centre = tuple(one or -0.0 for one in task.control_centre)
    low = tuple(max(one, -LARGEST_CONTROL) for one in task.control_low)
    high = tuple(min(one, LARGEST_CONTROL) for one in task.control_high)
    return centre, task.control_scale, low, high


def applied(task: Task, action: Sequence[Any]) -> list[Any]:
    """Return `Task.control` of one action, m numbers of any kind that can be compared."""
    control = []
    for value, centre, scale, low, high in zip(action, *actuators(task), strict=True):
        moved = centre + scale * value
        moved = where(moved > low, moved, low)
        control.append(where(moved > high, high, moved))
    return control


def meaning_of(task: Task) -> str:
    """Return what the numbers of an action are, for messages."""
    names = [name.partition(" [")[0] for name in task.control_names]
    return f"the {', '.join(names) or 'controls'}"


def contacts(task: Task, discs: FloatArray) -> FloatArray:
    """Return what the rules of a step are given of discs (..., k, 3), flat (..., 3 k)."""
    given = discs.copy()
    radii = discs[..., 2]
    given[..., 2] = np.where(radii > 0.0, radii + task.body_radius, 0.0) ** 2
    return given.reshape(*discs.shape[:-2], -1)


def option_names(task: Task) -> tuple[str, ...]:
    """Return what `reset(options=...)` may hold."""
    names = ("initial_state", "initial_error", "goal", "nominal")
    return (*names, "discs") if task.most_discs else names


def stated_scenario(
    options: dict[str, Any],
    task: Task,
    batch: tuple[int, ...] = (),
    looked_at: BoolArray | None = None,
) -> dict[str, FloatArray]:
    """Return the parts of a `Scenario` that the options hold, and the error at its start.

    Args:
        options: As given to reset.
        task: The task.
        batch: Leading axes of each part.
        looked_at: Which of a leading axis are read; all of them if left out.

    Raises:
        ValueError: A value has the wrong shape, is not finite or too large, or starts fallen.
    """
    given: dict[str, FloatArray] = {}
    shape = (*batch, task.system.state_dim)
    if "initial_state" in options:
        value = options["initial_state"]
        start = option_numbers("initial_state", value, shape, looked_at=looked_at)
        read = np.atleast_2d(start if looked_at is None else start[looked_at])
        if np.any(task.fallen([*read.T], functions)):
            raise ValueError(f"options['initial_state'] {task.fallen_start(read)}")
        given["initial_state"] = start
    if "initial_error" in options:
        meaning = "x(0) minus the initial state that is told"
        value = options["initial_error"]
        error = option_numbers("initial_error", value, shape, looked_at=looked_at, meaning=meaning)
        given["initial_error"] = error
    if "goal" in options:
        given["goal"] = _goal(options["goal"], task, shape, looked_at)
    if "discs" in options:
        given["discs"] = _discs(options["discs"], task, batch, looked_at)
    return given


def _goal(
    value: Any, task: Task, shape: tuple[int, ...], looked_at: BoolArray | None
) -> FloatArray:
    short = task.short_goal
    # One coordinate alone is no list.
    shorter = [(*shape[:-1], *((len(short),) if len(short) > 1 else ()))] if short else []
    goal = option_numbers("goal", value, shape, *shorter, looked_at=looked_at)
    if goal.shape == shape:
        return goal
    whole = np.zeros(shape)
    whole[..., short] = goal.reshape(*shape[:-1], len(short))
    return whole


def _discs(
    value: Any, task: Task, batch: tuple[int, ...], looked_at: BoolArray | None
) -> FloatArray:
    shapes = [(*batch, count, 3) for count in range(task.most_discs + 1)]
    # An empty list has no axis of three.
    value = np.zeros(shapes[0]) if isinstance(value, list | tuple) and not len(value) else value
    meaning = "x, y and radius of each disc [m]"
    discs = option_numbers("discs", value, *shapes, looked_at=looked_at, meaning=meaning)
    radii = (discs if looked_at is None else discs[looked_at])[..., 2]
    if np.any(radii < 0.0):
        raise ValueError(f"options['discs'] holds the radius {radii.min():g}; it must be >= 0")
    return task.all_discs(discs)


def stated_nominal(
    options: dict[str, Any],
    task: Task,
    batch: tuple[int, ...] = (),
    looked_at: BoolArray | None = None,
) -> FloatArray | None:
    """Return x_d at every control instant, shape (*batch, steps + 1, n), if the options hold it.

    Args:
        options: As given to reset.
        task: The task.
        batch: Leading axes.
        looked_at: Which of a leading axis have to be finite; all of them if left out.

    Raises:
        ValueError: The trajectory has the wrong shape or is not finite.
    """
    shape = (*batch, task.steps + 1, task.system.state_dim)
    return nominal_option(options, shape, "the nominal state", looked_at)


def scenario_with(drawn: Scenario, stated: dict[str, FloatArray]) -> Scenario:
    """Return a scenario with the parts that were stated in place of those that were drawn."""
    parts = {"initial_state": drawn.initial_state, "goal": drawn.goal, "discs": drawn.discs}
    return Scenario(**{name: stated.get(name, value) for name, value in parts.items()})


def starts_of(task: Task, scenarios: Scenario) -> list[Start]:
    """Return the starts of one scenario or of several."""
    layout = task.layout
    states, goals = np.atleast_2d(scenarios.initial_state, scenarios.goal)
    blanks = np.zeros((len(states), layout.size), np.float32)
    blanks[:, layout.goal], blanks[:, layout.initial_state] = goals, states
    first, second = list(map(tuple, states.tolist())), list(map(tuple, goals.tolist()))
    last, discs = second, np.zeros((len(first), 0, 3))
    if task.most_discs:
        discs = task.all_discs(scenarios.discs).reshape(len(states), -1, 3)
        blanks[:, layout.discs] = discs.reshape(len(states), -1)
        fixed = np.concatenate([contacts(task, discs), goals], axis=1)
        last = list(map(tuple, fixed.tolist()))
    return list(map(Start, first, second, discs, last, blanks))


def scenario_of(start: Start) -> Scenario:
    """Return the scenario of an episode that begins so."""
    return Scenario(np.array(start.state), np.array(start.goal), start.discs)
