"""Write the tables of the leaderboard into its page, of what lies in `benchmarks/leaderboard`.

    python docs/leaderboard.py             # whether the page is as they say; status 1 if not
    python docs/leaderboard.py --update    # and write it

A submission that is not as it should be ends it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lagros_benchmarks.report.leaderboard import read_submission, table

ROOT = Path(__file__).resolve().parents[1]
FOLDER, PAGE = ROOT / "benchmarks" / "leaderboard", ROOT / "docs" / "leaderboard.md"
_BEGIN, _END = "<!-- leaderboard -->\n", "<!-- end -->\n"


def updated(page: str, text: str) -> str:
    """Return a page with a text between its marks."""
    before, begin, rest = page.partition(_BEGIN)
    _, end, after = rest.partition(_END)
    return f"{before}{begin}{text}{end}{after}"


def main(arguments: Sequence[str] | None = None) -> str | None:
    """Compare or write the page; return what is wrong."""
    parser = argparse.ArgumentParser(description="The page of the leaderboard.")
    parser.add_argument("--update", action="store_true", help="write it")
    update = parser.parse_args(arguments).update
    page = PAGE.read_text(encoding="utf-8")
    wanted = updated(page, table(map(read_submission, sorted(FOLDER.glob("*.json")))))
    if page == wanted:
        return None
    if update:
        PAGE.write_text(wanted, encoding="utf-8")
        return None
    return "docs/leaderboard.md is not as the submissions are; run docs/leaderboard.py --update"


if __name__ == "__main__":
    sys.exit(main())
