"""Algorithm 1 for the spacecraft: random worlds, joint plans, states in their tubes, labels u*.

In the first flights the expert itself flies, under random disturbances, and the states that it
meets fill the tubes of its plans (Theorem 4). In later ones a network flies and the expert, which
plans again every few seconds from where the agents are, labels what the network meets (DAgger).
Without disturbance the labels are u_d, which policy (a) imitates.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from lagros_envs.arrays import Float32Array, IntArray
from lagros_envs.checks import (
    check_above,
    check_disturbance_bound,
    check_each,
    check_fields,
    check_name,
    check_seed,
    check_whole,
)
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.tasks.spacecraft.episode import SpacecraftEpisode
from lagros_envs.tasks.spacecraft.scenarios import MOST_AGENTS, PRESETS, Preset, preset_named
from lagros_envs.tasks.spacecraft.sensing import Layout, observe
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_policies.backends import LOKY, Backend
from lagros_policies.learning.shards import Shard, make_shards
from lagros_policies.learning.train_deep_set import SetSamples
from lagros_policies.tasks.spacecraft.expert import SpacecraftExpert, SpacecraftExpertSettings
from lagros_policies.tasks.spacecraft.features import spacecraft_features
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftNetworkPolicy
from lagros_policies.tasks.spacecraft.receding import Receding
from lagros_policies.tasks.spacecraft.sensed import Sensed


@dataclass(frozen=True)
class FlightSettings:
    """What to fly.

    Attributes:
        worlds: Random worlds in all.
        worlds_per_shard: Worlds side by side; they share number of agents, density and d_bar.
        agents: Numbers of agents, drawn with equal chances.
        open_share: Share of the shards whose worlds may have no obstacles at all.
        disturbance_bound: Largest d_bar, uniform in the ball; each shard draws its own.
        replan_period: Time between the expert's plans [s]; None keeps the first one.
        sample_every: Control steps between samples, where the first plan is kept.
        sample_after: Control steps after a plan at which samples are taken, where plans are
            renewed: a network does not follow a plan that it does not know, so labels must be
            fresh.
        expert: The expert.
        preset: The preset of the worlds.
        seed: Seed of the run.

    Raises:
        ValueError: A value is out of range.
    """

    worlds: int = 600
    worlds_per_shard: int = 10
    agents: tuple[int, ...] = (1, 2, 4, 5, 6, 6, 6, 7, 8)
    open_share: float = 0.25
    disturbance_bound: float = 1.2
    replan_period: float | None = None
    sample_every: int = 4
    sample_after: tuple[int, ...] = (0, 3)
    expert: SpacecraftExpertSettings = field(default_factory=SpacecraftExpertSettings)
    preset: str = "paper"
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self)
        if self.worlds_per_shard < 1 or self.worlds < 1 or self.worlds % self.worlds_per_shard:
            raise ValueError(
                f"worlds_per_shard={self.worlds_per_shard} must divide worlds={self.worlds}"
            )
        check_seed(self.seed)
        check_name("preset", self.preset, PRESETS)
        check_each("agents", self.agents, 1, MOST_AGENTS)
        check_each("sample_after", self.sample_after, 0)
        check_whole("sample_every", self.sample_every)
        check_disturbance_bound("disturbance_bound", self.disturbance_bound)
        if not 0.0 <= self.open_share <= 1.0:
            raise ValueError(f"open_share={self.open_share!r} must be in [0, 1]")
        if self.replan_period is not None:
            check_above("replan_period", self.replan_period, 0, "or None")

    @property
    def shards(self) -> int:
        """How many shards there are."""
        return self.worlds // self.worlds_per_shard

    def layout(self, task: SpacecraftSettings) -> Layout:
        """Return the layout of the samples: that of the largest worlds."""
        return Layout.for_preset(preset_named(self.preset).for_agents(max(self.agents)), task)


@dataclass(frozen=True)
class FlightData:
    """Labelled observations.

    Attributes:
        observation: o_l, shape (s, layout.size).
        acceleration: Label, of x, y and heading, shape (s, 3) [m/s^2, m/s^2, rad/s^2].
        world: Which world each sample belongs to, shape (s,).
        layout: Of the observations.
        plans: Plans asked for.
        failed_plans: Plans that failed; worlds without a first plan give no samples.
    """

    observation: Float32Array
    acceleration: Float32Array
    world: IntArray
    layout: Layout
    plans: int
    failed_plans: int


def fly_expert(
    folder: Path,
    settings: FlightSettings,
    task: SpacecraftSettings | None = None,
    learner: Path | None = None,
    jobs: int = 1,
    on_shard: Callable[[int], None] | None = None,
    backend: Backend = LOKY,
) -> FlightData:
    """Fly and label, or finish what an interrupted call began.

    Args:
        folder: Where the shards are kept.
        settings: What to fly.
        task: The task.
        learner: Weights of the network that flies; None lets the expert fly.
        jobs: Processes; they change no result.
        on_shard: Called with the number of shards that are finished.
        backend: Whose processes they are; those of a cluster must see the weights at this path.

    Returns:
        All samples, in an order that does not depend on the processes.

    Raises:
        ValueError: The folder holds flights of other settings, or a shard is damaged.
    """
    task = task or SpacecraftSettings()
    # Processes elsewhere have a working folder of their own.
    weights = None if learner is None else learner.absolute()
    make = partial(make_shard, settings=settings, task=task, learner=weights)
    record = {
        "flights": asdict(settings),
        "task": asdict(task),
        "learner": None if learner is None else hashlib.sha256(learner.read_bytes()).hexdigest(),
    }
    shards = make_shards(folder, settings.shards, make, record, jobs, on_shard, backend)
    return gathered(shards, settings, task)


def gathered(
    shards: Sequence[Shard], settings: FlightSettings, task: SpacecraftSettings
) -> FlightData:
    """Return the samples of all shards in one.

    Args:
        shards: Of the flights, in their order.
        settings: What was flown.
        task: The task.
    """
    observation, acceleration, world = (
        np.concatenate([shard[name] for shard in shards])
        for name in ("observation", "acceleration", "world")
    )
    return FlightData(
        observation,
        acceleration,
        world,
        settings.layout(task),
        sum(int(shard["plans"]) for shard in shards),
        sum(int(shard["failed_plans"]) for shard in shards),
    )


def make_shard(
    index: int, settings: FlightSettings, task: SpacecraftSettings, learner: Path | None
) -> Shard:
    """Fly the worlds of one shard side by side and label what is met."""
    count = settings.worlds_per_shard
    seeds = episode_seeds(settings.seed, settings.worlds)[index * count : (index + 1) * count]
    rng = np.random.default_rng([settings.seed, index])
    preset = flown_preset(settings, rng)
    bound = float(settings.disturbance_bound * rng.random())
    episode = SpacecraftEpisode(None, preset, "uniform", bound, "all", None, task, count)
    streams = [episode_streams(seed) for seed in seeds]
    scenarios = [preset.sample(stream.scenario) for stream in streams]
    world = episode.world
    world.begin(np.arange(count), scenarios, [stream.disturbance for stream in streams])
    expert = SpacecraftExpert(scenarios, settings.expert, task)
    policy = None
    if learner is not None:
        policy = SpacecraftNetworkPolicy(task, preset, weights=learner)
    planned = np.array([expert.plan(one, 0, world.states[one]) for one in range(count)])
    fresh = np.zeros(count, bool)
    rows, labels, of = [], [], []
    for step in range(task.steps):
        states = world.states
        age = _age(settings, task, step, count)
        for one in np.flatnonzero(planned & (age == 0)):
            fresh[one] = expert.plan(int(one), step, states[one])
        observation = observe(world, episode.layout)
        if settings.replan_period is None:
            chosen = planned & (step % settings.sample_every == 0)
        else:
            chosen = fresh & np.isin(age, settings.sample_after)
        if chosen.any():
            label = expert.acceleration(step, states).astype(np.float32)
            rows.append(observation[chosen].reshape(-1, episode.layout.size))
            labels.append(label[chosen].reshape(-1, 3))
            of.append(np.repeat(np.flatnonzero(chosen), preset.agents))
        if policy is None:
            thrust = expert.control(step, states)
        else:
            flat = observation.reshape(count * preset.agents, -1)
            thrust = policy.thrust(flat).reshape(count, preset.agents, -1)
        world.step(thrust)
    return {
        "observation": resize(np.concatenate(rows), episode.layout, settings.layout(task)),
        "acceleration": np.concatenate(labels),
        "world": np.concatenate(of) + index * count,
        "plans": np.array(expert.plans),
        "failed_plans": np.array(expert.failed_plans),
        "success": world.info()["success"],
        "collided": world.collided,
    }


def flight_samples(
    data: FlightData,
    task: SpacecraftSettings,
    agent_radius: float,
    core_radius: float,
    receding: Receding | None = None,
) -> SetSamples:
    """Return features and labels of flights.

    Args:
        data: The flights.
        task: Their task.
        agent_radius: Radius of every agent against the others [m].
        core_radius: Radius against obstacles [m].
        receding: How far goals were shown; None for all the way.
    """
    sensed = Sensed.of(data.layout, data.observation)
    features = spacecraft_features(sensed, task, agent_radius, core_radius, receding)
    plane = data.acceleration[:, 0] + 1j * data.acceleration[:, 1]
    plane *= features.frame.conj()
    target = np.stack([plane.real, plane.imag, data.acceleration[:, 2]], axis=-1)
    return SetSamples(features, target.astype(np.float32), data.world)


def resize(observation: Float32Array, layout: Layout, larger: Layout) -> Float32Array:
    """Return observations (s, layout.size) with the empty slots of a larger layout."""
    resized = np.zeros((len(observation), larger.size), np.float32)
    for name, source in layout.slices.items():
        start = larger.slices[name].start
        resized[:, start : start + source.stop - source.start] = observation[:, source]
    return resized


def flown_preset(settings: FlightSettings, rng: np.random.Generator) -> Preset:
    """Draw the number of agents and the density of a shard's worlds."""
    preset = preset_named(settings.preset).for_agents(int(rng.choice(settings.agents)))
    fewest, most = preset.obstacle_count
    return replace(
        preset, obstacle_count=(0 if rng.random() < settings.open_share else fewest, most)
    )


def _age(settings: FlightSettings, task: SpacecraftSettings, step: int, worlds: int) -> IntArray:
    """Return how many steps ago each world planned again, (worlds,); -1 if it has not."""
    if settings.replan_period is None:
        return np.full(worlds, -1)
    every = max(1, round(settings.replan_period / task.control_period))
    # The worlds take turns; the plans of the start are no fresh ones.
    turn = step + np.arange(worlds) * every // worlds
    age: IntArray = np.where(turn >= every, turn % every, -1)
    return age
