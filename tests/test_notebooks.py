"""The notebooks run, each in an empty folder, and a command that fails in one is noticed."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest

from tests import documents
from tests.test_site import script

NOTEBOOKS = script("notebooks")


@pytest.fixture
def runner(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("nbclient", reason="notebooks run with lagros[docs]")
    pytest.importorskip("ipykernel", reason="notebooks run with lagros[docs]")
    for variable, value in documents.environment().items():
        monkeypatch.setenv(variable, value)
    return NOTEBOOKS


def book(*cells: str) -> str:
    """Return a notebook of cells of code."""
    made = [NOTEBOOKS._code(cell) | {"id": f"cell-{index}"} for index, cell in enumerate(cells)]
    return json.dumps({"cells": made, "metadata": {}, "nbformat": 4, "nbformat_minor": 5})


def test_cells_run_one_after_the_other_in_their_folder(
    runner: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = ["%%writefile three.py\nx = 3", "!python three.py", "import three\nassert three.x == 3"]
    monkeypatch.setattr(runner, "notebook", lambda name: book("%pip install nothing", *cells))
    titles = [title for _, title in runner.run("any", tmp_path)]
    assert titles == [cell.partition("\n")[0] for cell in cells]
    assert (tmp_path / "three.py").read_text() == "x = 3\n"


@pytest.mark.parametrize("cell", ["assert False", "!python absent.py\n!python --version"])
def test_what_fails_in_a_cell_is_noticed(
    cell: str, runner: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from nbclient.exceptions import CellExecutionError

    monkeypatch.setattr(runner, "notebook", lambda name: book(cell))
    with pytest.raises(CellExecutionError):
        list(runner.run("any", tmp_path))


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", NOTEBOOKS.PAGES)
def test_a_notebook_runs_from_its_first_cell_to_its_last(
    name: str, runner: ModuleType, tmp_path: Path
) -> None:
    assert list(runner.run(name, tmp_path))


def test_a_stranger_comes_to_a_notebook_by_its_badges_once_there_is_an_address() -> None:
    (plain,) = NOTEBOOKS._install("quickstart", "")
    assert "badge" not in "".join(plain["source"])
    badges, install = NOTEBOOKS._install("quickstart", "https://github.com/them/lagros")
    text = "".join(badges["source"])
    assert "https://colab.research.google.com/github/them/lagros/blob/main/notebooks/" in text
    assert "https://mybinder.org/v2/gh/them/lagros/main?" in text
    assert "".join(install["source"]).startswith("%pip install")
    # Binder and Colab know no other host.
    (elsewhere,) = NOTEBOOKS._install("quickstart", "https://example.org/lagros")
    assert "badge" not in "".join(elsewhere["source"])
    assert "git+https://example.org/lagros" in "".join(elsewhere["source"])
