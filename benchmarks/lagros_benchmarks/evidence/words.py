"""What is guaranteed of episodes in words: one line first, then what it rests on."""

from __future__ import annotations

import numpy as np

from lagros_benchmarks.evidence.guaranteed import Evidence, coordinates, not_shown
from lagros_benchmarks.evidence.loops import Loop
from lagros_envs.numbers import Interval, exact, functions
from lagros_envs.numbers.interval import Truth
from lagros_envs.task import Task
from lagros_policies.contraction.statement import Statement, at_most

# Far beyond any state of an episode.
_FAR = 1e3
_DIGITS = 3


def headline(task: Task, loop: Loop, found: Evidence, bound: float) -> str:
    """Return in one line for how many episodes what is guaranteed, and what a search came to."""
    proved, worst = found.proved, float(found.worst.error.max())
    if proved is None:
        return f"nothing is guaranteed: {loop.why}; the search found ‖x − x_d‖ up to {worst:.3g}"
    count = f"guaranteed for {found.count} of {found.asked} episodes at d̄ = {bound:g}"
    if found.contradicted:
        return f"CONTRADICTED in {found.contradicted} episodes by flights: {count} does not hold"
    if not found.count:
        less = ""
        if found.smaller is not None:
            less = f", and for {found.smaller[1]} at d̄ = {found.smaller[0]:.3g}"
        return (
            f"{count}{less}; not shown: {_missing(found)}; the search found ‖x − x_d‖ up to "
            f"{worst:.3g}"
        )
    what = ["reaches the goal"]
    if task.most_discs:
        what.append("touches no disc")
    what += _bounds(task, found)
    share = 100.0 * float(np.median(found.shares))
    return (
        f"{count}: {', '.join(what)}, whatever the disturbance does; the search came to "
        f"{share:.0f} % of the bound"
    )


def proved_lines(task: Task, loop: Loop, found: Evidence) -> list[Statement]:
    """Return the lines of what is proved; none where nothing is."""
    proved = found.proved
    if proved is None or not proved.closed.any():
        return []
    closed = proved.closed
    plans, names = len(closed), coordinates(task)
    # A hold that is long for the motion may leave nothing known between two instants.
    between = proved.error[closed & np.isfinite(proved.error).all(axis=1)]
    where = "at the control instants and between them"
    if len(between) < closed.sum():
        where = "at the control instants"
        where += f", and between them around {len(between)}" if len(between) else " alone"
    sizes = ", ".join(
        f"{at_most(float(size), _DIGITS)} {name}"
        for size, name in zip(between.max(axis=0, initial=0.0), names, strict=True)
    )
    by_coordinate = f", by coordinate {sizes}" if len(between) else ""
    control = at_most(float(proved.deviation[closed].max()), _DIGITS)
    tube = (
        f"no disturbance up to d_bar takes the state out of its tube around {int(closed.sum())} of "
        f"{plans} plans, {where}: ||x - x_d|| <= "
        f"{at_most(float(proved.norm[closed].max()), _DIGITS)}{by_coordinate}; u stays "
        f"within {control} of u_d ({found.proof_seconds / plans:.2g} s a plan)"
    )
    lines = [Statement(tube, "proved", True, found.proof_seconds)]
    if found.count:
        distance = at_most(float(proved.goal_distance[proved.holds].max()), _DIGITS)
        rules = (
            f"in {found.count} of these tubes every state keeps the rules of the task: at the time "
            f"limit {distance} from the goal or nearer (asked: "
            f"{float(task.success_radius(task.time_limit)):.4g}), never fallen"
            + (", no disc touched on the straight way of a step" if task.most_discs else "")
        )
        if missing := _missing(found):
            rules += f"; of the others not shown: {missing}"
        lines.append(Statement(rules, "proved", True, 0.0))
    return lines


def search_line(found: Evidence) -> Statement:
    """Return what the search came to; it does not hold where it contradicts what is proved."""
    worst, shares = found.worst, found.shares
    text = (
        f"search, {worst.flights} flights for each of {len(worst.error)} episodes (aimed, "
        f"constant, climbing): ||x - x_d|| up to {float(worst.error.max()):.4g}"
    )
    if shares.size:
        text += (
            f", {100 * shares.min():.0f} to {100 * shares.max():.0f} % of its bound (median "
            f"{100 * float(np.median(shares)):.0f} %)"
        )
    if found.proved is not None:
        text += f"; {found.contradicted} episodes did what is proved impossible"
    return Statement(text, "observed", found.contradicted == 0, found.search_seconds)


def _missing(found: Evidence) -> str:
    return ", ".join(f"{name} ({count})" for name, count in not_shown(found).items())


def _bounds(task: Task, found: Evidence) -> list[str]:
    """Return the bounds of what the rules of falling look at, or of the way from the plan."""
    assert found.proved is not None
    kept = found.proved.holds
    state, names = found.proved.state[kept].max(axis=0), task.state_names
    units = [name.partition("[")[2].rstrip("]") for name in names] or [""] * len(state)
    bounds = [
        f"|{name}| ≤ {at_most(float(size), _DIGITS)} {unit}".strip()
        for name, size, unit in zip(coordinates(task), state, units, strict=True)
    ]
    # Where a motion between the instants is not enclosed, nothing is said of it.
    watched = [index for index in watched_coordinates(task) if np.isfinite(state[index])]
    if watched:
        return [bounds[index] for index in watched]
    norm = at_most(float(found.proved.norm[kept].max()), _DIGITS)
    return [f"‖x − x_d‖ ≤ {norm}"]


def watched_coordinates(task: Task) -> tuple[int, ...]:
    """Return the coordinates of the state that the rules of falling look at, one at a time."""
    found = []
    for index in range(task.system.state_dim):
        place = [exact(np.zeros(1)) for _ in range(task.system.state_dim)]
        place[index] = Interval([-_FAR], [_FAR])
        try:
            fallen = task.fallen(place, functions)
        except (TypeError, ValueError, ArithmeticError, AttributeError):
            return ()
        if isinstance(fallen, Truth) and np.any(fallen.can & ~fallen.must):
            found.append(index)
    return tuple(found)
