"""How errors die out: closed forms, brute force, pairing, and what a run makes of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.report.tables import legend, terminal_table
from lagros_benchmarks.run.convergence import (
    Envelope,
    convergence_rates,
    error_areas,
    tightest_envelope,
)
from lagros_benchmarks.run.episodes import run_episode
from lagros_benchmarks.run.initial_errors import initial_error
from lagros_benchmarks.run.metrics import median_ratio
from lagros_benchmarks.run.runner import run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_envs.env import TaskEnv
from lagros_envs.registry import task_named, task_names
from lagros_envs.seeding import episode_seeds, episode_streams
from lagros_envs.vector import TaskVectorEnv
from tests.benchmarks import fakes, toys

PERIOD = 0.1
TIMES = PERIOD * np.arange(61)
BODIES = [name for name in task_names() if task_named(name).most_agents == 1]


@pytest.mark.parametrize("rate", [0.02, 0.7, 4.0])
def test_the_envelope_of_an_exponential_is_itself(rate):
    found = tightest_envelope(np.exp(-rate * TIMES), PERIOD)
    assert found.overshoot == pytest.approx(1.0, abs=1e-6)
    assert found.rate == pytest.approx(rate, rel=1e-6)
    exact = (1.0 - math.exp(-rate * TIMES[-1])) / rate
    assert found.area(TIMES[-1]) == pytest.approx(exact, rel=1e-6)
    # The trapezoidal rule errs by period^2 / 12 of the difference of the slopes at the ends.
    (area,) = error_areas(np.exp(-rate * TIMES)[None], PERIOD)
    off = PERIOD**2 / 12.0 * rate * (1.0 - math.exp(-rate * TIMES[-1]))
    assert area - exact == pytest.approx(off, rel=0.02)


def test_the_envelope_of_an_exponential_that_jumps_first_has_its_overshoot():
    error = 4.0 * np.exp(-0.8 * TIMES)
    error[0] = 1.0
    found = tightest_envelope(error, PERIOD)
    assert found.overshoot == pytest.approx(4.0, rel=1e-6)
    assert found.rate == pytest.approx(0.8, rel=1e-6)
    slower = np.array([1.0, *3.0 * np.exp(-0.5 * TIMES[1:])])
    rates = convergence_rates(np.array([error, slower]), 4.0, PERIOD)
    # (ln 4 - ln 3 + 0.5 t) / t is least at the end.
    np.testing.assert_allclose(rates, [0.8, 0.5 + math.log(4.0 / 3.0) / TIMES[-1]], rtol=1e-9)


def test_an_error_that_grows_has_the_rate_zero_and_its_peak():
    error = np.exp(0.3 * TIMES)
    assert tightest_envelope(error, PERIOD) == Envelope(pytest.approx(math.exp(1.8)), 0.0)
    assert Envelope(2.0, 0.0).area(3.0) == 6.0
    assert convergence_rates(error[None], 2.0, PERIOD) == 0.0


def test_the_envelope_holds_and_no_other_of_many_has_less_area():
    rng = np.random.default_rng(0)
    for _ in range(40):
        error = np.exp(np.cumsum(rng.normal(-0.05, 0.3, len(TIMES))))
        error /= error[0]
        found = tightest_envelope(error, PERIOD)
        bound = found.overshoot * np.exp(-found.rate * TIMES)
        assert np.all(error <= bound * (1.0 + 1e-9))
        rates = np.linspace(1e-3, 10.0, 4000)
        overshoots = np.max(error * np.exp(np.outer(rates, TIMES)), axis=1)
        areas = overshoots * (1.0 - np.exp(-rates * TIMES[-1])) / rates
        assert found.area(TIMES[-1]) <= areas.min() * (1.0 + 1e-9)
        (rate,) = convergence_rates(error[None], found.overshoot, PERIOD)
        assert rate == pytest.approx(found.rate, abs=1e-6)


@pytest.mark.parametrize("error", [[1.0], [1.0, math.inf], [1.0, math.nan]])
def test_what_has_no_envelope_is_said(error):
    with pytest.raises(ValueError, match="finite at two instants"):
        tightest_envelope(np.array(error), PERIOD)


@pytest.mark.parametrize("name", BODIES)
def test_errors_at_the_start_are_paired_and_grow_with_their_share(name):
    task = task_named(name)
    scale = np.array(task.state_scale or (1.0,) * task.system.state_dim)
    whole = 0
    for seed in episode_seeds(0, 20):
        scenario = task.sample(episode_streams(seed).scenario)
        small, large = (initial_error(task, scenario, seed, share) for share in (0.02, 0.04))
        np.testing.assert_array_equal(small, initial_error(task, scenario, seed, 0.02))
        assert np.all(np.abs(small) <= 0.02 * scale)
        # Halved where the body would have fallen.
        factor = 2.0 if not np.allclose(large, small, rtol=1e-12) else 1.0
        np.testing.assert_allclose(large, factor * small, rtol=1e-12)
        whole += factor == 2.0
    assert whole >= 18


def test_an_error_never_puts_the_body_on_a_disc_or_beyond_its_limits():
    task = toys.Slide()
    halved = 0
    for seed in range(60):
        scenario = task.sample(np.random.default_rng(seed))
        error = initial_error(task, scenario, seed, 4.0)
        halved += not np.any(np.abs(error) > 2.0)
        state = scenario.initial_state + error
        assert abs(state[1]) <= 3.0
        away = np.linalg.norm(scenario.discs[:, :2] - state[:2], axis=1)
        assert np.all(away > scenario.discs[:, 2] + task.body_radius)
    assert 0 < halved < 60


def test_an_episode_begins_beside_what_is_told():
    task = toys.Slide()
    error = np.array([0.1, -0.2, 0.3, 0.0])
    env = TaskEnv("uniform", 0.1, task=task)
    plain, _ = env.reset(seed=5)
    told, start = env.scenario.initial_state, env.state
    seen, _ = env.reset(seed=5, options={"initial_error": error})
    np.testing.assert_array_equal(env.state, start + error)
    np.testing.assert_array_equal(env.scenario.initial_state, told)
    layout = task.layout
    np.testing.assert_array_equal(seen[layout.initial_state], plain[layout.initial_state])
    np.testing.assert_allclose(seen[layout.state] - plain[layout.state], error, rtol=1e-6)
    worlds = TaskVectorEnv(2, "uniform", 0.1, task=task, compiled=False)
    rows, _ = worlds.reset(seed=[5, 5], options={"initial_error": [error, 0.0 * error]})
    np.testing.assert_array_equal(rows, [seen, plain])
    action = np.float32([0.3, -0.2])
    moved = env.step(action)[0]
    np.testing.assert_array_equal(worlds.step(np.array([action, action]))[0][0], moved)
    with pytest.raises(ValueError, match=r"options\['initial_error'\] has shape \(2,\)"):
        env.reset(seed=5, options={"initial_error": [0.0, 0.0]})


def test_a_run_holds_all_policies_against_one_plan_and_one_error():
    settings = BenchmarkSettings(
        policies=("steady", "timid"), episodes=6, initial_error=0.1, chunk=4
    )
    run = run_benchmark(settings, fakes.EASY)
    first, second = run.episodes.values()
    for one, other, plan in zip(first, second, run.plans, strict=True):
        assert one.tracking_error[0] == other.tracking_error[0] > 0.0
        np.testing.assert_allclose(one.tracking_error[0], np.linalg.norm(plan.initial_error))
        assert one.left_paper_tube is None
    rows = summarise(run, ["here"])
    for row, records in zip(rows, run.episodes.values(), strict=True):
        errors = np.array([record.tracking_error for record in records])
        normalised = errors / errors[:, :1]
        areas = np.trapezoid(normalised, dx=0.1, axis=1)
        assert row["normalised_area_mean"] == pytest.approx(areas.mean())
        assert row["overshoot_mean"] == pytest.approx(normalised.max(axis=1).mean())
        assert row["envelope_overshoot"] >= normalised.max() * (1.0 - 1e-9)
        area = np.trapezoid(errors, dx=0.1, axis=1).mean()
        assert row["error_area_mean"] == pytest.approx(area)
        assert row["tube_violation_rate"] is None
    shown = " ".join(str(column.header) for column in terminal_table(rows).columns)
    assert "area" in shown
    assert "λ the mean" in legend(rows)
    versus = rows[0]["versus"]["timid"]
    areas, peaks = (
        np.array([[measure(r.tracking_error) for r in records] for records in (first, second)])
        for measure in (np.trapezoid, np.max)
    )
    assert versus["error_area_ratio"] == pytest.approx(np.median(areas[0] / areas[1]))
    assert versus["overshoot_ratio"] == pytest.approx(np.median(peaks[0] / peaks[1]))
    assert versus["overshoot_ratio_ci95"].low <= versus["overshoot_ratio"]


def test_on_the_plan_there_is_an_area_and_nothing_normalised():
    run = run_benchmark(BenchmarkSettings(policies=("steady",), episodes=3), fakes.EASY)
    (row,) = summarise(run, ["here"])
    assert row["error_area_mean"] > 0.0
    for name in ("normalised_area_mean", "overshoot_mean", "envelope_overshoot"):
        assert name not in row


def test_an_episode_that_ends_early_goes_on_with_its_largest_error():
    env = TaskEnv(task="cartpole")
    still = np.zeros((91, 4))
    record = run_episode(env, fakes.IdlePolicy(), 3, still, initial_error=np.full(4, 0.1))
    assert record.fallen
    assert record.beside_plan
    settings = BenchmarkSettings(policies=("idle",), episodes=4, initial_error=0.1)
    run = run_benchmark(settings, fakes.EASY)
    (row,) = summarise(run, ["here"])
    (records,) = run.episodes.values()
    least = [
        np.nanmax(one.tracking_error)
        / one.tracking_error[0]
        * 0.1
        * np.sum(np.isnan(one.tracking_error))
        for one in records
    ]
    assert row["normalised_area_mean"] >= np.mean(least)


def test_what_makes_no_sense_beside_a_plan_is_refused():
    with pytest.raises(ValueError, match="episodes that begin on their plan"):
        BenchmarkSettings(guarantee=True, initial_error=0.1)
    with pytest.raises(ValueError, match="initial_error=-1"):
        BenchmarkSettings(initial_error=-1.0)
    with pytest.raises(ValueError, match=r"initial_error=0\.1 is for one body"):
        BenchmarkSettings.for_task("spacecraft", initial_error=0.1)


def test_the_interval_of_a_median_ratio_is_that_of_order_statistics():
    rng = np.random.default_rng(1)
    for count in (6, 7, 20, 200):
        above, below = rng.exponential(size=(2, count))
        found = median_ratio(above, below)
        ratios = above / below
        test = stats.quantile_test(ratios, q=1.0, p=0.5)
        expected = test.confidence_interval(0.95)
        assert found.ratio == pytest.approx(np.median(ratios))
        np.testing.assert_allclose(found.interval, [expected.low, expected.high])
    assert median_ratio([1.0, math.nan], [2.0, 1.0]) == (0.5, None, 1)
    assert median_ratio([1.0], [math.nan]) is None
