"""What the benchmark asks of `lagros_policies`, and the one place where it asks.

Everything is imported when it is called: the command line must start at once, and a worker process
imports only what its chunk needs.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.run.process import undone
from lagros_benchmarks.tasks.spacecraft.claims import position_margin

FloatArray = NDArray[np.float64]
Environment = gym.Env[Any, Any]

_LONGEST_TEXT = 500


def describe_error(error: BaseException) -> str:
    """Return the type and the text of an exception on one line that any terminal can print."""
    try:
        text = str(error)
    except Exception:  # __str__ is the stranger's, too
        text = "(its text cannot be read)"
    text = " ".join(text.encode("utf-8", "backslashreplace").decode().split())
    text = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
    if len(text) > _LONGEST_TEXT:
        text = f"{text[:_LONGEST_TEXT]}…"
    return f"{type(error).__name__}: {text}"


class SetupError(Exception):
    """A run cannot begin: a policy, the planner or the metric cannot be built, or cannot run."""

    @classmethod
    def building(cls, what: str, error: BaseException) -> SetupError:
        """Return the error of something that cannot be built; its name is said once.

        Args:
            what: What was built, "policy 'mine:Lean'" for instance.
            error: What that has raised.
        """
        text = describe_error(error)
        own = text.partition(": ")[2] if isinstance(error, ValueError) else ""
        return cls(own if own.startswith(what) else f"{what} cannot be built: {text}")


# What a policy may have beside `predict`.
_OPTIONAL = ("name", "observes", "policy", "reseed", "counters", "bare_forward", "example_features")


def check_observes(what: str, policy: Any) -> None:
    """Check that a policy says rightly what it is fed, where it says it, and what it has.

    Args:
        what: As for `SetupError.building`.
        policy: The policy.

    Raises:
        SetupError: It does not.
    """
    with building(what):
        for name in _OPTIONAL:
            getattr(policy, name, None)  # a property may raise
        observes = getattr(policy, "observes", "local")
        if observes not in ("local", "global"):
            raise SetupError(f'{what} has observes={observes!r}; it must be "local" or "global"')


@contextmanager
def building(what: str) -> Iterator[None]:
    """Turn whatever the constructor of a stranger raises, SystemExit too, into a `SetupError`.

    Args:
        what: As for `SetupError.building`.

    Raises:
        SetupError: Something was raised.
    """
    try:
        with undone():  # where a constructor goes, it goes for itself
            yield
    except (KeyboardInterrupt, SetupError):
        raise
    except BaseException as error:
        raise SetupError.building(what, error) from error


class Policy(Protocol):
    """What an episode needs of a policy: `predict` of stable-baselines3's protocol.

    A policy may also have `counters(state) -> dict[str, int]`, `reseed(generator)` for what it
    draws itself, and a `BareNetwork`. One of the spacecraft says by `observes` whether it is fed
    the rows of all agents ("local") or `state()` of all worlds ("global").
    """

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Return the action and the policy's state."""
        ...


@runtime_checkable
class BareNetwork(Protocol):
    """What a policy has whose network can be timed alone."""

    def bare_forward(self, features: Any) -> Any:
        """Evaluate the network."""
        ...

    def example_features(self) -> Any:
        """Return an input of it."""
        ...


class Plan(Protocol):
    """A planned trajectory: `states` (N + 1, n), whether it is `solved`, and its `defect`."""

    @property
    def states(self) -> Any:
        """x_d at every control instant, shape (N + 1, n)."""
        ...

    @property
    def solved(self) -> bool:
        """Whether the planner vouches for it."""
        ...

    @property
    def defect(self) -> float:
        """The largest violation of the dynamics, in units of the state."""
        ...


class Planner(Protocol):
    """Plans an episode from its start to its goal."""

    def plan(self, initial_state: Any, goal: Any) -> Plan:
        """Return the plan."""
        ...


def make_policy(name: str, env: Any, settings: Mapping[str, Any]) -> Policy:
    """Build a policy from its name or file."""
    import lagros_policies

    policy: Policy = lagros_policies.make(name, env, **settings)
    return policy


def make_single_policy(name: str, env: Any) -> Policy:
    """Build the policy of a command that flies one.

    Raises:
        SetupError: It is a class of the user's own, and its constructor raises, or it does not say
            rightly what it observes.
        ValueError: The name is unknown, or the file is not valid.
        OSError: A file cannot be read.
        ImportError: An extra that the policy needs is not installed.
    """
    try:
        with undone():
            policy = make_policy(name, env, {})
        check_observes(f"policy {name!r}", policy)
        return policy
    except (SetupError, ValueError, OSError, ImportError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise SetupError.building(f"policy {name!r}", error) from error


def make_filter(policy: Any, env: Any, disturbance_bound: float) -> Policy:
    """Return a policy with the safety filter of its task.

    Args:
        policy: The policy.
        env: An environment whose task has one.
        disturbance_bound: d_bar, in units of the state per second.
    """
    room = importlib.import_module(f"lagros_policies.tasks.{env.settings.room}")
    filtered: Policy = room.filtered(policy, env, disturbance_bound)
    return filtered


def make_planner() -> Planner:
    """Return the planner whose cold plans are the nominal trajectories x_d of the episodes."""
    from lagros_policies.tasks.cartpole.planner import CartPolePlanner

    planner: Planner = CartPolePlanner()
    return planner


def load_metric(path: str | None) -> Callable[[FloatArray], FloatArray]:
    """Return M(x), states (..., n) to (..., n, n), of the shipped metric or of a file."""
    from lagros_policies.contraction import load_metric as load

    matrix: Callable[[FloatArray], FloatArray] = load(path, states=4).matrix
    return matrix


@dataclass(frozen=True)
class Toolbox:
    """The functions above, in one value that travels to the workers and that a test can replace.

    Attributes:
        make_policy: Name, environment and settings to a policy.
        make_planner: The planner of the nominal trajectories.
        load_metric: File or None to M(x).
        make_filter: Policy, spacecraft environment and bound to the policy with the safety filter.
        position_margin: Policy and bound to the certified bound of its position error, or None.
    """

    make_policy: Callable[[str, Any, Mapping[str, Any]], Policy] = make_policy
    make_planner: Callable[[], Planner] = make_planner
    load_metric: Callable[[str | None], Callable[[FloatArray], FloatArray]] = load_metric
    make_filter: Callable[[Policy, Any, float], Policy] = make_filter
    position_margin: Callable[[Any, float], float | None] = position_margin

    def with_policies(self, policies: Mapping[str, Policy]) -> Toolbox:
        """Return the same with some policies that are objects, by name.

        Args:
            policies: Each is copied wherever one is built by its name.
        """
        return replace(self, make_policy=GivenPolicies(policies, self.make_policy))


@dataclass(frozen=True)
class GivenPolicies:
    """Makes a policy: a copy of an object that was given, or what its name says.

    Attributes:
        objects: The policies, by name.
        otherwise: Makes all others.
    """

    objects: Mapping[str, Policy]
    otherwise: Callable[[str, Any, Mapping[str, Any]], Policy]

    def __call__(self, name: str, env: Any, settings: Mapping[str, Any]) -> Policy:
        """Make a policy.

        Raises:
            ValueError: There are settings for an object.
        """
        if name not in self.objects:
            return self.otherwise(name, env, settings)
        if settings:
            raise ValueError(f"policy {name!r} is an object, which is not built with settings")
        return deepcopy(self.objects[name])
