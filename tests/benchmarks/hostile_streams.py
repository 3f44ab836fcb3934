"""Runs every command with an output that fails, each in a child process of its own.

Run as a program with a folder, so that the interpreter starts once for all. What is flown is flown
once for all, too: the children only write and print.
"""

from __future__ import annotations

import io
import json
import os
import resource
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

import lagros_benchmarks.__main__ as program
from lagros_benchmarks.commands import cli
from lagros_benchmarks.report import figures
from lagros_benchmarks.report.page import assemble
from lagros_benchmarks.run import demonstrations, files, runner
from lagros_benchmarks.tasks.spacecraft import certify as spacecraft_certify
from lagros_benchmarks.tasks.spacecraft import scene_figure
from lagros_benchmarks.training import course as training_course
from lagros_benchmarks.training import curves
from lagros_benchmarks.worst_case import attack
from tests.benchmarks.tiny_training import TINY

BENCH = "--json b.json --csv b.csv --latex b.tex --markdown b.md --figure b.png --html b.html"
# Each command in a small size, with the files that it writes.
COMMANDS = {
    "bench": (
        f"bench cartpole --policies lqr,random --episodes 1 {BENCH} --episodes-file b.jsonl",
        ("b.json", "b.csv", "b.tex", "b.md", "b.png", "b.html", "b.jsonl"),
    ),
    "spacecraft": (
        "bench spacecraft --policies learned --episodes 1 --agents 1 --bound 0.4 "
        "--safety-filter none --timing-episodes 1 --json s.json --scene s.svg",
        ("s.json", "s.svg"),
    ),
    "demo": ("demo", ("runs/demo/results.json", "runs/demo/error.png")),
    "reproduce": (
        "reproduce cartpole --shipped-weights --episodes 1 --jobs 1 --out r",
        ("r/results.json", "r/table.tex", "r/error.png"),
    ),
    "attack": (
        "attack cartpole --policy lqr --episodes 1 --budget 31 --method random --json a.json "
        "--npz a.npz",
        ("a.json", "a.npz"),
    ),
    "certify": ("certify spacecraft --episodes 0 --seconds 0.1 --json c.json", ("c.json",)),
    "export": ("export lagros-cartpole --format onnx --out x.onnx", ("x.onnx",)),
    "data": (
        "data export --minari --episodes 1 --out d",
        ("d/lagros/cartpole/expert-v0/data/metadata.json",),
    ),
    "watch": (
        "watch cartpole --policy lqr --seconds 0.3 --video w.gif",
        ("w.gif",),
    ),
    "train": (
        "train cartpole --segments 1 --out t --json t.json --figure t.png",
        (
            "t.json",
            "t.png",
            "t/cartpole-ppo/seed-0/record.json",
            "t/cartpole-ppo/seed-0/weights.safetensors",
        ),
    ),
}
CONDITIONS = ("plain", "pipe", "full", "closed", "ascii", "disk")


def once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that works once for each of the commands, and then remembers."""
    found: dict[str, Any] = {}

    @wraps(function)
    def remembered(*arguments: Any, **options: Any) -> Any:
        key = " ".join(sys.argv)
        if key not in found:
            found[key] = function(*arguments, **options)
        return found[key]

    return remembered


def drawn_once(draw: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that draws a figure once for each of the commands, and then copies it."""
    found: dict[str, bytes] = {}

    def remembered(content: Any, path: Path) -> Path:
        key = f"{sys.argv} {path.suffix}"
        if key not in found:
            found[key] = Path(draw(content, path)).read_bytes()
        return files.write_atomic(path, found[key])

    return remembered


def make_small() -> None:
    """Make what no option makes small, and let everything be flown once."""
    cli.DEMO |= {"episodes": 1, "policies": ("lqr",)}
    small = replace(TINY, segments=1)
    training_course.default_training = lambda *_: small
    runner.run_benchmark = once(runner.run_benchmark)
    runner.fly_scene = once(runner.fly_scene)
    attack.run_attack = once(attack.run_attack)
    spacecraft_certify.certify = once(spacecraft_certify.certify)
    demonstrations.demonstrate = once(demonstrations.demonstrate)
    assemble.bench_page = once(assemble.bench_page)
    for module, name in ((figures, "draw"), (curves, "draw"), (scene_figure, "scene_figure")):
        setattr(module, name, drawn_once(getattr(module, name)))


def run_command(arguments: str) -> int:
    """Run a command as the installed program does, and return its exit status."""
    sys.argv = ["lagros", *arguments.split()]
    try:
        program.main()
    except SystemExit as ending:
        return int(ending.code or 0)
    return 99


def set_up(condition: str, out: int, err: int) -> None:
    """Put the standard streams of this process in a condition."""
    os.dup2(err, 2)
    sys.stderr = io.TextIOWrapper(io.FileIO(2, "w", closefd=False), "utf-8", write_through=True)
    if condition == "full":
        # Only ever as an open stream, never as a path.
        out = os.open("/dev/full", os.O_WRONLY)
    elif condition == "pipe":
        reader, out = os.pipe()
        os.close(reader)
    os.dup2(out, 1)
    encoding = "ascii" if condition == "ascii" else "utf-8"
    sys.stdout = io.TextIOWrapper(io.FileIO(1, "w", closefd=False), encoding, "strict")
    if condition == "closed":
        os.close(1)
        sys.stdout = None  # type: ignore[assignment]
    if condition == "disk":
        # No regular file takes a byte, wherever it lies.
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))


def run_child(name: str, condition: str, folder: Path) -> dict[str, Any]:
    """Run a command in a condition, and return its exit status and what it printed."""
    place = folder / condition / name
    (place / "tmp").mkdir(parents=True)
    pipes = [os.pipe(), os.pipe()]
    child = os.fork()
    if child == 0:
        status = 98
        try:
            for reader, _ in pipes:
                os.close(reader)
            os.chdir(place)
            tempfile.tempdir = str(place / "tmp")
            set_up(condition, pipes[0][1], pipes[1][1])
            status = run_command(COMMANDS[name][0])
        finally:
            os._exit(status)
    texts = []
    for _, writer in pipes:
        os.close(writer)
    for reader, _ in pipes:
        with open(reader, encoding="utf-8", errors="replace") as stream:
            texts.append(stream.read())
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return {
        "name": name,
        "condition": condition,
        "status": status,
        "out": texts[0],
        "err": texts[1],
    }


def main(folder: Path) -> None:
    """Run all commands in all conditions, and write what came of each as a line of JSON."""
    make_small()
    report = os.fdopen(os.dup(1), "w")
    for name, (arguments, _) in COMMANDS.items():
        first = folder / "first" / name
        first.mkdir(parents=True)
        os.chdir(first)
        with open(os.devnull, "w") as nowhere:
            sys.stdout, sys.stderr = nowhere, nowhere
            run_command(arguments)
        sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__
        for condition in CONDITIONS:
            report.write(json.dumps(run_child(name, condition, folder)) + "\n")
            report.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
