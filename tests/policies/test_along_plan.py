"""Metric and gain along a plan: against a semidefinite program, and in flight."""

from dataclasses import replace

import cvxpy as cp
import gymnasium as gym
import numpy as np
import pytest
import scipy.linalg

import lagros_policies
from lagros_envs.dynamics import hold_step, linearise_hold
from lagros_envs.task import Feedback
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction.along_plan import (
    contraction_condition,
    plan_metric,
    stage_weights,
)
from lagros_policies.contraction.control import contracting_set, nearest_contracting
from lagros_policies.expert import LAWS, SHIPPED_LAW, Expert
from lagros_policies.naming import with_parts
from lagros_policies.policy import policy_names
from tests.policies.toys import Drive, Slide

DECAY = 0.06


def random_plans(seed, steps=12, n=4, m=2, count=3):
    rng = np.random.default_rng(seed)
    by_state = np.eye(n) + 0.3 * rng.standard_normal((count, steps, n, n))
    by_control = rng.standard_normal((count, steps, n, m))
    state = rng.uniform(0.1, 2.0, (count, steps + 1, n))
    control = rng.uniform(0.1, 2.0, (count, steps, m))
    return by_state, by_control, state, control


@pytest.mark.parametrize(("seed", "controls"), [(0, 1), (1, 2), (2, 3)])
def test_metric_and_gain_solve_the_condition_with_the_weights_as_room(seed, controls):
    by_state, by_control, state, control = random_plans(seed, m=controls)
    metric = plan_metric(by_state, by_control, state, control, DECAY)
    condition = contraction_condition(metric, by_state, by_control, DECAY)
    assert np.linalg.eigvalsh(condition).min() > 0.0
    # What V falls by beyond the rate, for an error flown by a plain loop.
    rng = np.random.default_rng(seed)
    for plan in range(3):
        error = rng.standard_normal(4)
        for k in range(12):
            v = metric.gains[plan, k] @ error
            following = by_state[plan, k] @ error + by_control[plan, k] @ v
            before = error @ metric.matrices[plan, k] @ error
            after = following @ metric.matrices[plan, k + 1] @ following
            room = error @ (state[plan, k] * error) + v @ (control[plan, k] * v)
            assert before - np.exp(2.0 * DECAY) * after == pytest.approx(room, rel=1e-8)
            error = following


def test_a_wrong_gain_is_seen_by_the_condition():
    by_state, by_control, state, control = random_plans(5)
    metric = plan_metric(by_state, by_control, state, control, DECAY)
    wrong = metric._replace(gains=-metric.gains)
    assert np.linalg.eigvalsh(contraction_condition(wrong, by_state, by_control, DECAY)).min() < 0.0


def test_no_program_finds_a_larger_dual_than_the_recursion():
    """The largest W_0 = M_0^-1 over all W_k and Y_k = K_k W_k that keep the same room."""
    steps, n, m = 5, 3, 2
    by_state, by_control, state, control = (
        part[0] for part in random_plans(3, steps=steps, n=n, m=m, count=1)
    )
    found = plan_metric(by_state, by_control, state, control, DECAY)
    duals = [cp.Variable((n, n), symmetric=True) for _ in range(steps)]
    duals.append(cp.Constant(np.linalg.inv(found.matrices[-1])))
    asked = []
    for k in range(steps):
        product = cp.Variable((m, n))
        moved = np.exp(DECAY) * (by_state[k] @ duals[k] + by_control[k] @ product)
        row = [
            duals[k],
            moved.T,
            duals[k] @ np.diag(np.sqrt(state[k])),
            product.T @ np.diag(np.sqrt(control[k])),
        ]
        sides = [None, duals[k + 1], np.eye(n), np.eye(m)]
        sizes = (n, n, n, m)
        rows = [row]
        for at in range(1, 4):
            zero = [np.zeros((sizes[at], size)) for size in sizes]
            zero[0], zero[at] = row[at].T, sides[at]
            rows.append(zero)
        block = cp.bmat(rows)
        asked.append(0.5 * (block + block.T) >> 0)
    program = cp.Problem(cp.Maximize(cp.trace(duals[0])), asked)
    program.solve(solver=cp.CLARABEL)
    assert program.status == cp.OPTIMAL
    best = np.linalg.inv(found.matrices[0])
    assert duals[0].value == pytest.approx(best, rel=1e-3, abs=1e-4 * np.abs(best).max())


def test_far_from_the_end_it_is_the_stationary_regulator_of_the_discounted_system():
    by_state, by_control, state, control = (part[0, :1] for part in random_plans(7))
    count = 300
    tiled = (np.repeat(part, count, 0) for part in (by_state, by_control))
    found = plan_metric(*tiled, np.repeat(state, count + 1, 0), np.repeat(control, count, 0), DECAY)
    grown = np.exp(DECAY) * by_state[0], np.exp(DECAY) * by_control[0]
    value = scipy.linalg.solve_discrete_are(*grown, np.diag(state[0]), np.diag(control[0]))
    assert found.matrices[0] == pytest.approx(value)
    closed = by_state[0] + by_control[0] @ found.gains[0]
    assert np.abs(np.linalg.eigvals(closed)).max() < np.exp(-DECAY)


def test_weights_begin_as_they_are_told_and_settle():
    weights = Feedback((2.0, 3.0), (0.5,), 0.3, (1.0, 0.0), (-2.0,), 0.4)
    state, control = stage_weights(weights, np.array([0.0, 0.4, 40.0]), 3)
    assert state[0] == pytest.approx([2.0 * np.e, 3.0])
    assert state[1] == pytest.approx([2.0 * np.exp(np.exp(-1.0)), 3.0])
    assert state[2] == pytest.approx([2.0, 3.0])
    assert control[:, 0] == pytest.approx([0.5 * np.exp(-2.0), 0.5 * np.exp(-2.0 * np.exp(-1.0))])
    settled, _ = stage_weights(weights, None, 3)
    assert settled == pytest.approx(np.tile([2.0, 3.0], (3, 1)))


@pytest.fixture(scope="module", params=[Slide(), Drive()], ids=["slide", "drive"])
def planned(request):
    task, found = request.param, []
    expert = Expert(task)
    for seed in range(3):
        scenario = task.sample(np.random.default_rng(seed))
        plan = expert.planner.plan(scenario.initial_state, scenario.goal, discs=scenario.discs)
        assert plan.solved
        found.append((plan.states, plan.controls))
    return task, np.stack([one for one, _ in found]), np.stack([two for _, two in found])


@pytest.mark.parametrize("law", ["gain", "projected", "half-rate", "double-rate", "no-rate", "lqr"])
def test_laws_along_a_plan_need_no_metric_of_the_task(planned, law):
    task, states, controls = planned
    expert = Expert(task, law=law)
    tracked = expert.track(states, controls)
    assert tracked.feedback.shape == (*controls.shape, task.system.state_dim)
    every, step = np.arange(3), np.full(3, 4)
    assert expert.control(tracked, every, step, states[:, 4]) == pytest.approx(
        expert.applied(controls[:, 4]), abs=1e-9
    )
    error = 1e-4 * np.random.default_rng(1).standard_normal(states[:, 4].shape)
    wanted = controls[:, 4] + np.einsum("pmn,pn->pm", tracked.feedback[:, 4], error)
    batch = expert.wanted(tracked, every, step, states[:, 4] + error)
    assert batch == pytest.approx(wanted, abs=1e-7)
    for row in range(3):
        one = slice(row, row + 1)
        alone = expert.wanted(tracked, every[one], step[one], states[one, 4] + error[one])
        assert alone[0] == pytest.approx(batch[row], abs=1e-9)


def test_the_projection_contracts_and_moves_no_more_than_it_must(planned):
    task, states, controls = planned
    expert, plain = Expert(task, law="projected"), Expert(task, law="gain")
    tracked, other = expert.track(states, controls), plain.track(states, controls)
    period, rate = task.control_period, expert.feedback.rate
    rng = np.random.default_rng(2)
    count = 300
    plan, step = rng.integers(3, size=count), rng.integers(controls.shape[1], size=count)
    nominal = states[plan, step]
    error = rng.standard_normal(nominal.shape) * rng.uniform(0.0, 1.0, (count, 1))
    state = nominal + error
    flown = expert.wanted(tracked, plan, step, state)
    gained = plain.wanted(other, plan, step, state)
    before = np.einsum("si,sij,sj->s", error, tracked.matrices[plan, step], error)
    # Linearly in v, as the set is defined: by finite differences about u_d.
    nominal_control = controls[plan, step]
    base = hold_step(task.system, state, nominal_control, period)
    slopes = linearise_hold(task.system, state, nominal_control, period)[2]
    target = hold_step(task.system, nominal, nominal_control, period)

    def energy(control):
        moved = base - target + np.einsum("sij,sj->si", slopes, control - nominal_control)
        return np.einsum("si,sij,sj->s", moved, tracked.matrices[plan, step + 1], moved)

    limit = np.exp(-2.0 * rate * period) * before
    possible = energy(flown) <= limit * (1.0 + 1e-6) + 1e-12
    assert possible.mean() > 0.9
    inside = energy(gained) <= limit
    assert flown[inside] == pytest.approx(gained[inside], abs=1e-9)
    # Any other point of the set is farther from the gain.
    for share in (0.1, 0.5):
        towards = gained + (1.0 - share) * (flown - gained)
        nearer = np.linalg.norm(flown - gained, axis=-1) > 1e-6
        assert np.all(energy(towards)[nearer & possible] >= limit[nearer & possible] * (1 - 1e-6))


def test_half_and_double_rate_are_the_same_program_at_other_rates(planned):
    task, states, controls = planned
    rates = {law: Expert(task, law=law).feedback.rate for law in ("gain", "half-rate")}
    assert rates["half-rate"] == 0.5 * rates["gain"]
    doubled = Expert(task, law="double-rate")
    own = Expert(task, law="gain").feedback
    assert doubled.feedback == replace(own, rate=2.0 * own.rate)
    slow, fast = (
        np.abs(Expert(task, law=law).track(states, controls).feedback).sum()
        for law in ("half-rate", "double-rate")
    )
    assert slow < fast


def test_without_a_rate_the_law_is_the_plain_regulator_of_its_weights(planned):
    task, states, controls = planned
    own, period = Expert(task).feedback, task.control_period
    flat = replace(own, early_state=(), early_control=())
    found = Expert(task, law="no-rate", weights=replace(flat, rate=0.0)).track(states, controls)
    assert Expert(task, law="no-rate").feedback == replace(own, rate=0.0)
    _, by_state, by_control = linearise_hold(task.system, states[:, :-1], controls, period)
    q, r = np.diag(own.state_weights), np.diag(own.control_weights)
    for plan in range(len(states)):
        value = 10.0 * q
        for k in reversed(range(controls.shape[1])):
            a, b = by_state[plan, k], by_control[plan, k]
            gain = -np.linalg.solve(r + b.T @ value @ b, b.T @ value @ a)
            # Joseph's form, another than that of the recursion.
            value = q + gain.T @ r @ gain + (a + b @ gain).T @ value @ (a + b @ gain)
            assert found.feedback[plan, k] == pytest.approx(gain, rel=1e-6, abs=1e-9)


def test_the_nearest_point_of_one_control_is_that_of_the_general_ellipsoid():
    rng = np.random.default_rng(3)
    a, b, c = rng.uniform(0.5, 2.0, 50), rng.standard_normal(50), rng.uniform(-2.0, 0.1, 50)
    point = 3.0 * rng.standard_normal(50)
    one = nearest_contracting(a, b, c, point)
    many = nearest_contracting(a[:, None, None], b[:, None], c, point[:, None])
    assert one == pytest.approx(many)


def test_a_system_of_several_controls_gives_matrices():
    task = Slide()
    state = np.array([0.1, 0.0, 0.2, 0.0])
    a, b, c = contracting_set(
        task.system, 0.1, 0.5, (state, np.zeros(4), np.zeros(2)), np.eye(4), lambda *_: np.eye(4)
    )
    assert (a.shape, b.shape, c.shape) == ((2, 2), (2,), ())


def test_laws_are_policies_by_name():
    env = gym.make("lagros/CartPole-v0")
    for law in LAWS:
        name = "lqr-plan" if law == "lqr" else f"tube-mpc:{law}"
        policy = lagros_policies.make(name, env)
        assert policy.name == name
        assert policy.expert.law_name == law
    assert lagros_policies.make("tube-mpc", env).expert.law_name == SHIPPED_LAW
    with pytest.raises(ValueError, match=r"tube-mpc:gian.*Did you mean 'tube-mpc:gain'"):
        lagros_policies.make("tube-mpc:gian", env)
    with pytest.raises(ValueError, match=r"law='gian' must be one of gain.*Did you mean 'gain'"):
        lagros_policies.make("tube-mpc", env, law="gian")


def test_ablation_stands_for_the_parts_of_what_is_shipped():
    known = policy_names(CartPoleSettings())
    parts = with_parts(["ablation"], known)
    assert {f"tube-mpc:{law}" for law in LAWS if law != "lqr"} < set(parts)
    assert "lqr-plan" in parts
    assert not {"tube-mpc", "tube-mpc:replan"} & set(parts)
    assert with_parts(["lqr-plan", "ablation", "mine:Own"], known) == (
        "lqr-plan",
        *(name for name in parts if name != "lqr-plan"),
        "mine:Own",
    )
