"""A leaderboard of submitted files of `lagros bench --json`: which are as they should be, in order.

A submission is read as data and nothing in it is run. What it says is held against what it says
elsewhere and what everybody can compute: the seeds of the episodes, their number, the hashes of
shipped weights, the rates and intervals of the outcomes. Whoever changes all of these together is
found out by flying some of the episodes again (`fly_again`).
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lagros_benchmarks.report.formats import number, percent, policy_label
from lagros_benchmarks.run.fingerprints import policy_digest, seeds_digest
from lagros_benchmarks.run.metrics import wilson_interval
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_benchmarks.run.surroundings import versions
from lagros_benchmarks.run.workers import Progress
from lagros_envs.checks import shown
from lagros_envs.reading import Record, named, read_json
from lagros_envs.registry import task_named, task_names
from lagros_envs.task import Described
from lagros_policies.policy import policy_names

# What is flown: these episodes (worlds), under each of these kinds at the task's own bound.
SEED, EPISODES, WORLDS = 0, 200, 50
KINDS = ("uniform", "constant")
_NAME = re.compile(r"(\d{4}-\d{2}-\d{2})_([A-Za-z0-9][A-Za-z0-9-]{0,38})\.json")
_MOST_ROWS, _LONGEST = 1000, 80
# Digits of a rate, and of an interval that another processor computed.
_CLOSE = 1e-9
# Share of episodes flown again that may end otherwise, on another processor.
_OTHERWISE = 0.05


@dataclass(frozen=True)
class Submission:
    """A submission that was found as it should be.

    Attributes:
        who: Who handed it in, from the name of the file.
        when: The day, likewise.
        file: The name of the file.
        rows: Its rows, as `lagros bench` writes them.
    """

    who: str
    when: datetime.date
    file: str
    rows: tuple[dict[str, Any], ...]

    @property
    def code(self) -> list[str]:
        """The policies that are no name of this package: somebody's code."""
        names = {row["policy"]: task_named(row["task"]) for row in self.rows}
        return [name for name, task in names.items() if name not in policy_names(task)]


def read_submission(path: Path) -> Submission:
    """Read a submission, and check all that can be checked without flying.

    Args:
        path: A file WHEN_WHO.json, such as 2026-01-31_somebody.json.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no submission; the message says what is wrong.
    """
    name = named(path)
    told = _NAME.fullmatch(path.name)
    try:
        when = datetime.date.fromisoformat(told[1] if told else "")
    except ValueError:
        raise ValueError(
            f"{name}: the name says neither when nor who; call it like 2026-01-31_somebody.json"
        ) from None
    content = read_json(path, "what `lagros bench --json` writes")
    if not isinstance(content, list) or not 0 < len(content) <= _MOST_ROWS:
        raise ValueError(f"{name} is no list of 1 to {_MOST_ROWS} rows, as `lagros bench --json`")
    rows = [Record(row, f"{name}: row {index}") for index, row in enumerate(content, 1)]
    for row in rows:
        _check_asked(row)
        _check_evidence(row)
    _check_together(rows, name)
    assert told is not None
    return Submission(told[2], when, path.name, tuple(dict(row.entries) for row in rows))


def settings_of(task: Described, policies: Sequence[str], **given: Any) -> BenchmarkSettings:
    """Return the run that a submission of a task is a part of, or a shorter one of it."""
    usual: dict[str, Any] = {"episodes": EPISODES if task.most_agents == 1 else WORLDS}
    usual |= {
        "seed": SEED,
        "disturbances": KINDS,
        "bounds": (task.defaults.bound,),
        "policies": tuple(policies),
    }
    return BenchmarkSettings.for_task(task, **usual | given)


def _check_asked(row: Record) -> None:
    """Check that a row is of what everybody flies.

    Raises:
        ValueError: It is of something else.
    """
    task, policy = row.text("task"), row.text("policy")
    if task not in task_names():
        raise ValueError(
            f"{row.name}: {shown(task)} is no task of lagros: {', '.join(task_names())}"
        )
    if not (policy.isprintable() and 0 < len(policy.strip()) == len(policy) <= _LONGEST):
        raise ValueError(f"{row.name}: {shown(policy)} is no name of a policy")
    asked = settings_of(task_named(task), ["lqr"])
    wanted: dict[str, Any] = {
        "seed": asked.seed,
        "episodes": asked.episodes,
        "bound": asked.bounds[0],
        "channels": asked.channels,
    }
    if asked.description.most_agents > 1:
        wanted |= {"preset": asked.preset, "agents": asked.agents[0]}
    else:
        wanted |= {"initial_error": 0.0}
    for name, value in wanted.items():
        if type(row[name]) is bool or row[name] != value:
            raise ValueError(
                f"{row.name}: {name!r} is {shown(row[name])}, and {shown(value)} is what everybody "
                f"flies in {task}"
            )
    if row["disturbance"] not in KINDS:
        kinds = ",".join(KINDS)
        raise ValueError(f"{row.name}: fly --disturbance {kinds}, not {shown(row['disturbance'])}")
    here, theirs = versions().get("lagros"), row.record("versions").text("lagros")
    if theirs != here:
        raise ValueError(
            f"{row.name} was flown with lagros {shown(theirs)}, and this is {here}; fly it again"
        )
    evidence, digest = row.record("evidence"), seeds_digest(asked.episode_seeds())
    if evidence.text("seeds_sha256") != digest:
        raise ValueError(f"{row.name}: its episodes are not those of --seed {SEED}")
    weights = evidence["policy_sha256"]
    if policy in policy_names(asked.description):
        if weights != policy_digest(policy, asked.description):
            raise ValueError(
                f"{row.name}: it was flown with other weights than those that {policy!r} has here"
            )
    elif not (isinstance(weights, str) and re.fullmatch(r"[0-9a-f]{64}", weights)):
        raise ValueError(
            f"{row.name}: {policy!r} has no hash of its file; fly a model.zip or module:Class"
        )
    command = row.text("command").split()
    if command[:2] != ["lagros", "bench"] or not command[2:]:
        raise ValueError(f"{row.name}: its command is not `lagros bench`")


def _check_evidence(row: Record) -> None:
    """Check that the figures of a row are those of its outcomes.

    Raises:
        ValueError: One is not.
    """
    agents = row.whole("agents") if "agents" in row.entries else 1
    count = row.whole("episodes") * agents
    outcomes = row.record("evidence").text("outcomes")
    if len(outcomes) != count or set(outcomes) - set("012"):
        raise ValueError(f"{row.name}: 'outcomes' must be {count} figures of 0, 1 and 2")
    strict = outcomes.count("2")
    for name, held in (("success", strict + outcomes.count("1")), ("strict_success", strict)):
        _check_close(row, f"{name}_rate", [row.number(f"{name}_rate")], [held / count])
        ends = row.array(f"{name}_ci95", (2,)).tolist()
        _check_close(row, f"{name}_ci95", ends, list(wilson_interval(held, count)))
    raised = row.list("errors")
    if row.whole("raised") != len(raised):
        raise ValueError(f"{row.name}: 'raised' is not the number of its 'errors'")
    seeds = settings_of(task_named(row.text("task")), ["lqr"]).episode_seeds()
    for error in raised:
        seed = Record(error, f"{row.name}: an error").whole("seed")
        if seed not in seeds:
            raise ValueError(f"{row.name}: an error is of the seed {seed}, which nobody flies")
    step = row.number("step_time_median_s")
    if not 0.0 < step <= row.number("step_time_max_s"):
        raise ValueError(f"{row.name}: 'step_time_median_s' cannot be {step!r}")
    effort = row["effort_mean"]
    if effort is not None and row.number("effort_mean") < 0.0:
        raise ValueError(f"{row.name}: 'effort_mean' cannot be {effort!r}")
    if effort is None and row.whole("raised") < row.whole("episodes"):
        raise ValueError(f"{row.name}: 'effort_mean' is null, and not every episode raised")
    if effort is not None and row["effort_ci95"] is not None:
        low, high = row.array("effort_ci95", (2,)).tolist()
        if not low <= effort <= high:
            raise ValueError(f"{row.name}: 'effort_mean' is outside its own interval")


def _check_together(rows: Sequence[Record], name: str) -> None:
    """Check that every policy has flown under every kind, once, and the comparisons of the rows.

    Raises:
        ValueError: One has not.
    """
    found: dict[tuple[Any, ...], Record] = {}
    for row in rows:
        key = _key(row.entries, str(row["disturbance"]))
        if key in found:
            raise ValueError(f"{row.name}: it is in the file twice")
        found[key] = row
    for row in rows:
        for kind in KINDS:
            if _key(row.entries, kind) not in found:
                raise ValueError(f"{name}: {row['policy']!r} has not flown under {kind!r}")
        for other, said in row.record("versus").entries.items():
            beside = found.get(_key({**row.entries, "policy": other}, str(row["disturbance"])))
            if beside is not None:
                told = Record(said, f"{row.name}: versus {other}").number("success_difference")
                apart = row.number("success_rate") - beside.number("success_rate")
                _check_close(row, f"success beside {other}", [told], [apart])


def _key(row: Any, kind: str) -> tuple[Any, ...]:
    return row["task"], row["policy"], bool(row["safety_filter"]), kind


def _check_close(row: Record, what: str, told: Iterable[float], wanted: Iterable[float]) -> None:
    for one, other in zip(told, wanted, strict=True):
        if not math.isclose(one, other, rel_tol=0.0, abs_tol=_CLOSE):
            raise ValueError(f"{row.name}: {what} is {one!r}, and {other!r} by its outcomes")


def fly_again(
    submission: Submission,
    episodes: int,
    trusted: Sequence[str] = (),
    progress: Progress | None = None,
) -> str:
    """Fly the first episodes of every row again, and return what came of it.

    Args:
        submission: What to fly.
        episodes: How many (worlds), of each row.
        trusted: Policies that are code, and may run.
        progress: Called after every chunk of work.

    Raises:
        ValueError: A policy is code that is not trusted or is another here, or too many episodes
            end otherwise.
        SetupError: A policy cannot be built.
    """
    from lagros_benchmarks.report.records import summarise
    from lagros_benchmarks.run.runner import run_benchmark

    for name in submission.code:
        if name not in trusted:
            raise ValueError(
                f"{submission.file}: {name!r} is code of somebody's; name it with --trust {name} "
                "if you trust it, where its file is"
            )
    flown = differing = 0
    for task, filtered in dict.fromkeys((r["task"], r["safety_filter"]) for r in submission.rows):
        rows = [r for r in submission.rows if (r["task"], r["safety_filter"]) == (task, filtered)]
        settings = settings_of(task_named(task), list(dict.fromkeys(r["policy"] for r in rows)))
        count = min(episodes, settings.episodes)
        settings = replace(
            settings, episodes=count, safety_filter="all" if filtered else "none", timing_episodes=1
        )
        again = {
            (row["policy"], row["disturbance"]): row["evidence"]
            for row in summarise(run_benchmark(settings, progress=progress))
        }
        for row in rows:
            told, found = row["evidence"], again[row["policy"], row["disturbance"]]
            if told["policy_sha256"] != found["policy_sha256"]:
                raise ValueError(
                    f"{submission.file}: {row['policy']!r} has another file here than it was flown "
                    "from"
                )
            pairs = list(zip(told["outcomes"], found["outcomes"], strict=False))
            flown += len(pairs)
            differing += sum(one != other for one, other in pairs)
    if differing > _OTHERWISE * flown:
        raise ValueError(
            f"{submission.file}: of {flown} flights flown again {differing} end otherwise than it "
            "says"
        )
    return f"{flown} flights flown again, {differing} ended otherwise"


_HEADINGS = (
    *("policy", "who", "when", *(f"strict, {kind} [%]" for kind in KINDS)),
    *("effort", "Δt [µs]", "file"),
)


def table(submissions: Iterable[Submission]) -> str:
    """Return the leaderboard as Markdown: a table for each task, the best first.

    The best has the most strict successes under the last of `KINDS`, and then the least effort.
    """
    lines = [
        (rows[0]["task"], _rank(rows), _cells(submission, rows))
        for submission in submissions
        for rows in _policies(submission)
    ]
    text = []
    for task in dict.fromkeys(name for name in task_names() if name in {one[0] for one in lines}):
        described = task_named(task)
        text.append(f"## {described.title}, d̄ = {described.defaults.bound:g}\n")
        text.append(f"| {' | '.join(_HEADINGS)} |")
        text.append("| --- | --- | --- |" + " ---: |" * (len(_HEADINGS) - 4) + " --- |")
        ranked = sorted((one for one in lines if one[0] == task), key=lambda one: one[1])
        text += [f"| {' | '.join(cells)} |" for _, _, cells in ranked]
        text.append("")
    return "\n".join(text)


def _policies(submission: Submission) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows of each policy, in the order of `KINDS`."""
    by_key = {_key(row, row["disturbance"]): row for row in submission.rows}
    for key in dict.fromkeys(key[:-1] for key in by_key):
        yield [by_key[*key, kind] for kind in KINDS]


def _rank(rows: Sequence[dict[str, Any]]) -> tuple[Any, ...]:
    last = rows[-1]
    effort = last["effort_mean"]
    return -last["strict_success_rate"], math.inf if effort is None else effort, last["policy"]


def _cells(submission: Submission, rows: Sequence[dict[str, Any]]) -> list[str]:
    last = rows[-1]
    name = policy_label(last["policy"], 40) + (" + filter" if last["safety_filter"] else "")
    rates = []
    for row in rows:
        low, high = row["strict_success_ci95"]
        rates.append(
            f"{percent(row['strict_success_rate'])} ({100.0 * low:.0f}–{100.0 * high:.0f})"
        )
    effort = "–" if last["effort_mean"] is None else number(last["effort_mean"])
    time = number(1e6 * last["step_time_median_s"])
    # As text: a name may hold what Markdown takes for markup.
    name = re.sub(r"([\\`*_{}\[\]()#+!|<>~&-])", r"\\\1", name)
    when = submission.when.isoformat()
    return [name, submission.who, when, *rates, effort, time, f"`{submission.file}`"]
