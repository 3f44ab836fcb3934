"""Speed against peers, side by side in one process: python benchmarks/speed/run.py [--quick].

Prints one table per topic and the targets with what was measured. The whole run takes a few
minutes; start it on an idle machine. The topic `ratios` alone prints how many times as fast as its
peers lagros is, and `learner` the same for random actions and the resets that they bring. casadi is
the only peer that lagros does not need itself (`pip install -e ".[speed]"`, or `make speed`);
onnxruntime and numba take part where they are installed.
"""

from __future__ import annotations

import argparse
import importlib
import os
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parent / "results" / "speed.json"
RATIOS = HERE.parent / "results" / "speed_ratios.json"
LEARNER = HERE.parent / "results" / "speed_learner.json"
TOPICS = ("planner", "sdp", "network", "hold", "environment", "ratios", "learner")
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write the report."""
    options = _parser().parse_args(arguments)
    # The libraries read these when they are loaded, so nothing is imported before.
    for name in _THREADS:
        os.environ[name] = "1"
    # Modules are found as `speed.planner`: this folder itself would offer them as `planner`.
    sys.path[:] = [str(HERE.parent), *(entry for entry in sys.path if entry != str(HERE))]

    from rich.console import Console

    from speed import report, timing

    console = Console(width=report.WIDTH, highlight=False)
    load = os.getloadavg()[0]
    report.print_header(console, load)
    scale = timing.QUICK if options.quick else timing.FULL
    sections: list[report.Section] = []
    begun = time.perf_counter()
    for topic in options.topics or TOPICS:
        for section in importlib.import_module(f"speed.{topic}").sections(scale):
            report.print_section(console, section)
            sections.append(section)
    found = report.surroundings(load)
    report.print_targets(console, sections)
    report.print_versions(console, found)
    console.print(f"Took {time.perf_counter() - begun:.0f} s.", style="dim")
    path = options.json or (None if options.quick else _published(options.topics))
    if path is not None:
        command = shlex.join(["python", "benchmarks/speed/run.py", *(arguments or sys.argv[1:])])
        console.print(f"Wrote {report.write_json(path, sections, found, command)}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__.partition("\n\n")[0],
        epilog=f"A complete run writes {RESULTS.relative_to(HERE.parents[1])}, the topics ratios "
        f"and learner alone {RATIOS.name} and {LEARNER.name} beside it; --quick and other choices "
        "write a file only with --json.",
    )
    # No `choices`: argparse would check the empty list against them.
    parser.add_argument("topics", nargs="*", type=_topic, help=f"some of {', '.join(TOPICS)}")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions: about a minute")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the report as JSON")
    return parser


def _published(topics: Sequence[str]) -> Path | None:
    """Return the file that a complete run of these topics renews."""
    if not topics:
        return RESULTS
    return {("ratios",): RATIOS, ("learner",): LEARNER}.get(tuple(topics))


def _topic(name: str) -> str:
    if name not in TOPICS:
        raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(TOPICS)}")
    return name


if __name__ == "__main__":
    sys.exit(main())
