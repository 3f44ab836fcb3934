"""Print the lowest version of each package that an extra allows, as constraints for pip.

    python tests/lowest.py pyproject.toml bench > lowest.txt

The package's own requirements are among them. Nothing but the standard library is needed.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

# A name, and where its range begins; both are strings in a requirement such as "scipy>=1.15,<2".
RANGE = re.compile(r"([A-Za-z0-9_.-]+)>=([0-9.]+)")
OURS = re.compile(r"lagros\[([a-z,]+)\]")


def lowest(project: dict[str, Any], extra: str) -> dict[str, str]:
    """Return package and lowest version, of an extra with those that it names."""
    found: dict[str, str] = {}
    extras, todo = project["optional-dependencies"], [extra]
    lines = list(project["dependencies"])
    while todo:
        lines += extras[todo.pop()]
        for line in [line for line in lines if OURS.match(line)]:
            todo += OURS.match(line)[1].split(",")
            lines.remove(line)
    for line in lines:
        name, version = RANGE.match(line).groups()
        found[name] = version
    return found


if __name__ == "__main__":
    project = tomllib.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))["project"]
    for name, version in sorted(lowest(project, sys.argv[2]).items()):
        print(f"{name}=={version}")
