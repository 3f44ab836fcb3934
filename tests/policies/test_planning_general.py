"""The planner on systems that are no cart-pole, against integrators and optimisers of others."""

import importlib.util
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import scipy.integrate
from studies.planar import CAR, GRAVITY, car_problem, pvtol_problem

from lagros_envs.dynamics import check_system, hold_step, linearise_hold
from lagros_envs.tasks.pvtol.physics import Pvtol
from lagros_policies.planning import (
    Discs,
    PlannerSettings,
    Problem,
    ScpSettings,
    plan_trajectory,
    solve_scp,
)
from lagros_policies.planning import scp as scp_module
from lagros_policies.planning.guess import guesses
from lagros_policies.planning.problem import DISTANCE_SLACK
from lagros_policies.planning.program import Point, Programs
from lagros_policies.planning.qp import solve_qp

EXAMPLE = Path(__file__).parents[2] / "examples" / "planner_in_cvxpy.py"


@dataclass(frozen=True)
class Cart:
    """A point in the plane that is pushed: [x, y, v_x, v_y], exact under any Runge-Kutta rule."""

    state_dim: int = 4
    control_dim: int = 2

    def derivative(self, state, control, functions):
        return state[2], state[3], control[0], control[1]


def cart(steps=20, period=0.1, way=(2.0, 0.0), **given):
    start, goal = np.zeros(4), np.array([*way, 0.0, 0.0])
    return Problem(Cart(), period, steps, start, goal, **given)


def car_rates(state, control):
    _, _, heading, speed = state
    return [speed * np.cos(heading), speed * np.sin(heading), control[0], control[1]]


def pvtol_rates(state, control):
    """The velocity turned to the world's axes, where thrust and gravity act, and back."""
    _, _, roll, along, up, rate = state
    turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    velocity = turn @ [along, up]
    force = turn @ [0.0, sum(control) / 0.486] - [0.0, GRAVITY]
    spin = rate * np.array([[0.0, 1.0], [-1.0, 0.0]])
    change = turn.T @ force + spin @ [along, up]
    return [*velocity, rate, *change, 0.25 * (control[0] - control[1]) / 0.00383]


def flown(problem, plan, rates):
    """Return the states of every hold on a ten times finer grid, shape (N, 11, n)."""
    times = np.linspace(0.0, problem.period, 11)
    return np.stack(
        [
            scipy.integrate.solve_ivp(
                lambda t, x, u=u: rates(x, u),
                (0.0, problem.period),
                x,
                t_eval=times,
                rtol=1e-10,
                atol=1e-10,
            ).y.T
            for x, u in zip(plan.states[:-1], plan.controls, strict=True)
        ]
    )


def keep_distance(problem, places):
    """Return the least distance of places (..., 2) beyond radius, body and margin at any time."""
    gaps = np.linalg.norm(places[..., None, :] - problem.discs.centres, axis=-1)
    need = problem.discs.radii + problem.discs.body_radius + np.min(problem.discs.margin)
    return float(np.min(gaps - need))


def check(problem, plan, rates, tolerance):
    assert plan.solved, plan.status
    fine = flown(problem, plan, rates)
    assert np.max(np.abs(fine[:, -1] - plan.states[1:])) < tolerance
    assert plan.defect <= 1e-6
    assert np.array_equal(plan.states[0], problem.initial_state)
    assert plan.states[-1] == pytest.approx(problem.terminal_state, abs=1e-6)
    assert np.all(plan.states[1:] >= problem.state_low - 1e-6)
    assert np.all(plan.states[1:] <= problem.state_high + 1e-6)
    assert np.all(plan.controls >= problem.control_low - 1e-6)
    assert np.all(plan.controls <= problem.control_high + 1e-6)
    assert keep_distance(problem, fine[..., :2]) >= -1e-5
    assert plan.clearance >= -DISTANCE_SLACK


@pytest.mark.parametrize("system", [CAR.system, Pvtol()])
def test_the_systems_are_sound(system):
    check_system(system)


@pytest.mark.parametrize("episode", range(4))
def test_a_car_finds_its_way_among_discs(episode):
    problem = car_problem(np.random.default_rng([7, episode]))
    check(problem, plan_trajectory(problem), car_rates, 1e-6)


@pytest.mark.parametrize("episode", range(2))
def test_a_planar_quadrotor_finds_its_way_among_discs(episode):
    problem = pvtol_problem(np.random.default_rng([7, episode]))
    # The held rotors turn the body fast: four Runge-Kutta steps in a hold err by this.
    check(problem, plan_trajectory(problem), pvtol_rates, 5e-6)


@pytest.mark.slow
@pytest.mark.parametrize("draw", [car_problem, pvtol_problem])
def test_at_least_99_percent_of_200_random_episodes_are_solved(draw):
    plans = [plan_trajectory(draw(np.random.default_rng([8, k]))) for k in range(200)]
    assert sum(plan.solved for plan in plans) >= 198
    assert all(plan.defect <= 1e-6 and plan.clearance >= -1e-6 for plan in plans if plan.solved)


def test_a_hover_costs_nothing_but_against_another_reference():
    body = Pvtol()
    rest = Problem(body, 0.1, 20, np.zeros(6), np.zeros(6), reference_control=np.array(body.hover))
    plan = solve_scp(rest)
    assert plan.solved
    assert plan.effort == pytest.approx(0.0, abs=1e-9)
    assert plan.controls == pytest.approx(np.full((20, 2), body.hover), abs=1e-5)
    free = solve_scp(replace(rest, reference_control=np.array(0.0)))
    assert free.solved
    # Never more than what holds the body up, and little less: it comes back to its height.
    assert free.effort == pytest.approx(2.0 * 2.0 * body.hover**2, rel=1e-2)


def test_effort_of_a_linear_system_is_what_the_closed_form_says():
    # Least-norm controls of a reachability matrix; at the free end the velocity counts for nothing.
    problem = cart()
    matrix = np.zeros((4, 40))
    _, by_state, by_control = linearise_hold(Cart(), np.zeros(4), np.zeros(2), 0.1)
    for k in range(20):
        matrix[:, 2 * k : 2 * k + 2] = np.linalg.matrix_power(by_state, 19 - k) @ by_control
    for rows, end in (
        ([0, 1, 2, 3], problem.terminal_state),
        ([0, 1], np.array([2.0, 0.0, np.nan, np.nan])),
    ):
        plan = solve_scp(replace(problem, terminal_state=end))
        least = np.linalg.pinv(matrix[rows]) @ end[rows]
        assert plan.solved
        assert plan.controls.ravel() == pytest.approx(least, abs=1e-3)
        assert plan.effort == pytest.approx(0.1 * np.sum(least**2), rel=1e-4)


def test_bounds_bind_per_coordinate_and_time():
    free = solve_scp(cart())
    late = np.full((20, 2), np.inf)
    late[10:, 0] = 1.5  # only of the second half, only along the way
    held = solve_scp(cart(control_low=-late, control_high=late))
    assert np.min(free.controls[10:, 0]) < -2.0
    assert held.solved
    assert np.min(held.controls[10:, 0]) == pytest.approx(-1.5, abs=1e-4)
    assert np.max(held.controls[:10, 0]) > 1.6
    slow = solve_scp(cart(state_high=np.array([np.inf, np.inf, 1.2, np.inf])))
    assert np.max(free.states[:, 2]) > 1.4
    assert slow.solved
    assert np.max(slow.states[:, 2]) == pytest.approx(1.2, abs=1e-4)
    assert min(held.effort, slow.effort) > 1.01 * free.effort


def test_a_coordinate_with_a_free_end_keeps_its_bounds_there():
    end = np.array([2.0, 0.0, np.nan, 0.0])
    free = solve_scp(replace(cart(), terminal_state=end))
    high = np.array([np.inf, np.inf, 1.3, np.inf])
    bounded = solve_scp(replace(cart(state_high=high), terminal_state=end))
    assert free.states[-1, 2] > 1.4
    assert bounded.solved
    assert bounded.states[-1, 2] == pytest.approx(1.3, abs=1e-4)


@dataclass(frozen=True)
class InOtherUnits:
    """A system whose coordinates and controls are counted in other units."""

    inner: object
    state_unit: tuple
    control_unit: tuple

    @property
    def state_dim(self):
        return self.inner.state_dim

    @property
    def control_dim(self):
        return self.inner.control_dim

    def derivative(self, state, control, functions):
        x = [value * unit for value, unit in zip(state, self.state_unit, strict=True)]
        u = [value * unit for value, unit in zip(control, self.control_unit, strict=True)]
        rates = self.inner.derivative(x, u, functions)
        return [rate / unit for rate, unit in zip(rates, self.state_unit, strict=True)]


def test_with_scales_units_do_not_matter():
    problem = pvtol_problem(np.random.default_rng([7, 0]))
    unit, thrust = np.array([1e-3, 1e-3, 1.0, 10.0, 10.0, 0.01]), np.full(2, 1e-2)
    other = replace(
        problem,
        system=InOtherUnits(problem.system, tuple(unit), tuple(thrust)),
        initial_state=problem.initial_state / unit,
        terminal_state=problem.terminal_state / unit,
        state_low=problem.state_low / unit,
        state_high=problem.state_high / unit,
        control_low=problem.control_low / thrust,
        control_high=problem.control_high / thrust,
        reference_control=problem.reference_control / thrust,
        state_scale=problem.state_scale / unit,
        control_scale=problem.control_scale / thrust,
        discs=replace(
            problem.discs,
            centres=problem.discs.centres / 1e-3,
            radii=problem.discs.radii / 1e-3,
            body_radius=problem.discs.body_radius / 1e-3,
            margin=problem.discs.margin / 1e-3,
        ),
    )
    plain, scaled = (
        plan_trajectory(problem),
        plan_trajectory(
            other, PlannerSettings(scp=replace(PlannerSettings().scp, defect_tolerance=1e-4))
        ),
    )
    assert plain.solved
    assert scaled.solved
    assert scaled.states * unit == pytest.approx(plain.states, abs=5e-2)
    assert scaled.effort * 1e-4 == pytest.approx(plain.effort, rel=2e-2)


def test_the_iteration_may_stop_where_effort_hardly_falls():
    usual = PlannerSettings().scp
    longer = replace(usual, effort_tolerance=1e-5, max_iterations=300)
    early, late = [], []
    for episode in range(4):
        problem = pvtol_problem(np.random.default_rng([7, episode]))
        early.append(solve_scp(problem, next(guesses(problem)), usual))
        late.append(solve_scp(problem, next(guesses(problem)), longer))
    assert all(plan.solved for plan in early)
    assert sum(plan.iterations for plan in early) < 0.8 * sum(plan.iterations for plan in late)
    assert sum(plan.effort for plan in early) < 1.1 * sum(plan.effort for plan in late)


def test_a_step_is_shortened_only_where_the_trust_region_is_tight(monkeypatch):
    shares = []
    step = scp_module._Iteration._step

    def noting(self, point, values, weight):
        new, share = step(self, point, values, weight)
        if new is not None:
            shares.append((weight, share))
            assert new.merit <= point.merit + 1e-6 * (1.0 + abs(point.merit))
        return new, share

    monkeypatch.setattr(scp_module._Iteration, "_step", noting)
    for episode in range(3):
        problem = pvtol_problem(np.random.default_rng([9, episode]))
        solve_scp(problem, None, replace(PlannerSettings().scp, trust_weight=1.0))
        solve_scp(problem, None, replace(PlannerSettings().scp, line_search_weight=1e9))
    assert any(share < 1.0 for _, share in shares)
    assert all(weight >= 1.0 for weight, share in shares if share < 1.0)


# Discs.


def across_a_disc(steps, period, **given):
    """One disc on the straight way of the cart, a little aside."""
    discs = Discs(np.array([[1.0, 0.05]]), np.array(0.3), body_radius=0.1, **given)
    return cart(steps, period, discs=discs)


def exact_places(plan, count=50):
    """Return the cart's places between its nodes: the parabola of a held push."""
    time = np.linspace(0.0, plan.period, count)[:, None, None]
    place, speed = plan.states[:-1, :2], plan.states[:-1, 2:]
    return place + time * speed + 0.5 * time**2 * plan.controls


@pytest.mark.parametrize(("steps", "period"), [(40, 0.05), (10, 0.2), (5, 0.4)])
def test_no_plan_passes_through_a_disc_between_two_nodes(steps, period):
    problem = across_a_disc(steps, period)
    plan = plan_trajectory(problem)
    assert plan.solved
    assert keep_distance(problem, exact_places(plan)) >= -1e-4
    # It comes near: room is not given away but to what the coarse grid needs.
    assert keep_distance(problem, exact_places(plan)) < 0.02


def test_guesses_go_around_a_disc_on_either_side():
    discs = Discs(np.array([[1.0, 0.0]]), np.array(0.3), body_radius=0.1)
    problem = cart(discs=discs)
    first, second, roomy, straight = (states for states, _ in guesses(problem))
    middle = [states[10, 1] for states in (first, second)]
    assert middle[0] == pytest.approx(-middle[1], abs=1e-9)
    assert abs(middle[0]) > 0.3
    assert abs(roomy[10, 1]) > abs(middle[0])
    assert straight == pytest.approx(np.linspace(problem.initial_state, problem.terminal_state, 21))
    # From rest to rest: slow at both ends.
    steps = np.linalg.norm(np.diff(first[:, :2], axis=0), axis=1)
    assert max(steps[0], steps[-1]) < 0.3 * steps[10]
    moving = replace(problem, initial_state=np.array([0.0, 0.0, 1.0, 0.0]))
    states, controls = next(guesses(moving))
    assert np.linalg.norm(states[1, :2]) > 2.0 * steps[0]
    assert np.all(controls == 0.0)


def test_without_a_disc_or_a_place_to_end_at_the_guess_is_straight():
    discs = Discs(np.array([[1.0, 0.0]]), np.array(0.3))
    anywhere = np.array([2.0, np.nan, 0.0, 0.0])
    for problem in (cart(), replace(cart(discs=discs), terminal_state=anywhere)):
        (straight,) = (states for states, _ in guesses(problem))
        assert straight[:, 1] == pytest.approx(np.zeros(21))


def test_what_the_check_between_nodes_is_for(monkeypatch):
    # With the distances of the nodes alone, the coarse plan cuts the corner.
    problem = across_a_disc(5, 0.4)

    def at_nodes(self, states, path):
        gaps = np.linalg.norm(states[:, None, :2] - self.problem.discs.centres, axis=-1)
        short = np.maximum(self.required - gaps, 0.0)[1:-1]
        return self.required, float(np.min(gaps - self.required)), float(np.sum(short))

    monkeypatch.setattr(scp_module._Iteration, "_distances", at_nodes)
    plan = plan_trajectory(problem)
    assert plan.solved
    assert keep_distance(problem, exact_places(plan)) < -0.02


def test_a_margin_may_grow_with_time():
    growing = 0.3 * (1.0 - np.exp(-np.linspace(0.0, 2.0, 21)))
    problem = across_a_disc(20, 0.1, margin=growing)
    plan = plan_trajectory(problem)
    assert plan.solved
    gaps = np.linalg.norm(plan.states[:, :2] - problem.discs.centres[0], axis=-1)
    assert np.all(gaps >= 0.4 + growing - 1e-6)
    assert plan.effort > 1.05 * plan_trajectory(across_a_disc(20, 0.1)).effort


def test_without_a_way_no_plan_is_called_one():
    angle = np.linspace(0.0, 2.0 * np.pi, 9)[:-1]
    ring = np.stack([2.0 + 0.8 * np.cos(angle), 0.8 * np.sin(angle)], axis=-1)
    problem = cart(discs=Discs(ring, np.array(0.4)))
    plan = plan_trajectory(problem, PlannerSettings(attempts=2))
    assert not plan.solved
    assert plan.status != "solved"
    assert plan.clearance < -1e-3


def test_a_disc_far_away_changes_nothing():
    far = Discs(np.array([[0.0, 50.0]]), np.array(1.0))
    one, other = solve_scp(cart()), solve_scp(cart(discs=far))
    assert other.solved
    assert other.clearance == pytest.approx(49.0, abs=0.5)
    assert other.states == pytest.approx(one.states, abs=1e-6)
    assert one.clearance == np.inf


# Theorem 3.


def test_a_tube_tightens_each_bound_by_its_own():
    high = np.array([np.inf, 1.0, 2.0, 3.0])
    push = np.array([4.0, 5.0])
    discs = Discs(np.array([[1.0, 0.5]]), np.array(0.3), margin=np.array(0.1))
    problem = cart(
        state_low=-high, state_high=high, control_low=-push, control_high=push, discs=discs
    )
    time = np.linspace(0.1, 2.0, 20)[:, None]
    tube = (1.0 - np.exp(-time)) * np.array([0.3, 0.3, 0.2, 0.4])
    grown = np.concatenate([[0.0], tube[:, 0]])
    tight = problem.tightened(states=tube, controls=np.array([1.0, 0.5]), discs=grown)
    assert tight.state_high[:, 1:] == pytest.approx(high[1:] - tube[:, 1:])
    assert tight.state_low[:, 1:] == pytest.approx(-high[1:] + tube[:, 1:])
    assert np.all(np.isinf(tight.state_high[:, 0]))
    assert tight.control_high == pytest.approx(np.tile([3.0, 4.5], (20, 1)))
    assert tight.discs.required(20)[:, 0] == pytest.approx(0.4 + grown)
    plan = plan_trajectory(tight)
    assert plan.solved
    assert np.all(np.abs(plan.states[1:]) <= high - tube + 1e-6)
    assert np.all(np.abs(plan.controls) <= [3.0 + 1e-6, 4.5 + 1e-6])
    gaps = np.linalg.norm(plan.states[:, :2] - [1.0, 0.5], axis=-1)
    assert np.all(gaps >= 0.4 + grown - 1e-6)


def test_a_tube_that_leaves_nothing_is_refused():
    high = np.array([np.inf, 1.0, 2.0, 3.0])
    problem = cart(state_low=-high, state_high=high)
    with pytest.raises(ValueError, match="wider than the admissible"):
        problem.tightened(states=np.array([0.0, 1.1, 0.0, 0.0]))
    with pytest.raises(ValueError, match="radius"):
        problem.tightened(states=np.array(-0.1))
    with pytest.raises(ValueError, match="states of shape"):
        problem.tightened(states=np.zeros(3))
    around = replace(
        problem, discs=Discs(np.array([[1.0, 0.0]]), np.array(0.3), margin=np.array(0.1))
    )
    with pytest.raises(ValueError, match=r"discs=-0\.5"):
        around.tightened(discs=-0.5)
    with pytest.raises(ValueError, match="initial_state is 1 from the centre"):
        around.tightened(discs=0.7)


# Solvers.


@pytest.mark.parametrize("solver", ["clarabel", "osqp"])
def test_every_solver_makes_the_same_plan(solver):
    problem = car_problem(np.random.default_rng([7, 1]))
    settings = PlannerSettings()
    named = replace(settings, scp=replace(settings.scp, qp_solver=solver))
    first, second = plan_trajectory(problem), plan_trajectory(problem, named)
    assert second.solved
    # To what a last step below the tolerance leaves open.
    assert second.states == pytest.approx(first.states, abs=1e-2)
    assert second.effort == pytest.approx(first.effort, rel=1e-2)


@pytest.fixture
def example(monkeypatch):
    spec = importlib.util.spec_from_file_location("planner_in_cvxpy", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("draw", [car_problem, pvtol_problem])
def test_the_program_is_the_one_written_in_cvxpy(example, draw):
    problem = draw(np.random.default_rng([7, 3]))
    states, controls = next(guesses(problem))
    twin, x, u = example.convex_program(problem, states, controls, trust_weight=0.5)
    twin.solve(solver="CLARABEL")
    following = hold_step(problem.system, states[:-1], controls, problem.period)
    _, *slopes = linearise_hold(problem.system, states[:-1], controls, problem.period, 2)
    point = Point(states, controls, following, problem.discs.required(problem.steps))
    programs = Programs(problem, penalty=1e3, reach=100.0)
    answer = solve_qp(programs.around(point, slopes, 0.5), 1e-9)
    following, pushes = programs.states_and_controls(answer.values)
    assert answer.solved
    assert following == pytest.approx(x.value[1:], abs=1e-4)
    assert pushes == pytest.approx(u.value, abs=1e-4)


def test_the_example_converges(example, capsys):
    assert example.main(passes=2)[-1] < 1e-3
    assert "effort" in capsys.readouterr().out


# What makes no sense.

NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"period": 0.0}, "period=0.0"),
        ({"steps": 0}, "steps=0"),
        ({"initial_state": np.zeros(3)}, "initial_state of shape"),
        ({"initial_state": np.array([0.0, NAN, 0.0, 0.0])}, "initial_state.*finite"),
        ({"initial_state": "abcd"}, "initial_state"),
        ({"terminal_state": np.array([0.0, INF, 0.0, 0.0])}, "terminal_state.*NaN where"),
        ({"terminal_state": np.zeros((1, 4))}, "terminal_state of shape"),
        ({"state_high": np.zeros(3)}, r"state_high of shape \(3,\)"),
        ({"state_high": np.full((19, 4), 9.0)}, "state_high of shape"),
        ({"state_low": np.array(NAN)}, "state_low=nan"),
        ({"state_low": np.array(3.0), "state_high": np.array(2.0)}, "state_low=3 and"),
        ({"control_low": np.array([0.0, 2.0]), "control_high": np.array(1.0)}, "coordinate 1"),
        ({"state_high": np.array(1.0)}, r"terminal_state\[0\]=2 lies outside"),
        ({"reference_control": np.array(NAN)}, "reference_control"),
        ({"state_scale": np.array([1.0, 0.0, 1.0, 1.0])}, "state_scale.*> 0"),
        ({"control_scale": np.array(-1.0)}, "control_scale.*> 0"),
        ({"discs": Discs(np.array([[0.2, 0.0]]), np.array(0.3))}, "initial_state is 0.2 from"),
        ({"discs": Discs(np.array([[2.0, 0.1]]), np.array(0.3))}, "terminal_state is 0.1 from"),
        (
            {"discs": Discs(np.array([[1.0, 0.1]]), np.array(0.3), margin=np.zeros(7))},
            "margin of shape",
        ),
        ({"discs": Discs(np.zeros((0, 2)), np.array(0.3), position=(0, 4))}, "position"),
    ],
)
def test_problems_that_make_no_sense_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        replace(cart(), **given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"centres": np.zeros((2, 3))}, "centres of shape"),
        ({"centres": np.array([[NAN, 0.0], [1.0, 0.0]])}, "centres"),
        ({"radii": np.zeros(3)}, "radii of shape"),
        ({"radii": np.array(-1.0)}, "radii"),
        ({"body_radius": -0.1}, "body_radius"),
        ({"margin": np.array(INF)}, "margin"),
        ({"position": (1, 1)}, "position"),
        ({"position": (0, -1)}, "position"),
        ({"position": (0,)}, "position"),
        ({"position": (0.0, 1.0)}, "position"),
    ],
)
def test_discs_that_make_no_sense_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        replace(Discs(np.array([[1.0, 0.0], [2.0, 0.0]]), np.array(0.3)), **given)


def test_a_guess_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="states of the guess"):
        solve_scp(cart(), (np.zeros((20, 4)), np.zeros((20, 2))))
    with pytest.raises(ValueError, match="controls of the guess"):
        solve_scp(cart(), (np.zeros((21, 4)), np.full((20, 2), np.nan)))


@pytest.mark.parametrize("given", [{"qp_solver": "gurobi"}, {"effort_tolerance": -1.0}])
def test_settings_out_of_range_are_refused(given):
    with pytest.raises(ValueError, match=next(iter(given))):
        ScpSettings(**given)
