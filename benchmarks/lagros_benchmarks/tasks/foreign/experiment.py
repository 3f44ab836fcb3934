"""A benchmark of an environment of somebody else's: its episodes, without plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lagros_benchmarks.run.experiment import BenchmarkRun
from lagros_benchmarks.run.keeping import Kept
from lagros_benchmarks.run.library import Toolbox, building, built_policy
from lagros_benchmarks.run.settings import BenchmarkSettings, Case, Condition
from lagros_benchmarks.run.workers import Progress
from lagros_benchmarks.tasks.foreign.loop import ForeignLoop, ForeignRecord, fly
from lagros_envs.foreign import Disturb, Foreign
from lagros_policies.policy import BasePolicy


@dataclass(frozen=True)
class ForeignExperiment:
    """See `run.experiment.Experiment`; a unit is the seed of an episode."""

    settings: BenchmarkSettings
    toolbox: Toolbox
    task: Foreign

    @classmethod
    def set_up(cls, settings: BenchmarkSettings, toolbox: Toolbox) -> ForeignExperiment:
        """Build everything once.

        Raises:
            SetupError: Something cannot be built, or cannot run.
        """
        task: Any = settings.description
        experiment = cls(settings, toolbox, task)
        with building(task.name):
            for condition in settings.conditions:
                experiment.environment(condition).reset(seed=0)
        for name in settings.policies:
            experiment.policy(name, experiment.environment(settings.conditions[0]))
        return experiment

    @property
    def timed_apart(self) -> bool:
        """Whether workers contend for the processor."""
        return self.settings.backend.in_parallel(self.settings.jobs)

    def units(self, progress: Progress | None, keeper: Kept | None = None) -> list[int]:
        """Return the seeds of the episodes."""
        return self.settings.episode_seeds()

    def play(self, case: Case, units: Sequence[int]) -> list[ForeignRecord]:
        """Run episodes one after the other and return their records."""
        env = self.environment(case.condition)
        policy = self.policy(case.policy, env)
        try:
            return [fly(env, policy, seed, case.policy, case.condition.kind) for seed in units]
        finally:
            env.close()

    def time(self, case: Case, units: Sequence[int]) -> list[ForeignRecord]:
        """Return the records, for their step times."""
        return self.play(case, units)

    def finish(
        self,
        units: Sequence[int],
        outcomes: Mapping[Case, Sequence[list[ForeignRecord]]],
        timing: Mapping[Case, list[ForeignRecord]] | None,
    ) -> BenchmarkRun:
        """Put the run together."""
        episodes = {
            case: [record for part in parts for record in part] for case, parts in outcomes.items()
        }
        timed = episodes if timing is None else timing
        return BenchmarkRun(self.settings, episodes, timed, self.task.control_period)

    def environment(self, condition: Condition) -> Disturb:
        """Return the environment of one condition."""
        return self.task.make(condition.kind, condition.bound, self.settings.channels)

    def policy(self, name: str, env: Disturb) -> BasePolicy:
        """Build a policy and call it once, so that what its first call loads is not timed.

        Raises:
            SetupError: It cannot be built, or cannot run.
        """
        given = self.settings.policy_settings.get(name, {})
        policy = built_policy(name, lambda: self.toolbox.make_policy(name, env, given))
        ForeignLoop(env, policy).rehearse(f"policy {name!r}")
        return policy
