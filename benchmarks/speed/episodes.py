"""The episodes that the planners are timed on."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.task import Scenario
from lagros_envs.tasks.cartpole import task
from lagros_policies.planning import Trajectory
from lagros_policies.tasks.cartpole.planner import CartPolePlanner, CartPolePlannerSettings
from speed.timing import Candidate, Scale

if TYPE_CHECKING:
    from speed.casadi_peer import CasadiPlanner

FloatArray = NDArray[np.float64]

# What a disturbance of d_bar = 0.75 can move a state by in one control period of 0.1 s.
PERTURBATION = 0.075
# Episodes of these benchmarks, apart from those of training and of evaluation.
_EPISODES = 0x73706565
_SEED = 0


@dataclass(frozen=True)
class Bench:
    """The planner, episodes, and their cold plans.

    Attributes:
        scale: How often to repeat.
        planner: The planner.
        scenarios: Start and goal of each episode.
        plans: Cold plan of each episode.
        perturbed: x_d at the first step of each plan, moved by one period of disturbance,
            shape (episodes, 4).
    """

    scale: Scale
    planner: CartPolePlanner
    scenarios: list[Scenario]
    plans: list[Trajectory]
    perturbed: FloatArray
    _peers: dict[tuple[int, bool], dict[str, CasadiPlanner]] = field(default_factory=dict)

    @classmethod
    def prepare(cls, scale: Scale) -> Bench:
        """Draw the episodes and plan them."""
        settings = task.CartPoleSettings(time_limit=0.1 * scale.steps)
        planner = CartPolePlanner(settings)
        scenarios = draw(settings, scale.plans)
        plans = [planner.plan(one.initial_state, one.goal) for one in scenarios]
        direction = np.random.default_rng(_SEED).standard_normal((len(plans), task.STATE_DIM))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        perturbed = np.stack([plan.states[1] for plan in plans]) + PERTURBATION * direction
        return cls(scale, planner, scenarios, plans, perturbed)

    def cold(self, settings: CartPolePlannerSettings | None = None) -> Candidate:
        """Return what plans an episode from a straight line."""
        planner = CartPolePlanner(self.planner.task, settings or self.planner.settings)

        def plan(index: int) -> Trajectory:
            scenario = self.scenarios[index]
            return planner.plan(scenario.initial_state, scenario.goal)

        return plan

    def warm(
        self, settings: CartPolePlannerSettings | None = None, nominal: bool = False
    ) -> Candidate:
        """Return what plans again one step later, from the perturbed or from the nominal state."""
        planner = CartPolePlanner(self.planner.task, settings or self.planner.settings)

        def plan(index: int) -> Trajectory:
            earlier = self.plans[index]
            start = earlier.states[1] if nominal else self.perturbed[index]
            return planner.plan(start, self.scenarios[index].goal, 1, guess=earlier)

        return plan

    def peers(self, start_step: int, warm: bool) -> dict[str, CasadiPlanner]:
        """Return the CasADi solvers that are installed, built once."""
        key = start_step, warm
        if key not in self._peers:
            self._peers[key] = self._build_peers(start_step, warm)
        return self._peers[key]

    def _build_peers(self, start_step: int, warm: bool) -> dict[str, CasadiPlanner]:
        if importlib.util.find_spec("casadi") is None:
            return {}
        from speed.casadi_peer import CasadiPlanner, available

        names = {"CasADi + IPOPT": "ipopt", "CasADi + fatrop": "fatrop"}
        return {
            label: CasadiPlanner(self.planner, solver, start_step, warm)
            for label, solver in names.items()
            if available(solver)
        }


def draw(settings: task.CartPoleSettings, count: int) -> list[Scenario]:
    """Return random episodes; more of them begin with the fewer."""
    return [
        settings.sample(episode_streams(seed).scenario)
        for seed in episode_seeds(_SEED, count, _EPISODES)
    ]
