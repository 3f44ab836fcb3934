"""What a task is: a control-affine system, what is asked of it, and how well that was done.

`Task` describes one body. Its settings are fields, which `gym.make(..., settings={...})` changes;
what cannot change without becoming another task is a plain attribute of the class; what has to be
computed is a method. A task of your own is a subclass in a file of your own::

    @dataclass(frozen=True)
    class Slide(Task):
        system: DoubleIntegrator = DoubleIntegrator()
        name, title = "slide", "Slide"
        control_scale = (2.0,)

        def sample(self, rng):
            return Scenario(rng.uniform(-1.0, 1.0, 2), np.zeros(2))


    register_task(Slide())  # gym.make("lagros/Slide-v0")

A part that a task leaves out is missing in what is built on it, and said there: without `metric`
there is a planner, but neither u* nor a tube.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import (
    LARGEST,
    check_at_most,
    check_fields,
    check_multiple,
    check_positive,
)
from lagros_envs.dynamics.system import System
from lagros_envs.numbers.functions import where
from lagros_envs.task_parts import Defaults, Feedback, Learning, MetricDesign, Numbers
from lagros_envs.values import ByValue, use_plain_numbers

if TYPE_CHECKING:
    from lagros_envs.draw import Renderer

__all__ = [
    "Defaults",
    "Described",
    "Feedback",
    "Layout",
    "Learning",
    "MetricDesign",
    "Numbers",
    "Scenario",
    "Task",
    "distance_between",
]

# Farther from its goal than this the integration has diverged under an enormous control.
LARGEST_DISTANCE = 1e12
# No control is larger, whatever the action: the effort of an episode stays a number, in single
# precision as well.
LARGEST_CONTROL = 1e16


def distance_between(first: Sequence[Any], second: Sequence[Any], functions: Any) -> Any:
    """Return the Euclidean norm of a difference from the parts of both (any kind of number)."""
    total: Any = None
    for one, other in zip(first, second, strict=True):
        off = one - other
        total = off * off if total is None else total + off * off
    return functions.sqrt(total)


NO_DISCS = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class Scenario(ByValue):
    """What an episode asks for, or each of several episodes.

    Attributes:
        initial_state: x(0), shape (..., n).
        goal: x_f, shape (..., n).
        discs: Centre and radius of each disc to stay clear of, shape (..., k, 3).
    """

    initial_state: FloatArray
    goal: FloatArray
    discs: FloatArray = field(default_factory=lambda: NO_DISCS)

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        self._lock()


class Layout:
    """Where each named part of an observation lies, along its last axis.

    Attributes:
        state: x.
        goal: x_f.
        initial_state: x(0).
        time: t [s].
        discs: Centre and radius of each disc, one after the other; zeros where there is none.
        size: Numbers in an observation.
    """

    def __init__(self, states: int, discs: int) -> None:
        """Lay out so many states and discs."""
        self.state, self.goal = slice(0, states), slice(states, 2 * states)
        self.initial_state = slice(2 * states, 3 * states)
        self.time = 3 * states
        self.size = self.time + 1 + 3 * discs
        self.discs = slice(self.time + 1, self.size)

    def discs_of(self, observation: NDArray[Any]) -> FloatArray:
        """Return the discs in observations (..., size), shape (..., most discs, 3)."""
        rows = np.asarray(observation[..., self.discs], np.float64)
        return rows.reshape(*rows.shape[:-1], -1, 3)


class Described:
    """What every task has, of one body or of many.

    Attributes:
        name: As in `lagros bench NAME`.
        title: As in `gym.make("lagros/TITLE-v0")`.
        room: Its folder under `tasks/` of the packages above; None where it needs none.
        defaults: Of the commands.
        most_agents: Agents that a world may have; 1 for a task of one body.
        presets: Kinds of worlds; of one body its forms, this one first, others NAME-PRESET.
    """

    name: str
    title: str
    room: str | None = None
    defaults = Defaults()
    most_agents = 1
    presets: ClassVar[tuple[str, ...]] = ()

    @property
    def env_id(self) -> str:
        """The Gymnasium id."""
        return f"lagros/{self.title}-v0"

    def defaults_in(self, preset: str | None) -> Defaults:
        """Return what the commands take in the worlds of a preset; None for the usual one."""
        return self.defaults


@dataclass(frozen=True)
class Task(Described):
    """One body that is to go from a start to a goal, under bounded disturbance.

    Attributes:
        system: dx/dt = f(x) + B(x) u.
        control_period: Zero-order hold [s].
        time_limit: Length of an episode, which is also that of a plan [s].

    Class attributes that a subclass sets:
        state_names: Name and unit of each coordinate, "theta [rad]"; () for x0, x1, ...
        control_names: Likewise of each control.
        rates: Which coordinates are rates: those that `disturbance_channels="rates"` disturbs;
            () for all.
        state_low: Least x that a plan may ask for, shape (n,); () for none.
        state_high: Largest x, likewise.
        state_scale: How far each coordinate typically moves, shape (n,); () for ones.
        control_spread: How far each control typically moves in a plan, shape (m,); () for ones.
        goal_radius: How near the goal counts as success.
        position: The coordinates that are the position: two in a plane, as discs ask for, or three
            in space, of which a picture shows the first two; () where it is no coordinates.
        body_radius: Of the body around its position [m].
        most_discs: Discs that an observation has room for.
        margin: Room that a plan keeps beside body and disc [m].
        short_goal: Coordinates that a goal may be given by alone, the others being zero.
        alive_bonus: Reward per second of an episode that goes on, so that ending early never pays.
        distance_weight: Reward per (unit of distance from the goal) s, negative sign applied.
        success_bonus: Reward at the first success.
        metric: The contraction metric; None for none.
        feedback: What u* prefers, and the weights of the regulators; None for Bryson's rule.
        regulator: Weights of the regulator of the goal, `lqr`, whose errors are as long as the way;
            None for those of the others.
        learning: How its networks are made; None for none.
        weights: Folder of its metric and networks; None for that of its `lagros reproduce`,
            `runs/reproduce-NAME` from the working directory.
        keep: What plans keep at or below zero at their control instants besides all bounds, such as
            a speed minus its limit, a method of state and functions that returns several numbers;
            one counts as much as one `state_scale`. Written like an equation of motion, with a
            slope wherever a plan may come to. None for nothing.
        features: What its networks see, a method of an observation's components and the functions
            that they may use, written like an equation of motion; None for the usual.
    """

    system: System
    control_period: float = 0.1
    time_limit: float = 6.0

    state_names: ClassVar[tuple[str, ...]] = ()
    control_names: ClassVar[tuple[str, ...]] = ()
    rates: ClassVar[tuple[int, ...]] = ()
    state_low: ClassVar[Numbers] = ()
    state_high: ClassVar[Numbers] = ()
    state_scale: ClassVar[Numbers] = ()
    control_spread: ClassVar[Numbers] = ()
    goal_radius: ClassVar[float] = 0.3
    position: ClassVar[tuple[int, ...]] = ()
    body_radius: ClassVar[float] = 0.0
    most_discs: ClassVar[int] = 0
    margin: ClassVar[float] = 0.0
    short_goal: ClassVar[tuple[int, ...]] = ()
    metric: ClassVar[MetricDesign | None] = None
    feedback: ClassVar[Feedback | None] = None
    regulator: ClassVar[Feedback | None] = None
    learning: ClassVar[Learning | None] = None
    weights: ClassVar[Path | None] = None
    keep: ClassVar[Callable[..., Sequence[Any]] | None] = None
    features: ClassVar[Callable[..., Sequence[Any]] | None] = None
    # Without an annotation: a task may make fields of them.
    alive_bonus = 10.0
    distance_weight = 1.0
    success_bonus = 10.0

    def __post_init__(self) -> None:
        check_fields(self)
        use_plain_numbers(self)
        for name in ("control_period", "time_limit"):
            check_positive(name, getattr(self, name))
            check_at_most(name, getattr(self, name), LARGEST)
        check_multiple("time_limit", self.time_limit, "control_period", self.control_period)

    @property
    def steps(self) -> int:
        """Control steps of an episode that runs to its limit."""
        return round(self.time_limit / self.control_period)

    @property
    def control_centre(self) -> Numbers:
        """Control of the action 0, shape (m,); from here effort is counted."""
        return (0.0,) * self.system.control_dim

    @property
    def control_scale(self) -> Numbers:
        """Change of u for the action 1, shape (m,)."""
        return (1.0,) * self.system.control_dim

    @property
    def control_low(self) -> Numbers:
        """Least u, shape (m,): the environment clips, and plans keep it; -inf for none."""
        return (-math.inf,) * self.system.control_dim

    @property
    def control_high(self) -> Numbers:
        """Largest u, shape (m,)."""
        return (math.inf,) * self.system.control_dim

    @property
    def control_unit(self) -> str:
        """The unit of all controls; "" where they have none, or several."""
        units = {name.partition("[")[2].rstrip("]") for name in self.control_names}
        return units.pop() if len(units) == 1 else ""

    @property
    def squared_unit(self) -> str:
        """The unit of ||u||^2, "N²" or "(m/s^2)²"; "" where the controls have no one unit."""
        unit = self.control_unit
        return f"({unit})²" if len(unit) > 1 else unit and f"{unit}²"

    def control(self, action: FloatArray) -> FloatArray:
        """Return u of actions (..., m), as the environment applies it."""
        with np.errstate(over="ignore"):
            moved = np.add(self.control_centre, np.multiply(self.control_scale, action))
        most = np.minimum(self.control_high, LARGEST_CONTROL)
        return np.clip(moved, np.maximum(self.control_low, -LARGEST_CONTROL), most)

    def action(self, control: FloatArray) -> FloatArray:
        """Return the action of controls (..., m)."""
        off = np.subtract(control, self.control_centre)
        action: FloatArray = off / np.array(self.control_scale)
        return action

    @property
    def effort_weight(self) -> float:
        """Reward per control^2 s of effort, negative sign applied.

        By default the largest action costs as much as a second of the episode brings.
        """
        return self.alive_bonus / sum(scale * scale for scale in self.control_scale)

    @property
    def layout(self) -> Layout:
        """Where each named part of an observation lies."""
        return Layout(self.system.state_dim, self.most_discs)

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw what an episode asks for."""
        raise NotImplementedError(f"{type(self).__name__}.sample(rng) must return a Scenario")

    def sample_many(self, rng: np.random.Generator, count: int) -> Scenario:
        """Draw the scenarios of several episodes, one after the other, from one generator."""
        return self.sample_each(itertools.repeat(rng, count))

    def sample_each(self, generators: Iterable[np.random.Generator]) -> Scenario:
        """Draw one scenario from each generator; both may be overridden by what is faster.

        Returns:
            All of them, with a leading axis; discs that are missing are rows of zeros.
        """
        drawn = [self.sample(rng) for rng in generators]
        count, n, most = len(drawn), self.system.state_dim, self.most_discs
        return Scenario(
            np.array([one.initial_state for one in drawn], np.float64).reshape(count, n),
            np.array([one.goal for one in drawn], np.float64).reshape(count, n),
            np.array([self.all_discs(one.discs) for one in drawn]).reshape(count, most, 3),
        )

    def all_discs(self, discs: FloatArray) -> FloatArray:
        """Return discs (..., k, 3) with rows of zeros for those that are missing."""
        padded = np.zeros((*discs.shape[:-2], self.most_discs, 3))
        padded[..., : discs.shape[-2], :] = discs
        return padded

    def renderer(self, render_mode: str, fps: int) -> Renderer:
        """Return what draws the environment.

        Args:
            render_mode: "human" or "rgb_array".
            fps: Frames per second at which "human" plays.
        """
        from lagros_envs.draw import PlaneRenderer

        return PlaneRenderer(self, render_mode, fps)

    def place(self, state: FloatArray) -> FloatArray:
        """Return where its picture has the body, shape (2,) [m]; shape (0,) for no such picture."""
        return state[list(self.position[:2])]

    def outline(self, state: FloatArray) -> Sequence[FloatArray]:
        """Return the body as closed polygons (corners, 2) [m], for its picture; () for a disc."""
        return ()

    def success_radius(self, time: Any) -> Any:
        """Return how near the goal counts as success at a time [s] (a float or an array)."""
        return self.goal_radius + 0.0 * time

    def tube_radius(self, time: Any) -> Any:
        """Return the radius of the published tube around a plan at a time [s]; None for none."""
        return None

    def goal_distance(self, state: Sequence[Any], goal: Sequence[Any], functions: Any) -> Any:
        """Return the distance from the goal: of the positions, or of the states without one."""
        which = self.position or range(self.system.state_dim)
        here, there = ([values[index] for index in which] for values in (state, goal))
        return distance_between(here, there, functions)

    def excess(self, state: Sequence[Any], functions: Any) -> Any:
        """Return by how much the state is beyond what the task allows; positive: it has fallen.

        Written like an equation of motion, but it may also choose by `numbers.functions.where`. A
        search for the worst disturbance follows its slope.
        """
        return 0.0 * state[0] - 1.0

    def fallen(self, state: Sequence[Any], functions: Any) -> Any:
        """Return whether the state has left what the task allows, which ends the episode.

        One comparison or several by `<=` and `>`, each in parentheses of its own, joined by `&`
        and `|`.
        """
        return self.excess(state, functions) > 0.0

    def fallen_start(self, states: FloatArray) -> str:
        """Say what is wrong with initial states (..., n) of which some have fallen."""
        return f"holds a state in which the episode of {self.name} has already ended"

    def reward(self, effort: Any, distance: Any, first_success: Any, down: Any) -> Any:
        """Return the reward of one control step (floats, arrays or recorded numbers).

        Args:
            effort: ||u - centre||^2 dt of the step [control^2 s].
            distance: From the goal, after the step.
            first_success: Whether the step brought the first success.
            down: Whether the body has fallen or collided.

        Returns:
            -w_e ||u - centre||^2 dt - w_d distance dt + b_a dt [not down] + b_s [first success].
            The distance counts as at most b_a / w_d: no step costs more than ending the episode.
        """
        reach = self.alive_bonus - self.distance_weight * distance
        stay = self.control_period * (0.5 * (reach + abs(reach)))
        return (
            -self.effort_weight * effort
            + where(down, 0.0, stay)
            + where(first_success, self.success_bonus, 0.0)
        )
