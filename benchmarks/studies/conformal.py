"""Do the calibrated bounds cover what they say they cover?

Episodes of one namespace calibrate, fresh ones of another check: the learning error and the tube of
the cart-pole's policies, and the position error of the spacecraft under u*. For each level the
bound, how many fresh episodes it covers, and how far that is from k / (n + 1) in standard errors
of the Beta-binomial law, which has both in it, the luck of the calibration set and that of the
fresh episodes. Beside it the coverage averaged over random splits of all episodes together.

    python benchmarks/studies/conformal.py [--json FILE]

Scores are kept in runs/conformal/ and a call that was interrupted goes on; `--fresh` begins anew.
The files are named by a hash of the task's weights and metrics too: what was flown with a network
of before is not taken for one that was trained again.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from studies.coverage import check_coverage, split_coverage

from lagros_benchmarks.evidence.calibration import (
    EpisodeScores,
    Score,
    pretrained_hash,
    single_scores,
)
from lagros_benchmarks.evidence.calibration import scores_of as calibrated_of
from lagros_benchmarks.run.files import write_json
from lagros_benchmarks.tasks.spacecraft.calibration import POSITION_ERROR, spacecraft_scores
from lagros_benchmarks.worst_case.seeds import CALIBRATION, VERIFICATION
from lagros_envs.files import write_atomic
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction.conformal import conformal_bound, coverage_interval

COMMAND = "python benchmarks/studies/conformal.py"
FOLDER = Path("runs/conformal")
LEVELS = (0.8, 0.9, 0.95)
_SPLITS = 500
SCORES: dict[str, tuple[Score, ...]] = {
    "cartpole": calibrated_of(CartPoleSettings()),
    "spacecraft": (POSITION_ERROR,),
}
# Seed of the random splits alone.
_SPLIT_SEED = 20210226


def cases(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Return what is calibrated."""
    wanted = [
        {"task": "cartpole", "policy": "lagros", "kind": "uniform", "bound": 0.75},
        {"task": "spacecraft", "policy": "centralized", "kind": "uniform", "bound": 0.6},
    ]
    return [case for case in wanted if arguments.task in (None, case["task"])]


def scores_of(
    case: dict[str, Any], namespace: int, count: int, folder: Path
) -> tuple[EpisodeScores, float]:
    """Return the scores of a case from its file, or fly the episodes and write it."""
    key = pretrained_hash(case["task"])
    name = "-".join(str(part) for part in (*case.values(), f"{namespace:x}", count, key))
    path = folder / f"{name}.json"
    if path.is_file():
        record = json.loads(path.read_text())
        values = {key: np.array(entry, float) for key, entry in record["values"].items()}
        return EpisodeScores(values, record["failed"], record["seconds"]), record["seconds"]
    if case["task"] == "cartpole":
        how = (case["policy"], count, namespace, 0, case["kind"], case["bound"])
        found = single_scores(CartPoleSettings(), *how)
    else:
        found = spacecraft_scores(count, namespace, 0, case["kind"], case["bound"])
    # JSON of Python reads and writes Infinity; the file is ours alone.
    record = {
        "values": {key: entry.tolist() for key, entry in found.values.items()},
        "failed": found.failed,
        "seconds": found.seconds,
    }
    write_atomic(path, json.dumps(record))
    return found, found.seconds


def row(
    case: dict[str, Any], score: Score, level: float, old: EpisodeScores, fresh: EpisodeScores
) -> dict[str, Any]:
    """Return the figures of one bound."""
    calibration, verification = old.values[score.name], fresh.values[score.name]
    bound = conformal_bound(calibration, level)
    check = check_coverage(bound, verification)
    low, high = coverage_interval(bound)
    both = np.concatenate([calibration, verification])
    rng = np.random.default_rng(_SPLIT_SEED)
    return {
        **case,
        "score": score.name,
        "unit": score.unit,
        "level": level,
        "bound_value": bound.value,
        "rank": bound.rank,
        "calibration_episodes": bound.count,
        "calibration_failed": old.failed,
        "fresh_episodes": check.episodes,
        "fresh_failed": fresh.failed,
        "fresh_median": float(np.median(verification)),
        "fresh_max": float(verification.max()),
        "expected_coverage": check.expected,
        "coverage": check.share,
        "standard_error": check.standard_error,
        "standard_errors_off": check.deviation,
        "within_two": check.within_two,
        "coverage_given_calibration_95": [low, high],
        "split_coverage": split_coverage(both, len(calibration), level, _SPLITS, rng),
    }


def show(rows: list[dict[str, Any]]) -> None:
    """Print the table."""
    table = Table(title="split conformal bounds, one score per episode")
    for heading in ("task", "policy", "d̄", "score", "level", "bound", "covered", "off", "splits"):
        table.add_column(heading, justify="right")
    for one in rows:
        table.add_row(
            one["task"],
            one["policy"],
            f"{one['bound']:g}",
            one["score"],
            f"{one['level']:g}",
            f"{one['bound_value']:.4g} {one['unit']}",
            f"{100 * one['coverage']:.2f} % of {one['fresh_episodes']}",
            f"{one['standard_errors_off']:+.2f} se",
            f"{100 * one['split_coverage']:.2f} %",
        )
    Console(width=130).print(table)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Check the coverage of the calibrated bounds.")
    parser.add_argument("--task", choices=("cartpole", "spacecraft"))
    parser.add_argument(
        "--calibration", type=int, default=4000, help="episodes; worlds are a tenth"
    )
    parser.add_argument("--fresh-episodes", type=int, default=8000, help="likewise")
    parser.add_argument("--fresh", action="store_true", help="forget the scores kept")
    parser.add_argument("--json", type=Path, default=Path("benchmarks/results/conformal.json"))
    options = parser.parse_args()
    if options.fresh:
        for path in FOLDER.glob("*.json"):
            path.unlink()
    rows = []
    for case in cases(options):
        share = 1 if case["task"] == "cartpole" else 10
        old, _ = scores_of(case, CALIBRATION, options.calibration // share, FOLDER)
        fresh, _ = scores_of(case, VERIFICATION, options.fresh_episodes // share, FOLDER)
        kinds = SCORES[case["task"]]
        rows += [row(case, score, level, old, fresh) for score in kinds for level in LEVELS]
        show(rows)
    write_json(
        options.json,
        {"command": COMMAND + (f" --task {options.task}" if options.task else ""), "rows": rows},
    )


if __name__ == "__main__":
    main()
