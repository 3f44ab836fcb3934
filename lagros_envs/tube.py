"""The tube whose radius is the paper's success threshold."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagros_envs.checks import LARGEST, check_at_most, check_fields, check_positive
from lagros_envs.values import use_plain_numbers


@dataclass(frozen=True, slots=True)
class PaperTube:
    """The published tube r(t) = R (1 - exp(-alpha t)): success threshold and figure line.

    It is a number of the paper, not a bound that this package has certified; see
    `lagros_policies.contraction.tube` for those.

    Attributes:
        steady_radius: R, in units of the state norm.
        contraction_rate: alpha [1/s].

    Raises:
        ValueError: A value is not positive and finite.
    """

    steady_radius: float = 3.15
    contraction_rate: float = 0.6

    def __post_init__(self) -> None:
        check_fields(self)
        use_plain_numbers(self)
        for name in ("steady_radius", "contraction_rate"):
            check_positive(name, getattr(self, name))
            check_at_most(name, getattr(self, name), LARGEST)

    def radius(self, time: Any) -> Any:
        """Return r(t) for a time, or an array of times, [s]."""
        if isinstance(time, (float, int)):  # the union type takes three times as long
            return self.steady_radius * -math.expm1(-self.contraction_rate * time)
        return self.steady_radius * -np.expm1(-self.contraction_rate * time)
