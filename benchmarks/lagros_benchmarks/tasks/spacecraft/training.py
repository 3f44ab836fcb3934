"""Reinforcement learning with spacecraft: one policy for all agents of all worlds.

Every agent of every world is a row. The rows come from `SpacecraftVectorEnv`, batched, or from
PettingZoo's environment through `ParallelVecEnv`; both give the same episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lagros_benchmarks.run.metrics import cluster_rate_interval
from lagros_benchmarks.tasks.spacecraft.course import SpacecraftTraining
from lagros_benchmarks.tasks.spacecraft.episodes import WorldsLoop, make_worlds
from lagros_benchmarks.training.agent import actor_network
from lagros_benchmarks.training.run import rounded
from lagros_benchmarks.training.sb3_parallel import ParallelVecEnv
from lagros_benchmarks.training.sb3_vector import SB3VectorEnv
from lagros_benchmarks.training.settings import CURVE, FINAL
from lagros_envs import spacecraft_v0
from lagros_envs.arrays import FloatArray
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.spacecraft.scenarios import preset_named
from lagros_envs.tasks.spacecraft.sensing import Layout
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings, settings_for
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.tasks.spacecraft.ppo import (
    FEATURES,
    WRENCH,
    SpacecraftPpoPolicy,
    look,
    thrust_of,
)
from lagros_policies.tasks.spacecraft.sensed import Sensed
from lagros_policies.tasks.spacecraft.setup import spacecraft_range
from lagros_policies.trained_for import weights_record

RATES = ("success", "strict_success", "paper_success", "collided")


class ShapedReward(VecEnvWrapper):
    """Makes it cost to be near to other bodies, and pay to be at the goal.

    The penalty and the bonus of the environment come once, at the first collision and at the first
    success; these come at every step, also to those that have collided already, which no
    observation tells apart. A body that is near costs w (1 - gap / reach)^2 per second, w from a
    touch on.

    Args:
        venv: The environment, with the plain observation of the spacecraft.
        layout: Of that observation.
        training: Its weights and reaches.
        period: Control period [s].
        goal_radius: Distance from the goal at which an agent has arrived [m].
        agent_radius: Of every agent [m].

    Attributes:
        share: Of the cost of being near that counts now.
    """

    def __init__(
        self,
        venv: VecEnv,
        layout: Layout,
        training: SpacecraftTraining,
        period: float,
        goal_radius: float,
        agent_radius: float,
    ) -> None:
        super().__init__(venv)
        self.layout, self.training, self.period = layout, training, period
        self.goal_radius, self.agent_radius = goal_radius, agent_radius
        self.share = 1.0

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every world."""
        return np.asarray(self.venv.reset())

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step; rewards are lower near others and higher at the goal."""
        observation, reward, done, infos = self.venv.step_wait()
        seen = np.array(observation)
        for row in np.flatnonzero(done):
            # What the step led to; the observation is of the next episode.
            seen[row] = infos[row]["terminal_observation"]
        sensed, run = Sensed.of(self.layout, seen), self.training
        others = np.linalg.norm(sensed.neighbours[..., :2], axis=-1) - 2.0 * self.agent_radius
        walls = np.linalg.norm(sensed.obstacles[..., :2], axis=-1)
        walls = walls - sensed.obstacles[..., 2] - self.agent_radius
        cost = run.nearness_weight * _nearness(others, sensed.neighbour_mask, run.nearness_range)
        cost += run.obstacle_weight * _nearness(walls, sensed.obstacle_mask, run.obstacle_range)
        arrived = np.linalg.norm(sensed.goal, axis=1) <= self.goal_radius
        shaped = reward + self.period * (run.goal_weight * arrived - self.share * cost)
        return observation, shaped.astype(np.float32), done, infos


def _nearness(gaps: FloatArray, mask: NDArray[np.bool_], reach: float) -> FloatArray:
    """Return the sum of (1 - gap / reach)^2 over the bodies that are sensed, shape (rows,)."""
    squares = np.clip(1.0 - gaps / reach, 0.0, 1.0) ** 2
    total: FloatArray = np.sum(squares * mask, axis=1)
    return total


class GoalFrame(VecEnvWrapper):
    """Shows the agent `look` of the observation and lets it act in the same frame.

    Its action has three numbers within -1 and 1; `thrust_of` makes eight thrusts of them.

    Args:
        venv: The environment, with the plain observation of the spacecraft.
        layout: Of that observation.
        settings: The task.
    """

    def __init__(self, venv: VecEnv, layout: Layout, settings: SpacecraftSettings) -> None:
        super().__init__(
            venv,
            observation_space=spaces.Box(-np.inf, np.inf, (FEATURES,), np.float32),
            action_space=spaces.Box(-1.0, 1.0, (WRENCH,), np.float32),
        )
        self.layout, self.settings = layout, settings

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every world and return the features (rows, 53)."""
        return self._look(np.asarray(self.venv.reset()))

    def step_async(self, actions: NDArray[np.floating]) -> None:
        """Store the thrusts of the coming step, from actions (rows, 3)."""
        self.venv.step_async(thrust_of(self.settings, self._axes, actions))

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step and map the observations, those of ended episodes included."""
        observation, reward, done, infos = self.venv.step_wait()
        rows = np.flatnonzero(done)
        if rows.size:
            last = np.stack([infos[row]["terminal_observation"] for row in rows])
            for row, features in zip(rows, look(self.layout, last).features, strict=True):
                infos[row]["terminal_observation"] = features
        return self._look(np.asarray(observation)), reward, done, infos

    def _look(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        seen = look(self.layout, observation)
        self._axes = seen.axes
        return seen.features


class SpacecraftLesson:
    """The spacecraft's part of a training run; see `run.Lesson`.

    Args:
        training: The run.
        parallel_env: Whether the rows come from PettingZoo's environment, one world at a time.
    """

    def __init__(self, training: SpacecraftTraining, parallel_env: bool = False) -> None:
        self.training = training
        preset = preset_named(training.preset).for_agents(training.agents)
        settings = replace(
            settings_for(preset),
            time_limit=training.time_limit,
            effort_weight=training.effort_weight,
            progress_weight=training.progress_weight,
        )
        layout = Layout.for_preset(preset, settings)
        self.shaped = ShapedReward(
            _rows(training, settings, parallel_env),
            layout,
            training,
            settings.control_period,
            settings.goal_radius,
            preset.agent_radius,
        )
        # The features have fixed scales; only the returns are normalised.
        self.venv: VecEnv = VecNormalize(
            GoalFrame(self.shaped, layout, settings),
            norm_obs=False,
            gamma=training.algorithm.discount,
        )

    def begin(self, segment: int) -> None:
        """Let the cost of being near grow: in full from the start, nobody would go anywhere."""
        run = self.training
        grown = min(1.0, segment / (run.growth * run.segments))
        self.shaped.share = run.first_share + (1.0 - run.first_share) * grown

    def figures(self, model: BaseAlgorithm) -> dict[str, float]:
        """Return the figures of the agents on the held-out worlds of the learning curve."""
        run = self.training
        seeds = episode_seeds(0, run.curve_episodes, CURVE)
        return summary(self._fly(model, run.preset, run.agents, seeds, run.disturbance_bound))

    def final(self, model: BaseAlgorithm) -> list[dict[str, Any]]:
        """Return the figures at the end, for each preset, number of agents and bound."""
        run = self.training
        seeds = episode_seeds(0, run.final_episodes, FINAL)
        return [
            self._final_row(model, preset, agents, seeds, bound)
            for preset in run.final_presets
            for agents in run.final_agents
            for bound in run.final_bounds
        ]

    def _final_row(
        self, model: BaseAlgorithm, preset: str, agents: int, seeds: Sequence[int], bound: float
    ) -> dict[str, Any]:
        measures = self._fly(model, preset, agents, seeds, bound)
        successes = measures["success"].reshape(-1, agents).sum(axis=1)
        interval = cluster_rate_interval(successes.tolist(), [agents] * len(seeds))
        return {
            "preset": preset,
            "agents": agents,
            "disturbance": self.training.disturbance,
            "bound": bound,
            "worlds": len(seeds),
            **rounded(summary(measures)),
            "success_ci95": [round(limit, 4) for limit in interval],
        }

    def save(self, model: BaseAlgorithm, path: Path) -> None:
        """Write the actor as safetensors."""
        network = actor_network(model)
        # It trains in shorter episodes, and is judged in those of the task.
        preset = preset_named(self.training.preset)
        trained_for = spacecraft_range(settings_for(preset), [preset])
        name = self.training.algorithm.name
        network.metadata.update(weights_record("spacecraft", name, trained_for))
        network.save(path)

    def _fly(
        self, model: BaseAlgorithm, preset: str, agents: int, seeds: Sequence[int], bound: float
    ) -> dict[str, NDArray[Any]]:
        # It is judged in other worlds than those in which it learns, too.
        policy = SpacecraftPpoPolicy(
            None, preset, agents, actor_network(model), allow_other_settings=True
        )
        return evaluate(policy, preset, agents, seeds, self.training.disturbance, bound)


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
        SpacecraftVectorEnv(
            training.rows, agents, compiled=False, autoreset_mode="same_step", **task
        )
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

    There is a world for each seed. The measures are the environment's own at the end of the
    episode, each of shape (worlds * agents,).
    """
    env = make_worlds(len(seeds), agents, preset, disturbance, bound, settings=policy.settings)
    loop = WorldsLoop(env, policy, past_the_end=True)
    for _ in loop.fly(list(seeds)):
        pass
    return {name: loop.info[name] for name in (*RATES, "effort_to_success", "success_time")}


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
