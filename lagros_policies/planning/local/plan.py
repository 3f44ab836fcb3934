"""The plan of one agent among what it senses: sequential convex programming, small and dense.

    min  1/2 int ||F||^2 dt + sum_k phi(s_k)
    s.t. dp/dt = v, dv/dt = F / m, F held over each step, from the given state to rest at the goal,
         |v| <= v_max, |F| <= F_max per axis where there is a limit,
         ||p(t_k) - c_j(t_k)|| >= R_j(t_k) - s_k, s_k >= 0

c_j is an obstacle, or another agent extrapolated at constant velocity. The plan always reaches to
the goal, with short steps as far as others can be foreseen and long ones after that, so that its
size does not depend on the time that remains. The distances are linearised as in `joint.scp`; all
may be violated at the price phi(s) = w_1 s + w_2 s^2 / 2, whose second term keeps an agent in the
middle of a passage too narrow for its margins. So a plan always exists, and says what it lacks.

Positions are affine in the forces, p(t) = p_0 + v_0 t + Phi(t) F for each axis alike, which leaves
the forces and the shortfalls as unknowns.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lagros_envs.arrays import FloatArray
from lagros_policies.planning.local.motion import Discs, LocalPlan, required_distances
from lagros_policies.planning.local.problem import LocalPlannerSettings, LocalProblem
from lagros_policies.planning.vectors import lengths

# Instants at which a plan in force is checked are at most this far apart [s], as long as these are
# enough for it.
_CHECK_SPACING, _MOST_CHECKS = 0.4, 300
# Look for another way when the plan in force has become dearer by this much [N^2 s].
_DEARER = 5e-3


class LocalPlanner:
    """Plans the motion of one agent."""

    def __init__(self, settings: LocalPlannerSettings | None = None) -> None:
        self.settings = settings or LocalPlannerSettings()

    def plan(
        self,
        start: FloatArray,
        goal: FloatArray,
        discs: Discs,
        left: float,
        last: LocalPlan | None = None,
        elapsed: float = 0.0,
        fresh: bool = True,
    ) -> LocalPlan:
        """Plan from a state to rest at the goal.

        Args:
            start: [p, v], shape (4,) [m, m/s].
            goal: Position, shape (2,) [m].
            discs: What to keep away from.
            left: Time until the agent should have arrived [s]; may be negative, for it is late.
            last: The plan in force; the guess that is tried first.
            elapsed: Time since that plan began [s].
            fresh: Whether to look for another way too, as is done whenever the last one is short.

        Returns:
            The best plan found. Where every program failed, `solved` is False and the forces are 0.
        """
        problem = LocalProblem(self.settings, start, goal, discs, left)
        best: LocalPlan | None = None
        programs = 0
        if last is not None:
            guess, _ = last.at(problem.times + elapsed)
            aside = problem.aside(guess)
            best = problem.solve(aside, warm=True)
            programs = best.programs
            fresh = fresh or best.cost > last.cost + _DEARER
        if best is None or fresh or not best.solved or best.short > self.settings.tolerance:
            for guess in problem.ways():
                found = problem.solve(guess)
                programs += found.programs
                if best is None or found.cost < self.settings.change * best.cost:
                    best = found
        assert best is not None  # there is always a way
        return replace(best, programs=programs)

    def shortfall(
        self, plan: LocalPlan, elapsed: float, goal: FloatArray, discs: Discs, left: float
    ) -> float:
        """Return by how much a plan in force falls short of the distances that it should keep now.

        Args:
            plan: The plan.
            elapsed: Time since it began [s].
            goal: Where it ends, shape (2,) [m].
            discs: What to keep away from, as it is seen now.
            left: Time until the agent should have arrived [s].

        Returns:
            The largest shortfall over the rest of the plan, or over the foresight if that is
            longer [m].
        """
        settings = self.settings
        if len(discs.centres) == 0:
            return 0.0
        ends = max(plan.duration - elapsed, settings.foresight)
        checks = min(math.ceil(ends / _CHECK_SPACING), _MOST_CHECKS)
        times = np.linspace(0.0, ends, checks + 1)
        places = plan.at(times + elapsed)[0]
        required = required_distances(discs, times, places[0], goal, left, settings.margin_growth)
        apart = lengths(places[:, None] - discs.at(times))
        heeded = discs.heeded(times, settings.foresight)
        return float(np.max(np.where(heeded, required - apart, 0.0), initial=0.0))
