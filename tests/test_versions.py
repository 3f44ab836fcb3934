"""Sites of several versions lie side by side, and each offers the others."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import pytest

from tests.benchmarks import browser
from tests.test_site import script

ROOT = Path(__file__).parents[1]
VERSIONS = script("versions")
CODE = (ROOT / "docs/_static/versions.js").read_text(encoding="utf-8")
PAGE = """<!doctype html><html data-content_root="./"><meta charset="utf-8">
<script>const DOCUMENTATION_OPTIONS = {{VERSION: "{0}"}};</script>
<script src="../versions.js"></script><script src="own.js"></script>
<a class="sidebar-brand">lagros</a><h1>{0}</h1></html>"""


def site(folder: Path, version: str) -> Path:
    """Write a site of one page."""
    folder.mkdir()
    (folder / "index.html").write_text(PAGE.format(version), encoding="utf-8")
    (folder / "own.js").write_text(CODE, encoding="utf-8")
    (folder / ".buildinfo").touch()
    return folder


@pytest.fixture
def published(tmp_path: Path) -> Path:
    for version in ("0.9.0", "0.10.0", "1.0.0rc1"):
        VERSIONS.publish(site(tmp_path / version, version), tmp_path / "all", version)
    return tmp_path / "all"


def listed(folder: Path) -> list[str]:
    text = (folder / "versions.js").read_text(encoding="utf-8")
    return json.loads(text.removeprefix("window.LAGROS_VERSIONS = ").rstrip(";\n"))


def test_versions_are_listed_by_their_age_and_the_newest_is_no_trial(published: Path) -> None:
    assert listed(published) == ["1.0.0rc1", "0.10.0", "0.9.0"]
    assert "url=0.10.0/index.html" in (published / "index.html").read_text(encoding="utf-8")
    assert not list(published.rglob(".buildinfo"))


@pytest.mark.parametrize(
    ("version", "said"), [("0.9.0", "published once"), ("../up", "must be like"), ("v2", "must be")]
)
def test_what_is_no_new_version_is_refused(published: Path, version: str, said: str) -> None:
    before = listed(published)
    with pytest.raises(ValueError, match=said):
        VERSIONS.publish(published / "0.9.0", published, version)
    assert listed(published) == before


def test_what_is_no_site_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no index"):
        VERSIONS.publish(tmp_path, tmp_path / "all", "1.0.0")
    assert not (tmp_path / "all").exists()


@pytest.mark.slow
@pytest.mark.skipif(browser.PROGRAM is None, reason=browser.MISSING)
def test_a_reader_goes_from_one_version_to_another(published: Path, tmp_path: Path) -> None:
    with browser.Browser(tmp_path / "browser") as view:
        view.open(published / "0.9.0" / "index.html")
        chosen = "document.querySelector('select.versions')"
        assert view.value(f"{chosen}.value") == "0.9.0"
        assert view.value(f"{chosen}.length") == 3
        view.value(f"{chosen}.value = '0.10.0'; {chosen}.dispatchEvent(new Event('change'))")
        for _ in range(50):
            if view.value("document.querySelector('h1')?.textContent") == "0.10.0":
                break
            time.sleep(0.1)
        assert view.value(f"{chosen}.value") == "0.10.0"
        assert view.problems == []


def test_the_changelog_goes_by_release_the_newest_first() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first, *releases = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert first == "[Unreleased]"
    known = [re.fullmatch(r"\[(.*)\] - (\d{4}-\d\d-\d\d|unreleased)", one) for one in releases]
    assert all(known)
    versions = [one[1] for one in known if one]
    assert versions == sorted(versions, key=VERSIONS._age, reverse=True)
