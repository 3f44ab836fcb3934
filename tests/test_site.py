"""The site says what the code says, its tutorial runs, and it builds without a warning."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests import documents, first_half

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
TUTORIAL = sorted((DOCS / "tutorial").glob("*.md"))
# What would install, open a window or need a compiler.
_NOT_RUN = ("make", "pip", "source", "git")


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["spec", "notebooks"])
def test_what_is_made_of_code_and_pages_is_as_they_are(name: str) -> None:
    assert script(name).main([]) is None


def test_a_page_that_is_not_as_the_code_is_is_found() -> None:
    spec = script("spec")
    page = "text\n<!-- spec -->\nold\n<!-- end -->\nmore\n"
    assert spec.updated(page, "new\n") == page.replace("old", "new")
    with pytest.raises(ValueError, match="marks"):
        spec.updated("text", "new")


def test_a_page_becomes_cells_in_its_order() -> None:
    text = "Write `mine.py`:\n\n```python\nx = 1\n```\n\nSee [it](../y.md):\n\n    lagros bench z\n"
    cells = list(script("notebooks")._cells(text, Path("tutorial/page.md")))
    assert ["".join(cell["source"]) for cell in cells] == [
        "Write `mine.py`:",
        "%%writefile mine.py\nx = 1",
        "See [it](../docs/tutorial/../y.md):",
        "!lagros bench z",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIAL, ids=[page.stem for page in TUTORIAL])
def test_a_page_of_the_tutorial_runs_as_it_stands(page: Path, tmp_path: Path) -> None:
    text = page.read_text(encoding="utf-8")
    first_half.write_modules(text, tmp_path)
    blocks = documents.python_blocks(text)
    (tmp_path / "blocks.py").write_text("\n\n".join(blocks), encoding="utf-8")
    typed = [command.words for command in documents.commands(text)]
    programs = str(Path(sys.executable).parent)
    paths = [str(ROOT), str(ROOT / "benchmarks"), os.environ.get("PYTHONPATH", "")]
    env = os.environ | {
        "PATH": programs + os.pathsep + os.environ["PATH"],
        "PYTHONPATH": os.pathsep.join(paths),
        "SDL_VIDEODRIVER": "dummy",
    }
    for words in [("python", "blocks.py"), *typed]:
        if words[0] not in _NOT_RUN:
            subprocess.run(words, cwd=tmp_path, env=env, check=True, stdin=subprocess.DEVNULL)


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="the site needs lagros[docs]")
    command = (sys.executable, "-m", "sphinx", "--quiet", "--fail-on-warning", "--keep-going")
    subprocess.run([*command, str(DOCS), str(tmp_path / "site")], check=True)
    for page in (tmp_path / "site").rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        for attribute in ('src="http', '<link rel="stylesheet" href="http', "@import url(http"):
            assert attribute not in text, (page.name, attribute)
