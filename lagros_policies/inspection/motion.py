"""Whether an equation of motion is what its author says: names and units, energy, mirror, hold."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.dynamics import hold_step, jacobian, vector_field
from lagros_envs.dynamics.integrate import SUBSTEPS
from lagros_envs.dynamics.invariants import ROUNDING, energy_balance, mirror_signs, mirrored
from lagros_envs.task import Scenario, Task
from lagros_policies.inspection.finding import Finding

_DRAWN = 32  # states around each end of a scenario
_FINE = 64  # substeps by which four are judged
# Error of one hold, in scales, from which it is felt, and from which it spoils a flight. Controls
# are drawn within all of their limits, most of which no flight uses.
_ROUGH, _STIFF = 5e-3, 0.1
_DEGREES = ("deg", "degree", "degrees", "°")
# Units that are compared: others may be the same in other words, as N/kg and m/s^2 are.
_KINEMATIC = re.compile(r"(1|rad|m|mm|cm|km|-)(/(s|min|h)(\^\d)?)?")


def state_names(task: Task) -> list[str]:
    """Return the names of the coordinates without their units."""
    names = task.state_names or tuple(f"x{index}" for index in range(task.system.state_dim))
    return [_parted(name)[0] for name in names]


def control_names(task: Task) -> list[str]:
    """Return the names of the controls without their units."""
    names = task.control_names or tuple(f"u{index}" for index in range(task.system.control_dim))
    return [_parted(name)[0] for name in names]


def scales(task: Task) -> FloatArray:
    """Return how far each coordinate typically moves, shape (n,)."""
    return np.array(task.state_scale or (1.0,) * task.system.state_dim)


def control_range(task: Task) -> tuple[FloatArray, FloatArray]:
    """Return the limits of the controls or, where there are none, what actions of one reach."""
    centre, scale = np.array(task.control_centre), np.array(task.control_scale)
    low, high = np.array(task.control_low), np.array(task.control_high)
    low = np.where(np.isfinite(low), low, centre - scale)
    return low, np.where(np.isfinite(high), high, centre + scale)


def drawn_places(
    task: Task, scenarios: Sequence[Scenario], rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw controls, and states about the ends of scenarios, within a scale and plans' bounds.

    Returns:
        States (k, n) and controls (k, m).
    """
    ends = np.array([[one.initial_state, one.goal] for one in scenarios]).reshape(
        -1, task.system.state_dim
    )
    states = np.repeat(ends, _DRAWN, axis=0)
    states = states + scales(task) * rng.uniform(-1.0, 1.0, states.shape)
    if task.state_low:
        states = np.maximum(states, task.state_low)
    if task.state_high:
        states = np.minimum(states, task.state_high)
    low, high = control_range(task)
    return states, rng.uniform(low, high, (len(states), task.system.control_dim))


def of_names(task: Task, states: FloatArray, controls: FloatArray) -> list[Finding]:
    """Look at names and units, also against the equation: what is the rate of what."""
    n, m = task.system.state_dim, task.system.control_dim
    missing = [name for name in ("state_names", "control_names") if not getattr(task, name)]
    if missing:
        return [
            Finding(
                "names and units",
                "warning",
                f"{n} states and {m} controls without {' and '.join(missing)}: they appear as x0, "
                "u0 and so on, and no unit can be looked at",
                'write state_names = ("theta [rad]", ...) and control_names = ("force [N]", ...)',
            )
        ]
    named = [*map(_parted, task.state_names), *map(_parted, task.control_names)]
    for name, unit in named:
        if unit in _DEGREES:
            return [
                Finding(
                    "names and units",
                    "warning",
                    f"{name} is in degrees, and functions.sin and .cos take radians",
                    f"use radians in the equation, and write {name} [rad]",
                )
            ]
    for index, source in _copies(task, states, controls):
        (name, unit), (other, other_unit) = named[index], named[source]
        if _KINEMATIC.fullmatch(_plain(other_unit)) and _differ(_rate_unit(unit), other_unit):
            return [
                Finding(
                    "names and units",
                    "warning",
                    f"the equation says d{name}/dt = {other}, so {other} is in "
                    f"{_rate_unit(unit)}, and not in {other_unit}",
                    f"write {other} [{_rate_unit(unit)}], or convert it in the equation",
                )
            ]
    return [Finding("names and units", "ok", f"{n} states and {m} controls, with their units")]


def of_energy(task: Task, states: FloatArray) -> list[Finding]:
    """Hold the energy that a system states, if any, against its equation."""
    system = task.system
    if getattr(system, "energy", None) is None:
        return []
    falls = bool(getattr(system, "dissipates", False))
    try:
        balance = energy_balance(system, states)
    except ValueError as error:
        return [Finding("energy", "fault", str(error), "write energy like the equation")]
    room = ROUNDING * (balance.size + balance.size.max())
    wrong = balance.rate > room if falls else np.abs(balance.rate) > room
    if not np.any(wrong):
        what = "never rises" if falls else "is conserved"
        return [Finding("energy", "ok", f"with u = d = 0 it {what}, at {len(states)} states")]
    worst = int(np.argmax(np.where(wrong, np.abs(balance.rate), -np.inf)))
    place = ", ".join(
        f"{name} = {value:.3g}"
        for name, value in zip(state_names(task), states[worst], strict=True)
    )
    remedy = "look for a wrong sign or a missing term in derivative, or in energy itself"
    if not falls and np.all(balance.rate <= room):
        remedy = "it only falls: with friction say dissipates = True in the system; else " + remedy
    return [
        Finding(
            "energy",
            "fault",
            f"with u = d = 0 it changes by {balance.rate[worst]:.3g} per second at {place}",
            remedy,
        )
    ]


def of_mirror(task: Task, states: FloatArray, controls: FloatArray) -> list[Finding]:
    """Hold the mirror symmetry that a system states, if any, against its equation."""
    system = task.system
    if getattr(system, "mirror", None) is None:
        return []
    try:
        mirror_signs(system)
    except ValueError as error:
        return [Finding("mirror", "fault", str(error), "give signs alone, 1 or -1")]
    off = np.abs(mirrored(system, states, controls))
    room = ROUNDING * (1.0 + np.abs(vector_field(system, states, controls)))
    if np.all(off <= room):
        return [Finding("mirror", "ok", "the mirror image of a motion is a motion")]
    index = int(np.argmax((off / room).max(axis=0)))
    return [
        Finding(
            "mirror",
            "fault",
            f"the mirror image has another d{state_names(task)[index]}/dt, by up to "
            f"{off[:, index].max():.3g}",
            "look for a wrong sign in that rate, or correct the signs of mirror",
        )
    ]


def of_hold(task: Task, states: FloatArray, controls: FloatArray) -> Finding:
    """Compare the held step of the environments with one of many more substeps."""
    period, scale = task.control_period, scales(task)
    with np.errstate(all="ignore"):
        coarse = hold_step(task.system, states, controls, period)
        fine = hold_step(task.system, states, controls, period, substeps=_FINE)
        off = np.abs(coarse - fine) / scale
    off = np.where(np.isfinite(off), off, np.inf)
    worst = float(off.max())
    name = state_names(task)[int(np.argmax(off.max(axis=0)))]
    text = (
        f"a step of {period:g} s by {SUBSTEPS} Runge-Kutta steps is off by up to {worst:.2g} of "
        f"the scale of {name}"
    )
    remedy = (
        f"shorten control_period (to {period / 4.0:g} s, say), or leave out what settles faster "
        "than that"
    )
    if worst > _STIFF:
        return Finding("hold", "fault", text, remedy)
    if worst > _ROUGH:
        return Finding("hold", "warning", text, remedy)
    return Finding("hold", "ok", text)


def _copies(task: Task, states: FloatArray, controls: FloatArray) -> list[tuple[int, int]]:
    """Return which rates are a coordinate or a control as it is: pairs of places in (x, u)."""
    n = task.system.state_dim
    slopes = np.concatenate(jacobian(task.system, states, controls), axis=-1)
    rates = vector_field(task.system, states, controls)
    values = np.concatenate([states, controls], axis=-1)
    found = []
    for index in range(n):
        first = slopes[0, index]
        if np.count_nonzero(first) == 1 and np.all(slopes[:, index] == first):
            source = int(np.argmax(first))
            if first[source] == 1.0 and np.allclose(rates[:, index], values[:, source]):
                found.append((index, source))
    return found


def _parted(name: str) -> tuple[str, str]:
    """Return name and unit of a text such as "theta [rad]"."""
    first, _, rest = name.partition("[")
    return first.strip(), rest.rstrip("]").strip()


def _plain(unit: str) -> str:
    """Return a unit as it is compared: "m/s²" is "m/s^2"."""
    return unit.replace("²", "^2").replace("³", "^3").replace(" ", "")


def _differ(unit: str, other: str) -> bool:
    """Return whether two units differ; a radian is a one."""
    first, second = (re.sub(r"^(rad|-)", "1", _plain(one)) for one in (unit, other))
    return first != second


def _rate_unit(unit: str) -> str:
    """Return the unit of a rate."""
    found = re.fullmatch(r"(.+)/s(?:\^(\d))?", _plain(unit))
    if found:
        return f"{found[1]}/s^{int(found[2] or 1) + 1}"
    return f"{'1' if unit == '-' else _plain(unit)}/s"
