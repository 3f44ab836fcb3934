"""What a task is: a control-affine system, what is asked of it, and how well that was done.

`Task` describes one body. Its settings are fields, which `gym.make(..., settings={...})` changes;
what cannot change without becoming another task is a plain attribute of the class; what has to be
computed is a method. A task of your own is a subclass in a file of your own:

    @dataclass(frozen=True)
    class Slide(Task):
        system: DoubleIntegrator = DoubleIntegrator()
        name, title = "slide", "Slide"
        control_scale = (2.0,)

        def sample(self, rng):
            return Scenario(rng.uniform(-1.0, 1.0, 2), np.zeros(2))

    register_task(Slide())           # gym.make("lagros/Slide-v0")

A part that a task leaves out is missing in what is built on it, and said there: without `metric`
there is a planner, but neither u* nor a tube.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import (
    LARGEST,
    check_at_most,
    check_fields,
    check_multiple,
    check_positive,
)
from lagros_envs.dynamics.system import System
from lagros_envs.values import ByValue, use_plain_numbers

FloatArray = NDArray[np.float64]
Numbers = tuple[float, ...]

# Farther from its goal than this the integration has diverged under an enormous control.
LARGEST_DISTANCE = 1e12
# No control is larger, whatever the action: the effort of an episode stays a number, in single
# precision as well.
LARGEST_CONTROL = 1e16


def _no_discs() -> FloatArray:
    return np.zeros((0, 3))


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
    discs: FloatArray = field(default_factory=_no_discs)

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        self._lock()


@dataclass(frozen=True)
class MetricDesign:
    """Which contraction metric a task wants, and where it has to hold (CV-STEM, Theorem 2).

    W is a sum of coefficients times `basis`, functions of x or of x_d written as in
    `lagros_policies.contraction.Basis`, such as "1", "cos(x[2])" or "x[3]**2".

    Attributes:
        low: Least x_d of the region, shape (n,).
        high: Largest x_d, shape (n,).
        error: Largest |x - x_d| of each coordinate, shape (n,).
        control_low: Least u_d, shape (m,).
        control_high: Largest u_d, shape (m,).
        basis: Functions of the point.
        point: "state": the metric is a function of x; "nominal": of x_d, for systems whose control
            moves all that the motion depends on.
        rate: Contraction rate alpha [1/s].
        scaling: Of the coordinates in the condition number, shape (n,); None for ones.
        margin: By how much the condition is asked for beyond zero [1/s].
    """

    low: Numbers
    high: Numbers
    error: Numbers
    control_low: Numbers
    control_high: Numbers
    basis: tuple[str, ...] = ("1",)
    point: str = "state"
    rate: float = 0.5
    scaling: Numbers | None = None
    margin: float = 0.1


@dataclass(frozen=True)
class Feedback:
    """What u* prefers where contraction leaves a choice: a regulator along the plan.

    Attributes:
        state_weights: Diagonal of Q, shape (n,).
        control_weights: Diagonal of R, shape (m,).
    """

    state_weights: Numbers
    control_weights: Numbers


@dataclass(frozen=True)
class Learning:
    """How the networks of a task are made (Algorithm 1, then DAgger).

    Attributes:
        plans: Random episodes with a target trajectory each.
        samples: Labelled states around them.
        disturbance_bound: Largest d_bar of the flights that fill the tube.
        hidden: Width of each hidden layer of (c) and (a).
        epochs: Passes over the data.
        rounds: Rounds of DAgger: the network flies, u* says what it should have done.
        round_plans: Episodes of each round.
    """

    plans: int = 1000
    samples: int = 100_000
    disturbance_bound: float = 1.0
    hidden: tuple[int, ...] = (128, 128)
    epochs: int = 100
    rounds: int = 0
    round_plans: int = 500


@dataclass(frozen=True)
class Defaults:
    """What the commands take where the user says nothing; each stands here and nowhere else.

    Attributes:
        policies: Of `lagros bench`.
        bounds: d_bar of `lagros bench`, in units of the state per second.
        bound: d_bar of the commands that take one.
        episodes: Episodes of `lagros bench`.
        agents: Agents of each of its worlds; () for a task of one body, as in the next two.
        preset: Of `Described.presets`.
        safety_filter: "none", "all" policies use it, or "both" one after the other.
        attack_episodes: Episodes that `lagros attack` searches.
        attack_budget: Flights that it may spend on each.
        certify_policies: What `lagros certify` may be asked about, the first by default.
        certify_episodes: Flights behind a calibrated bound.
        speed: Of the film of `lagros watch`, as a multiple of the real one.
    """

    policies: tuple[str, ...] = ("learned", "tube-mpc", "lagros", "lqr")
    bounds: Numbers = (0.75,)
    bound: float = 0.75
    episodes: int = 50
    agents: tuple[int, ...] = ()
    preset: str | None = None
    safety_filter: str = "none"
    attack_episodes: int = 10
    attack_budget: int = 1000
    certify_policies: tuple[str, ...] = ("lagros", "tube-mpc")
    certify_episodes: int = 400
    speed: float = 1.0


class Described:
    """What every task has, of one body or of many.

    Attributes:
        name: As in `lagros bench NAME`.
        title: As in `gym.make("lagros/TITLE-v0")`.
        room: Its folder under `tasks/` of the packages above; None where it needs none.
        defaults: Of the commands.
        most_agents: Agents that a world may have; 1 for a task of one body.
        presets: Kinds of worlds; () for a task of one body.
    """

    name: str
    title: str
    room: str | None = None
    defaults = Defaults()
    most_agents = 1
    presets: tuple[str, ...] = ()

    @property
    def env_id(self) -> str:
        """The Gymnasium id."""
        return f"lagros/{self.title}-v0"


@dataclass(frozen=True)
class Task(Described):
    """One body that is to go from a start to a goal, under bounded disturbance.

    Attributes:
        system: dx/dt = f(x) + B(x) u.
        control_period: Zero-order hold [s].
        time_limit: Length of an episode, which is also that of a plan [s].

    Attributes of the class, to be set in a subclass:
        state_names: Name and unit of each coordinate, "theta [rad]"; () for x0, x1, ...
        control_names: Likewise of each control.
        rates: Which coordinates are rates: those that `disturbance_channels="rates"` disturbs;
            () for all.
        state_low: Least x that a plan may ask for, shape (n,); () for none.
        state_high: Largest x, likewise.
        state_scale: How far each coordinate typically moves, shape (n,); () for ones.
        control_spread: How far each control typically moves in a plan, shape (m,); () for ones.
        goal_radius: How near the goal counts as success.
        position: The two coordinates that are the position; () where the body has none in a plane.
        body_radius: Of the body around its position [m].
        most_discs: Discs that an observation has room for.
        margin: Room that a plan keeps beside body and disc [m].
        metric: The contraction metric; None for none.
        feedback: What u* prefers, and the weights of the regulators; None for Bryson's rule.
        learning: How its networks are made; None for none.
        weights: Folder of its metric and networks; None for those of the package.
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
    metric: ClassVar[MetricDesign | None] = None
    feedback: ClassVar[Feedback | None] = None
    learning: ClassVar[Learning | None] = None
    weights: ClassVar[Path | None] = None

    def __post_init__(self) -> None:
        """Check the settings."""
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

    def sample(self, rng: np.random.Generator) -> Scenario:
        """Draw what an episode asks for."""
        raise NotImplementedError(f"{type(self).__name__}.sample(rng) must return a Scenario")

    def sample_many(self, rng: np.random.Generator, count: int) -> Scenario:
        """Draw several at once; to be overridden where that is faster."""
        drawn = [self.sample(rng) for _ in range(count)]
        parts = [(one.initial_state, one.goal, one.discs) for one in drawn]
        return Scenario(*(np.stack(part) for part in zip(*parts, strict=True)))

    def success_radius(self, time: Any) -> Any:
        """Return how near the goal counts as success at a time [s] (a float or an array)."""
        return self.goal_radius + 0.0 * time

    def tube_radius(self, time: Any) -> Any:
        """Return the radius of the published tube around a plan at a time [s]; None for none."""
        return None

    def goal_distance(self, state: Sequence[Any], goal: Sequence[Any], functions: Any) -> Any:
        """Return the distance from the goal: of the positions, or of the states without one."""
        which = self.position or range(self.system.state_dim)
        total: Any = 0.0
        for index in which:
            off = state[index] - goal[index]
            total = total + off * off
        return functions.sqrt(total)

    def excess(self, state: Sequence[Any], functions: Any) -> Any:
        """Return by how much the state is beyond what the task allows; positive: it has fallen.

        A search for the worst disturbance follows its slope.
        """
        return 0.0 * state[0] - 1.0

    def fallen(self, state: Sequence[Any], functions: Any) -> Any:
        """Return whether the state has left what the task allows, which ends the episode."""
        return self.excess(state, functions) > 0.0
