"""Policies at batch 1: the bare network, `predict`, and the tube MPC."""

from __future__ import annotations

import importlib.util
import itertools
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import lagros_envs  # noqa: F401  (registers the environment)
from lagros_envs.seeding import episode_seeds
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.learning.features import seen
from lagros_policies.learning.networks import Mlp
from lagros_policies.room import PRETRAINED
from lagros_policies.tasks.cartpole.features import CartPoleView
from lagros_policies.tube_mpc import TubeMpcPolicy
from speed.report import Section, Target, absent_row, timed_row
from speed.timing import Candidate, Scale, Times, interleave

Float32Array = NDArray[np.float32]

_HIDDEN = (100, 100, 100)
_SEED = 0
_EPISODES = 0x6E6574
_DISTURBANCE = {"disturbance": "uniform", "disturbance_bound": 0.75}


def sections(scale: Scale) -> list[Section]:
    """Measure and return the tables."""
    import torch

    torch.set_num_threads(1)
    return [_forward(scale), _predict(scale), _tube_mpc(scale)]


def _random_network() -> Mlp:
    rng = np.random.default_rng(_SEED)
    widths = [len(CartPoleView.names), *_HIDDEN, 1]
    shapes = list(itertools.pairwise(widths))
    weights = [rng.standard_normal(shape) / np.sqrt(shape[0]) for shape in shapes]
    return Mlp(weights, [0.1 * rng.standard_normal(shape[1]) for shape in shapes])


def _forward(scale: Scale) -> Section:
    network = _random_network()
    features = np.random.default_rng(_SEED).standard_normal(network.inputs).astype(np.float32)
    candidates: dict[str, Candidate] = {"NumPy (lagros)": lambda _: network(features)}
    candidates |= _torch_peers(network, features)
    onnx = importlib.util.find_spec("onnxruntime") is not None
    if onnx:
        candidates["ONNX Runtime"] = _onnx_peer(network, features)
    expected = network(features).copy()
    for name, candidate in candidates.items():
        if not np.allclose(np.ravel(candidate(0)), expected, rtol=1e-4, atol=1e-5):
            raise RuntimeError(f"{name} gives {candidate(0)}, NumPy {expected}")
    times = interleave(candidates, scale.rounds, scale.calls)
    reference = times["NumPy (lagros)"]
    rows = [timed_row(name, taken, reference) for name, taken in times.items()]
    if not onnx:
        rows.append(absent_row("ONNX Runtime", "onnxruntime"))
    return Section(
        f"Bare network {len(CartPoleView.names)}-{'-'.join(map(str, _HIDDEN))}-1, batch 1",
        rows,
        [Target("bare forward", 1e6 * reference.median, 25.0, "µs")],
        ["From a NumPy vector to a NumPy vector; all agree to 1e-5."],
    )


def _torch_peers(network: Mlp, features: Float32Array) -> dict[str, Candidate]:
    import torch

    layers: list[torch.nn.Module] = []
    for weight, bias in zip(network.weights, network.biases, strict=True):
        layer = torch.nn.Linear(*weight.shape)
        with torch.no_grad():
            layer.weight.copy_(torch.from_numpy(weight.T.copy()))
            layer.bias.copy_(torch.from_numpy(bias))
        layers += [layer, torch.nn.Tanh()]
    eager = torch.nn.Sequential(*layers[:-1]).eval()
    example = torch.from_numpy(features)
    traced = torch.jit.freeze(torch.jit.trace(eager, example))

    def running(model: Any) -> Candidate:
        def run(_: int) -> Any:
            with torch.inference_mode():
                return model(torch.from_numpy(features)).numpy()

        return run

    # The first calls of a traced model compile it.
    for _ in range(10):
        running(traced)(0)
    return {"torch, eager": running(eager), "torch.jit, frozen": running(traced)}


def _onnx_peer(network: Mlp, features: Float32Array) -> Candidate:
    import onnxruntime

    from speed.onnx_model import onnx_bytes

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(
        onnx_bytes(network), options, providers=["CPUExecutionProvider"]
    )
    return lambda _: session.run(None, {"x": features[None]})[0]


def _predict(scale: Scale) -> Section:
    env = gym.make("lagros/CartPole-v0", **_DISTURBANCE)
    observation, _ = env.reset(seed=_SEED)
    policy, source = shipped_policy()
    see = CartPoleView()
    features, _ = seen(see, observation)
    candidates: dict[str, Candidate] = {
        "LagrosPolicy.predict": lambda _: policy.predict(observation),
        "of this: features": lambda _: seen(see, observation),
        "of this: network": lambda _: policy.network(features),
    }
    sb3 = importlib.util.find_spec("stable_baselines3") is not None
    if sb3:
        candidates["PPO.predict (SB3), 3x100"] = ppo_peer(env, observation)
    times = interleave(candidates, scale.rounds, scale.calls)
    reference = times["LagrosPolicy.predict"]
    rows = [timed_row(name, taken, reference) for name, taken in times.items()]
    if not sb3:
        rows.append(absent_row("PPO.predict (SB3), 3x100", "stable-baselines3"))
    return Section(
        "predict: one observation to one action",
        rows,
        [Target("predict of (c)", 1e6 * reference.median, 60.0, "µs")],
        [f"{source}; PPO is untrained, its actor 3x100 like ours."],
    )


def shipped_policy() -> tuple[LagrosPolicy, str]:
    """Return policy (c) and where its weights come from."""
    try:
        return LagrosPolicy(), "Shipped weights"
    except FileNotFoundError:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "random.safetensors"
            _random_network().save(path)
            return LagrosPolicy(weights=path), "Random weights, as none are shipped"


def ppo_peer(env: gym.Env[Any, Any], observation: Float32Array) -> Candidate:
    """Return `predict` of an untrained PPO of stable-baselines3 with an actor like ours."""
    from stable_baselines3 import PPO

    model = PPO("MlpPolicy", env, policy_kwargs={"net_arch": list(_HIDDEN)}, device="cpu")
    return lambda _: model.predict(observation, deterministic=True)


def _tube_mpc(scale: Scale) -> Section:
    env = gym.make("lagros/CartPole-v0", **_DISTURBANCE)
    policy, source = _tube_mpc_policy()
    first: list[float] = []
    later: list[float] = []
    late = failed = 0
    # The first episode warms up and does not count.
    for number, seed in enumerate(episode_seeds(_SEED, scale.tracked_episodes + 1, _EPISODES)):
        seconds, state = _run(env, policy, seed)
        if number:
            first.append(seconds[0])
            later += seconds[1:]
            counters = policy.counters(state)
            late, failed = late + counters["late_plans"], failed + counters["failed_plans"]
    every = Times(np.array(first + later), [])
    rows = [
        timed_row(
            "TubeMpcPolicy.predict",
            every,
            None,
            f"most {1e3 * every.seconds.max():.1f} ms, {failed} failed, {late} late",
            slowest_s=float(every.seconds.max()),
            failed_plans=failed,
            late_plans=late,
        ),
        timed_row("of these: first step (cold)", Times(np.array(first), []), None),
        timed_row("of these: later steps", Times(np.array(later), []), None),
    ]
    p99 = every.p99 or float(every.seconds.max())
    return Section(
        "Δt of the tube MPC (b), a re-plan in every control step",
        rows,
        [
            Target("tube MPC, median", 1e3 * every.median, 5.0, "ms"),
            Target("tube MPC, p99", 1e3 * p99, 20.0, "ms"),
        ],
        [f"{scale.tracked_episodes} episodes, uniform disturbance, d̄ = 0.75. {source}."],
        tails=True,
    )


def _tube_mpc_policy() -> tuple[TubeMpcPolicy, str]:
    if (PRETRAINED / "cartpole_metric.json").is_file():
        return TubeMpcPolicy(), "Shipped metric"
    from lagros_policies.tasks.cartpole.metric_design import (
        MetricDesignSettings,
        design_cartpole_metric,
    )

    metric = design_cartpole_metric(MetricDesignSettings(plans=60, pool=5000, checks=500))
    return TubeMpcPolicy(metric=metric), "A metric designed just now, as none is shipped"


def _run(env: gym.Env[Any, Any], policy: TubeMpcPolicy, seed: int) -> tuple[list[float], Any]:
    """Return the time of every step of an episode, and the policy's memory at its end."""
    observation, _ = env.reset(seed=seed)
    state, ended = None, False
    seconds = []
    while not ended:
        begun = time.perf_counter()
        action, state = policy.predict(observation, state)
        seconds.append(time.perf_counter() - begun)
        observation, _, terminated, truncated, _ = env.step(action)
        ended = terminated or truncated
    return seconds, state
