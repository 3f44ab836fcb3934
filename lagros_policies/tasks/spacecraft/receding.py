"""Receding goals: what an agent is shown of a goal far away, and its way out of a deadlock.

A network that has learned ways of a few metres within half a minute can fly any way: it is shown
the point `reach` ahead on the straight line to the goal, and a time for it. The pace, one over the
other, is that at which the whole way takes a `share` of the time left until T, between a least and
a greatest one: who has time keeps out of others' way. That is a function of what is sensed, so that
NumPy, C and ONNX compute it alike.

Agents that wait for each other wait for ever: all see the same at every step. The rule against it
needs no word between them and three numbers of each:

    Who has not come `progress` closer to its goal than ever before for `patience`, and has not
    arrived, is shown the point ahead turned about itself by `angle` for `detour`: twice
    counter-clockwise, then twice clockwise, and so on, each two by `wider` more than the two
    before, and for `detour` more, up to three times. Then it counts anew from where it is.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from lagros_envs.arrays import BoolArray, ComplexArray, FloatArray
from lagros_envs.checks import check_at_most, check_fields
from lagros_envs.conventions import built_like
from lagros_envs.numbers.functions import maximum, minimum
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_policies.tasks.spacecraft.pace import LEAST_TIME

# The largest worlds in which the networks learned ways to their goals: in them goals are shown as
# they are.
LEARNED_AGENTS, LEARNED_ARENA = 8, 6.0  # [m]
# Of a plan from rest to rest, the largest over the mean.
SPEED_OF_PACE = 1.5
# Paces [m/s]: none is less than the first, or than that at which the longest ways, of 1.28 times
# the side of the arena, take T; none is more than the second.
SLOWEST, FASTEST = 0.25, 0.7
LONGEST_WAY = 1.28
_SOON = 1e-3  # what counts as time left when there is none [s]
# How often detours become wider, and how often longer.
_WIDER, _LONGER = 2, 3
COUNTERS = ("detours", "detour_steps")


class Waiting(NamedTuple):
    """What B agents remember, three numbers each, and what is counted of them.

    Attributes:
        closest: Least distance to the goal since the count began, shape (B,) [m].
        waited: Control steps since the agent came closer; below zero while a detour lasts, (B,).
        detours: Detours so far in this episode, (B,); their number says to which side the next is.
        steps: Control steps of detours in this episode, which decide nothing, (B,).
    """

    closest: FloatArray
    waited: FloatArray
    detours: FloatArray
    steps: FloatArray

    @classmethod
    def begun(cls, count: int) -> Waiting:
        """Return the memories of agents at the start of their episodes."""
        return cls(np.full(count, np.inf), *np.zeros((3, count)))

    def restarted(self, starts: BoolArray) -> Waiting:
        """Return the memories with those begun anew whose episodes start, shape (B,)."""
        fresh = self.begun(len(starts))
        return Waiting(*(np.where(starts, new, old) for new, old in zip(fresh, self, strict=True)))


@dataclass(frozen=True)
class Receding:
    """How far goals are shown, and the rule against deadlocks.

    Attributes:
        reach: Farther goals are shown this far ahead [m].
        pace: Least distance of what is shown over the time that is shown for it [m/s].
        fastest: The greatest [m/s].
        share: Of the time left, in which the whole way is to be flown.
        progress: How much closer counts as progress [m].
        patience: Time without progress before a detour [s].
        angle: By which the point ahead is turned about the agent first [rad].
        wider: By which it is turned more after each two detours [rad].
        detour: Time for which it is first, and by which that grows after each two detours [s].

    Raises:
        ValueError: A value is out of range.
    """

    reach: float = 2.0
    pace: float = SLOWEST
    fastest: float = FASTEST
    share: float = 0.4
    progress: float = 0.1
    patience: float = 3.0
    angle: float = 1.5
    wider: float = 0.35
    detour: float = 5.0

    def __post_init__(self) -> None:
        positive = [item.name for item in fields(self) if item.name != "wider"]
        check_fields(self, positive=positive, not_negative=("wider",))
        check_at_most("pace", self.pace, self.fastest, "or fastest must be larger")
        check_at_most("angle", self.angle + _WIDER * self.wider, float(np.pi))

    @classmethod
    def chosen(
        cls, given: Any, preset: Preset, horizon: float, speed_limit: float | None = None
    ) -> Receding | None:
        """Return what an argument `receding` of a policy means.

        Args:
            given: True or False; a `Receding`, or a mapping of its fields that differ; None for
                receding goals where worlds are larger than those in which the networks learned.
            preset: Of the worlds, with their number of agents.
            horizon: T, for which the usual pace is chosen [s].
            speed_limit: Largest speed [m/s], which is 1.5 times the pace; None for no limit.

        Raises:
            ValueError: It is something else, a field is unknown, or a value is out of range.
        """
        if given is None:
            given = preset.agents > LEARNED_AGENTS or preset.arena > LEARNED_ARENA
        fastest = FASTEST if speed_limit is None else min(FASTEST, speed_limit / SPEED_OF_PACE)
        asked = max(LONGEST_WAY * preset.arena / horizon, SLOWEST)
        usual = cls(pace=min(asked, fastest), fastest=fastest)
        if isinstance(given, bool):
            return usual if given else None
        return built_like(usual, given, "receding")

    def shown(self, goal: Any) -> Any:
        """Return the point that is shown of a goal relative to the agent, of any kind [m]."""
        distance = abs(goal)
        return goal * minimum(self.reach / maximum(distance, self.reach), 1.0)

    def pace_of(self, distance: Any, left: Any) -> Any:
        """Return the pace at which a way of that distance [m] is flown [m/s].

        Args:
            distance: Of the goal itself, of any kind of number [m].
            left: Until T; zero or less when that has passed [s].
        """
        asked = distance / maximum(left * self.share, _SOON)
        return minimum(maximum(asked, self.pace), self.fastest)

    def time_to_go(self, distance: Any, pace: Any) -> Any:
        """Return the time that is shown for the distance of the point that is shown [s]."""
        return maximum(distance / pace, LEAST_TIME)

    def turned(
        self, goal: ComplexArray, memory: Waiting, arrived: float, period: float
    ) -> tuple[ComplexArray, Waiting]:
        """Apply the rule against deadlocks for one control step.

        Args:
            goal: Relative to the agents, shape (B,) [m].
            memory: Of the agents.
            arrived: Distance at which an agent has arrived [m].
            period: Since the last step [s].

        Returns:
            The goals, turned about those who are on a detour, and the memories.
        """
        distance, away = np.abs(goal), memory.waited < 0.0
        patience = max(1, round(self.patience / period))
        pair = memory.detours // 2  # of the detour that begins now, if one does
        detour = np.round((1.0 + np.minimum(pair, _LONGER)) * self.detour / period)
        closer = distance <= memory.closest - self.progress
        idle = (distance > arrived) & (away | ~closer)
        waited = np.where(idle, memory.waited + 1.0, 0.0)
        begins = waited >= patience
        waited = np.where(begins, -np.maximum(detour, 1.0), waited)
        # Until a detour has ended the count begins anew at every step.
        closest = np.where(closer | away, distance, memory.closest)
        detours, away = memory.detours + begins, waited < 0.0
        closest = np.where(away, distance, closest)
        memory = Waiting(closest, waited, detours, memory.steps + away)
        pair = (detours - 1.0) // 2
        turn = self.angle + self.wider * np.minimum(pair, _WIDER)
        return goal * np.exp(1j * turn * np.where(pair % 2 == 0, away, -1.0 * away)), memory
