"""Run policies on paired episodes: episodes in chunks, step times without contention.

The same seeds give the same episodes to every policy, kind and bound, and the same records whether
one process runs them or many. What depends on the task is an `Experiment`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lagros_benchmarks.run.experiment import BenchmarkRun, Experiment
from lagros_benchmarks.run.fingerprints import fingerprint
from lagros_benchmarks.run.keeping import Kept
from lagros_benchmarks.run.library import GivenPolicies, Toolbox
from lagros_benchmarks.run.room import room_of
from lagros_benchmarks.run.settings import BenchmarkSettings, Case
from lagros_benchmarks.run.workers import Progress, gather, split
from lagros_envs.checks import check_instance, shown
from lagros_policies.backends import running

__all__ = [
    "BenchmarkRun",
    "Case",
    "Progress",
    "fly_scene",
    "kept_in",
    "make_experiment",
    "run_benchmark",
]


def make_experiment(settings: BenchmarkSettings, toolbox: Toolbox | None = None) -> Experiment:
    """Return the experiment of the settings' task, with everything built once as a check.

    Raises:
        SetupError: A policy, the planner or the metric cannot be built.
    """
    check_instance("settings", settings, BenchmarkSettings)
    kind = room_of(settings.description).part("experiment")
    made: Experiment = kind.set_up(settings, toolbox or Toolbox())
    return made


def kept_in(
    folder: Path | str, settings: BenchmarkSettings, toolbox: Toolbox | None = None
) -> Kept:
    """Return the finished chunks of a run of these settings, in a folder of its own below this one.

    Runs of other settings, policies, weights or versions have others, so that all may share one.

    Raises:
        ValueError: The settings are none.
    """
    check_instance("settings", settings, BenchmarkSettings)
    key = fingerprint(settings, toolbox or Toolbox())
    return Kept.named(Path(folder), settings.description.name, key)


def run_benchmark(
    settings: BenchmarkSettings,
    toolbox: Toolbox | None = None,
    progress: Progress | None = None,
    kept: Kept | None = None,
    policies: Mapping[str, Any] | None = None,
) -> BenchmarkRun:
    """Run every policy under every condition on the same episodes.

    Policies are built by their names, or are your own beside them, which are called by the names
    that you give them in the results (`lagros_benchmarks.compare` is the same in one call):

        settings = BenchmarkSettings(policies=("lqr", "mine"), episodes=20)
        run = run_benchmark(settings, policies={"mine": MyPolicy(gain=2.0)})
        for row in summarise(run):
            print(row["policy"], row["success_rate"])

    Args:
        settings: What to run.
        toolbox: Where policies and plans come from; `lagros_policies` if None.
        progress: Called after every chunk of work.
        kept: Has the chunks that an earlier run of the same settings has finished, and takes those
            that this one finishes; see `kept_in`. All but the times is the same with it, to the
            bit.
        policies: By name, objects with the `predict` of `Policy` (models of stable-baselines3 are
            some), classes or functions that make one of the task, or names and files of policies;
            those that the settings do not name fly after the others. Every chunk of episodes flies
            a copy (`copy.deepcopy`) as the object is now, and worker processes are sent it by
            value, so that none sees what another left behind, as if each were built anew.

    Returns:
        All episodes.

    Raises:
        SetupError: A policy, the planner or the metric cannot be built, or a policy cannot run.
            (What an episode raises is recorded as its failure instead.)
        ValueError: The settings are none; the policies are no dictionary; an object has the name of
            a policy of this package or one that is no single line, or comes with `kept`, which
            cannot tell one object from another; or `kept` is of other settings.
        BackendError: The backend is not installed, not reachable, or loses its workers.
    """
    check_instance("settings", settings, BenchmarkSettings)
    if kept is not None:
        check_instance("kept", kept, Kept, otherwise="as kept_in gives, or None")
    if policies:
        if kept is not None:
            raise ValueError("kept= cannot tell policies that are objects apart; leave it out")
        settings, toolbox = _with_policies(settings, toolbox, policies)
    if kept is not None and kept.key != fingerprint(settings, toolbox or Toolbox()):
        raise ValueError("kept is of other settings; use kept_in(folder, settings, toolbox)")
    experiment = make_experiment(settings, toolbox)
    cases, jobs, backend = settings.cases, settings.jobs, settings.backend
    with running(backend, jobs):
        units = experiment.units(progress, kept)
        chunks = [(case, part) for case in cases for part in split(units, settings.chunk)]

        def work(chunk: tuple[Case, Sequence[Any]]) -> Any:
            return experiment.play(*chunk)

        played = gather("episodes", work, chunks, jobs, progress, backend, kept)
    outcomes: dict[Case, list[Any]] = {case: [] for case in cases}
    for (case, _), outcome in zip(chunks, played, strict=True):
        outcomes[case].append(outcome)
    timing = None
    if experiment.timed_apart:
        # The first episodes again, in this process alone.
        first = units[: settings.timing_episodes]
        timed = gather(
            "timing", lambda case: experiment.time(case, first), cases, 1, progress, keeper=kept
        )
        timing = dict(zip(cases, timed, strict=True))
    return experiment.finish(units, outcomes, timing)


def fly_scene(
    settings: BenchmarkSettings,
    world: int = 0,
    toolbox: Toolbox | None = None,
    policies: Mapping[str, Any] | None = None,
) -> Any:
    """Fly one world of a benchmark of many agents again, from 0, and keep where everybody was.

    Raises:
        ValueError: The run has no such world.
    """
    if policies:
        settings, toolbox = _with_policies(settings, toolbox, policies)
    return room_of(settings.description).part("fly_scene")(settings, world, toolbox or Toolbox())


def _with_policies(
    settings: BenchmarkSettings, toolbox: Toolbox | None, policies: Mapping[str, Any]
) -> tuple[BenchmarkSettings, Toolbox]:
    """Return settings that name all policies and a toolbox that makes them."""
    from lagros_policies.policy import policy_names
    from lagros_policies.sb3_model import packed

    taken = policy_names(settings.description)
    if not isinstance(policies, Mapping):
        raise ValueError(f"policies={shown(policies)} must be a dictionary of objects by name")
    for name in policies:
        plain = isinstance(name, str) and name.isprintable() and name and name == name.strip()
        if not plain or name.endswith("+filter"):
            raise ValueError(
                f"policies: {shown(name)} is no name; take text of one line, which does not end in "
                "+filter"
            )
        if name in taken and policies[name] != name:
            raise ValueError(f"policies: {name!r} is a policy of this package; take another name")
    names = dict.fromkeys((*settings.policies, *policies))
    before = toolbox or Toolbox()
    given = {name: packed(policy, name) for name, policy in policies.items()}
    made = replace(before, make_policy=GivenPolicies(given, before.make_policy))
    return replace(settings, policies=tuple(names)), made
