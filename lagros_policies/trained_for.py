"""What a network or a metric was made for, and whether it may fly another task.

The metadata of a file name the task, the policy and the settings that the training was about. A
file without them is taken for one of the paper's task, for which all commands of this package
train.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_flag
from lagros_envs.reading import parse_json
from lagros_envs.task import Described
from lagros_envs.tasks.cartpole.physics import CartPole
from lagros_envs.tasks.cartpole.task import CartPoleSettings

TASK, POLICY, SETTINGS = KEYS = ("task", "policy", "trained_for")
Rule = Literal["equal", "at_most", "one_of"]
# By rule and by name, what the settings of a flight are held against.
Range = Mapping[str, Mapping[str, Any]]


def cartpole_range(task: CartPoleSettings, timed: bool) -> Range:
    """Return what a network of the cart-pole that was trained for a task may fly.

    Args:
        task: The task.
        timed: Whether the network counts on the time at which the episode ends.
    """
    equal = body_values(task.system)
    equal |= {name: getattr(task, name) for name in ("control_period", "force_limit")}
    at_most = {name: getattr(task, name) for name in ("initial_angle", "goal_range")}
    (equal if timed else at_most)["time_limit"] = task.time_limit
    return {"equal": equal, "at_most": at_most}


def cartpole_design(system: CartPole) -> Range:
    """Return what a metric that was designed for a cart-pole may track."""
    return {"equal": body_values(system)}


def weights_record(task: str, policy: str, trained_for: Range) -> dict[str, str]:
    """Return the metadata of a weights file.

    Args:
        task: Name of the task.
        policy: Name of the policy that flies it.
        trained_for: What it may fly.
    """
    return {TASK: task, POLICY: policy, SETTINGS: json.dumps(trained_for, sort_keys=True)}


def check_trained_for(
    metadata: Mapping[str, str],
    what: str,
    policy: str | None,
    flown: Described,
    assumed: Range,
    allow_other_settings: bool = False,
    told: Mapping[str, Any] | None = None,
) -> None:
    """Check that a network flies as what it was trained, and within what it was trained for.

    Args:
        metadata: Of its weights.
        what: The weights, for the message.
        policy: Name of the policy that is to fly it; None for any.
        flown: The task.
        assumed: What it may fly if the metadata do not say.
        allow_other_settings: Do not look at the settings.
        told: What else a range may speak about, by name.

    Raises:
        ValueError: It is another policy's, or the settings are others.
    """
    task = flown.name
    found = metadata.get(TASK, task), metadata.get(POLICY, policy)
    if found[0] != task or (policy is not None and found[1] != policy):
        raise ValueError(
            f"{what} holds the policy {found[1]!r} of the {found[0]}, not {policy!r} of the {task}"
        )
    check_flag("allow_other_settings", allow_other_settings)
    if allow_other_settings:
        return
    for name, value in (_settings(flown) | dict(told or {})).items():
        needed = _needed(range_of(metadata, what, assumed), name, value)
        if needed is not None:
            raise ValueError(
                f"{name}={value!r}: {what} was made for {needed}; use what was made for this task, "
                "or give lagros_policies.make allow_other_settings=True to fly outside of that"
            )


def range_of(metadata: Mapping[str, str], what: str, assumed: Range) -> Range:
    """Return what a network may fly; the arguments are those of `check_trained_for`.

    Raises:
        ValueError: The metadata cannot be read.
    """
    text = metadata.get(SETTINGS)
    if text is None:
        return assumed
    value = parse_json(text, f"{what}: its {SETTINGS!r}")
    if not isinstance(value, dict) or not all(isinstance(part, dict) for part in value.values()):
        raise ValueError(f"{what}: its {SETTINGS!r} must be rules, names and values")
    return value


@dataclass(frozen=True)
class EpisodeRange:
    """Which episodes a network of the cart-pole may fly: those like the ones of its training.

    Attributes:
        policy: Whose network it is, for the message.
        farthest: Largest distance from the start to the goal [m].
        steepest: Largest angle at the start [rad].
    """

    policy: str
    farthest: float = math.inf
    steepest: float = math.inf

    @classmethod
    def of(cls, policy: str, trained_for: Range, allow_other_settings: bool) -> EpisodeRange:
        """Return the range that a record names, or every episode where others are allowed.

        Args:
            policy: Whose network it is.
            trained_for: What the network was trained for.
            allow_other_settings: Whether it may fly all.
        """
        if allow_other_settings:
            return cls(policy)
        # Of single precision, a hair wider than trained for.
        farthest, steepest = (
            (1.0 + 1e-6) * float(trained_for.get("at_most", {}).get(name, math.inf))
            for name in ("goal_range", "initial_angle")
        )
        return cls(policy, farthest, steepest)

    def check(self, ways: NDArray[np.float32], leans: NDArray[np.float32]) -> None:
        """Check episodes; a single one costs a microsecond.

        Args:
            ways: p_f - p(0), shape () or (B,) [m].
            leans: theta(0), of the same shape [rad].

        Raises:
            ValueError: A goal is farther away, or a start leans more, than in the training.
        """
        if ways.ndim == 0:
            way, lean = abs(ways.item()), abs(leans.item())
        else:
            way = float(np.max(np.abs(ways), initial=0.0))
            lean = float(np.max(np.abs(leans), initial=0.0))
        if way > self.farthest or lean > self.steepest:
            raise ValueError(
                f"the episode goes {way:.3g} m from a lean of {lean:.3g} rad; "
                f"{self.policy} was trained for at most {self.farthest:.3g} m and "
                f"{self.steepest:.3g} rad: pass allow_other_settings=True to fly outside of that"
            )


def _needed(trained_for: Range, name: str, value: Any) -> str | None:
    """Return what a setting must be, in words; None if it is, or nothing is said about it."""
    for rule, words in (("equal", ""), ("at_most", "at most "), ("one_of", "one of ")):
        limits = trained_for.get(rule, {})
        if name not in limits:
            continue
        limit = limits[name]
        if rule == "equal":
            holds = value == limit
        elif rule == "at_most":
            holds = isinstance(limit, int | float) and value <= limit
        else:
            holds = isinstance(limit, list) and value in limit
        return None if holds else f"{words}{limit!r}"
    return None


def _settings(task: Any) -> dict[str, Any]:
    """Return the settings of a task, and those of its body."""
    values = {item.name: getattr(task, item.name) for item in fields(task)}
    return values | body_values(task.system)


def body_values(system: Any) -> dict[str, Any]:
    """Return the parameters of a system as ranges name them."""
    return {f"system.{item.name}": getattr(system, item.name) for item in fields(system)}
