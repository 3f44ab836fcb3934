"""What a run of `lagros train TASK --algo c3m` depends on; nothing here needs torch."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from lagros_policies.learning.c3m import C3mSettings


@dataclass(frozen=True)
class C3mRun:
    """A run.

    Attributes:
        task: Its name.
        settings: How it trains.
        final_episodes: Held-out episodes at its end, under each of two kinds of disturbance.
    """

    task: str
    settings: C3mSettings = field(default_factory=C3mSettings)
    final_episodes: int = 50

    label = "c3m"

    @property
    def seed(self) -> int:
        """Of the run."""
        return self.settings.seed

    def seeded(self, seed: int) -> C3mRun:
        """Return the same run with another seed."""
        return replace(self, settings=replace(self.settings, seed=seed))

    def record(self) -> dict[str, Any]:
        """Return all settings as JSON knows them."""
        own = {"task": self.task, "seed": self.seed, "final_episodes": self.final_episodes}
        return own | {"algorithm": {"name": self.label, **asdict(self.settings)}}
