"""Every environment of the package, each with the one way in which these tests play it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

import lagros_envs  # noqa: F401 - registers the ids
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.cartpole.env import CartPoleEnv
from lagros_envs.tasks.cartpole.vector import CartPoleVectorEnv
from lagros_envs.tasks.spacecraft.single import SpacecraftEnv
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv

CARTPOLE, SPACECRAFT = "lagros/CartPole-v0", "lagros/Spacecraft-v0"
IDS = (CARTPOLE, SPACECRAFT)
# So short that random episodes of spacecraft end, too.
SHORT = {CARTPOLE: {"time_limit": 0.8}, SPACECRAFT: {"time_limit": 0.8}}


@dataclass
class Player:
    """Plays an environment through steps and, where its episode is over, a reset without a seed.

    Attributes:
        env: The environment.
        over: Whether its episode is.
    """

    env: Any
    over: bool = False

    def reset(self, **arguments: Any) -> Any:
        """Start an episode."""
        self.over = False
        return self.env.reset(**arguments)

    def step(self, random: np.random.Generator) -> Any:
        """Take a random step, or the reset that is due."""
        if self.over:
            return self.reset()
        result = self.env.step(self.action(random))
        self.over = self.has_ended(result)
        return result

    def play(self, steps: int = 25, seed: int = 0) -> list[Any]:
        """Return all that the environment says over some steps."""
        random = np.random.default_rng(seed)
        return [self.step(random) for _ in range(steps)]

    def action(self, random: np.random.Generator) -> Any:
        """Draw an action."""
        space = self.env.action_space
        return random.uniform(space.low, space.high).astype(np.float32)

    def has_ended(self, result: Any) -> bool:
        """Tell whether a step ended the episode."""
        return bool(result[2] or result[3])


class Batch(Player):
    """Plays a vector environment, which starts episodes by itself unless told not to."""

    def has_ended(self, result: Any) -> bool:
        """Tell whether every episode is over and nothing starts the next."""
        if self.env.metadata["autoreset_mode"] is not gym.vector.AutoresetMode.DISABLED:
            return False
        return bool(np.all(result[2] | result[3]))


class Parallel(Player):
    """Plays PettingZoo's form in which all agents step at once."""

    def action(self, random: np.random.Generator) -> Any:
        """Draw an action for every agent."""
        return {agent: random.random(8, np.float32) for agent in self.env.agents}

    def has_ended(self, result: Any) -> bool:
        """Tell whether no agent is left."""
        return not self.env.agents


class Cycle(Parallel):
    """Plays PettingZoo's form in which one agent steps after the other."""

    def reset(self, **arguments: Any) -> Any:
        """Start an episode."""
        self.over = False
        self.env.reset(**arguments)
        return self.env.last()

    def step(self, random: np.random.Generator) -> Any:
        """Take the step of the agent whose turn it is, or the reset that is due."""
        if self.over:
            return self.reset()
        _, _, terminated, truncated, _ = self.env.last()
        self.env.step(None if terminated or truncated else random.random(8, np.float32))
        self.over = not self.env.agents
        return None if self.over else self.env.last()


@dataclass(frozen=True)
class Subject:
    """One environment, as users make it.

    Attributes:
        make: Makes it from the arguments of its class.
        player: How it is played.
        cartpole: Whether it is the cart-pole; the spacecraft otherwise.
        options: Names that `reset(options=...)` knows.
        own_copy: Whether `copy.copy` is ours to define; a wrapper of others copies what it wraps.
    """

    make: Callable[..., Any]
    player: type[Player] = Player
    cartpole: bool = True
    options: tuple[str, ...] = ("initial_state", "initial_error", "goal", "nominal")
    own_copy: bool = field(default=True, kw_only=True)

    def players(self, count: int = 1, **arguments: Any) -> list[Player]:
        """Make some of the same."""
        return [self.player(self.make(**arguments)) for _ in range(count)]


def _vector(make: Callable[..., Any], mode: str, **fixed: Any) -> Callable[..., Any]:
    return lambda **arguments: make(autoreset_mode=mode, **fixed, **arguments)


_OF_WORLD = ("scenario", "nominal")
_OF_WORLDS = ("scenarios", "nominal", "reset_mask")
_OF_CARTS = ("initial_state", "initial_error", "goal", "nominal", "reset_mask")

SINGLE = {
    "cart-pole": Subject(CartPoleEnv),
    "cart-pole of make": Subject(lambda **given: gym.make(CARTPOLE, **given), own_copy=False),
    "compiled cart-pole": Subject(lambda **given: CartPoleEnv(compiled=True, **given)),
    "spacecraft": Subject(SpacecraftEnv, Player, False, _OF_WORLD),
    "spacecraft of make": Subject(
        lambda **given: gym.make(SPACECRAFT, **given), Player, False, _OF_WORLD, own_copy=False
    ),
}
VECTOR = {
    "one cart-pole": Subject(
        _vector(CartPoleVectorEnv, "same_step", num_envs=1, compiled=False), Batch, True, _OF_CARTS
    ),
    "one spacecraft": Subject(
        _vector(SpacecraftVectorEnv, "same_step", num_envs=1, compiled=False),
        Batch,
        False,
        _OF_WORLDS,
    ),
    **{
        f"cart-poles, {mode}": Subject(
            _vector(CartPoleVectorEnv, mode, num_envs=3, compiled=False), Batch, True, _OF_CARTS
        )
        for mode in ("next_step", "same_step", "disabled")
    },
    "compiled cart-poles": Subject(
        _vector(CartPoleVectorEnv, "same_step", num_envs=3, compiled=True), Batch, True, _OF_CARTS
    ),
    **{
        f"spacecraft in worlds, {mode}": Subject(
            _vector(SpacecraftVectorEnv, mode, num_envs=4, num_agents=2, compiled=False),
            Batch,
            False,
            _OF_WORLDS,
        )
        for mode in ("next_step", "same_step", "disabled")
    },
    "compiled spacecraft": Subject(
        _vector(SpacecraftVectorEnv, "same_step", num_envs=4, num_agents=2, compiled=True),
        Batch,
        False,
        _OF_WORLDS,
    ),
}
PETTINGZOO = {
    "spacecraft at once": Subject(
        lambda **given: spacecraft_v0.parallel_env(num_agents=2, **given),
        Parallel,
        False,
        _OF_WORLD,
    ),
    "spacecraft in turn": Subject(
        lambda **given: spacecraft_v0.env(num_agents=2, **given),
        Cycle,
        False,
        _OF_WORLD,
        own_copy=False,
    ),
}
EVERY = {**SINGLE, **VECTOR, **PETTINGZOO}
