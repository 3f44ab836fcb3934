"""Design of a metric that can be proved: CV-STEM, proof, and failures fed back, until it holds.

    python -m lagros_policies.tasks.cartpole.proof_design --out FILE

designs and proves the shipped metric again, with the settings that are the defaults of
`ProvedDesignSettings`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from lagros_envs.files import write_atomic
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_policies.contraction.metric import Metric
from lagros_policies.contraction.metric_files import metric_record
from lagros_policies.contraction.regions import Samples, joined
from lagros_policies.proof.condition import Proof
from lagros_policies.proof.families import Violation
from lagros_policies.tasks.cartpole.proof import prove_cartpole
from lagros_policies.tasks.cartpole.proof_program import (
    ProvedDesignSettings,
    corners,
    design_on_points,
)


def design_proved(
    settings: ProvedDesignSettings | None = None, system: CartPole | None = None
) -> tuple[Metric, Proof, Proof]:
    """Design a metric and prove it, feeding failures back.

    Args:
        settings: What to design; the defaults are those of the shipped file.
        system: The cart-pole; the paper's if left out.

    Returns:
        The metric, its proof on the box and that of the differential form and of the hold.

    Raises:
        InfeasibleError: No such metric exists.
        RuntimeError: The last metric could not be proved.
    """
    settings, system = settings or ProvedDesignSettings(), system or CartPole()
    pool = joined(corners(system, settings.box), corners(system, settings.leaning))
    held = corners(system, settings.leaning, angles=13, rates=5)
    for _ in range(settings.rounds):
        metric = design_on_points(system, pool, held, settings)
        proof = prove_cartpole(metric, settings.box, system, most_seconds=settings.most_seconds)
        second = prove_cartpole(
            metric,
            settings.leaning,
            system,
            held_box=settings.leaning,
            period=settings.period,
            most_seconds=settings.most_seconds,
        )
        if all(part.holds for part in (*proof.statements, *second.statements)):
            return metric, proof, second
        found = [proof.contraction.violation, second.contraction.violation]
        over = None if second.held is None else second.held.search.failure
        if not any(found) and over is None:
            # Nothing failed: the proofs ran out of time, and would again.
            break
        for point in found:
            pool = pool if point is None else joined(pool, _around(point))
        if over is not None:
            held = joined(held, _around(over))
    missed = [part.text for part in (*proof.statements, *second.statements) if not part.holds]
    raise RuntimeError(
        f"not proved after at most {settings.rounds} designs: {'; '.join(missed)}. Raise the "
        "margin or most_seconds, or shrink the box"
    )


def _around(point: Violation) -> Samples:
    return Samples(point.state[None], point.nominal[None], point.control[None])


def write_proved(
    metric: Metric,
    proofs: Sequence[Proof],
    settings: ProvedDesignSettings,
    path: Path | str,
) -> None:
    """Write a metric with what was proved and the settings that made it, atomically."""
    record = metric_record(metric)
    record["proved"] = {
        "command": "python -m lagros_policies.tasks.cartpole.proof_design",
        "settings": asdict(settings),
        "statements": [asdict(part) for proof in proofs for part in proof.statements],
    }
    write_atomic(path, json.dumps(record, indent=1) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Design, prove and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="metric to write")
    parser.add_argument(
        "--seconds", type=float, default=60.0, metavar="S", help="limit of each proof; default 60"
    )
    options = parser.parse_args(arguments)
    settings = ProvedDesignSettings(most_seconds=options.seconds)
    metric, *proofs = design_proved(settings)
    write_proved(metric, proofs, settings, options.out)
    for proof in proofs:
        for part in proof.statements:
            sys.stdout.write(f"{part.kind}, {part.seconds:.1f} s: {part.text}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
