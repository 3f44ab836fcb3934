"""The page itself: one file that holds all that it needs, and asks nobody for anything."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files as files_of
from typing import Any

from lagros_benchmarks.report.page import contents
from lagros_benchmarks.report.page.reels import Reel
from lagros_benchmarks.report.page.worthy import Merit, Pick, worthy
from lagros_benchmarks.run.experiment import BenchmarkRun, Row
from lagros_benchmarks.run.files import plain
from lagros_benchmarks.run.library import Toolbox
from lagros_benchmarks.run.room import room_of
from lagros_benchmarks.run.settings import Case
from lagros_benchmarks.run.workers import Progress, gather
from lagros_policies.backends import running

LARGEST = 5_000_000  # of a page [bytes]
_SCRIPTS = ("dom.js", "table.js", "charts.js", "scene.js", "player.js", "main.js")
# A browser would read a tag or the end of the script in them.
_TAGS = str.maketrans({"<": r"\u003c", ">": r"\u003e", "&": r"\u0026"})
_MOST_EACH, _MOST_FLIGHTS = 8, 240  # episodes of a condition, and flights of a page


def page_text(content: Mapping[str, Any]) -> str:
    """Return the page of what `contents` has gathered."""
    assets = files_of("lagros_benchmarks.report.page") / "assets"
    parts = {
        "title": html.escape(str(content["title"])),
        "style": (assets / "page.css").read_text("utf-8"),
        "script": "\n".join((assets / name).read_text("utf-8") for name in _SCRIPTS),
        "data": json_in_script(content),
    }
    template = (assets / "page.html").read_text("utf-8")
    # In one pass: what is inserted is not looked through again.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], template)


def json_in_script(content: Mapping[str, Any]) -> str:
    """Return JSON that can stand in a script of a page, whatever names and texts it holds."""
    text = json.dumps(plain(content), allow_nan=False, separators=(",", ":"))
    return text.translate(_TAGS)


def bench_page(
    run: BenchmarkRun,
    rows: Sequence[Row],
    progress: Progress | None = None,
    toolbox: Toolbox | None = None,
) -> str:
    """Return the page of a run, and fly again for it what is worth watching.

    The same episodes are kept for all policies of a condition, as many as fit in 5 MB.

    Args:
        run: The run.
        rows: Its rows.
        progress: Called after every policy and condition that has flown.
        toolbox: Where policies come from, as in the run.
    """
    content = contents.of_rows(rows, run.settings.description)
    groups: dict[Any, dict[Case, list[Merit]]] = {}
    reels = room_of(run.settings.description).part("reels")
    for case, records in run.episodes.items():
        merits = [reels.merit(record) for record in records]
        groups.setdefault((case.agents, case.condition), {})[case] = merits
    most = max(1, _MOST_FLIGHTS // max(map(len, groups.values())))
    picks = worthy(list(groups.values()), min(most, _MOST_EACH * len(groups)))
    content["episodes"] = _episodes(run, rows, picks, list(groups.values()), progress, toolbox)
    return _fitting(content)


def _episodes(
    run: BenchmarkRun,
    rows: Sequence[Row],
    picks: Sequence[Pick],
    groups: Sequence[Mapping[Case, Any]],
    progress: Progress | None,
    toolbox: Toolbox | None,
) -> list[contents.Content]:
    settings = run.settings
    reels = room_of(settings.description).part("reels")
    units, tools = reels.units(run), toolbox or Toolbox()
    wanted = [
        (case, [pick.episode for pick in picks if pick.group == group])
        for group, cases in enumerate(groups)
        for case in cases
    ]
    items = [
        (case, [units[index] for index in own], [run.episodes[case][index] for index in own])
        for case, own in wanted
        if own
    ]

    def work(item: tuple[Case, list[Any], list[Any]]) -> list[Reel | None]:
        flown: list[Reel | None] = reels.fly(settings, tools, *item)
        return flown

    with running(settings.backend, settings.jobs):
        flown = gather("report", work, items, settings.jobs, progress, settings.backend)
    found = {
        (case, index): reel
        for (case, own), part in zip((one for one in wanted if one[1]), flown, strict=True)
        for index, reel in zip(own, part, strict=True)
    }
    at = {
        case: contents.series_at(rows, case.policy, case.safety_filter)
        for cases in groups
        for case in cases
    }
    episodes = []
    for pick in picks:
        own = {
            at[case]: reel
            for case in groups[pick.group]
            if (reel := found[case, pick.episode]) is not None
        }
        if own:
            seed = next(run.episodes[case][pick.episode].seed for case in groups[pick.group])
            why = [(at[case], reason) for case, reason in pick.why]
            episodes.append(contents.episode(pick.group, pick.episode, seed, why, own))
    return episodes


def _fitting(content: contents.Content) -> str:
    """Return the page with as many of its episodes, the first first, as its size allows."""
    episodes = content["episodes"]
    sizes = [len(json_in_script(one)) + 1 for one in episodes]
    room = LARGEST - len(page_text({**content, "episodes": []}).encode())
    kept = 0
    while kept < len(sizes) and sum(sizes[: kept + 1]) <= room:
        kept += 1
    return page_text({**content, "episodes": episodes[:kept]})
