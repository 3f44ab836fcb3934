"""The run behind the shipped `ppo`.

    python benchmarks/tuning/shipped_ppo.py --seed 0

Ten times as long as that of `lagros train cartpole --algo ppo`, and otherwise the same.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from lagros_benchmarks.tasks.cartpole.course import CartPoleTraining
from lagros_benchmarks.training.course import lesson_of
from lagros_benchmarks.training.run import Place, train

SHIPPED = CartPoleTraining(segments=40, segment_steps=1800, curve_episodes=500, final_episodes=2000)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from the command line.

    Args:
        arguments: The arguments; None for those of the process.
    """
    parser = argparse.ArgumentParser(
        prog="python benchmarks/tuning/shipped_ppo.py",
        description="Train the shipped PPO actor of the cart-pole. Started again after an "
        "interruption, it goes on from the last checkpoint.",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the run (default: 0)")
    parser.add_argument(
        "--out", type=Path, help="folder of the run (default: runs/train/shipped-ppo/seed-SEED)"
    )
    options = parser.parse_args(arguments)
    if options.seed < 0:
        parser.error("--seed must be >= 0")
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(message)s")
    torch.set_num_threads(1)
    run = replace(SHIPPED, seed=options.seed)
    folder = options.out or Path("runs/train/shipped-ppo") / f"seed-{options.seed}"
    command = f"python benchmarks/tuning/shipped_ppo.py --seed {options.seed}"
    train(run, Place(folder), lambda: lesson_of(run), command)


if __name__ == "__main__":
    main()
