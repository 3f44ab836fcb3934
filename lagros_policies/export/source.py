"""What is exported: a cart-pole network, its name and where its weights come from."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagros_envs import cartpole_task as task
from lagros_policies.imitation.network_policy import PRETRAINED, NetworkPolicy
from lagros_policies.imitation.networks import Mlp
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.learned import LearnedPolicy

Float32Array = NDArray[np.float32]

_POLICIES: dict[str, type[NetworkPolicy]] = {
    "lagros-cartpole": LagrosPolicy,
    "learned-cartpole": LearnedPolicy,
}
NAMES = tuple(_POLICIES)

_NEWTONS = task.CartPoleSettings(force_scale=1.0)


@dataclass(frozen=True)
class NetworkSource:
    """A policy to export.

    Attributes:
        name: "lagros-cartpole" or "learned-cartpole".
        file: Name of the weights file.
        digest: SHA-256 of the weights file, hexadecimal.
        policy: The policy in NumPy; the action 1.0 is 1 N.
    """

    name: str
    file: str
    digest: str
    policy: NetworkPolicy

    @property
    def network(self) -> Mlp:
        """The network, from 7 features to the force of the mirrored side [N]."""
        return self.policy.network

    def force(self, observation: Float32Array) -> Float32Array:
        """Return the force [N], shape (B,), of observations (B, 13): what an export must give."""
        return self.policy.predict(observation)[0][:, 0]


def load_source(name: str, weights: Path | str | None = None) -> NetworkSource:
    """Read the network of a policy.

    Args:
        name: One of `NAMES`.
        weights: A safetensors file written by `Mlp.save`; the shipped one if left out.

    Returns:
        The policy with its provenance.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The name is unknown, or the file is damaged or another network.
    """
    if name not in _POLICIES:
        raise ValueError(f"policy={name!r} cannot be exported; choose one of {', '.join(NAMES)}")
    kind = _POLICIES[name]
    path = PRETRAINED / kind.weights_file if weights is None else Path(weights)
    policy = kind(_NEWTONS, path)
    return NetworkSource(name, path.name, hashlib.sha256(path.read_bytes()).hexdigest(), policy)


def example_observations(count: int, seed: int = 0) -> Float32Array:
    """Return random observations, shape (count, 13), over the range of the task.

    Scenarios are drawn as in an episode and start leaning to either side; states lie anywhere
    between 5 m left and right of the goal, upright within 60 degrees, at rates up to 3 m/s and
    3 rad/s; times within the episode.
    """
    rng = np.random.default_rng(seed)
    settings = task.CartPoleSettings()
    rows = np.empty((count, task.OBSERVATION_DIM), np.float32)
    widths = np.array([settings.goal_range, settings.initial_angle, 3.0, 3.0])
    for row in rows:
        scenario = task.sample_scenario(rng, settings)
        row[task.STATE] = scenario.goal + widths * rng.uniform(-1.0, 1.0, task.STATE_DIM)
        row[task.GOAL] = scenario.goal
        row[task.INITIAL_STATE] = scenario.initial_state
        row[task.TIME] = rng.uniform(0.0, settings.time_limit)
    return rows
