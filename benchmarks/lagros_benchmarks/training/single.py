"""Reinforcement learning of one body: what the agent sees, its figures, its actor.

An agent controls the body alone, or corrects LAG-ROS by at most beta.
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

from lagros_benchmarks.training.agent import actor_network
from lagros_benchmarks.training.evaluation import evaluate, final_row
from lagros_benchmarks.training.sb3_vector import LinearFeatures, SB3VectorEnv
from lagros_benchmarks.training.settings import CURVE, FINAL, OffPolicy, SingleTraining
from lagros_envs.seeding import episode_seeds
from lagros_envs.task import Numbers, Task
from lagros_envs.vector import TaskVectorEnv
from lagros_policies.actor import Actor, ActorPolicy, goal_frame
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.policy import BasePolicy
from lagros_policies.residual import ResidualPolicy
from lagros_policies.trained_for import training_of, weights_record


class CorrectedWorlds(VecEnvWrapper):
    """Adds the action of a base policy to that of the agent.

    The agent's action, clipped to its space, is a correction in units of beta.

    Args:
        venv: The worlds with their plain observation.
        base: The policy that is corrected; it must remember nothing.
        largest_correction: beta, in units of the control.
        control_scale: Of the environment, shape (m,).
    """

    def __init__(
        self, venv: VecEnv, base: BasePolicy, largest_correction: float, control_scale: Numbers
    ) -> None:
        shape = (len(control_scale),)
        super().__init__(venv, action_space=spaces.Box(-1.0, 1.0, shape, np.float32))
        self.base = base
        self.scale = largest_correction / np.array(control_scale)
        self._observation: NDArray[np.float32] | None = None

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every world and return the observations (worlds, o)."""
        self._observation = np.asarray(self.venv.reset())
        return self._observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the corrections (worlds, m) of the coming step.

        Raises:
            RuntimeError: The environment was not reset.
        """
        if self._observation is None:
            raise RuntimeError("call reset() before step_async()")
        base, _ = self.base.predict(self._observation)
        self.venv.step_async(base + self.scale * np.clip(actions, -1.0, 1.0))

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step: observations, rewards, dones and infos as they come."""
        observation, reward, done, infos = self.venv.step_wait()
        self._observation = np.asarray(observation)
        return self._observation, reward, done, infos


class SingleLesson:
    """The part of a training run of one body, with the worlds as the agent meets them."""

    def __init__(self, training: SingleTraining) -> None:
        self.training = training
        task: Any = training.described
        if training.effort_weight is not None:
            task = replace(task, effort_weight=training.effort_weight)
        self.settings: Task = task
        self.control_scale = self.settings.control_scale
        worlds = TaskVectorEnv(
            training.worlds,
            disturbance=training.disturbance,
            disturbance_bound=training.disturbance_bound,
            settings=self.settings,
            # The weights must not depend on whether numba is installed.
            compiled=False,
            autoreset_mode="same_step",
        )
        venv: VecEnv = SB3VectorEnv(worlds)
        if training.largest_correction is not None:
            base = LagrosPolicy(self.settings)
            venv = CorrectedWorlds(venv, base, training.largest_correction, self.control_scale)
            self.control_scale = (training.largest_correction,) * len(self.control_scale)
        frame = goal_frame(self.settings)
        if isinstance(training.algorithm, OffPolicy):
            # A buffer of old features must not change its meaning: their scale is fixed.
            scales = np.ones(len(frame))
            known = training.feature_scales or self.settings.state_scale
            scales[: len(known)] = known
            self.venv: VecEnv = LinearFeatures(venv, frame / scales[:, None])
        else:
            features = LinearFeatures(venv, frame)
            self.venv = VecNormalize(features, gamma=training.algorithm.discount)

    def policy(self, model: BaseAlgorithm) -> ActorPolicy | ResidualPolicy:
        """Return the agent as it is now, as a policy of the task."""
        actor = extract_actor(model, self.control_scale)
        if self.training.largest_correction is None:
            return ActorPolicy(self.training.described, weights=actor)
        return ResidualPolicy(self.training.described, weights=actor)

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
        conditions = (("none", 0.0), (run.disturbance, run.disturbance_bound))
        return [final_row(policy, seeds, kind, bound) for kind, bound in conditions]

    def save(self, model: BaseAlgorithm, path: Path) -> None:
        """Write the actor as safetensors."""
        plain = self.training.largest_correction is None
        name = self.training.algorithm.name if plain else "residual"
        trained_for = training_of(self.training.described).range(timed=False)
        metadata = weights_record(self.training.task, name, trained_for)
        replace(extract_actor(model, self.control_scale), metadata=metadata).save(path)


def extract_actor(model: BaseAlgorithm, control_scale: Numbers) -> Actor:
    """Return the mean action of an agent as arrays.

    Args:
        model: A PPO, SAC or TD3 of the policy "MlpPolicy" with tanh layers on a Box action. It may
            look at the observation through `LinearFeatures` and `VecNormalize`.
        control_scale: Change of each control for the action 1 in the training, shape (m,).

    Raises:
        ValueError: The policy is not such a network.
    """
    network = actor_network(model)
    space = model.action_space
    symmetric = isinstance(space, spaces.Box) and np.array_equal(space.low, -space.high)
    if not isinstance(space, spaces.Box) or not symmetric or np.ptp(space.high):
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
        control_scale=control_scale,
        squash="clip" if isinstance(model, PPO) else "tanh",
    )


def _features(model: BaseAlgorithm) -> NDArray[Any]:
    venv: Any = model.get_env()
    while venv is not None:
        if isinstance(venv, LinearFeatures):
            return venv.matrix
        venv = getattr(venv, "venv", None)
    return np.eye((model.observation_space.shape or (0,))[0])
