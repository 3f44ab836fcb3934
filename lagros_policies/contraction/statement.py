"""One line of a certificate: what is claimed, how it is known, and whether it holds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import ROUND_CEILING, Context
from typing import Literal, get_args

from lagros_envs.checks import check_not_negative

Kind = Literal["proved", "calibrated", "observed"]


@dataclass(frozen=True, slots=True)
class Statement:
    """A claim with the kind of evidence behind it.

    Attributes:
        text: The claim in plain words, with its numbers and their units.
        kind: "proved" (sound over a continuous set), "calibrated" (with a stated confidence from
            finitely many episodes) or "observed" (counted).
        holds: Whether the claim was established. A proof that was not found is a statement that
            does not hold, whether or not its opposite was shown.
        seconds: Time that the evidence took [s].
        refuted: Whether the opposite was shown.

    Raises:
        ValueError: The text is empty, the kind unknown or the time negative or not finite.
    """

    text: str
    kind: Kind
    holds: bool
    seconds: float
    refuted: bool = False

    def __post_init__(self) -> None:
        if not self.text.strip():
            raise ValueError("text='' must say what is claimed")
        if self.kind not in get_args(Kind):
            raise ValueError(f"kind={self.kind!r} must be one of {', '.join(get_args(Kind))}")
        check_not_negative("seconds", self.seconds)

    @property
    def verdict(self) -> str:
        """Return "yes", "NO", or "not shown" where neither a proof was found nor its opposite."""
        if self.holds:
            return "yes"
        return "not shown" if self.kind == "proved" and not self.refuted else "NO"


def at_least(value: float, digits: int = 4) -> str:
    """Return a number in words, rounded downwards; see `at_most`."""
    return f"{-float(at_most(-value, digits)):.{digits}g}"


def at_most(value: float, digits: int = 4) -> str:
    """Return a number in words, rounded upwards: what is claimed is never less than was proved."""
    if not math.isfinite(value):
        return f"{value:g}"
    rounded = Context(prec=digits, rounding=ROUND_CEILING).create_decimal_from_float(value)
    return f"{float(rounded):.{digits}g}"
