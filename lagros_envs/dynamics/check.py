"""Tries an equation of motion on every kind of number and says what is wrong with it.

An equation that works on floats alone fails later, in a planner or a proof, with a message about
numbers that its author has never heard of. Here it fails first, in the author's words.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics.straight_line import straight_line
from lagros_envs.dynamics.system import System, components
from lagros_envs.numbers import TaylorModel, dual, exact, functions, monomials, variable
from lagros_envs.numbers.series import KinkError

_DRAWS = 16
# Half the width of the box around each state that intervals are tried on.
_WIDTH = 1e-6
# What rounding may make of two orders of the same sum, relative to its size.
_ROUNDING = 1e-9


def check_system(
    system: System, states: FloatArray | None = None, controls: FloatArray | None = None
) -> None:
    """Check a user's control-affine system: shapes, names, finiteness, and every kind of number.

    Args:
        system: The system.
        states: States to try it at, shape (k, n); 16 drawn from [-1, 1] if left out.
        controls: Controls to try it with, shape (k, m); drawn likewise.

    Raises:
        TypeError: Something that a system has is missing or of the wrong type.
        ValueError: The derivative is wrong; the message says where and what to write instead.
    """
    title = type(system).__name__
    n, m = (_dimension(system, title, name) for name in ("state_dim", "control_dim"))
    if not callable(getattr(system, "derivative", None)):
        raise TypeError(f"{title} has no derivative(state, control, functions): write one")
    _check_names(system, title, "state_names", n)
    _check_names(system, title, "control_names", m)
    rng = np.random.default_rng(0)
    states = rng.uniform(-1.0, 1.0, (_DRAWS, n)) if states is None else np.asarray(states, float)
    if controls is None:
        controls = rng.uniform(-1.0, 1.0, (len(states), m))
    if states.shape != (len(states), n) or controls.shape != (len(states), m):
        raise ValueError(
            f"states of shape {states.shape} and controls of shape {controls.shape} must be "
            f"(k, {n}) and (k, {m}), for the {n} states and {m} controls of {title}"
        )
    place = f"{title}.derivative"
    rates = np.array(
        [
            _at(system, place, state, control)
            for state, control in zip(states, controls, strict=True)
        ]
    )
    _check_arrays(system, place, states, controls, rates)
    _check_affine(system, place, states, controls, rates)
    _check_kinds(system, place, states, controls, rates)


def _dimension(system: Any, title: str, name: str) -> int:
    value = getattr(system, name, None)
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise TypeError(f"{title}.{name}={value!r} must be a whole number, 1 or more")
    return int(value)


def _check_names(system: Any, title: str, name: str, count: int) -> None:
    names = getattr(system, name, None)
    if names is None:
        return
    if isinstance(names, str) or not all(isinstance(one, str) and one for one in names):
        raise TypeError(f"{title}.{name}={names!r} must be a sequence of {count} names")
    if len(names) != count or len(set(names)) != count:
        raise ValueError(
            f"{title}.{name}={names!r} must be {count} different names, one for each entry"
        )


def _at(system: System, place: str, state: FloatArray, control: FloatArray) -> list[float]:
    """Return the rates at one state, in floats; nothing may change, and nothing may be random."""
    given: tuple[list[float], list[float]] = (state.tolist(), control.tolist())
    rates = _called(system, place, "floats", *given, functions)
    if given != (state.tolist(), control.tolist()):
        raise ValueError(
            f"{place} changes the state or control that it is given: unpack them into names of "
            "your own instead of assigning to their entries"
        )
    numbers = []
    for index, rate in enumerate(rates):
        if isinstance(rate, bool) or not isinstance(rate, float | int):
            raise ValueError(
                f"{place} returns {rate!r} as rate {index} of a state of floats; each rate must be "
                "one number"
            )
        if not np.isfinite(rate):
            raise ValueError(
                f"{place} returns {rate!r} as rate {index} at state={given[0]} and "
                f"control={given[1]}; check for a division by zero or a root of a negative number, "
                "or try it at states where it is meant to hold: check_system(system, states=...)"
            )
        numbers.append(float(rate))
    again = [float(rate) for rate in _called(system, place, "floats", *given, functions)]
    if again != numbers:
        raise ValueError(
            f"{place} gives two answers at one state, {numbers} and {again}: a system may use "
            "neither time nor random numbers nor a memory of its own"
        )
    return numbers


def _called(
    system: System,
    place: str,
    kind: str,
    state: Sequence[Any],
    control: Sequence[Any],
    namespace: Any,
) -> Sequence[Any]:
    """Return the rates, as many as there are states."""
    try:
        rates = system.derivative(state, control, namespace)
    except Exception as error:
        raise ValueError(
            f"{place} fails on {kind}: {type(error).__name__}: {error}. {_remedy(error)}"
        ) from error
    count = system.state_dim
    try:
        found = len(rates)
    except TypeError:
        found = -1
    if found != count:
        what = "no sequence" if found < 0 else f"{found} rates"
        raise ValueError(
            f"{place} returns {what} ({rates!r}); it must return {count}, one for each state"
        )
    return rates


def _remedy(error: Exception) -> str:
    text = str(error)
    if isinstance(error, AttributeError) and "functions" in text:
        return "Of functions there are sin, cos, tan, exp and sqrt"
    if "unpack" in text or "out of range" in text:
        return "Check how many states and controls it unpacks against state_dim and control_dim"
    if "branch" in text or "supported between" in text or "truth value" in text:
        return (
            "It must not compare or branch on the state (no if, min, max): one formula has to hold "
            "everywhere"
        )
    return (
        "Use + - * / and integer powers, abs, and functions.sin, .cos, .tan, .exp, .sqrt alone: "
        "neither math nor numpy of its own, no arrays, no float()"
    )


def _check_arrays(
    system: System, place: str, states: FloatArray, controls: FloatArray, rates: FloatArray
) -> None:
    kind = "arrays (a batch of states)"
    found = _called(system, place, kind, components(states), components(controls), np)
    for index, rate in enumerate(found):
        array = np.asarray(rate)
        if array.shape not in ((), (len(states),)):
            raise ValueError(
                f"{place} returns an array of shape {array.shape} as rate {index} of a batch of "
                f"{len(states)} states: work on each coordinate alone, without sums over arrays"
            )
        _compare(place, kind, index, np.broadcast_to(array, (len(states),)), rates[:, index])


def _compare(place: str, kind: str, index: int, found: FloatArray, wanted: FloatArray) -> None:
    room = _ROUNDING * (1.0 + np.abs(wanted))
    if not np.all(np.abs(found - wanted) <= room):
        worst = int(np.argmax(np.abs(found - wanted)))
        raise ValueError(
            f"{place} gives {found[worst]:.6g} as rate {index} on {kind} and {wanted[worst]:.6g} "
            "on floats: one formula has to hold for every kind of number"
        )


def _check_affine(
    system: System, place: str, states: FloatArray, controls: FloatArray, rates: FloatArray
) -> None:
    """f(x) + B(x) u at u, -u and 2u: the mean of the first two is f, the third continues them."""
    for state, control, here in zip(states, controls, rates, strict=True):
        other = np.array(_at(system, place, state, -control))
        double = np.array(_at(system, place, state, 2.0 * control))
        drift, push = 0.5 * (here + other), 0.5 * (here - other)
        still = np.array(_at(system, place, state, 0.0 * control))
        size = 1.0 + np.abs(here) + np.abs(double)
        wrong = np.maximum(np.abs(drift - still), np.abs(drift + 2.0 * push - double)) / size
        if wrong.max() > _ROUNDING:
            raise ValueError(
                f"{place} is not affine in the control: rate {int(np.argmax(wrong))} is not "
                "f(x) + B(x) u. Make the control a state and its rate the new control"
            )


def _check_kinds(
    system: System, place: str, states: FloatArray, controls: FloatArray, rates: FloatArray
) -> None:
    """Duals, intervals, series, Taylor models and recorded numbers."""
    n, m = system.state_dim, system.control_dim
    parts = components(states) + components(controls)
    seeds = dual.seed(parts)
    kinds: dict[str, Callable[[], Sequence[Any]]] = {
        "dual numbers (which give the Jacobian)": lambda: seeds,
        "intervals (which give proofs)": lambda: [
            exact(part) + exact([-_WIDTH, _WIDTH])[..., :1] for part in parts
        ],
        "series (which give higher derivatives)": lambda: [
            variable(exact(part), 1) for part in parts
        ],
        "Taylor models (which give tubes)": lambda: [_around(part) for part in parts],
    }
    for kind, numbers in kinds.items():
        given = numbers()
        try:
            found = _called(system, place, kind, given[:n], given[n:], functions)
        except ValueError as error:
            if isinstance(error.__cause__, KinkError):
                continue  # abs at zero: it flies and plans, and a proof over zero says so
            raise
        for index, rate in enumerate(found):
            middle = np.broadcast_to(_middle(rate), (len(states),))
            if not np.all(np.isfinite(middle)):
                raise ValueError(f"{place} gives a rate {index} that is not finite on {kind}")
    kind = "recorded numbers (which give fast and exported code)"

    def recorded(numbers: Sequence[Any]) -> Sequence[Any]:
        return _called(system, place, kind, numbers[:n], numbers[n:], functions)

    try:
        straight_line(recorded, [f"v{index}" for index in range(n + m)])
    except TypeError as error:
        raise ValueError(f"{place} fails on {kind}: {error}. {_remedy(error)}") from error
    slopes = dual.gradients(
        list(system.derivative(seeds[:n], seeds[n:], functions)), n + m, (len(states),)
    )
    _check_slopes(system, place, states, controls, slopes)


def _around(places: FloatArray) -> TaylorModel:
    """Return numbers that all move by one variable, a little."""
    kept = monomials(1, 0, 0)
    parts = np.zeros((kept.count, len(places)))
    parts[0], parts[1] = places, _WIDTH
    return TaylorModel(kept, parts, np.zeros(len(places)))


def _middle(rate: Any) -> Any:
    """Return the value of a number of any kind."""
    for name in ("value", "midpoint"):
        if hasattr(rate, name):
            return _middle(getattr(rate, name))
    return _middle(rate.parts[0]) if hasattr(rate, "parts") else rate


def _check_slopes(
    system: System, place: str, states: FloatArray, controls: FloatArray, slopes: FloatArray
) -> None:
    """The Jacobian of the duals against central differences: a value taken out of a dual shows."""
    n = system.state_dim
    joint = np.concatenate([states, controls], axis=1)
    step = 1e-6
    for column in range(joint.shape[1]):
        ends = []
        for sign in (1.0, -1.0):
            moved = joint.copy()
            moved[:, column] += sign * step
            ends.append(
                np.array(
                    [
                        np.broadcast_to(rate, len(states))
                        for rate in system.derivative(
                            components(moved[:, :n]), components(moved[:, n:]), np
                        )
                    ]
                )
            )
        difference = (ends[0] - ends[1]).T / (2.0 * step)
        size = 1.0 + np.abs(difference) + np.abs(slopes).max()
        wrong = np.abs(difference - slopes[..., column]) / size
        if wrong.max() > 1e-4:
            index = int(np.argmax(wrong.max(axis=0)))
            raise ValueError(
                f"{place} has a wrong derivative: rate {index} by entry {column} of state and "
                "control. It takes a value out of the numbers (float(), .value, a table), or it "
                "jumps or bends there"
            )
