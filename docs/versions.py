"""Put the site of a release beside those of earlier ones: each in a folder of its version.

    LAGROS_VERSIONED=1 make docs
    python docs/versions.py site published    # fills published/VERSION

`published/` is what a web server shows; it needs no program there. Every page offers all versions
by `versions.js`, which lies beside them, and `index.html` leads to the newest. Nothing but the
standard library is needed.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_VERSION = re.compile(r"(\d+)\.(\d+)\.(\d+)((?:a|b|rc)\d+)?")
_FIRST = (
    '<!doctype html><meta charset="utf-8"><title>lagros</title>'
    '<meta http-equiv="refresh" content="0; url={0}/index.html">'
    '<a href="{0}/index.html">lagros {0}</a>\n'
)


def published_versions(folder: Path) -> list[str]:
    """Return the versions whose sites lie in a folder, the newest first."""
    found = [path.name for path in folder.iterdir() if path.is_dir()]
    return sorted(filter(_VERSION.fullmatch, found), key=_age, reverse=True)


def _age(version: str) -> tuple[int, int, int, bool, str]:
    """Return by what versions are ordered: 1.0.0rc1 comes before 1.0.0."""
    known = _VERSION.fullmatch(version)
    assert known is not None
    major, minor, patch, before = known.groups()
    return int(major), int(minor), int(patch), before is None, before or ""


def publish(site: Path, folder: Path, version: str) -> None:
    """Copy a site to where its version lies, and name it in the lists of versions.

    Raises:
        ValueError: The version is none, is there already, or the site is none.
    """
    if not _VERSION.fullmatch(version):
        raise ValueError(f"version={version!r} must be like 1.2.3 or 1.2.3rc1")
    if not (site / "index.html").is_file():
        raise ValueError(f"{site} is no site: it has no index.html; run `make docs` first")
    if (folder / version).exists():
        raise ValueError(f"{folder / version} is there: a version is published once")
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copytree(site, folder / version, ignore=shutil.ignore_patterns(".*"))
    versions = published_versions(folder)
    # What is no trial comes first.
    newest = next((one for one in versions if _age(one)[3]), versions[0])
    text = f"window.LAGROS_VERSIONS = {json.dumps(versions)};\n"
    (folder / "versions.js").write_text(text, encoding="utf-8")
    (folder / "index.html").write_text(_FIRST.format(newest), encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> str | None:
    """Publish; return what is wrong."""
    parser = argparse.ArgumentParser(description="Sites of all versions, side by side.")
    parser.add_argument("site", type=Path, help="what `make docs` has built")
    parser.add_argument("published", type=Path, help="the folder of all versions")
    given = parser.parse_args(arguments)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    try:
        publish(given.site, given.published, project["version"])
    except ValueError as error:
        return str(error)
    return None


if __name__ == "__main__":
    sys.exit(main())
