"""Flights around target trajectories that try to leave a tube, each from e(0) = 0.

A tube for a control at will is flown with the control inside the integrator, a tube for a held
control with the control held; both are looked at every 10 ms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.worst_case.search import SearchSettings, search
from lagros_envs.balls import into_unit_ball, onto_unit_sphere
from lagros_envs.disturbances import Disturbance
from lagros_envs.dynamics import hold_step, vector_field
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.cartpole import task
from lagros_policies.contraction.ellipsoid import TubeControl
from lagros_policies.contraction.held_design import HeldTube
from lagros_policies.contraction.tube_design import ConstantTube
from lagros_policies.tasks.cartpole.planner import CartPolePlanner
from lagros_policies.tasks.cartpole.plans import PlanBox

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
AnyTube = ConstantTube | HeldTube

NAMESPACE = 31
SETTLED = PlanBox(angle=0.4, velocity=7.5, angular_rate=1.2, force=3.0)
UPRIGHT = PlanBox(angle=0.05, velocity=0.5, angular_rate=0.1, force=0.5)
_SETTLED_STEP = 8
PERIOD = 0.1
# Control steps flown, and Runge-Kutta steps in each; d is constant over a control step, but for
# the steepest one, which is renewed at every Runge-Kutta step.
_STEPS = 40
_FINE = 10
# Error of the integration, as a share of the tube.
_INTEGRATION = 1e-3
_KINDS = ("uniform", "sphere", "constant", "sinusoid", "gust")


@dataclass(frozen=True)
class Plans:
    """Target trajectories: x_d where each begins (p, 4), and u_d (p, steps, 1)."""

    start: FloatArray
    controls: FloatArray


def settled_plans(count: int) -> Plans:
    """Plan random episodes and cut off their first 0.8 s; all must lie inside the box."""
    settings = task.CartPoleSettings()
    planner = CartPolePlanner(settings)
    starts, controls = [], []
    for seed in episode_seeds(0, count, NAMESPACE):
        scenario = settings.sample(episode_streams(seed).scenario)
        plan = planner.plan(scenario.initial_state, scenario.goal)
        part = plan.states[_SETTLED_STEP : _SETTLED_STEP + _STEPS + 1]
        force = plan.controls[_SETTLED_STEP : _SETTLED_STEP + _STEPS]
        limit = (SETTLED.angle, SETTLED.velocity, SETTLED.angular_rate)
        if not np.all(np.abs(part[:, 1:]) <= limit) or np.abs(force).max() > SETTLED.force:
            raise RuntimeError(f"the plan of episode {seed} leaves {SETTLED}")
        starts.append(part[0])
        controls.append(force)
    return Plans(np.stack(starts), np.stack(controls))


def resting_plans(count: int) -> Plans:
    """Return plans that rest at the goal."""
    return Plans(np.zeros((count, 4)), np.zeros((count, _STEPS, 1)))


def fly(
    tube: AnyTube,
    plans: Plans,
    which: IntArray,
    pushes: FloatArray | None,
    flight: _AtWill | _Held | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Fly episodes from e(0) = 0 under the control of a tube.

    Args:
        tube: The tube.
        plans: The plans.
        which: Plan of each flight, shape (b,).
        pushes: d / d_bar, shape (b, steps, 4); None for the d that raises V fastest.
        flight: How the control is applied; as the tube asks for it if None.

    Returns:
        The largest |e_i| of each flight, (b, 4), and the largest share of the tube, max of
        sqrt(V(t) / bound of V(t)), (b,).
    """
    if flight is None:
        flight = _Held(tube) if isinstance(tube, HeldTube) else _AtWill(tube)
    bound, fine = tube.design.disturbance_bound, PERIOD / _FINE
    nominal = plans.start[which]
    state = nominal.copy()
    rng = np.random.default_rng(7)
    first = onto_unit_sphere(rng.standard_normal(state.shape), np.eye(4)[0])
    largest, share = np.zeros((len(which), 4)), np.zeros(len(which))
    for instant in range(_STEPS * _FINE):
        control = plans.controls[which, instant // _FINE]
        flight.renew(state, nominal, control)
        if pushes is None:
            push = onto_unit_sphere(flight.slope(state - nominal), first)
        else:
            push = pushes[:, instant // _FINE]
        state, nominal = flight.advance(state, nominal, control, bound * push, fine)
        error = state - nominal
        largest = np.maximum(largest, np.abs(error))
        allowed = float(tube.share((instant + 1) * fine)) ** 2
        share = np.maximum(share, np.sqrt(flight.energy(error) / allowed))
    return largest, share


def steepest_share(tube: ConstantTube, plans: Plans, flights: int, hold: float | None) -> float:
    """Return the largest sqrt(V / bound) under the d that raises V fastest.

    Args:
        tube: A tube for a control at will.
        plans: The plans that are flown.
        flights: Flights, from first pushes of their own.
        hold: Time for which the control is held all the same [s]; None for a control at will.
    """
    which = np.arange(flights) % len(plans.start)
    flight = None if hold is None else _Renewed(tube, round(hold * _FINE / PERIOD))
    return float(fly(tube, plans, which, None, flight)[1].max())


class _AtWill:
    """A control inside the integrator."""

    def __init__(self, tube: ConstantTube) -> None:
        self._law = TubeControl(task.CartPoleSettings().system, tube)
        self._inverse = np.linalg.inv(tube.dual) / tube.energy

    def renew(self, state: FloatArray, nominal: FloatArray, u_d: FloatArray) -> None:
        """Hold nothing."""

    def slope(self, error: FloatArray) -> FloatArray:
        """Return a positive multiple of dV/de, (b, 4)."""
        return error @ self._inverse

    def energy(self, error: FloatArray) -> FloatArray:
        """Return V over its steady bound, (b,)."""
        return np.asarray(np.sum(error @ self._inverse * error, axis=-1))

    def advance(
        self, state: FloatArray, nominal: FloatArray, u_d: FloatArray, push: FloatArray, time: float
    ) -> tuple[FloatArray, FloatArray]:
        """Integrate x under u(x, x_d, u_d) and x_d under u_d together."""
        law = self._law

        def slope(pair: FloatArray) -> FloatArray:
            here, there = pair
            moved = vector_field(law.system, here, law(here, there, u_d)) + push
            return np.stack([moved, vector_field(law.system, there, u_d)])

        pair = np.stack([state, nominal])
        first = slope(pair)
        second = slope(pair + 0.5 * time * first)
        third = slope(pair + 0.5 * time * second)
        fourth = slope(pair + time * third)
        following = pair + time / 6.0 * (first + 2.0 * (second + third) + fourth)
        return following[0], following[1]


class _Renewed(_AtWill):
    """The control at will, held for some Runge-Kutta steps all the same."""

    def __init__(self, tube: ConstantTube, steps: int) -> None:
        super().__init__(tube)
        self._system = task.CartPoleSettings().system
        self._steps, self._since = steps, 0
        self._force: FloatArray = np.zeros((1, 1))

    def renew(self, state: FloatArray, nominal: FloatArray, u_d: FloatArray) -> None:
        """Take the control where a hold has ended."""
        if self._since % self._steps == 0:
            self._force = self._law(state, nominal, u_d)
        self._since += 1

    def advance(
        self, state: FloatArray, nominal: FloatArray, u_d: FloatArray, push: FloatArray, time: float
    ) -> tuple[FloatArray, FloatArray]:
        """Integrate x under the force that is held and x_d under u_d."""
        after = hold_step(self._system, state, self._force, time, push, 1)
        return after, hold_step(self._system, nominal, u_d, time, substeps=1)


class _Held:
    """A control that is held; for random parts of the hold where the tube covers that."""

    def __init__(self, tube: HeldTube) -> None:
        self._tube, self._system = tube, task.CartPoleSettings().system
        self._whole = round(tube.design.period * _FINE / PERIOD)
        self._rng = np.random.default_rng(11)
        self._since = self._length = 0
        self._deviation: FloatArray = np.zeros((1, 1))

    def renew(self, state: FloatArray, nominal: FloatArray, u_d: FloatArray) -> None:
        """Take the control where a hold has ended."""
        if self._since < self._length:
            return
        self._since, self._length = 0, self._whole
        if self._tube.design.aperiodic:
            self._length = int(self._rng.integers(1, self._whole + 1))
        self._deviation = self._tube.control(state, nominal, u_d) - u_d

    def slope(self, error: FloatArray) -> FloatArray:
        """Return a positive multiple of dV/de, (b, 4)."""
        inverse = np.linalg.inv(self._tube.dual_at(self._since / self._whole))
        return np.asarray(np.concatenate([error, self._deviation], axis=-1) @ inverse[:, :4])

    def energy(self, error: FloatArray) -> FloatArray:
        """Return V before the control is renewed, (b,)."""
        return np.asarray(self._tube.energy(self._since / self._whole, error, self._deviation))

    def advance(
        self, state: FloatArray, nominal: FloatArray, u_d: FloatArray, push: FloatArray, time: float
    ) -> tuple[FloatArray, FloatArray]:
        """Integrate x under u_d + v and x_d under u_d."""
        self._since += 1
        after = hold_step(self._system, state, u_d + self._deviation, time, push, 1)
        return after, hold_step(self._system, nominal, u_d, time, substeps=1)


class TubeTarget:
    """The flights around one plan, for `worst_case.search`: how large an output becomes."""

    def __init__(self, tube: AnyTube, plans: Plans, output: FloatArray) -> None:
        """Keep what is attacked."""
        self._tube, self._plans, self._output = tube, plans, output
        self.episodes, self.steps, self.channels, self.slope_cost = len(plans.start), _STEPS, 4, 0
        self.shares: list[float] = []

    def scores(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return the largest |c'e| of each flight."""
        largest, share = fly(self._tube, self._plans, episode, sequences)
        self.shares.extend(share.tolist())
        return largest @ np.abs(self._output)

    def slopes(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """There are none."""
        raise NotImplementedError

    def starts(self) -> FloatArray:
        """Return constant pushes along each state, both ways."""
        rays = np.concatenate([np.eye(4), -np.eye(4)])
        held = np.repeat(into_unit_ball(rays)[:, None], _STEPS, axis=1)
        return np.repeat(held[None], self.episodes, axis=0)


def attack(tube: AnyTube, plans: Plans, flights: int, budget: int) -> dict[str, Any]:
    """Return what the worst disturbances found do to a tube.

    Args:
        tube: The tube.
        plans: The plans that are flown.
        flights: Flights of each kind of disturbance.
        budget: Flights of each search.
    """
    rng = np.random.default_rng(3)
    which = rng.integers(len(plans.start), size=flights)
    random = [
        Disturbance(kind, 1.0, (True,) * 4).realise(rng, _STEPS, PERIOD)
        for kind in _KINDS
        for _ in range(flights)
    ]
    errors, share = fly(tube, plans, np.tile(which, len(_KINDS)), np.stack(random))
    steepest, worst = fly(tube, plans, which, None)
    largest = np.maximum(errors.max(axis=0), steepest.max(axis=0))
    shares = [share, worst]
    few = Plans(plans.start[:1], plans.controls[:1])
    for index in (1, 0):
        target = TubeTarget(tube, few, np.eye(4)[index])
        settings = SearchSettings(method="cross-entropy", budget=budget, population=50)
        for found in search(target, settings, seed=index):
            largest[index] = max(largest[index], found.score)
        shares.append(np.array(target.shares))
    every = np.concatenate(shares)
    return {
        "flights": len(every),
        "observed": dict(zip(("p", "theta", "p_dot", "theta_dot"), largest.tolist(), strict=True)),
        "largest_share": float(every.max()),
        "crossed": int(np.count_nonzero(every > 1.0 + _INTEGRATION)),
    }
