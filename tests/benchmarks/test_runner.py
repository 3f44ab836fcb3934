"""A run: paired episodes, failures that count, the same in one process and in several."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lagros_benchmarks.run.library import SetupError
from lagros_benchmarks.run.runner import Case, run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings, Condition
from lagros_benchmarks.run.single import SingleExperiment
from tests.benchmarks import fakes

UNIFORM = Condition("uniform", 0.75)


def settings_of(*policies, **changes):
    return BenchmarkSettings(**{"policies": policies, "episodes": 12, "chunk": 5, **changes})


def test_every_policy_meets_the_same_scenarios_and_disturbances():
    spies = []

    def make_spy(name, env, settings):
        spies.append(fakes.Spy(env))
        return spies[-1]

    toolbox = dataclasses.replace(fakes.EASY, make_policy=make_spy)
    settings = settings_of("one", "two", bounds=(0.2, 0.4), chunk=12)
    run_benchmark(settings, toolbox)
    # The first two were built for the check before the run; then one per case, whose first
    # episode is the warm-up.
    seen = [spy.seen[1:] for spy in spies[2:]]
    assert [len(episodes) for episodes in seen] == [12] * 4
    one_small, two_small, one_large, two_large = seen
    for a, b, c, d in zip(one_small, two_small, one_large, two_large, strict=True):
        for other in (b, c, d):
            np.testing.assert_array_equal(a[0], other[0])
            np.testing.assert_array_equal(a[1], other[1])
        np.testing.assert_array_equal(a[2], b[2])
        np.testing.assert_array_equal(c[2], d[2])
        # A larger bound is the same realisation, larger.
        np.testing.assert_allclose(2.0 * a[2], c[2], rtol=1e-12)
    assert len({episode[0][0] for episode in one_small}) == 12


def test_all_records_are_there_and_in_the_order_of_the_seeds():
    settings = settings_of("steady", "idle", disturbances=("uniform", "none"))
    run = run_benchmark(settings, fakes.TOOLBOX)
    assert list(run.episodes) == [
        Case("steady", UNIFORM),
        Case("idle", UNIFORM),
        Case("steady", Condition("none", 0.0)),
        Case("idle", Condition("none", 0.0)),
    ]
    for case, records in run.episodes.items():
        assert [record.seed for record in records] == settings.episode_seeds()
        assert {record.policy for record in records} == {case.policy}
        assert {(r.disturbance, r.bound) for r in records} == {case.condition}
    assert run.timing is run.episodes


def test_exceptions_are_failures_that_stay_in_the_list():
    run = run_benchmark(settings_of("raising", episodes=20), fakes.EASY)
    records = run.episodes[Case("raising", UNIFORM)]
    raised = [record for record in records if record.error is not None]
    assert len(records) == 20
    assert 0 < len(raised) < 20
    assert not any(record.success for record in raised)


def test_plans_are_made_once_per_scenario_and_failed_ones_say_why():
    calls = []

    class Counting(fakes.StraightPlanner):
        def plan(self, initial_state, goal, discs=None):
            calls.append(goal[0])
            return super().plan(initial_state, goal)

    toolbox = dataclasses.replace(fakes.TOOLBOX, make_planner=lambda task: Counting())
    settings = settings_of("steady", "idle", bounds=(0.1, 0.2), episodes=40)
    run = run_benchmark(settings, toolbox)
    assert len(calls) == 40
    for plan, goal in zip(run.plans, calls, strict=True):
        assert (plan.states is None) == (goal > 4.0)
        if goal > 4.5:
            assert plan.error == "RuntimeError: infeasible"
        elif goal > 4.0:
            assert plan.error == "not solved, defect 0.25"
    assert any(goal > 4.5 for goal in calls)
    for records in run.episodes.values():
        for record, goal in zip(records, calls, strict=True):
            assert (record.max_tracking_error is None) == (goal > 4.0)
            assert record.left_paper_tube or goal <= 4.0


def test_the_kind_worst_uses_metric_and_plan():
    run = run_benchmark(settings_of("steady", disturbances=("worst",), bounds=(0.3,)), fakes.EASY)
    records = run.episodes[Case("steady", Condition("worst", 0.3))]
    assert all(record.error is None for record in records)
    assert len({record.effort for record in records}) > 1


def test_parallel_equals_serial():
    policies = ("steady", "raising", "drawing")
    serial = run_benchmark(settings_of(*policies), fakes.TOOLBOX)
    parallel = run_benchmark(settings_of(*policies, jobs=2, timing_episodes=3), fakes.TOOLBOX)
    assert serial.episodes == parallel.episodes
    for case, records in serial.episodes.items():
        for one, two in zip(records, parallel.episodes[case], strict=True):
            np.testing.assert_array_equal(one.tracking_error, two.tracking_error)
    for one, two in zip(serial.plans, parallel.plans, strict=True):
        assert one.error == two.error
        np.testing.assert_array_equal(one.states, two.states)
    # The published step times come from the serial pass.
    assert [len(records) for records in parallel.timing.values()] == [3, 3, 3]
    for case, records in parallel.timing.items():
        assert [r.seed for r in records] == [r.seed for r in serial.episodes[case][:3]]
        assert [r.effort for r in records] == [r.effort for r in serial.episodes[case][:3]]


def test_chunks_make_no_difference():
    whole = run_benchmark(settings_of("drawing", chunk=100), fakes.TOOLBOX)
    split = run_benchmark(settings_of("drawing", chunk=1), fakes.TOOLBOX)
    assert whole.episodes == split.episodes


def test_a_policy_that_cannot_be_built_ends_the_run_before_it_begins():
    with pytest.raises(SetupError, match=r"policy 'absent' cannot be built.*no weights for absent"):
        run_benchmark(settings_of("steady", "absent"), fakes.TOOLBOX)


def test_settings_of_a_policy_reach_it():
    run = run_benchmark(
        settings_of("steady", policy_settings={"steady": {"scale": 0.0}}), fakes.EASY
    )
    assert all(record.fallen for record in run.episodes[Case("steady", UNIFORM)])


def test_progress_is_told_of_every_chunk():
    told = []
    SingleExperiment.set_up(settings_of("steady"), fakes.EASY).units(
        lambda *args: told.append(args)
    )
    assert told == [("planning", 0, 3), ("planning", 1, 3), ("planning", 2, 3), ("planning", 3, 3)]


def test_what_cannot_be_built_is_named_once():
    known = SetupError.building("policy 'a'", ValueError("policy 'a': no such\nclass"))
    assert str(known) == "policy 'a': no such class"
    other = SetupError.building("policy 'a'", TypeError("policy 'a': 3 arguments"))
    assert str(other) == "policy 'a' cannot be built: TypeError: policy 'a': 3 arguments"
