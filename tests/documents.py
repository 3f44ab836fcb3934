"""What the pages tell a reader to type and to run. Needs nothing but the standard library."""

from __future__ import annotations

import os
import re
import shlex
import sys
from pathlib import Path
from typing import NamedTuple

# The words that a line to type begins with.
PROGRAMS = (
    "lagros",
    "python",
    "python3",
    "pip",
    "make",
    "source",
    "git",
    "cc",
    "./a.out",
    "pytest",
)
_ASSIGNMENT = re.compile(r"[A-Z][A-Z0-9_]*=\S*")


class Command(NamedTuple):
    """A command of a page.

    Attributes:
        line: Number of its first line, from 1.
        words: As a shell takes it apart, variables in front and a comment behind left out.
    """

    line: int
    words: tuple[str, ...]


def environment() -> dict[str, str]:
    """Return variables with which what the pages say runs the code of this folder."""
    root = Path(__file__).resolve().parents[1]
    modules = [str(root), str(root / "benchmarks"), os.environ.get("PYTHONPATH", "")]
    programs = [str(Path(sys.executable).parent), os.environ["PATH"]]
    return os.environ | {
        "PATH": os.pathsep.join(programs),
        "PYTHONPATH": os.pathsep.join(modules),
        "SDL_VIDEODRIVER": "dummy",
    }


def words(text: str) -> int:
    """Return how many words of two letters or more a page has, without code and tables."""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    lines = [line for line in prose.splitlines() if not line.startswith(("|", "    "))]
    return len(re.findall(r"[^\W\d_]{2,}", "\n".join(lines)))


def python_blocks(text: str) -> list[str]:
    """Return the fenced blocks of Python of a page."""
    return re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def commands(text: str) -> list[Command]:
    """Return the commands of a page, from its fenced and its indented blocks.

    Raises:
        ValueError: A line of such a block is no command: the one before it lacks its backslash.
    """
    found: list[Command] = []
    for block in _blocks(text):
        first = next((line for _, line in block if line.strip()), "")
        if not _is_command(first):
            continue
        lines = iter(block)
        for number, line in lines:
            whole = line
            while whole.rstrip().endswith("\\"):
                whole = whole.rstrip()[:-1] + next(lines, (0, ""))[1]
            if not whole.strip() or whole.lstrip().startswith("#"):
                continue
            if not _is_command(whole):
                raise ValueError(f"line {number} is no command: {whole.strip()!r}")
            words = shlex.split(whole, comments=True)
            while _ASSIGNMENT.fullmatch(words[0]):
                words.pop(0)
            # "a && b" are two.
            while "&&" in words:
                cut = words.index("&&")
                found.append(Command(number, tuple(words[:cut])))
                words = words[cut + 1 :]
            found.append(Command(number, tuple(words)))
    return found


def _is_command(line: str) -> bool:
    words = line.split()
    while words and _ASSIGNMENT.fullmatch(words[0]):
        words.pop(0)
    return bool(words) and words[0].rpartition("/")[2] in PROGRAMS


def _blocks(text: str) -> list[list[tuple[int, str]]]:
    """Return the blocks of code of a page, as numbered lines."""
    blocks: list[list[tuple[int, str]]] = []
    fenced, before = "", "blank"
    for number, line in enumerate(text.splitlines(), start=1):
        if line.lstrip().startswith("```"):
            fenced = "" if fenced else line.strip("` \n") or "text"
            before = "fence"
            blocks.append([])
        elif fenced:
            # A paragraph at a time: a block may go on in another language.
            if not line.strip():
                blocks.append([])
            elif fenced in ("console", "bash", "sh", "shell"):
                blocks[-1].append((number, line))
        elif not line.strip():
            before = "blank"
        elif line.startswith("    ") and before in ("blank", "code"):
            if before != "code":
                blocks.append([])
            blocks[-1].append((number, line))
            before = "code"
        else:
            before = "text"
    return [block for block in blocks if block]
