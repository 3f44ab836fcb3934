"""What the benchmark asks of `lagros_policies`, and the one place where it asks.

Everything is imported when it is called: the command line must start at once, and a worker process
imports only what its chunk needs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lagros_benchmarks.claims import position_margin

FloatArray = NDArray[np.float64]
Environment = gym.Env[Any, Any]


class SetupError(Exception):
    """A run cannot begin: a policy, the planner or the metric cannot be built."""

    @classmethod
    def building(cls, what: str, error: Exception) -> SetupError:
        """Return the error of something that cannot be built; its name is said once.

        Args:
            what: What was built, "policy 'mine:Lean'" for instance.
            error: What that has raised.
        """
        text = str(error) if isinstance(error, ValueError) else ""
        if not text.startswith(what):
            text = f"{what} cannot be built: {type(error).__name__}: {error}"
        return cls(text.replace("\n", " "))


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
        SetupError: It is a class of the user's own, and its constructor raises.
        ValueError: The name is unknown, or the file is not valid.
        OSError: A file cannot be read.
        ImportError: An extra that the policy needs is not installed.
    """
    try:
        return make_policy(name, env, {})
    except (ValueError, OSError, ImportError):
        raise
    except Exception as error:
        text = f"policy {name!r} cannot be built: {type(error).__name__}: {error}"
        raise SetupError(text) from error


def make_filter(policy: Any, env: Any, disturbance_bound: float) -> Policy:
    """Return a policy of the spacecraft that wears the safety filter.

    Args:
        policy: The policy.
        env: A spacecraft environment; its task and preset are taken.
        disturbance_bound: d_bar, in units of the state per second.
    """
    from lagros_policies.safety import SafetyFilter

    filtered: Policy = SafetyFilter(
        policy, env.settings, env.preset, disturbance_bound=disturbance_bound
    )
    return filtered


def make_planner() -> Planner:
    """Return the planner whose cold plans are the nominal trajectories x_d of the episodes."""
    from lagros_policies.planning.cartpole import CartPolePlanner

    planner: Planner = CartPolePlanner()
    return planner


def load_metric(path: str | None) -> Callable[[FloatArray], FloatArray]:
    """Return M(x), states (..., n) to (..., n, n), of the shipped metric or of a file."""
    from lagros_policies.contraction import load_metric as load

    matrix: Callable[[FloatArray], FloatArray] = load(path).matrix
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
