"""Policies side by side from Python, in one call: what `lagros bench` does on the command line.

result = compare("puck", {"mine": MyPolicy(), "lagros": "lagros"}, episodes=50)
print(result.table())
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.run.experiment import BenchmarkRun, Progress, Row
from lagros_benchmarks.run.runner import run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings, check_policy
from lagros_envs.checks import shown
from lagros_envs.registry import find_any
from lagros_envs.task import Described, Task

if TYPE_CHECKING:
    import pandas

    from lagros_benchmarks.report.canvas import Drawn

__all__ = ["Comparison", "compare"]

_WIDTH = 80  # of a table


@dataclass(frozen=True)
class Comparison:
    """What policies did on the same episodes; printed, it is its table.

    Attributes:
        run: Settings, episodes and plans.
        rows: The figures of each policy and condition, as in the JSON of `lagros bench`.
    """

    run: BenchmarkRun = field(repr=False)
    rows: list[Row] = field(repr=False)

    @property
    def episodes(self) -> list[Any]:
        """Records of all episodes, policy by policy, in the order of the rows.

        Of one body `EpisodeRecord`s; of many agents chunks of worlds, which
        `report.records.episode_objects(run)` takes apart.
        """
        return [record for records in self.run.episodes.values() for record in records]

    def table(self) -> str:
        """Return the tables, the paired differences and what raised, as text of 80 columns."""
        from rich.console import Console

        from lagros_benchmarks.report.delivery import print_report

        stream = io.StringIO()
        print_report(self.rows, Console(file=stream, width=_WIDTH, highlight=False))
        return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())

    def __str__(self) -> str:
        """Return the table."""
        return self.table()

    def to_pandas(self) -> pandas.DataFrame:
        """Return the scalar figures of each policy and condition, intervals as two columns.

        Raises:
            ImportError: Pandas is not installed.
        """
        try:
            import pandas
        except ImportError as error:
            raise ImportError("to_pandas() needs pandas: pip install 'lagros[pandas]'") from error
        from lagros_benchmarks.report.tables import scalar_figures

        plain = [
            {name: None if value == "" else value for name, value in line.items()}
            for line in scalar_figures(self.rows)
        ]
        return pandas.DataFrame(plain)

    def figure(self, path: str | Path | None = None) -> Drawn:
        """Draw the errors over time of one condition, or success against the bound of several.

        Args:
            path: File to write, which ends in .png, .pdf or .svg; None for none.

        Returns:
            The path, or the figure of Matplotlib, which a notebook shows.

        Raises:
            ValueError: The suffix is another, or no policy has a plan to be held against.
            ModuleNotFoundError: Matplotlib is not installed.
        """
        from lagros_benchmarks.report.figures import draw

        return draw(self.rows, path)


def compare(
    task: str | Described,
    policies: Mapping[str, Any] | Sequence[str],
    *,
    episodes: int | None = None,
    disturbance: str | Sequence[str] = "uniform",
    bound: float | Sequence[float] | None = None,
    seed: int = 0,
    jobs: int = 1,
    initial_error: float = 0.0,
    progress: Progress | None = None,
    **settings: Any,
) -> Comparison:
    """Fly policies on the same episodes: the same digits as `lagros bench` of the same.

    Args:
        task: A task, its name, the id of its environment ("lagros/Puck-v0"), or a file of a
            task of your own; or "gym:ID", an environment of Gymnasium's.
        policies: By the name that the table shows, each one of

            - an object with `predict(observation, state, episode_start, deterministic)`, of which a
              copy flies in every chunk of episodes; a model of stable-baselines3 is one, and flies
              behind the `VecNormalize` of its environment where it has one;
            - a class or a function, which is called with the task and returns such an object;
            - a name of this package, `module:Class`, or the .zip of a stable-baselines3 model;
            - a pair of such a name and a dictionary of settings for `lagros_policies.make`. A
              `VecNormalize` that was saved is loaded on request alone, because its pickle is code,
              as the zip is: `("ppo.zip", {"vecnormalize": "vecnormalize.pkl"})`.

            Names of this package alone may be a list.
        episodes: Of each policy and condition; None for the usual number of the task.
        disturbance: Kind, or several.
        bound: d_bar, or several, in units of the state per second; None for that of the task.
        seed: Of the run; its episodes occur in no training.
        jobs: Worker processes.
        initial_error: How far beside the plan episodes begin, as a share of the state's scale.
        progress: Called after every chunk with what is done, how much of it, and of how much.
        settings: Others of `BenchmarkSettings`, such as `channels`, `guarantee` or, of many agents,
            `agents`.

    Returns:
        Episodes, rows, and what shows them.

    Raises:
        ValueError: A name or a setting is not valid.
        SetupError: A policy, the planner or a metric cannot be built, or a policy cannot fly. What
            a policy raises in an episode is that episode's failure.
    """
    described = find_any(task)
    if isinstance(described, Task) and described is task:
        from lagros_envs.check_task import check_task

        check_task(described)
    given, made_with = _taken_apart(policies, described)
    chosen = BenchmarkSettings.for_task(
        described,
        policies=tuple(given),
        policy_settings=made_with,
        episodes=episodes,
        disturbances=(disturbance,) if isinstance(disturbance, str) else tuple(disturbance),
        bounds=None if bound is None else _several(bound),
        seed=seed,
        jobs=jobs,
        initial_error=initial_error,
        **settings,
    )
    own = {name: value for name, value in given.items() if value != name}
    run = run_benchmark(chosen, progress=progress, policies=own)
    return Comparison(run, summarise(run))


def _several(bound: float | Sequence[float]) -> tuple[float, ...]:
    return tuple(bound) if isinstance(bound, Sequence) else (bound,)


def _taken_apart(
    policies: Mapping[str, Any] | Sequence[str], task: Described
) -> tuple[dict[str, Any], dict[str, Mapping[str, Any]]]:
    """Return what flies by the name that it is shown by, and the settings of those that have some.

    Raises:
        ValueError: They are neither a dictionary nor a list of names, or a name is not known.
    """
    if isinstance(policies, str) or not isinstance(policies, Mapping | Sequence) or not policies:
        raise ValueError(
            f"policies={shown(policies)} must be a dictionary of policies by name, or a list of "
            "names"
        )
    named = policies if isinstance(policies, Mapping) else dict.fromkeys(policies)
    given: dict[str, Any] = {}
    settings: dict[str, Mapping[str, Any]] = {}
    for name, value in named.items():
        policy = name if value is None else value
        if isinstance(policy, tuple):
            if len(policy) != 2 or not isinstance(policy[1], Mapping):
                raise ValueError(
                    f"policies: {name!r} is {shown(policy)}; a pair is a name and a dictionary of "
                    "settings"
                )
            policy, settings[name] = policy
        policy = str(policy) if isinstance(policy, Path) else policy
        if isinstance(policy, str):
            check_policy(policy, task)
        given[name] = policy
    return given, settings
