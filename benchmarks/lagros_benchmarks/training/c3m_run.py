"""What a run of `lagros train TASK --algo c3m` depends on; nothing here needs torch."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from lagros_policies.learning.c3m import C3mSettings


@dataclass(frozen=True)
class Candidate:
    """Settings that no task names, one of several that are tried.

    Attributes:
        met: Whether x_d, u_d and x - x_d are drawn from what plans ask for and a regulator leaves,
            or from the box of the task's metric, which only tasks with one have.
        pace: lambda times the length of an episode, where 3 is the published 0.5 /s of 6 s; None
            for the rate of the run.
        largest: w_ub, in scaled coordinates.
    """

    met: bool
    pace: float | None
    largest: float


# The first is as published. The same for every task.
SCAN = (Candidate(False, None, 10.0), Candidate(True, 3.0, 10.0), Candidate(True, 6.0, 100.0))


@dataclass(frozen=True)
class C3mRun:
    """A run: of the candidates that are trained and flown the best is kept.

    The second and later ones are tried where the contraction that the first promises holds on less
    than `enough` of fresh states.

    Attributes:
        task: Its name.
        settings: How it trains, but for what the candidates say.
        scan: The candidates.
        enough: Share of fresh states; 1 to try all.
        scan_episodes: Episodes on which they are judged, under each of two kinds of disturbance.
        final_episodes: Held-out episodes at its end, likewise.
    """

    task: str
    settings: C3mSettings = field(default_factory=C3mSettings)
    scan: tuple[Candidate, ...] = SCAN
    enough: float = 0.5
    scan_episodes: int = 20
    final_episodes: int = 50

    label = "c3m"

    @property
    def seed(self) -> int:
        """Of the run."""
        return self.settings.seed

    def seeded(self, seed: int) -> C3mRun:
        """Return the same run with another seed."""
        return replace(self, settings=replace(self.settings, seed=seed))

    def settings_of(self, candidate: Candidate, time_limit: float) -> C3mSettings:
        """Return the settings of a candidate on a task whose episodes are that long [s]."""
        rate = self.settings.rate if candidate.pace is None else candidate.pace / time_limit
        return replace(self.settings, rate=rate, largest=candidate.largest)

    def record(self) -> dict[str, Any]:
        """Return all settings as JSON knows them."""
        own = {name: value for name, value in asdict(self).items() if name != "settings"}
        own |= {"seed": self.seed}
        return own | {"algorithm": {"name": self.label, **asdict(self.settings)}}
