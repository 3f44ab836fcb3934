"""Walk the four paths of a stranger who has the site and nothing else, and time them.

    python tests/four_paths.py [--install] [NAME ...]

What is typed and run is taken from the pages, in an empty folder for each path. The programs of the
environment come first on the path; what installs is run with `--install` only, in the folder of the
project. Nothing but the standard library is imported here.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

sys.path.append(str(Path(__file__).resolve().parents[1]))

from tests import documents

ROOT = Path(__file__).resolve().parents[1]
# What a stranger has for all four [s].
_PATIENCE = 15 * 60
_INSTALL = "pip install"


class Step(NamedTuple):
    """Something that a page says to do.

    Attributes:
        page: Its path in `docs`.
        wanted: Pattern of a command or a block of Python of that page; every one that has it is
            run, in the order of the page.
        shows: What is then printed, as patterns, or a file that is then there.
    """

    page: str
    wanted: str
    shows: tuple[str, ...] = ()


_COMPARE, _SYSTEM = "tutorial/train-and-compare.md", "your-system.md"
PATHS = {
    "install": (
        Step("index.md", r"^pip install .*\[bench\]"),
        Step("index.md", r"gym\.make\(", (r"True|False",)),
    ),
    "film": (
        Step("tutorial/quickstart.md", r"^lagros watch .*--video cartpole\.gif", ("cartpole.gif",)),
    ),
    "compare": (
        Step(_COMPARE, r"^pip install .*\[bench,rl\]"),
        Step(_COMPARE, r"PPO\(", ("mine.zip",)),
        Step(_COMPARE, r"^lagros bench .*mine\.zip", (r"lagros +\d", r"mine\.zip +\d")),
    ),
    "system": (
        Step(_SYSTEM, r"^lagros new mysystem\.py", ("mysystem.py",)),
        Step(_SYSTEM, r"^lagros check \./mysystem\.py"),
        Step(_SYSTEM, r"^lagros bench \./mysystem\.py", (r"tube-mpc +\d", r"lqr +\d")),
    ),
}


def said(step: Step) -> list[tuple[str, ...]]:
    """Return what a page says for a step: words of commands, and ("python", "-c", block).

    Raises:
        ValueError: It says nothing for it.
    """
    text = (ROOT / "docs" / step.page).read_text(encoding="utf-8")
    # An installation may stand within a sentence.
    inline = "\n\n".join(f"    {line}" for line in re.findall(rf"`({_INSTALL} [^`]+)`", text))
    lines = [*documents.commands(text), *documents.commands(f"\n{inline}\n")]
    typed = [command.words for command in lines if re.search(step.wanted, " ".join(command.words))]
    blocks = [block for block in documents.python_blocks(text) if re.search(step.wanted, block)]
    found = [*dict.fromkeys(typed), *(("python", "-c", block) for block in blocks)]
    if not found:
        raise ValueError(f"docs/{step.page} has no command and no Python with {step.wanted!r}")
    return found


def walk(name: str, folder: Path, install: bool = False) -> None:
    """Walk one path in a folder, telling each step and its time.

    Raises:
        RuntimeError: A step failed, or did not show what it should.
    """
    for step in PATHS[name]:
        for words in said(step):
            installs = " ".join(words).startswith(_INSTALL)
            title = f"Python of {step.page}" if words[1] == "-c" else " ".join(words)
            if installs and not install:
                print(f"          (not now: {title})", flush=True)
                continue
            begun = time.perf_counter()
            place = ROOT if installs else folder
            run = subprocess.run(
                words, cwd=place, stdin=subprocess.DEVNULL, capture_output=True, text=True
            )
            print(f"{time.perf_counter() - begun:7.1f} s {title}", flush=True)
            missing = [
                pattern
                for pattern in step.shows
                if not ((folder / pattern).is_file() or re.search(pattern, run.stdout))
            ]
            if run.returncode or missing:
                raise RuntimeError(
                    f"{title}: status {run.returncode}, without {missing}\n{run.stdout}{run.stderr}"
                )


def main() -> None:
    """Walk the paths that are named, or all."""
    parser = argparse.ArgumentParser(description="The four paths of a stranger.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(PATHS))
    parser.add_argument("--install", action="store_true", help="run what installs, too")
    given = parser.parse_args()
    begun = time.perf_counter()
    for name in given.names or PATHS:
        print(name, flush=True)
        with tempfile.TemporaryDirectory() as folder:
            walk(name, Path(folder), given.install)
    seconds = time.perf_counter() - begun
    print(f"{seconds:.0f} s in all, of the {_PATIENCE} s that a stranger has", flush=True)


if __name__ == "__main__":
    main()
