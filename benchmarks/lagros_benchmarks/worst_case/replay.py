"""Found sequences, flown again in the ordinary environments, kept in files and read back.

What is published about a worst case is what happens here and not what the search saw: one world at
a time, the real policy, the environment's own clock, so that a file gives the same figures to the
last bit whenever it is flown on the same machine and versions.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import lagros_envs  # noqa: F401  (registers the environments)
from lagros_benchmarks.run.episodes import ACTION, TUBE_TOLERANCE
from lagros_benchmarks.run.flying import Attempt, ask, reseed
from lagros_benchmarks.run.library import Policy
from lagros_benchmarks.tasks.cartpole.worst_case import Episodes, Flights, scores
from lagros_benchmarks.tasks.spacecraft.worst_case import SpacecraftTarget
from lagros_benchmarks.worst_case.sequences import Replay
from lagros_envs.checks import is_number, shown
from lagros_envs.files import write_atomic
from lagros_envs.reading import Record, named, parse_json, read_npz
from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings

FloatArray = NDArray[np.float64]

_FORMAT = "lagros-worst-case-1"
# Of all sequences together: a thousand worlds of eight agents have less.
_MOST_BYTES = 1 << 28


@dataclass(frozen=True)
class Outcome:
    """What one sequence did to one episode.

    Attributes:
        seed: Seed of the episode.
        score: How bad it was for the goal; larger is worse.
        broken: Whether the goal was broken: for "tube" the tube was left (cart-pole: the published
            one; spacecraft: the certified margin), for "success" the episode failed (spacecraft:
            some agent did not arrive), for "clearance" the pole fell or an agent collided.
        measures: Further figures, by name.
        error: The exception that ended the episode, which then counts as broken; None if none did.
    """

    seed: int
    score: float
    broken: bool
    measures: Mapping[str, float | bool | int | None]
    error: str | None = None


def replay_cartpole(
    episodes: Episodes, index: int, policy: Policy, goal: str, pushes: FloatArray
) -> tuple[Outcome, Flights | None]:
    """Fly one sequence in `CartPoleEnv`.

    Args:
        episodes: The episodes.
        index: Which of them.
        policy: The policy.
        goal: As for `cartpole.profile`.
        pushes: d, shape (steps, 4).

    Returns:
        The outcome, and the flight for further questions; None where it raised.
    """
    settings = episodes.settings
    given = Replay(pushes, settings.control_period)
    env: Any = gym.make(
        "lagros/CartPole-v0",
        disturbance=given,
        disturbance_bound=given.bound,
        settings=settings,
        max_episode_steps=settings.steps,
        disable_env_checker=True,
    ).unwrapped
    seed = episodes.seeds[index]
    with Attempt() as attempt:
        flight, info = _cartpole_flight(env, policy, seed, episodes.plans[index])
    if attempt.error is not None:
        return Outcome(seed, math.inf, True, {}, attempt.error), None
    where = np.array([index])
    score = float(scores(episodes, goal, where, flight)[0][0])
    errors = np.linalg.norm(flight.states[0] - episodes.plans[index], axis=-1)[flight.alive[0]]
    radius = settings.tube.radius(settings.control_period * np.arange(len(errors)))
    fallen = bool(flight.fallen[0])
    left = fallen or bool(np.any(errors > radius + TUBE_TOLERANCE))
    broken = {"tube": left, "success": not info["success"], "clearance": fallen}[goal]
    measures = {
        "success": bool(info["success"]),
        "strict_success": not fallen and bool(info["inside_tube"]),
        "fallen": fallen,
        "left_paper_tube": left,
        "max_tracking_error": float(errors.max()),
        "largest_angle": float(np.abs(flight.states[0, :, 1][flight.alive[0]]).max()),
    }
    return Outcome(seed, score, bool(broken), measures), flight


def _cartpole_flight(
    env: Any, policy: Policy, seed: int, nominal: FloatArray
) -> tuple[Flights, dict[str, Any]]:
    settings = env.settings
    observation, info = env.reset(seed=seed, options={"nominal": nominal})
    states = np.empty((1, settings.steps + 1, task.STATE_DIM))
    states[0, 0] = env.state
    forces = np.zeros((1, settings.steps, 1))
    alive = np.zeros(states.shape[:2], bool)
    alive[0, 0] = True
    reseed(policy, seed)
    memory: Any = None
    over = False
    for step in range(settings.steps):
        action, memory, _ = ask(policy, observation, memory, [step == 0], ACTION)
        forces[0, step] = settings.force_scale * float(action[0])
        observation, _, over, _, info = env.step(action)
        states[0, step + 1 :] = env.state
        alive[0, step + 1] = True
        if over:
            break
    return Flights(states, forces, alive, np.array([over])), info


def replay_spacecraft(target: SpacecraftTarget, pushes: FloatArray) -> Outcome:
    """Fly one sequence in a world of its own.

    Args:
        target: The world, the policy and the goal.
        pushes: d, shape (steps, agents, 6).
    """
    given = Replay(pushes, SpacecraftSettings().control_period)
    with Attempt() as attempt:
        flown = target.fly(target.environment(1, given))
    if attempt.error is not None:
        return Outcome(target.seed, math.inf, True, {}, attempt.error)
    success, collided = flown.info["success"][0], flown.info["collided"][0]
    ratio = None if target.margin is None else float(flown.position_error.max()) / target.margin
    broken = {
        "tube": ratio is not None and ratio > 1.0,
        "success": not bool(success.all()),
        "clearance": bool(collided.any()),
    }[target.goal]
    error_ = None if ratio is None else float(flown.position_error.max())
    measures = {
        "success_share": float(success.mean()),
        "strict_success_share": float(flown.info["strict_success"][0].mean()),
        "collided_agents": int(collided.sum()),
        "least_gap": float(flown.gap[0]),
        "max_position_error": error_,
        "share_of_certified": ratio,
    }
    return Outcome(target.seed, float(flown.scores[0]), broken, measures)


@dataclass(frozen=True)
class WorstCases:
    """Found sequences and all that it takes to fly them again.

    Attributes:
        command: What found them: the options of `lagros attack`, by name.
        pushes: d, shape (episodes, steps, 4), or (episodes, steps, agents, 6).
        outcomes: What each did.
    """

    command: Mapping[str, Any]
    pushes: FloatArray
    outcomes: tuple[Outcome, ...]


def save_worst_cases(found: WorstCases, path: Path | str) -> None:
    """Write sequences as .npz, atomically; no object is pickled."""
    record = {
        "format": _FORMAT,
        "command": dict(found.command),
        "outcomes": [asdict(outcome) for outcome in found.outcomes],
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, pushes=found.pushes, record=np.array(json.dumps(record)))
    write_atomic(path, buffer.getvalue())


def load_worst_cases(path: Path | str) -> WorstCases:
    """Read what `save_worst_cases` wrote.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no such file, or damaged.
    """
    arrays = read_npz(path, ("pushes", "record"), _MOST_BYTES)
    name = named(path)
    text, pushes = arrays["record"], arrays["pushes"]
    if text.dtype.kind != "U" or text.ndim:
        raise ValueError(f"{name} is not a file of `lagros attack --npz`: 'record' is no text")
    # The score of a flight that raised is infinite.
    record = Record(parse_json(str(text), f"{name}: 'record'", all_finite=False), name)
    record.must("format", _FORMAT)
    if pushes.dtype.kind != "f" or pushes.ndim not in (3, 4) or not np.all(np.isfinite(pushes)):
        raise ValueError(
            f"{name}: 'pushes' of shape {pushes.shape} and type {pushes.dtype} must be finite "
            "numbers of shape (episodes, steps, 4) or (episodes, steps, agents, 6)"
        )
    entries = record.list("outcomes")
    if len(entries) != len(pushes):
        raise ValueError(f"{name}: {len(entries)} 'outcomes' do not match pushes {pushes.shape}")
    outcomes = tuple(
        _outcome(Record(entry, f"{name}: outcome {index}")) for index, entry in enumerate(entries)
    )
    return WorstCases(record.record("command").entries, pushes.astype(np.float64), outcomes)


def _outcome(entry: Record) -> Outcome:
    """Return what a file says of one sequence, without what earlier versions called certified.

    Raises:
        ValueError: An entry is missing or of another type.
    """
    score, broken, error = entry["score"], entry["broken"], entry["error"]
    if not is_number(score):
        raise ValueError(f"{entry.name}: 'score' is {shown(score)} and must be a number")
    if not isinstance(broken, bool):
        raise ValueError(f"{entry.name}: 'broken' is {shown(broken)} and must be true or false")
    if not isinstance(error, str | None):
        raise ValueError(f"{entry.name}: 'error' is {shown(error)} and must be text or null")
    measures = {
        name: None if name.startswith("certified") else value
        for name, value in entry.record("measures").entries.items()
    }
    return Outcome(entry.whole("seed"), float(score), broken, measures, error)
