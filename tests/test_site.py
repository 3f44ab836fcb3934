"""The site says what the code says, its tutorial runs, and it builds without a warning."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest

from tests import documents, first_half
from tests.benchmarks import browser

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
# The others are run as notebooks (test_notebooks.py).
TUTORIAL = [
    page
    for page in sorted((DOCS / "tutorial").glob("*.md"))
    if not (ROOT / "notebooks" / f"{page.stem}.ipynb").is_file()
]
# What would install, open a window or need a compiler.
_NOT_RUN = ("make", "pip", "source", "git")


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["spec", "notebooks", "leaderboard"])
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


def test_the_guide_is_short() -> None:
    """Without code and tables; what was tried belongs to benchmarks/studies."""
    counts = {
        path.relative_to(DOCS).as_posix(): documents.words(path.read_text(encoding="utf-8"))
        for path in DOCS.rglob("*.md")
    }
    assert sum(counts.values()) <= 15_000, sorted(counts.items(), key=lambda item: -item[1])[:8]
    assert counts["guarantees.md"] <= 1_200
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 900


def test_words_are_counted_without_code_and_tables() -> None:
    text = "# Two words\n\n| not | these |\n\n    nor this\n\n```python\nx = 1\n```\nand x here\n"
    assert documents.words(text) == 4


def test_the_tables_of_results_say_what_the_rows_say() -> None:
    """Of the cart-pole's table, in the README and on the page of results."""
    rows = json.loads((ROOT / "benchmarks/results/cartpole_grid.json").read_text(encoding="utf-8"))
    kinds = ("uniform", "constant", "gust", "switching")
    of = {(row["policy"], row["disturbance"]): row for row in rows if row["bound"] == 0.75}
    for page in (ROOT / "README.md", DOCS / "results.md"):
        lines = re.findall(r"^\| (?:\(\S+\) )?(\S+) \| (\d.*) \|$", page.read_text("utf-8"), re.M)
        told = {name: cells.split(" | ") for name, cells in lines if (name, "gust") in of}
        assert len(told) >= 6, page
        for name, cells in told.items():
            strict = [f"{100 * of[name, kind]['strict_success_rate']:.1f}" for kind in kinds]
            effort = f"{of[name, 'uniform']['effort_mean']:.1f}"
            assert cells[:5] == [*strict, effort], (page.name, name)


def test_every_published_row_is_in_the_table_once_and_filters_start_from_a_plain_table() -> None:
    results = script("results")
    found = results.rows()
    keys = [tuple(column.text(row) for column in results.COLUMNS[:5]) for row in found]
    channels = [row["channels"] for row in found]
    assert len(set(zip(keys, channels, strict=True))) == len(keys)
    assert {row["task"] for row in found} >= {"cartpole", "car", "spacecraft"}
    # What the files hold, counted another way.
    grid = json.loads((ROOT / "benchmarks/results/cartpole_grid.json").read_text("utf-8"))
    of_grid = {(row["policy"], row["disturbance"], row["bound"]) for row in grid}
    assert of_grid <= {(row["policy"], row["disturbance"], row["bound"]) for row in found}
    parsed = ElementTree.fromstring(results.page(found))
    assert len(parsed.findall(".//tbody/tr")) == len(found)
    assert len(parsed.findall(".//th")) == len(parsed.find(".//tbody/tr"))
    assert results.markdown(found).count("\n") == len(found) + 1


@pytest.mark.slow
@pytest.mark.skipif(browser.PROGRAM is None, reason=browser.MISSING)
def test_the_table_of_results_filters_and_sorts_in_a_browser(tmp_path: Path) -> None:
    results = script("results")
    found = results.rows()
    code = (DOCS / "_static" / "filter.js").read_text(encoding="utf-8")
    page = tmp_path / "page.html"
    page.write_text(
        f'<meta charset="utf-8">{results.page(found)}<script>{code}</script>', encoding="utf-8"
    )
    shown = "[...document.querySelectorAll('tbody tr')].filter((row) => !row.hidden)"
    with browser.Browser(tmp_path / "browser") as view:
        view.open(page)
        assert view.value(f"{shown}.length") == len(found)
        view.value(
            "(() => { const choice = document.querySelector('select'); choice.value = 'car';"
            " choice.dispatchEvent(new Event('change')); })()"
        )
        cars = [row for row in found if row["task"] == "car"]
        assert view.value(f"{shown}.length") == len(cars) > 0
        view.value("document.querySelectorAll('thead button')[6].click()")
        sorted_now = view.value(f"{shown}.map((row) => parseFloat(row.cells[6].textContent))")
        assert sorted_now == sorted(sorted_now)
        assert sorted_now[-1] == 100.0
        assert view.problems == []


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIAL, ids=[page.stem for page in TUTORIAL])
def test_a_page_of_the_tutorial_runs_as_it_stands(page: Path, tmp_path: Path) -> None:
    text = page.read_text(encoding="utf-8")
    first_half.write_modules(text, tmp_path)
    blocks = documents.python_blocks(text)
    (tmp_path / "blocks.py").write_text("\n\n".join(blocks), encoding="utf-8")
    typed = [command.words for command in documents.commands(text)]
    for words in [("python", "blocks.py"), *typed]:
        if words[0] not in _NOT_RUN:
            env = documents.environment()
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
