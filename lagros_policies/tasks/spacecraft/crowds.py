"""How crowds are learned: a guide, then a network, flies worlds of many, and the guide labels them.

The agents are shown receding goals at a pace of the flight, and take the detours of the rule
against deadlocks, so that what a network meets when it flies is what it has learned. In every other
shard the safety filter flies along: a network must know what it is led to as well.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from lagros_envs.arrays import Float32Array, FloatArray
from lagros_envs.checks import check_fields
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.spacecraft.episode import SpacecraftEpisode
from lagros_envs.tasks.spacecraft.scenarios import Preset, preset_named
from lagros_envs.tasks.spacecraft.sensing import observe
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings, applied_forces, settings_for
from lagros_policies.backends import LOKY, Backend
from lagros_policies.learning.shards import Shard, make_shards
from lagros_policies.learning.train_deep_set import SetSamples
from lagros_policies.policy import PolicyState
from lagros_policies.tasks.spacecraft.flights import (
    FlightSettings,
    flight_samples,
    flown_preset,
    gathered,
    resize,
)
from lagros_policies.tasks.spacecraft.guide import Guide
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftNetworkPolicy
from lagros_policies.tasks.spacecraft.receding import Receding
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.thrusters import allocate


@dataclass(frozen=True)
class CrowdSettings:
    """What to fly at one least pace.

    Attributes:
        flights: The worlds; no expert plans there.
        pace: As of `Receding` [m/s].
        fastest: Likewise.
        share: Likewise.
        guide: What labels, and flies first.

    Raises:
        ValueError: A value is out of range.
    """

    flights: FlightSettings
    pace: float = 0.4
    fastest: float = 0.7
    share: float = 0.5
    guide: Guide = field(default_factory=Guide)

    def __post_init__(self) -> None:
        check_fields(self, positive=("pace", "fastest", "share"))
        preset, agents = preset_named(self.flights.preset), self.flights.agents
        if len({settings_for(preset.for_agents(count)).horizon for count in agents}) > 1:
            raise ValueError(
                f"agents={agents}: the T of {self.flights.preset} grows with their number, and "
                "what is shown of a goal depends on it; fly them one by one"
            )

    @property
    def receding(self) -> Receding:
        """What the agents are shown."""
        return Receding(pace=self.pace, fastest=self.fastest, share=self.share)


def usual_rounds() -> tuple[tuple[CrowdSettings, ...], ...]:
    """Return the scenes of each round from which the network that ships is made."""
    few, many, usual = (12, 32), (10,), Guide()
    even = tuple(
        (preset, pace, pace, agents, usual)
        for preset, agents, paces in (
            ("swarm-45", few, (0.3, 0.4, 0.5)),
            ("gcbf", many, (0.4, 0.5)),
        )
        for pace in paces
    )
    # Who has time keeps more room, and who is in a hurry less.
    patient = Guide(pair_margin=0.24, obstacle_margin=0.17)
    hurried = Guide(pair_margin=0.1, obstacle_margin=0.06, look=1.5)
    paced = (
        ("swarm", 0.25, 0.7, (32,), patient),
        ("swarm-45", 0.5, 0.7, few, hurried),
        ("gcbf", 0.25, 0.33, many, usual),
    )
    # The scenes, the worlds of each, and their first seed, by round.
    rounds = (even, (12,) * 5, 41), (even, (8,) * 5, 51), (paced, (24, 24, 12), 61)
    return tuple(
        tuple(
            CrowdSettings(
                FlightSettings(
                    worlds=worlds,
                    worlds_per_shard=4,
                    agents=agents,
                    preset=preset,
                    sample_every=5,
                    seed=seed,
                ),
                pace,
                fastest,
                guide=guide,
            )
            for (preset, pace, fastest, agents, guide), worlds, seed in zip(
                scenes, counts, range(first, first + len(scenes)), strict=True
            )
        )
        for scenes, counts, first in rounds
    )


class _Guided(SpacecraftNetworkPolicy):
    """The policy of a crowd, which can fly the guide; it keeps what it saw and what it should do.

    Attributes:
        flies: Whether the guide flies, and not the network.
        sensed: What the agents sensed last, with the goals as the rule turned them.
        label: Accelerations that were right there, shape (B, 3).
    """

    flies: bool
    guide: Guide
    sensed: Sensed
    label: FloatArray

    def _push(self, sensed: Sensed) -> FloatArray:
        assert self.receding is not None
        features = self.features(sensed)
        own = self.network(features).astype(np.float64)
        radii = self.preset.agent_radius, self.preset.core
        way, left = np.hypot(*sensed.goal.T), self.settings.horizon - sensed.time
        pace = self.receding.pace_of(way, left)
        plane = self.guide.acceleration(sensed, pace, *radii)
        self.sensed = sensed
        self.label = np.stack([plane.real, plane.imag, own[:, 2]], axis=-1)
        if not self.flies:
            return super()._push(sensed)
        body = self.settings.system
        force = body.mass * plane * (sensed.facing[:, 0] + 1j * sensed.facing[:, 1])
        torque = 2.0 * body.inertia * own[:, 2]
        return allocate(body, np.stack([force.real, force.imag, torque], axis=-1))


def fly_crowd(
    folder: Path,
    settings: CrowdSettings,
    learner: Path,
    guided: bool,
    jobs: int = 1,
    on_shard: Callable[[int], None] | None = None,
    backend: Backend = LOKY,
) -> SetSamples:
    """Fly and label, or finish what an interrupted call began; see `flights.fly_expert`.

    Args:
        folder: Where the shards are kept.
        settings: What to fly.
        learner: Weights of the network that flies, and says how to turn.
        guided: Whether the guide flies in its place.
        jobs: Processes; they change no result.
        on_shard: Called with the number of shards that are finished.
        backend: Whose processes they are.

    Returns:
        Features and labels.

    Raises:
        ValueError: The folder holds flights of other settings, or a shard is damaged.
    """
    make = partial(make_shard, settings=settings, learner=learner.absolute(), guided=guided)
    record = {
        "crowd": asdict(settings),
        "guided": guided,
        "learner": hashlib.sha256(learner.read_bytes()).hexdigest(),
    }
    flights = settings.flights
    shards = make_shards(folder, flights.shards, make, record, jobs, on_shard, backend)
    preset, task = _largest(flights)
    data = gathered(shards, flights, task)
    return flight_samples(data, task, preset.agent_radius, preset.core, settings.receding)


def make_shard(index: int, settings: CrowdSettings, learner: Path, guided: bool) -> Shard:
    """Fly the worlds of one shard side by side and label what is met."""
    flights = settings.flights
    count = flights.worlds_per_shard
    seeds = episode_seeds(flights.seed, flights.worlds)[index * count : (index + 1) * count]
    rng = np.random.default_rng([flights.seed, index])
    preset = flown_preset(flights, rng)
    bound = float(flights.disturbance_bound * rng.random())
    episode = SpacecraftEpisode(None, preset, "uniform", bound, "all", None, None, count)
    world, task = episode.world, episode.settings
    streams = [episode_streams(seed) for seed in seeds]
    scenarios = [preset.sample(stream.scenario) for stream in streams]
    world.begin(np.arange(count), scenarios, [stream.disturbance for stream in streams])
    policy = _Guided(
        *(task, preset, None, learner, True),
        receding=settings.receding,
    )
    policy.flies, policy.guide = guided, settings.guide
    flying = SafetyFilter(policy, task, preset, None, bound) if index % 2 else policy
    rows: list[Float32Array] = []
    labels: list[FloatArray] = []
    state: PolicyState = None
    for step in range(task.steps):
        observation = observe(world, episode.layout).reshape(count * preset.agents, -1)
        action, state = flying.predict(observation, state)
        if step % flights.sample_every == 0:
            seen = observation.copy()
            seen[:, :2] = policy.sensed.goal
            rows.append(seen)
            labels.append(policy.label)
        world.step(applied_forces(task, action).reshape(count, preset.agents, -1))
    whose = np.repeat(np.arange(count), preset.agents)
    return {
        "observation": resize(
            np.concatenate(rows), episode.layout, flights.layout(_largest(flights)[1])
        ),
        "acceleration": np.concatenate(labels).astype(np.float32),
        "world": np.tile(whose, len(rows)) + index * count,
        "plans": np.array(0),
        "failed_plans": np.array(0),
    }


def _largest(flights: FlightSettings) -> tuple[Preset, SpacecraftSettings]:
    """Return the preset with as many agents as any world has, and its task."""
    preset = preset_named(flights.preset).for_agents(max(flights.agents))
    return preset, settings_for(preset)
