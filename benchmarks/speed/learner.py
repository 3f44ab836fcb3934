"""Speed as a learner meets it: random actions, so that episodes end, and their resets included.

Each ratio is taken by turns in one run, and counts steps of all worlds, those that only start a new
episode among them. VMAS takes part where LAGROS_SPEED_VMAS names an interpreter that has it, as in
`ratios.py`; without it there is nothing to compare the spacecraft with.
"""

from __future__ import annotations

import importlib.util
import time
from typing import Any

import gymnasium as gym
import numpy as np

import lagros_envs  # noqa: F401  (registers the environments)
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from speed import environment
from speed.ratios import Duel, Peer, variants
from speed.report import Row, Section, Target, absent_row, timed_row
from speed.timing import Candidate, Scale, Times, interleave

_CARTPOLE, _SPACECRAFT = "lagros/CartPole-v0", "lagros/Spacecraft-v0"
_DISTURBED = {"disturbance": "uniform"}
_STEPS = 100  # of the cart-poles, in a round
_DRAWN = 50  # random actions that are used by turns: to draw them is nobody's step
WORLDS, AGENTS = 256, 6
_LEARNERS, _ROLLOUT = 64, 128
_LARGEST_SHARE = 0.15


def sections(scale: Scale) -> list[Section]:
    """Measure and return the table."""
    duels = [*_many(scale), _one(scale)]
    found: list[Duel | Row] = [*duels, *_disturbed(scale)]
    with Peer("vmas") as vmas:
        found += _spacecraft(scale, vmas)
    share = _share_of_learning(scale)
    targets = [target for one in found if isinstance(one, Duel) for target in one.targets()]
    if isinstance(share, Target):
        targets.append(share)
        share = Row(share.what, remark=f"{share.measured:.3f} of the wall time")
    rows = [row for one in found for row in (one.rows() if isinstance(one, Duel) else [one])]
    return [
        Section(
            "As a learner meets it: random actions, resets included",
            [*rows, share],
            targets,
            [
                "Times are of a step of all worlds. Ours takes four Runge-Kutta substeps, and an "
                "episode of random forces lasts six steps; Gymnasium's takes one step of Euler "
                f"and lasts twenty-two. VMAS {vmas.version}: navigation, {WORLDS} x {AGENTS}, "
                "ended and reset after as many steps."
            ],
        )
    ]


def stepping_worlds(env: gym.vector.VectorEnv[Any, Any, Any], steps: int) -> Candidate:
    """Return what goes on with random actions and returns the mean time of a step [s]."""
    rng = np.random.default_rng(0)
    space = env.action_space
    if isinstance(space, gym.spaces.Box):
        drawn = rng.uniform(space.low, space.high, (_DRAWN, *space.shape)).astype(np.float32)
    else:
        drawn = rng.integers(0, 2, (_DRAWN, env.num_envs))
    env.reset(seed=0)

    def go_on(_: int) -> float:
        begun = time.perf_counter()
        for step in range(steps):
            env.step(drawn[step % _DRAWN])
        return (time.perf_counter() - begun) / steps

    return go_on


def stepping_one(env: gym.Env[Any, Any], steps: int) -> Candidate:
    """Return what goes on in one environment, resetting it, and returns the mean time [s]."""
    rng = np.random.default_rng(0)
    actions: list[Any] = (
        list(rng.uniform(-1.0, 1.0, (_DRAWN, 1)).astype(np.float32))
        if isinstance(env.action_space, gym.spaces.Box)
        else rng.integers(0, 2, _DRAWN).tolist()
    )
    env.reset(seed=0)

    def go_on(_: int) -> float:
        begun = time.perf_counter()
        for step in range(steps):
            _, _, terminated, truncated, _ = env.step(actions[step % _DRAWN])
            if terminated or truncated:
                env.reset()
        return (time.perf_counter() - begun) / steps

    return go_on


def _many(scale: Scale) -> list[Duel]:
    names = variants("compiled")
    worlds: dict[str, Candidate] = {
        name: stepping_worlds(gym.make_vec(_CARTPOLE, num_envs=scale.worlds, **settings), _STEPS)
        for name, settings in names.items()
    }
    theirs = gym.make_vec(
        "CartPole-v1", num_envs=scale.worlds, vectorization_mode="vector_entry_point"
    )
    worlds["peer"] = stepping_worlds(theirs, _STEPS)
    times = _means(interleave(worlds, max(scale.rounds // 5, 2)))
    title = f"{scale.worlds:,} cart-poles"
    return [
        Duel(
            title,
            "CartPoleVectorEnv",
            times["peer"],
            {name: times[name]},
            0.7 if name.startswith("compiled") else 0.1,
        )
        for name in names
    ]


def _one(scale: Scale) -> Duel:
    times = _means(
        interleave(
            {
                "ours": stepping_one(gym.make(_CARTPOLE), 10 * scale.calls),
                "peer": stepping_one(gym.make("CartPole-v1"), 10 * scale.calls),
            },
            max(scale.rounds // 5, 2),
        )
    )
    return Duel("one cart-pole", "CartPole-v1", times["peer"], {"plain": times["ours"]}, 0.6)


def _disturbed(scale: Scale) -> list[Row]:
    """Return what a disturbance that is drawn in every step costs; nothing was asked of it."""
    candidates: dict[str, Candidate] = {}
    for label, settings in {"calm": {}, "uniform disturbance": _DISTURBED}.items():
        many = gym.make_vec(_CARTPOLE, num_envs=scale.worlds, **settings)
        one = gym.make(_CARTPOLE, **settings)
        candidates[f"{scale.worlds:,} cart-poles, {label}"] = stepping_worlds(many, _STEPS)
        candidates[f"one cart-pole, {label}"] = stepping_one(one, scale.calls)
    times = _means(interleave(candidates, max(scale.rounds // 5, 2)))
    calm = {name.partition(",")[0]: taken for name, taken in times.items() if "calm" in name}
    rows = []
    for name, taken in times.items():
        ratio = taken.ratio_to(calm[name.partition(",")[0]]) if "calm" not in name else 1.0
        rows.append(timed_row(name, taken, None, f"{ratio:.3g} of the calm one's time"))
    return rows


def _spacecraft(scale: Scale, vmas: Peer) -> list[Duel | Row]:
    peer = vmas.candidate("random")
    if not peer:
        return [absent_row(f"{WORLDS} x {AGENTS} spacecraft", "LAGROS_SPEED_VMAS: vmas")]
    # A whole episode, so that each round has all of its resets.
    steps = SpacecraftSettings().steps
    ours: dict[str, Candidate] = {
        name: stepping_worlds(
            gym.make_vec(_SPACECRAFT, num_envs=WORLDS * AGENTS, num_agents=AGENTS, **settings),
            steps,
        )
        for name, settings in variants("compiled").items()
    }
    times = _means(interleave(ours | peer, max(scale.rounds // 20, 2)))
    title = f"{WORLDS} × {AGENTS} spacecraft"
    theirs = times.pop(vmas.name)
    return [Duel(title, "VMAS navigation", theirs, times, 10.0)]


def _share_of_learning(scale: Scale) -> Target | Row:
    """Return the share of the wall time of PPO.learn that is spent in the environment."""
    what = f"PPO on {_LEARNERS} cart-poles: share of the environment"
    if importlib.util.find_spec("stable_baselines3") is None:
        return absent_row(what, "stable-baselines3")
    import torch
    from stable_baselines3 import PPO

    from lagros_benchmarks.training.sb3_vector import SB3VectorEnv
    from lagros_envs.tasks.cartpole.vector import CartPoleVectorEnv

    torch.set_num_threads(1)

    class Timed(SB3VectorEnv):
        seconds = 0.0

        def step_wait(self) -> Any:
            begun = time.perf_counter()
            answer = super().step_wait()
            self.seconds += time.perf_counter() - begun
            return answer

    env = Timed(CartPoleVectorEnv(_LEARNERS, "uniform", autoreset_mode="same_step"))
    model = PPO("MlpPolicy", env, n_steps=_ROLLOUT, device="cpu", seed=0)
    rollout = _LEARNERS * _ROLLOUT
    shares = []
    # The first round compiles.
    for index in range(1 + max(scale.designs, 1)):
        env.seconds, begun = 0.0, time.perf_counter()
        model.learn(rollout, reset_num_timesteps=index == 0)
        shares.append(env.seconds / (time.perf_counter() - begun))
    return Target(what, float(np.median(shares[1:])), _LARGEST_SHARE, "")


def _means(times: dict[str, Times]) -> dict[str, Times]:
    return {name: environment.returned(taken) for name, taken in times.items()}
