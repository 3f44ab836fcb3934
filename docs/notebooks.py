"""Make the notebooks of the pages of the tutorial: one source, two ways to read it.

    python docs/notebooks.py             # which are not as their page is; status 1 if any is not
    python docs/notebooks.py --update    # and write them

Blocks of Python become cells, commands become cells that begin with `!`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "notebooks"
PAGES = {
    "quickstart": "tutorial/quickstart.md",
    "train-and-compare": "tutorial/train-and-compare.md",
    "your-system": "your-system.md",
    "certificate": "tutorial/certificate.md",
    "swarm": "tutorial/swarm.md",
}
_PIECES = re.compile(
    r"^```(?P<kind>\w+)\n(?P<fenced>.*?)^```\n|(?P<indented>(?:^    \S[^\n]*\n)+)",
    re.MULTILINE | re.DOTALL,
)
# "Write `mine.py`:" before a block of Python.
_WRITTEN = re.compile(r"[Ww]rite\s+`(\w+\.py)`:$")
# What only makes the environment that the notebook already runs in.
_INSTALLS = ("make", "pip", "source")


def notebook(name: str) -> str:
    """Return the text of a notebook."""
    page = PAGES[name]
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    cells = [*_install(name), *_cells(text, Path(page))]
    for number, cell in enumerate(cells):
        cell["id"] = hashlib.sha256(f"{name} {number}".encode()).hexdigest()[:8]
    found = {
        "cells": cells,
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(found, indent=1, ensure_ascii=False) + "\n"


def _install(name: str) -> Iterator[dict[str, Any]]:
    """Yield the first cells: how a stranger comes by the package."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    address = project["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]
    if not address:
        yield _markdown(
            'Needs `pip install -c constraints.txt ".[bench,rl]"` in the folder of the project.\n'
        )
        return
    path = f"{address.removeprefix('https://github.com/')}/blob/main/notebooks/{name}.ipynb"
    colab = "https://colab.research.google.com"
    yield _markdown(f"[![Open in Colab]({colab}/assets/colab-badge.svg)]({colab}/github/{path})\n")
    yield _code(f'%pip install "lagros[bench,rl] @ git+{address}"')


def _cells(text: str, page: Path) -> Iterator[dict[str, Any]]:
    end = 0
    for piece in _PIECES.finditer(text):
        if before := text[end : piece.start()].strip():
            yield _markdown(_linked(before, page))
        end = piece.end()
        written = _WRITTEN.search(before)
        yield from _piece(piece, page, f"%%writefile {written[1]}\n" if written else "")
    if rest := text[end:].strip():
        yield _markdown(_linked(rest, page))


def _piece(piece: re.Match[str], page: Path, magic: str) -> Iterator[dict[str, Any]]:
    if piece["kind"] == "python":
        yield _code(magic + piece["fenced"].rstrip())
    elif piece["indented"] or piece["kind"] == "console":
        block = piece["indented"] or piece["fenced"]
        lines = [line.strip() for line in block.splitlines() if line.strip()]
        runs = [line for line in lines if line.split()[0] not in _INSTALLS]
        if runs:
            yield _code("\n".join(f"!{line}" for line in runs))
        else:
            yield _markdown(piece[0].rstrip())
    else:
        yield _markdown(_linked(piece[0].rstrip(), page))


def _linked(text: str, page: Path) -> str:
    """Return a text whose links begin at the notebooks' folder."""

    def moved(link: re.Match[str]) -> str:
        return link[0] if "://" in link[1] else f"](../docs/{(page.parent / link[1]).as_posix()})"

    return re.sub(r"\]\(([^)]+)\)", moved, text)


def _markdown(text: str) -> dict[str, Any]:
    return {"cell_type": "markdown", "metadata": {}, "source": text.splitlines(keepends=True)}


def _code(text: str) -> dict[str, Any]:
    return {
        "cell_type": "code",
        "execution_count": None,
        "metadata": {},
        "outputs": [],
        "source": text.splitlines(keepends=True),
    }


def main(arguments: Sequence[str] | None = None) -> str | None:
    """Compare or write the notebooks; return what is wrong."""
    parser = argparse.ArgumentParser(description="Notebooks of the tutorial.")
    parser.add_argument("--update", action="store_true", help="write the notebooks")
    update = parser.parse_args(arguments).update
    stale = []
    for name in PAGES:
        path, wanted = FOLDER / f"{name}.ipynb", notebook(name)
        if not path.is_file() or path.read_text(encoding="utf-8") != wanted:
            stale.append(name)
            if update:
                FOLDER.mkdir(exist_ok=True)
                path.write_text(wanted, encoding="utf-8")
    if stale and not update:
        return f"not as the page is: {', '.join(stale)}; run: python docs/notebooks.py --update"
    return None


if __name__ == "__main__":
    sys.exit(main())
