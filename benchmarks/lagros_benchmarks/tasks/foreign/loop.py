"""The closed loop of a policy and an environment of somebody else's, and what is kept of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagros_benchmarks.run.closed_loop import ClosedLoop
from lagros_benchmarks.run.flying import Attempt, ask
from lagros_benchmarks.run.keeping import Keepable
from lagros_envs.arrays import FloatArray
from lagros_envs.foreign import Disturb
from lagros_envs.seeding import episode_streams

# What an environment may call success in its info; of the last step it is that of the episode.
_SUCCESS = ("is_success", "success")


@dataclass(frozen=True)
class ForeignRecord(Keepable):
    """What happened in one episode; how long it took is left out of the comparison.

    Attributes:
        seed: Seed of the episode.
        policy: Policy, as the run was asked for it.
        disturbance: Kind of disturbance.
        bound: d_bar, in units of the scale per second.
        total_reward: The return, undiscounted.
        length: Steps that were taken.
        terminated: Whether the environment ended it, not the limit of steps.
        success: What the environment says itself; None where it says nothing.
        error: The exception that ended the episode, which is then a failure; None if none did.
        step_times: Time of each call of `predict` [s].
        deadline_misses: Steps whose call took longer than the control period.
    """

    seed: int
    policy: str
    disturbance: str
    bound: float
    total_reward: float
    length: int
    terminated: bool
    success: bool | None
    error: str | None
    step_times: FloatArray = field(compare=False, repr=False)
    deadline_misses: int = field(compare=False)


class ForeignLoop(ClosedLoop):
    """One environment, whose observations and actions are arrays of any shape.

    Attributes:
        total_reward: The return so far.
    """

    total_reward = 0.0

    def begin(self, seed: Any, options: dict[str, Any] | None = None) -> None:
        """Reset the environment."""
        super().begin(seed, options)
        self._batch, self.ended, self.total_reward = False, False, 0.0

    def decide(self) -> None:
        """Ask the policy for its action, of the type that the environment takes."""
        first = self.step == 0
        if first and self.policy.draws:
            self.policy.reseed(episode_streams(self._seed).policy)
        answer = ask(self.policy, self.observation, self.memory, [first], *self._shapes)
        self.action = answer.action.astype(self.env.action_space.dtype)
        self.memory = answer.state
        self.step_times.append(answer.seconds)

    def move(self) -> None:
        """Hold the action for one control step."""
        super().move()
        self.total_reward += float(self.reward)


def fly(env: Disturb, policy: Any, seed: int, label: str, kind: str) -> ForeignRecord:
    """Fly one episode to its end; what is raised is its failure and never raised here."""
    loop = ForeignLoop(env, policy)
    with Attempt() as attempt:
        for _ in loop.fly(seed):
            pass
    said = next((bool(loop.info[name]) for name in _SUCCESS if name in loop.info), None)
    times = np.array(loop.step_times)
    return ForeignRecord(
        seed=seed,
        policy=label,
        disturbance=kind,
        bound=float(env.disturbance.bound),
        total_reward=loop.total_reward,
        length=loop.step,
        terminated=bool(loop.terminated),
        success=said if attempt.error is None or said is None else False,
        error=attempt.error,
        step_times=times,
        deadline_misses=int(np.count_nonzero(times > env.settings.control_period)),
    )
