"""The disturbance of one environment of somebody else's, from reset to reset.

At the beginning of a control step the state is moved by dt d, and the environment then makes the
step that it makes, x_{k+1} = F(x_k + dt d_k, u_k): to first order in dt what d in dx/dt = f + d
does when it is held over the step. So what the environment says after it (observation, reward,
end) is of the state that it is in, and its own limits hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_positive, check_whole, shown
from lagros_envs.conventions import plain_seed
from lagros_envs.disturbances import Disturbance, Situation, channel_mask
from lagros_envs.foreign.adapters import adapter_for, given_adapter, period_of
from lagros_envs.of_task import Channels
from lagros_envs.options import real_numbers
from lagros_envs.seeding import episode_streams

# Of what a push moves, and of a state in single precision: what may differ where it is read back.
_OF_MOVE, _OF_STATE = 1e-3, 1e-6
# A sequence may pass its bound by rounding alone.
_ROUNDING = 1e-12


class Pushes:
    """Draws d, or takes it from a sequence, and moves the state by it; see `disturb`.

    Attributes:
        disturbance: Kind and bound; of kind "none" where a sequence is given.
        now: d of the last step, of the state's shape, in units of the state per second.
    """

    def __init__(
        self,
        kind: Any,
        bound: float,
        channels: Channels,
        scale: Any,
        adapter: Any,
        period: float | None,
        steps: int | None,
    ) -> None:
        self._given = None if isinstance(kind, str) or callable(kind) else _sequence(kind, bound)
        if isinstance(kind, str) and kind == "worst":
            raise ValueError(
                'kind="worst" pushes away from a nominal trajectory, which environments of others '
                "do not have; `lagros attack` searches the worst sequence of any"
            )
        # Of all channels; which there are is known with the first state.
        self.disturbance = Disturbance(kind if self._given is None else "none", bound, (True,))
        self._channels = channels
        self._scale = None if scale is None else _scale(scale)
        self._adapter = None if adapter is None else given_adapter(adapter)
        if period is not None:
            check_positive("period", period)
        if steps is not None:
            check_whole("steps", steps, 1)
        self._period, self._steps = period, steps
        self._rng: np.random.Generator | None = None
        self._drawn: FloatArray | None = None
        self._units, self._step, self._tried = np.ones(1), 0, False
        self.now: FloatArray = np.zeros(0)

    def begin(self, env: Any, limit: int | None, seed: int | None) -> None:
        """Draw the disturbance of an episode, which the environment has just begun.

        Args:
            env: The environment.
            limit: Its own limit of steps, if it has one.
            seed: That of the reset; None goes on with the generator of the last one.
        """
        env = env.unwrapped
        if self._adapter is None:
            self._adapter = adapter_for(env)
        state = self._read(env)
        if state.shape != self.now.shape:
            self._fit(env, state, limit)
        seed = plain_seed(seed)
        if seed is not None:
            self._rng = episode_streams(seed).disturbance
        elif self._rng is None:
            self._rng = np.random.default_rng()
        self._step, self.now = 0, np.zeros(state.shape)
        if self._given is None:
            rows = self._drawn
            assert rows is not None
            self.disturbance.realise_all([self._rng] * len(rows), rows, self.period)

    def apply(self, env: Any) -> None:
        """Move the state by dt d of this step."""
        if self._drawn is None:  # not reset: the environment says so
            return
        env = env.unwrapped
        rows = self._drawn
        # Past the end (of an environment whose limit is not that which was said) the last stays.
        push = rows[:, min(self._step, rows.shape[1] - 1)].reshape(self.now.shape)
        feedback = self.disturbance.is_feedback
        state = self._read(env) if feedback or push.any() else None
        if feedback:
            assert state is not None
            time = np.broadcast_to(self._step * self.period, state.shape[:-1])
            push = self.disturbance.respond(Situation(state, None, np.array(time), push))
        self.now = self._units * push
        # A calm environment is left alone, to the last bit.
        if state is not None and self.now.any():
            self._move(env, state, state + self.period * self.now)
        self._step += 1

    @property
    def period(self) -> float:
        """The control step [s]."""
        assert self._period is not None
        return self._period

    @property
    def knows_rates(self) -> bool:
        """Whether `channels="rates"` means something here, after a reset."""
        return callable(getattr(self._adapter, "rates", None))

    @property
    def steps(self) -> int:
        """Steps for which d is drawn or given."""
        assert self._drawn is not None
        return int(self._drawn.shape[1])

    def _move(self, env: Any, state: FloatArray, target: FloatArray) -> None:
        assert self._adapter is not None
        self._adapter.set_state(env, target.copy())
        if self._step and self._tried:
            return
        self._tried = True
        found = self._read(env)
        allowed = _OF_MOVE * np.abs(target - state).max() + _OF_STATE * np.abs(target)
        if found.shape != target.shape or np.any(np.abs(found - target) > allowed):
            raise ValueError(
                f"{_name(self._adapter)}: after set_state(env, {_short(target)}) state(env) is "
                f"{_short(found)}; it must be what was set"
            )

    def _read(self, env: Any) -> FloatArray:
        assert self._adapter is not None
        returned = self._adapter.state(env)
        state = real_numbers(returned)
        if state is None or state.ndim not in (1, 2) or not state.size or not _finite(state):
            raise ValueError(
                f"{_name(self._adapter)}: state(env) returned {shown(returned)}; it must be finite "
                "numbers of shape (n,), or (k, n) for k bodies"
            )
        return state

    def _fit(self, env: Any, state: FloatArray, limit: int | None) -> None:
        """Take the sizes of a state that is seen for the first time."""
        adapter, n = self._adapter, state.shape[-1]
        assert adapter is not None
        if self._period is None:
            self._period = period_of(adapter, env)
        self._units = np.ones(n) if self._scale is None else self._scale
        if self._units.shape not in ((), (n,)):
            raise ValueError(f"scale has {self._units.size} entries; the state has {n}")
        mask = self._mask(env, n)
        self.disturbance = replace(self.disturbance, channels=mask)
        bodies = 1 if state.ndim == 1 else len(state)
        if self._given is not None:
            self._drawn = _fitting(self._given, state.shape, mask)
        else:
            steps = self._steps or limit
            if steps is None:
                raise ValueError(
                    f"{type(env).__name__} has no limit of steps, which says how long a "
                    "disturbance is drawn: pass steps=, or wrap it in TimeLimit first"
                )
            self._drawn = np.zeros((bodies, steps, n))
        self._tried = False

    def _mask(self, env: Any, states: int) -> tuple[bool, ...]:
        rates: tuple[bool, ...] = (True,) * states
        if isinstance(self._channels, str) and self._channels == "rates":
            known: Any = getattr(self._adapter, "rates", None)
            if known is None:
                raise ValueError(
                    f'channels="rates": {_name(self._adapter)} does not say which of the {states} '
                    "coordinates are rates; pass a mask, a boolean for each"
                )
            rates = tuple(bool(one) for one in known(env))
        try:
            return channel_mask(self._channels, rates)
        except ValueError as error:
            raise ValueError(str(error).replace("disturbance_channels", "channels")) from None


def _sequence(given: Any, bound: float) -> FloatArray:
    """Return d/scale at every step, shape (steps, n) or (steps, k, n).

    Raises:
        ValueError: It is no such array, or a push passes the bound.
    """
    pushes = real_numbers(given)
    if pushes is None or pushes.ndim not in (2, 3) or not pushes.size or not _finite(pushes):
        raise ValueError(
            f"kind={shown(given)} must be the name of a kind, a function of a Situation, or a "
            "sequence of pushes, finite numbers of shape (steps, n), or (steps, k, n) of k bodies"
        )
    Disturbance("none", bound, (True,))  # checks the bound before anything is compared with it
    largest = float(np.linalg.norm(pushes, axis=-1).max())
    if largest > bound * (1.0 + _ROUNDING):
        raise ValueError(f"a push of the sequence has norm {largest!r}, above bound={bound!r}")
    return pushes


def _fitting(pushes: FloatArray, shape: tuple[int, ...], mask: Sequence[bool]) -> FloatArray:
    """Return a sequence as (bodies, steps, n).

    Raises:
        ValueError: It is not of the state's shape, or pushes what is not among the channels.
    """
    if pushes.shape[1:] != shape:
        raise ValueError(
            f"the sequence has pushes of shape {pushes.shape[1:]}; the state has shape {shape}"
        )
    if pushes[..., ~np.array(mask)].any():
        raise ValueError("the sequence pushes coordinates that are not among the channels")
    return np.moveaxis(pushes.reshape(len(pushes), -1, shape[-1]), 0, 1)


def _scale(given: Any) -> FloatArray:
    scale = real_numbers(given)
    if scale is None or scale.ndim > 1 or not _finite(scale) or not (scale > 0.0).all():
        raise ValueError(
            f"scale={shown(given)} must be a positive number, or one for each coordinate"
        )
    return scale


def _finite(numbers: FloatArray) -> bool:
    return bool(np.isfinite(numbers).all())


def _short(numbers: FloatArray) -> str:
    return np.array2string(numbers, precision=6, threshold=8).replace("\n", "")


def _name(adapter: Any) -> str:
    return f"the adapter {type(adapter).__name__}"
