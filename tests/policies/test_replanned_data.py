"""The data of (a): plans from where flights come to, and what the planner does there."""

from dataclasses import fields, replace

import numpy as np
import pytest

from lagros_envs.tasks.cartpole import task
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.contraction import BoxRegion, CvStemSettings, design_on_region
from lagros_policies.learning.dataset import ExpertDataSettings
from lagros_policies.learning.networks import Mlp
from lagros_policies.learning.replanned import generate_replanned
from lagros_policies.planning.planner import planner_of
from lagros_policies.tasks.cartpole.planner import CartPolePlanner
from tests.policies.toys import Slide

SETTINGS = ExpertDataSettings(plans=4, samples=80, shards=2, disturbance_bound=0.8, seed=5)


@pytest.fixture(scope="module")
def data(metric, tmp_path_factory):
    return generate_replanned(tmp_path_factory.mktemp("data"), metric, SETTINGS)


def steps_of(data):
    return np.rint(data.observation[:, task.TIME] / 0.1).astype(int)


def same(one, other):
    return all(
        np.array_equal(getattr(one, item.name), getattr(other, item.name)) for item in fields(one)
    )


def test_a_label_is_the_control_of_a_plan_from_the_state(data):
    planner = CartPolePlanner()
    goal, state = data.observation[:, task.GOAL], data.observation[:, task.STATE]
    early = np.flatnonzero(steps_of(data) <= 80)
    assert len(early) > 40
    for one in early[::4]:
        # The rest of a plan of least effort is the plan from its state: planned anew, from nothing.
        plan = planner.plan(state[one], goal[one], int(steps_of(data)[one]))
        assert plan.solved
        assert data.control[one] == pytest.approx(plan.controls[0], abs=0.05)


def test_states_lie_off_the_plan_of_their_episode(data):
    planner, far = CartPolePlanner(), []
    for episode in np.unique(data.plan):
        mine = np.flatnonzero(data.plan == episode)
        row = data.observation[mine[0]]
        plan = planner.plan(row[task.INITIAL_STATE], row[task.GOAL])
        nominal = plan.states[steps_of(data)[mine]]
        far.extend(np.linalg.norm(data.observation[mine][:, task.STATE] - nominal, axis=1))
    assert np.median(far) > 0.02


def test_every_sample_that_was_asked_for_is_there(data):
    assert data.observation.shape == (80, 13)
    assert data.control.shape == (80, 1)
    assert np.array_equal(np.unique(data.plan // 2), [0, 1])
    assert data.asked > data.failed
    # Ten labels of a plan at most.
    assert 10 * (data.asked - data.failed) >= 80


def test_the_same_settings_give_the_same_data_in_any_process(metric, data, tmp_path):
    assert same(generate_replanned(tmp_path, metric, SETTINGS, jobs=2), data)
    (tmp_path / "shard_0001.npz").unlink()
    assert same(generate_replanned(tmp_path, metric, SETTINGS), data)


def test_a_network_is_asked_where_it_comes_to(metric, tmp_path):
    still = Mlp([np.zeros((7, 1))], [np.zeros(1)])
    few = replace(SETTINGS, plans=2, samples=40, shards=1, disturbance_bound=0.0)
    found = generate_replanned(tmp_path, metric, few, network=still)
    # Without a force the pole of most episodes falls within a second, and what it did before is
    # planned from; the other labels lie on the plans from there.
    steps, state = steps_of(found), found.observation[:, task.STATE]
    first = np.concatenate([[True], np.diff(steps) <= 0])
    assert steps[first].max() <= 30
    lean = np.abs(state[first, 1]) - np.abs(found.observation[first, task.INITIAL_STATE][:, 1])
    assert np.all(lean >= -1e-9)


def test_a_network_that_is_lost_at_once_is_an_error(metric, tmp_path, monkeypatch):
    def fail(self, *arguments, **settings):
        return replace(plan(self, *arguments, **settings), solved=False)

    plan = CartPolePlanner.plan
    monkeypatch.setattr(CartPolePlanner, "plan", fail)
    still = Mlp([np.zeros((7, 1))], [np.zeros(1)])
    with pytest.raises(ValueError, match="only 0 of"):
        generate_replanned(tmp_path, metric, SETTINGS, network=still)


def test_discs_are_planned_around(tmp_path):
    slide = Slide()
    region = BoxRegion((-9.0,) * 4, (9.0,) * 4, (0.5,) * 4, (-3.0,) * 2, (3.0,) * 2)
    metric = design_on_region(
        slide.system, region, CvStemSettings(0.5, 0, 0.05, 0.1, (1.0,) * 4), seed=1
    )
    few = ExpertDataSettings(plans=2, samples=30, shards=1, disturbance_bound=0.3)
    data = generate_replanned(tmp_path, metric, few, slide)
    layout, planner = slide.layout, planner_of(slide)
    step = np.rint(data.observation[:, layout.time] / slide.control_period).astype(int).ravel()
    compared = 0
    for row, control, begin in zip(data.observation, data.control, step, strict=True):
        if begin > 30:
            continue
        discs = layout.discs_of(row)
        gaps = np.linalg.norm(row[[0, 1]] - discs[:, :2], axis=1) - discs[:, 2]
        assert np.all(gaps[discs[:, 2] > 0.0] > slide.body_radius)
        plan = planner.plan(row[layout.state], row[layout.goal], begin, discs=discs)
        if plan.solved:
            assert control == pytest.approx(plan.controls[0], abs=0.3)
            compared += 1
    assert compared > 10


def test_the_task_may_be_left_out(metric, tmp_path):
    few = replace(SETTINGS, plans=1, samples=5, shards=1)
    usual = generate_replanned(tmp_path / "usual", metric, few)
    assert same(usual, generate_replanned(tmp_path / "given", metric, few, CartPoleSettings()))
