"""From episodes to the rows of a published table: one flat object per policy and condition."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from lagros_benchmarks.run.experiment import BenchmarkRun, Row
from lagros_benchmarks.run.fingerprints import policy_digest, seeds_digest
from lagros_benchmarks.run.room import room_of
from lagros_benchmarks.run.settings import PROVED_FILTER, Case
from lagros_benchmarks.run.surroundings import machine, own_command, threads, versions

__all__ = ["Row", "episode_objects", "machine", "summarise", "threads", "versions"]


def summarise(run: BenchmarkRun, command: Sequence[str] | None = None) -> list[Row]:
    """Return one row per policy and condition: the public figures of a run.

    Efforts are averaged over the episodes that did not raise: one that raised has no effort, and
    counting none would flatter the policy. It still counts as a failure in every rate. The rows are
    in the order of the conditions and then of the policies. They hold the command that is given, or
    that of this process.
    """
    surroundings = {
        "machine": machine(),
        "versions": versions(),
        "threads": {
            **threads(),
            "jobs": run.settings.jobs,
            "backend": run.settings.backend.name,
        },
        "command": shlex.join(command if command is not None else own_command()),
    }
    own = room_of(run.settings.description).part("records")
    return [
        {
            **_identity(run, case),
            **own.figures(run, case),
            "raised": sum(one.error is not None for one in episodes),
            "errors": [{"seed": e.seed, "text": e.error} for e in episodes if e.error is not None],
            "evidence": _evidence(run, case),
            **_compared(run, case, own.comparison),
            **surroundings,
        }
        for case, episodes in run.episodes.items()
    ]


def episode_objects(run: BenchmarkRun) -> Iterable[dict[str, Any]]:
    """Return every episode, or every agent of every world, as a JSON object."""
    own = room_of(run.settings.description).part("records")
    found: Iterable[dict[str, Any]] = own.episode_objects(run)
    return found


def _identity(run: BenchmarkRun, case: Case) -> Row:
    settings = run.settings
    worlds = {} if case.agents is None else {"preset": settings.preset, "agents": case.agents}
    return {
        "task": settings.description.name,
        "policy": case.policy,
        "disturbance": case.condition.kind,
        "bound": case.condition.bound,
        "channels": settings.channels,
        **worlds,
        "episodes": settings.episodes,
        "seed": settings.seed,
        "safety_filter": case.safety_filter,
        **({"proved_filter": True} if settings.safety_filter == PROVED_FILTER else {}),
    }


def _evidence(run: BenchmarkRun, case: Case) -> Row:
    """Return by what somebody else can tell that the same was flown, and how each flight ended.

    Outcomes are one figure per episode, or per agent of each world in turn: 2 for a strict success,
    1 for a success, 0 for neither, "-" where nobody says what a success is.
    """
    settings = run.settings
    flights = [one for record in run.episodes[case] for one in getattr(record, "agents", [record])]
    return {
        "seeds_sha256": seeds_digest(settings.episode_seeds()),
        "policy_sha256": policy_digest(case.policy, settings.description),
        "outcomes": "".join(map(_outcome, flights)),
    }


def _outcome(record: Any) -> str:
    success = getattr(record, "success", None)
    if success is None:
        return "-"
    return str(int(success) + int(success and getattr(record, "strict_success", False)))


def _compared(run: BenchmarkRun, case: Case, compare: Callable[[Any, Any], Row]) -> Row:
    """Compare with every other policy, filtered alike, and with the policy without the filter."""
    ours = run.episodes[case]
    row: Row = {
        "versus": {
            name: compare(ours, run.episodes[case._replace(policy=name)])
            for name in run.settings.policies
            if name != case.policy
        }
    }
    if case.agents is not None:
        bare = case._replace(safety_filter=False)
        filtered = case.safety_filter and bare in run.episodes
        row["filter_effect"] = compare(ours, run.episodes[bare]) if filtered else None
    return row
