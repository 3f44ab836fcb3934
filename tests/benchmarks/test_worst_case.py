"""Searches for the worst disturbance: parametrisations, optimisers, closed loops, files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from studies.theorem_one import TubeCheck

import lagros_envs  # noqa: F401
from lagros_benchmarks.worst_case.attack import AttackSettings, fly_again, run_attack
from lagros_benchmarks.worst_case.flights import (
    Episodes,
    Flights,
    draw_episodes,
    fly,
    policy_law,
    tracking_law,
)
from lagros_benchmarks.worst_case.goals import GOALS, gradient, scores
from lagros_benchmarks.worst_case.optimisers import OPTIMISERS, make_search
from lagros_benchmarks.worst_case.replay import load_worst_cases, save_worst_cases
from lagros_benchmarks.worst_case.search import METHODS, SearchSettings, search
from lagros_benchmarks.worst_case.sequences import PARAMETRISATIONS, Knots, Replay, Segments
from lagros_benchmarks.worst_case.single import replay_single
from lagros_envs.seeding import episode_seeds
from lagros_envs.tasks.cartpole.vector import CartPoleVectorEnv
from lagros_policies.baselines import LqrPolicy
from lagros_policies.lagros import LagrosPolicy
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from lagros_policies.tube_mpc import TubeMpcPolicy

FloatArray = NDArray[np.float64]


@pytest.fixture(scope="module")
def expert() -> CartPoleExpert:
    return CartPoleExpert()


@pytest.fixture(scope="module")
def episodes(expert: CartPoleExpert) -> Episodes:
    return draw_episodes(expert, episode_seeds(0, 3, 12345))


@given(
    name=st.sampled_from(sorted(PARAMETRISATIONS)),
    scale=st.sampled_from([0.0, 1e-3, 1.0, 1e3, 1e150]),
    seed=st.integers(0, 100),
)
@settings(max_examples=40, deadline=None)
def test_every_sequence_lies_in_the_unit_ball(name: str, scale: float, seed: int) -> None:
    kind = PARAMETRISATIONS[name](90, 4, 6)
    points = scale * np.random.default_rng(seed).standard_normal((5, kind.dimension))
    sequences = kind.sequences(points)
    assert sequences.shape == (5, 90, 4)
    assert np.linalg.norm(sequences, axis=-1).max() <= 1.0


def test_parametrisations_mean_what_they_say() -> None:
    points = np.random.default_rng(0).standard_normal((2, 3 * 2))
    blocks = Segments(10, 2, 3).sequences(points)
    changes = np.any(np.diff(blocks, axis=1) != 0.0, axis=-1)
    assert np.flatnonzero(changes[0]).tolist() == [3, 6]
    knots = Knots(9, 2, 2).sequences(0.1 * points)
    np.testing.assert_allclose(knots[:, [0, 8]], 0.1 * points.reshape(2, 3, 2)[:, [0, 2]])
    np.testing.assert_allclose(knots[:, 4], 0.1 * points.reshape(2, 3, 2)[:, 1])
    # One switch at the middle, logit 0.
    switching = PARAMETRISATIONS["switching"](10, 2, 2).sequences(np.array([[3.0, 4.0, 0.0]]))[0]
    np.testing.assert_allclose(switching[:5], np.tile([0.6, 0.8], (5, 1)))
    np.testing.assert_allclose(switching[5:], np.tile([-0.6, -0.8], (5, 1)))
    with pytest.raises(ValueError, match="pieces=11"):
        Segments(10, 2, 11)


@dataclass(frozen=True)
class LinearTarget:
    """score = sum_k c_k'd_k, whose largest value in the balls is the sum of ||c_k||."""

    slope: FloatArray  # (episodes, steps, channels)
    slope_cost: int = 1

    @property
    def episodes(self) -> int:
        return self.slope.shape[0]

    @property
    def steps(self) -> int:
        return self.slope.shape[1]

    @property
    def channels(self) -> int:
        return self.slope.shape[2]

    def scores(self, episode: NDArray[np.intp], sequences: FloatArray) -> FloatArray:
        return np.einsum("bkc,bkc->b", self.slope[episode], sequences)

    def slopes(self, episode: NDArray[np.intp], sequences: FloatArray) -> FloatArray:
        return self.slope[episode]

    def starts(self) -> FloatArray:
        return np.zeros((self.episodes, 1, self.steps, self.channels))

    @property
    def best(self) -> FloatArray:
        return np.linalg.norm(self.slope, axis=-1).sum(axis=1)


@pytest.mark.parametrize("method", METHODS)
def test_methods_near_the_optimum_that_is_known(method: str) -> None:
    # Constant over each of two halves, so that two segments can express the optimum.
    halves = np.random.default_rng(1).standard_normal((3, 2, 3))
    flown = np.zeros(3, int)

    class Counted(LinearTarget):
        def scores(self, episode: NDArray[np.intp], sequences: FloatArray) -> FloatArray:
            np.add.at(flown, episode, 1)
            return super().scores(episode, sequences)

        def slopes(self, episode: NDArray[np.intp], sequences: FloatArray) -> FloatArray:
            np.add.at(flown, episode, self.slope_cost)
            return super().slopes(episode, sequences)

    target = Counted(np.repeat(halves, 5, axis=1))
    given = SearchSettings(method, "cross-entropy", "segments", 2, 600, population=20, restarts=3)
    found = search(target, given)
    assert [one.flights for one in found] == flown.tolist()
    assert flown.max() <= 600
    reached = np.array([one.score for one in found]) / target.best
    least = {"gradient": 1.0 - 1e-9, "hybrid": 1.0 - 1e-9, "random": 0.8}.get(method, 0.97)
    assert reached.min() >= least
    assert reached.max() <= 1.0 + 1e-12
    sequences = np.stack([one.sequence for one in found])
    again = np.einsum("ekc,ekc->e", target.slope, sequences)
    np.testing.assert_allclose(again, [one.score for one in found])
    assert np.linalg.norm(sequences, axis=-1).max() <= 1.0


def test_a_climb_of_few_where_the_budget_does_not_pay_for_all() -> None:
    target = LinearTarget(np.random.default_rng(2).standard_normal((3, 9, 3)), slope_cost=16)
    # One start, sixty flights that explore; eight climbers would cost 160 a round.
    found = search(target, SearchSettings(budget=130))
    assert {one.flights for one in found} <= set(range(81, 131))
    np.testing.assert_allclose([one.score for one in found], target.best)


@pytest.mark.parametrize("name", OPTIMISERS)
def test_optimisers_are_reproducible_and_learn(name: str) -> None:
    def best(seed: int) -> FloatArray:
        one = make_search(name, 6, 20, np.random.default_rng(seed))
        tops = []
        for _ in range(30):
            points = one.ask()
            values = -np.sum((points - 1.5) ** 2, axis=1)
            one.tell(points, values)
            tops.append(values.max())
        return np.array(tops)

    first, again = best(0), best(0)
    np.testing.assert_array_equal(first, again)
    if name != "random":
        assert first[-1] > 0.05 * first[0]
        assert first[-1] > -0.3


def test_settings_name_what_is_wrong() -> None:
    with pytest.raises(ValueError, match="method='annealing' must be one of"):
        SearchSettings("annealing")
    with pytest.raises(ValueError, match="population=1 must be a whole number"):
        SearchSettings(population=1)
    with pytest.raises(ValueError, match="goal='speed'"):
        AttackSettings("cartpole", goal="speed")
    with pytest.raises(ValueError, match="random"):
        AttackSettings("cartpole", policy="random")
    with pytest.raises(ValueError, match="optimiser 'x'"):
        make_search("x", 2, 2, np.random.default_rng(0))


def _pushes(count: int, bound: float) -> FloatArray:
    kind = Segments(90, 4, 9)
    points = np.random.default_rng(5).standard_normal((count, kind.dimension))
    return bound * kind.sequences(points)


@pytest.mark.parametrize("policy", [LqrPolicy(), LagrosPolicy()], ids=["lqr", "lagros"])
def test_flights_are_those_of_the_vector_environment(policy: Any, episodes: Episodes) -> None:
    pushes = _pushes(3, 0.2)
    law = policy_law(policy, episodes)
    flights = fly(episodes, law, np.arange(3), pushes)
    env = CartPoleVectorEnv(
        3, Replay(np.moveaxis(pushes, 1, 0), 0.1), 0.2, autoreset_mode="disabled"
    )
    rows, _ = env.reset(seed=list(episodes.seeds))
    states = [env.state]
    for _ in range(90):
        rows, *_ = env.step(policy.predict(rows)[0])
        states.append(env.state)
    assert not flights.fallen.any()
    np.testing.assert_allclose(flights.states, np.stack(states, axis=1), atol=1e-5)


def test_the_stand_in_of_tube_mpc_is_tube_mpc(expert: CartPoleExpert, episodes: Episodes) -> None:
    pushes = _pushes(3, 0.2)
    law = tracking_law(expert, episodes)
    flight = fly(episodes, law, np.arange(3), pushes)
    policy = TubeMpcPolicy(deadline=1e9)
    outcome, real = replay_single(episodes, 0, policy, "tube", pushes[0])
    assert real is not None
    np.testing.assert_allclose(real.states[0], flight.states[0], atol=2e-3)
    score = scores(episodes, "tube", np.arange(3), flight)[0][0]
    assert outcome.score == pytest.approx(score, rel=1e-2)


@pytest.mark.parametrize("goal", GOALS)
def test_slopes_against_differences_of_whole_flights(goal: str, episodes: Episodes) -> None:
    law = policy_law(_Exact(episodes), episodes)
    where = np.array([1])
    pushes = _pushes(1, 0.3)
    flight = fly(episodes, law, where, pushes)
    value, instant = scores(episodes, goal, where, flight)
    slope = gradient(episodes, law, goal, where, pushes, flight)[0]
    assert not slope[instant[0] :].any()
    rng = np.random.default_rng(3)
    for _ in range(2):
        change = rng.standard_normal((1, 90, 4))
        # Observations and actions are rounded to float32.
        step = 1e-4
        ends = [
            scores(episodes, goal, where, fly(episodes, law, where, pushes + sign * change))[0][0]
            for sign in (step, -step)
        ]
        measured = (ends[0] - ends[1]) / (2.0 * step)
        predicted = float(np.sum(slope * change))
        # The slope is that of the score up to one positive factor.
        factor = _factor(episodes, goal, flight, int(instant[0]))
        assert measured == pytest.approx(factor * predicted, rel=5e-2, abs=1e-3)
    assert value.shape == (1,)


class _Exact:
    """LQR in double precision at the float32 state that is shown, without float32 actions."""

    def __init__(self, episodes: Episodes) -> None:
        self._policy = LqrPolicy(episodes.settings)

    def predict(self, rows: Any, *_: Any) -> tuple[Any, None]:
        return self._policy.predict(rows)[0], None


def _factor(episodes: Episodes, goal: str, flight: Flights, at: int) -> float:
    state = flight.states[0, at]
    if goal == "clearance":
        return 1.0
    if goal == "success":
        return 1.0 / float(np.linalg.norm(state - episodes.goals[1]))
    radius = episodes.settings.tube.radius(0.1 * at)
    return 1.0 / float(np.linalg.norm(state - episodes.plans[1, at]) * radius)


def test_a_policy_with_a_memory_is_refused(episodes: Episodes) -> None:
    law = policy_law(TubeMpcPolicy(deadline=1e9), episodes)
    with pytest.raises(ValueError, match="keeps a memory"):
        law(episodes.initial_states, np.arange(3), np.zeros(3, int))


def test_replay_is_the_given_sequence(episodes: Episodes) -> None:
    pushes = _pushes(1, 0.4)[0]
    env: Any = gym.make(
        "lagros/CartPole-v0", disturbance=Replay(pushes, 0.1), disturbance_bound=0.4
    ).unwrapped
    env.reset(seed=0, options={"initial_state": np.zeros(4)})
    met = [env.step(np.zeros(1, np.float32))[4]["disturbance"] for _ in range(5)]
    np.testing.assert_allclose(met, pushes[:5], rtol=1e-12)
    with pytest.raises(ValueError, match="must be finite"):
        Replay(np.full((3, 4), np.nan), 0.1)


def test_a_certificate_that_is_too_small_is_crossed(
    expert: CartPoleExpert, episodes: Episodes
) -> None:
    law = tracking_law(expert, episodes)
    pushes = np.zeros((3, 90, 4))
    pushes[:, :, 2] = 0.05
    flight = fly(episodes, law, np.arange(3), pushes)
    every = np.arange(3)
    honest = TubeCheck(expert, episodes, 0.05).hold(every, flight)
    assert honest.in_region.any()
    assert not honest.certified_crossed.any()
    assert honest.learning_error.max() < 1e-4
    # The flights had d = 0.05; a certificate for much less of it must not survive.
    wrong = TubeCheck(expert, episodes, 0.0).hold(every, flight)
    assert wrong.certified_crossed.all()
    # A policy that ignores the plan has a learning error, and the certificate takes it in.
    lqr = fly(episodes, policy_law(LqrPolicy(), episodes), every, pushes)
    other = TubeCheck(expert, episodes, 0.05).hold(every, lqr)
    assert (other.certified_radius > 2.0 * honest.certified_radius).all()
    assert (other.learning_error > 0.1).all()


def test_an_attack_is_saved_and_flown_again_to_the_last_bit(tmp_path: Path) -> None:
    given = AttackSettings(
        "cartpole",
        goal="success",
        bound=0.75,
        episodes=2,
        search=SearchSettings(budget=80, population=20),
    )
    attack = run_attack(given)
    row = attack.row
    assert row["broken_rate"] == np.mean([one.broken for one in attack.cases.outcomes])
    assert row["score_worst"] >= max(row["random_score_worst"], 0.0)
    assert np.linalg.norm(attack.cases.pushes, axis=-1).max() <= 0.75
    path = tmp_path / "worst.npz"
    save_worst_cases(attack.cases, path)
    loaded = load_worst_cases(path)
    np.testing.assert_array_equal(loaded.pushes, attack.cases.pushes)
    assert tuple(fly_again(loaded)) == attack.cases.outcomes == loaded.outcomes


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "worst.npz"
    path.write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(ValueError, match=r"worst\.npz is damaged or not an \.npz file"):
        load_worst_cases(path)
    np.savez(path, pushes=np.zeros((1, 90, 4)), record=np.array('{"format": "other"}'))
    with pytest.raises(ValueError, match=r"worst\.npz: 'format' is 'other'"):
        load_worst_cases(path)
    with pytest.raises(FileNotFoundError):
        load_worst_cases(tmp_path / "nowhere.npz")
