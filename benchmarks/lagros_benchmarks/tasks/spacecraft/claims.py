"""Which certified bound is about which flights: the one place that decides it.

A number is published as certified only beside flights that its statement is about, under
everything that the statement supposes.

**Cart-pole: none.** Every flight holds its control for a period. Theorem 1 is for a control at
will, for u* or what errs from it by a known eps_l, and for alpha - kappa d_theta / 2 in place of
alpha, which is not positive at the bounds that are flown (`contraction.theorems`). The tubes that
are proved for a held control (`contraction.held_design`) are those of another law around gentler
plans. So the columns of the certified tube are null for every policy.

**Spacecraft: the position's error to the plan of `centralized`**, under the gain, the least-norm u*
or the sliding-variable law, held, whatever the disturbance is within its bound (`position_margin`).
Of the gain it is proved with the turn of the body within a hold; of the two others that is left
out, and only the gain's worlds have a guarantee of their own (`tracked_with_a_gain`).
"""

from __future__ import annotations

from typing import Any


def position_margin(policy: Any, disturbance_bound: float) -> float | None:
    """Return the certified bound of the position error to x_d, of a policy that tracks a plan [m].

    Args:
        policy: The policy as it flies, with whatever it uses. None is returned for all but the
            centralised policy itself: a safety filter, a class derived from it or thrusters that
            saturate apply another control than the one that the bound is for.
        disturbance_bound: d_bar, in units of the state per second.
    """
    from lagros_policies.tasks.spacecraft.sliding import SlidingTracking
    from lagros_policies.tasks.spacecraft.wrench_control import WrenchTracking

    law = _law(policy)
    if not (tracked_with_a_gain(policy) or type(law) in (SlidingTracking, WrenchTracking)):
        return None
    margin: float = law.margin(disturbance_bound)
    return margin


def tracked_with_a_gain(policy: Any) -> bool:
    """Return whether a policy tracks joint plans with a gain, so that worlds can be proved.

    Args:
        policy: The policy as it flies.
    """
    from lagros_policies.tasks.spacecraft.gain_control import GainTracking

    return type(_law(policy)) is GainTracking


def _law(policy: Any) -> Any:
    """Return the law of a centralised policy itself; it may have been exchanged by another."""
    from lagros_policies.tasks.spacecraft.centralized import CENTRALIZED
    from lagros_policies.tasks.spacecraft.sliding import SlidingCentralizedPolicy

    if type(policy) not in (*CENTRALIZED, SlidingCentralizedPolicy):
        return None
    return None if policy.settings.thrust_limit is not None else policy.tracking
