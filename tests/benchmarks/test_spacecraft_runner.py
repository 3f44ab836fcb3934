"""A spacecraft run: paired worlds, the filter beside its policy, times, one process or several."""

from __future__ import annotations

import dataclasses
import types

import numpy as np
import pytest

from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.run.library import SetupError
from lagros_benchmarks.run.runner import Case, fly_scene, run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings, Condition
from lagros_benchmarks.tasks.spacecraft.experiment import SpacecraftExperiment
from lagros_benchmarks.tasks.spacecraft.guaranteed import kept_apart
from lagros_benchmarks.tasks.spacecraft.timing import time_policy
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from tests.benchmarks import spacecraft_fakes as fakes


def settings_of(*policies, **changes):
    defaults = {
        "policies": policies,
        "episodes": 4,
        "chunk": 3,
        "bounds": (0.4,),
        "agents": (2,),
        "safety_filter": "none",
        "timing_episodes": 1,
    }
    return BenchmarkSettings.for_task("spacecraft", **{**defaults, **changes})


def case_of(policy, bound=0.4, filtered=False, agents=2):
    return Case(policy, Condition("uniform", bound), filtered, agents)


def test_every_policy_meets_the_same_worlds_and_disturbances():
    experiment = SpacecraftExperiment(settings_of("spring", bounds=(0.2, 0.4)), fakes.TOOLBOX, 0.1)
    seeds = experiment.settings.episode_seeds()
    seen = {}
    for case in experiment.settings.cases:
        env = experiment.environment(case, len(seeds))
        env.reset(seed=seeds)
        seen[case.condition.bound] = (
            env.states,
            env.world.goals.copy(),
            env.world.obstacle_centres.copy(),
            env.world._pushes.copy(),
        )
    small, large = seen[0.2], seen[0.4]
    for one, two in zip(small[:3], large[:3], strict=True):
        np.testing.assert_array_equal(one, two)
    # A larger bound is the same realisation, larger.
    np.testing.assert_allclose(2.0 * small[3], large[3], rtol=1e-12)
    # And a world alone is the one of the batch.
    env = experiment.environment(case_of("spring"), 1)
    env.reset(seed=seeds[2:3])
    np.testing.assert_array_equal(env.states[0], large[0][2])
    np.testing.assert_array_equal(env.world._pushes[0], large[3][2])


def test_policies_of_a_run_start_from_the_same_worlds(monkeypatch):
    seen = []
    reset = SpacecraftVectorEnv.reset

    def spy(self, *, seed=None, options=None):
        answer = reset(self, seed=seed, options=options)
        seen.append((tuple(seed), self.states.copy()))
        return answer

    settings = settings_of("spring", "idle", safety_filter="both", chunk=4)
    monkeypatch.setattr(SpacecraftVectorEnv, "reset", spy)
    run = run_benchmark(settings, fakes.TOOLBOX)
    flown = [states for seeds, states in seen if seeds == tuple(settings.episode_seeds())]
    assert len(flown) == 4
    for states in flown[1:]:
        np.testing.assert_array_equal(states, flown[0])
    for worlds in run.episodes.values():
        assert [world.seed for world in worlds] == settings.episode_seeds()


def test_all_cases_are_there_and_in_order():
    settings = settings_of("spring", "idle", bounds=(0.1, 0.2), safety_filter="both", episodes=2)
    run = run_benchmark(settings, fakes.TOOLBOX)
    assert list(run.episodes) == [
        case_of(policy, bound, filtered)
        for bound in (0.1, 0.2)
        for filtered in (False, True)
        for policy in ("spring", "idle")
    ]
    assert all(len(worlds) == 2 for worlds in run.episodes.values())
    # The filter of the fakes halves every thrust and counts the agents.
    bare, filtered = case_of("idle", 0.1), case_of("spring", 0.1, True)
    assert run.counters[bare] == {}
    assert run.counters[filtered] == {"interventions": 2 * 2 * 450}


@pytest.mark.parametrize(("choice", "flags"), [("none", [False]), ("all", [True])])
def test_the_filter_can_be_left_out_or_worn_by_all(choice, flags):
    run = run_benchmark(settings_of("idle", safety_filter=choice, episodes=1), fakes.TOOLBOX)
    assert [case.safety_filter for case in run.episodes] == flags


def test_several_numbers_of_agents():
    settings = settings_of("spring", agents=(1, 3), episodes=2, preset="swarm")
    run = run_benchmark(settings, fakes.TOOLBOX)
    assert [case.agents for case in run.episodes] == [1, 3]
    for case, worlds in run.episodes.items():
        assert all(len(world.agents) == case.agents for world in worlds)


def test_parallel_equals_serial():
    policies = ("raising", "drawing", "joint")
    options = {"episodes": 3, "chunk": 2}
    serial = run_benchmark(settings_of(*policies, **options), fakes.TOOLBOX)
    parallel = run_benchmark(settings_of(*policies, **options, jobs=2), fakes.TOOLBOX)
    assert serial.episodes == parallel.episodes
    assert serial.counters == parallel.counters
    raised = [world.error for world in serial.episodes[case_of("raising")]]
    assert any(error is not None for error in raised)


def test_a_policy_is_built_with_its_settings_for_the_bound_of_its_case():
    told = []

    def make(name, env, settings):
        told.append((name, (env.unwrapped.disturbance.bound, settings)))
        return fakes.SpringPolicy()

    toolbox = dataclasses.replace(fakes.TOOLBOX, make_policy=make)
    settings = settings_of(
        "learned",
        "tube-mpc",
        "centralized",
        episodes=1,
        bounds=(0.7,),
        policy_settings={"learned": {"weights": "w"}, "tube-mpc": {"horizon": 3.0}},
    )
    run_benchmark(settings, toolbox)
    assert dict(told) == {
        "learned": (0.7, {"weights": "w"}),
        "tube-mpc": (0.7, {"horizon": 3.0}),
        "centralized": (0.7, {}),
    }


def test_what_cannot_be_built_ends_the_run_before_it_begins():
    with pytest.raises(SetupError, match=r"policy 'absent' cannot be built.*no weights for absent"):
        run_benchmark(settings_of("spring", "absent"), fakes.TOOLBOX)

    def broken(policy, env, bound):
        raise RuntimeError("no filter")

    toolbox = dataclasses.replace(fakes.TOOLBOX, make_filter=broken)
    with pytest.raises(SetupError, match=r"'spring' with the safety filter cannot be built"):
        run_benchmark(settings_of("spring", safety_filter="both"), toolbox)
    with pytest.raises(SetupError, match=r"40 agents cannot be built.*no scenario with 40 agents"):
        run_benchmark(settings_of("spring", agents=(40,)), fakes.TOOLBOX)


def environment(agents):
    return SpacecraftVectorEnv(agents, agents, "open", "uniform", 0.2, autoreset_mode="disabled")


def test_one_agent_is_timed_alone_and_all_together():
    policy = fakes.SpringPolicy()
    timing = time_policy(environment(3), policy, [1, 2])
    assert policy.calls[:4] == [3, 1, 3, 1]
    assert len(timing.steps) == len(timing.batches) == 2 * 450
    assert timing.agents == 3
    assert timing.plans.size == 0
    assert np.all(timing.steps > 0.0)


def test_the_first_call_for_all_agents_is_their_plan():
    timing = time_policy(environment(2), fakes.JointPolicy(agents=2), [1, 2])
    assert timing.plans.size == 2
    assert timing.steps.size == 2 * 449
    assert timing.batches.size == 2 * 450
    np.testing.assert_array_equal(timing.plans, timing.batches[[0, 450]])


def test_more_plans_are_timed_than_worlds():
    settings = settings_of("joint", "spring", episodes=7, timing_episodes=2)
    run = run_benchmark(settings, fakes.TOOLBOX)
    joint, spring = (run.timing[case_of(name)][0] for name in settings.policies)
    assert joint.plans.size == 7
    assert joint.steps.size < 2 * 450
    assert spring.plans.size == 0


def test_what_raises_ends_the_times_of_its_world():
    class Late(fakes.SpringPolicy):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            if observation[0][8] > 0.95:
                raise ArithmeticError
            return super().predict(observation, state, episode_start, deterministic)

    timing = time_policy(environment(2), Late(), [1, 2])
    assert len(timing.batches) == len(timing.steps) == 2 * 10


def test_a_scene_is_one_world_of_the_run():
    policies = ("spring", "idle", "joint")
    settings = settings_of(*policies, bounds=(0.1, 0.2, 0.3), safety_filter="both")
    scene = fly_scene(settings, 2, fakes.TOOLBOX)
    run = run_benchmark(dataclasses.replace(settings, bounds=(0.2,)), fakes.TOOLBOX)
    assert [panel.case for panel in scene.panels] == [case_of(name, 0.2) for name in policies]
    for panel in scene.panels:
        record = run.episodes[panel.case][2]
        assert panel.world.seed == record.seed
        assert [a.success for a in panel.world.agents] == [a.success for a in record.agents]
        np.testing.assert_allclose(panel.path[0], scene.scenario.starts)
        ends = np.linalg.norm(panel.path[-1] - scene.scenario.goals, axis=-1)
        if len(panel.path) == 451:
            np.testing.assert_allclose(ends, [a.goal_distance for a in record.agents], atol=1e-4)
    with pytest.raises(ValueError, match="0 to 3"):
        fly_scene(settings, 4, fakes.TOOLBOX)


def test_the_filter_with_a_proof_flies_by_name():
    settings = settings_of("spring", episodes=2, safety_filter="proved")
    run = run_benchmark(settings, fakes.TOOLBOX)
    (case,) = settings.cases
    assert case.safety_filter
    assert run.counters[case]["infeasible"] == 0
    assert not any(agent.collided for world in run.episodes[case] for agent in world.agents)
    (row,) = summarise(run)
    assert row["proved_filter"]
    assert (row["guaranteed_rate"], row["guaranteed_arriving_rate"]) == (1.0, 0.0)
    assert row["guarantees_contradicted"] == 0


def test_nothing_is_proved_of_worlds_that_begin_outside_of_what_the_filter_keeps():
    counts = np.array([[5, 1, 0], [5, 0, 0], [5, 0, 0], [5, 2, 1]])
    env = types.SimpleNamespace(num_worlds=2)
    loop = types.SimpleNamespace(memory=types.SimpleNamespace(counts=counts), env=env)
    assert [one["guaranteed"] for one in kept_apart(loop)] == [True, False]
