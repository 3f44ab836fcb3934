"""What the training of a network has recorded about it."""

from __future__ import annotations

import json

from lagros_envs.task import Described
from lagros_policies.contraction.statement import Statement
from lagros_policies.room import found_file

# Policies that track with u* itself.
_EXACT = ("tube-mpc", "centralized")


def recorded_error(task: Described, policy: str) -> float:
    """Return the largest ||u_L - u*|| of the held-out samples, from the network's own record.

    Raises:
        FileNotFoundError: The network has no record.
        ValueError: The record holds no such figure.
    """
    path = found_file(task, f"{policy}.json")
    try:
        return float(json.loads(path.read_text())["learning_error"]["maximum"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} holds no learning_error: {error}") from error


def recorded(task: Described, policy: str, unit: str) -> tuple[float, list[Statement]]:
    """Return the recorded learning error and its line of a certificate; 0 and no line for u*."""
    if policy in _EXACT:
        return 0.0, []
    error = recorded_error(task, policy)
    text = (
        f"||u_L - u*|| <= {f'{error:.4g} {unit}'.strip()} on the held-out samples of the training "
        f"of {policy}, for the u* that it imitates (its record); no bound for other states"
    )
    return error, [Statement(text, "observed", True, 0.0)]
