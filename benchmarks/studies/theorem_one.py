"""Whether flights kept what Theorem 1 promises, as far as that goes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.episodes import TUBE_TOLERANCE
from lagros_benchmarks.worst_case.flights import Episodes, Flights, fly
from lagros_benchmarks.worst_case.single import SingleTarget
from lagros_envs.dynamics import control_matrix
from lagros_policies.contraction import certified_tube
from lagros_policies.contraction.metric import even_region
from lagros_policies.tasks.cartpole.expert import CartPoleExpert

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class Held:
    """Flights held against the tube of Theorem 1; every array has shape (b,).

    Attributes:
        learning_error: Largest ||u - u*|| while in the region.
        in_region: Whether the flight never left the region of the metric.
        certified_share: Largest ||e(t)|| / r_l(t) until the first instant outside, that instant
            included: the state came there from inside.
        certified_crossed: Whether that passes one.
        certified_radius: What r_l tends to, with the learning error of the flight.
    """

    learning_error: FloatArray
    in_region: BoolArray
    certified_share: FloatArray
    certified_crossed: BoolArray
    certified_radius: FloatArray


class TubeCheck:
    """The tube of Theorem 1 around the plans of some episodes, under one bound.

    Its hypotheses are that the state has stayed in the region of the metric so far and that
    ||u - u*|| <= eps_l; a flight that leaves the region is not held against it any longer. The
    eps_l of a flight is the one that it had, so that any policy can be asked. The tube is the
    paper's formula, with alpha as it is: for a metric of the state and a disturbance of what it
    depends on that is not a bound (`theorems.disturbed_rate`), and what is found is an observation.

    Args:
        expert: The law u* with its metric.
        episodes: The episodes.
        bound: d_bar, in units of the state per second.
    """

    def __init__(self, expert: CartPoleExpert, episodes: Episodes, bound: float) -> None:
        """Prepare the plans."""
        self._expert, self._episodes, self._bound = expert, episodes, bound
        self._tracked = expert.track(episodes.plans, episodes.controls)
        self._gain = largest_gain(expert)

    def hold(self, episode: IntArray, flights: Flights) -> Held:
        """Hold flights against the tube.

        Args:
            episode: Which episode each flight belongs to, shape (b,).
            flights: The flights.
        """
        episodes, expert = self._episodes, self._expert
        plans, controls = episodes.plans[episode], episodes.controls[episode]
        controls = np.concatenate([controls, controls[:, -1:]], axis=1)
        region = expert.metric.region
        inside = region.contains(flights.states, plans, controls) & flights.alive
        so_far = np.logical_and.accumulate(inside, axis=1)
        held = flights.alive.copy()
        held[:, 1:] &= so_far[:, :-1]
        error = self._learning_error(episode, flights, so_far[:, :-1])
        # The tube is linear in the push b_bar eps_l + d_bar.
        unit = certified_tube(expert.metric, 1.0)
        push = self._gain * error + self._bound
        times = episodes.settings.control_period * np.arange(plans.shape[1])
        radius = push[:, None] * unit.radius(times)
        distance = np.linalg.norm(flights.states - plans, axis=-1)
        share = np.where(held, distance / np.maximum(radius, TUBE_TOLERANCE), 0.0)
        return Held(
            error,
            np.asarray(inside.all(axis=1)),
            share[:, 1:].max(axis=1),
            np.asarray(np.any(held & (distance > radius + TUBE_TOLERANCE), axis=1)),
            push * unit.steady_radius,
        )

    def _learning_error(self, episode: IntArray, flights: Flights, acting: BoolArray) -> FloatArray:
        """Return the largest ||u - u*|| of each flight where it acts inside the region, (b,)."""
        flight, step = np.nonzero(acting)
        missed = np.zeros(acting.shape)
        if len(flight):
            wanted = self._expert.control(
                self._tracked, episode[flight], step, flights.states[flight, step]
            )
            off = flights.controls[flight, step] - wanted
            missed[flight, step] = np.linalg.norm(off, axis=-1)
        return np.asarray(missed.max(axis=1))


@dataclass(frozen=True)
class CertificateTarget(SingleTarget):
    """The same flights, scored by what they use of the tube of Theorem 1 while it holds.

    What breaks the tube of success has left the region of the metric by then; this looks for the
    share that counts.

    Attributes:
        check: The tube; it must be given.
    """

    check: TubeCheck | None = None

    @property
    def slope_cost(self) -> int:
        """None: the share has a jump where a flight leaves the region."""
        return 0

    def scores(self, episode: IntArray, sequences: FloatArray) -> FloatArray:
        """Return the largest share (b,) of the tube under d/d_bar (b, steps, n)."""
        assert self.check is not None
        flights = fly(self.flown, self.law, episode, self.bound * sequences)
        return self.check.hold(episode, flights).certified_share


def largest_gain(expert: CartPoleExpert, points: int = 1001) -> float:
    """Return b_bar, the largest ||B(x)|| over a grid of the region's angles (observed)."""
    states = np.zeros((points, 4))
    states[:, 1] = np.linspace(0.0, even_region(expert.metric)[1], points)
    matrices = control_matrix(expert.task.system, states)
    return float(np.linalg.norm(matrices, axis=(1, 2)).max())
