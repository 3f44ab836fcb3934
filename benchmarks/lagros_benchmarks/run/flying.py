"""How a policy is asked, and what becomes of what it raises.

Every command flies policies through this module, whatever its loop. A policy is a stranger: it gets
copies, its answers are checked, and whatever it raises is the failure of its episode. Only
Ctrl-C ends the run, and so does a `KeyboardInterrupt` of the policy's own, which is the same to us.
A call that never returns is waited for: there is no time limit on a policy.
"""

from __future__ import annotations

from collections.abc import Iterable
from time import perf_counter
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.library import describe_error
from lagros_benchmarks.run.process import ProcessState
from lagros_envs.arrays import Float32Array
from lagros_policies.policy import BasePolicy

# Exit status of a command that has flown and written everything, where some episodes raised.
RAISED = 3


class AnswerError(ValueError):
    """What `predict` returned is not an action of the right shape and a memory."""


class Answer(NamedTuple):
    """What a policy answered.

    Attributes:
        action: The action, a copy, in the first of the shapes that were asked for.
        state: The policy's memory.
        seconds: Time of the call with the conversion of its result [s].
    """

    action: Float32Array
    state: Any
    seconds: float


class Attempt:
    """A part of an episode whose exceptions are its failure: `with Attempt() as attempt: ...`.

    Args:
        passing: Exceptions that are not, and are raised as they are.

    Attributes:
        error: The exception on one line; None if there was none.
    """

    def __init__(self, *passing: type[BaseException]) -> None:
        self.error: str | None = None
        self._passing: tuple[type[BaseException], ...] = (KeyboardInterrupt, *passing)
        self._process: ProcessState | None = None

    def __enter__(self) -> Attempt:
        self._process = ProcessState()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        """Write an exception down, SystemExit too; let KeyboardInterrupt pass."""
        if self._process is not None:
            self._process.restore()
        if error is None or isinstance(error, self._passing):
            return False
        self.error = describe_error(error)
        return True


def ask(
    policy: BasePolicy, observation: Any, state: Any, starts: Any, *shapes: tuple[int, ...]
) -> Answer:
    """Ask a policy for actions, and check what it answers.

    Args:
        policy: The policy; it gets copies of the arrays, to keep or to write into.
        observation: Flat observation (o,), or a batch of them (B, o).
        state: What the last call returned; None at the start.
        starts: Which rows start an episode.
        shapes: Shapes that the action may have; it is returned in the first.

    Returns:
        The answer.

    Raises:
        AnswerError: It is no pair, or its first part no array of numbers of one of these shapes.
        ValueError: A number of it is not finite.
    """
    seen, first = np.array(observation), np.array(starts)
    with np.errstate():  # a policy may set what NumPy raises, for itself
        begin = perf_counter()
        answer = policy.predict(seen, state, first, True)
    if not isinstance(answer, tuple | list) or len(answer) != 2:
        raise AnswerError(
            f"predict returned {_said(answer)}; it must return a pair, the action and its memory "
            "(None if it keeps none)"
        )
    action, memory = answer
    # Numbers as they are and nothing else: text, objects and masks would be converted in silence.
    if type(action) is not np.ndarray:
        action = _array(action)
    if action.dtype.kind not in "iuf":
        raise AnswerError(f"predict returned {_said(action)} as its action; it must be numbers")
    single = action
    if action.dtype != np.float32:
        with np.errstate(over="ignore"):  # it is then not finite, which is said below
            single = action.astype(np.float32)
    seconds = perf_counter() - begin
    if single.shape not in shapes:
        raise AnswerError(
            f"predict answered observations of shape {seen.shape} by an action of shape "
            f"{single.shape}; it must be {' or '.join(map(str, dict.fromkeys(shapes)))}"
        )
    if not np.isfinite(single).all():
        at = np.flatnonzero(~np.isfinite(single.ravel()))[0]
        raise ValueError(f"predict returned an action that is not finite: {single.ravel()[at]}")
    # A copy: the policy may go on with its own array.
    return Answer(np.array(single).reshape(shapes[0]), memory, seconds)


def _array(action: Any) -> NDArray[Any]:
    if isinstance(action, np.ma.MaskedArray):
        raise AnswerError("predict returned a masked array as its action; it must be plain numbers")
    try:
        return np.asarray(action)
    except (ValueError, TypeError) as error:
        raise AnswerError(
            f"predict returned {_said(action)} as its action, which is no array: {error}"
        ) from None


def _said(answer: Any) -> str:
    """Return in a few words what was returned."""
    if isinstance(answer, np.ndarray):
        return f"an array of {answer.dtype} of shape {answer.shape}"
    if isinstance(answer, tuple | list):
        return f"a {type(answer).__name__} of {len(answer)} values"
    return "None" if answer is None else f"a value of type {type(answer).__name__}"


def raised_line(raised: Iterable[tuple[str, int, int]]) -> str:
    """Return what a command says at its end of the episodes that raised; "" if none did.

    Of each row are given the policy, how many episodes raised, and how many there were.
    """
    counts: dict[str, list[int]] = {}
    for name, count, total in raised:
        before = counts.setdefault(name, [0, 0])
        before[0] += count
        before[1] += total
    parts = [f"{name}: {count} of {total}" for name, (count, total) in counts.items() if count]
    if not parts:
        return ""
    return f"episodes raised and count as failures ({'; '.join(parts)}); exit status {RAISED}"
