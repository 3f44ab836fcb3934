"""Train one PPO agent for all spacecraft: `python -m lagros_benchmarks.train_spacecraft_ppo`.

An example of multi-agent learning with stable-baselines3: every agent of every world is a row, and
one policy drives them all in the preset `open`. The rows come from `SpacecraftVectorEnv`, batched,
or with `--parallel-env` from PettingZoo's environment through `ParallelVecEnv`; both give the same
episodes. The run is cut into segments with checkpoints, like that of `train_ppo`.
"""

from __future__ import annotations

import argparse
import json
import logging
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lagros_benchmarks.files import write_json
from lagros_benchmarks.metrics import wilson_interval
from lagros_benchmarks.ppo_run import (
    CURVE_SEED,
    PpoTraining,
    actor_network,
    agent,
    rounded,
    run_segments,
    versions,
)
from lagros_benchmarks.sb3_parallel import ParallelVecEnv
from lagros_benchmarks.sb3_vector import SB3VectorEnv
from lagros_benchmarks.spacecraft_ppo import ACTOR, FEATURES, SpacecraftPpoPolicy, body_features
from lagros_envs import spacecraft_v0
from lagros_envs.observation import Layout
from lagros_envs.scenarios import preset_named
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.spacecraft_task import SpacecraftSettings
from lagros_envs.spacecraft_vector import SpacecraftVectorEnv
from lagros_policies.sensed import Sensed

_LOG = logging.getLogger(__name__)
_COMMAND = "python -m lagros_benchmarks.train_spacecraft_ppo"
PRESET = "open"
RATES = ("success", "strict_success", "paper_success", "collided")


@dataclass(frozen=True)
class SpacecraftPpoTraining(PpoTraining):
    """A training run with spacecraft; attributes as in `PpoTraining`, and these.

    Attributes:
        initial_log_std: -2 is 0.14 N of each thruster.
        effort_weight: That of the environment.
        agents: Agents in each world.
        time_limit: Of an episode in training [s]: most of the 45 s of the task are spent at the
            goal, where there is little left to learn.
        nearness_weight: Reward per second at a touch of another agent, negative sign applied.
        nearness_range: Distance beyond touching at which that has fallen to nothing [m].
        final_agents: Numbers of agents in the evaluation at the end.
        final_bounds: Their d_bar.
    """

    segments: int = 10
    rollouts: int = 20
    rollout_steps: int = 128
    worlds: int = 24
    batch_size: int = 4608
    epochs: int = 5
    learning_rate: float = 7e-4
    effort_weight: float = 0.02
    disturbance_bound: float = 0.4
    curve_episodes: int = 50
    final_episodes: int = 200
    agents: int = 6
    time_limit: float = 20.0
    nearness_weight: float = 5.0
    nearness_range: float = 0.5
    final_agents: tuple[int, ...] = (3, 4, 5, 6)
    final_bounds: tuple[float, ...] = (0.2, 0.4)

    @property
    def segment_steps(self) -> int:
        """Control steps of a segment, over all agents of all worlds."""
        return super().segment_steps * self.agents


class KeepDistance(VecEnvWrapper):
    """Makes nearness to other agents cost, so that avoidance is learnt before collisions teach it.

    The penalty of the environment comes once, at the first collision; this comes at every step, and
    to those that have collided already, which no observation tells apart.

    Args:
        venv: The environment, with the plain observation of the spacecraft.
        layout: Of that observation.
        touch: Distance of two centres at a touch [m].
        training: For `nearness_weight` and `nearness_range`.
        period: Control period [s].
    """

    def __init__(
        self,
        venv: VecEnv,
        layout: Layout,
        touch: float,
        training: SpacecraftPpoTraining,
        period: float,
    ) -> None:
        """Wrap the environment; see the class."""
        super().__init__(venv)
        self.layout, self.touch, self.training, self.period = layout, touch, training, period

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
        nearness = np.clip(1.0 - gaps / self.training.nearness_range, 0.0, 1.0)
        cost = np.sum(nearness * sensed.neighbour_mask, axis=1)
        lowered = reward - self.training.nearness_weight * self.period * cost
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


def build(training: SpacecraftPpoTraining, parallel_env: bool = False) -> tuple[PPO, VecNormalize]:
    """Return the untrained agent and its environment.

    Args:
        training: The run.
        parallel_env: Whether the rows come from PettingZoo's environment, one world at a time.
    """
    settings = SpacecraftSettings(
        time_limit=training.time_limit, effort_weight=training.effort_weight
    )
    task: dict[str, Any] = {
        "preset": PRESET,
        "disturbance": training.disturbance,
        "disturbance_bound": training.disturbance_bound,
        "settings": settings,
    }
    venv: VecEnv
    if parallel_env:
        venv = ParallelVecEnv(
            [spacecraft_v0.parallel_env(training.agents, **task) for _ in range(training.worlds)]
        )
    else:
        rows = training.worlds * training.agents
        venv = SB3VectorEnv(
            SpacecraftVectorEnv(rows, training.agents, autoreset_mode="same_step", **task)
        )
    preset = preset_named(PRESET).for_agents(training.agents)
    layout = Layout.for_preset(preset, settings)
    apart = KeepDistance(venv, layout, 2.0 * preset.agent_radius, training, settings.control_period)
    # The features have fixed scales; only the returns are normalised.
    normalised = VecNormalize(BodyFeatures(apart, layout), norm_obs=False, gamma=training.discount)
    return agent(training, normalised), normalised


def evaluate(
    policy: SpacecraftPpoPolicy, agents: int, seeds: Sequence[int], disturbance: str, bound: float
) -> dict[str, NDArray[Any]]:
    """Fly the policy through whole episodes of the task and return its measures, agent by agent.

    Args:
        policy: The policy.
        agents: Number of agents in each world.
        seeds: Seed of each world.
        disturbance: Kind of disturbance.
        bound: d_bar.

    Returns:
        The environment's own measures at the end of the episode, each of shape (worlds * agents,).
    """
    settings = SpacecraftSettings()
    pilot = SpacecraftPpoPolicy(settings, PRESET, agents, policy.network)
    env = SpacecraftVectorEnv(
        len(seeds) * agents,
        agents,
        PRESET,
        disturbance,
        bound,
        settings=settings,
        autoreset_mode="disabled",
    )
    observation, info = env.reset(seed=list(seeds))
    for _ in range(settings.steps):
        action, _ = pilot.predict(observation)
        observation, _, _, _, info = env.step(action)
    return {name: info[name] for name in (*RATES, "effort_to_success", "success_time")}


def figures(measures: dict[str, NDArray[Any]]) -> dict[str, float]:
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


def train(
    training: SpacecraftPpoTraining,
    out: Path | str,
    checkpoint: Path | str,
    parallel_env: bool = False,
) -> dict[str, Any]:
    """Train, or go on with a training that was interrupted, and write the actor.

    Args:
        training: The run.
        out: The safetensors file to write at the end.
        checkpoint: Where the state of the run is kept between segments.
        parallel_env: As in `build`.

    Returns:
        The record of the run, JSON-serialisable.

    Raises:
        ValueError: The checkpoint is damaged or belongs to another run.
    """
    model, normalised = build(training, parallel_env)
    held_out = episode_seeds(CURVE_SEED, training.curve_episodes)

    def reached() -> dict[str, float]:
        policy = SpacecraftPpoPolicy(weights=actor_network(model))
        bound = training.disturbance_bound
        return figures(evaluate(policy, training.agents, held_out, training.disturbance, bound))

    curve = run_segments(training, model, normalised, Path(checkpoint), reached)
    network = actor_network(model)
    network.save(out)
    return record(training, curve, final_rows(training, SpacecraftPpoPolicy(weights=network)))


def final_rows(
    training: SpacecraftPpoTraining, policy: SpacecraftPpoPolicy
) -> list[dict[str, Any]]:
    """Return the figures on the episodes of `lagros bench`, for each number of agents and bound.

    The interval of the success rate takes agents for independent, which those of one world are not
    quite.
    """
    seeds = episode_seeds(0, training.final_episodes, EVALUATION)
    rows = []
    for agents in training.final_agents:
        for bound in training.final_bounds:
            measures = evaluate(policy, agents, seeds, training.disturbance, bound)
            successes = measures["success"]
            interval = wilson_interval(int(successes.sum()), successes.size)
            row = {
                "agents": agents,
                "disturbance": training.disturbance,
                "bound": bound,
                "worlds": len(seeds),
                **rounded(figures(measures)),
                "success_ci95": [round(limit, 4) for limit in interval],
            }
            _LOG.info("%s", json.dumps(row))
            rows.append(row)
    return rows


def record(
    training: SpacecraftPpoTraining, curve: list[dict[str, float]], final: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return what is written down about a run."""
    return {
        "command": f"{_COMMAND} --seed {training.seed} --segments {training.segments} "
        "--json benchmarks/results/spacecraft_ppo_open.json",
        "algorithm": "PPO of stable-baselines3, one actor and one critic for all agents",
        "task": f"spacecraft, preset {PRESET}",
        "budget": {
            "agent_steps": training.segments * training.segment_steps,
            "seconds": curve[-1]["seconds"],
            "torch_threads": torch.get_num_threads(),
        },
        "training": asdict(training),
        "features": "goal and the three nearest neighbours in the body's axes, fixed scales",
        "curve_seed": CURVE_SEED,
        "curve": {key: [point[key] for point in curve] for key in curve[0]},
        "final_seed": 0,
        "final": final,
        "versions": versions(),
        "machine": platform.machine(),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from the command line.

    Args:
        arguments: The arguments; None for those of the process.
    """
    parser = argparse.ArgumentParser(
        prog=_COMMAND,
        description="Train one PPO agent for all spacecraft of the preset `open`. Started again "
        "after an interruption, it goes on from the last checkpoint.",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the run (default: 0)")
    parser.add_argument(
        "--segments",
        type=int,
        default=SpacecraftPpoTraining.segments,
        help="length of the run (default: %(default)s)",
    )
    parser.add_argument(
        "--parallel-env",
        action="store_true",
        help="take the rows from PettingZoo's environment: the same episodes, and slower",
    )
    parser.add_argument(
        "--out", type=Path, default=ACTOR, help="the actor to write (default: %(default)s)"
    )
    parser.add_argument("--json", type=Path, help="write the record of the run to this file")
    parser.add_argument(
        "--checkpoint",
        type=Path,
        help="state of the run (default: runs/ppo/spacecraft-seed-SEED.pt); deleted when the run "
        "is complete",
    )
    options = parser.parse_args(arguments)
    if options.seed < 0:
        parser.error("--seed must be >= 0")
    if options.segments < 1:
        parser.error("--segments must be >= 1")
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(message)s")
    # One thread: networks this small gain nothing from more, and the sums stay reproducible.
    torch.set_num_threads(1)
    training = replace(SpacecraftPpoTraining(seed=options.seed), segments=options.segments)
    checkpoint = options.checkpoint or ACTOR.parent / f"spacecraft-seed-{options.seed}.pt"
    written = train(training, options.out, checkpoint, options.parallel_env)
    if options.json is not None:
        write_json(options.json, written)
        _LOG.info("wrote %s", options.json)
    checkpoint.unlink()
    _LOG.info("wrote %s", options.out)


if __name__ == "__main__":
    main()
