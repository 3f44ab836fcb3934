"""Policy (b): what it counts, what it keeps, and where it goes."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import lagros_envs  # noqa: F401  registers the environment
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.tasks.cartpole.planner import CartPolePlanner
from lagros_policies.tube_mpc import ReplanningTubeMpcPolicy, TubeMpcPolicy

SHORT = CartPoleSettings(time_limit=3.0, goal_range=1.0)


class Clock:
    """A clock that advances by `lag` whenever it is looked at."""

    def __init__(self):
        self.lag = 0.0
        self.now = 0.0

    def __call__(self):
        self.now += self.lag
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def build(metric, clock):
    def build(**settings):
        return TubeMpcPolicy(SHORT, metric, clock=clock, **settings)

    return build


@pytest.fixture
def spoil(monkeypatch):
    """Make every plan fail, or only those asked for while `spoil.on` is true."""

    class Switch:
        on = True

    sound = CartPolePlanner.plan

    def plan(self, *arguments, **settings):
        answer = sound(self, *arguments, **settings)
        if not Switch.on:
            return answer
        return replace(answer, solved=False, status="spoiled", controls=answer.controls + 1e3)

    monkeypatch.setattr(CartPolePlanner, "plan", plan)
    return Switch


def observe(step, state=(0.0, 0.4, 0.0, 0.0), goal=0.5, start=(0.0, 0.4, 0.0, 0.0)):
    return np.array([*state, goal, 0.0, 0.0, 0.0, *start, 0.1 * step], np.float32)


def fly(policy, seed=0, bound=0.0, options=None, goals=None, steps=SHORT.steps):
    """Fly an episode; return states, forces, what the policy remembers and the last info."""
    env = gym.make(
        "lagros/CartPole-v0", disturbance="uniform", disturbance_bound=bound, settings=SHORT
    )
    observation, info = env.reset(seed=seed, options=options or {})
    memory, states, forces = None, [env.unwrapped.state], []
    for step in range(steps):
        if goals is not None:
            observation[4] = goals(step)
        action, memory = policy.predict(observation, memory, np.array([step == 0]))
        forces.append(40.0 * float(action[0]))
        observation, _, terminated, _, info = env.step(action)
        states.append(env.unwrapped.state)
        if terminated:
            break
    env.close()
    return np.stack(states), np.array(forces), memory, info


def test_one_plan_serves_an_episode_whatever_the_disturbance(build):
    policy = build()
    states, _, memory, _ = fly(policy, bound=0.3)
    assert len(states) == 31
    assert policy.counters(memory) == {"plans": 1, "failed_plans": 0, "late_plans": 0}


def test_a_plan_at_every_step_only_confirms_the_first(build):
    asked = build(replan_every=1)
    states, forces, memory, _ = fly(asked, bound=0.3)
    assert asked.counters(memory) == {"plans": 30, "failed_plans": 0, "late_plans": 0}
    other_states, other_forces, *_ = fly(build(), bound=0.3)
    assert states == pytest.approx(other_states, abs=0.05)
    assert forces == pytest.approx(other_forces, abs=1.0)


def test_plans_come_every_so_many_steps(build):
    policy = build(replan_every=7)
    _, _, memory, _ = fly(policy)
    assert policy.counters(memory)["plans"] == 5


def test_without_disturbance_it_follows_its_plan_to_the_goal(build):
    options = {"initial_state": [0.0, 0.6, 0.0, 0.0], "goal": 0.8}
    plan = CartPolePlanner(SHORT).plan(np.array([0.0, 0.6, 0.0, 0.0]), np.array([0.8, 0, 0, 0]))
    for every in (1, 10, None):
        states, forces, _, info = fly(build(replan_every=every), options=options)
        assert np.abs(states - plan.states).max() < 0.02
        assert np.abs(forces - plan.controls[:, 0]).max() < 0.5
        assert states[-1] == pytest.approx([0.8, 0.0, 0.0, 0.0], abs=0.01)
        assert info["success"]


def test_under_disturbance_feedback_keeps_it_near_the_plan(build, oracle):
    options = {"initial_state": [0.0, 0.6, 0.0, 0.0], "goal": 0.8}
    plan = CartPolePlanner(SHORT).plan(np.array([0.0, 0.6, 0.0, 0.0]), np.array([0.8, 0, 0, 0]))
    for seed in range(3):
        states, forces, memory, info = fly(build(), seed, 0.3, options)
        assert not info["fallen"]
        assert np.linalg.norm(states - plan.states, axis=1).max() < 1.0
        # The plan is renewed from x_d and not from the measured state: it stays what it was.
        rest = memory[0].plan.states
        assert rest == pytest.approx(plan.states[-len(rest) :], abs=0.02)
        assert np.abs(forces - plan.controls[:, 0]).max() > 0.3


def test_goal_that_moves_is_followed_at_once(build):
    options = {"initial_state": [0.0, 0.3, 0.0, 0.0], "goal": -0.5}
    policy = build()
    states, _, memory, _ = fly(policy, options=options, goals=lambda k: -0.5 if k < 8 else 0.7)
    assert policy.counters(memory)["plans"] == 2
    assert states[-1] == pytest.approx([0.7, 0.0, 0.0, 0.0], abs=0.02)
    # Until then it went the other way.
    still, *_ = fly(policy, options=options)
    assert states[:9] == pytest.approx(still[:9])
    assert still[-1, 0] == pytest.approx(-0.5, abs=0.02)


def test_late_plan_is_counted_and_the_last_one_stays(build, clock):
    policy = build(deadline=0.1)
    _, memory = policy.predict(observe(0), None)
    first = memory[0].plan
    clock.lag = 0.11
    action, memory = policy.predict(observe(1, goal=-0.9), memory)
    assert policy.counters(memory) == {"plans": 2, "failed_plans": 0, "late_plans": 1}
    assert memory[0].plan is first
    clock.lag = 0.09
    other, memory = policy.predict(observe(1, goal=-0.9), memory)
    assert policy.counters(memory) == {"plans": 3, "failed_plans": 0, "late_plans": 1}
    assert memory[0].plan is not first
    assert memory[0].plan.states[-1, 0] == pytest.approx(-0.9, abs=1e-5)
    assert not np.allclose(action, other, atol=1e-3)


def test_first_plan_is_used_however_late(build, clock):
    clock.lag = 5.0
    policy = build()
    action, memory = policy.predict(observe(0), None)
    assert policy.counters(memory) == {"plans": 1, "failed_plans": 0, "late_plans": 1}
    assert memory[0].plan is not None
    assert abs(action[0]) > 0.01


def test_failed_plan_is_counted_and_the_last_one_stays(build, spoil):
    policy = build(replan_every=1)
    spoil.on = False
    _, memory = policy.predict(observe(0), None)
    first = memory[0].plan
    sound, _ = policy.predict(observe(1), [replace(memory[0])])
    spoil.on = True
    action, memory = policy.predict(observe(1), memory)
    assert policy.counters(memory) == {"plans": 2, "failed_plans": 1, "late_plans": 0}
    assert memory[0].plan is first
    assert action == pytest.approx(sound, abs=1e-3)


def test_failed_plan_for_a_new_goal_is_tried_again(build, spoil):
    policy = build()
    spoil.on = False
    _, memory = policy.predict(observe(0), None)
    spoil.on = True
    for step in (1, 2):
        _, memory = policy.predict(observe(step, goal=-0.9), memory)
    assert policy.counters(memory) == {"plans": 3, "failed_plans": 2, "late_plans": 0}
    spoil.on = False
    for step in (3, 4):
        _, memory = policy.predict(observe(step, goal=-0.9), memory)
    assert policy.counters(memory)["plans"] == 4
    assert memory[0].plan.states[-1, 0] == pytest.approx(-0.9, abs=1e-5)


def test_without_any_plan_there_is_no_force_until_one_succeeds(build, spoil):
    policy = build()
    action, memory = policy.predict(observe(0), None)
    assert np.array_equal(action, [0.0])
    action, memory = policy.predict(observe(1), memory)
    assert np.array_equal(action, [0.0])
    assert policy.counters(memory) == {"plans": 2, "failed_plans": 2, "late_plans": 0}
    spoil.on = False
    # Then it plans from where it is, not from where the episode began.
    here = (0.1, 0.5, 0.2, 0.3)
    action, memory = policy.predict(observe(2, state=here), memory)
    assert abs(action[0]) > 0.01
    assert memory[0].plan.states[0] == pytest.approx(here, abs=1e-6)
    assert memory[0].plan.horizon == 28


def test_episode_that_flies_on_failures_still_ends_at_the_goal(build, spoil):
    policy = build(replan_every=1)
    options = {"initial_state": [0.0, 0.6, 0.0, 0.0], "goal": 0.8}
    spoil.on = False
    calls = []

    def goals(step):
        spoil.on = step > 0
        calls.append(step)
        return 0.8

    states, _, memory, _ = fly(policy, options=options, goals=goals)
    assert policy.counters(memory) == {"plans": 30, "failed_plans": 29, "late_plans": 0}
    assert states[-1] == pytest.approx([0.8, 0.0, 0.0, 0.0], abs=0.02)


def test_only_the_row_that_starts_an_episode_forgets(build):
    policy = build()
    rows = np.stack([observe(0), observe(0, goal=0.2), observe(0, goal=-0.3)])
    _, memory = policy.predict(rows, None, np.ones(3, bool))
    plans = [entry.plan for entry in memory]
    again = np.stack([observe(1), observe(0, goal=0.2), observe(1, goal=-0.3)])
    _, memory = policy.predict(again, memory, np.array([False, True, False]))
    assert memory[0].plan is plans[0]
    assert memory[1].plan is not plans[1]
    assert memory[2].plan is plans[2]
    assert [entry.plans for entry in memory] == [1, 1, 1]
    assert policy.counters(memory)["plans"] == 3


def test_memory_of_other_episodes_is_refused(build):
    policy = build()
    _, memory = policy.predict(np.stack([observe(0), observe(0)]), None)
    with pytest.raises(ValueError, match="2 episodes"):
        policy.predict(observe(1), memory)


def test_past_the_time_limit_there_is_still_a_force(build):
    policy = build()
    _, memory = policy.predict(observe(0), None)
    for step in (29, 30, 34):
        action, memory = policy.predict(observe(step), memory)
        assert np.all(np.isfinite(action))


@pytest.mark.parametrize("bad", [{"replan_every": 0}, {"deadline": 0.0}])
def test_settings_out_of_range_are_refused(build, bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        build(**bad)


def test_plans_from_the_measured_state_go_with_the_body(build, metric):
    policy = ReplanningTubeMpcPolicy(SHORT, metric, deadline=1e9)
    _, memory = policy.predict(observe(0), None)
    for step, pushed in ((1, 0.3), (2, -0.2)):
        nominal = memory[0].plan.states[1]
        measured = np.float32(nominal + np.array([pushed, 0.0, 0.0, 0.0]))
        action, memory = policy.predict(observe(step, measured), memory)
        plan = memory[0].plan
        assert plan.states[0] == pytest.approx(measured, abs=1e-6)
        assert plan.states[-1] == pytest.approx([0.5, 0.0, 0.0, 0.0], abs=1e-6)
        # The error around the newest plan is zero, so that its own control is applied.
        assert 40.0 * action[0] == pytest.approx(plan.controls[0, 0], abs=1e-3)
    assert policy.counters(memory)["plans"] == 3


def test_near_the_time_limit_the_last_plan_from_the_measured_state_stays(metric):
    policy = ReplanningTubeMpcPolicy(SHORT, metric, 2, last_plan=1.0, deadline=1e9)
    _, _, memory, info = fly(policy, bound=0.1)
    # At 0, 0.2, ..., 2.0 s of 3 s.
    assert policy.counters(memory)["plans"] == 11
    assert info["inside_tube"]


def test_without_disturbance_it_does_not_matter_from_where_it_plans(build, metric):
    options = {"initial_state": [0.0, 0.5, 0.0, 0.0], "goal": 0.8}
    kept, *_ = fly(build(), options=options)
    anew, *_ = fly(ReplanningTubeMpcPolicy(SHORT, metric, 5, deadline=1e9), options=options)
    assert anew == pytest.approx(kept, abs=0.02)
