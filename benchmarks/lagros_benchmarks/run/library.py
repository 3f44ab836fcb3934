"""What the benchmark asks of `lagros_policies`, and the one place where it asks.

Everything is imported when it is called: the command line must start at once, and a worker process
imports only what its chunk needs.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from lagros_benchmarks.run.process import undone
from lagros_envs.arrays import FloatArray
from lagros_policies.policy import BasePolicy, as_policy

if TYPE_CHECKING:
    from lagros_policies.planning.planner import Planner

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
        """Return the error of what cannot be built, "policy 'mine:Lean'" for instance."""
        text = describe_error(error)
        own = text.partition(": ")[2] if isinstance(error, ValueError) else ""
        return cls(own if own.startswith(what) else f"{what} cannot be built: {text}")


@contextmanager
def building(what: str) -> Iterator[None]:
    """Turn whatever the constructor of a stranger raises, SystemExit too, into a `SetupError`.

    Raises:
        SetupError: Something was raised; its message begins with `what`.
    """
    try:
        with undone():  # where a constructor goes, it goes for itself
            yield
    except (KeyboardInterrupt, SetupError):
        raise
    except BaseException as error:
        raise SetupError.building(what, error) from error


def make_policy(name: Any, env: Any, settings: Mapping[str, Any]) -> Any:
    """Build a policy from its name, file or class."""
    import lagros_policies

    return lagros_policies.make(name, env, **settings)


def built_policy(name: str, make: Callable[[], Any]) -> BasePolicy:
    """Build a policy by its name in the run, of which then everything can be asked.

    Raises:
        SetupError: It cannot be built, or is no policy.
    """
    with building(f"policy {name!r}"):
        made = make()
        try:
            return as_policy(made, name)
        except TypeError as error:
            raise SetupError(str(error)) from None


def make_single_policy(name: str, env: Any) -> BasePolicy:
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
    except (ValueError, OSError, ImportError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise SetupError.building(f"policy {name!r}", error) from error
    return built_policy(name, lambda: policy)


def make_planner(task: Any) -> Planner:
    """Return the planner whose cold plans are the nominal trajectories x_d of a task's episodes."""
    from lagros_policies.planning.planner import planner_of

    return planner_of(task)


def load_metric(task: Any, path: str | None) -> Callable[[FloatArray], FloatArray]:
    """Return M(x), states (..., n) to (..., n, n), of the task's own metric or of a file."""
    from lagros_policies.contraction import load_metric as load
    from lagros_policies.expert import metric_of

    metric = metric_of(task) if path is None else load(path, task.system.state_dim)
    return metric.matrix


@dataclass(frozen=True)
class Toolbox:
    """The functions above, in one value that travels to the workers and that a test can replace.

    Attributes:
        make_policy: Name, environment and settings to a policy, or to an object that can be one.
        make_planner: Task to the planner of the nominal trajectories.
        load_metric: Task, and file or None, to M(x).
        make_filter: Policy, environment and bound to the policy with the safety filter; None, as
            in the next, for that of the task.
        position_margin: Policy and bound to the certified bound of its position error, or None.
    """

    make_policy: Callable[[str, Any, Mapping[str, Any]], Any] = make_policy
    make_planner: Callable[[Any], Planner] = make_planner
    load_metric: Callable[[Any, str | None], Callable[[FloatArray], FloatArray]] = load_metric
    make_filter: Callable[[BasePolicy, Any, float], BasePolicy] | None = None
    position_margin: Callable[[BasePolicy, float], float | None] | None = None


@dataclass(frozen=True)
class GivenPolicies:
    """Makes a policy of what a caller has given, or what its name says otherwise.

    Attributes:
        given: By name, an object with `predict`, of which a copy flies; or what `otherwise` makes a
            policy of: a class, a function, or another name.
        otherwise: Makes a policy of one of these, an environment and settings.
    """

    given: Mapping[str, Any]
    otherwise: Callable[[Any, Any, Mapping[str, Any]], Any]

    def __call__(self, name: str, env: Any, settings: Mapping[str, Any]) -> Any:
        """Make a policy.

        Raises:
            ValueError: There are settings for an object.
        """
        given = self.given.get(name, name)
        made = isinstance(given, str | partial) or inspect.isclass(given)
        if made or inspect.isroutine(given):
            return self.otherwise(given, env, settings)
        if settings:
            raise ValueError(f"policy {name!r} is an object, which is not built with settings")
        return deepcopy(given)
