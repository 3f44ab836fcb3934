"""How the state of an environment is read and set: two methods, and the adapters that are shipped.

An adapter is given the environment beneath all wrappers (`env.unwrapped`) and keeps nothing of it.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import is_number, shown


class Adapter(Protocol):
    """All that a disturbance asks of an environment.

    Two more methods may stand beside them: `period(env)`, its control step [s], and `rates(env)`,
    which coordinates are rates, a boolean each, for `channels="rates"`.
    """

    def state(self, env: Any, /) -> FloatArray:
        """Return the state x, shape (n,); or that of k bodies, (k, n), each with a d of its own."""
        ...

    def set_state(self, env: Any, state: FloatArray, /) -> None:
        """Set the state, of the shape that `state` returns."""
        ...


class StateAttribute:
    """An environment whose attribute `state` is the state and nothing else is: classic control.

    The control step is its attribute `dt` or `tau`.
    """

    @staticmethod
    def fits(env: Any) -> bool:
        """Return whether there is such an attribute, of a few numbers."""
        state = getattr(env, "state", None)
        return (
            isinstance(state, np.ndarray | list | tuple)
            and np.ndim(state) in (1, 2)
            and np.asarray(state).dtype.kind == "f"
        )

    def state(self, env: Any) -> FloatArray:
        """Return the attribute."""
        return np.array(env.state, np.float64)

    def set_state(self, env: Any, state: FloatArray) -> None:
        """Set the attribute, as the kind of sequence that it is."""
        before = env.state
        if isinstance(before, np.ndarray):
            env.state = state.astype(before.dtype)
        else:
            env.state = type(before)(state.tolist())


class Mujoco:
    """An environment of MuJoCo: x = (qpos, qvel); joint velocities are the rates.

    Contacts, actuators and warm starts are left as they are.
    """

    @staticmethod
    def fits(env: Any) -> bool:
        """Return whether it has MuJoCo's data, and Gymnasium's way to set them."""
        data = getattr(env, "data", None)
        return hasattr(data, "qpos") and hasattr(data, "qvel") and hasattr(env, "set_state")

    def state(self, env: Any) -> FloatArray:
        """Return positions and velocities of the joints."""
        return np.concatenate([env.data.qpos, env.data.qvel])

    def set_state(self, env: Any, state: FloatArray) -> None:
        """Set them.

        Raises:
            ValueError: A position would move that is part of a quaternion, for which adding has no
                meaning.
        """
        count = len(env.data.qpos)
        turns = count != len(env.data.qvel)
        if turns and not np.array_equal(state[:count], env.data.qpos):
            raise ValueError(
                "some positions of this model are quaternions, which cannot be pushed by adding: "
                'pass channels="rates" (--channels rates), or a mask of your own'
            )
        env.set_state(state[:count], state[count:])

    def period(self, env: Any) -> float:
        """Return the control step, that of the simulation times the frames skipped [s]."""
        return float(env.dt)

    def rates(self, env: Any) -> Sequence[bool]:
        """Return which coordinates are velocities."""
        return [False] * len(env.data.qpos) + [True] * len(env.data.qvel)


class Particles:
    """Worlds of MPE and VMAS: a row for each agent, its positions, then its velocities.

    A row of VMAS is (x, y, angle, vx, vy, rate of the angle), of a simulation of one world.
    """

    _PARTS = (("p_pos", "p_vel"), ("pos", "rot", "vel", "ang_vel"))

    @classmethod
    def fits(cls, env: Any) -> bool:
        """Return whether it is such a world, and a single one."""
        agents: Any = getattr(getattr(env, "world", None), "agents", None)
        return bool(agents) and any(hasattr(agents[0].state, parts[0]) for parts in cls._PARTS)

    def state(self, env: Any) -> FloatArray:
        """Return the agents' rows."""
        agents = env.world.agents
        return np.stack([np.concatenate(self._values(agent)) for agent in agents])

    def set_state(self, env: Any, state: FloatArray) -> None:
        """Set them."""
        for agent, row in zip(env.world.agents, state, strict=True):
            begin = 0
            for name, value in zip(self._parts(agent), self._values(agent), strict=True):
                part, begin = row[begin : begin + len(value)], begin + len(value)
                now = getattr(agent.state, name)
                tensor = hasattr(now, "new_tensor")
                setattr(agent.state, name, now.new_tensor(part[None]) if tensor else part)

    def period(self, env: Any) -> float:
        """Return the control step [s]."""
        return float(env.world.dt)

    def rates(self, env: Any) -> Sequence[bool]:
        """Return which coordinates are velocities."""
        agent = env.world.agents[0]
        sizes = zip(self._parts(agent), self._values(agent), strict=True)
        return [name.endswith("vel") for name, value in sizes for _ in value]

    def _parts(self, agent: Any) -> tuple[str, ...]:
        return next(parts for parts in self._PARTS if hasattr(agent.state, parts[0]))

    def _values(self, agent: Any) -> list[FloatArray]:
        """Return the parts as vectors; of VMAS those of the one world that there may be."""
        parts = (getattr(agent.state, name) for name in self._parts(agent))
        # A tensor does not take a type and a copy at once.
        values = [np.asarray(part).astype(np.float64) for part in parts]
        if any(value.ndim == 2 and len(value) != 1 for value in values):
            raise ValueError(
                "this simulation runs several worlds at once; a disturbance is for one: make it "
                "with num_envs=1"
            )
        return [value.reshape(-1) for value in values]


_SHIPPED: tuple[Any, ...] = (Mujoco, Particles, StateAttribute)


def given_adapter(given: Any) -> Adapter:
    """Return the adapter of a user's own.

    Args:
        given: An object with the two methods, or "module:Class", which is imported and made.

    Raises:
        TypeError: It lacks one of them.
        ValueError: There is no such class.
    """
    if isinstance(given, str):
        module, _, name = given.partition(":")
        try:
            given = getattr(importlib.import_module(module), name)()
        except (ImportError, AttributeError, ValueError) as error:
            raise ValueError(f"adapter={shown(given)}: {error}; write module:Class") from error
    missing = [name for name in ("state", "set_state") if not callable(getattr(given, name, None))]
    if missing or isinstance(given, type):
        what = f"the class {given.__name__}" if isinstance(given, type) else shown(given)
        raise TypeError(
            f"adapter={what} must be an object with the methods state(env) and "
            f"set_state(env, state){'; it has no ' + ' and no '.join(missing) if missing else ''}"
        )
    adapter: Adapter = given
    return adapter


def adapter_for(env: Any) -> Adapter:
    """Return the shipped adapter of an environment that has been reset.

    Raises:
        TypeError: There is none.
    """
    for kind in _SHIPPED:
        if kind.fits(env):
            adapter: Adapter = kind()
            return adapter
    raise TypeError(
        f"no adapter knows how to read and set the state of {type(env).__name__}: it has neither "
        "an attribute `state` of numbers, nor MuJoCo's data, nor a world of particles; pass "
        "adapter=, an object with state(env) and set_state(env, state)"
    )


def period_of(adapter: Adapter, env: Any) -> float:
    """Return the control step of an environment [s].

    Raises:
        ValueError: Neither adapter nor environment tells.
    """
    own = getattr(adapter, "period", None)
    found = own(env) if own else getattr(env, "dt", getattr(env, "tau", None))
    if not is_number(found) or not 0.0 < found < np.inf:
        raise ValueError(
            f"{type(env).__name__} does not say how long a control step is: pass period=, in "
            "seconds; 1.0 makes the disturbance one per step"
        )
    return float(found)
