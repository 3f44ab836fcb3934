"""Reinforcement learning with spacecraft: one policy for all agents of all worlds.

Every agent of every world is a row. The rows come from `SpacecraftVectorEnv`, batched, or from
PettingZoo's environment through `ParallelVecEnv`; both give the same episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lagros_benchmarks.metrics import cluster_rate_interval
from lagros_benchmarks.sb3_parallel import ParallelVecEnv
from lagros_benchmarks.sb3_vector import SB3VectorEnv
from lagros_benchmarks.training.agent import actor_network
from lagros_benchmarks.training.run import rounded
from lagros_benchmarks.training.settings import CURVE, FINAL, SpacecraftTraining
from lagros_envs import spacecraft_v0
from lagros_envs.observation import Layout
from lagros_envs.scenarios import preset_named
from lagros_envs.seeding import episode_seeds
from lagros_envs.spacecraft_task import SpacecraftSettings
from lagros_envs.spacecraft_vector import SpacecraftVectorEnv
from lagros_policies.sensed import Sensed
from lagros_policies.spacecraft_ppo import FEATURES, SpacecraftPpoPolicy, body_features

RATES = ("success", "strict_success", "paper_success", "collided")


class KeepDistance(VecEnvWrapper):
    """Makes nearness to other agents cost, so that avoidance is learnt before collisions teach it.

    The penalty of the environment comes once, at the first collision; this comes at every step, and
    to those that have collided already, which no observation tells apart.

    Args:
        venv: The environment, with the plain observation of the spacecraft.
        layout: Of that observation.
        touch: Distance of two centres at a touch [m].
        weight: Cost per second at a touch.
        reach: Distance beyond touching at which it has fallen to nothing [m].
        period: Control period [s].
    """

    def __init__(
        self,
        venv: VecEnv,
        layout: Layout,
        touch: float,
        weight: float,
        reach: float,
        period: float,
    ) -> None:
        """Wrap the environment; see the class."""
        super().__init__(venv)
        self.layout, self.touch, self.reach = layout, touch, reach
        self.cost_of_step = weight * period

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every world."""
        return np.asarray(self.venv.reset())

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step; rewards are lower where agents are close to each other."""
        observation, reward, done, infos = self.venv.step_wait()
        seen = np.array(observation)
        for row in np.flatnonzero(done):
            # What the step led to; the observation is of the next episode.
            seen[row] = infos[row]["terminal_observation"]
        sensed = Sensed.of(self.layout, seen)
        gaps = np.linalg.norm(sensed.neighbours[..., :2], axis=-1) - self.touch
        nearness = np.clip(1.0 - gaps / self.reach, 0.0, 1.0)
        cost = np.sum(nearness * sensed.neighbour_mask, axis=1)
        lowered = reward - self.cost_of_step * cost
        return observation, lowered.astype(np.float32), done, infos


class BodyFeatures(VecEnvWrapper):
    """Shows the agent `body_features` of the observation.

    Args:
        venv: The environment, with the plain observation of the spacecraft.
        layout: Of that observation.
    """

    def __init__(self, venv: VecEnv, layout: Layout) -> None:
        """Wrap the environment; see the class."""
        space = spaces.Box(-np.inf, np.inf, (FEATURES,), np.float32)
        super().__init__(venv, observation_space=space)
        self.layout = layout

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every world and return the features (rows, 27)."""
        return body_features(self.layout, np.asarray(self.venv.reset()))

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step and map the observations, those of ended episodes included."""
        observation, reward, done, infos = self.venv.step_wait()
        rows = np.flatnonzero(done)
        if rows.size:
            last = np.stack([infos[row]["terminal_observation"] for row in rows])
            for row, features in zip(rows, body_features(self.layout, last), strict=True):
                infos[row]["terminal_observation"] = features
        return body_features(self.layout, np.asarray(observation)), reward, done, infos


class SpacecraftLesson:
    """The spacecraft's part of a training run; see `run.Lesson`.

    Args:
        training: The run.
        parallel_env: Whether the rows come from PettingZoo's environment, one world at a time.

    Attributes:
        venv: The worlds as the agents meet them.
    """

    def __init__(self, training: SpacecraftTraining, parallel_env: bool = False) -> None:
        """Build the worlds; see the class."""
        self.training = training
        settings = SpacecraftSettings(
            time_limit=training.time_limit, effort_weight=training.effort_weight
        )
        preset = preset_named(training.preset).for_agents(training.agents)
        layout = Layout.for_preset(preset, settings)
        apart = KeepDistance(
            _rows(training, settings, parallel_env),
            layout,
            2.0 * preset.agent_radius,
            training.nearness_weight,
            training.nearness_range,
            settings.control_period,
        )
        # The features have fixed scales; only the returns are normalised.
        self.venv: VecEnv = VecNormalize(
            BodyFeatures(apart, layout), norm_obs=False, gamma=training.algorithm.discount
        )

    def figures(self, model: BaseAlgorithm) -> dict[str, float]:
        """Return the figures of the agents on the held-out worlds of the learning curve."""
        run = self.training
        seeds = episode_seeds(0, run.curve_episodes, CURVE)
        return summary(self._fly(model, run.agents, seeds, run.disturbance_bound))

    def final(self, model: BaseAlgorithm) -> list[dict[str, Any]]:
        """Return the figures at the end, for each number of agents and bound."""
        run = self.training
        seeds = episode_seeds(0, run.final_episodes, FINAL)
        rows = []
        for agents in run.final_agents:
            for bound in run.final_bounds:
                measures = self._fly(model, agents, seeds, bound)
                successes = measures["success"].reshape(-1, agents).sum(axis=1)
                interval = cluster_rate_interval(successes.tolist(), [agents] * len(seeds))
                rows.append(
                    {
                        "agents": agents,
                        "disturbance": run.disturbance,
                        "bound": bound,
                        "worlds": len(seeds),
                        **rounded(summary(measures)),
                        "success_ci95": [round(limit, 4) for limit in interval],
                    }
                )
        return rows

    def save(self, model: BaseAlgorithm, path: Path) -> None:
        """Write the actor as safetensors."""
        actor_network(model).save(path)

    def _fly(
        self, model: BaseAlgorithm, agents: int, seeds: Sequence[int], bound: float
    ) -> dict[str, NDArray[Any]]:
        run = self.training
        policy = SpacecraftPpoPolicy(SpacecraftSettings(), run.preset, agents, actor_network(model))
        return evaluate(policy, run.preset, agents, seeds, run.disturbance, bound)


def _rows(training: SpacecraftTraining, settings: SpacecraftSettings, parallel_env: bool) -> VecEnv:
    task: dict[str, Any] = {
        "preset": training.preset,
        "disturbance": training.disturbance,
        "disturbance_bound": training.disturbance_bound,
        "settings": settings,
    }
    agents = training.agents
    if parallel_env:
        return ParallelVecEnv(
            [spacecraft_v0.parallel_env(agents, **task) for _ in range(training.worlds)]
        )
    return SB3VectorEnv(
        SpacecraftVectorEnv(training.rows, agents, autoreset_mode="same_step", **task)
    )


def evaluate(
    policy: SpacecraftPpoPolicy,
    preset: str,
    agents: int,
    seeds: Sequence[int],
    disturbance: str,
    bound: float,
) -> dict[str, NDArray[Any]]:
    """Fly a policy through whole episodes of the task and return its measures, agent by agent.

    Args:
        policy: The policy.
        preset: Preset of the scenarios.
        agents: Number of agents in each world.
        seeds: Seed of each world.
        disturbance: Kind of disturbance.
        bound: d_bar, in units of the state per second.

    Returns:
        The environment's own measures at the end of the episode, each of shape (worlds * agents,).
    """
    env = SpacecraftVectorEnv(
        len(seeds) * agents,
        agents,
        preset,
        disturbance,
        bound,
        settings=policy.settings,
        autoreset_mode="disabled",
    )
    observation, info = env.reset(seed=list(seeds))
    for _ in range(policy.settings.steps):
        action, _ = policy.predict(observation)
        observation, _, _, _, info = env.step(action)
    return {name: info[name] for name in (*RATES, "effort_to_success", "success_time")}


def summary(measures: dict[str, NDArray[Any]]) -> dict[str, float]:
    """Return shares of agents, the mean effort to success [N^2 s] and the mean time to it [s].

    The effort counts everyone, to the end of the episode if it had no success; the time counts
    those that had (0 if none had).
    """
    times = measures["success_time"]
    reached = times[np.isfinite(times)]
    return {
        **{name: float(np.mean(measures[name])) for name in RATES},
        "effort_to_success": float(np.mean(measures["effort_to_success"])),
        "success_time": float(np.mean(reached)) if reached.size else 0.0,
    }
