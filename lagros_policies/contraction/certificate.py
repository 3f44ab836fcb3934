"""One certificate of a task: what is claimed of flights or of a metric, and how each is known.

Pure functions: they prove and compute, and read no file and fly no episode. What was calibrated or
observed is added by whoever flew (`Certificate.with_evidence`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from lagros_envs.arrays import FloatArray
from lagros_policies.contraction.statement import Statement


@dataclass(frozen=True)
class TubeSizes:
    """Three tubes that are never to be confused, each by the radius that it tends to.

    Attributes:
        paper: The published tube: a success threshold, not a bound of this package; None where none
            is published.
        certified: What is proved: of flights by their own tubes, of a metric by Theorem 1 with the
            certificate's numbers; None where there is no tube.
        observed: The largest ||x - x_d|| of the episodes flown; None without any.
    """

    paper: float | None
    certified: float | None
    observed: float | None = None


@dataclass(frozen=True)
class Certificate:
    """What is claimed of flights, or of a metric on a region.

    Attributes:
        task: Name of the task.
        policy: Who flies, or whose control the theorems speak of.
        region: Names to [low, high], where the condition holds; empty, and the next four and the
            coefficients None, where the claims are of flights.
        alpha: Contraction rate [1/s].
        chi: I <= W_bar <= chi I on the region, in the units of the state.
        nu: Weight of B B' in the condition.
        b_bar: Bound of ||B(x)|| on the region.
        epsilon_l: Learning error ||u_L - u*||, in units of the control; None of another policy.
        d_bar: Bound of the disturbance, in units of the state per second.
        channels: "all", or "rates" where the certified tube is for disturbances of the rates alone.
        basis: How W_bar depends on the state.
        coefficients: W_bar = sum_i coefficients[i] basis_i, shape (k, n, n).
        tube: The three radii.
        statements: Every claim.
        details: Further numbers, by name.
        not_proved: What nobody has proved of it, in words.
        verdict_radius: The tube that the certificate comes to; `tube.certified` if None.
        reach: What that bounds, in words; "" for Theorem 1.
        unit: Its unit; "" for the norm of the state.
        everywhere: Whether the condition holds for all states, of which the region is a part to
            draw from.
        headline: What it comes to, in one line; "" for the verdict alone.
        guarantee: What is guaranteed of episodes, as JSON; None where no statement is about them.
        predicted: What floats say and nothing proves, in words.
    """

    task: str
    policy: str
    region: Mapping[str, tuple[float, float]]
    alpha: float | None
    chi: float | None
    nu: float | None
    b_bar: float | None
    epsilon_l: float | None
    d_bar: float
    channels: str
    basis: str
    coefficients: FloatArray | None
    tube: TubeSizes
    statements: tuple[Statement, ...]
    details: Mapping[str, Any] = field(default_factory=dict)
    not_proved: tuple[str, ...] = ()
    verdict_radius: float | None = None
    reach: str = ""
    unit: str = ""
    everywhere: bool = False
    headline: str = ""
    guarantee: Mapping[str, Any] | None = None
    predicted: tuple[str, ...] = ()

    @classmethod
    def of_flights(cls, **claims: Any) -> Certificate:
        """Return a certificate that is of flights and of no metric."""
        nothing: dict[str, Any] = dict.fromkeys(("alpha", "chi", "nu", "b_bar", "coefficients"))
        return cls(**nothing, region={}, channels="all", basis="", **claims)

    @property
    def reached(self) -> float | None:
        """The tube that the certificate comes to; None for none."""
        return self.tube.certified if self.verdict_radius is None else self.verdict_radius

    @property
    def holds(self) -> bool:
        """Whether everything that is claimed holds, and anything is claimed at all."""
        return bool(self.statements) and all(line.holds for line in self.statements)

    @property
    def seconds(self) -> float:
        """Time that the evidence took [s]."""
        return sum(line.seconds for line in self.statements)

    def with_evidence(
        self, statements: Sequence[Statement], observed: float | None = None
    ) -> Certificate:
        """Return the certificate with further claims, and with what was observed of the tube."""
        tube = self.tube if observed is None else replace(self.tube, observed=observed)
        return replace(self, tube=tube, statements=(*self.statements, *statements))

    def as_json(self) -> dict[str, Any]:
        """Return the certificate as what JSON can hold; what is not finite becomes null."""
        return {
            "task": self.task,
            "policy": self.policy,
            "alpha": self.alpha,
            "chi": _finite(self.chi),
            "nu": self.nu,
            "b_bar": _finite(self.b_bar),
            "epsilon_l": _finite(self.epsilon_l),
            "d_bar": self.d_bar,
            "channels": self.channels,
            "region": {name: list(ends) for name, ends in self.region.items()},
            "metric": None
            if self.coefficients is None
            else {"basis": self.basis, "coefficients": self.coefficients.tolist()},
            "tube": {
                "paper": self.tube.paper,
                "certified": _finite(self.tube.certified),
                "observed": _finite(self.tube.observed),
            },
            "guarantee": self.guarantee,
            "predicted": list(self.predicted),
            "not_proved": list(self.not_proved),
            "holds": self.holds,
            "statements": [
                {
                    "text": line.text,
                    "kind": line.kind,
                    "holds": line.holds,
                    "seconds": round(line.seconds, 3),
                }
                for line in self.statements
            ],
            **self.details,
        }


class Stopwatch:
    """Seconds since it was last asked."""

    def __init__(self) -> None:
        self._begun = time.monotonic()

    def lap(self) -> float:
        """Return the time since the last lap [s], and start the next."""
        now = time.monotonic()
        taken, self._begun = now - self._begun, now
        return taken


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value
