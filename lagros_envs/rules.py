"""The rules at the end of a control step of any single-body task, on numbers of several kinds.

They are recorded together with the equation of motion (`dynamics.straight_line`) and run like it on
floats, on arrays or compiled, so that the single environment and its vector form share them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from lagros_envs.numbers import functions as elementary
from lagros_envs.numbers.functions import where
from lagros_envs.task import Task


class Given(NamedTuple):
    """What the rules of a step are given, floats or arrays; the last four are theirs to renew.

    Attributes:
        start: The position at the beginning of the step [m]; () for a task without discs.
        discs: Of each disc the centre [m] and the square of the distance of contact [m^2].
        goal: x_f, its n parts.
        time: t at the end of the step [s].
        radius: How near the goal counts as success then.
        collided: Whether a disc has been touched so far; 0 for a task without discs.
        effort: The integral of ||u - centre||^2 before the step [control^2 s].
        effort_to_success: The same, frozen at the first success.
        success_time: Instant of the first success [s]; inf before.
    """

    start: Sequence[Any]
    discs: Sequence[Sequence[Any]]
    goal: Sequence[Any]
    time: Any
    radius: Any
    collided: Any
    effort: Any
    effort_to_success: Any
    success_time: Any


class Outcome(NamedTuple):
    """What the rules make of a step, floats or arrays.

    Attributes:
        collided: As in `Given`, after the step.
        effort: As in `Given`, after the step.
        effort_to_success: As in `Given`, after the step.
        success_time: As in `Given`, after the step.
        distance: From the goal.
        reward: See `Task.reward`.
        fallen: Whether the state has left what the task allows.
        inside: Whether x is within the radius of the goal, and not fallen.
        size: Grows without bound where the state does, and is nan where part of it is.
    """

    collided: Any
    effort: Any
    effort_to_success: Any
    success_time: Any
    distance: Any
    reward: Any
    fallen: Any
    inside: Any
    size: Any


@dataclass(frozen=True)
class StepRules:
    """The rules at the end of a control step: who has fallen, who has arrived, at what cost.

    Attributes:
        task: The task.
    """

    task: Task

    @cached_property
    def kept(self) -> slice:
        """Which part of an `Outcome` a step of this task gives; the others cost nothing.

        `collided` is left out without discs, `size` where the distance from the goal is that of
        whole states and says as much.
        """
        whole = not self.task.position and type(self.task).goal_distance is Task.goal_distance
        return slice(0 if self.task.most_discs else 1, 8 if whole else 9)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of what a step of this task gives, in order."""
        return tuple(Outcome._fields)[self.kept]

    @cached_property
    def head(self) -> int:
        """How many given numbers come before the goal: a position and three of each disc."""
        return 2 + 3 * self.task.most_discs if self.task.most_discs else 0

    @cached_property
    def given(self) -> int:
        """How many numbers are given, in the order of `Given`."""
        collided = 1 if self.task.most_discs else 0
        return self.head + self.task.system.state_dim + 5 + collided

    def __call__(
        self, state: Sequence[Any], control: Sequence[Any], given: Sequence[Any], functions: Any
    ) -> tuple[Any, ...]:
        """Judge a step by x at its end, u and the numbers of `Given`; see `names`."""
        judged: tuple[Any, ...] = self._judged(state, control, self._read(given), functions)
        return judged[self.kept]

    def begun(self, state: Sequence[Any], given: Sequence[Any]) -> tuple[Any, ...]:
        """Judge the start of an episode: as if a step without effort had ended there."""
        return self(state, self.task.control_centre, given, elementary)

    def lost(
        self, state: Sequence[Any], control: Sequence[Any], given: Sequence[Any], functions: Any
    ) -> tuple[Any, ...]:
        """Judge a step that could not be integrated: a fall, and x stays as it was before."""
        # Nothing is inside a radius below zero.
        before = self._read(given)._replace(radius=-1.0)
        judged = self._judged(state, control, before, functions)
        price = self.task.reward(self._spent(control), judged.distance, False, True)
        outcome: tuple[Any, ...] = judged._replace(reward=price, fallen=True)
        return outcome[self.kept]

    def touching(
        self,
        start: Sequence[Any],
        end: Sequence[Any],
        discs: Sequence[Sequence[Any]],
    ) -> Any:
        """Return whether the straight way between two positions touches a disc.

        Args:
            start: Two coordinates [m], floats or arrays.
            end: Likewise.
            discs: As in `Given`; a contact of zero is no disc.
        """
        across, up = end[0] - start[0], end[1] - start[1]
        square = across * across + up * up
        divisor = where(square > 0.0, square, 1.0)
        deepest: Any = None
        for x, y, contact in discs:
            beside, above = x - start[0], y - start[1]
            share = (beside * across + above * up) / divisor
            share = where(share > 0.0, share, 0.0)
            share = where(share > 1.0, 1.0, share)
            beside, above = beside - share * across, above - share * up
            depth = contact - (beside * beside + above * above)
            deepest = depth if deepest is None else where(depth > deepest, depth, deepest)
        return deepest > 0.0

    def _read(self, given: Sequence[Any]) -> Given:
        n = self.task.system.state_dim
        goal, tail = given[self.head : self.head + n], given[self.head + n :]
        if not self.head:
            return Given((), (), goal, tail[0], tail[1], 0.0, *tail[2:])
        discs = [given[k : k + 3] for k in range(2, self.head, 3)]
        return Given(given[:2], discs, goal, *tail)

    def _spent(self, control: Sequence[Any]) -> Any:
        """Return ||u - centre||^2 dt of a step."""
        total: Any = None
        for one, centre in zip(control, self.task.control_centre, strict=True):
            off = one - centre if centre else one
            total = off * off if total is None else total + off * off
        return total * self.task.control_period

    def _judged(
        self, state: Sequence[Any], control: Sequence[Any], before: Given, functions: Any
    ) -> Outcome:
        task = self.task
        distance = task.goal_distance(state, before.goal, functions)
        spent = self._spent(control)
        fallen = task.fallen(state, functions)
        inside = (distance <= before.radius) & (fallen <= 0.0)
        # Before the first success its instant is infinitely late.
        still_open = before.success_time > before.time
        first, down, collided = inside & still_open, fallen, before.collided
        if task.most_discs:
            end = [state[index] for index in task.position]
            collided = where(self.touching(before.start, end, before.discs), 1.0, collided)
            first = first & (collided <= 0.0)
            down = where(fallen, 1.0, collided) > 0.0
        effort = before.effort + spent
        size: Any = distance
        for part in state if self.kept.stop == len(Outcome._fields) else ():
            size = size + abs(part)
        return Outcome(
            collided,
            effort,
            where(still_open, effort, before.effort_to_success),
            where(first, before.time, before.success_time),
            distance,
            task.reward(spent, distance, first, down),
            fallen,
            inside,
            size,
        )


class Rows:
    """Rows of what is kept of every world, so that a restart writes all of it at once.

    Coordinates come first: that is what the equation of motion works on. The rules of a step read
    `given`, as `Given`, and renew `outcome`, as far as they keep of `Outcome`.

    Args:
        rules: The rules of a step of the task.
    """

    def __init__(self, rules: StepRules) -> None:
        """Lay out the rows."""
        n, names = rules.task.system.state_dim, rules.names
        self.state = slice(0, n)
        self.start = slice(n, n + min(rules.head, 2))
        self.discs = slice(self.start.stop, n + rules.head)
        self.goal = slice(n + rules.head, 2 * n + rules.head)
        self.now, self.radius = self.goal.stop, self.goal.stop + 1
        begin = self.radius + 1
        self.given = slice(n, n + rules.given)
        self.outcome = slice(begin, begin + len(names))
        self.count = self.outcome.stop
        places = {name: begin + place for place, name in enumerate(names)}
        # None where there are no discs.
        self.collided = places.get("collided")
        self.success_time, self.distance = places["success_time"], places["distance"]
        self.reward, self.fallen, self.inside = (
            places[name] for name in ("reward", "fallen", "inside")
        )
        # Of the info: from effort to distance, which lie side by side.
        self.effort = places["effort"]
        self.size = places.get("size", self.distance)
