"""What is exported: a policy that is a network, its name and where its weights come from."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import THRUSTERS, SpacecraftSettings
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.learned import LearnedPolicy
from lagros_policies.learning.deep_set import DeepSet
from lagros_policies.learning.network_policy import NetworkPolicy
from lagros_policies.learning.networks import Mlp
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.cartpole.features import cartpole_features
from lagros_policies.tasks.spacecraft.network_policy import (
    SpacecraftLagrosPolicy,
    SpacecraftLearnedPolicy,
    SpacecraftNetworkPolicy,
)

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]

_CARTPOLE: dict[str, type[NetworkPolicy]] = {
    "lagros-cartpole": LagrosPolicy,
    "learned-cartpole": LearnedPolicy,
}
_SPACECRAFT: dict[str, type[SpacecraftNetworkPolicy]] = {
    "lagros-spacecraft": SpacecraftLagrosPolicy,
    "learned-spacecraft": SpacecraftLearnedPolicy,
}
CARTPOLE_NAMES, SPACECRAFT_NAMES = tuple(_CARTPOLE), tuple(_SPACECRAFT)
NAMES = CARTPOLE_NAMES + SPACECRAFT_NAMES

_NEWTONS = task.CartPoleSettings(force_scale=1.0)


@dataclass(frozen=True)
class NetworkSource:
    """A cart-pole policy to export.

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

    @property
    def inputs(self) -> int:
        """Length of an observation, 13."""
        return task.OBSERVATION_DIM

    @property
    def outputs(self) -> int:
        """Number of forces, 1."""
        return 1

    def force(self, observation: Float32Array) -> Float32Array:
        """Return the force [N], shape (B,), of observations (B, 13): what an export must give."""
        return self.answer(observation)[:, 0]

    def answer(self, observation: Float32Array) -> Float32Array:
        """Return the same as `force`, shape (B, 1) [N].

        It is `predict` without the check that the observation is finite, which an export lacks.
        """
        features, side = cartpole_features(observation)
        return self.network(features) * side[..., None]

    def examples(self, count: int, seed: int = 0) -> Float32Array:
        """Return random observations, shape (count, 13); see `example_observations`."""
        return example_observations(count, seed)


@dataclass(frozen=True)
class SpacecraftSource:
    """A spacecraft policy to export.

    Attributes:
        name: "lagros-spacecraft" or "learned-spacecraft".
        file: Name of the weights file.
        digest: SHA-256 of the weights file, hexadecimal.
        policy: The policy in NumPy.
    """

    name: str
    file: str
    digest: str
    policy: SpacecraftNetworkPolicy

    @property
    def network(self) -> DeepSet:
        """The network, from features to an acceleration in the frame of the goal."""
        return self.policy.network

    @property
    def layout(self) -> Layout:
        """Where everything lies in the flat observation."""
        return self.policy.layout

    @property
    def radii(self) -> tuple[float, float]:
        """Radii of an agent against other agents and against obstacles [m]."""
        preset = self.policy.preset
        return preset.agent_radius, preset.core

    @property
    def inputs(self) -> int:
        """Length of an observation."""
        return self.layout.size

    @property
    def outputs(self) -> int:
        """Number of thrusters, 8."""
        return THRUSTERS

    def answer(self, observation: Float32Array) -> Float32Array:
        """Return u >= 0, shape (B, 8) [N], of observations (B, o): what an export must give."""
        return self.policy.thrust(observation).astype(np.float32)

    def examples(self, count: int, seed: int = 0) -> Float32Array:
        """Return random observations, shape (count, o); see `example_sensed`."""
        return example_sensed(self.policy, count, seed)


Source = NetworkSource | SpacecraftSource


def load_source(
    name: str,
    weights: Path | str | None = None,
    preset: str | Preset = "paper",
    num_agents: int | None = None,
) -> Source:
    """Read the network of a policy.

    Args:
        name: One of `NAMES`.
        weights: A safetensors file written by `Mlp.save`, or `DeepSet.save`; the shipped one if
            left out.
        preset: Of the spacecraft: the radii of the bodies and the slots of an observation.
        num_agents: Of the spacecraft; None for the preset's own.

    Returns:
        The policy with its provenance.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The name is unknown, or the file is damaged or another network.
    """
    if name in _SPACECRAFT:
        kind = _SPACECRAFT[name]
        path = _path(kind.weights_file, weights)
        flying = kind(SpacecraftSettings(), preset, num_agents, path)
        return SpacecraftSource(name, path.name, _digest(path), flying)
    return load_cartpole(name, weights)


def load_cartpole(name: str, weights: Path | str | None = None) -> NetworkSource:
    """Read the network of a cart-pole policy; as `load_source`."""
    if name not in _CARTPOLE:
        raise ValueError(f"policy={name!r} cannot be exported; choose one of {', '.join(NAMES)}")
    kind = _CARTPOLE[name]
    path = _path(kind.weights_file, weights)
    policy = kind(_NEWTONS, path)
    return NetworkSource(name, path.name, _digest(path), policy)


def _path(shipped: str, weights: Path | str | None) -> Path:
    return PRETRAINED / shipped if weights is None else Path(weights)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


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


def example_sensed(policy: SpacecraftNetworkPolicy, count: int, seed: int = 0) -> Float32Array:
    """Return random observations of a spacecraft, shape (count, policy.layout.size).

    Goals lie up to 6 m away in any direction, velocities reach 0.5 m/s and spins 0.5 rad/s, times
    the end of the episode. Every slot is sensed by chance, with its body anywhere between a slight
    overlap and the rim of what is sensed; what is not sensed is zero, as in the environment.
    """
    rng = np.random.default_rng(seed)
    settings, preset, layout = policy.settings, policy.preset, policy.layout
    at, reach = layout.slices, settings.sensing_radius
    rows = np.zeros((count, layout.size), np.float32)
    rows[:, at["goal"]] = _around(rng, np.zeros(count), 6.0)
    rows[:, at["velocity"]] = _around(rng, np.zeros(count), 0.5)
    heading, turn = rng.uniform(-np.pi, np.pi, (2, count))
    rows[:, at["heading"]] = np.stack([np.cos(heading), np.sin(heading), turn], axis=1)
    rows[:, at["spin"]] = rng.uniform(-0.5, 0.5, (count, 1))
    rows[:, at["time"]] = rng.uniform(0.0, settings.time_limit, (count, 1))

    touch = np.full((count, layout.neighbours), 2.0 * preset.agent_radius)
    neighbours = [_around(rng, 0.9 * touch, reach), _around(rng, 0.0 * touch, 0.8)]
    radii = preset.obstacle_radius * rng.uniform(0.6, 1.4, (count, layout.obstacles))
    obstacles = [_around(rng, 0.9 * (radii + preset.core), reach + radii), radii[..., None]]
    for parts, name in ((neighbours, "neighbour"), (obstacles, "obstacle")):
        slots = np.concatenate(parts, axis=-1)
        sensed = rng.random(slots.shape[:2]) < 0.5
        rows[:, at[f"{name}_mask"]] = sensed
        rows[:, at[f"{name}s"]] = (slots * sensed[..., None]).reshape(count, -1)
    return rows


def _around(rng: np.random.Generator, least: FloatArray, most: FloatArray | float) -> FloatArray:
    """Return vectors of a length between two and of any direction, shape (*least.shape, 2)."""
    angle = rng.uniform(-np.pi, np.pi, least.shape)
    length = rng.uniform(least, most)
    return np.stack([length * np.cos(angle), length * np.sin(angle)], axis=-1)
