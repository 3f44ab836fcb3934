"""Which contraction rate, and which law: success against effort of the spacecraft's policies.

Flies (d) and (b) with each law and rate on worlds of a namespace of their own, preset `paper`, six
agents, uniform disturbance. Effort is counted to success and over the same time, to the time limit.
Of (d) with a gain, the share of worlds that are proved is counted too: free of collisions, and with
every agent arriving. (c) has no rate; it is flown as it ships, with and without its filter.

    python benchmarks/studies/spacecraft_rates.py [--worlds 20] [--bound 0.2,0.6,1.0]
        [--rates 0.5,0.7,1,1.5,2,3,4] [--policies centralized,tube-mpc,lagros] [--json FILE]
        [--markdown FILE] [--figure FILE]

Rows that the file of `--json` has of the same worlds are kept and not flown again. The table is of
all of them, the figure of those at the bounds that are asked for.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from lagros_benchmarks.report.canvas import canvas, styles
from lagros_benchmarks.report.formats import markdown_table
from lagros_benchmarks.tasks.spacecraft.claims import tracked_with_a_gain
from lagros_benchmarks.tasks.spacecraft.episodes import WorldsLoop, fly, make_filter, make_worlds
from lagros_envs.files import write_atomic
from lagros_envs.seeding import episode_seeds
from lagros_policies.policy import make
from lagros_policies.tasks.spacecraft.guarantee import guarantee

AGENTS, PRESET = 6, "paper"
TUNING = 0x74756E65  # "tune": namespace of the worlds of this study
_WORLDS = 20  # in one batch
_LAWS = {"centralized": ("gain", "least-norm"), "tube-mpc": ("gain", "least-norm")}


def variants(policies: list[str], rates: list[float]) -> Iterator[tuple[str, dict[str, Any], bool]]:
    """Yield names, settings and whether the safety filter is worn."""
    for name in policies:
        if name == "lagros":
            yield name, {}, False
            yield name, {}, True
        for law in _LAWS.get(name, ()):
            for rate in rates:
                yield name, {"law": law, "contraction_rate": rate}, False
        if name == "centralized":
            for law in ("ellipsoid", "lqr"):
                yield name, {"law": law}, False


def study(name: str, given: dict[str, Any], filtered: bool, bound: float, worlds: int) -> Any:
    """Fly a variant under a bound and return its row."""
    policy: Any = make(name, _env(1, bound), **given)
    proved = tracked_with_a_gain(policy)
    margin = policy.tracking.margin(bound) if proved else None
    if filtered:
        policy = make_filter(policy, _env(1, bound), bound)
    seeds = episode_seeds(0, worlds, TUNING)
    agents, found = [], []
    for at in range(0, worlds, _WORLDS):
        some = [int(seed) for seed in seeds[at : at + _WORLDS]]
        loop = WorldsLoop(_env(len(some), bound), policy)
        flight = fly(loop, some)
        agents += [agent for world in flight.worlds for agent in world.agents]
        if proved:
            found += [
                guarantee(
                    loop.env.scenarios[world],
                    loop.env.settings,
                    policy.tracking,
                    one.nominal,
                    one.accelerations,
                    bound,
                )
                for world, one in enumerate(loop.memory)
                if one.solved
            ]

    def mean(field: str) -> float:
        return float(np.mean([getattr(agent, field) for agent in agents]))

    return {
        "policy": name,
        **given,
        "safety_filter": filtered,
        "bound": bound,
        "worlds": worlds,
        "success_rate": mean("success"),
        "strict_success_rate": mean("strict_success"),
        "collision_rate": mean("collided"),
        "effort_mean": mean("effort"),
        "effort_total_mean": mean("effort_total"),
        "certified_error_m": margin,
        "proved_collision_free": sum(one.collision_free for one in found) / worlds
        if proved
        else None,
        "proved_arriving": sum(one.arriving for one in found) / worlds if proved else None,
    }


def _env(worlds: int, bound: float) -> Any:
    return make_worlds(worlds, AGENTS, PRESET, "uniform", bound)


def markdown(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a table."""
    heads = [
        *("policy", "law", "α [1/s]", "d̄", "success [%]", "strict [%]"),
        *("effort", "to 45 s", "proved error [m]", "collision-free / arriving [%]"),
    ]
    lines = []
    for row in rows:
        free = row["proved_collision_free"]
        lines.append(
            [
                row["policy"] + (" + filter" if row["safety_filter"] else ""),
                row.get("law", "–"),
                f"{row['contraction_rate']:g}" if "contraction_rate" in row else "–",
                f"{row['bound']:g}",
                f"{100 * row['success_rate']:.1f}",
                f"{100 * row['strict_success_rate']:.1f}",
                f"{row['effort_mean']:.3f}",
                f"{row['effort_total_mean']:.3f}",
                "–" if free is None else f"{row['certified_error_m']:.3f}",
                "–" if free is None else f"{100 * free:.0f} / {100 * row['proved_arriving']:.0f}",
            ]
        )
    return markdown_table(heads, lines)


def series(row: dict[str, Any]) -> tuple[str, bool]:
    """Return the name of the policy that a row flies, and whether it flies behind the filter."""
    law = row.get("law", "gain")
    if law == "lqr":
        return "lqr-plan", row["safety_filter"]
    return row["policy"] + ("" if law == "gain" else f":{law}"), row["safety_filter"]


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw strict success against the effort over the same time, a line for each law."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    bounds = sorted({row["bound"] for row in rows})
    lines = sorted({series(row) for row in rows})
    look = styles([name for name, _ in lines])
    figure, panels = canvas(
        4.6 * len(bounds), 4.0, columns=len(bounds), share="all", abscissa=False
    )
    for axes, bound in zip(panels, bounds, strict=True):
        for name, filtered in lines:
            line = [
                row for row in rows if series(row) == (name, filtered) and row["bound"] == bound
            ]
            line.sort(key=lambda row: row.get("contraction_rate", 0.0))
            points = [(row["effort_total_mean"], 100 * row["strict_success_rate"]) for row in line]
            style = look[name]
            axes.plot(
                [effort for effort, _ in points],
                [success for _, success in points],
                color=style.colour,
                linestyle=style.line,
                marker=style.marker,
                markerfacecolor="white" if filtered else style.colour,
                label=name + (" with the filter" if filtered else ""),
            )
            for point, row in zip(points, line, strict=True):
                if "contraction_rate" in row:
                    axes.annotate(
                        f"{row['contraction_rate']:g}",
                        point,
                        (0, -11),
                        textcoords="offset points",
                        ha="center",
                        fontsize=7,
                        color=style.colour,
                    )
        axes.set(title=f"d̄ = {bound:g}", xlabel="effort ∫‖u‖² dt to 45 s [N²s]", xscale="log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    panels[0].margins(y=0.12)
    panels[0].set_ylabel("strict success [%]")
    panels[0].legend(fontsize=7, loc="lower right", title="numbers: α [1/s]", title_fontsize=7)
    figure.savefig(path)


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    """Return which row of the table it is."""
    names = ("policy", "law", "contraction_rate", "safety_filter", "bound")
    return tuple(row.get(name) for name in names)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Success against effort, by law and rate.")
    parser.add_argument("--worlds", type=int, default=20)
    parser.add_argument("--bound", default="0.2,0.6,1.0", help="disturbance bounds, by commas")
    parser.add_argument("--rates", default="0.5,0.7,1,1.5,2,3,4", help="alpha [1/s], by commas")
    parser.add_argument("--policies", default="centralized,tube-mpc,lagros")
    for name in ("--json", "--markdown", "--figure"):
        parser.add_argument(name, type=Path)
    options = parser.parse_args()
    rates = [float(part) for part in options.rates.split(",")]
    rows: list[dict[str, Any]] = []
    if options.json is not None and options.json.is_file():
        rows = json.loads(options.json.read_text(encoding="utf-8"))
        rows = [row for row in rows if row["worlds"] == options.worlds]
    flown = [_key(row) for row in rows]
    console = Console()
    bounds = [float(part) for part in options.bound.split(",")]
    for bound in bounds:
        for variant in variants(options.policies.split(","), rates):
            name, given, filtered = variant
            if _key({"policy": name, **given, "safety_filter": filtered, "bound": bound}) in flown:
                continue
            rows.append(study(*variant, bound, options.worlds))
            console.print(markdown(rows[-1:]).splitlines()[-1], soft_wrap=True)
            if options.json is not None:
                write_atomic(options.json, json.dumps(rows, indent=1) + "\n")
    if options.markdown is not None:
        write_atomic(options.markdown, markdown(rows) + "\n")
    if options.figure is not None:
        draw([row for row in rows if row["bound"] in bounds], options.figure)


if __name__ == "__main__":
    main()
