"""The exported files against NumPy, in one run: python benchmarks/speed/export.py.

Options: --policy NAME --rounds N --json FILE. Prints, for each way to compile, the time of one
call, how many times as fast as `predict` and as the bare network in NumPy that is, and the bytes of
code, weights, data and stack. Everything takes turns on one thread. Times are medians of processor
time, so that other processes on the machine count little; the wall clock stands beside them.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

# The libraries read it when they are loaded.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
HERE = Path(__file__).resolve().parent
sys.path[:] = [str(HERE.parent), *(entry for entry in sys.path if entry != str(HERE))]

import numpy as np  # noqa: E402

from lagros_envs.files import write_atomic  # noqa: E402
from lagros_policies.export import Source, check, exported_names, load_source  # noqa: E402
from lagros_policies.export.c99 import TANHS, c_file  # noqa: E402
from lagros_policies.export.cost import footprint  # noqa: E402
from lagros_policies.export.onnx import onnx_file  # noqa: E402
from lagros_policies.learning.features import seen  # noqa: E402
from lagros_policies.tasks.spacecraft.sensed import Sensed  # noqa: E402
from speed.timing import Candidate, interleave  # noqa: E402

# The first is what runs anywhere. C99 mode keeps products and sums apart; the last fuses them.
BUILDS = (
    ("-std=c99", "-O2"),
    ("-std=c99", "-O3"),
    ("-std=c99", "-O3", "-march=native", "-ffp-contract=fast"),
)
CALLS = 100  # of each candidate in a round, on different observations
# Of the compiled ones so many times as many, so that they take about as long as NumPy: the first
# call of a round finds its weights out of the near caches, and has to count alike for all.
REPEATS = 10


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Time an exported C file against NumPy.")
    parser.add_argument("--policy", default="lagros-cartpole", choices=exported_names())
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    source = load_source(options.policy)
    rows = source.examples(CALLS)
    inputs = features(source, rows)

    def predict(_: int) -> None:
        for row in rows:
            source.policy.predict(row)

    def bare(_: int) -> None:
        for row in inputs:
            source.policy.network(row)

    candidates: dict[str, Candidate] = {"NumPy predict": predict, "NumPy bare network": bare}
    if check.has_onnxruntime():
        model = check.onnx_function(onnx_file(source))
        candidates["ONNX Runtime"] = lambda _: [model(rows[i : i + 1]) for i in range(CALLS)]
    sizes: dict[str, dict[str, int]] = {}
    for kind, text in texts(source).items():
        for flags in BUILDS:
            name = f"C, {kind}{' '.join(flags[1:])}"
            with check.CompiledPolicy(text, source, flags) as compiled:
                found = check.agreement(compiled.answer(rows), source, rows)
                if not found.relative < 1e-5:
                    raise RuntimeError(f"{name} differs from NumPy by {found}")
                candidates[name] = lambda _, policy=compiled: [
                    policy.answer(rows) for _ in range(REPEATS)
                ]
            sizes[name] = asdict(footprint(text, flags))
    times = interleave(candidates, options.rounds)
    calls = {name: CALLS * (REPEATS if name in sizes else 1) for name in times}
    cpu = {name: np.asarray(taken.cpu_seconds) / calls[name] for name, taken in times.items()}
    results: list[dict[str, Any]] = []
    for name, seconds in cpu.items():
        ratios = [float(np.median(cpu[peer] / seconds)) for peer in list(cpu)[:2]]
        figures = {
            "name": name,
            "ns_per_call": float(1e9 * np.median(seconds)),
            "wall_ns_per_call": 1e9 * times[name].median / calls[name],
            "times_as_fast_as_predict": ratios[0],
            "times_as_fast_as_bare": ratios[1],
        }
        results.append(figures | sizes.get(name, {}))
    report(results, options.policy)
    if source.program.bodies:
        sensed = [
            float(np.mean(np.sum(rows[:, source.policy.layout.slices[f"{kind}_mask"]], axis=1)))
            for kind in ("neighbour", "obstacle")
        ]
        print("On average {:.1f} neighbours and {:.1f} obstacles are sensed.".format(*sensed))
    if options.json:
        write_atomic(options.json, json.dumps(results, indent=1) + "\n")


def features(source: Source, rows: Any) -> list[Any]:
    """Return the inputs of the network for each observation."""
    if source.program.bodies:
        layout = source.policy.layout
        return [source.policy.features(Sensed.of(layout, row)) for row in rows]
    return list(seen(source.policy.see, rows)[0])


def texts(source: Source) -> dict[str, str]:
    """Return the C files of a policy, by what tells them apart."""
    if not source.program.tanh:
        return {"": c_file(source)}
    return {f"tanh {tanh}, ": c_file(source, tanh) for tanh in TANHS}  # type: ignore[arg-type]


def report(results: list[dict[str, Any]], policy: str) -> None:
    """Print the table."""
    version = subprocess.run(
        [check.compiler() or "gcc", "--version"], capture_output=True, text=True, check=True
    ).stdout.splitlines()[0]
    print(f"{policy}, one call, one thread; {version}; NumPy {np.__version__}")
    print(f"load {os.getloadavg()[0]:.1f}. Ratios: how many times as fast as NumPy's.\n")
    print(f"{'':<52}{'ns':>7}{'wall':>7}{'predict':>9}{'bare':>7}{'code':>8}{'RAM':>5}{'stack':>7}")
    for row in results:
        memory = f"{row['code']:>8}{row['ram']:>5}{row['stack']:>7}" if "code" in row else ""
        print(
            f"{row['name']:<52}{row['ns_per_call']:>7.0f}{row['wall_ns_per_call']:>7.0f}"
            f"{row['times_as_fast_as_predict']:>9.1f}{row['times_as_fast_as_bare']:>7.1f}{memory}"
        )
    print("\ncode: with the weights, of `size` [B]. RAM: data and bss [B]. stack: at most [B].")


if __name__ == "__main__":
    main()
