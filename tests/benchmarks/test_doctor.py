"""`lagros doctor` and `lagros` alone: what a stranger types first, and last."""

from __future__ import annotations

import json
from importlib import metadata

import numpy as np
import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli, doctor
from lagros_benchmarks.commands.extras import MODULES
from tests import documents, test_documents


def test_it_says_versions_processor_and_extras() -> None:
    result = CliRunner().invoke(cli.app, ["doctor", "--json"])
    assert result.exit_code == 0
    found = json.loads(result.output)
    assert found["versions"]["numpy"] == np.__version__ == metadata.version("numpy")
    assert found["machine"]["cpu_count"] > 0
    assert set(found["extras"]) == set(MODULES)
    words = CliRunner().invoke(cli.app, ["doctor"]).output
    assert f"numpy                  {np.__version__}" in words


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "MODULES", {"fast": ("no_such_module_anywhere", "numpy")})
    assert doctor.diagnosis()["extras"] == {"fast": "missing: no_such_module_anywhere"}


def test_lagros_alone_says_four_things_that_can_be_typed() -> None:
    result = CliRunner().invoke(cli.app, [])
    assert result.exit_code == 0
    lines = [line for line in result.output.splitlines() if line.startswith("  lagros ")]
    assert len(lines) == 4
    assert max(len(line) for line in result.output.splitlines()) <= 100
    for line in lines:
        command = line.strip().split("   ")[0]
        test_documents.check_commands(f"    {command}\n")
        assert documents.commands(f"    {command}\n")
