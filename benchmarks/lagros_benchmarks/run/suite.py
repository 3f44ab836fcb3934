"""All systems x all policies: the runs behind one page, each resumable on its own."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.run.experiment import Progress, Row
from lagros_benchmarks.run.library import SetupError, built_policy, make_policy
from lagros_benchmarks.run.runner import kept_in, run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings, check_policy
from lagros_benchmarks.run.suite_worst import search_worst
from lagros_benchmarks.run.surroundings import machine, own_command, threads, versions
from lagros_envs.checks import check_fields, check_whole
from lagros_envs.reading import read_json
from lagros_envs.registry import find_task, task_names
from lagros_envs.task import Described, Task
from lagros_policies.backends import LOKY, Backend
from lagros_policies.policy import policy_names

# Curves, and what stands once for all rows.
_LEFT_OUT = {
    *("time_s", "paper_tube", "certified_tube", "counters", "step_time_while_contended"),
    *("mean_tracking_error", "tracking_error_p10", "tracking_error_p90", "bound_over_worst"),
    *("machine", "versions", "threads", "command", "evidence"),
}


_PAGE = (
    *("learned", "tube-mpc", "lagros", "lqr-plan", "sd-lqr", "c3m", "mpc", "lqr"),
    *("ppo", "sac"),
)
# Of the settings, what the rows depend on and the page says.
_SAID = (
    *("policies", "episodes", "fewer", "worlds", "disturbances", "initial_error", "proved"),
    *("worst", "worst_flights", "seed", "jobs"),
)


class Missing(NamedTuple):
    """A policy that a task does not have, and why."""

    task: str
    policy: str
    reason: str


class TaskResult(NamedTuple):
    """What came of one task.

    Attributes:
        task: Its name.
        rows: As in the JSON of `lagros bench`, without curves; of one body those with an initial
            error too.
        missing: Policies that did not fly.
        worst: What the searches of the disturbance came to, see `suite_worst.search_worst`.
    """

    task: str
    rows: list[Row]
    missing: list[Missing]
    worst: list[Row]


@dataclass(frozen=True)
class SuiteSettings:
    """What the suite flies, each task at its own d_bar.

    Attributes:
        tasks: Tasks by what a user calls them.
        policies: Of tasks of one body; one that a task does not have is said to be missing. Tasks
            of many agents fly those of their own table.
        episodes: Episodes of one body, of each policy and condition.
        fewer: Episodes of policies that take long, the first of the others.
        worlds: Of many agents.
        disturbances: Kinds, with and without an error at the start.
        initial_error: That error, as a share of the scale of the state.
        proved: Plans of which the guarantees are proved, of the policies that the task certifies; 0
            for none.
        worst: Episodes of one body for each of which the worst disturbance is searched, of every
            policy; 0 for none.
        worst_flights: Flights that a search may spend on an episode.
        seed: Of all runs.
        jobs: Worker processes.
        backend: Whose processes they are.

    Raises:
        ValueError: A setting is not valid.
    """

    tasks: tuple[str, ...] = field(default_factory=task_names)
    policies: tuple[str, ...] = field(default_factory=lambda: _usual_policies())
    episodes: int = 200
    fewer: Mapping[str, int] = field(default_factory=lambda: {"mpc": 20})
    worlds: int = 50
    disturbances: tuple[str, ...] = ("uniform", "constant")
    initial_error: float = 0.2
    proved: int = 50
    worst: int = 5
    worst_flights: int = 300
    seed: int = 0
    jobs: int = 1
    backend: Backend = LOKY

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("episodes", "worlds"):
            check_whole(name, getattr(self, name), 1, 1_000_000)
        for policy, count in self.fewer.items():
            check_whole(f"fewer={policy}", count, 1, self.episodes)
        for name in ("proved", "worst"):
            check_whole(name, getattr(self, name), 0, 1_000_000)
        check_whole("worst_flights", self.worst_flights, 1, 1_000_000)
        described = [find_task(name) for name in self.tasks]
        for task in described:
            self._run(task)  # says what is wrong with the rest
        bodies = [task for task in described if task.most_agents == 1]
        for policy in self.policies if bodies else ():
            if all(_unknown(policy, task) for task in bodies):
                check_policy(policy, bodies[0])

    def parts(self, task: Any, policies: tuple[str, ...]) -> Iterator[BenchmarkSettings]:
        """Yield the runs of a task of one body, with policies that it has."""
        counts = {name: self.fewer.get(name, self.episodes) for name in policies}
        for count in dict.fromkeys(counts.values()):
            group = tuple(name for name, own in counts.items() if own == count)
            for error in dict.fromkeys((0.0, self.initial_error)):
                yield self._run(task, policies=group, episodes=count, initial_error=error)
        certified = tuple(name for name in task.defaults.certify_policies if name in policies)
        if self.proved and certified:
            yield self._run(
                task,
                policies=certified,
                episodes=self.proved,
                initial_error=0.0,
                guarantee=True,
                disturbances=self.disturbances[:1],
            )

    def _run(self, task: Any, **given: Any) -> BenchmarkSettings:
        common: dict[str, Any] = {
            "disturbances": self.disturbances,
            "bounds": (task.defaults.bound,),
            "seed": self.seed,
            "jobs": self.jobs,
            "backend": self.backend,
            "episodes": self.worlds,
        }
        if task.most_agents == 1:
            common |= {"policies": self.policies, "initial_error": self.initial_error}
        return BenchmarkSettings.for_task(task, **(common | given))


def _usual_policies() -> tuple[str, ...]:
    """Return the policies of the page that there are."""
    known = {name for task in map(find_task, task_names()) for name in policy_names(task)}
    return tuple(name for name in _PAGE if name in known)


def _unknown(policy: str, task: Described) -> bool:
    try:
        check_policy(policy, task)
    except ValueError:
        return True
    return False


def flyable(task: Task, policies: tuple[str, ...]) -> tuple[tuple[str, ...], list[Missing]]:
    """Return which policies a task of one body has, and what the others lack."""
    from lagros_envs.env import TaskEnv

    env = TaskEnv(task=task)
    there, missing = [], []
    for name in policies:
        if _unknown(name, task):
            missing.append(Missing(task.name, name, "no such policy"))
            continue
        try:
            built_policy(name, partial(make_policy, name, env, {}))
        except SetupError as error:
            # Without the folder of this machine, in which they would be.
            absent = isinstance(error.__cause__, FileNotFoundError)
            missing.append(Missing(task.name, name, "not trained" if absent else str(error)))
        else:
            there.append(name)
    return tuple(there), missing


def fly_task(
    settings: SuiteSettings,
    name: str,
    folder: Path,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> TaskResult:
    """Fly all that the suite asks of one task, going on with what the folder keeps.

    Raises:
        BackendError: The backend is not there, or loses its workers.
    """
    task: Any = find_task(name)
    missing: list[Missing] = []
    policies: tuple[str, ...] = ()
    if task.most_agents > 1:
        runs = [settings._run(task)]
    else:
        policies, missing = flyable(task, settings.policies)
        runs = list(settings.parts(task, policies)) if policies else []
    rows: list[Row] = []
    for number, run in enumerate(runs, 1):
        if say is not None:
            beside = f", beside the plan by {run.initial_error:g}" if run.initial_error else ""
            proofs = ", with proofs" if run.guarantee else ""
            names = ", ".join(run.policies)
            say(f"{task.name} {number}/{len(runs)}: {run.episodes} × {names}{beside}{proofs}")
        try:
            flown = run_benchmark(run, progress=progress, kept=kept_in(folder, run))
        except SetupError as error:
            missing += [Missing(task.name, policy, str(error)) for policy in run.policies]
            continue
        rows += [slim(row) for row in summarise(flown)]
    searched: list[Row] = []
    if settings.worst and runs and task.most_agents == 1:
        if say is not None:
            say(f"{task.name}: worst found, {settings.worst} × {', '.join(policies)}")
        searched = search_worst(
            settings._run(task, policies=policies, episodes=settings.worst, initial_error=0.0),
            task,
            settings.worst_flights,
            folder,
            progress,
        )
    return TaskResult(task.name, rows, missing, searched)


def slim(row: Row) -> Row:
    """Return a row without curves and surroundings, for a file of many."""
    return {name: value for name, value in row.items() if name not in _LEFT_OUT}


def with_task(result: dict[str, Any], settings: SuiteSettings, flown: TaskResult) -> dict[str, Any]:
    """Return the result of a suite, {} at its beginning, with one more task or one anew."""
    said = {name: value for name, value in asdict(settings).items() if name in _SAID}
    surroundings = {"machine": machine(), "versions": versions(), "threads": threads()}
    # A command that flies some tasks anew is not what makes all of it.
    begun = {"command": shlex.join(own_command()), "settings": said, **surroundings}
    before = {"rows": [], "missing": [], "worst": [], **begun, **result}
    others, searched = (
        [row for row in before[name] if row["task"] != flown.task] for name in ("rows", "worst")
    )
    missing = [one for one in before["missing"] if one[0] != flown.task]
    names = list(dict.fromkeys((*(row["task"] for row in before["rows"]), flown.task)))
    rows = sorted([*others, *flown.rows], key=lambda row: names.index(row["task"]))
    found = {"missing": [*missing, *flown.missing], "worst": [*searched, *flown.worst]}
    return {**before, "rows": rows, **found}


def read_result(path: Path) -> dict[str, Any]:
    """Return the result in a file of `lagros suite`, its settings as `SuiteSettings` takes them.

    Raises:
        ValueError: It is no such file.
        OSError: It cannot be read.
    """
    found = read_json(path)
    try:
        said = {name: found["settings"][name] for name in _SAID}
        for name in ("rows", "missing", "worst", "command", "machine"):
            found[name]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} is not the JSON of `lagros suite`: it has no {error}") from None
    told = {name: tuple(one) if isinstance(one, list) else one for name, one in said.items()}
    return {**found, "settings": told}
