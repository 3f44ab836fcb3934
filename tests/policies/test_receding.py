"""Receding goals against their formula, the rule against deadlocks against scenes and a loop."""

import cmath
import math

import numpy as np
import pytest

from lagros_envs.tasks.spacecraft.scenarios import Preset, Scenario
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.export import check, load_source
from lagros_policies.export.c99 import c_file
from lagros_policies.export.onnx import onnx_file
from lagros_policies.tasks.spacecraft.network_policy import SpacecraftLagrosPolicy
from lagros_policies.tasks.spacecraft.receding import Receding, Waiting
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter

H = 0.1


def scene(starts, goals, obstacles=()):
    discs = np.array(obstacles, float).reshape(-1, 2)
    return Scenario(starts, np.zeros(len(starts)), goals, discs, np.full(len(discs), 0.5))


def head_on():
    return scene([[0, 0], [5, 0]], [[5, 0], [0, 0]])


def corridor():
    walls = [[x, y] for x in np.arange(0, 6.1, 0.75) for y in (1.45, -1.45)]
    ends = [[-1.5, 0], [7.5, 0], [-2.5, 0], [8.5, 0]]
    return scene(ends, [ends[1], ends[0], ends[3], ends[2]], walls)


def ring():
    angle = 2.0 * np.pi * np.arange(16) / 16
    rim = 3.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return scene(rim, -rim)


def parked_crowd():
    cup = [[2.0, y] for y in np.arange(-1.2, 1.21, 0.6)]
    cup += [[x, y] for x in (1.4, 0.8) for y in (1.2, -1.2)]
    return scene([[-1.0, 0.0], *cup], [[5.0, 0.0], *cup])


def pocket():
    walls = [[1.5, y] for y in (-1.2, -0.4, 0.4, 1.2)]
    walls += [[x, y] for x in (0.7, -0.1) for y in (1.2, -1.2)]
    return scene([[-2.0, 0.0]], [[4.5, 0.0]], walls)


SCENES = {one.__name__: one for one in (head_on, corridor, ring, parked_crowd, pocket)}


def flown(scenario, bound, receding, seconds=120.0, worlds=2):
    """Fly a scene with the filter; return the last info and the policy's counters."""
    agents = scenario.num_agents
    preset = Preset(agents=agents, arena=10.0, obstacle_count=(0, len(scenario.obstacles)))
    env = SpacecraftVectorEnv(
        *(worlds * agents, agents, preset, "uniform", bound),
        settings={"time_limit": seconds},
        autoreset_mode="disabled",
    )
    policy = SafetyFilter(
        SpacecraftLagrosPolicy(env.settings, env.preset, receding=receding),
        env.settings,
        env.preset,
        disturbance_bound=bound,
    )
    observation, info = env.reset(
        seed=list(range(worlds)), options={"scenarios": [scenario] * worlds}
    )
    state = None
    for _ in range(env.settings.steps):
        action, state = policy.predict(observation, state)
        observation, _, _, _, info = env.step(action)
    return info, policy.counters(state)


@pytest.mark.parametrize("bound", [1e-9, 0.4])
@pytest.mark.parametrize("name", SCENES)
def test_deadlock_scenes_are_solved(name, bound):
    info, _ = flown(SCENES[name](), bound, True)
    assert info["success"].all()
    assert not info["collided"].any()


@pytest.mark.parametrize(("name", "bound"), [("pocket", 0.4), ("pocket", 1e-9)])
def test_it_is_the_rule_that_solves_them(name, bound):
    patient, none = flown(SCENES[name](), bound, {"patience": 1e6})
    assert none["detours"] == 0
    assert not patient["success"].all()
    _, counted = flown(SCENES[name](), bound, True)
    assert counted["detours"] > 0
    # The longest last 20 s; an arrival ends one early.
    assert 0 < counted["detour_steps"] <= 200 * counted["detours"]


@pytest.mark.parametrize("kind", [complex, np.complex128])
def test_the_goal_shown_is_at_most_the_reach_ahead(kind):
    rng = np.random.default_rng(0)
    receding = Receding(reach=1.5, pace=0.25)
    for length in (0.0, 1e-12, 0.7, 1.5, 1.5000001, 3.0, 1e4):
        goal = kind(cmath.rect(length, rng.uniform(-math.pi, math.pi)))
        shown = receding.shown(goal)
        assert abs(shown) == pytest.approx(min(length, 1.5), abs=1e-12)
        assert receding.time_to_go(abs(shown), 0.25) == pytest.approx(max(4.0 * abs(shown), 2.0))
        if length:
            assert cmath.phase(shown) == pytest.approx(cmath.phase(goal))
    together = rng.normal(size=20) + 1j * rng.normal(size=20)
    alone = [receding.shown(complex(goal)) for goal in together]
    np.testing.assert_allclose(receding.shown(together), alone)


def test_a_pace_is_that_at_which_the_way_takes_its_share_of_the_time_left():
    receding = Receding(pace=0.3, fastest=0.6, share=0.5)
    for way, left, pace in (
        *((4.0, 20.0, 0.4), (2.0, 20.0, 0.3), (9.0, 20.0, 0.6), (9.0, 60.0, 0.3)),
        *((1.0, 0.0, 0.6), (1.0, -10.0, 0.6), (0.0, 10.0, 0.3), (0.0, -10.0, 0.3)),
    ):
        assert receding.pace_of(way, left) == pytest.approx(pace)
        np.testing.assert_allclose(receding.pace_of(np.array([way]), np.array([left])), pace)
    with pytest.raises(ValueError, match=r"pace=0\.8.*at most"):
        Receding(pace=0.8)


def one_agent(receding, distances, arrived):
    """The rule in words, one agent after the other: by which angle its goal is turned, when."""
    angles, closest, idle, away, detours = [], math.inf, 0, 0, 0
    patience = round(receding.patience / H)
    for distance in distances:
        if away:
            away = 0 if distance <= arrived else away - 1
            idle, closest = 0, distance
        elif distance <= arrived:
            idle = 0
            closest = distance if distance <= closest - receding.progress else closest
        elif distance <= closest - receding.progress:
            idle, closest = 0, distance
        else:
            idle += 1
            if idle == patience:
                times = (1, 1, 2, 2, 3, 3, 4)[min(detours, 6)]
                away = round(times * receding.detour / H)
                detours, idle, closest = detours + 1, 0, distance
        angle = receding.angle + (0, 0, 0, 1, 1, 2)[min(detours, 5)] * receding.wider
        angles.append(angle * (1 if detours % 4 in (1, 2) else -1) if away else 0.0)
    return angles, detours


def test_the_rule_is_what_its_words_say():
    rng = np.random.default_rng(3)
    receding = Receding(progress=0.1, patience=0.5, angle=0.9, wider=0.3, detour=0.8)
    walks = np.abs(np.cumsum(rng.normal(-0.01, 0.08, (400, 30)), axis=0) + rng.uniform(0, 3, 30))
    direction = np.exp(1j * rng.uniform(-np.pi, np.pi, walks.shape))
    memory, turns = Waiting.begun(30), []
    for distance, unit in zip(walks, direction, strict=True):
        turned, memory = receding.turned(distance * unit, memory, 0.2, H)
        np.testing.assert_allclose(np.abs(turned), distance)
        turns.append(np.angle(turned / (distance * unit)))
    for agent in range(30):
        angles, detours = one_agent(receding, walks[:, agent], 0.2)
        np.testing.assert_allclose(np.array(turns)[:, agent], angles, atol=1e-9)
        assert memory.detours[agent] == detours
        assert memory.steps[agent] == np.count_nonzero(angles)
    assert memory.detours.sum() > 30


def test_agents_remember_for_themselves_and_begin_anew():
    env = SpacecraftVectorEnv(24, 12, "swarm", "uniform", 0.4, autoreset_mode="disabled")
    policy = SpacecraftLagrosPolicy(env.settings, env.preset, receding={"patience": 0.3})
    observation, _ = env.reset(seed=[1, 2])
    together = one = None
    for _ in range(30):
        action, together = policy.predict(observation, together)
        alone, one = policy.predict(observation[5], one)
        np.testing.assert_allclose(action[5], alone, rtol=1e-4, atol=1e-5)
        observation = env.step(action)[0]
    assert policy.counters(together)["detours"] > 0
    fresh, _ = policy.predict(observation)
    again, state = policy.predict(observation, together, np.ones(24, bool))
    np.testing.assert_array_equal(again, fresh)
    assert policy.counters(state) == {"detours": 0, "detour_steps": 0}
    with pytest.raises(ValueError, match="these 24 rows"):
        policy.predict(observation, one)


def test_worlds_no_larger_than_those_learned_are_shown_as_they_are():
    for preset, agents, expected in (
        ("paper", 6, False),
        ("paper", 8, False),
        ("swarm", 8, False),
        ("swarm", 32, True),
        ("crossing", 9, True),
    ):
        policy = SpacecraftLagrosPolicy(preset=preset, num_agents=agents, receding=None)
        assert (policy.receding is not None) == expected
    assert SpacecraftLagrosPolicy(receding={"pace": 0.2}).receding == Receding(pace=0.2)
    assert SpacecraftLagrosPolicy(preset="swarm", num_agents=32, receding=False).receding is None


@pytest.mark.parametrize("given", [{"reach": 0.0}, {"speed": 1.0}, {"angle": 4.0}, "yes", 3.0])
def test_what_is_no_receding_goal_is_refused(given):
    with pytest.raises(ValueError, match=r"receding|reach|angle"):
        SpacecraftLagrosPolicy(receding=given)


@pytest.mark.parametrize("kind", ["c", "onnx"])
def test_c_and_onnx_show_the_same_goal(kind):
    source = load_source("lagros-spacecraft", preset="swarm", num_agents=20)
    assert source.policy.receding is not None
    rows = source.examples(300, seed=2)
    rows[::2, :2] *= np.float32(4.0)
    if kind == "onnx":
        pytest.importorskip("onnxruntime")
        answer = check.onnx_answer(onnx_file(source), rows)
    elif check.compiler() is None:
        pytest.skip("no C compiler")
    else:
        text = c_file(source)
        assert "no rule against deadlocks" in " ".join(text.replace("*", " ").split())
        with check.CompiledPolicy(text, source) as compiled:
            answer = compiled.answer(rows)
    np.testing.assert_allclose(answer, source.answer(rows), rtol=1e-5, atol=2e-6)
    np.testing.assert_allclose(
        policy_action(source.policy, rows), source.answer(rows), rtol=1e-6, atol=1e-6
    )


def policy_action(policy, rows):
    return policy.predict(rows)[0] * policy.settings.thrust_scale
