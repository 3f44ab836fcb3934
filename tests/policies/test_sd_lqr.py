"""The regulator of the exact error dynamics: its identity, its Riccati equation, its fallbacks."""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

from lagros_envs.dynamics import control_matrix, vector_field
from lagros_envs.dynamics.system import state_dependent_coefficient
from lagros_envs.env import TaskEnv
from lagros_envs.registry import task_named
from lagros_envs.task import Feedback
from lagros_envs.tasks import SHIPPED
from lagros_policies import make
from lagros_policies.sd_lqr import SdLqrPolicy, StateDependentRegulator, held_gains

SINGLE = [name for name in SHIPPED if task_named(name).most_agents == 1]
each = pytest.mark.parametrize("name", SINGLE)


def drawn(task, count, seed=0):
    """Return states, targets and controls of a task, at random around its starts."""
    rng = np.random.default_rng(seed)
    n = task.system.state_dim
    scale = np.array(task.state_scale or (1.0,) * n)
    nominal = np.stack([task.sample(rng).goal for _ in range(count)])
    nominal = nominal + 0.3 * scale * rng.uniform(-1, 1, (count, n))
    state = nominal + 0.3 * scale * rng.uniform(-1, 1, (count, n))
    spread = np.array(task.control_spread or (1.0,) * task.system.control_dim)
    control = np.array(task.control_centre) + spread * rng.uniform(-1, 1, (count, len(spread)))
    return state, nominal, control


@each
def test_the_error_obeys_the_matrices_without_a_remainder(name):
    task = task_named(name)
    state, nominal, control = drawn(task, 20)
    moved = control + np.random.default_rng(1).normal(size=control.shape)
    slope = state_dependent_coefficient(task.system, state, nominal, control)
    rate = vector_field(task.system, state, moved) - vector_field(task.system, nominal, control)
    told = np.einsum("sij,sj->si", slope, state - nominal)
    told += np.einsum("sij,sj->si", control_matrix(task.system, state), moved - control)
    np.testing.assert_allclose(told, rate, rtol=1e-7, atol=1e-7)


@each
def test_the_gain_solves_the_riccati_equation_of_the_hold(name):
    task = task_named(name)
    law = StateDependentRegulator(task)
    state, nominal, control = drawn(task, 3)
    gains, failed = law.gains(state, nominal, control)
    assert not failed.any()
    q, r = np.diag(law.weights.state_weights), np.diag(law.weights.control_weights)
    for row in range(3):
        slope = state_dependent_coefficient(task.system, state[row], nominal[row], control[row])
        reach = control_matrix(task.system, state[row])
        n = len(slope)

        # The hold of frozen matrices, by an integrator in place of a matrix exponential.
        def rate(_, flat, slope=slope, reach=reach, n=n):
            moved = flat.reshape(n, -1)
            turned = slope @ moved
            turned[:, n:] += reach
            return turned.ravel()

        begun = np.hstack([np.eye(n), np.zeros_like(reach)]).ravel()
        end = (
            scipy.integrate.solve_ivp(
                rate, (0.0, task.control_period), begun, rtol=1e-10, atol=1e-12
            )
            .y[:, -1]
            .reshape(n, -1)
        )
        f, g, k = end[:, :n], end[:, n:], gains[row]
        # The cost of K by its Lyapunov equation: no other gain costs less.
        cost = scipy.linalg.solve_discrete_lyapunov((f - g @ k).T, q + k.T @ r @ k)
        best = np.linalg.solve(r + g.T @ cost @ g, g.T @ cost @ f)
        np.testing.assert_allclose(k, best, rtol=1e-4, atol=1e-6 * np.abs(best).max())
        assert np.abs(np.linalg.eigvals(f - g @ k)).max() < 1.0


def test_where_there_is_no_gain_the_target_has_one_and_it_is_counted(monkeypatch):
    task = task_named("cartpole")
    law = StateDependentRegulator(task)
    state, nominal, control = drawn(task, 4)
    at_target, _ = law.gains(nominal[:1], nominal[:1], control[:1])
    held = StateDependentRegulator.held

    def lost(self, at, *others):
        """Let no control reach anything where the state is that of the test."""
        transition, effect = held(self, at, *others)
        reached = (at != state[:1]).any(axis=-1)[:, None, None]
        return transition, np.where(reached, effect, 0.0)

    monkeypatch.setattr(StateDependentRegulator, "held", lost)
    found, failed = law.answer(state[:1], nominal[:1], control[:1])
    assert failed.tolist() == [True]
    np.testing.assert_allclose(
        found[0], control[0] - at_target[0] @ (state[0] - nominal[0]), rtol=1e-6
    )

    def unmoved(self, *at):
        transition, effect = held(self, *at)
        return transition, 0.0 * effect

    env = TaskEnv(task=task, disturbance="none")
    policy = SdLqrPolicy(task, deadline=1e9)
    row, _ = env.reset(seed=3)
    monkeypatch.setattr(StateDependentRegulator, "held", unmoved)
    memory = None
    for _ in range(5):
        action, memory = policy.predict(row, memory)
        row, *_ = env.step(action)
    assert policy.counters(memory)["fallbacks"] == 5
    np.testing.assert_allclose(task.control(action), memory[0].plan.controls[4], rtol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_gains_of_many_loops_are_those_of_scipy_and_one_without_spoils_no_other(seed):
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 7)), int(rng.integers(1, 4))
    transition = rng.normal(size=(12, n, n)) * rng.choice((0.3, 1.0, 3.0), (12, 1, 1))
    effect = rng.normal(size=(12, n, m))
    state, control = np.diag(rng.uniform(0.1, 10.0, n)), np.diag(rng.uniform(0.01, 10.0, m))
    # One that grows, one that stays and one that is no number, none of them reached.
    for row, diagonal in enumerate((1.5, 1.0, np.nan)):
        transition[row], effect[row] = diagonal * np.eye(n), 0.0
    gains, failed = held_gains(transition, effect, state, control)
    assert failed.tolist() == [True] * 3 + [False] * 9
    assert not gains[:3].any()
    for f, g, gain in zip(transition[3:], effect[3:], gains[3:], strict=True):
        cost = scipy.linalg.solve_discrete_are(f, g, state, control)
        wanted = np.linalg.solve(control + g.T @ cost @ g, g.T @ cost @ f)
        # SciPy's own error: up to 4e-7 of the largest entry, against 40 digits, where the condition
        # of the cost comes to 1e9.
        np.testing.assert_allclose(gain, wanted, rtol=0.0, atol=1e-5 * np.abs(wanted).max())


def test_the_weights_decide():
    task = task_named("cartpole")
    gentle = StateDependentRegulator(task, Feedback((1.0,) * 4, (100.0,)))
    firm = StateDependentRegulator(task, Feedback((1.0,) * 4, (0.01,)))
    at = drawn(task, 1)
    assert np.linalg.norm(gentle.gains(*at)[0]) < np.linalg.norm(firm.gains(*at)[0])
    env = TaskEnv(task=task)
    row, _ = env.reset(seed=0)
    policy = make("sd-lqr", env, weights=firm.weights, deadline=1e9)
    assert policy.name == "sd-lqr"
    _, memory = policy.predict(row)
    assert policy.counters(memory) == {
        "plans": 1,
        "failed_plans": 0,
        "late_plans": 0,
        "fallbacks": 0,
    }
