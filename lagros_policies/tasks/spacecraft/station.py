"""How station is kept: a network flies, and labels what it meets itself, but at the goal.

Who has arrived needs no plan: the gain of u* about the goal says what it should have done. Under
way, and where another agent is near, the network goes on as it does. So what station keeping costs
is decided by one gain, and not by the mixture of gains that the labels on the way are made with.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import check_above, check_fields
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.spacecraft.episode import SpacecraftEpisode
from lagros_envs.tasks.spacecraft.scenarios import Preset
from lagros_envs.tasks.spacecraft.sensing import observe
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.backends import LOKY, Backend
from lagros_policies.contraction.axis_gain import AxisGain
from lagros_policies.learning.shards import Shard, make_shards
from lagros_policies.tasks.spacecraft.expert import SEARCH_RADIUS
from lagros_policies.tasks.spacecraft.flights import (
    FlightData,
    FlightSettings,
    flown_preset,
    gathered,
    resize,
)
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftNetworkPolicy
from lagros_policies.tasks.spacecraft.sensed import Sensed


@dataclass(frozen=True)
class StationSettings:
    """What to fly, and where station is kept.

    Attributes:
        flights: The worlds; no expert plans there.
        rate: alpha of the gain about the goal [1/s].
        inner: Distance from the goal up to which the gain is the label [m].
        outer: Distance from which the network is; in between they are mixed [m].
        clearance: Gap to another agent below which the network is the label [m].

    Raises:
        ValueError: A value is out of range.
    """

    flights: FlightSettings = field(
        default_factory=lambda: FlightSettings(worlds=600, sample_every=5, seed=21)
    )
    rate: float = 1.5
    inner: float = 0.2
    outer: float = 0.5
    clearance: float = 0.3

    def __post_init__(self) -> None:
        check_fields(self, positive=("rate", "inner", "outer"), not_negative=("clearance",))
        check_above("outer", self.outer, self.inner)

    def share(self, sensed: Sensed, agent_radius: float) -> FloatArray:
        """Return how much of each label is the gain's, shape (B,).

        Args:
            sensed: What B agents sense.
            agent_radius: Of every agent [m].
        """
        distance = np.linalg.norm(sensed.goal, axis=-1)
        share = np.clip((self.outer - distance) / (self.outer - self.inner), 0.0, 1.0)
        gap = np.linalg.norm(sensed.neighbours[..., :2], axis=-1) - 2.0 * agent_radius
        near = np.any(sensed.neighbour_mask & (gap < self.clearance), axis=-1)
        value: FloatArray = np.where(near, 0.0, share)
        return value


def fly_station(
    folder: Path,
    settings: StationSettings,
    task: SpacecraftSettings,
    learner: Path,
    jobs: int = 1,
    on_shard: Callable[[int], None] | None = None,
    backend: Backend = LOKY,
) -> FlightData:
    """Fly and label, or finish what an interrupted call began; see `flights.fly_expert`.

    Args:
        folder: Where the shards are kept.
        settings: What to fly.
        task: The task.
        learner: Weights of the network that flies.
        jobs: Processes; they change no result.
        on_shard: Called with the number of shards that are finished.
        backend: Whose processes they are.

    Raises:
        ValueError: The folder holds flights of other settings, or a shard is damaged.
    """
    make = partial(make_shard, settings=settings, task=task, learner=learner.absolute())
    record = {
        "station": asdict(settings),
        "task": asdict(task),
        "learner": hashlib.sha256(learner.read_bytes()).hexdigest(),
    }
    shards = make_shards(folder, settings.flights.shards, make, record, jobs, on_shard, backend)
    return gathered(shards, settings.flights, task)


def make_shard(
    index: int, settings: StationSettings, task: SpacecraftSettings, learner: Path
) -> Shard:
    """Fly the worlds of one shard side by side and label what is met."""
    flights = settings.flights
    count = flights.worlds_per_shard
    seeds = episode_seeds(flights.seed, flights.worlds)[index * count : (index + 1) * count]
    rng = np.random.default_rng([flights.seed, index])
    preset = flown_preset(flights, rng)
    bound = float(flights.disturbance_bound * rng.random())
    episode = SpacecraftEpisode(None, preset, "uniform", bound, "all", None, task, count)
    streams = [episode_streams(seed) for seed in seeds]
    world = episode.world
    scenarios = [preset.sample(stream.scenario) for stream in streams]
    world.begin(np.arange(count), scenarios, [stream.disturbance for stream in streams])
    policy = SpacecraftNetworkPolicy(task, preset, weights=learner)
    gain = AxisGain.of_rate(settings.rate, task.control_period)
    rows, labels, of = [], [], []
    for step in range(task.steps):
        observation = observe(world, episode.layout).reshape(count * preset.agents, -1)
        sensed = Sensed.of(policy.layout, observation)
        if step % flights.sample_every == 0:
            # Who has strayed for good has nothing to teach.
            kept = np.hypot(*sensed.goal.T) <= SEARCH_RADIUS
            rows.append(observation[kept])
            labels.append(_label(policy, sensed, gain, settings, preset)[kept])
            of.append(np.repeat(np.arange(count), preset.agents)[kept])
        world.step(policy.thrust(observation).reshape(count, preset.agents, -1))
    return {
        "observation": resize(np.concatenate(rows), episode.layout, flights.layout(task)),
        "acceleration": np.concatenate(labels).astype(np.float32),
        "world": np.concatenate(of) + index * count,
        "plans": np.array(0),
        "failed_plans": np.array(0),
    }


def _label(
    policy: SpacecraftNetworkPolicy,
    sensed: Sensed,
    gain: AxisGain,
    settings: StationSettings,
    preset: Preset,
) -> FloatArray:
    """Return the accelerations of x, y and heading that are to be learned, shape (B, 3)."""
    features = policy.features(sensed)
    own = policy.network(features).astype(np.float64)
    plane = (own[:, 0] + 1j * own[:, 1]) * features.frame
    held = gain.deviation(-sensed.goal, sensed.velocity)
    share = settings.share(sensed, preset.agent_radius)
    mixed = (1.0 - share) * plane + share * (held[:, 0] + 1j * held[:, 1])
    return np.stack([mixed.real, mixed.imag, own[:, 2]], axis=-1)
