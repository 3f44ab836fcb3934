"""What an inspection has found: one line for each thing looked at, and what they come to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["ok", "warning", "fault"]
# In the order in which they are shown.
VERDICTS: tuple[Verdict, ...] = ("fault", "warning", "ok")


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        subject: What, in a word or two.
        verdict: "fault": it will not work, or is not what it says; "warning": it works, and less
            well than it could; "ok".
        text: What was found.
        remedy: What to write instead; "" where nothing is wrong.
    """

    subject: str
    verdict: Verdict
    text: str
    remedy: str = ""


def count(findings: Sequence[Finding], verdict: Verdict) -> int:
    """Return how many findings have a verdict."""
    return sum(one.verdict == verdict for one in findings)


def verdict_of(name: str, findings: Sequence[Finding]) -> str:
    """Return what the findings on a task come to, in one sentence."""
    faults, warnings = count(findings, "fault"), count(findings, "warning")
    beside = f", {_number(warnings, 'warning')}" if warnings else ""
    if faults:
        return f"{name} is NOT ready: {_number(faults, 'fault')}{beside}."
    if warnings:
        return f"{name} flies{beside}."
    return f"{name} is ready: nothing is wrong in {_number(len(findings), 'check')}."


def _number(many: int, what: str) -> str:
    return f"{many} {what}{'s' * (many != 1)}"
