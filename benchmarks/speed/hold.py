"""The control step of an environment, run in every way that it can be, from the same physics."""

from __future__ import annotations

import importlib.util
import math

import numpy as np
from numpy.typing import NDArray

from lagros_envs.dynamics import hold_step
from lagros_envs.dynamics.held import HeldBatch, HeldStep
from lagros_envs.dynamics.integrate import SUBSTEPS, rk4_hold
from lagros_envs.dynamics.straight_line import recorded_hold
from lagros_envs.dynamics.system import System
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.spacecraft.physics import Spacecraft
from speed.report import Row, Section, timed_row
from speed.timing import Candidate, Scale, interleave

FloatArray = NDArray[np.float64]

_DURATION = 0.1  # [s]
_NUMBA = importlib.util.find_spec("numba") is not None


def sections(scale: Scale) -> list[Section]:
    """Measure and return the table."""
    body = Spacecraft().by_wrench
    return [
        Section(
            "The equation of motion over a control step of four Runge-Kutta substeps",
            [
                *_floats(scale),
                *_arrays("cart-pole", CartPole(), scale),
                *_arrays("spacecraft", body, scale),
            ],
            notes=[
                f"Arrays of {scale.worlds:,} states. Each ratio is to calling the function. "
                "'One group': eight worlds at a time where the processor takes eight doubles."
            ],
        )
    ]


def _floats(scale: Scale) -> list[Row]:
    system = CartPole()
    numbers = [0.1, 0.2, -0.3, 0.4, 5.0, 0.1, -0.2, 0.3, 0.1]
    state, control, push = numbers[:4], numbers[4:5], numbers[5:]
    candidates: dict[str, Candidate] = {
        "called": lambda _: rk4_hold(system, state, control, push, _DURATION, math)
    }
    grouped = tuple(state), tuple(control), tuple(push)
    ways = {"recorded": False} | ({"compiled": True} if _NUMBA else {})
    for name, compiled in ways.items():
        run = HeldStep(system, _DURATION, compiled).run
        candidates[name] = lambda _, run=run: run(*grouped)
    return _rows("cart-pole, floats", candidates, scale)


def _arrays(label: str, system: System, scale: Scale) -> list[Row]:
    n, m = system.state_dim, system.control_dim
    numbers = np.random.default_rng(0).uniform(-1.0, 1.0, (n + m + n, scale.worlds))
    parts = numbers[:n], numbers[n : n + m], numbers[n + m :]
    state, control, push = (np.ascontiguousarray(part.T) for part in parts)
    candidates: dict[str, Candidate] = {
        "called": lambda _: hold_step(system, state, control, _DURATION, push)
    }
    batch = HeldBatch(system, _DURATION, (scale.worlds,))
    candidates["recorded"] = lambda _: batch(*parts)
    if _NUMBA:
        candidates |= _compiled(system, numbers)
    return _rows(f"{label}, arrays", candidates, scale)


def _compiled(system: System, numbers: FloatArray) -> dict[str, Candidate]:
    from lagros_envs.dynamics.compiled import (
        BLOCK,
        VectorFunctions,
        batch_source,
        compiled_function,
    )

    count = numbers.shape[1]
    step = recorded_hold(system, _DURATION / SUBSTEPS, 1, VectorFunctions)

    def advancing(abreast: int) -> Candidate:
        held = compiled_function(batch_source(step, SUBSTEPS, abreast=abreast), fuse=True)
        # Whole blocks of columns, as `CompiledBatch` makes them.
        rows = np.zeros((len(numbers), count + -count % BLOCK))

        def advance(_: int) -> None:
            rows[:, :count] = numbers
            held(rows)

        return advance

    return {"compiled, one group": advancing(1), "compiled, two groups abreast": advancing(2)}


def _rows(label: str, candidates: dict[str, Candidate], scale: Scale) -> list[Row]:
    times = interleave(candidates, scale.rounds, scale.calls // 10 or 1)
    return [timed_row(f"{label}: {name}", taken, times["called"]) for name, taken in times.items()]
