"""Small environments of somebody else's, for the tests of what disturbs them."""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

STEP = 0.1


class Drift(gym.Env):
    """x moves by what is asked for, and the reward is -|x|; the state is kept under another name.

    It ends where |x| passes `edge`.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, edge=np.inf):
        """Begin nowhere."""
        self.edge, self.where = edge, np.zeros(2)

    def reset(self, *, seed=None, options=None):
        """Start near the origin."""
        super().reset(seed=seed)
        self.where = self.np_random.uniform(-0.1, 0.1, 2)
        return self.where.copy(), {}

    def step(self, action):
        """Move."""
        self.where = self.where + STEP * np.asarray(action, np.float64)
        size = float(np.linalg.norm(self.where))
        return self.where.copy(), -size, size > self.edge, False, {"is_success": size < 0.5}


class OfDrift:
    """Its adapter."""

    def state(self, env):
        """Return where it is."""
        return env.where

    def set_state(self, env, state):
        """Put it somewhere."""
        env.where = state

    def period(self, env):
        """Return its control step [s]."""
        return STEP


class Swing(gym.Env):
    """A mass on a spring without damping, whose reward is -|x|; what resounds is worst for it."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    dt = 0.25

    def reset(self, *, seed=None, options=None):
        """Start at rest."""
        super().reset(seed=seed)
        self.state = np.zeros(2)
        return self.state.copy(), {}

    def step(self, action):
        """Turn the phase."""
        x, v = self.state
        cosine, sine = np.cos(self.dt), np.sin(self.dt)
        self.state = np.array([cosine * x + sine * v, cosine * v - sine * x])
        return self.state.copy(), -abs(self.state[0]), False, False, {}


class Pair(ParallelEnv):
    """Two agents that each drift for three steps."""

    metadata = {"name": "pair"}

    def __init__(self):
        """Name them."""
        self.possible_agents, self.agents = ["left", "right"], []
        self.max_cycles = 3
        self._seen_in = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self._moves_in = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.rows = np.zeros((2, 2))

    def observation_space(self, agent):
        """Return the space of a row."""
        return self._seen_in

    def action_space(self, agent):
        """Return the space of a move."""
        return self._moves_in

    def reset(self, seed=None, options=None):
        """Start."""
        self.agents, self.time = list(self.possible_agents), 0
        self.rows = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, 2))
        return self._seen(), {agent: {} for agent in self.agents}

    def step(self, actions):
        """Move both."""
        self.rows = self.rows + STEP * np.array([actions[agent] for agent in self.agents])
        self.time += 1
        over = self.time == self.max_cycles
        agents = list(self.agents)
        seen = self._seen()
        self.agents = [] if over else agents
        return (
            seen,
            dict.fromkeys(agents, 0.0),
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, over),
            {agent: {} for agent in agents},
        )

    def _seen(self):
        return {agent: row.copy() for agent, row in zip(self.agents, self.rows, strict=True)}


class OfPair:
    """Its adapter: a row for each agent."""

    def state(self, env):
        """Return the rows."""
        return env.rows

    def set_state(self, env, state):
        """Set them."""
        env.rows = state

    def period(self, env):
        """Return the control step [s]."""
        return STEP


class Joints:
    """What the adapter of MuJoCo touches of an environment."""

    dt = 0.05

    def __init__(self, positions, velocities):
        """Take qpos and qvel."""
        self.data = SimpleNamespace(qpos=np.array(positions), qvel=np.array(velocities))

    def set_state(self, positions, velocities):
        """Set them."""
        self.data.qpos, self.data.qvel = positions.copy(), velocities.copy()


def particles(make, **parts):
    """Return what the adapter of particle worlds touches: two agents with such parts."""
    agents = [
        SimpleNamespace(state=SimpleNamespace(**{n: make(v) for n, v in parts.items()}))
        for _ in range(2)
    ]
    return SimpleNamespace(world=SimpleNamespace(agents=agents, dt=0.1))
