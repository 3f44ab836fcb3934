"""What a network among discs costs by its widths: random weights, one call in C and in NumPy.

    OMP_NUM_THREADS=1 python benchmarks/studies/disc_networks.py [--task pvtol]
        [--hidden 64,64,128,128 48,32,64,64]

The first two widths are those of the layers of each disc, and of the rest. Processor time; plain
-O2; the least of a few medians, since other processes empty the caches. What such networks learn is
in `export.md`.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
from pathlib import Path

import numpy as np

from lagros_envs.registry import find_task
from lagros_envs.task import Task
from lagros_policies.export import load_source
from lagros_policies.export.c99 import c_file
from lagros_policies.export.cost import c_time
from lagros_policies.learning.features import view_of
from lagros_policies.learning.networks import Mlp

_HIDDEN = (
    "64,64,128,128",
    "48,48,64,64",
    "48,32,96,64",
    "48,32,64,64",
    "40,32,64,64",
    "32,32,96,64",
    "32,32,64,64",
)
_TURNS = 5  # medians


def random_network(task: Task, hidden: tuple[int, ...]) -> Mlp:
    """Return a network of these widths for what a task shows, its weights drawn at random."""
    view, rng = view_of(task), np.random.default_rng(0)
    alike = view.alike
    assert alike is not None
    (first, second, *others), rest = hidden, len(view.names) - alike.things * alike.size
    shapes = [(rest + alike.size, first), (rest, first), (first, second), (first, second)]
    shapes += itertools.pairwise([2 * second, *others, task.system.control_dim])
    weights = [rng.standard_normal(shape) / np.sqrt(shape[0]) for shape in shapes]
    return Mlp(weights, [rng.standard_normal(shape[1]) for shape in shapes], alike=alike)


def main() -> None:
    """Print a line for each network."""
    parser = argparse.ArgumentParser(description="Cost of networks among discs by their widths.")
    parser.add_argument("--task", default="pvtol")
    parser.add_argument("--hidden", nargs="+", default=_HIDDEN)
    wanted = parser.parse_args()
    task = find_task(wanted.task)
    assert isinstance(task, Task)
    for text in wanted.hidden:
        network = random_network(task, tuple(map(int, text.split(","))))
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "random.safetensors"
            network.save(file)
            source = load_source(f"lagros-{task.name}", file)
        code = c_file(source)
        c, numpy = np.min([c_time(code, source) for _ in range(_TURNS)], axis=0)
        count = sum(weight.size + bias.size for weight, bias in network.stored)
        sys.stdout.write(
            f"{text:<16} {count:>6} weights   C {1e6 * c:5.2f} us   predict {1e6 * numpy:5.1f} us\n"
        )
        sys.stdout.flush()


if __name__ == "__main__":
    main()
