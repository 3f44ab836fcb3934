"""The planner and the expert of any task of one body, on tasks that no package knows."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from lagros_envs.dynamics import hold_step
from lagros_envs.task import Feedback, Scenario
from lagros_policies.contraction import BoxRegion, CvStemSettings, design_on_region
from lagros_policies.expert import Expert, Regulator, metric_of, regulator_weights
from lagros_policies.planning.planner import planner_of, problem_of
from lagros_policies.planning.scp import solve_scp
from tests.policies.toys import Drive, Slide

TASKS = (Slide(), Drive())


def drawn(task, seed):
    return task.sample(np.random.default_rng(seed))


@pytest.fixture(scope="module")
def metric():
    wanted = Slide.metric
    region = BoxRegion(
        wanted.low, wanted.high, wanted.error, wanted.control_low, wanted.control_high
    )
    settings = CvStemSettings(wanted.rate, 0, 0.05, wanted.margin, (1.0,) * 4)
    return design_on_region(Slide().system, region, settings, seed=1)


@pytest.fixture(scope="module")
def expert(metric):
    return Expert(Slide(), metric)


@pytest.fixture(scope="module")
def planned(expert):
    plans = []
    for seed in range(8):
        scenario = drawn(expert.task, seed)
        plan = expert.planner.plan(scenario.initial_state, scenario.goal, discs=scenario.discs)
        plans.append((scenario, plan))
    return plans


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
def test_plans_obey_the_task(task):
    for seed in range(5):
        scenario = drawn(task, seed)
        plan = planner_of(task).plan(scenario.initial_state, scenario.goal, discs=scenario.discs)
        assert plan.solved
        assert plan.horizon == task.steps
        moved = hold_step(task.system, plan.states[:-1], plan.controls, task.control_period)
        np.testing.assert_allclose(moved, plan.states[1:], atol=1e-6)
        np.testing.assert_allclose(plan.states[-1], scenario.goal, atol=1e-6)
        assert np.all(plan.controls <= np.array(task.control_high) + 1e-6)
        assert np.all(plan.states[1:] >= np.array(task.state_low) - 1e-6)
        away = np.linalg.norm(plan.states[:, None, :2] - scenario.discs[:, :2], axis=-1)
        keep = scenario.discs[:, 2] + task.body_radius + task.margin
        assert np.all(away >= keep - 1e-6)


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
def test_the_rest_of_a_plan_is_found_from_it(task):
    scenario = drawn(task, 0)
    planner = planner_of(task)
    whole = planner.plan(scenario.initial_state, scenario.goal, discs=scenario.discs)
    for step in (1, task.steps // 2, task.steps - 1):
        rest = planner.plan(whole.states[step], scenario.goal, step, whole, scenario.discs)
        assert rest.solved
        assert rest.horizon == task.steps - step
        assert rest.effort <= np.sum(
            (whole.controls[step:] - task.control_centre) ** 2
        ) * task.control_period * (1.0 + 2e-3)


def test_the_problem_of_a_task_is_its_own():
    task = replace(Slide(), control_period=0.2)
    scenario = drawn(task, 1)
    problem = problem_of(task, scenario, 5, scenario.initial_state + 0.1)
    assert (problem.period, problem.steps) == (0.2, 15)
    np.testing.assert_allclose(problem.initial_state, scenario.initial_state + 0.1)
    assert problem.control_low.tolist() == [[-4.0, -4.0]] * 15
    assert problem.state_high[3].tolist() == [np.inf, np.inf, 3.0, 3.0]
    np.testing.assert_allclose(problem.discs.required(15)[0], scenario.discs[:, 2] + 0.1 + 0.2)


def test_margins_grow_from_what_a_start_beside_a_disc_leaves():
    task = Slide()
    start, goal = np.zeros(4), np.array([4.0, 0.0, 0.0, 0.0])
    discs = np.array([[0.6, 0.0, 0.4], [2.5, 1.0, 0.3]])  # 0.1 m beyond touching
    problem = problem_of(task, Scenario(start, goal, discs))
    margin = problem.discs.margin
    np.testing.assert_allclose(margin[0], 0.1, atol=1e-5)
    assert np.all(np.diff(margin) >= 0.0)
    np.testing.assert_allclose(margin[10:], task.margin)
    assert planner_of(task).plan(start, goal, discs=discs).solved
    discs = discs - [0.15, 0.0, 0.0]
    with pytest.raises(ValueError, match=r"initial_state is 0\.45 from the centre of disc 0"):
        problem_of(task, Scenario(start, goal, discs))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"initial_state": np.zeros(3)}, "initial_state=.* must be 4 finite numbers"),
        ({"goal": np.full(4, np.nan)}, "goal=.* must be 4 finite numbers"),
        ({"start_step": 40}, "start_step=40 is not one of the 40 steps"),
        ({"start_step": -1}, "start_step=-1 is not one"),
    ],
)
def test_what_cannot_be_planned_is_refused(arguments, message):
    whole = {"initial_state": np.zeros(4), "goal": np.zeros(4), **arguments}
    with pytest.raises(ValueError, match=message):
        planner_of(Slide()).plan(**whole)


def test_the_rest_of_a_problem_is_the_problem_of_the_rest():
    task, scenario = Slide(), drawn(Slide(), 2)
    problem = problem_of(task, scenario).tightened(discs=np.linspace(0.0, 0.05, task.steps + 1))
    start = scenario.initial_state + 0.05
    rest = problem.rest(12, start, scenario.goal)
    by_hand = replace(
        problem_of(task, scenario, task.steps - 12, start),
        discs=replace(problem.discs, margin=problem.discs.margin[-13:]),
    )
    np.testing.assert_array_equal(rest.discs.required(12), by_hand.discs.required(12))
    ours, theirs = solve_scp(rest), solve_scp(by_hand)
    assert np.array_equal(ours.states, theirs.states)
    assert problem.steps == task.steps


def test_the_expert_keeps_every_state_in_the_tube(expert, planned):
    task, bound = expert.task, 0.4
    states = np.stack([plan.states for _, plan in planned])
    tracked = expert.track(states, np.stack([plan.controls for _, plan in planned]))
    everyone, rng = np.arange(len(states)), np.random.default_rng(0)
    state = states[:, 0].copy()
    for step in range(task.steps):
        control = expert.control(tracked, everyone, np.full(len(states), step), state)
        push = rng.standard_normal(state.shape)
        push *= bound / np.linalg.norm(push, axis=-1, keepdims=True)
        state = hold_step(task.system, state, control, task.control_period, push)
        away = np.linalg.norm(state[:, :2] - states[:, step + 1, :2], axis=-1)
        assert np.max(away) < task.margin


def test_a_batch_is_its_states_one_by_one(expert, planned):
    states = np.stack([plan.states for _, plan in planned])
    tracked = expert.track(states, np.stack([plan.controls for _, plan in planned]))
    rng = np.random.default_rng(1)
    plan, step = rng.integers(len(states), size=20), rng.integers(40, size=20)
    points = states[plan, step] + 0.1 * rng.standard_normal((20, 4))
    together = expert.control(tracked, plan, step, points)
    alone = [
        expert.control(tracked, plan[[i]], step[[i]], points[[i]])[0] for i in range(len(plan))
    ]
    np.testing.assert_allclose(together, alone, rtol=1e-9, atol=1e-9)
    late = expert.track(states[:, 7:], tracked.controls[:, 7:], 7)
    np.testing.assert_allclose(
        expert.control(late, plan, np.maximum(step, 7), points),
        expert.control(tracked, plan, np.maximum(step, 7), points),
        rtol=1e-9,
        atol=1e-9,
    )


def test_what_the_bounds_leave_of_a_control(expert, planned):
    states = np.stack([plan.states for _, plan in planned])
    tracked = expert.track(states, np.stack([plan.controls for _, plan in planned]))
    zero = np.zeros(1, np.intp)
    far = states[0, :1] + 3.0
    wanted = expert.wanted(tracked, zero, zero, far)
    assert np.max(np.abs(wanted)) > 4.0
    assert np.array_equal(expert.control(tracked, zero, zero, far), np.clip(wanted, -4.0, 4.0))


def test_a_regulator_far_from_the_end_is_the_stationary_one():
    task = Slide()
    weights = Feedback((2.0, 1.0, 0.5, 0.1), (0.3, 0.2))
    period = task.control_period
    # Exactly, by the matrix exponential of the linear system.
    a = np.zeros((6, 6))
    a[0, 2] = a[1, 3] = 1.0
    a[2, 2] = a[3, 3] = -0.2
    a[2, 4] = a[3, 5] = 1.0
    held = scipy.linalg.expm(period * a)
    by_state, by_control = held[:4, :4], held[:4, 4:]
    cost = scipy.linalg.solve_discrete_are(
        by_state, by_control, np.diag(weights.state_weights), np.diag(weights.control_weights)
    )
    stiffness = np.diag(weights.control_weights) + by_control.T @ cost @ by_control
    gain = np.linalg.solve(stiffness, by_control.T @ cost @ by_state)
    along = Regulator(task, weights).gains(
        np.tile(by_state, (1, 200, 1, 1)), np.tile(by_control, (1, 200, 1, 1)), np.arange(201)
    )
    np.testing.assert_allclose(along[0, 0], gain, rtol=1e-6)


def test_weights_without_any_follow_brysons_rule(metric):
    task = type(
        "Scaled",
        (Slide,),
        {"feedback": None, "state_scale": (2.0, 1.0, 0.5, 1.0), "control_spread": (4.0, 1.0)},
    )
    assert regulator_weights(task()) == Feedback((0.25, 1.0, 4.0, 1.0), (0.0625, 1.0))
    assert Expert(task(), metric).feedback == regulator_weights(task())


def test_a_task_without_a_metric_is_refused_with_a_remedy(tmp_path):
    with pytest.raises(ValueError, match="drive has no contraction metric: describe one in its cl"):
        metric_of(Drive())
    elsewhere = type("Elsewhere", (Slide,), {"weights": tmp_path})()
    with pytest.raises(FileNotFoundError, match=r"slide has no slide_metric.json in .*reproduce"):
        Expert(elsewhere, law="tuned")
    with pytest.raises(FileNotFoundError, match=r"slide; `lagros reproduce tests.*Slide` makes it"):
        Expert(Slide(), law="least-norm")
