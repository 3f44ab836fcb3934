"""Write what the code says of each system into its page: spaces, limits, ends, defaults.

    python docs/spec.py             # say which pages are not as the code is; status 1 if any is not
    python docs/spec.py --update    # and write them

Each page docs/systems/NAME.md has the marks `<!-- spec -->` and `<!-- end -->`; what stands between
them is ours.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lagros_envs.registry import find_task
from lagros_envs.task import Task
from lagros_envs.tasks import SHIPPED
from lagros_envs.tasks.spacecraft.scenarios import PRESETS
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings, settings_for

PAGES = Path(__file__).parent / "systems"
RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"
BEGIN, END = "<!-- spec -->\n", "<!-- end -->"


def specification(task: Task | SpacecraftSettings) -> str:
    """Return the block of a task."""
    if isinstance(task, Task):
        lines = [*_facts(task), "", *_coordinates(task), *_flown(task)]
    else:
        lines = [*_facts_of_many(task), "", *_presets(task)]
    return "\n".join(["", *lines, ""]) + "\n"


def _facts(task: Task) -> Iterator[str]:
    yield "| | |"
    yield "|---|---|"
    yield f'| make | `gym.make("{task.env_id}")`, `lagros bench {task.name}` |'
    yield f"| state, control | {task.system.state_dim}, {task.system.control_dim} |"
    yield (
        f"| observation | {task.layout.size} numbers: x, the goal, x(0), the time [s]"
        + (
            f", and centre and radius of up to {task.most_discs} discs |"
            if task.most_discs
            else " |"
        )
    )
    yield f"| action | `Box(-1, 1, ({task.system.control_dim},), float32)`, scaled as below |"
    yield f"| control period, time limit | {task.control_period:g} s, {task.time_limit:g} s |"
    yield f"| terminated | {_ends(task)}; arriving ends nothing |"
    radius = float(task.success_radius(task.time_limit))
    yield f"| success | within {radius:.3g} of the goal, and neither fallen nor in touch |"
    bounds = ", ".join(f"{bound:g}" for bound in task.defaults.bounds)
    yield f"| disturbance | ‖d‖ ≤ d̄ = {bounds} by default, in all states or in the rates alone |"
    yield (
        f"| reward, per step of dt | −{task.effort_weight:.3g} ‖u − u_0‖² dt, "
        f"−{task.distance_weight:g} · distance dt, +{task.alive_bonus:g} dt while it goes on, "
        f"+{task.success_bonus:g} at the first success |"
    )
    if task.presets:
        yield f"| presets | {', '.join(f'`{name}`' for name in task.presets)} |"


def _ends(task: Task) -> str:
    """Return when an episode is terminated, in the words of the task's own docstring."""
    ends = []
    said = re.match(r"Return by how much (.+?)(?: \[|[,:]|\.$)", type(task).excess.__doc__ or "")
    if type(task).excess is not Task.excess and said:
        ends.append(f"when {said[1]}")
    if task.most_discs:
        ends.append("when a disc is touched")
    return ", or ".join(ends) or "never before the time limit"


def _coordinates(task: Task) -> Iterator[str]:
    yield "| state | plans keep it within |"
    yield "|---|---|"
    names = task.state_names or tuple(f"x{k}" for k in range(task.system.state_dim))
    low = task.state_low or (-math.inf,) * len(names)
    high = task.state_high or (math.inf,) * len(names)
    for name, least, most in zip(names, low, high, strict=True):
        yield f"| {name} | {_interval(least, most)} |"
    yield ""
    yield "| control | action 0 | action ±1 adds | applied within |"
    yield "|---|---:|---:|---|"
    controls = task.control_names or tuple(f"u{k}" for k in range(task.system.control_dim))
    rows = zip(
        controls,
        task.control_centre,
        task.control_scale,
        task.control_low,
        task.control_high,
        strict=True,
    )
    for name, centre, scale, least, most in rows:
        yield f"| {name} | {centre:.4g} | {scale:.4g} | {_interval(least, most)} |"


def _facts_of_many(task: SpacecraftSettings) -> Iterator[str]:
    defaults = task.defaults
    preset = PRESETS[str(defaults.preset)]
    layout = Layout.for_preset(preset, task)
    yield "| | |"
    yield "|---|---|"
    yield (
        f'| make | `{task.name}_v0.parallel_env()` (PettingZoo), `gym.make("{task.env_id}")` for '
        f"one agent, `lagros bench {task.name}` |"
    )
    yield f"| agents | 1 to {task.most_agents}, {preset.agents} by default |"
    yield f"| state, control of each | {task.system.state_dim}, {task.system.control_dim} |"
    size = sum(math.prod(shape) for shape in layout.shapes.values())
    parts = ", ".join(
        f"{name} {' × '.join(map(str, shape))}" for name, shape in layout.shapes.items()
    )
    yield f"| observation of each, preset {defaults.preset} | {size} numbers: {parts} |"
    yield f"| senses | what is within {task.sensing_radius:g} m |"
    most = "unlimited" if task.thrust_limit is None else f"at most {task.thrust_limit:g} N"
    yield f"| action of each | 8 thrusts ≥ 0 in units of {task.thrust_scale:g} N, {most} |"
    yield f"| control period, time limit | {task.control_period:g} s, {task.time_limit:g} s |"
    yield (
        f"| success | within {task.goal_radius:g} m of the goal at a control instant, before any "
        "collision |"
    )
    bounds = ", ".join(f"{bound:g}" for bound in defaults.bounds)
    yield (
        f"| disturbance | ‖d‖ ≤ d̄ = {bounds} by default, of each agent, in all states or in the "
        "rates alone |"
    )
    yield (
        f"| reward of each | +{task.progress_weight:g} per metre nearer, "
        f"−{task.effort_weight:g} ∫‖u‖² dt, +{task.success_bonus:g} at the first success, "
        f"−{task.collision_penalty:g} at the first collision |"
    )


def _presets(task: SpacecraftSettings) -> Iterator[str]:
    yield (
        "| preset | agents n | arena [m] | obstacles | radius [m]: obstacle, agent, to obstacles "
        "| T, time limit [s] | other |"
    )
    yield "|---|---:|---:|---:|---:|---:|---|"
    for name in task.presets:
        preset = PRESETS[name]
        own = settings_for(preset)
        grown = f" · n/{preset.agents}" if preset.grows else ""
        arena = f"{preset.arena:g}" + (f" · √(n/{preset.agents})" if preset.grows else "")
        if preset.layout == "antipodal":
            arena = "a circle, each goal opposite"
        fewest, most = preset.obstacle_count
        count = f"{fewest} to {most}" if fewest < most else f"{most}"
        if most:
            count = f"({count}){grown}" if grown else count
        times = f"{own.horizon:g}, {own.time_limit:g}"
        if preset.slows:
            times = f"({times}) · √(n/{preset.agents})"
        given = dict(preset.task)
        other = [f"{key} {given[key]:g}" for key in given if key not in ("horizon", "time_limit")]
        radius = f"{preset.obstacle_radius:.3g}"
        if preset.rectangle_sides is not None and preset.obstacle_count[1]:
            least, most = (side / math.sqrt(math.pi) for side in preset.rectangle_sides)
            radius = f"{least:.2f} to {most:.2f}"
        yield (
            f"| `{name}` | {preset.agents} | {arena} | {count} | "
            f"{radius}, {preset.agent_radius:g}, {preset.core:g} | {times} | "
            f"{', '.join(other) or '–'} |"
        )


def _flown(task: Task) -> Iterator[str]:
    """Yield the published table of the task."""
    path = RESULTS / f"{task.name}.json"
    if not path.is_file():
        return
    rows = json.loads(path.read_text(encoding="utf-8"))
    kinds = list(dict.fromkeys(row["disturbance"] for row in rows))
    count, bound = rows[0]["episodes"], rows[0]["bound"]
    yield ""
    yield (
        f"Success of {count} paired episodes at d̄ = {bound:g} [%], strict success in brackets; "
        f"effort under {kinds[0]}:"
    )
    yield ""
    yield f"| policy | {' | '.join(kinds)} | effort | Δt [µs] |"
    yield f"|---|{'---:|' * (len(kinds) + 2)}"
    for policy in dict.fromkeys(row["policy"] for row in rows):
        of = {row["disturbance"]: row for row in rows if row["policy"] == policy}
        cells = [
            f"{100 * of[kind]['success_rate']:.1f} ({100 * of[kind]['strict_success_rate']:.1f})"
            for kind in kinds
        ]
        first = of[kinds[0]]
        cells += [f"{first['effort_mean']:.3g}", f"{1e6 * first['step_time_median_s']:.0f}"]
        yield f"| {policy} | {' | '.join(cells)} |"
    yield ""
    command = (
        " ".join(rows[0]["command"]) if isinstance(rows[0]["command"], list) else rows[0]["command"]
    )
    yield f"    {command}"


def _interval(low: float, high: float) -> str:
    if math.isinf(low) and math.isinf(high):
        return "any"
    return f"[{low:.4g}, {high:.4g}]"


def updated(text: str, block: str) -> str:
    """Return a page with the block between its marks.

    Raises:
        ValueError: A mark is missing.
    """
    if BEGIN not in text or END not in text.partition(BEGIN)[2]:
        raise ValueError(f"the marks {BEGIN.strip()} and {END} are missing")
    before, _, rest = text.partition(BEGIN)
    return before + BEGIN + block + END + rest.partition(END)[2]


def _blocks() -> Iterator[tuple[Path, str]]:
    """Yield each page and what is to stand between its marks."""
    tasks = {name: find_task(name) for name in SHIPPED}
    # A preset of a task stands on the page of the task.
    presets = {f"{name}-{preset}" for name, task in tasks.items() for preset in task.presets}
    tasks = {name: task for name, task in tasks.items() if name not in presets}
    for name, task in tasks.items():
        if isinstance(task, Task | SpacecraftSettings):
            yield PAGES / f"{name}.md", specification(task)
    yield PAGES / "index.md", "\n".join(["", *_overview(tasks), ""]) + "\n"


def _overview(tasks: Mapping[str, Any]) -> Iterator[str]:
    yield "| environment | state, control | limit [s] | discs | d̄ | constant push: (b), (c) [%] |"
    yield "|---|---:|---:|---:|---:|---:|"
    for name, task in tasks.items():
        page = (PAGES / f"{name}.md").read_text(encoding="utf-8")
        title = page.partition("\n")[0].removeprefix("# ").partition(",")[0]
        if isinstance(task, Task):
            sizes = f"{task.system.state_dim}, {task.system.control_dim}"
            bound = f"{task.defaults.bound or task.defaults.bounds[0]:g}"
            facts = (sizes, f"{task.time_limit:g}", f"{task.most_discs or '–'}", bound)
            yield f"| [{title}]({name}.md) | {' | '.join(facts)} | {_pushed(name)} |"
        else:
            yield f"| [{title}]({name}.md) | 6, 8 each | {task.time_limit:g} | obstacles | – | – |"


def _pushed(name: str) -> str:
    """Return the strict success of (b) and (c) under a constant push, as published."""
    path = RESULTS / f"{name}.json"
    grid = RESULTS / f"{name}_grid.json"
    path = path if path.is_file() else grid
    rows = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    most = max((row["bound"] for row in rows), default=0.0)
    of = {
        row["policy"]: 100 * row["strict_success_rate"]
        for row in rows
        if row["disturbance"] == "constant" and row["bound"] == most
    }
    found = [f"{of[policy]:.1f}" for policy in ("tube-mpc", "lagros") if policy in of]
    return ", ".join(found) or "–"


def main(arguments: Sequence[str] | None = None) -> str | None:
    """Compare or write the pages; return what is wrong."""
    parser = argparse.ArgumentParser(description="What the code says of each system.")
    parser.add_argument("--update", action="store_true", help="write the pages")
    update = parser.parse_args(arguments).update
    stale = []
    for page, block in _blocks():
        text = page.read_text(encoding="utf-8")
        wanted = updated(text, block)
        if wanted != text:
            stale.append(page.stem)
            if update:
                page.write_text(wanted, encoding="utf-8")
    if stale and not update:
        return f"not as the code is: {', '.join(stale)}; run: python docs/spec.py --update"
    return None


if __name__ == "__main__":
    sys.exit(main())
