"""What the cart-pole's u* prefers: two regulators along the plan, and a gate between them.

The tight gain corrects at once. But where the pole leans far and the force has little authority,
correcting at once throws cart and pole out of the tube that is still narrow; there the gentle gain
is better. The gate looks a few steps ahead under the tight gain.

The weights below are design constants. They were found by gradient descent on the share of
simulated episodes that leave the published tube; they shape performance, never the bound.
`benchmarks/tuning/feedback.py` finds others, as good, from constant weights in five minutes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lagros_envs.arrays import FloatArray, IntArray
from lagros_envs.checks import check_fields, check_whole
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tube import PaperTube
from lagros_policies.contraction.feedback import riccati_gains

# The published tube begins with radius zero; errors are measured against at least its radius
# after one step.
_FIRST_RADIUS_STEP = 1


@dataclass(frozen=True)
class WeightSchedule:
    """Linear-quadratic weights whose logarithms are sum_j w_j exp(-j t / decay_time).

    Attributes:
        state: w_j of the state's weights, one row per j, one column per state.
        control: w_j of the control's weight.
        decay_time: Time over which the schedule settles [s].

    Raises:
        ValueError: The rows do not match.
    """

    state: tuple[tuple[float, ...], ...]
    control: tuple[float, ...]
    decay_time: float = 0.35

    def __post_init__(self) -> None:
        if len(self.state) != len(self.control) or not self.decay_time > 0.0:
            raise ValueError(
                f"{len(self.state)} rows of state weights need as many control weights, "
                "and decay_time must be positive"
            )

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the state weights, shape (t, n), and control weights, (t,), at times [s]."""
        basis = np.exp(-np.arange(len(self.control)) * times[:, None] / self.decay_time)
        return np.exp(basis @ np.asarray(self.state)), np.exp(basis @ np.asarray(self.control))


_TIGHT = WeightSchedule(
    state=(
        (-2.55, 1.59, -0.73, -1.04),
        (3.04, 2.29, 3.85, -0.71),
        (3.11, 0.53, 0.67, -4.91),
        (1.13, 0.22, -1.07, -5.75),
    ),
    control=(-1.9, -2.84, -0.58, -0.6),
)
_GENTLE = WeightSchedule(
    state=(
        (-9.99, 0.03, -5.5, 3.49),
        (-12.79, 4.55, 9.86, 6.45),
        (7.01, 5.93, 4.76, -2.09),
        (5.84, 5.73, 1.1, -4.64),
    ),
    control=(-3.68, 6.81, 0.92, -3.22),
)


@dataclass(frozen=True)
class FeedbackSettings:
    """The two gains and the gate between them.

    Attributes:
        tight: Weights of the gain that corrects at once.
        gentle: Weights of the gain that lets a large error decay.
        gate_offset: Logit of the gentle share where no error is foreseen.
        gate_slope: Logit per unit of foreseen error, in radii of the tube.
        lookahead: Steps foreseen.
        sharpness: Of the soft maximum over these.
        tube: The published tube, in whose radii errors are measured.

    Raises:
        ValueError: A value is of another type, or no step is foreseen.
    """

    tight: WeightSchedule = _TIGHT
    gentle: WeightSchedule = _GENTLE
    gate_offset: float = -3.68
    gate_slope: float = 4.15
    lookahead: int = 3
    sharpness: float = 12.0
    tube: PaperTube = field(default_factory=PaperTube)

    def __post_init__(self) -> None:
        check_fields(self)
        check_whole("lookahead", self.lookahead)


@dataclass(frozen=True)
class GainTable:
    """Both gains along a batch of plans with one control.

    Attributes:
        tight: K of the tight gain, shape (p, N, n).
        gentle: K of the gentle gain, shape (p, N, n).
        closed: A - B K of the tight gain, shape (p, N + lookahead, n, n); zero past the end.
    """

    tight: FloatArray
    gentle: FloatArray
    closed: FloatArray


def gain_table(
    settings: FeedbackSettings,
    by_state: FloatArray,
    by_control: FloatArray,
    times: FloatArray,
) -> GainTable:
    """Compute both gains along plans.

    Args:
        settings: Weights.
        by_state: dF/dx of the held dynamics along the plans, shape (p, N, n, n).
        by_control: dF/du, shape (p, N, n).
        times: Control instants of the plans, shape (N + 1,) [s].

    Raises:
        ValueError: The plans have more than one control, or other states than there are weights.
    """
    wanted = (len(times) - 1, by_state.shape[-1])
    widths = {len(row) for one in (settings.tight, settings.gentle) for row in one.state}
    if np.shape(by_control)[-2:] != wanted or np.shape(by_state)[-3:-1] != wanted:
        raise ValueError(
            f"by_state and by_control of shapes {np.shape(by_state)} and {np.shape(by_control)} "
            f"must be (p, N, n, n) and (p, N, n) for {len(times)} times N + 1 and one control"
        )
    if widths != {wanted[1]}:
        raise ValueError(
            f"the weights are for {sorted(widths)} states, as the cart-pole's, and the plans have "
            f"{wanted[1]}: give FeedbackSettings with weights for these"
        )
    schedules = [schedule.at(times) for schedule in (settings.tight, settings.gentle)]
    state = np.stack([weights for weights, _ in schedules])[:, None]
    control = np.stack([weights for _, weights in schedules])[:, None, :-1, None]
    pushes = by_control[None, ..., None]
    tight, gentle = riccati_gains(by_state[None], pushes, state, control)[..., 0, :]
    closed = by_state - by_control[..., None] * tight[..., None, :]
    padding = np.zeros((len(closed), settings.lookahead, *closed.shape[2:]))
    return GainTable(tight, gentle, np.concatenate([closed, padding], axis=1))


def preferred_deviation(
    settings: FeedbackSettings,
    table: GainTable,
    plan: IntArray,
    index: IntArray,
    error: FloatArray,
    time: FloatArray,
    period: float,
) -> FloatArray:
    """Return the preferred v = u - u_d at errors along plans of a table.

    Args:
        settings: Gate and tube.
        table: Gains of the plans.
        plan: Which plan each error belongs to, shape (s,).
        index: Its step along the plan, shape (s,).
        error: e = x - x_d, shape (s, n).
        time: t, shape (s,) [s].
        period: Control period [s].

    Returns:
        v, shape (s,).
    """
    tight = -np.einsum("si,si->s", table.tight[plan, index], error)
    gentle = -np.einsum("si,si->s", table.gentle[plan, index], error)
    instants = time[:, None] + period * np.arange(settings.lookahead + 1)
    instants[:, 0] = np.maximum(instants[:, 0], _FIRST_RADIUS_STEP * period)
    radii = settings.tube.radius(instants)
    foreseen = np.empty_like(radii)
    ahead = error
    for step in range(settings.lookahead + 1):
        if step:
            ahead = np.einsum("sij,sj->si", table.closed[plan, index + step - 1], ahead)
        foreseen[:, step] = np.linalg.norm(ahead, axis=-1) / radii[:, step]
    worst = foreseen.max(axis=1)
    spread = np.exp(settings.sharpness * (foreseen - worst[:, None])).sum(axis=1)
    soft = worst + np.log(spread) / settings.sharpness
    share = 1.0 / (1.0 + np.exp(-(settings.gate_offset + settings.gate_slope * soft)))
    # Once the tube is wide there is nothing to be gentle about.
    share = share * np.exp(-settings.tube.contraction_rate * time)
    deviation: FloatArray = (1.0 - share) * tight + share * gentle
    return deviation


class GatedRegulator:
    """Both gains and the gate, as a `lagros_policies.expert.Preference`.

    Args:
        task: The task.
        settings: Weights; those above with the task's tube if left out.
    """

    def __init__(self, task: CartPoleSettings, settings: FeedbackSettings | None = None) -> None:
        self.settings = settings or FeedbackSettings(tube=task.tube)
        self._period = task.control_period

    def gains(self, by_state: FloatArray, by_control: FloatArray, times: FloatArray) -> GainTable:
        """Return both gains along plans; see `gain_table`, but by_control is (p, N, n, 1)."""
        return gain_table(self.settings, by_state, by_control[..., 0], times)

    def deviation(
        self, gains: GainTable, plan: IntArray, index: IntArray, error: FloatArray, time: FloatArray
    ) -> FloatArray:
        """Return the preferred v, shape (s,); see `preferred_deviation`."""
        return preferred_deviation(self.settings, gains, plan, index, error, time, self._period)
