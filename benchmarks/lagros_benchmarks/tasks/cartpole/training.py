"""Reinforcement learning on the cart-pole: what the agent sees, its figures, its actor.

An agent controls the cart-pole alone, or corrects LAG-ROS by a force of at most beta newtons.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from lagros_benchmarks.run.metrics import wilson_interval
from lagros_benchmarks.training.agent import actor_network
from lagros_benchmarks.training.run import rounded
from lagros_benchmarks.training.sb3_vector import LinearFeatures, SB3VectorEnv
from lagros_benchmarks.training.settings import CURVE, FINAL, CartPoleTraining, OffPolicy
from lagros_envs.conventions import beyond_the_end
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.vector import CartPoleVectorEnv
from lagros_policies.actor import Actor, ActorPolicy, goal_frame
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.policy import Policy
from lagros_policies.residual import ResidualPolicy
from lagros_policies.trained_for import training_of, weights_record

# What is large on this task, for the features of an agent without running normalisation: the
# farthest goal [m], a start [rad], and the rates of a cart that hurries there [m/s, rad/s].
FEATURE_SCALES = (5.0, 1.0, 5.0, 3.0)


class CorrectedWorlds(VecEnvWrapper):
    """Adds the action of a base policy to that of the agent.

    The agent's action, clipped to its space, is a correction in units of beta.

    Args:
        venv: The cart-pole with its plain observation.
        base: The policy that is corrected; it must remember nothing.
        largest_correction: beta [N].
        force_scale: Force of the action 1.0 of the environment [N].
    """

    def __init__(
        self, venv: VecEnv, base: Policy, largest_correction: float, force_scale: float
    ) -> None:
        """Wrap the environment; see the class."""
        super().__init__(venv, action_space=spaces.Box(-1.0, 1.0, (1,), np.float32))
        self.base = base
        self.scale = largest_correction / force_scale
        self._observation: NDArray[np.float32] | None = None

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every world and return the observations (worlds, 13)."""
        self._observation = np.asarray(self.venv.reset())
        return self._observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the corrections (worlds, 1) of the coming step.

        Raises:
            RuntimeError: The environment was not reset.
        """
        if self._observation is None:
            raise RuntimeError("call reset() before step_async()")
        forces, _ = self.base.predict(self._observation)
        self.venv.step_async(forces + self.scale * np.clip(actions, -1.0, 1.0))

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step: observations, rewards, dones and infos as they come."""
        observation, reward, done, infos = self.venv.step_wait()
        self._observation = np.asarray(observation)
        return self._observation, reward, done, infos


class CartPoleLesson:
    """The cart-pole's part of a training run; see `run.Lesson`.

    Args:
        training: The run.

    Attributes:
        venv: The worlds as the agent meets them.
    """

    def __init__(self, training: CartPoleTraining) -> None:
        """Build the worlds; see the class."""
        self.training = training
        settings = task.CartPoleSettings(effort_weight=training.effort_weight)
        self.settings = settings
        self.force_scale = settings.force_scale
        worlds = CartPoleVectorEnv(
            training.worlds,
            disturbance=training.disturbance,
            disturbance_bound=training.disturbance_bound,
            settings=settings,
            # The weights must not depend on whether numba is installed.
            compiled=False,
            autoreset_mode="same_step",
        )
        venv: VecEnv = SB3VectorEnv(worlds)
        if training.largest_correction is not None:
            base = LagrosPolicy(settings)
            venv = CorrectedWorlds(venv, base, training.largest_correction, self.force_scale)
            self.force_scale = training.largest_correction
        if isinstance(training.algorithm, OffPolicy):
            # A buffer of old features must not change its meaning: their scale is fixed.
            scales = np.array(FEATURE_SCALES)[:, None]
            self.venv: VecEnv = LinearFeatures(venv, goal_frame(settings) / scales)
        else:
            features = LinearFeatures(venv, goal_frame(settings))
            self.venv = VecNormalize(features, gamma=training.algorithm.discount)

    def policy(self, model: BaseAlgorithm) -> Policy:
        """Return the agent as it is now, as a policy of the cart-pole."""
        actor = extract_actor(model, self.force_scale)
        if self.training.largest_correction is None:
            return ActorPolicy(weights=actor)
        return ResidualPolicy(weights=actor)

    def begin(self, segment: int) -> None:
        """Do nothing: all segments are alike."""

    def figures(self, model: BaseAlgorithm) -> dict[str, float]:
        """Return the figures of the agent on the held-out episodes of the learning curve."""
        run = self.training
        seeds = episode_seeds(0, run.curve_episodes, CURVE)
        return evaluate(self.policy(model), seeds, run.disturbance, run.disturbance_bound)

    def final(self, model: BaseAlgorithm) -> list[dict[str, Any]]:
        """Return the figures at the end, without a disturbance and with that of the training."""
        run, policy = self.training, self.policy(model)
        seeds = episode_seeds(0, run.final_episodes, FINAL)
        rows = []
        for kind, bound in (("none", 0.0), (run.disturbance, run.disturbance_bound)):
            figures = evaluate(policy, seeds, kind, bound)
            successes = round(figures["success"] * len(seeds))
            interval = wilson_interval(successes, len(seeds))
            rows.append(
                {
                    "disturbance": kind,
                    "bound": bound,
                    "episodes": len(seeds),
                    **rounded(figures),
                    "success_ci95": [round(limit, 4) for limit in interval],
                }
            )
        return rows

    def save(self, model: BaseAlgorithm, path: Path) -> None:
        """Write the actor as safetensors."""
        plain = self.training.largest_correction is None
        name = self.training.algorithm.name if plain else "residual"
        metadata = weights_record("cartpole", name, training_of(self.settings).range(timed=False))
        replace(extract_actor(model, self.force_scale), metadata=metadata).save(path)


def extract_actor(model: BaseAlgorithm, force_scale: float = 40.0) -> Actor:
    """Return the mean action of an agent as arrays.

    Args:
        model: A PPO, SAC or TD3 of the policy "MlpPolicy" with tanh layers on a Box action of one
            number. It may look at the observation through `LinearFeatures` and `VecNormalize`.
        force_scale: Force of the action 1.0 in the training [N].

    Raises:
        ValueError: The policy is not such a network.
    """
    network = actor_network(model)
    space = model.action_space
    if not isinstance(space, spaces.Box) or not np.array_equal(space.low, -space.high):
        raise ValueError(f"the action space {space} is not a symmetric Box")
    features = _features(model)
    count = features.shape[0]
    mean, std, clip = np.zeros(count), np.ones(count), float(np.finfo(np.float32).max)
    normalised = model.get_vec_normalize_env()
    if normalised is not None and normalised.norm_obs:
        statistics: Any = normalised.obs_rms
        mean, std = statistics.mean, np.sqrt(statistics.var + normalised.epsilon)
        clip = float(normalised.clip_obs)
    return Actor(
        network=network,
        features=features.astype(np.float32),
        mean=mean.astype(np.float32),
        std=std.astype(np.float32),
        feature_clip=clip,
        action_clip=float(space.high[0]),
        control_scale=(force_scale,),
        squash="clip" if isinstance(model, PPO) else "tanh",
    )


def _features(model: BaseAlgorithm) -> NDArray[Any]:
    venv: Any = model.get_env()
    while venv is not None:
        if isinstance(venv, LinearFeatures):
            return venv.matrix
        venv = getattr(venv, "venv", None)
    return np.eye(task.OBSERVATION_DIM)


def evaluate(policy: Any, seeds: list[int], disturbance: str, bound: float) -> dict[str, float]:
    """Run a policy that remembers nothing over episodes and return its figures.

    Args:
        policy: The policy; it has the attribute `settings`.
        seeds: Of the episodes.
        disturbance: Kind of disturbance.
        bound: d_bar, in units of the state per second.

    Returns:
        Shares of episodes: `success` (the paper's), `strict` (inside the tube at the end, never
        fell) and `fallen`; means over all episodes: `effort` (to the end or the fall) [N^2 s] and
        `effort_to_success`; `final_distance`, the mean over those that did not fall (0 if all did);
        `reward`, the mean of the task's own reward over an episode.
    """
    venv = CartPoleVectorEnv(
        len(seeds),
        disturbance=disturbance,
        disturbance_bound=bound,
        settings=policy.settings,
        compiled=False,
        autoreset_mode="disabled",
    )
    observation, info = venv.reset(seed=seeds)
    fallen, rewards = np.zeros(len(seeds), dtype=bool), np.zeros(len(seeds))
    last = {key: np.array(info[key]) for key in ("success", "effort", "effort_to_success")}
    for _ in range(policy.settings.steps):
        action, _ = policy.predict(observation)
        action = np.where(fallen[:, None], 0.0, action)
        with beyond_the_end():
            observation, reward, terminated, _, info = venv.step(action)
        rewards += np.where(fallen, 0.0, reward)
        for key, values in last.items():
            values[~fallen] = info[key][~fallen]
        fallen |= terminated
    standing = info["goal_distance"][~fallen]
    return {
        "success": float(np.mean(last["success"])),
        "strict": float(np.mean(info["inside_tube"] & ~fallen)),
        "fallen": float(np.mean(fallen)),
        "effort": float(np.mean(last["effort"])),
        "effort_to_success": float(np.mean(last["effort_to_success"])),
        "final_distance": float(np.mean(standing)) if standing.size else 0.0,
        "reward": float(np.mean(rewards)),
    }
