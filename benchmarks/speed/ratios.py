"""How many times as fast as its peers lagros is: eight ratios, each measured by turns in one run.

VMAS and safe-control-gym cannot live in the environment of lagros. Name the interpreter of an
environment that has them in LAGROS_SPEED_VMAS and LAGROS_SPEED_SAFE_CONTROL_GYM, and they are
measured like the others (`peers.py`); without it the figure measured once for this project on two
cores is used and marked as quoted.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import lagros_envs  # noqa: F401  (registers the environments)
from lagros_envs.dynamics.held import has_numba
from speed import environment, network
from speed.report import Row, Section, Target, absent_row, timed_row
from speed.timing import Candidate, Scale, Times, interleave

_CARTPOLE = "lagros/CartPole-v0"
_CARTPOLE_DISTURBANCE = {"disturbance": "uniform", "disturbance_bound": 0.75}
_AGENTS = 4
_THRUST = 0.2  # largest action [1]
_WORLD_STEPS = 10  # of the spacecraft, in a round
_EXPORT_CALLS = 100
# What was measured once for this project, on two cores: seconds of one call.
_QUOTED = {
    ("safe-control-gym", "step"): 1.0 / 4000.0,
    ("safe-control-gym", "reset"): 3.6e-3,
    ("vmas", "step"): 1024.0 / 29000.0,
}


@dataclass(frozen=True)
class Duel:
    """What was measured for one ratio.

    Attributes:
        title: What both do.
        peer: Name of the peer.
        theirs: Its times, or the quoted seconds of one call.
        ours: Our times, by variant; the first is the one that anybody gets.
        asked: How many times as fast as the peer the best of ours is to be.
    """

    title: str
    peer: str
    theirs: Times | float
    ours: dict[str, Times]
    asked: float

    def speed(self, name: str) -> float:
        """Return how many times as fast as the peer one of ours is, the median over the rounds."""
        if isinstance(self.theirs, Times):
            return 1.0 / self.ours[name].ratio_to(self.theirs)
        return self.theirs / self.ours[name].median

    def rows(self) -> list[Row]:
        """Return a line for the peer and one for each of ours."""
        label = f"{self.title}: {self.peer}"
        if isinstance(self.theirs, Times):
            peer = timed_row(label, self.theirs, None)
        else:
            peer = Row(label, self.theirs, remark="quoted")
        return [peer] + [
            timed_row(
                f"  {name}",
                times,
                None,
                f"{self.speed(name):.3g} ×",
                times_as_fast=self.speed(name),
            )
            for name, times in self.ours.items()
        ]

    def targets(self) -> list[Target]:
        """Return what is asked, of every variant."""
        return [
            Target(
                f"{self.title}, {name} / {self.peer}",
                self.speed(name),
                self.asked,
                "×",
                at_least=True,
            )
            for name in self.ours
        ]


def sections(scale: Scale) -> list[Section]:
    """Measure and return the table."""
    found: list[Duel | Row] = []
    with Peer("safe-control-gym") as safe, Peer("vmas") as vmas:
        found += _single(scale, safe)
        found.append(_vector(scale))
        found.append(_spacecraft(scale, vmas))
        versions = {peer.name: peer.version for peer in (safe, vmas)}
    found.append(_predict(scale))
    found += _export(scale)
    found.append(_processes(scale))
    duels = [duel for duel in found if isinstance(duel, Duel)]
    rows = [row for one in found for row in (one.rows() if isinstance(one, Duel) else [one])]
    about = ", ".join(f"{name} {version}" for name, version in versions.items())
    return [
        Section(
            "Ratios: how many times as fast as the peer",
            rows,
            [target for duel in duels for target in duel.targets()],
            [
                "Our cart-pole integrates with four Runge-Kutta substeps (two were assumed when "
                "these ratios were asked for), under a disturbance and with its info; "
                "Gymnasium's takes one step of Euler. 'compiled' is numba: compiled=True for one "
                "cart-pole, and what many worlds take by themselves where it is installed.",
                f"Quoted: not measured in this run. Peers elsewhere: {about}.",
            ],
        )
    ]


class Peer:
    """A peer in a process of its own, if the environment says where; else its quoted figures."""

    def __init__(self, name: str) -> None:
        """Start the peer's process."""
        self.name, self.version = name, "quoted"
        python = os.environ.get("LAGROS_SPEED_" + name.upper().replace("-", "_"))
        self._process: subprocess.Popen[str] | None = None
        if python:
            self._process = subprocess.Popen(
                [python, str(Path(__file__).with_name("peers.py")), name],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            self.version = json.loads(self._answer())["version"]

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.communicate()

    def candidate(self, what: str) -> dict[str, Candidate]:
        """Return what runs a round and returns its seconds, by name; nothing if it is quoted."""
        return {} if self._process is None else {self.name: lambda _: self._round(what)}

    def times(self, what: str, measured: dict[str, Times]) -> Times | float:
        """Return the peer's times, or the quoted seconds."""
        if self.name in measured:
            return environment.returned(measured[self.name])
        return _QUOTED[self.name, what]

    def _round(self, what: str) -> float:
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(what + "\n")
        self._process.stdin.flush()
        return float(self._answer())

    def _answer(self) -> str:
        assert self._process is not None
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the process of {self.name} ended; what it said stands above")
        return line


def variants(default: str) -> dict[str, dict[str, bool]]:
    """Return the settings of both ways to integrate, the one that nobody has to ask for first.

    Args:
        default: "plain" or "compiled"; without numba there is only "plain".
    """
    ways = {"plain": {"compiled": False}}
    if has_numba():
        ways["compiled"] = {"compiled": True}
    first = default if default in ways else "plain"
    return {f"{first}, the default": {}} | {name: ways[name] for name in ways if name != first}


def _single(scale: Scale, safe: Peer) -> list[Duel]:
    envs = {
        name: gym.make(_CARTPOLE, **_CARTPOLE_DISTURBANCE, **settings)
        for name, settings in variants("plain").items()
    }
    calm = np.zeros(1, np.float32)
    steps: dict[str, Candidate] = {
        name: environment.stepping(env, calm, scale.calls) for name, env in envs.items()
    }
    steps["CartPole-v1"] = environment.stepping(gym.make("CartPole-v1"), 0, scale.calls)
    stepped = interleave(steps | safe.candidate("step"), scale.rounds)
    ours = {name: environment.returned(stepped[name]) for name in envs}
    theirs = environment.returned(stepped["CartPole-v1"])

    def resetting(env: gym.Env[Any, Any]) -> Callable[[int], float]:
        def resets(index: int) -> float:
            begun = time.perf_counter()
            for call in range(scale.calls):
                env.reset(seed=index * scale.calls + call)
            return (time.perf_counter() - begun) / scale.calls

        return resets

    reset = interleave(
        {"default": resetting(next(iter(envs.values()))), **safe.candidate("reset")}, scale.rounds
    )
    return [
        Duel("step of one cart-pole", "CartPole-v1", theirs, ours, 0.7),
        Duel("step of one cart-pole", safe.name, safe.times("step", stepped), ours, 10.0),
        Duel(
            "reset of one cart-pole",
            safe.name,
            safe.times("reset", reset),
            {"default": environment.returned(reset["default"])},
            50.0,
        ),
    ]


def _vector(scale: Scale) -> Duel:
    from lagros_policies.baselines import LqrPolicy

    lqr = LqrPolicy()
    choices = np.random.default_rng(0).integers(0, 2, scale.worlds)
    # LQR keeps nearly all worlds upright; Gymnasium's fall every twenty steps or so.
    episodes: dict[str, Candidate] = {
        name: environment.episode(
            gym.make_vec(_CARTPOLE, num_envs=scale.worlds, **_CARTPOLE_DISTURBANCE, **settings),
            lambda observations: lqr.predict(observations)[0],
        )
        for name, settings in variants("compiled").items()
    }
    theirs = gym.make_vec(
        "CartPole-v1", num_envs=scale.worlds, vectorization_mode="vector_entry_point"
    )
    episodes["peer"] = environment.episode(theirs, lambda _: choices)
    measured = interleave(episodes, max(scale.rounds // 10, 2))
    times = {name: _median_of_each(taken) for name, taken in measured.items()}
    peer = times.pop("peer")
    return Duel(f"{scale.worlds:,} cart-poles", "CartPoleVectorEnv", peer, times, 1.0)


def _spacecraft(scale: Scale, vmas: Peer) -> Duel:
    rows = scale.worlds * _AGENTS
    actions = np.random.default_rng(0).uniform(0.0, _THRUST, (_WORLD_STEPS, rows, 8))
    flights: dict[str, Candidate] = {}
    scenarios: list[Any] | None = None
    for name, settings in variants("compiled").items():
        envs = gym.make_vec(
            "lagros/Spacecraft-v0",
            num_envs=rows,
            num_agents=_AGENTS,
            disturbance="uniform",
            disturbance_bound=0.4,
            autoreset_mode="disabled",
            **settings,
        )
        envs.reset(seed=0, options={"scenarios": scenarios})
        scenarios = envs.unwrapped.scenarios  # type: ignore[attr-defined]
        flights[name] = _flight(envs, scenarios, actions.astype(np.float32))
    measured = interleave(flights | vmas.candidate("step"), max(scale.rounds // 10, 2))
    ours = {name: environment.returned(measured[name]) for name in flights}
    title = f"{scale.worlds:,} × {_AGENTS} spacecraft with sensing"
    return Duel(title, vmas.name, vmas.times("step", measured), ours, 10.0)


def _flight(
    envs: gym.vector.VectorEnv[Any, Any, Any], scenarios: list[Any], actions: NDArray[Any]
) -> Callable[[int], float]:
    """Return what flies some steps from the start and returns the mean time of a step [s]."""

    def steps(index: int) -> float:
        envs.reset(seed=index, options={"scenarios": scenarios})
        begun = time.perf_counter()
        for action in actions:
            envs.step(action)
        return (time.perf_counter() - begun) / len(actions)

    return steps


def _predict(scale: Scale) -> Duel | Row:
    import torch

    torch.set_num_threads(1)
    if importlib.util.find_spec("stable_baselines3") is None:
        return absent_row("predict of LAG-ROS, batch 1", "stable-baselines3")
    env = gym.make(_CARTPOLE, **_CARTPOLE_DISTURBANCE)
    observation, _ = env.reset(seed=0)
    policy, _ = network.shipped_policy()
    times = interleave(
        {
            "default": lambda _: policy.predict(observation),
            "peer": network.ppo_peer(env, observation),
        },
        scale.rounds,
        scale.calls,
    )
    ours = {"default": times["default"]}
    return Duel("predict of LAG-ROS, batch 1", "SB3 PPO.predict", times["peer"], ours, 5.0)


def _export(scale: Scale) -> list[Duel | Row]:
    from lagros_policies.export import check, load_source
    from lagros_policies.export.c99 import c_file
    from lagros_policies.learning.features import seen

    if check.compiler() is None:
        return [absent_row("C export, one call", "gcc")]
    source = load_source("lagros-cartpole")
    rows = source.examples(_EXPORT_CALLS)
    features = seen(source.policy.see, rows)[0]
    flags = ("-std=c99", "-O3", "-march=native", "-ffp-contract=fast")
    # About as long as NumPy's part: the first call of a round finds its weights out of the near
    # caches, and has to count alike for both.
    repeats = 10
    with check.CompiledPolicy(c_file(source), source, flags) as exported:
        times = interleave(
            {
                "C": lambda _: [exported.answer(rows) for _ in range(repeats)],
                "predict": lambda _: [source.policy.predict(row) for row in rows],
                "forward": lambda _: [source.policy.network(row) for row in features],
            },
            scale.rounds,
        )
    calls = {name: _EXPORT_CALLS * (repeats if name == "C" else 1) for name in times}
    each = {
        name: Times(taken.seconds / calls[name], [], single=False) for name, taken in times.items()
    }
    ours = {"rational, -O3": each["C"]}
    return [
        Duel("C export, one call", "NumPy predict", each["predict"], ours, 10.0),
        Duel("C export, one call", "NumPy forward", each["forward"], ours, 10.0),
    ]


def _processes(scale: Scale) -> Duel:
    from lagros_benchmarks.run.runner import run_benchmark
    from lagros_benchmarks.run.settings import BenchmarkSettings

    def running(jobs: int) -> Candidate:
        # With more than one job a serial pass for the step times follows: one episode of it.
        settings = BenchmarkSettings(
            policies=("tube-mpc", "lagros"),
            episodes=4 * scale.tracked_episodes,
            jobs=jobs,
            chunk=max(1, scale.tracked_episodes // 5),
            timing_episodes=1,
        )
        return lambda _: run_benchmark(settings) and None

    times = interleave({"2 processes": running(2), "serial": running(1)}, scale.designs)
    ours = {"2 processes": times["2 processes"]}
    return Duel("benchmark run", "serial", times["serial"], ours, 1.7)


def _median_of_each(times: Times) -> Times:
    """Return the median step of every episode."""
    return Times(np.median(np.array(times.results), axis=1), [], single=False)
