"""What a task keeps at or below zero, in plans: against the optimum of a cone program."""

from dataclasses import dataclass, field, replace

import cvxpy as cp
import numpy as np
import pytest

from lagros_envs import Scenario, Task
from lagros_envs.dynamics import hold_step
from lagros_envs.numbers import functions
from lagros_policies.planning import Discs, Problem, plan_trajectory, solve_scp
from lagros_policies.planning.planner import planner_of, problem_of

_LIMIT = 0.3


@dataclass(frozen=True)
class Cart:
    """A point in the plane that is pushed."""

    state_dim: int = 4
    control_dim: int = 2

    def derivative(self, state, control, functions):
        return state[2], state[3], control[0], control[1]


def slow(state, functions):
    """A speed below a limit."""
    return (functions.sqrt(state[2] ** 2 + state[3] ** 2 + 1e-8) - _LIMIT,)


def problem(way=(2.0, 1.0), steps=40, **given):
    start, goal = np.zeros(4), np.array([*way, 0.0, 0.0])
    return Problem(Cart(), 0.25, steps, start, goal, keep=slow, **given)


def optimum(way, steps, period=0.25):
    """The least effort under the limit, by a cone program over the exact motion."""
    states, controls = cp.Variable((steps + 1, 4)), cp.Variable((steps, 2))
    rules = [states[0] == 0.0, states[-1] == np.array([*way, 0.0, 0.0])]
    for k in range(steps):
        place, speed = states[k, :2], states[k, 2:]
        rules += [
            states[k + 1, :2] == place + period * speed + 0.5 * period**2 * controls[k],
            states[k + 1, 2:] == speed + period * controls[k],
            cp.norm(states[k + 1, 2:]) <= _LIMIT,
        ]
    program = cp.Problem(cp.Minimize(period * cp.sum_squares(controls)), rules)
    program.solve(solver="CLARABEL")
    return program.value


@pytest.mark.parametrize("way", [(2.0, 1.0), (-2.4, 0.0), (0.3, 2.2)])
def test_effort_is_that_of_the_cone_program(way):
    plan = plan_trajectory(problem(way))
    assert plan.solved
    speed = np.linalg.norm(plan.states[:, 2:], axis=1)
    # Kept, and at the limit: without it the plan would be faster.
    assert speed.max() <= _LIMIT + 1e-6
    assert speed.max() >= _LIMIT - 2e-3
    assert plan.excess <= 1e-6
    assert np.linalg.norm(plan.states[:, 2:], axis=1).max() <= _LIMIT + 1e-6
    assert plan.effort == pytest.approx(optimum(way, 40), rel=0.02)
    free = plan_trajectory(replace(problem(way), keep=None))
    assert free.excess == -np.inf
    assert np.linalg.norm(free.states[:, 2:], axis=1).max() > 1.1 * _LIMIT


def test_what_no_motion_keeps_has_no_plan():
    plan = solve_scp(problem((4.0, 0.0)))
    assert not plan.solved
    assert plan.excess > 1e-3


def test_a_way_around_a_disc_keeps_it_as_well():
    disc = Discs(np.array([[1.0, 0.1]]), np.array([0.3]))
    plan = plan_trajectory(problem((2.0, 0.0), 50, discs=disc))
    assert plan.solved
    assert np.linalg.norm(plan.states[:, 2:], axis=1).max() <= _LIMIT + 1e-6
    assert np.linalg.norm(plan.states[:, :2] - [1.0, 0.1], axis=1).min() >= 0.3 - 1e-6


def test_the_rest_of_a_plan_keeps_it_too():
    whole = problem()
    plan = plan_trajectory(whole)
    rest = whole.rest(25, plan.states[15], plan.states[-1])
    again = solve_scp(rest, (plan.states[15:], plan.controls[15:]))
    assert again.solved
    np.testing.assert_allclose(again.controls, plan.controls[15:], atol=2e-2)


@dataclass(frozen=True)
class Slow(Task):
    """A task that keeps a speed, several numbers at once."""

    system: Cart = field(default_factory=Cart)
    control_period: float = 0.25
    time_limit: float = 10.0
    name, title = "slow", "Slow"

    def sample(self, rng):
        return Scenario(np.zeros(4), np.array([2.0, *rng.uniform(-1.0, 1.0, 1), 0.0, 0.0]))

    def keep(self, state, functions):
        return abs(state[2]) - 0.25, state[3] - 0.1, -0.1 - state[3]


@pytest.mark.parametrize("seed", range(4))
def test_a_task_says_what_its_plans_keep(seed):
    task = Slow()
    drawn = task.sample(np.random.default_rng(seed))
    plan = planner_of(task).plan(drawn.initial_state, drawn.goal)
    assert plan.solved
    kept = np.array(task.keep(list(plan.states[1:].T), functions))
    assert kept.max() <= 1e-6
    assert problem_of(task, drawn).keep == task.keep
    moved = hold_step(task.system, plan.states[:-1], plan.controls, task.control_period)
    np.testing.assert_allclose(moved, plan.states[1:], atol=1e-6)
