"""The closed loop of a policy and its environment, in which every command flies its episodes.

    loop = ClosedLoop(env, policy)
    for _ in loop.fly(seed):            # once for every control instant, the first one too
        print(loop.step, loop.info["goal_distance"])

What the loop holds is whole even where the next call raises. Whoever needs to look between the
decision and what comes of it calls `begin`, `decide` and `move` in the place of `fly`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from lagros_benchmarks.run.flying import AnswerError, ask
from lagros_benchmarks.run.library import SetupError, describe_error
from lagros_benchmarks.run.process import undone
from lagros_envs.conventions import beyond_the_end
from lagros_envs.seeding import episode_streams
from lagros_policies.policy import as_policy


class ClosedLoop:
    """A policy in a Gymnasium environment, of one body or of a batch that does not reset itself.

    Args:
        env: The environment; a batch has a row per body in observations and actions.
        policy: The policy, or an object with its `predict`.
        past_the_end: Whether what has ended flies on to the time limit. Otherwise it stands in a
            batch with the action zero until the others have ended, too.

    Raises:
        TypeError: The object has no such `predict`.

    Attributes:
        step: Control steps that were taken.
        observation: What the environment showed last.
        action: What the policy decided last; None before.
        memory: The policy's memory; None before the first decision.
        reward: Of the last step.
        terminated: Whether the last step ended the episode, each of a batch.
        truncated: Whether it reached the time limit, likewise.
        ended: Whether any step has done so, likewise.
        over: Whether all that flies has ended, or is at the time limit where it flies on.
        info: The environment's, at this instant.
        step_times: Time of every decision [s].
    """

    def __init__(self, env: Any, policy: Any, past_the_end: bool = False) -> None:
        self.env, self.policy = env, as_policy(policy)
        self._past_the_end, self._batch = past_the_end, False
        self._seed: Any = None
        self._shapes: Sequence[tuple[int, ...]] = ()
        self._clear()

    def _clear(self) -> None:
        self.step, self.over = 0, False
        self.observation: Any = None
        self.action: Any = None
        self.memory: Any = None
        self.reward: Any = 0.0
        self.terminated: Any = False
        self.truncated: Any = False
        self.ended: Any = False
        self.info: dict[str, Any] = {}
        self.step_times: list[float] = []

    def fly(self, seed: Any, options: dict[str, Any] | None = None) -> Iterator[ClosedLoop]:
        """Fly an episode, or a batch of them, to the end; yield at every control instant.

        Args:
            seed: Seed of the episode; a list of seeds for a batch.
            options: Those of the environment's `reset`.
        """
        self.begin(seed, options)
        yield self
        while not self.over:
            self.decide()
            self.move()
            yield self

    def begin(self, seed: Any, options: dict[str, Any] | None = None) -> None:
        """Reset the environment; see `fly` for the arguments."""
        self._clear()
        self._seed = seed
        self.observation, self.info = self.env.reset(seed=seed, options=options)
        # Asked for once: what follows is done at every step.
        self._shapes, self._batch = self.shapes(), np.ndim(self.observation) > 1
        if self._batch:
            self.ended = np.zeros(len(self.observation), bool)

    def decide(self) -> None:
        """Ask the policy for its action; what it draws comes from the stream of the first seed."""
        first = self.step == 0
        if first and self.policy.draws:
            seed = self._seed if np.ndim(self._seed) == 0 else self._seed[0]
            self.policy.reseed(episode_streams(seed).policy)
        seen = self.seen()
        starts = [first] if seen.ndim == 1 else np.full(len(seen), first)
        answer = ask(self.policy, seen, self.memory, starts, *self._shapes)
        self.action, self.memory, seconds = answer
        self.step_times.append(seconds)

    def move(self) -> None:
        """Hold the action for one control step."""
        if self._batch:
            self._move_batch()
            return
        outcome = self.env.step(self.action)
        self.observation, self.reward, self.terminated, self.truncated, self.info = outcome
        self.ended = self.over = self.terminated or self.truncated
        self.step += 1

    def _move_batch(self) -> None:
        if self._past_the_end:
            with beyond_the_end():
                outcome = self.env.step(self.action)
        else:
            self.action[self.ended] = 0.0
            outcome = self.env.step(self.action)
        self.observation, self.reward, self.terminated, self.truncated, self.info = outcome
        self.ended = self.ended | self.terminated | self.truncated
        self.over = bool(np.all(self.truncated if self._past_the_end else self.ended))
        self.step += 1

    def counters(self) -> dict[str, int]:
        """Return what the policy has counted in its memory."""
        if self.memory is None:
            return {}
        return {str(name): int(n) for name, n in self.policy.counters(self.memory).items()}

    def rehearse(self, what: str, seed: Any = 0, options: dict[str, Any] | None = None) -> None:
        """Ask the policy once before it flies, so that one that cannot run ends the command.

        Its first call also loads what the timed ones need. Whatever else it raises here it will
        raise in its episodes, where it is written down. A message begins with `what`, "policy
        'mine:Lean'" for instance.

        Raises:
            SetupError: A package is missing, or it answers by something that is no action of this
                task.
        """
        self.begin(seed, options)
        try:
            with undone():
                self.decide()
        except AnswerError as error:
            text = describe_error(error).partition(": ")[2]
            raise SetupError(f"{what} cannot fly: {text}") from error
        except ImportError as error:
            raise SetupError(f"{what} cannot fly: {describe_error(error)}") from error
        except KeyboardInterrupt:
            raise
        except BaseException:
            return

    def seen(self) -> Any:
        """Return what the policy is fed now."""
        return self.observation

    def shapes(self) -> Sequence[tuple[int, ...]]:
        """Return the shapes that its action may have; it is taken in the first."""
        return (self.env.action_space.shape,)
