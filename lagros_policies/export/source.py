"""Which policy is exported: its name, where its weights come from, what its file has to answer."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lagros_envs.arrays import Float32Array
from lagros_envs.checks import shown
from lagros_envs.registry import find_task, task_names
from lagros_envs.task import Described, Task
from lagros_policies.export.program import Program
from lagros_policies.policy import BasePolicy
from lagros_policies.room import found_file, imported, named_in, part_of

# Policies that are one evaluation of a network.
_POLICIES = {
    "lagros": "lagros_policies.lagros:LagrosPolicy",
    "learned": "lagros_policies.learned:LearnedPolicy",
}


@dataclass(frozen=True)
class Exported:
    """A policy taken apart.

    Attributes:
        program: What its file computes.
        answer: From observations (B, o) to controls (B, m), by NumPy: what an export must give. It
            is `predict` in units of u and without the check that the observation is finite.
        examples: From a number and a seed, 0 if left out, to so many random observations (B, o)
            over the range of the task.
    """

    program: Program
    answer: Callable[[Float32Array], Float32Array]
    examples: Callable[..., Float32Array]


@dataclass(frozen=True)
class Source(Exported):
    """A policy to export.

    Attributes:
        name: Of policy and task, "POLICY-TASK".
        file: Name of the weights file.
        digest: SHA-256 of the weights file, hexadecimal.
        policy: The policy in NumPy.
    """

    name: str
    file: str
    digest: str
    policy: Any

    @property
    def identifier(self) -> str:
        """The name as C and files have it."""
        return self.name.replace("-", "_")


def exported_names() -> list[str]:
    """Return the names of what can be exported of the tasks that are known by name."""
    return [f"{policy}-{task}" for task in task_names() for policy in _POLICIES]


NAMES = tuple(exported_names())  # the older name of `exported_names`


def parted(name: str) -> tuple[str, Described]:
    """Return a policy's name and its task.

    Args:
        name: POLICY-TASK, where the task may be whatever `find_task` finds.

    Raises:
        ValueError: There is no such policy, or no such task.
    """
    policy, _, task = name.partition("-")
    if policy not in _POLICIES or not task:
        raise ValueError(
            f"policy={shown(name)} cannot be exported; choose one of "
            f"{', '.join(exported_names())}, or name a task of your own: lagros-./mytask.py"
        )
    return policy, find_task(task)


def load_source(name: str, weights: Path | str | None = None, **told: Any) -> Source:
    """Read the network of a policy.

    Args:
        name: As in `exported_names`, or POLICY-TASK.
        weights: A safetensors file written by the network's `save`; the task's own if left out.
        told: What else the policy is built with, as `preset` and `num_agents` of many agents.

    Returns:
        The policy with its provenance.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The name is unknown, or the file is damaged or another network.
    """
    short, task = parted(name)
    place = named_in(task, "POLICIES", {}).get(short, _POLICIES[short])
    # Worlds of many agents bring settings with their preset, unless somebody has chosen others.
    usual = not isinstance(task, Task) and task == type(task)()
    policy: BasePolicy = imported(place)(None if usual else task, weights=weights, **told)
    parts: Exported = part_of(task, "EXPORT", "lagros_policies.export.single:exported")(policy)
    # Which file ships may depend on the world: the policy knows which one it took.
    path = Path(
        weights or getattr(policy, "weights_path", None) or found_file(task, f"{short}.safetensors")
    )
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return Source(
        **vars(parts), name=f"{short}-{task.name}", file=path.name, digest=digest, policy=policy
    )
