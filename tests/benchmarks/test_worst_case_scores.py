"""What an attack says of a flight, against a second account of the same flight."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray
from studies.theorem_one import CertificateTarget, TubeCheck

import lagros_envs  # noqa: F401
import lagros_policies
from lagros_benchmarks.evidence import calibration
from lagros_benchmarks.tasks.spacecraft import calibration as worlds_calibration
from lagros_benchmarks.tasks.spacecraft.attack import (
    SpacecraftBench,
    replay_spacecraft,
    search_adversary,
)
from lagros_benchmarks.tasks.spacecraft.plane import plane_target, worst_plane_pushes
from lagros_benchmarks.tasks.spacecraft.worst_case import SpacecraftFlights, SpacecraftTarget
from lagros_benchmarks.worst_case import attack
from lagros_benchmarks.worst_case.attack import AttackSettings, check_bound, run_attack
from lagros_benchmarks.worst_case.flights import Episodes, Flights, draw_episodes, fly, tracking_law
from lagros_benchmarks.worst_case.goals import GOALS, scores
from lagros_benchmarks.worst_case.replay import Outcome
from lagros_benchmarks.worst_case.search import SearchSettings, search
from lagros_benchmarks.worst_case.seeds import ATTACK, CALIBRATION
from lagros_benchmarks.worst_case.single import (
    SingleTarget,
    energy_adversary,
    replay_single,
)
from lagros_envs.conventions import beyond_the_end
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.spacecraft.task import SpacecraftSettings
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.baselines import LqrPolicy
from lagros_policies.contraction import certified_tube
from lagros_policies.remarks.lagrangian import SlidingAxis, peak_position_error
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tasks.spacecraft.safety_filter import SafetyFilter
from lagros_policies.tasks.spacecraft.sliding import SlidingTracking

FloatArray = NDArray[np.float64]


@pytest.fixture(scope="module")
def expert() -> CartPoleExpert:
    return CartPoleExpert()


@pytest.fixture(scope="module")
def episodes(expert: CartPoleExpert) -> Episodes:
    return draw_episodes(expert, episode_seeds(0, 3, 12345))


# The cart-pole: what a flight is scored by.


def test_targets_fly_sequences_times_the_bound(expert: CartPoleExpert, episodes: Episodes) -> None:
    law = tracking_law(expert, episodes)
    target = SingleTarget(episodes, law, "tube", 0.2)
    still = np.zeros((3, 90, 4))
    still[..., 2] = 1.0
    flown = fly(episodes, law, np.arange(3), 0.2 * still)
    wanted = scores(episodes, "tube", np.arange(3), flown)[0]
    np.testing.assert_array_equal(target.scores(np.arange(3), still), wanted)


def test_starts_push_both_ways_along_every_axis_and_away_from_the_plan(
    expert: CartPoleExpert, episodes: Episodes
) -> None:
    law = tracking_law(expert, episodes)
    adversary = energy_adversary(expert.metric)
    target = SingleTarget(episodes, law, "tube", 0.1, adversary)
    starts = target.starts()
    assert starts.shape == (3, 19, 90, 4)
    assert [one.flights for one in search(target, SearchSettings("random", budget=4))] == [4] * 3
    constant = {tuple(row) for row in starts[0, :8, 40]}
    axes = np.concatenate([np.eye(4), -np.eye(4)])
    assert constant == {tuple(row) for row in axes}
    # The greedy pushes raise V = e'Me: where there is an error they go along its gradient.
    flights = fly(episodes, law, np.arange(3), 0.1 * starts[:, 8])
    error = (flights.states - episodes.plans)[:, 1:90]
    gradient = np.einsum("eij,ej->ei", expert.metric.matrix(flights.states[0, 1:90]), error[0])
    assert np.all(np.sum(gradient * starts[0, 8, 1:], axis=-1) > 0.0)


def test_a_fall_counts_for_the_clearance_and_the_moment_of_it_for_nothing_else(
    episodes: Episodes,
) -> None:
    states = episodes.plans[:1].copy()
    states[0, 50:] = [0.0, 2.0, 0.0, 900.0]
    alive = np.ones((1, 91), bool)
    alive[0, 51:] = False
    flight = Flights(
        states,
        np.zeros((1, 90, 1)),
        alive,
        np.ones(1, bool),
        np.zeros(1, bool),
        np.full((1, 91), np.inf),
    )
    where = np.zeros(1, int)
    depth, instant = scores(episodes, "clearance", where, flight)
    assert (depth[0], instant[0]) == (pytest.approx(2.0 - np.pi / 2), 50)
    # On the plan until it fell.
    assert scores(episodes, "tube", where, flight)[0][0] == pytest.approx(0.0, abs=1e-6)


class _Still:
    name, observes = "still", "local"

    def predict(self, rows: Any, *_: Any) -> Any:
        return np.zeros((*np.shape(rows)[:-1], 1), np.float32), None


def test_what_counts_as_broken_on_the_cartpole(episodes: Episodes) -> None:
    push = np.zeros((90, 4))
    push[:20, 0] = 2.0

    def broken(policy: Any, goal: str) -> bool:
        return replay_single(episodes, 0, policy, goal, push)[0].broken

    # Without a force the pole falls: everything is broken.
    assert [broken(_Still(), goal) for goal in GOALS] == [True] * 3
    # LQR is pushed out of the tube around the plan and arrives all the same.
    assert [broken(LqrPolicy(), goal) for goal in GOALS] == [True, False, False]


def test_the_tube_is_held_until_the_first_instant_outside_the_region(
    expert: CartPoleExpert, episodes: Episodes
) -> None:
    law = tracking_law(expert, episodes)
    flight = fly(episodes, law, np.array([0]), np.zeros((1, 90, 4)))
    check = TubeCheck(expert, episodes, 0.05)
    before = check.hold(np.array([0]), flight)
    steady = certified_tube(expert.metric, 0.05).steady_radius
    assert before.certified_radius[0] == pytest.approx(steady, rel=1e-3)
    # At instant 10 it is outside; what it does from 11 on is not held against the tube.
    states = flight.states.copy()
    states[0, 10] = episodes.plans[0, 10] + [0.0, 0.5, 0.0, 0.0]
    states[0, 11:] = episodes.plans[0, 11:] + [5.0, 0.9, 0.0, 0.0]
    moved = check.hold(np.array([0]), replace(flight, states=states))
    radius = certified_tube(expert.metric, 0.05).radius(1.0)
    assert moved.certified_share[0] == pytest.approx(0.5 / radius, rel=1e-2)
    assert not moved.in_region[0]
    # And on inside again afterwards: outside once is outside.
    states[0, 11:] = episodes.plans[0, 11:] + [50.0, 0.0, 0.0, 0.0]
    back = check.hold(np.array([0]), replace(flight, states=states))
    assert back.certified_share[0] == moved.certified_share[0]


def test_a_search_for_the_share_of_the_certificate_is_no_worse_than_its_starts(
    expert: CartPoleExpert,
) -> None:
    episodes = draw_episodes(expert, episode_seeds(0, 1, 12345))
    law = tracking_law(expert, episodes)
    adversary = energy_adversary(expert.metric)
    check = TubeCheck(expert, episodes, 0.75)
    target = CertificateTarget(episodes, law, "tube", 0.75, adversary, check)
    found = search(target, SearchSettings("cross-entropy", budget=20, population=10))
    starts = target.starts()
    for index, one in enumerate(found):
        flown = target.scores(np.full(len(starts[index]), index), starts[index])
        assert one.score >= flown.max()
        again = fly(episodes, law, np.array([index]), 0.75 * one.sequence[None])
        assert check.hold(np.array([index]), again).certified_share[0] == one.score


def test_a_metric_that_is_a_network_is_attacked_by_the_law_of_its_own() -> None:
    name = "lagros_policies.tasks.cartpole.remarks:NeuralTubeMpcPolicy"
    given = AttackSettings(
        "cartpole", policy=name, bound=0.3, episodes=1, search=SearchSettings(budget=30)
    )
    row = run_attack(given).row
    assert row["broken_rate"] == 1.0
    assert row["random_broken_rate"] == 0.0
    # Against the u* of the shipped metric it would err by newtons.
    assert row["learning_error_max"] < 1e-3
    assert row["certified_radius_max"] is None


# Rows.


def test_attacks_have_episodes_of_their_own() -> None:
    seeds = AttackSettings("cartpole", episodes=50, seed=3).episode_seeds()
    assert seeds == episode_seeds(3, 50, ATTACK)
    for other in (None, EVALUATION, CALIBRATION):
        assert not set(seeds) & set(episode_seeds(3, 50, other))


def test_rows_keep_the_worst_of_every_measure() -> None:
    outcomes = [
        Outcome(1, 0.0, False, {"least_gap": gap, "max_position_error": far, "fallen": fell})
        for gap, far, fell in ((0.3, 0.1, False), (-0.2, 0.4, True), (0.1, 0.2, False))
    ]
    row = attack._worst_measures([*outcomes, Outcome(2, 1.0, True, {}, "broke")])
    assert row == {"least_gap_min": -0.2, "max_position_error_max": 0.4, "fallen_rate": 0.25}


def test_pushes_outside_the_ball_are_refused() -> None:
    check_bound(np.full((2, 5, 4), 0.5), 1.0)
    for wrong in (np.full((2, 5, 4), 0.51), np.full((1, 1, 4), np.nan)):
        with pytest.raises(ValueError, match=r"above the bound 1\.0"):
            check_bound(wrong, 1.0)


# The spacecraft.


def test_the_search_of_an_adversary_keeps_the_worst_that_it_flew() -> None:
    flown: list[FloatArray] = []

    def fly(points: FloatArray) -> Any:
        flown.append(points)
        return points[:, 0], points[:, None, None, :6]

    target: Any = SimpleNamespace(try_adversaries=fly, bound=1.0)
    rng = np.random.default_rng(0)
    given = SearchSettings(budget=100, population=16)
    found = search_adversary(target, given, rng)
    assert found.score == max(points[:, 0].max() for points in flown)
    assert found.sequence[0, 0, 0] == found.score
    assert found.flights == sum(map(len, flown)) <= 100


def test_the_filter_is_worn_and_has_no_certified_margin() -> None:
    given = AttackSettings(
        "spacecraft", "centralized", "clearance", 0.4, 1, preset="open", agents=2
    )
    bare, worn = (
        SpacecraftBench(replace(given, safety_filter=flag)).targets()[0] for flag in (False, True)
    )
    assert bare.margin is not None
    assert worn.margin is None
    assert isinstance(worn.policy, SafetyFilter)
    # A policy that prepares for a bound is told the one that it is attacked with.
    stronger = SpacecraftBench(replace(given, bound=0.8)).targets()[0]
    assert stronger.policy.planner.settings.margins[0] == pytest.approx(  # type: ignore[attr-defined]
        2.0 * bare.policy.planner.settings.margins[0]  # type: ignore[attr-defined]
    )


@pytest.mark.parametrize("bound", [0.3, 4.0])
def test_a_flight_is_measured_as_the_world_is_seen(bound: float) -> None:
    env = SpacecraftVectorEnv(2, 2, "open", "none", bound, autoreset_mode="disabled")
    policy = lagros_policies.make("centralized", env)
    target = SpacecraftTarget(policy, 5, 2, "open", bound, "tube", 1.0)

    def together(situation: Any) -> FloatArray:
        push = np.zeros(situation.state.shape)
        towards = situation.state[..., ::-1, :2] - situation.state[..., :2]
        early = np.max(situation.time) < 15.0
        push[..., 3:5] = 9.0 * early * towards
        return push

    flown = target.fly(target.environment(1, together))
    env = target.environment(1, together)
    env.reset(seed=[5])
    memory: Any = None
    gaps, misses, errors = [], [], []
    hit = np.zeros(2, bool)
    for step in range(env.settings.steps):
        action, memory = policy.predict(env.state(), memory)
        with beyond_the_end():
            info = env.step(action.reshape(2, -1))[4]
        place = env.states[0, :, :2]
        # In the preset "open" there is nothing but the two.
        gaps.append(np.hypot(*(place[0] - place[1])) - 2.0 * env.scenarios[0].agent_radius)
        hit |= info["collided"]
        misses.append(np.where(hit, np.inf, info["goal_distance"] - env.settings.goal_radius))
        errors.append(np.linalg.norm(place - memory[0].nominal[step + 1, :, :2], axis=-1))
    assert flown.gap[0] == pytest.approx(min(gaps), abs=1e-9)
    np.testing.assert_allclose(flown.position_error[0], np.max(errors, axis=0), atol=1e-9)
    assert flown.scores[0] == pytest.approx(np.max(errors))
    assert hit.any() == (bound > 1.0)
    if not hit.any():
        np.testing.assert_allclose(flown.misses[0], np.min(misses, axis=0), atol=1e-6)
    else:
        # Who collided early has not arrived, wherever it drifts later.
        assert np.all(flown.misses[0] > 0.2)
    success = replace(target, goal="success")
    assert success._scores(flown.gap, np.array([[0.1, -0.2]]), flown.position_error)[0] == 0.1


def _flown(**changed: Any) -> SpacecraftFlights:
    info = {name: np.zeros((1, 2), bool) for name in ("success", "strict_success", "collided")}
    info["success"] = np.array([[True, changed.get("both", True)]])
    info["collided"] = np.array([[False, changed.get("hit", False)]])
    error = np.array([[0.1, changed.get("error", 0.2)]])
    return SpacecraftFlights(np.zeros(1), np.zeros(1), np.ones(1), np.zeros((1, 2)), error, info)


@pytest.mark.parametrize(
    ("goal", "changed", "broken"),
    [
        ("tube", {"error": 0.51}, True),
        ("tube", {"error": 0.49, "hit": True, "both": False}, False),
        ("success", {"both": False}, True),
        ("success", {"hit": True, "error": 0.9}, False),
        ("clearance", {"hit": True}, True),
        ("clearance", {"both": False, "error": 0.9}, False),
    ],
)
def test_what_counts_as_broken_in_a_world(goal: str, changed: dict[str, Any], broken: bool) -> None:
    target: Any = SimpleNamespace(
        seed=1,
        goal=goal,
        margin=0.5,
        task=SpacecraftSettings(),
        environment=lambda *_: None,
        fly=lambda _: _flown(**changed),
    )
    assert replay_spacecraft(target, np.zeros((450, 2, 6))).broken is broken


@pytest.mark.parametrize(("position_rate", "sliding_rate"), [(3.0, 3.0), (1.0, 2.5)])
def test_the_climb_reaches_the_worst_that_is_known_exactly(
    position_rate: float, sliding_rate: float
) -> None:
    axis = SlidingAxis(position_rate, sliding_rate)
    env = SpacecraftVectorEnv(1, 1, "open", "none")
    law = SlidingTracking(env.settings.system, axis, axis)
    target = plane_target(law, 0.4)
    sequence = worst_plane_pushes(law, 0.4, target.steps)
    assert np.linalg.norm(sequence, axis=-1).max() <= 1.0
    reached = target.scores(np.zeros(1, int), sequence[None])[0]
    peak = peak_position_error(axis, 0.4)
    assert 0.99 * peak < reached <= peak * (1.0 + 1e-9)


def test_an_attack_on_the_certified_error_comes_near_it_within_the_ball() -> None:
    given = AttackSettings(
        "spacecraft",
        "centralized",
        "tube",
        0.4,
        1,
        search=SearchSettings(budget=1, population=2),
        preset="open",
        agents=2,
    )
    found = run_attack(given)
    pushes = found.cases.pushes
    assert 0.4 - 1e-9 < np.linalg.norm(pushes, axis=-1).max() <= 0.4
    assert found.row["random_broken_rate"] == found.row["broken_rate"] == 0.0
    # The random disturbance reaches less than half of what the climbed one does.
    assert 0.72 < found.row["score_worst"] < 1.0
    assert found.row["random_score_worst"] < 0.5 * found.row["score_worst"]


# The scores behind calibrated bounds.


def test_calibration_scores_are_the_largest_of_an_episode(expert: CartPoleExpert) -> None:
    scores = calibration.single_scores(CartPoleSettings(), "lagros", 2, bound=0.5).values
    env: Any = gym.make(
        "lagros/CartPole-v0", disturbance="uniform", disturbance_bound=0.5
    ).unwrapped
    policy = lagros_policies.make("lagros", env)
    for index, seed in enumerate(episode_seeds(0, 2, CALIBRATION)):
        one = draw_episodes(expert, [seed])
        tracked = expert.track(one.plans, one.controls)
        rows, _ = env.reset(seed=seed)
        errors, missed = [0.0], []
        for step in range(env.settings.steps):
            action, _ = policy.predict(rows)
            where = np.array([0]), np.array([step])
            wanted = expert.control(tracked, *where, env.state[None])[0, 0]
            missed.append(abs(env.settings.force_scale * float(action[0]) - wanted))
            rows = env.step(action)[0]
            errors.append(float(np.linalg.norm(env.state - one.plans[0, step + 1])))
        assert scores["tube"][index] == pytest.approx(max(errors), rel=1e-3)
        assert scores["learning_error"][index] == pytest.approx(max(missed), rel=1e-2)


def test_episodes_that_fall_or_have_no_plan_are_infinitely_bad(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fallen = calibration.single_scores(CartPoleSettings(), "lagros", 4, bound=20.0)
    assert fallen.failed == 4
    assert all(np.all(np.isinf(values)) for values in fallen.values.values())
    drawn = calibration.draw_episodes
    monkeypatch.setattr(
        calibration, "draw_episodes", lambda *given: replace(drawn(*given), unplanned=(1, 2))
    )
    some = calibration.single_scores(CartPoleSettings(), "lagros", 3, bound=0.1)
    assert some.failed == 2
    assert all(
        np.isinf(values).tolist() == [False] * 3 + [True] * 2 for values in some.values.values()
    )


def test_a_world_scores_its_worst_agent_and_a_failed_one_is_infinitely_bad(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def world(*errors: float | None, **changed: Any) -> Any:
        agents = [SimpleNamespace(max_position_error=error) for error in errors]
        return SimpleNamespace(**{"error": None, "planned": True, "agents": agents, **changed})

    worlds = [
        world(0.1, 0.3),
        world(0.4, 0.2),
        world(0.1, None),
        world(0.1, 0.1, error="it raised"),
        world(0.1, 0.1, planned=False),
    ]
    monkeypatch.setattr(worlds_calibration, "fly_chunk", lambda *_: SimpleNamespace(worlds=worlds))
    scores = worlds_calibration.spacecraft_scores(5, preset="open", agents=2)
    np.testing.assert_array_equal(
        scores.values["position_error"], [0.3, 0.4, np.inf, np.inf, np.inf]
    )
    assert scores.failed == 3
