"""Policies (a) and (c) of the spacecraft, and what they share with PPO: one evaluation each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np

from lagros_envs.arrays import BoolArray, Float32Array, FloatArray
from lagros_envs.tasks.spacecraft import task
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_policies.learning.deep_set import DeepSet, SetFeatures
from lagros_policies.learning.networks import Mlp
from lagros_policies.observed import as_numbers
from lagros_policies.policy import BasePolicy, PolicyState
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.spacecraft.features import NEIGHBOUR, OBSTACLE, OWN, spacecraft_features
from lagros_policies.tasks.spacecraft.receding import COUNTERS, Receding, Waiting
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.setup import (
    PUBLISHED,
    radii_of,
    spacecraft_range,
    task_and_preset,
)
from lagros_policies.tasks.spacecraft.thrusters import allocate
from lagros_policies.trained_for import check_trained_for


class SpacecraftActor(BasePolicy):
    """A policy of each agent for itself, by one evaluation of a network: what (a), (c), PPO share.

    Every row of an observation is an agent of its own: all agents of all worlds fit in one call.

    Args:
        settings: The task; None for that of the preset.
        preset: The preset, or its name: the size of observations and the radii of the bodies.
        num_agents: Number of agents; None for the preset's own.
        weights: A file of the network, or the network itself; None for the shipped one.
        allow_other_settings: Fly settings and radii too for which the network was not trained.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged, its network is another one or another policy's, or was
            trained for other settings.

    Attributes:
        kind: Of the network.
        maps: Its inputs and outputs.
        maker: The command that makes one.
        trained_in: Presets whose bodies it has met, where the file does not say.
        recorded_as: The policy that the file must name; None takes any.
        weights_path: The file that was read; None of a network that was handed over.
    """

    kind: type[DeepSet] | type[Mlp]
    maps: tuple[Any, int]
    maker: str
    trained_in: tuple[str, ...] = PUBLISHED
    weights_file: str
    recorded_as: str | None = None
    weights_path: Path | None
    network: Any
    restricted = True  # `policy.make` tells it whether other settings are allowed

    def __init__(
        self,
        settings: task.SpacecraftSettings | None = None,
        preset: str | Preset = "paper",
        num_agents: int | None = None,
        weights: Path | str | DeepSet | Mlp | None = None,
        allow_other_settings: bool = False,
    ) -> None:
        self.settings, self.preset = task_and_preset(settings, preset, num_agents)
        self.layout = Layout.for_preset(self.preset, self.settings)
        given = PRETRAINED / self._shipped() if weights is None else weights
        ready = isinstance(given, self.kind)
        what = "the network" if ready else str(given)
        self.network = given if ready else self.kind.load(cast(Path, given))
        self.weights_path = None if ready else Path(cast(Path, given))
        if (self.network.inputs, self.network.outputs) != self.maps:
            raise ValueError(
                f"{what} maps {self.network.inputs} numbers to {self.network.outputs}; this agent "
                f"maps {self.maps[0]} to {self.maps[1]}; `{self.maker}` makes such a network"
            )
        check_trained_for(
            self.network.metadata,
            what,
            self.recorded_as,
            self._looked_at(),
            spacecraft_range(task.SpacecraftSettings(), self.trained_in),
            allow_other_settings,
            radii_of(self.preset),
        )

    def _shipped(self) -> str:
        """Return the name of the file that is flown where none is given."""
        return self.weights_file

    def _looked_at(self) -> task.SpacecraftSettings:
        """Return the settings that are held against those of the training."""
        # Who sees no further than its neighbours is not tied to their number.
        return task.before_growth(self.settings, self.preset)


class SpacecraftNetworkPolicy(SpacecraftActor):
    """Maps what an agent senses to its eight thrusters by a deep set.

    The network answers with an acceleration in the frame of the goal; a turn into the body's axes
    and a fixed last layer with ReLU, the allocation of least norm, make u >= 0 of it.

    Args:
        receding: Whether goals are shown as receding ones, with the rule against deadlocks: True or
            False, a `Receding` or a mapping of its fields; None for yes where worlds are larger
            than those in which the networks learned, `Receding.chosen`.
        others: As of `SpacecraftActor`.

    Raises:
        FileNotFoundError: As of `SpacecraftActor`.
        ValueError: As of `SpacecraftActor`, or `receding` is none of these.
    """

    name: str = "network"
    kind = DeepSet
    # Features of the agent itself, of a neighbour and of an obstacle; accelerations in the frame of
    # the goal and of the heading.
    maps = (len(OWN), len(NEIGHBOUR), len(OBSTACLE)), 3
    maker = "lagros reproduce spacecraft"
    network: DeepSet

    def __init__(
        self,
        *others: Any,
        receding: Receding | Mapping[str, float] | bool | None = None,
        **named: Any,
    ) -> None:
        self._asked = receding
        super().__init__(*others, **named)

    @cached_property
    def receding(self) -> Receding | None:
        """How far goals are shown; None for all the way."""
        settings = self.settings
        return Receding.chosen(self._asked, self.preset, settings.horizon, settings.speed_limit)

    def _looked_at(self) -> task.SpacecraftSettings:
        # Who is always shown the same time is not tied to T or to the end of an episode.
        if self.receding is None:
            return super()._looked_at()
        usual = task.SpacecraftSettings()
        return replace(self.settings, horizon=usual.horizon, time_limit=usual.time_limit)

    def predict(
        self,
        observation: Float32Array,
        state: PolicyState = None,
        episode_start: BoolArray | None = None,
        deterministic: bool = True,
    ) -> tuple[Float32Array, PolicyState]:
        """Evaluate the network for one agent (o,) or many (B, o); see `Policy.predict`.

        With receding goals the state is a `Waiting`, which the rule against deadlocks looks at.
        """
        rows = as_numbers(observation, np.float32)
        sensed = Sensed.of(self.layout, rows)
        if self.receding is not None:
            sensed, state = self._led(sensed, self.receding, state, episode_start)
        action = self._push(sensed) * (1.0 / self.settings.thrust_scale)
        return (action if rows.ndim == 2 else action[0]).astype(np.float32), state

    def counters(self, state: PolicyState) -> dict[str, int]:
        """Return how many detours there were, and how many control steps agents spent on them."""
        if self.receding is None:
            return {}
        counted = (int(part.sum()) for part in (state.detours, state.steps))
        return dict(zip(COUNTERS, counted, strict=True))

    def thrust(self, observation: Float32Array) -> FloatArray:
        """Return u >= 0 of each agent, shape (B, 8) [N], for observations (B, o) or (o,).

        It remembers nothing: there are no detours.
        """
        return self._push(Sensed.of(self.layout, observation))

    def _led(
        self,
        sensed: Sensed,
        receding: Receding,
        state: PolicyState,
        episode_start: BoolArray | None,
    ) -> tuple[Sensed, Waiting]:
        """Turn the goals of those who are on a detour; see `Receding.turned`."""
        count = len(sensed.own)
        memory = Waiting.begun(count) if state is None else state
        if not isinstance(memory, Waiting) or len(memory.waited) != count:
            raise ValueError(
                f"state must be what predict returned last for these {count} rows, or None at the "
                "start of an episode"
            )
        if episode_start is not None:
            memory = memory.restarted(np.ravel(episode_start).astype(bool))
        goal = np.ascontiguousarray(sensed.goal).view(np.complex128)[:, 0]
        settings = self.settings
        goal, memory = receding.turned(goal, memory, settings.goal_radius, settings.control_period)
        own = np.concatenate([goal.view(np.float64).reshape(-1, 2), sensed.own[:, 2:]], axis=1)
        return sensed._replace(own=own), memory

    def _push(self, sensed: Sensed) -> FloatArray:
        """Return u >= 0 of each agent, shape (B, 8) [N]."""
        features = self.features(sensed)
        wrench = self.network(features).astype(np.float64)
        body = self.settings.system
        # Into the world's axes, then into the body's, as complex numbers in place.
        force = wrench[:, :2].view(np.complex128)[:, 0]
        force *= features.frame
        force *= sensed.facing.view(np.complex128)[:, 0]
        wrench *= (body.mass, body.mass, 2.0 * body.inertia)
        return allocate(body, wrench)

    def features(self, sensed: Sensed) -> SetFeatures:
        """Return the inputs of the network."""
        radii = self.preset.agent_radius, self.preset.core
        return spacecraft_features(sensed, self.settings, *radii, receding=self.receding)

    def bare_forward(self, features: SetFeatures) -> Float32Array:
        """Evaluate the network alone, for timing."""
        return self.network(features)


class SpacecraftLearnedPolicy(SpacecraftNetworkPolicy):
    """Policy (a): o_l -> u_d of each spacecraft, learned on undisturbed plans."""

    name = recorded_as = "learned"
    weights_file = "spacecraft_learned.safetensors"


class SpacecraftLagrosPolicy(SpacecraftNetworkPolicy):
    """Policy (c): o_l -> u* of each spacecraft from what it senses alone.

    Where goals recede it flies the network that has learned crowds, if no weights are given.
    """

    name = recorded_as = "lagros"
    weights_file = "spacecraft_lagros.safetensors"

    def _shipped(self) -> str:
        return self.weights_file if self.receding is None else "spacecraft_crowds.safetensors"
