"""Make the notebooks of the pages of the tutorial: one source, two ways to read it.

    python docs/notebooks.py             # which are not as their page is; status 1 if any is not
    python docs/notebooks.py --update    # and write them
    python docs/notebooks.py --run       # run them, each in an empty folder; needs lagros[docs]

Blocks of Python become cells, commands become cells that begin with `!`. What needs a file of the
project beside the notebook stays text.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
import tempfile
import time
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
# Where the pages' files of the project lie, which a notebook does not have.
_PROJECT = "examples/"
# What opens notebooks of this host, and of no other.
_HOST = "https://github.com/"
_COLAB, _BINDER = "https://colab.research.google.com", "https://mybinder.org"
# What a notebook may take on two cores [s].
_PATIENCE = 600


def notebook(name: str) -> str:
    """Return the text of a notebook."""
    page = PAGES[name]
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    address = project["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]
    cells = [*_install(name, address), *_cells(text, Path(page))]
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


def _install(name: str, address: str) -> Iterator[dict[str, Any]]:
    """Yield the first cells: how a stranger comes by the package, from where it is published."""
    if not address:
        yield _markdown(
            'Needs `pip install -c constraints.txt ".[bench,rl]"` in the folder of the project.\n'
        )
        return
    install = f'%pip install -q "lagros[bench,rl] @ git+{address}"'
    project = address.removeprefix(_HOST)
    if project == address:
        yield _markdown(f"Needs `{install.removeprefix('%')}`.\n")
        return
    path = f"notebooks/{name}.ipynb"
    colab = f"{_COLAB}/github/{project}/blob/main/{path}"
    binder = f"{_BINDER}/v2/gh/{project}/main?labpath={path}"
    yield _markdown(
        f"[![Open in Colab]({_COLAB}/assets/colab-badge.svg)]({colab})\n"
        f"[![Open in Binder]({_BINDER}/badge_logo.svg)]({binder})\n"
    )
    yield _code(install)


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
        runs = [line for line in lines if line.split()[0] not in _INSTALLS and _PROJECT not in line]
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


def run(name: str, folder: Path) -> Iterator[tuple[float, str]]:
    """Run a notebook in a folder; yield the seconds and the first line of every cell of code.

    Raises:
        nbclient.exceptions.CellExecutionError: A cell raised, or one of its commands failed.
        nbclient.exceptions.CellTimeoutError: A cell took longer than a whole notebook may.
    """
    import nbformat
    from nbclient import NotebookClient

    book = nbformat.reads(notebook(name), as_version=4)
    client = NotebookClient(book, timeout=_PATIENCE, resources={"metadata": {"path": str(folder)}})
    with client.setup_kernel():
        for number, cell in enumerate(book.cells):
            if cell.cell_type != "code" or cell.source.startswith("%pip"):
                continue
            title = cell.source.partition("\n")[0]
            # A command that fails raises nothing by itself.
            cell.source = re.sub(r"^!.*$", r"\g<0>\nassert not _exit_code", cell.source, flags=re.M)
            begun = time.perf_counter()
            client.execute_cell(cell, number)
            yield time.perf_counter() - begun, title


def _run_all(names: Sequence[str]) -> None:
    for name in names:
        print(name, flush=True)
        begun = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            for seconds, title in run(name, Path(folder)):
                print(f"{seconds:7.1f} s {title}", flush=True)
        print(f"{time.perf_counter() - begun:7.1f} s in all, of {_PATIENCE} s", flush=True)


def main(arguments: Sequence[str] | None = None) -> str | None:
    """Compare, write or run the notebooks; return what is wrong."""
    parser = argparse.ArgumentParser(description="Notebooks of the tutorial.")
    parser.add_argument("--update", action="store_true", help="write the notebooks")
    parser.add_argument("--run", nargs="*", metavar="NAME", help="run those that are named, or all")
    given = parser.parse_args(arguments)
    if given.run is not None:
        _run_all(given.run or list(PAGES))
        return None
    update = given.update
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
