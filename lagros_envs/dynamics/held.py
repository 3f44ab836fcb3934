"""The control step of an environment: `rk4_hold` of a system, recorded once and run many times."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache, partial
from typing import Any, cast

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_flag
from lagros_envs.dynamics.integrate import SUBSTEPS
from lagros_envs.dynamics.straight_line import (
    ArrayFunction,
    Measure,
    recorded_hold,
    recorded_measure,
    scalar_source,
    straight_line,
)
from lagros_envs.dynamics.system import System

# From x, u, d and what is given, sequences of floats, to x at the end and what is measured there.
FloatStep = Callable[..., tuple[tuple[float, ...], tuple[Any, ...]]]


class HeldStep:
    """`rk4_hold` on floats, several times faster and equal to it bit for bit.

    Args:
        system: The system.
        duration: Length of the control step [s].
        compiled: Whether numba compiles it.
        measure: Computes more from the state at the end, see `straight_line.recorded_hold`.
        given: How many numbers the measure is given.
        pushed: Whether there is a disturbance; it costs a tenth of the step.

    Attributes:
        run: From x, u, d (if there is one) and what is given (if anything is), sequences of
            floats, to x at the end and what the measure computed. It raises ValueError for the
            sine of an infinity, or returns nan where it is compiled.

    Raises:
        ValueError: `compiled` is none of these.
        ImportError: `compiled` was asked for and numba is not installed.
    """

    def __init__(
        self,
        system: System,
        duration: float,
        compiled: bool = False,
        measure: Measure | None = None,
        given: int = 0,
        pushed: bool = True,
    ) -> None:
        """Record the step."""
        check_flag("compiled", compiled)
        self._made_from = system, duration, compiled, measure, given, pushed
        self.run: FloatStep = _float_step(
            cast(Hashable, system), duration, compiled, cast(Hashable, measure), given, pushed
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the step is made from: a recorded function has no name to be found by."""
        return HeldStep, self._made_from


class OnFloats:
    """A function of several groups of numbers, recorded and written out for floats.

    Args:
        function: From the groups to its results; not more of these than numbers.
        sizes: How many numbers each group has, by a letter.

    Attributes:
        run: From the groups, sequences of floats, to the results and an empty tuple.
    """

    def __init__(self, function: Callable[..., Sequence[Any]], **sizes: int) -> None:
        """Record the function."""
        self._made_from = function, sizes
        ends = list(itertools.accumulate(sizes.values(), initial=0))
        names = [f"{letter}{k}" for letter, size in sizes.items() for k in range(size)]

        def flat(numbers: Sequence[Any]) -> Sequence[Any]:
            return function(*(numbers[one:two] for one, two in itertools.pairwise(ends)))

        self.run = float_function(scalar_source(straight_line(flat, names), 1, grouped=True))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what it is made from, as `HeldStep` does."""
        function, sizes = self._made_from
        return partial(OnFloats, function, **sizes), ()


class HeldBatch:
    """`rk4_hold` on arrays of a fixed shape.

    In NumPy it equals `hold_step` bit for bit. Compiled it is ten times faster and may differ in
    the last digits: its sine and cosine are polynomials, and products and sums are fused.

    Args:
        system: The system.
        duration: Length of the step [s].
        shape: Shape of the batch.
        compiled: Whether numba compiles it; None: where it is installed.
        substeps: Runge-Kutta steps in the step.
        measure: Computes more from the state at the end, see `straight_line.recorded_hold`.
        given: Number of arrays that the measure is given.
        pushed: As in `HeldStep`.

    Attributes:
        compiled: Whether it is compiled.
        measured: What the measure computed in the last call, shape (measured, *shape).

    Raises:
        ValueError: `compiled` is none of these.
        ImportError: `compiled` was asked for and numba is not installed.
    """

    def __init__(
        self,
        system: System,
        duration: float,
        shape: tuple[int, ...],
        compiled: bool | None = False,
        substeps: int = SUBSTEPS,
        measure: Measure | None = None,
        given: int = 0,
        pushed: bool = True,
    ) -> None:
        """Record the step and allocate its buffers."""
        if compiled is not None:
            check_flag("compiled", compiled, "or None for wherever numba is installed")
        self._made_from = system, duration, shape, compiled, substeps, measure, given, pushed
        n, m = system.state_dim, system.control_dim
        self._ends = n, n + m, n + m + (n if pushed else 0)
        self._run: Callable[[], Any]
        self.compiled = has_numba() if compiled is None else compiled
        if self.compiled:
            from lagros_envs.dynamics.compiled import CompiledBatch

            batch = CompiledBatch(system, duration, shape, substeps, measure, given, pushed)
            self._run, self._inputs = batch, batch.inputs
            self._states, self.measured = batch.states, batch.measured
        else:
            step = recorded_hold(
                system, duration, substeps, measure=measure, given=given, pushed=pushed
            )
            function = ArrayFunction(step, shape)
            # An enormous force overflows; the environments look at what comes out.
            self._run = np.errstate(over="ignore", invalid="ignore")(function)
            self._inputs = function.inputs
            self._states, self.measured = function.outputs[:n], function.outputs[n:]

    def __call__(
        self,
        state: FloatArray | Sequence[FloatArray],
        control: FloatArray | Sequence[FloatArray],
        push: FloatArray | Sequence[FloatArray] = (),
        given: FloatArray | Sequence[FloatArray] = (),
    ) -> FloatArray:
        """Advance the batch.

        Args:
            state: x, one array of the batch's shape for each coordinate.
            control: u, the same for each control.
            push: d, the same for each coordinate, in units of the state per second; not looked at
                where there is none.
            given: What the measure is given.

        Returns:
            x at the end, shape (n, *shape); the next call overwrites it.
        """
        first, second, third = self._ends
        inputs = self._inputs
        inputs[:first] = state
        inputs[first:second] = control
        if third > second:
            inputs[second:third] = push
        if len(given):
            inputs[third:] = given
        self._run()
        return self._states

    def go_on(self, state: FloatArray) -> FloatArray:
        """Advance the batch once more from a state, under the same control and push."""
        self._inputs[: self._ends[0]] = state
        self._run()
        return self._states

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the step is made from, not its buffers."""
        return HeldBatch, self._made_from


@lru_cache(maxsize=1)
def has_numba() -> bool:
    """Return whether numba can be imported: it refuses versions of NumPy that it does not know."""
    try:
        import numba  # noqa: F401
    except ImportError:
        return False
    return True


@lru_cache(maxsize=32)
def _float_step(
    system: Any, duration: float, compiled: bool, measure: Any, given: int, pushed: bool
) -> FloatStep:
    tail = None if measure is None else recorded_measure(system, measure, given)
    step = recorded_hold(system, duration / SUBSTEPS, 1, pushed=pushed)
    source = scalar_source(step, SUBSTEPS, tail, grouped=True)
    if compiled:
        from lagros_envs.dynamics.compiled import compiled_function

        function = compiled_function(source)
        # Lists are slow to get into what numba has compiled.
        return lambda *groups: cast(Any, function(*map(tuple, groups)))
    return float_function(source)


def float_function(source: str) -> FloatStep:
    """Return the function of a module that `straight_line.scalar_source` has written."""
    # Our own text: operators, the names of the inputs, and the numbers of the system.
    namespace: dict[str, Any] = {}
    exec(compile(source, "<held step>", "exec"), namespace)
    return cast(FloatStep, namespace["held"])
