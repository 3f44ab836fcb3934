"""Train the PPO baseline of the cart-pole: `python -m lagros_benchmarks.train_ppo --seed 0`.

Proximal policy optimisation of stable-baselines3 on `CartPoleVectorEnv` under the uniform
disturbance of the paper. The result is the actor as safetensors and a JSON record of its training
beside it. The run is cut into segments, each with random streams of its own and each followed by a
checkpoint, so that a run that was killed and started again ends with the same weights.
"""

from __future__ import annotations

import argparse
import json
import logging
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from lagros_benchmarks.files import write_json
from lagros_benchmarks.ppo_run import (
    CURVE_SEED,
    PpoTraining,
    actor_network,
    agent,
    rounded,
    run_segments,
    versions,
)
from lagros_benchmarks.sb3_vector import LinearFeatures, SB3VectorEnv
from lagros_envs import cartpole_task as task
from lagros_envs.cartpole_vector import CartPoleVectorEnv
from lagros_envs.seeding import episode_seeds
from lagros_policies.baselines import PRETRAINED_PPO, PpoActor, PpoPolicy, goal_frame

_LOG = logging.getLogger(__name__)
# Seed of the held-out episodes at the end: neither those of the curve nor those of `lagros bench`.
_FINAL_SEED = 910_002


def build(training: PpoTraining) -> tuple[PPO, VecNormalize]:
    """Return the untrained agent and the normalisation of its features."""
    settings = task.CartPoleSettings(effort_weight=training.effort_weight)
    venv = CartPoleVectorEnv(
        training.worlds,
        disturbance=training.disturbance,
        disturbance_bound=training.disturbance_bound,
        settings=settings,
        autoreset_mode="same_step",
    )
    features = LinearFeatures(SB3VectorEnv(venv), goal_frame())
    normalised = VecNormalize(features, gamma=training.discount)
    return agent(training, normalised), normalised


def extract_actor(
    model: PPO, normalised: VecNormalize | None, force_scale: float = 40.0
) -> PpoActor:
    """Return the mean action of an agent as arrays.

    Args:
        model: A PPO of the policy "MlpPolicy" with tanh layers on a Box action of one number.
        normalised: The `VecNormalize` that the agent looks through, over `LinearFeatures` or over
            the observation itself; None if it looks at the plain observation.
        force_scale: Force of the action 1.0 in the training [N].

    Returns:
        The actor; its `features` are those of the `LinearFeatures` around the environment.

    Raises:
        ValueError: The policy is not such a network.
    """
    network = actor_network(model)
    space = model.action_space
    if not isinstance(space, gymnasium.spaces.Box) or not np.array_equal(space.low, -space.high):
        raise ValueError(f"the action space {space} is not a symmetric Box")
    features = _features(model, normalised)
    count = features.shape[0]
    mean, std, clip = np.zeros(count), np.ones(count), float(np.finfo(np.float32).max)
    if normalised is not None and normalised.norm_obs:
        statistics: Any = normalised.obs_rms
        mean, std = statistics.mean, np.sqrt(statistics.var + normalised.epsilon)
        clip = float(normalised.clip_obs)
    return PpoActor(
        network=network,
        features=features.astype(np.float32),
        mean=mean.astype(np.float32),
        std=std.astype(np.float32),
        feature_clip=clip,
        action_clip=float(space.high[0]),
        force_scale=force_scale,
    )


def _features(model: PPO, normalised: VecNormalize | None) -> np.ndarray[Any, Any]:
    venv: Any = model.get_env() if normalised is None else normalised
    while venv is not None:
        if isinstance(venv, LinearFeatures):
            return venv.matrix
        venv = getattr(venv, "venv", None)
    return np.eye(task.OBSERVATION_DIM)


def export_actor(
    model: PPO,
    normalised: VecNormalize | None,
    path: Path | str,
    record: dict[str, Any] | None = None,
    force_scale: float = 40.0,
) -> PpoActor:
    """Write the actor as safetensors and its training record as JSON beside it, each atomically.

    Args:
        model: See `extract_actor`.
        normalised: See `extract_actor`.
        path: Where to write, ending in `.safetensors`.
        record: The training record, JSON-serialisable; None writes none.
        force_scale: See `extract_actor`.

    Returns:
        The actor.

    Raises:
        ValueError: See `extract_actor`.
    """
    actor = extract_actor(model, normalised, force_scale)
    actor.save(path)
    if record is not None:
        write_json(Path(path).with_suffix(".json"), record)
    return actor


def evaluate(
    policy: PpoPolicy, episodes: int, seed: int, disturbance: str, bound: float
) -> dict[str, float]:
    """Run a stateless policy over held-out episodes and return its figures.

    Args:
        policy: The policy.
        episodes: Number of episodes.
        seed: Seed of the set of episodes.
        disturbance: Kind of disturbance.
        bound: d_bar.

    Returns:
        Shares of episodes: `success` (the paper's), `strict` (inside the tube at the end, never
        fell) and `fallen`; means over all episodes: `effort` (to the end or the fall) [N^2 s] and
        `effort_to_success`; `final_distance`, the mean over those that did not fall (0 if all did).
    """
    venv = CartPoleVectorEnv(
        episodes,
        disturbance=disturbance,
        disturbance_bound=bound,
        settings=policy.settings,
        autoreset_mode="disabled",
    )
    observation, info = venv.reset(seed=episode_seeds(seed, episodes))
    fallen = np.zeros(episodes, dtype=bool)
    last = {key: np.array(info[key]) for key in ("success", "effort", "effort_to_success")}
    for _ in range(policy.settings.steps):
        action, _ = policy.predict(observation)
        observation, _, terminated, _, info = venv.step(np.where(fallen[:, None], 0.0, action))
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
    }


def train(training: PpoTraining, out: Path | str, checkpoint: Path | str) -> PpoActor:
    """Train, or go on with a training that was interrupted, and write actor and record.

    Args:
        training: The run.
        out: The safetensors file to write at the end.
        checkpoint: Where the state of the run is kept between segments.

    Returns:
        The actor.

    Raises:
        ValueError: The checkpoint is damaged or belongs to another run.
    """
    model, normalised = build(training)

    def figures() -> dict[str, float]:
        return evaluate(
            PpoPolicy(weights=extract_actor(model, normalised)),
            training.curve_episodes,
            CURVE_SEED,
            training.disturbance,
            training.disturbance_bound,
        )

    curve = run_segments(training, model, normalised, Path(checkpoint), figures)
    final = {
        f"{kind} {bound:g}": rounded(
            evaluate(
                PpoPolicy(weights=extract_actor(model, normalised)),
                training.final_episodes,
                _FINAL_SEED,
                kind,
                bound,
            )
        )
        for kind, bound in (("none", 0.0), (training.disturbance, training.disturbance_bound))
    }
    _LOG.info("final, %d episodes: %s", training.final_episodes, json.dumps(final))
    return export_actor(model, normalised, out, _record(training, curve, final))


def _record(
    training: PpoTraining, curve: list[dict[str, float]], final: dict[str, dict[str, float]]
) -> dict[str, Any]:
    length = "" if training.segments == PpoTraining.segments else f" --segments {training.segments}"
    return {
        "command": f"python -m lagros_benchmarks.train_ppo --seed {training.seed}{length}",
        "algorithm": "PPO of stable-baselines3, actor and critic apart",
        "task": "lagros/CartPole-v0",
        "budget": {
            "steps": training.segments * training.segment_steps,
            "episodes_at_most": training.segments * training.rollouts * training.worlds,
            "seconds": curve[-1]["seconds"],
            "torch_threads": torch.get_num_threads(),
        },
        "training": asdict(training),
        "features": "[p - p_f, theta, dp/dt, dtheta/dt], running normalisation fixed at export",
        "curve_seed": CURVE_SEED,
        "curve": {key: [point[key] for point in curve] for key in curve[0]},
        "final_seed": _FINAL_SEED,
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
        prog="python -m lagros_benchmarks.train_ppo",
        description="Train the PPO baseline of lagros/CartPole-v0 and write it as safetensors. "
        "Started again after an interruption, it goes on from the last checkpoint.",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the run (default: 0)")
    parser.add_argument(
        "--out", type=Path, default=PRETRAINED_PPO, help="file to write (default: the shipped one)"
    )
    parser.add_argument(
        "--checkpoint",
        type=Path,
        help="state of the run (default: runs/ppo/seed-SEED.pt); deleted when the run is complete",
    )
    parser.add_argument(
        "--segments", type=int, help=f"length of the run (default: {PpoTraining.segments})"
    )
    options = parser.parse_args(arguments)
    if options.seed < 0:
        parser.error("--seed must be >= 0")
    if options.segments is not None and options.segments < 1:
        parser.error("--segments must be >= 1")
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(message)s")
    # One thread: networks this small gain nothing from more, and the sums stay reproducible.
    torch.set_num_threads(1)
    training = PpoTraining(seed=options.seed)
    if options.segments is not None:
        training = replace(training, segments=options.segments)
    checkpoint = options.checkpoint or Path("runs") / "ppo" / f"seed-{options.seed}.pt"
    train(training, options.out, checkpoint)
    checkpoint.unlink()
    _LOG.info("wrote %s and %s", options.out, options.out.with_suffix(".json"))


if __name__ == "__main__":
    main()
