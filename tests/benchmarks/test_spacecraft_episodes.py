"""Worlds of spacecraft in a batch: what is written down, above all when something goes wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lagros_benchmarks.tasks.spacecraft.episodes import (
    Trace,
    WorldsLoop,
    fly,
    fly_chunk,
    plans_of,
)
from lagros_envs import spacecraft_v0
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from tests.benchmarks import spacecraft_fakes as fakes

SEEDS = [3, 14, 15, 92, 65]
AGENTS, BOUND = 3, 0.3


def worlds(count, agents=AGENTS, bound=BOUND, preset="paper"):
    return SpacecraftVectorEnv(
        count * agents, agents, preset, "uniform", bound, autoreset_mode="disabled"
    )


def by_hand(policy, seed, agents=AGENTS):
    """The episode again in the single environment, measured here from its states."""
    env = spacecraft_v0.parallel_env(agents, disturbance="uniform", disturbance_bound=BOUND)
    observations, infos = env.reset(seed=seed)
    goals = env.scenario.goals
    states, efforts, collided = [env.states], [], [np.zeros(agents, bool)]
    memory = None
    while env.agents:
        names = env.agents
        rows = np.stack([observations[name] for name in names])
        actions, memory = policy.predict(rows, memory, np.full(agents, memory is None))
        observations, _, _, _, infos = env.step(dict(zip(names, actions, strict=True)))
        states.append(env.states)
        efforts.append(np.sum(np.maximum(actions, 0.0).astype(float) ** 2, axis=-1) * 0.1)
        collided.append(np.array([infos[name]["collided"] for name in env.possible_agents]))
    near = np.linalg.norm(np.array(states)[..., :2] - goals, axis=-1) <= 0.2
    return np.array(efforts), near & ~np.array(collided), np.array(collided)


@pytest.fixture(scope="module")
def flight():
    return fly_chunk(worlds, fakes.SpringPolicy(), SEEDS)


def test_the_records_are_those_computed_by_hand(flight):
    seen = set()
    for world in flight.worlds:
        efforts, arrived, collided = by_hand(fakes.SpringPolicy(), world.seed)
        for agent, record in enumerate(world.agents):
            success = bool(arrived[:, agent].any())
            assert record.success == success
            assert record.collided == bool(collided[-1, agent])
            assert record.strict_success == bool(arrived[-1, agent])
            until = int(np.argmax(arrived[:, agent])) if success else len(efforts)
            assert record.effort == pytest.approx(efforts[:until, agent].sum(), rel=1e-4)
            assert record.effort_total == pytest.approx(efforts[:, agent].sum(), rel=1e-4)
            if success:
                assert record.success_time == pytest.approx(0.1 * until)
            if record.collided:
                assert record.collision_time == pytest.approx(0.1 * np.argmax(collided[:, agent]))
            assert math.isfinite(record.goal_distance)
            seen.add((record.success, record.collided))
    # The worlds hold agents that arrive, that hit something first, and that hit something later.
    assert {(True, False), (False, True)} <= seen


def test_a_batch_is_its_worlds_one_by_one(flight):
    for seed, world in zip(SEEDS, flight.worlds, strict=True):
        alone = fly(WorldsLoop(worlds(1), fakes.SpringPolicy()), [seed])
        for one, two in zip(world.agents, alone.worlds[0].agents, strict=True):
            assert (one.success, one.collided, one.success_time) == (
                two.success,
                two.collided,
                two.success_time,
            )
            assert one.effort == pytest.approx(two.effort, rel=1e-4)


def test_a_world_whose_agents_have_all_collided_is_over():
    """What the batch does to it while the others go on is not counted."""
    found = 0
    for seed in range(8):
        efforts, _, collided = by_hand(fakes.SpringPolicy(), seed, 2)
        if not collided[-1].all() or len(efforts) >= fakes.STEPS:
            continue
        found += 1
        others = [seed, *SEEDS[:2]]
        record = fly(WorldsLoop(worlds(3, 2), fakes.SpringPolicy()), others).worlds[0]
        for agent in range(2):
            total = efforts[:, agent].sum()
            assert record.agents[agent].effort_total == pytest.approx(total, rel=1e-4)
    assert found > 0


def test_counters_are_those_of_all_worlds(flight):
    assert flight.counters == {"decisions": len(SEEDS) * AGENTS * 450, "failed_plans": 0}


def test_an_exception_is_the_failure_of_its_own_world_alone():
    calm = fly_chunk(worlds, fakes.SpringPolicy(), SEEDS)
    flight = fly_chunk(worlds, fakes.RaisingPolicy(), SEEDS)
    raised = [world.error is not None for world in flight.worlds]
    assert any(raised)
    assert not all(raised)
    for world, other in zip(flight.worlds, calm.worlds, strict=True):
        assert world.seed == other.seed
        assert len(world.agents) == AGENTS
        if world.error is None:
            for one, two in zip(world.agents, other.agents, strict=True):
                assert one.success == two.success
                assert one.effort == pytest.approx(two.effort, rel=1e-4)
            continue
        assert world.error == "ArithmeticError: no solution at all [bold]here[/bold]"
        for one, two in zip(world.agents, other.agents, strict=True):
            # It was raised before 20.05 s, and is a failure also of who had arrived by then.
            assert (one.success, one.success_time) == (False, None)
            assert (one.strict_success, one.paper_success) == (False, False)
            assert one.collided <= two.collided
            assert 0.0 < one.effort_total <= two.effort_total * (1 + 1e-4)


class BadAction(fakes.IdlePolicy):
    """Answers with something that is no action."""

    answer = np.full((1, 8), np.nan)

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.repeat(self.answer, len(observation), axis=0), None


@pytest.mark.parametrize("answer", [np.full((1, 8), np.nan), np.zeros((1, 7))])
def test_a_bad_action_is_an_exception_of_the_policy(answer):
    policy = BadAction()
    policy.answer = answer
    flight = fly_chunk(worlds, policy, SEEDS[:2])
    assert len(flight.worlds) == 2
    for world in flight.worlds:
        assert world.error is not None
        assert "predict " in world.error
        assert not any(agent.success or agent.strict_success for agent in world.agents)


def test_a_policy_that_draws_has_the_stream_of_each_episode():
    flight = fly_chunk(worlds, fakes.DrawingPolicy(), SEEDS[:3])
    alone = fly_chunk(worlds, fakes.DrawingPolicy(), SEEDS[2:3])
    assert flight.worlds[2] == alone.worlds[0]
    assert flight.worlds[0].agents[0].effort != flight.worlds[1].agents[0].effort


def test_a_filter_flies_in_one_batch_unless_its_policy_draws():
    batches = []

    def counted(count):
        batches.append(count)
        return worlds(count)

    fly_chunk(counted, fakes.HalfFilter(fakes.SpringPolicy()), SEEDS)
    assert batches == [5]
    filtered = fly_chunk(counted, fakes.HalfFilter(fakes.DrawingPolicy()), SEEDS[:2])
    assert batches == [5, 1]
    alone = fly_chunk(counted, fakes.HalfFilter(fakes.DrawingPolicy()), SEEDS[1:2])
    assert filtered.worlds[1] == alone.worlds[0]


def test_the_error_to_the_plan_is_that_of_the_states():
    agents, seeds = 2, [1, 2, 3, 4, 5, 6]
    policy = fakes.JointPolicy(agents=agents)
    trace = Trace()
    loop = WorldsLoop(worlds(len(seeds), agents), policy)
    flight = fly(loop, seeds, 0.1, trace)
    path = np.array(trace.path)
    planned = [bool(path[0, w, 0, 0] > 1.0) for w in range(len(seeds))]
    assert [world.planned for world in flight.worlds] == planned
    assert any(planned)
    assert not all(planned)
    for index, world in enumerate(flight.worlds):
        # A world is over when all have collided.
        times = [record.collision_time for record in world.agents]
        end = len(path) if None in times else round(10 * max(times)) + 1
        nominal = loop.memory[index].nominal[:end, :, :2]
        error = np.linalg.norm(path[:end, index] - nominal, axis=-1).max(axis=0)
        for agent, record in enumerate(world.agents):
            assert record.max_position_error == pytest.approx(error[agent], rel=1e-6)
            left = not planned[index] or error[agent] > 0.1
            assert record.left_certified_tube == left
            # The paper's tube begins with no width, and every step brings a disturbance.
            assert record.left_paper_tube is True


def test_without_a_plan_there_is_no_tube(flight):
    for world in flight.worlds:
        assert world.planned is None
        assert all(agent.left_paper_tube is None for agent in world.agents)
        assert all(agent.max_position_error is None for agent in world.agents)


def test_the_plans_are_found_behind_a_filter():
    joint = fakes.JointPolicy(agents=2)
    bare = fly(WorldsLoop(worlds(2, 2), joint), [1, 2], 0.1)
    filtered = fly(WorldsLoop(worlds(2, 2), fakes.HalfFilter(joint)), [1, 2], 0.1)
    assert [w.planned for w in filtered.worlds] == [w.planned for w in bare.worlds]
    assert filtered.counters == {"interventions": 2 * 2 * 450}
    assert plans_of(None) is None
    assert plans_of([0, 0]) is None
    assert plans_of(([], 3)) is None


def test_a_scenario_that_cannot_be_drawn_is_the_failure_of_its_world():
    class Broken(SpacecraftVectorEnv):
        def reset(self, *, seed=None, options=None):
            if 14 in seed:
                raise ValueError("no scenario")
            return super().reset(seed=seed, options=options)

    def broken(count):
        return Broken(count * 2, 2, "paper", "uniform", BOUND, autoreset_mode="disabled")

    flight = fly_chunk(broken, fakes.IdlePolicy(), [3, 14])
    assert [world.error for world in flight.worlds] == [None, "ValueError: no scenario"]
    assert [len(world.agents) for world in flight.worlds] == [2, 2]
