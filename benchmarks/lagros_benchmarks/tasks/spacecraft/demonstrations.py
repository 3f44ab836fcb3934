"""The expert of one spacecraft: policy (d) with one agent."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from lagros_benchmarks.run.demonstrations import Expert
from lagros_envs.arrays import FloatArray
from lagros_envs.tasks.spacecraft.sensing import global_state
from lagros_policies.policy import PolicyState
from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy


class SpacecraftExpert(Expert):
    """One plan of the whole episode among the obstacles, tracked with u*.

    Args:
        env: The environment, unwrapped.
    """

    algorithm = "centralised planner of one agent, tracked with u*"

    def __init__(self, env: Any) -> None:
        self._env = env
        self._task = env.settings
        self._policy = CentralizedPolicy(
            env.settings, env.preset, 1, disturbance_bound=env.disturbance.bound
        )

    def predict(
        self, observation: Any, state: PolicyState = None, *rest: Any
    ) -> tuple[Any, PolicyState]:
        """Return the action, and the plan as the state."""
        # The planner knows all obstacles, also those that are not in sight yet.
        actions, state = self._policy.predict(global_state(self._env.episode.world)[0], state)
        return actions[0], state

    def nominal(self, state: PolicyState) -> tuple[FloatArray, FloatArray]:
        """Return x_d and u_d; see `Expert`."""
        memory = state[0]
        states, controls = memory.nominal[:, 0].copy(), memory.accelerations[:, 0]
        controls = np.concatenate([controls, np.full((1, 3), np.nan)])
        if not memory.solved:
            states[:], controls[:] = np.nan, np.nan
        return states, controls

    def counters(self, state: PolicyState) -> dict[str, int]:
        """Return how many plans were made and failed."""
        return self._policy.counters(state)

    def record(self) -> dict[str, Any]:
        """Return metric and planner; see `Expert`."""
        tracking = self._policy.tracking
        return {
            "metric": {
                name: {"alpha": axis.rate, "chi": axis.state_condition, "dual": axis.dual.tolist()}
                for name, axis in (("plane", tracking.plane), ("turning", tracking.turning))
            },
            "planner": asdict(self._policy.planner.settings),
        }
