"""What is made of the repository's address, and what is left out while there is none."""

from __future__ import annotations

import importlib.util
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def build() -> ModuleType:
    # hatchling is there where a wheel is built, and not here.
    parts = ("hatchling", "hatchling.metadata", "hatchling.metadata.plugin")
    stub = ModuleType("hatchling.metadata.plugin.interface")
    stub.MetadataHookInterface = object  # type: ignore[attr-defined]
    with pytest.MonkeyPatch.context() as patch:
        for name in parts:
            patch.setitem(sys.modules, name, ModuleType(name))
        patch.setitem(sys.modules, stub.__name__, stub)
        spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return module


def test_without_an_address_nothing_points_anywhere(build: ModuleType) -> None:
    text = build.readme(README, "")
    assert "![" not in text
    assert "](docs/" not in text
    assert "the paper" in text
    assert build.urls("") == {}


def test_with_an_address_every_picture_and_link_is_whole(build: ModuleType) -> None:
    text = build.readme(README, "https://example.org/lagros")
    assert "](docs/" not in text
    assert "](https://example.org/lagros/raw/main/docs/images/" in text
    assert "](https://example.org/lagros/blob/main/docs/" in text
    assert all(
        url.startswith("https://example.org/lagros")
        for url in build.urls("https://example.org/lagros").values()
    )


def test_links_to_elsewhere_and_within_stay(build: ModuleType) -> None:
    text = "[a](https://x.org) [b](#c) ![d](e.png)"
    assert build.readme(text, "") == "[a](https://x.org) [b](#c) "


def test_the_address_stands_once() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    address = project["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]
    if address:
        for name in ("README.md", "docs/conf.py", "docs/notebooks.py"):
            assert address not in (ROOT / name).read_text(encoding="utf-8")
    assert set(project["project"]["dynamic"]) == {"readme", "urls"}
