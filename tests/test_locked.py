"""The hashes of what is installed are of the versions that are pinned, and of all of them."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from tests.locked import locked
from tests.lowest import lowest

ROOT = Path(__file__).parents[1]


def versions(name: str) -> dict[str, str]:
    """Return package and version of a file of pins."""
    text = (ROOT / name).read_text(encoding="utf-8")
    return dict(re.findall(r"^([a-z0-9.-]+)==([^\s;]+)", text, re.MULTILINE))


PINNED = versions("constraints.txt")


@pytest.mark.parametrize("name", ["locked/bench.txt", "locked/tests.txt"])
def test_every_pin_has_its_hashes(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    pieces = re.split(r"^(?=[a-z0-9.-]+==)", text, flags=re.MULTILINE)
    assert len(pieces) > 30
    for piece in pieces[1:]:
        assert re.findall(r"--hash=sha256:[0-9a-f]{64}(?=\s)", piece + "\n"), piece
        assert "--hash=sha1" not in piece
        assert "--hash=md5" not in piece
    # What no environment of the tests needs is pinned nowhere else.
    others = set(versions(name)) - set(PINNED)
    assert others <= {"colorama", "exceptiongroup", "tomli"}
    assert {one: version for one, version in versions(name).items() if one not in others} == {
        one: PINNED[one] for one in versions(name) if one not in others
    }


def test_all_that_the_tests_run_with_is_there() -> None:
    assert versions("locked/tests.txt") == PINNED


def test_all_that_a_user_installs_is_there() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    todo, needed = list(lowest(project, "bench")), set()
    while todo:
        name = todo.pop().lower().replace("_", "-")
        if name in needed:
            continue
        needed.add(name)
        for line in metadata.requires(name) or ():
            required = Requirement(line)
            if required.marker is None or required.marker.evaluate({"extra": ""}):
                todo.append(required.name)
    assert needed <= set(versions("locked/bench.txt"))


def test_a_report_of_pip_becomes_lines() -> None:
    def item(name: str, version: str) -> dict[str, object]:
        hashes = {"archive_info": {"hashes": {"sha256": "0" * 64}}}
        return {"metadata": {"name": name, "version": version}, "download_info": hashes}

    report = {"install": [item("torch", "2.13.0+cpu"), item("Jinja_2", "3")]}
    line = f" --hash=sha256:{'0' * 64}"
    assert list(locked(report)) == [f"jinja-2==3{line}", f"torch==2.13.0{line}"]
