"""Plans against independent integrators and an independent optimiser."""

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize

from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.planning import ScpSettings
from lagros_policies.tasks.cartpole.planner import CartPolePlanner, CartPolePlannerSettings

UPRIGHT = np.zeros(4)


def start_at(angle, rate=0.0):
    return np.array([0.0, angle, 0.0, rate])


def goal_at(position):
    return np.array([position, 0.0, 0.0, 0.0])


def random_scenarios(count, seed, settings=None):
    for index in range(count):
        rng = np.random.default_rng([seed, index])
        yield (settings or CartPoleSettings()).sample(rng)


def angle_limit(settings, times):
    """Return pi/2 less the margin that grows as a tube does (Theorem 3)."""
    grown = 1.0 - np.exp(-settings.margin_rate * times)
    return np.pi / 2 - settings.angle_margin * grown


def check(plan, scenario, oracle, planner):
    """Check a plan against the true dynamics, its ends and its limit."""
    assert plan.solved, plan.status
    following = oracle.step(plan.states[:-1], plan.controls)
    assert np.max(np.abs(following - plan.states[1:])) < 1e-6
    assert plan.defect < 1e-6
    assert np.array_equal(plan.states[0], scenario.initial_state)
    assert plan.states[-1] == pytest.approx(scenario.goal, abs=1e-6)
    assert plan.states.shape == (planner.task.steps + 1, 4)
    assert plan.controls.shape == (planner.task.steps, 1)
    times = planner.task.control_period * np.arange(1, planner.task.steps)
    limit = angle_limit(planner.settings, times)
    assert np.all(np.abs(plan.states[1:-1, 1]) <= limit + 1e-6)


def solve_everywhere(count, seed, oracle):
    planner = CartPolePlanner()
    solved = 0
    for scenario in random_scenarios(count, seed):
        plan = planner.plan(scenario.initial_state, scenario.goal)
        if plan.solved:
            solved += 1
            check(plan, scenario, oracle, planner)
        else:
            assert plan.status != "solved"
    return solved


def test_plans_of_random_episodes_hold(oracle):
    assert solve_everywhere(60, seed=11, oracle=oracle) == 60


@pytest.mark.slow
def test_at_least_99_percent_of_1000_random_episodes_are_solved(oracle):
    assert solve_everywhere(1000, seed=12, oracle=oracle) >= 990


def test_plan_follows_the_flow_to_the_truncation_error_of_its_integrator(oracle, plans):
    states, controls = plans[0][0], plans[1][0]

    def flow(state, control):
        answer = scipy.integrate.solve_ivp(
            lambda t, x: oracle.rates(x, control), (0.0, 0.1), state, rtol=1e-12, atol=1e-12
        )
        return answer.y[:, -1]

    exact = np.stack([flow(x, u) for x, u in zip(states[:-1], controls, strict=True)])
    error = np.max(np.abs(exact - states[1:]))
    # Four substeps a period. Half as long ones come 2^4 times closer, from the same plan.
    halved = np.max(np.abs(exact - oracle.step(states[:-1], controls, substeps=8)))
    assert error < 2e-5
    assert 10.0 < error / halved < 24.0


def least_effort(oracle, start, goal, steps, limit=None):
    """Solve the planning problem by SLSQP, by multiple shooting from a straight line."""
    period = oracle.period

    def unpack(z):
        states = np.concatenate([[start], z[steps:].reshape(steps - 1, 4), [goal]])
        return states.astype(z.dtype), z[:steps, None]

    def defects(z):
        states, controls = unpack(z)
        return (oracle.step(states[:-1], controls) - states[1:]).ravel()

    def slopes(z):
        states, controls = unpack(z)
        by_state = oracle.jacobian(lambda x: oracle.step(x, controls), states[:-1])
        by_control = oracle.jacobian(
            lambda u: oracle.step(states[:-1].astype(complex), u), controls
        )
        matrix = np.zeros((steps, 4, z.size))
        for k in range(steps):
            matrix[k, :, k] = by_control[k, :, 0]
            if k > 0:
                matrix[k, :, steps + 4 * (k - 1) : steps + 4 * k] = by_state[k]
            if k < steps - 1:
                matrix[k, :, steps + 4 * k : steps + 4 * (k + 1)] -= np.eye(4)
        return matrix.reshape(-1, z.size)

    guess = np.linspace(start, goal, steps + 1)[1:-1].ravel()
    bounds = [(None, None)] * steps
    for k in range(1, steps):
        widest = None if limit is None else limit[k - 1]
        low = None if limit is None else -widest
        bounds += [(None, None), (low, widest), (None, None), (None, None)]
    answer = scipy.optimize.minimize(
        lambda z: period * np.sum(z[:steps] ** 2),
        np.concatenate([np.zeros(steps), guess]),
        jac=lambda z: np.concatenate([2 * period * z[:steps], np.zeros(z.size - steps)]),
        constraints={"type": "eq", "fun": defects, "jac": slopes},
        bounds=bounds,
        method="SLSQP",
        options={"maxiter": 200, "ftol": 1e-8},
    )
    assert answer.success, answer.message
    assert np.max(np.abs(defects(answer.x))) < 1e-6
    return unpack(answer.x), answer.fun


@pytest.mark.parametrize(("angle", "position"), [(0.5, 0.4), (-0.9, 1.0), (0.1, -1.5)])
def test_effort_is_the_least_that_an_independent_optimiser_finds(oracle, angle, position):
    settings = CartPoleSettings(time_limit=2.5)
    planner = CartPolePlanner(settings)
    plan = planner.plan(start_at(angle), goal_at(position))
    (states, controls), effort = least_effort(oracle, start_at(angle), goal_at(position), 25)
    assert plan.solved
    assert plan.effort == pytest.approx(effort, rel=1e-3)
    assert plan.effort == pytest.approx(0.1 * np.sum(plan.controls**2))
    assert plan.controls == pytest.approx(controls, abs=0.02 * np.abs(controls).max())
    assert plan.states == pytest.approx(states, abs=0.02)


def test_angle_limit_is_kept_where_it_costs_effort(oracle):
    settings = CartPoleSettings(time_limit=2.0)
    start, goal = start_at(0.0), goal_at(1.5)
    free = CartPolePlanner(settings).plan(start, goal)
    tight = CartPolePlanner(settings, CartPolePlannerSettings(angle_margin=1.4, margin_rate=5.0))
    plan = tight.plan(start, goal)
    times = 0.1 * np.arange(1, 20)
    limit = angle_limit(tight.settings, times)
    assert tight.angle_limit(times) == pytest.approx(limit)
    assert plan.solved
    assert np.any(np.abs(free.states[1:-1, 1]) > limit + 0.01)
    assert np.all(np.abs(plan.states[1:-1, 1]) <= limit + 1e-6)
    assert np.any(np.abs(plan.states[1:-1, 1]) > limit - 1e-5)
    _, effort = least_effort(oracle, start, goal, 20, limit)
    assert plan.effort == pytest.approx(effort, rel=1e-3)
    assert plan.effort > 1.01 * free.effort


@pytest.mark.parametrize("warm", [True, False])
def test_planning_again_from_the_nominal_state_gives_the_rest_of_the_plan(plans, warm):
    # The principle of optimality, whatever the first guess.
    planner = CartPolePlanner()
    first = planner.plan(plans[0][3, 0], plans[0][3, -1])
    # With less than four steps left, only a guess finds the controls that meet four conditions.
    for step in (1, 10, 45, 80, 88, 89) if warm else (1, 10, 45, 80):
        again = planner.plan(
            first.states[step], first.states[-1], step, guess=first if warm else None
        )
        assert again.solved
        assert again.horizon == 90 - step
        assert again.states == pytest.approx(first.states[step:], abs=5e-3)
        assert again.controls == pytest.approx(first.controls[step:], abs=5e-2)
        assert again.effort == pytest.approx(
            0.1 * np.sum(first.controls[step:] ** 2), rel=2e-3, abs=1e-6
        )


def test_warm_start_needs_fewer_programs(plans):
    planner = CartPolePlanner()
    first = planner.plan(plans[0][3, 0], plans[0][3, -1])
    warm = planner.plan(first.states[1], first.states[-1], 1, first)
    cold = planner.plan(first.states[1], first.states[-1], 1)
    assert warm.iterations < cold.iterations
    assert warm.iterations <= 2


def test_plan_is_mirrored_with_the_problem():
    planner = CartPolePlanner()
    one = planner.plan(start_at(0.7), goal_at(2.0))
    other = planner.plan(start_at(-0.7), goal_at(-2.0))
    assert other.states == pytest.approx(-one.states, abs=1e-4)
    assert other.controls == pytest.approx(-one.controls, abs=1e-3)


def test_resting_at_the_goal_costs_nothing():
    plan = CartPolePlanner().plan(UPRIGHT, UPRIGHT)
    assert plan.solved
    assert plan.effort == pytest.approx(0.0, abs=1e-9)
    assert plan.states == pytest.approx(np.zeros((91, 4)), abs=1e-6)


def test_impossible_problem_is_reported_and_not_raised():
    # The pole turns so fast that no force keeps the next state within the limit.
    planner = CartPolePlanner(CartPoleSettings(time_limit=2.0))
    plan = planner.plan(start_at(1.5, rate=30.0), goal_at(0.0))
    assert not plan.solved
    assert plan.status != "solved"
    assert plan.status


def test_plan_counts_as_solved_only_where_its_defect_is_small():
    # However large the last step may be: the defects are what a plan is accepted by.
    for tolerance in (1e-3, 1e-9):
        scp = ScpSettings(step_tolerance=100.0, defect_tolerance=tolerance)
        planner = CartPolePlanner(settings=CartPolePlannerSettings(scp=scp))
        plan = planner.plan(start_at(1.0), goal_at(5.0))
        assert plan.solved
        assert plan.defect <= tolerance
    assert plan.iterations > 1


def test_iterations_end_and_say_so():
    planner = CartPolePlanner(settings=CartPolePlannerSettings(scp=ScpSettings(max_iterations=1)))
    plan = planner.plan(start_at(1.0), goal_at(5.0))
    assert not plan.solved
    assert plan.iterations == 1
    assert "1" in plan.status


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"initial_state": np.zeros(3)}, "initial_state"),
        ({"initial_state": np.array([0.0, np.nan, 0.0, 0.0])}, "initial_state"),
        ({"initial_state": np.zeros((1, 4))}, "initial_state"),
        ({"goal": np.zeros(5)}, "goal"),
        ({"goal": np.array([np.inf, 0.0, 0.0, 0.0])}, "goal"),
        ({"start_step": 90}, "start_step=90"),
        ({"start_step": 1000}, "start_step=1000"),
        ({"start_step": -1}, "start_step=-1"),
    ],
)
def test_problems_that_make_no_sense_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        CartPolePlanner().plan(**{"initial_state": UPRIGHT, "goal": UPRIGHT, **arguments})


def test_guess_that_is_too_short_is_refused(plans):
    planner = CartPolePlanner()
    short = planner.plan(plans[0][0, 40], plans[0][0, -1], 40)
    assert short.horizon == 50
    with pytest.raises(ValueError, match="guess"):
        planner.plan(plans[0][0, 0], plans[0][0, -1], 0, guess=short)


@pytest.mark.parametrize(
    "bad",
    [{"angle_margin": -0.1}, {"angle_margin": 1.6}, {"margin_rate": 0.0}],
)
def test_planner_settings_out_of_range_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        CartPolePlannerSettings(**bad)


def test_scp_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match="penalty"):
        ScpSettings(penalty=0.0)
