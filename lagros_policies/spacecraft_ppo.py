"""The PPO agent that all spacecraft share: what it sees, and its actor as a policy in NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lagros_envs import spacecraft_task as task
from lagros_envs.observation import Layout
from lagros_envs.scenarios import Preset, preset_named
from lagros_policies.imitation.networks import Mlp
from lagros_policies.policy import PolicyState
from lagros_policies.sensed import Sensed

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]

# Where the training writes its actor; none is shipped.
WEIGHTS = Path("runs/train/spacecraft-ppo/seed-0/weights.safetensors")
NEAREST = 3  # neighbours that the agent looks at
_OWN, _EACH = 6, 7
FEATURES = _OWN + _EACH * NEAREST
# Numbers of the order of one, from metres and metres per second.
_GOAL_SCALE, _SPEED_SCALE, _RELATIVE_SPEED_SCALE = 0.5, 3.0, 2.0
# The direction of the goal loses its meaning at the goal: it fades within this distance [m].
_FADE = 0.3
_SMALLEST = 1e-9


def body_features(layout: Layout, observation: NDArray[np.floating]) -> Float32Array:
    """Return what the agent sees: goal and nearest neighbours in the axes of its own body.

    In these axes the same thrusters always push the same way, whatever the heading. Neighbours are
    sorted by distance, so that their order in the observation changes nothing, and the number of
    features depends neither on that of the agents nor on that of the obstacles, which are left out.

    Args:
        layout: Of the environment.
        observation: Shape (B, layout.size).

    Returns:
        Shape (B, 27), float32: the goal's direction (2) and distance, the velocity (2), the spin;
        then for each of the three nearest neighbours its direction (2), the same times its
        nearness (2), its relative velocity (2) and its nearness, which falls from 1 at a touch of
        0.25 m agents to 0 at 2 m. What is not sensed is zero.

    Raises:
        ValueError: The observation is not of this layout.
    """
    sensed = Sensed.of(layout, observation)
    cosine, sine = np.cos(sensed.heading)[:, None], np.sin(sensed.heading)[:, None]

    def turned(vectors: FloatArray) -> FloatArray:
        # The body's axes are (cos phi, -sin phi) and (sin phi, cos phi).
        x, y = vectors[..., 0], vectors[..., 1]
        return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)

    goal, velocity = turned(sensed.goal[:, None])[:, 0], turned(sensed.velocity[:, None])[:, 0]
    way = np.linalg.norm(goal, axis=-1, keepdims=True)
    own = [goal / (way + _FADE), _GOAL_SCALE * way, _SPEED_SCALE * velocity, sensed.spin[:, None]]

    distance = np.linalg.norm(sensed.neighbours[..., :2], axis=-1)
    order = np.argsort(np.where(sensed.neighbour_mask, distance, np.inf), axis=1, kind="stable")
    order = order[:, :NEAREST]
    distance = np.take_along_axis(distance, order, axis=1)
    seen = np.take_along_axis(sensed.neighbour_mask, order, axis=1).astype(np.float64)
    others = np.take_along_axis(sensed.neighbours, order[..., None], axis=1)
    direction = turned(others[..., :2]) / np.maximum(distance, _SMALLEST)[..., None]
    nearness = seen * np.maximum(2.0 - distance, 0.0) / 1.5
    each = [
        direction,
        direction * nearness[..., None],
        _RELATIVE_SPEED_SCALE * turned(others[..., 2:]),
        nearness[..., None],
    ]
    features = np.zeros((len(sensed.goal), FEATURES), np.float32)
    features[:, :_OWN] = np.concatenate(own, axis=1)
    neighbours = np.concatenate(each, axis=-1).reshape(len(features), -1)
    features[:, _OWN : _OWN + neighbours.shape[1]] = neighbours
    return features


class SpacecraftPpoPolicy:
    """The trained actor, its mean action, for any number of agents.

    `lagros train spacecraft --algo ppo` trains it, in the preset `open`: it does not see obstacles.

    Args:
        settings: The task; None for the paper's.
        preset: The preset, or its name, of the environment.
        num_agents: Number of agents; None for the preset's own.
        weights: The file of a training, or the network itself; None for that of seed 0 in the
            folder `runs/train` here.

    Raises:
        FileNotFoundError: There is no such file: train first.
        ValueError: The file is damaged, or not this agent's.
    """

    name = "ppo"
    observes: Literal["local", "global"] = "local"

    def __init__(
        self,
        settings: task.SpacecraftSettings | None = None,
        preset: str | Preset = "open",
        num_agents: int | None = None,
        weights: Path | str | Mlp | None = None,
    ) -> None:
        """Load the actor."""
        self.settings = settings or task.SpacecraftSettings()
        self.layout = Layout.for_preset(preset_named(preset).for_agents(num_agents), self.settings)
        if not isinstance(weights, Mlp):
            weights = Mlp.load(WEIGHTS if weights is None else weights)
        self.network = weights
        if (self.network.inputs, self.network.outputs) != (FEATURES, task.THRUSTERS):
            raise ValueError(
                f"the network maps {self.network.inputs} numbers to {self.network.outputs}; this "
                f"agent maps {FEATURES} to {task.THRUSTERS}"
            )

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Choose the thrusts; see `Policy.predict`.

        Args:
            observation: Of one agent (o,), or of many (B, o).
            state: Is passed on: the actor remembers nothing.
            episode_start: Has no effect.
            deterministic: Has no effect: this is the mean action.

        Returns:
            The actions (8,) or (B, 8) within [0, 1], and the state.

        Raises:
            ValueError: The observation is not of this task.
        """
        features = body_features(self.layout, np.atleast_2d(observation))
        # The agent was trained on 1 N at the action 1.0.
        thrust = np.clip(self.network(features), 0.0, 1.0) / self.settings.thrust_scale
        return (thrust if np.ndim(observation) == 2 else thrust[0]).astype(np.float32), state
