"""The search for the worst disturbance of spacecraft, and the scores behind calibrated bounds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import lagros_policies
from lagros_benchmarks.evidence import calibration
from lagros_benchmarks.tasks.spacecraft.attack import replay_spacecraft
from lagros_benchmarks.tasks.spacecraft.calibration import spacecraft_scores
from lagros_benchmarks.tasks.spacecraft.worst_case import (
    PARAMETERS,
    Adversary,
    PlansOnce,
    SpacecraftTarget,
    first_adversaries,
    least_gap,
)
from lagros_benchmarks.worst_case.seeds import ATTACK, CALIBRATION, VERIFICATION
from lagros_envs.disturbances import Situation
from lagros_envs.seeding import EVALUATION, episode_seeds
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_envs.tasks.spacecraft.scenarios import Scenario
from lagros_envs.tasks.spacecraft.vector import SpacecraftVectorEnv
from lagros_policies.contraction.conformal import rank_for

AGENTS = 2


def _scenario() -> Scenario:
    return Scenario(
        starts=np.array([[0.5, 0.5], [4.0, 0.5]]),
        headings=np.zeros(2),
        goals=np.array([[4.0, 4.0], [0.5, 4.0]]),
        obstacles=np.array([[2.0, 0.5]]),
        obstacle_radii=np.array([0.5]),
        agent_radius=0.25,
    )


def _target(goal: str, name: str = "lagros", margin: float | None = None) -> SpacecraftTarget:
    env = SpacecraftVectorEnv(AGENTS, AGENTS, "open", "none")
    policy = lagros_policies.make(name, env)
    return SpacecraftTarget(policy, 7, AGENTS, "open", 0.4, goal, margin)


def test_least_gap_by_hand() -> None:
    positions = np.array([[[0.5, 0.5], [4.0, 0.5]], [[0.0, 0.0], [0.3, 0.4]]])
    gaps = least_gap(positions, _scenario())
    # Agent 0 to the obstacle: 1.5 - 0.5 - 0.25; then two agents 0.5 apart that touch.
    np.testing.assert_allclose(gaps, [0.75, 0.0], atol=1e-12)


def test_adversary_pushes_where_its_numbers_say() -> None:
    points = np.zeros((3, PARAMETERS))
    points[0, 0] = 1.0
    points[1, 2] = 1.0
    points[2, 0], points[2, -1] = 1.0, 20.0
    state = np.zeros((3, 2, 6))
    state[:, 0, :2], state[:, 1, :2] = [0.9, 0.5], [4.0, 0.5]
    one = Adversary(points, _scenario(), None, 0.1)
    push = one(Situation(state, None, np.zeros((3, 2)), np.zeros((3, 2, 6))))
    np.testing.assert_allclose(np.linalg.norm(push, axis=-1), 1.0)
    # Agent 0 is nearest to the obstacle on its right; agent 1 to the same one on its left.
    np.testing.assert_allclose(push[0, 0], [0, 0, 0, 1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(push[0, 1], [0, 0, 0, -1, 0, 0], atol=1e-12)
    away = state[1, 0, :2] - [4.0, 4.0]
    np.testing.assert_allclose(push[1, 0, 3:5], away / np.linalg.norm(away))
    # The last number turns the push from the velocity to the position.
    np.testing.assert_allclose(push[2, 0], [1, 0, 0, 0, 0, 0], atol=1e-12)


def test_what_an_adversary_did_is_replayed_within_the_bound() -> None:
    target = _target("clearance")
    flown = target.fly_adversaries(first_adversaries()[:2])
    norms = np.linalg.norm(flown.pushes, axis=-1)
    assert 0.4 - 1e-9 <= norms.max() <= 0.4
    outcome = replay_spacecraft(target, flown.pushes[0])
    again = replay_spacecraft(target, flown.pushes[0])
    assert outcome == again
    assert outcome.score == pytest.approx(flown.scores[0], abs=1e-2)
    assert outcome.broken == bool(flown.info["collided"][0].any())
    assert outcome.measures["least_gap"] == -outcome.score


def test_an_exception_is_an_outcome() -> None:
    class Broken:
        name, observes = "broken", "local"

        def predict(self, *_: Any) -> Any:
            raise RuntimeError("no thrust")

    target = SpacecraftTarget(Broken(), 7, AGENTS, "open", 0.4, "success")
    outcome = replay_spacecraft(target, np.zeros((450, AGENTS, 6)))
    assert outcome.broken
    assert outcome.error == "RuntimeError: no thrust"


def test_goals_need_what_they_measure() -> None:
    with pytest.raises(ValueError, match="centralized"):
        _target("tube")
    with pytest.raises(ValueError, match="goal 'speed'"):
        _target("speed")


def test_a_planner_is_asked_the_same_question_once() -> None:
    class Planner:
        settings = "kept"
        asked = 0

        def plan(self, *question: Any) -> int:
            self.asked += 1
            return self.asked

    inner = Planner()
    planner = PlansOnce(inner)
    assert planner.settings == "kept"
    assert planner.plan(np.zeros(2), 1.0) == planner.plan(np.zeros(2), 1.0) == 1
    assert planner.plan(np.ones(2), 1.0) == 2


def test_namespaces_share_no_episode() -> None:
    spaces = (None, EVALUATION, ATTACK, CALIBRATION, VERIFICATION)
    seeds = [set(episode_seeds(0, 200, space)) for space in spaces]
    assert len(set.union(*seeds)) == sum(map(len, seeds))


def test_scores_of_the_cartpole_are_those_of_its_flights() -> None:
    scores = calibration.single_scores(CartPoleSettings(), "lagros", 12, bound=0.3)
    tube, share = scores.values["tube"], scores.values["tube_share"]
    assert scores.failed == 0
    assert {len(values) for values in scores.values.values()} == {12}
    # ||e|| <= s r(t) with r(t) < 3.15.
    assert np.all(tube <= 3.15 * share)
    # Ten times the disturbance, the same episodes: none is closer to its plan.
    more = calibration.single_scores(CartPoleSettings(), "lagros", 12, bound=3.0)
    assert np.all(more.values["tube"] > tube)
    still = calibration.single_scores(CartPoleSettings(), "tube-mpc", 4, kind="none", bound=0.0)
    assert still.values["tube"].max() < 1e-3
    # What imitates nothing has no learning error.
    assert set(scores.values) - set(still.values) == {"learning_error"}


def test_statements_need_enough_episodes_for_the_level() -> None:
    with pytest.raises(ValueError, match="too few"):
        calibration.single_statements(CartPoleSettings(), 0.95, 5, bound=0.3)
    lines = calibration.single_statements(CartPoleSettings(), 0.5, 5, bound=0.3)
    assert rank_for(5, 0.5) == 3
    assert [line.kind for line in lines] == ["calibrated"] * 3
    assert all(line.holds for line in lines)


def test_scores_of_the_spacecraft_stay_below_the_certified_margin() -> None:
    from lagros_policies.tasks.spacecraft.centralized import CentralizedPolicy

    scores = spacecraft_scores(3, bound=0.4, preset="open", agents=2)
    margin = CentralizedPolicy(preset="open").tracking.margin(0.4)
    assert np.all(scores.values["position_error"] < margin)
    assert np.all(scores.values["position_error"] > 0.0)
