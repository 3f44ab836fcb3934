"""The rows of the suite by system: who flew, what was found, and who is ahead of whom."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from lagros_benchmarks.run.experiment import Row
from lagros_benchmarks.run.suite_worst import worst_of

# Which of ours are held against which others.
OURS = ("tube-mpc", "lagros")
RIVALS = ("c3m", "sd-lqr", "lqr")


class Measure(NamedTuple):
    """What policies are compared by, of which less is better.

    Attributes:
        name: In the page.
        ratio: Field of `versus`.
        beside: Whether it is of the episodes that begin beside their plan.
    """

    name: str
    ratio: str
    beside: bool


MEASURES = (
    Measure("area", "error_area_ratio", False),
    Measure("normalised area", "error_area_ratio", True),
    Measure("peak", "overshoot_ratio", True),
)


class System:
    """The rows of one task of one body, found by policy, kind and start.

    Attributes:
        task: Its name.
        policies: In the order of the suite.
        kinds: Of disturbance.
    """

    def __init__(self, rows: Sequence[Row], searches: Sequence[Row] = ()) -> None:
        self.task = str(rows[0]["task"])
        self._searches = searches
        self.kinds = list(dict.fromkeys(row["disturbance"] for row in rows))
        self._rows = {
            (row["policy"], row["disturbance"], bool(row["initial_error"]), row["guarantee"]): row
            for row in rows
        }
        self.policies = list(dict.fromkeys(row["policy"] for row in rows))

    @property
    def first(self) -> Row:
        """Any of its rows."""
        return next(iter(self._rows.values()))

    @property
    def episodes(self) -> list[int]:
        """Numbers of episodes of its rows."""
        return [row["episodes"] for row in self._rows.values()]

    def row(self, policy: str, kind: str, beside: bool = False) -> Row | None:
        """Return the row of a policy under a kind, of episodes on or beside their plan."""
        return self._rows.get((policy, kind, beside, False))

    def proved(self, policy: str) -> Row | None:
        """Return the row of a policy in which guarantees were proved."""
        return self._rows.get((policy, self.kinds[0], False, True))

    def worst(self, policy: str, goal: str) -> Row | None:
        """Return what the search of a goal came to; None where there was none."""
        return worst_of(self._searches, self.task, policy, goal)

    def ratio(self, measure: Measure, ours: str, rival: str, kind: str) -> Any:
        """Return ratio and interval of a measure on the same episodes; None where there is none."""
        row = self.row(ours, kind, measure.beside)
        versus = None if row is None else row["versus"].get(rival)
        if versus is None or versus[measure.ratio] is None:
            return None
        return versus[measure.ratio], versus[f"{measure.ratio}_ci95"]

    def ahead(self, measure: Measure, ours: str, rival: str, *kinds: str) -> bool | None:
        """Return whether the whole interval is below 1 under all kinds; None without a rival."""
        found = [self.ratio(measure, ours, rival, kind) for kind in kinds or self.kinds]
        if any(one is None for one in found):
            return None
        return all(one[1] is not None and one[1][1] < 1.0 for one in found)


def systems_of(rows: Sequence[Row], searches: Sequence[Row] = ()) -> list[System]:
    """Return the systems of one body among rows, with what was searched."""
    names = dict.fromkeys(row["task"] for row in rows if "agents" not in row)
    return [System([row for row in rows if row["task"] == name], searches) for name in names]


def policies_of(systems: Sequence[System]) -> list[str]:
    """Return the policies that flew on any of some systems, in the order of the first."""
    return list(dict.fromkeys(name for system in systems for name in system.policies))
