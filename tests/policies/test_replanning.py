"""Where a re-plan begins, when it is asked for, and on which clock its margins and gains run."""

import numpy as np
import pytest

from lagros_envs.tasks.cartpole.task import FALL_ANGLE, CartPoleSettings
from lagros_policies.planning import Problem, solve_scp
from lagros_policies.planning.local.plan import LocalPlanner
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tasks.cartpole.planner import CartPolePlanner, CartPolePlannerSettings
from lagros_policies.tasks.spacecraft.distributed import DistributedTubeMpcPolicy
from lagros_policies.tube_mpc import TubeMpcPolicy

SHORT = CartPoleSettings(time_limit=3.0, goal_range=1.0)
START = (0.0, 0.4, 0.0, 0.0)


# The cart-pole.


def cartpole_row(step, state=START, goal=0.5):
    return np.array([*state, goal, 0.0, 0.0, 0.0, *START, 0.1 * step], np.float32)


def test_a_goal_that_moves_by_a_little_makes_a_plan_of_its_own(metric):
    policy = TubeMpcPolicy(SHORT, metric)
    _, memory = policy.predict(cartpole_row(0))
    first = memory[0].plan
    assert first.states[-1] == pytest.approx([0.5, 0.0, 0.0, 0.0], abs=1e-6)
    _, memory = policy.predict(cartpole_row(1, first.states[1], goal=0.52), memory)
    second = memory[0].plan
    assert second.states[-1] == pytest.approx([0.52, 0.0, 0.0, 0.0], abs=1e-6)
    assert np.max(np.abs(second.controls - first.controls[1:])) < 1.0  # a little [N]


def test_plans_fall_on_the_multiples_of_their_period(metric):
    policy = TubeMpcPolicy(SHORT, metric, replan_every=3)
    memory, asked = None, []
    for step in range(8):
        _, memory = policy.predict(cartpole_row(step), memory)
        asked.append(memory[0].plans)
    assert asked == [1, 1, 1, 2, 2, 2, 3, 3]


def test_the_gains_of_the_rest_of_a_plan_are_those_of_the_whole(metric, plans):
    expert = CartPoleExpert(metric)
    states, controls = plans[0][:3], plans[1][:3]
    whole = expert.track(states, controls)
    rng = np.random.default_rng(0)
    for begin in (1, 30, 80):
        rest = expert.track(states[:, begin:], controls[:, begin:], begin)
        plan, step = np.arange(3), np.full(3, begin + 4)
        away = states[:, begin + 4] + rng.uniform(-0.1, 0.1, (3, 4))
        expected = expert.control(whole, plan, step, away)
        assert expert.control(rest, plan, step, away) == pytest.approx(expected, abs=1e-9)


def test_a_plan_that_begins_late_keeps_the_margin_of_its_time():
    tightened = CartPolePlannerSettings(angle_margin=1.35, margin_rate=1.0)
    planner = CartPolePlanner(CartPoleSettings(time_limit=4.0), tightened)
    begin = 20
    # So far to go in two seconds that the pole has to lean as much as it may.
    plan = planner.plan(np.zeros(4), np.array([2.0, 0.0, 0.0, 0.0]), begin)
    assert plan.solved
    times = 0.1 * np.arange(begin + 1, 40)
    limit = FALL_ANGLE - 1.35 * (1.0 - np.exp(-times))
    angle = np.abs(plan.states[1:-1, 1])
    assert np.all(angle <= limit + 1e-6)
    assert np.any(angle >= limit - 1e-4)


def test_a_warm_start_beyond_the_bounds_is_left():
    planner = CartPolePlanner()
    start, goal = np.array([0.0, 0.5, 0.0, 0.0]), np.array([2.0, 0.0, 0.0, 0.0])
    none = np.full(4, np.inf)

    def solve(sign, low, high, guess=None):
        system = planner.task.system
        return solve_scp(Problem(system, 0.1, 40, sign * start, sign * goal, low, high), guess)

    free = solve(1.0, -none, none)
    assert free.solved
    for sign in (1.0, -1.0):  # the same problem and its mirror image, at the other bound
        high = none.copy()
        high[2] = 0.9 * np.max(free.states[1:-1, 2])
        low, high = (-none, high) if sign > 0.0 else (-high, none)
        guess = sign * free.states, sign * free.controls
        plan = solve(sign, low, high, guess)
        assert plan.solved
        assert np.all(plan.states[1:-1] <= high + 1e-6)
        assert np.all(plan.states[1:-1] >= low - 1e-6)


# The spacecraft, each for itself.


@pytest.fixture
def asked(monkeypatch):
    """Every call of the local planner, by the names of its arguments."""
    calls = []
    sound = LocalPlanner.plan

    def plan(self, start, goal, discs, left, last=None, elapsed=0.0, fresh=True):
        calls.append({"start": start, "discs": discs, "last": last, "fresh": fresh})
        return sound(self, start, goal, discs, left, last, elapsed, fresh)

    monkeypatch.setattr(LocalPlanner, "plan", plan)
    return calls


def spacecraft_row(layout, place, neighbours=(), obstacles=(), time=0.0):
    """Return the observation of an agent at a place whose goal is the origin."""
    row, at = np.zeros(layout.size, np.float32), layout.slices
    row[at["goal"]], row[at["time"]], row[at["heading"]] = -np.asarray(place), time, (1.0, 0.0, 0.0)
    for name, values in (("neighbour", neighbours), ("obstacle", obstacles)):
        flat = np.ravel(np.asarray(values, np.float32))
        row[at[name + "s"]][: flat.size] = flat
        row[at[name + "_mask"]][: len(values)] = 1.0
    return row


def test_a_spacecraft_plans_again_from_its_nominal_state(asked):
    policy = DistributedTubeMpcPolicy(replan_every=1, kept_for=0.0)
    _, memory = policy.predict(spacecraft_row(policy.layout, (2.0, 1.0)))
    first = memory[0].plan
    assert asked[0]["start"] == pytest.approx([2.0, 1.0, 0.0, 0.0])
    # A push has carried it away from the plan, which goes on as if there had been none.
    policy.predict(spacecraft_row(policy.layout, (2.2, 0.9), time=0.1), memory)
    place, speed = first.at(np.array([0.1]))
    assert asked[1]["start"] == pytest.approx(np.concatenate([place[0], speed[0]]), abs=1e-12)


def test_every_fifth_plan_of_a_spacecraft_looks_for_another_way(asked):
    policy = DistributedTubeMpcPolicy(replan_every=1, kept_for=0.0)
    memory = None
    for step in range(12):
        row = spacecraft_row(policy.layout, (2.0, 1.0), time=0.1 * step)
        _, memory = policy.predict(row, memory)
    assert [call["fresh"] for call in asked] == [step % 5 == 0 for step in range(12)]


@pytest.mark.parametrize(("bound", "slow"), [(0.0, 0.04), (0.4, 0.08), (1.0, 0.14)])
def test_a_neighbour_is_taken_to_rest_below_the_noise_of_the_bound(asked, bound, slow):
    policy = DistributedTubeMpcPolicy(disturbance_bound=bound)
    speeds = np.array([0.9 * slow, 1.1 * slow])
    neighbours = [(1.0, 1.0, 0.0, -speeds[0]), (-1.0, 1.0, 0.0, -speeds[1])]
    row = spacecraft_row(policy.layout, (2.0, 0.0), neighbours)
    policy.predict(row)
    discs = asked[0]["discs"]
    order = np.argsort(-discs.centres[:, 0])  # the slow one stands further right
    assert discs.moving[order].tolist() == [False, True]
    assert discs.velocities[order, 1] == pytest.approx([0.0, -speeds[1]], rel=1e-6)


def test_two_agents_keep_root_two_of_the_margin_and_their_radii(asked):
    policy = DistributedTubeMpcPolicy(preset="released", disturbance_bound=0.4)
    row = spacecraft_row(policy.layout, (2.0, 0.0), [(0.0, 1.5, 0.0, 0.0)], [(-1.0, 0.3, 0.5)])
    policy.predict(row)
    discs = asked[0]["discs"]
    order = np.argsort(discs.centres[:, 1])  # the obstacle stands further down
    # Centres of agents keep a metre there, and to an obstacle an agent is a point.
    assert discs.touching[order] == pytest.approx([0.5, 1.0])
    assert discs.margins[order] == pytest.approx(policy.margin * np.array([1.0, np.sqrt(2.0)]))
    assert policy.margin > 0.0


def test_a_spacecraft_turns_back_to_the_heading_of_its_start():
    policy = DistributedTubeMpcPolicy()
    at = policy.layout.slices["heading"]
    torques = []
    for change in (-0.3, 0.0, 0.3):
        row = spacecraft_row(policy.layout, (2.0, 1.0))
        row[at] = np.cos(0.5 + change), np.sin(0.5 + change), change
        action, _ = policy.predict(row)
        torques.append(policy.settings.system.wrench(list(action.astype(float)))[2])
    assert torques[0] > 0.01
    assert torques[1] == pytest.approx(0.0, abs=1e-5)
    assert torques[2] < -0.01
