"""What a network or a metric was made for, and whether it may fly another task.

The metadata of a file name the task, the policy and the settings that the training was about. A
file without them is taken for one of the paper's task, for which all commands of this package
train.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from lagros_envs.checks import check_flag
from lagros_envs.reading import parse_json
from lagros_envs.task import Described, Task
from lagros_policies.room import part_of

if TYPE_CHECKING:
    from lagros_policies.policy import BasePolicy

TASK, POLICY, SETTINGS = KEYS = ("task", "policy", "trained_for")
Rule = Literal["equal", "at_most", "one_of"]
# By rule and by name, what the settings of a flight are held against.
Range = Mapping[str, Mapping[str, Any]]
# Refuses observations, (o,) or (B, o), of episodes unlike those of the training.
EpisodeCheck = Callable[[NDArray[Any]], None]


class Training:
    """What the networks of a task may fly: what they were trained for, setting by setting.

    A task whose networks may fly more names a class of its own in its room.
    """

    def __init__(self, task: Task) -> None:
        self.task = task

    def range(self, timed: bool) -> Range:
        """Return what a network may fly.

        Args:
            timed: Whether the network counts on the time at which the episode ends.
        """
        return {"equal": _settings(self.task)}

    def episodes(self, policy: str, trained_for: Range) -> EpisodeCheck:
        """Return a check of the episodes that a network meets; see `check_weights`.

        Args:
            policy: Whose network it is, for the message.
            trained_for: What it may fly.
        """
        return every_episode


def every_episode(rows: NDArray[Any]) -> None:
    """Allow every episode."""


def training_of(task: Task) -> Training:
    """Return what the networks of a training for a task may fly."""
    found: Training = part_of(task, "TRAINED", "lagros_policies.trained_for:Training")(task)
    return found


def usual(task: Task) -> Task:
    """Return a task with its default settings, for which its files were made."""
    kind: Any = type(task)
    try:
        found: Task = kind()
        return found
    except TypeError:  # it has settings without a default
        return task


def check_weights(
    task: Task,
    metadata: Mapping[str, str],
    what: str,
    policy: BasePolicy,
    timed: bool,
    allow_other_settings: bool = False,
) -> EpisodeCheck:
    """Check that a network flies as what it was trained, and within what it was trained for.

    Args:
        task: The task that it is to fly.
        metadata: Of its weights.
        what: The weights, for the message.
        policy: Whose network it is; `recorded_as` is the name that the file must have.
        timed: As for `Training.range`.
        allow_other_settings: Do not look at the settings.

    Returns:
        A function that refuses observations, (o,) or (B, o), of episodes that are unlike those of
        the training.

    Raises:
        ValueError: It is another policy's, or the settings are others.
    """
    training = training_of(usual(task))
    assumed = training.range(timed)
    check_trained_for(metadata, what, policy.recorded_as, task, assumed, allow_other_settings)
    if allow_other_settings:
        return every_episode
    return training.episodes(policy.name, range_of(metadata, what, assumed))


def weights_record(task: str, policy: str, trained_for: Range) -> dict[str, str]:
    """Return the metadata of a weights file."""
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
                f"{name}={value!r}: {what} was made for {needed}; use a policy that was "
                "made for this task, or give lagros_policies.make allow_other_settings=True to "
                "fly outside of that"
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
    """Return the settings of a task, those of its body as "system.mass", as JSON keeps them."""
    values: dict[str, Any] = {}
    for item in fields(task):
        value = getattr(task, item.name)
        if is_dataclass(value):
            values |= {f"{item.name}.{name}": entry for name, entry in _settings(value).items()}
        else:
            values[item.name] = _plain(value)
    return values


def _plain(value: Any) -> Any:
    """Return a setting as it is read again from JSON."""
    if isinstance(value, tuple | list | np.ndarray):
        return [_plain(entry) for entry in value]
    plain = value is None or isinstance(value, bool | int | float | str)
    return value if plain else type(value).__name__


def body_values(system: Any) -> dict[str, Any]:
    """Return the parameters of a system as ranges name them."""
    return {f"system.{name}": value for name, value in _settings(system).items()}
