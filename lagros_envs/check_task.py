"""Tries a task before it is registered and says what is wrong with it, in its author's words."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import (
    check_instance,
    check_not_negative,
    check_positive,
    check_whole,
    is_finite,
    is_number,
    is_whole,
    shown,
)
from lagros_envs.dynamics.check import check_system
from lagros_envs.dynamics.straight_line import recorded_measure
from lagros_envs.numbers import functions
from lagros_envs.rules import StepRules
from lagros_envs.task import Defaults, Feedback, Learning, MetricDesign, Scenario, Task
from lagros_envs.tasks import SHIPPED

_SAMPLES = 8  # scenarios that are tried
_AROUND = 0.05  # states beside them, as a share of the scale of each coordinate
_NAME = r"[a-z][a-z0-9_-]*"
_TITLE = r"[A-Z][A-Za-z0-9]*"
# "theta [rad]", "x [-]"
_QUANTITY = r"[^\[\]]+ \[[^\[\]]+\]"


def check_task(task: Any) -> None:
    """Check names, shapes, units and ranges of a task, its scenarios and its system.

    Raises:
        TypeError: It is no `Task`, or something of it is of the wrong type.
        ValueError: Something is wrong; the message names it, with what to write instead.
    """
    if not isinstance(task, Task):
        given = f"the class {task.__name__}" if isinstance(task, type) else shown(task)
        raise TypeError(f"{given} is no task: register_task takes an instance of a Task")
    title = type(task).__name__
    try:
        _check_names(task)
        # Shapes before the system: it says how long all of them are.
        check_system(task.system)
        _check_hashable(task)
        _check_shapes(task)
        _check_ranges(task)
        scenarios = _scenarios(task, title)
        states = _states(task, scenarios)
        rng = np.random.default_rng(0)
        actions = rng.uniform(-1.0, 1.0, (len(states), task.system.control_dim))
        check_system(task.system, states, task.control(actions))
        _check_rules(task, title, scenarios)
        _check_observed(task, scenarios)
    except (TypeError, ValueError) as error:
        raise type(error)(f"the task {title}: {error}") from error


def _check_names(task: Task) -> None:
    for name, pattern, example in (("name", _NAME, "puck"), ("title", _TITLE, "Puck")):
        value = getattr(task, name, None)
        if not isinstance(value, str) or not re.fullmatch(pattern, value):
            raise ValueError(
                f"{name}={shown(value)} must be set to a text like {example!r} ({pattern})"
            )


def _check_hashable(task: Task) -> None:
    """Recorded steps are kept by the system and the task that they are of."""
    for what, value in (("system", task.system), ("task", task)):
        try:
            hash(value)
        except TypeError as error:
            raise TypeError(
                f"the {what} {type(value).__name__} cannot be hashed ({error}): declare it with "
                "@dataclass(frozen=True), and hold tuples in it instead of lists and arrays"
            ) from error


def _check_shapes(task: Task) -> None:
    n, m = task.system.state_dim, task.system.control_dim
    for name, count, what in (("state_names", n, "state"), ("control_names", m, "control")):
        names = getattr(task, name)
        wrong = isinstance(names, str) or not isinstance(names, list | tuple)
        wrong = wrong or not all(isinstance(one, str) for one in names)
        if wrong or len(names) not in (0, count):
            raise ValueError(f"{name}={shown(names)} must be {count} texts, one for each {what}")
        for one in names:
            if not re.fullmatch(_QUANTITY, one):
                raise ValueError(
                    f"{name} holds {one!r}; it must be a name and its unit in brackets, like "
                    '"theta [rad]" or "share [-]"'
                )
    for name in ("control_centre", "control_scale", "control_low", "control_high"):
        _numbers(name, getattr(task, name), m, "control", optional=False)
    _numbers("control_spread", task.control_spread, m, "control")
    for name in ("state_low", "state_high", "state_scale"):
        _numbers(name, getattr(task, name), n, "state")
    for name in ("rates", "position", "short_goal"):
        _indices(name, getattr(task, name), n)
    _check_parts(task)
    if task.metric is not None:
        _check_metric(task.metric, n, m)
    for name in ("feedback", "regulator"):
        weights: Feedback | None = getattr(task, name)
        if weights is not None:
            _numbers(f"{name}.state_weights", weights.state_weights, n, "state", False)
            _numbers(f"{name}.control_weights", weights.control_weights, m, "control", False)
            _numbers(f"{name}.early_state", weights.early_state, n, "state")
            _numbers(f"{name}.early_control", weights.early_control, m, "control")
            check_positive(f"{name}.rate", weights.rate)
            check_positive(f"{name}.settling", weights.settling)


def _check_parts(task: Task) -> None:
    kinds: dict[str, tuple[type, ...]] = {
        "metric": (MetricDesign,),
        "feedback": (Feedback,),
        "regulator": (Feedback,),
        "learning": (Learning,),
        "weights": (Path, str),
    }
    for name, kind in kinds.items():
        value = getattr(task, name)
        if value is not None:
            check_instance(name, value, *kind, otherwise="or None")
    check_instance("defaults", task.defaults, Defaults)
    if task.room is not None and task.name not in SHIPPED:
        raise ValueError(
            f"room={task.room!r} is a folder of this package, for the task of that name alone: set "
            "room = None, and the general parts serve it"
        )


def _check_metric(metric: MetricDesign, n: int, m: int) -> None:
    for name in ("low", "high", "error"):
        _numbers(f"metric.{name}", getattr(metric, name), n, "state", False)
    for name in ("control_low", "control_high"):
        _numbers(f"metric.{name}", getattr(metric, name), m, "control", False)
    if metric.scaling is not None:
        _numbers("metric.scaling", metric.scaling, n, "state", False)
    _ordered("metric.low", metric.low, "metric.high", metric.high)
    _ordered("metric.control_low", metric.control_low, "metric.control_high", metric.control_high)
    if metric.point not in ("state", "nominal"):
        raise ValueError(f'metric.point={shown(metric.point)} must be "state" or "nominal"')
    check_positive("metric.rate", metric.rate)


def _numbers(name: str, values: Any, count: int, what: str, optional: bool = True) -> None:
    wrong = not isinstance(values, list | tuple) or not all(is_number(one) for one in values)
    if wrong or not (len(values) == count or (optional and len(values) == 0)):
        text = f"{name}={shown(values)} must be a tuple of {count} numbers, one for each {what}"
        raise ValueError(text + (", or ()" if optional else ""))
    if any(math.isnan(one) for one in values):
        raise ValueError(f"{name}={shown(values)} holds a nan")


def _indices(name: str, values: Any, states: int) -> None:
    wrong = not isinstance(values, list | tuple)
    wrong = wrong or not all(is_whole(one) and 0 <= one < states for one in values)
    if wrong or len(set(values)) != len(values):
        raise ValueError(
            f"{name}={shown(values)} must be different indices of states, 0 to {states - 1}"
        )


def _ordered(low: str, least: Sequence[float], high: str, largest: Sequence[float]) -> None:
    for index, (one, other) in enumerate(zip(least, largest, strict=True)):
        if not one <= other:
            raise ValueError(f"{low}[{index}]={one:g} must not be above {high}[{index}]={other:g}")


def _check_ranges(task: Task) -> None:
    for name in ("control_scale", "control_spread", "state_scale"):
        for index, value in enumerate(getattr(task, name)):
            check_positive(f"{name}[{index}]", value)
    check_positive("goal_radius", task.goal_radius)
    check_not_negative("body_radius", task.body_radius)
    check_not_negative("margin", task.margin)
    check_whole("most_discs", task.most_discs, 0, 1000)
    for name in ("alive_bonus", "distance_weight", "success_bonus", "effort_weight"):
        check_not_negative(name, getattr(task, name))
    if len(task.position) not in (0, 2, 3):
        raise ValueError(
            f"position={task.position!r} must be two or three indices of states, or ()"
        )
    if task.most_discs and len(task.position) != 2:
        raise ValueError(
            f"most_discs={task.most_discs} needs position, the two states that discs meet"
        )
    _ordered("control_low", task.control_low, "control_high", task.control_high)
    _ordered("control_low", task.control_low, "control_centre", task.control_centre)
    _ordered("control_centre", task.control_centre, "control_high", task.control_high)
    if task.state_low and task.state_high:
        _ordered("state_low", task.state_low, "state_high", task.state_high)


def _scenarios(task: Task, title: str) -> list[Scenario]:
    """Return a few scenarios, each of the right shape, possible, and the same when drawn again."""
    found = []
    for seed in range(_SAMPLES):
        first, again = (
            _called(f"{title}.sample", task.sample, np.random.default_rng(seed)) for _ in range(2)
        )
        _check_scenario(task, title, first)
        if first != again:
            raise ValueError(
                "sample(rng) gives two answers for one seed: draw from rng alone, not from "
                "np.random or random"
            )
        found.append(first)
    together = _called(f"{title}.sample_many", task.sample_many, np.random.default_rng(0), 3)
    n = task.system.state_dim
    shapes = [part.shape for part in (together.initial_state, together.goal, together.discs)]
    if shapes != [(3, n), (3, n), (3, task.most_discs, 3)]:
        raise ValueError(
            f"sample_many(rng, 3) gives arrays of shape {shapes}; they must be (3, {n}), (3, {n}) "
            f"and (3, {task.most_discs}, 3)"
        )
    return found


def _called(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except Exception as error:
        raise ValueError(f"{name} fails: {type(error).__name__}: {error}") from error


def _check_scenario(task: Task, title: str, scenario: Any) -> None:
    if not isinstance(scenario, Scenario):
        raise TypeError(f"sample(rng) returns {shown(scenario)}; it must return a Scenario")
    n = task.system.state_dim
    for name in ("initial_state", "goal", "discs"):
        value = np.asarray(getattr(scenario, name))
        right = value.shape == (n,) if name != "discs" else value.shape[1:] == (3,)
        if value.dtype.kind not in "fi" or not right or not np.isfinite(value).all():
            shape = f"({n},)" if name != "discs" else "(k, 3): x, y and radius of each"
            raise ValueError(
                f"sample(rng).{name}={shown(value.tolist())} must be finite numbers of shape "
                f"{shape}"
            )
    start, goal = scenario.initial_state, scenario.goal
    _check_discs(task, scenario)
    if bool(_called(f"{title}.fallen", task.fallen, start.tolist(), functions)):
        raise ValueError(f"sample(rng).initial_state={start.tolist()} has fallen already")
    for name, bounds, sign in (
        ("state_low", task.state_low, 1),
        ("state_high", task.state_high, -1),
    ):
        for what, state in (("initial_state", start), ("goal", goal)):
            beyond = [k for k, one in enumerate(bounds) if sign * (state[k] - one) < 0.0]
            if beyond:
                raise ValueError(
                    f"sample(rng).{what}[{beyond[0]}]={state[beyond[0]]:g} is beyond "
                    f"{name}[{beyond[0]}]={bounds[beyond[0]]:g}, which no plan may be"
                )


def _check_discs(task: Task, scenario: Scenario) -> None:
    discs = scenario.discs
    if len(discs) > task.most_discs:
        raise ValueError(
            f"sample(rng) has {len(discs)} discs; an observation has room for "
            f"most_discs={task.most_discs}"
        )
    for x, y, radius in discs.tolist():
        check_positive("the radius of a disc of sample(rng)", radius)
        for what, state in (("initial_state", scenario.initial_state), ("goal", scenario.goal)):
            place = [float(state[index]) for index in task.position]
            distance = math.hypot(place[0] - x, place[1] - y)
            if distance <= radius + task.body_radius:
                raise ValueError(
                    f"sample(rng).{what} is {distance:.3g} m from the centre of a disc of radius "
                    f"{radius:.3g} m, with a body of body_radius={task.body_radius:g} m: draw "
                    "again until both ends are clear"
                )


def _states(task: Task, scenarios: list[Scenario]) -> FloatArray:
    """Return starts, goals, and states around and between them."""
    ends = np.array([[one.initial_state, one.goal] for one in scenarios], np.float64)
    scale = np.array(task.state_scale or (1.0,) * task.system.state_dim)
    rng = np.random.default_rng(0)
    between = ends[:, 0] + rng.uniform(0.0, 1.0, (len(ends), 1)) * (ends[:, 1] - ends[:, 0])
    states = np.concatenate([ends[:, 0], ends[:, 1], between])
    moved = states + _AROUND * scale * rng.uniform(-1.0, 1.0, states.shape)
    if task.state_low:
        moved = np.maximum(moved, task.state_low)
    if task.state_high:
        moved = np.minimum(moved, task.state_high)
    return np.concatenate([states, moved])


def _check_rules(task: Task, title: str, scenarios: list[Scenario]) -> None:
    """The rules of a step run on floats and are recorded, see `rules`."""
    for scenario in scenarios:
        start, goal = scenario.initial_state.tolist(), scenario.goal.tolist()
        distance = _called(f"{title}.goal_distance", task.goal_distance, start, goal, functions)
        if not is_finite(distance) or distance < 0.0:
            raise ValueError(f"goal_distance gives {shown(distance)}; it must be a number >= 0")
    for time in (0.0, task.time_limit):
        radius = _called(f"{title}.success_radius", task.success_radius, time)
        if not is_finite(radius) or radius < 0.0:
            raise ValueError(f"success_radius({time:g}) is {shown(radius)}; it must be >= 0")
    fallen = task.fallen(scenarios[0].initial_state.tolist(), functions)
    if not isinstance(fallen, bool | np.bool_):
        raise ValueError(
            f"fallen gives {shown(fallen)}; it must end with a comparison by <= or >, such as "
            "abs(state[2]) > 1.0"
        )
    rules = StepRules(task)
    try:
        recorded_measure(task.system, rules, rules.given)
    except Exception as error:
        raise ValueError(
            "fallen, excess, goal_distance or reward cannot be recorded: "
            f"{type(error).__name__}: {error}. Use + - * / and integer powers, abs, the functions "
            "that they are given, comparisons by <= and >, joined by & and |, and "
            "lagros_envs.numbers.functions.where in place of if"
        ) from error


def _check_observed(task: Task, scenarios: list[Scenario]) -> None:
    for scenario in scenarios:
        place = np.shape(task.place(scenario.initial_state))
        if place not in ((0,), (2,)):
            raise ValueError(f"place(state) has shape {place}; it must be (2,), or (0,) for none")
        for polygon in task.outline(scenario.initial_state):
            if np.asarray(polygon).ndim != 2 or np.asarray(polygon).shape[1] != 2:
                raise ValueError("outline(state) must give polygons, each of shape (corners, 2)")
