"""Print what pip would install, with its hashes, as `pip install --require-hashes -r` takes it.

    pip install --dry-run --ignore-installed --report - -r constraints.txt | python tests/locked.py

Nothing but the standard library is needed.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from typing import Any


def locked(report: dict[str, Any]) -> Iterator[str]:
    """Yield a line for each package of a report: a plain version, and the hash of its file."""
    for item in sorted(report["install"], key=lambda item: item["metadata"]["name"].lower()):
        # "2.13.0+cpu" lies on another index than "2.13.0", under which pip finds both.
        version = item["metadata"]["version"].partition("+")[0]
        name = item["metadata"]["name"].lower().replace("_", "-")
        digest = item["download_info"]["archive_info"]["hashes"]["sha256"]
        yield f"{name}=={version} --hash=sha256:{digest}"


if __name__ == "__main__":
    for line in locked(json.load(sys.stdin)):
        print(line)
