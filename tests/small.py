"""Which test runs a command or a snippet of the pages, and what makes it small.

Every command of the site is run as it stands there, with options behind it that make it small, or
by a test that is named here. `test_small.py` counts that none is left over.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Pages all of whose snippets and commands a test of their own runs.
PAGES = {
    "README.md": "tests/benchmarks/test_readme.py",
    "docs/your-system.md": "tests/benchmarks/test_your_system.py",
    **{
        f"docs/tutorial/{name}.md": "tests/test_notebooks.py"
        for name in ("quickstart", "train-and-compare", "certificate", "swarm")
    },
    **{f"docs/tutorial/{name}.md": "tests/test_site.py" for name in ("your-policy", "to-c")},
}
# Commands that are run by something else: what installs or needs a cluster, and whole studies.
ELSEWHERE = {
    r"(make (demo|test)|source .venv/bin/activate)$": ".ci/run",
    r"(\S*/)?pip install|python -m venv": ".ci/wheel",
    r"make speed$|python benchmarks/speed/run.py": "tests/benchmarks/test_speed.py",
    r"python benchmarks/speed/tasks.py": "tests/benchmarks/test_speed.py",
    r"lagros .*--backend (ray|dask)": "tests/benchmarks/test_backends.py",
    r"lagros leaderboard": "tests/benchmarks/test_leaderboard.py",
    r"lagros train \S+ --algo (c3m|missing)": "tests/benchmarks/test_train_c3m.py",
    r"python benchmarks/studies/reproduction_table.py": (
        "tests/benchmarks/test_reproduction_table.py"
    ),
    r"pytest tests/": "tests",
}
# What is put behind the words of a command, in place of what they say of the same option.
_FEW = ("--episodes", "1", "--quiet")
SMALL = {
    "attack": (*_FEW, "--budget", "20"),
    "bench": (*_FEW, "--jobs", "1"),
    "certify": (*_FEW, "--seconds", "5"),
    "data": _FEW,
    "export": (),
    "reproduce": (*_FEW, "--shipped-weights", "--jobs", "1"),
    "suite": (
        *_FEW,
        "--policies",
        "lqr,lqr-plan",
        "--worlds",
        "1",
        "--proved",
        "0",
        "--jobs",
        "1",
        "--fewer",
        "mpc=1",
    ),
    "train": ("--segments", "1", "--seed", "0", "--quiet"),
    "watch": ("--seconds", "0.5"),
    "python benchmarks/speed/costs.py": ("--plans", "1", "--tasks", "docking"),
    "python benchmarks/speed/spacecraft_world.py": ("--sizes", "1x8", "--rounds", "1"),
    "python benchmarks/studies/plan_law.py": ("--episodes", "1"),
    "python benchmarks/studies/swarms.py": ("--cells", "gcbf-free", "--agents", "8"),
    "python benchmarks/studies/swarms_proved.py": ("--cells", "gcbf-free", "--agents", "8"),
    "python benchmarks/studies/plan_tubes.py": (
        "--tasks",
        "car",
        "--plans",
        "1",
        "--searched",
        "1",
    ),
    "python benchmarks/studies/replanning.py": ("--tasks", "car", "--episodes", "1"),
    "python benchmarks/studies/spacecraft_rates.py": ("--worlds", "1", "--rates", "2"),
    "python examples/disturbed_pendulum.py": ("--steps", "2048"),
}
# Of snippets: lengths of training and numbers of episodes.
_SMALLER = (
    (r"\b350_000\b", "64"),
    (r"\bn_steps=90\b", "n_steps=1"),
    (r"\bbatch_size=1440\b", "batch_size=64"),
    (r"\bepisodes=\d+", "episodes=1"),
    (r"\bsegments=\d+", "segments=1"),
)


def runner(page: str, words: tuple[str, ...]) -> str | None:
    """Return the test that runs a command of a page, or None if it is run at small size."""
    typed = " ".join(words)
    named = (test for pattern, test in ELSEWHERE.items() if re.match(pattern, typed))
    return PAGES.get(page) or next(named, None)


def small(words: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return a command at small size, or None if nobody has said how."""
    if words[0] in ("cc", "./a.out"):
        return words
    program, first, *rest = words
    key = first if program == "lagros" else f"{program} {first}"
    if key not in SMALL:
        return None
    more = SMALL[key]
    if "--replay" in rest:
        more = ("--quiet",)
    elif "--from" in rest:  # the file says how much is flown
        more = ("--quiet", "--jobs", "1")
    elif "--episodes 0" in " ".join(rest):
        more = ("--seconds", "5", "--quiet")
    elif "spacecraft" in (first, *rest) and key == "certify":
        more = _FEW
    if program == "python":
        first = str(ROOT / first)
    return (program, first, *given(rest, more))


def given(words: Sequence[str], more: Sequence[str]) -> list[str]:
    """Return words with further options; what they had of the same option is left out."""
    valued = {
        word: not after.startswith("--")
        for word, after in zip(more, [*more[1:], "--"][: len(more)], strict=True)
        if word.startswith("--")
    }
    kept: list[str] = []
    following = iter(words)
    for word in following:
        if word not in valued:
            kept.append(word)
        elif valued[word]:
            next(following, None)
    return [*kept, *more]


def smaller(block: str) -> str:
    """Return a snippet at small size."""
    for pattern, new in _SMALLER:
        block = re.sub(pattern, new, block)
    return block
