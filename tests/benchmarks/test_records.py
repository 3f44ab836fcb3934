"""The rows of a run: the public keys, and figures that can be counted from the episodes."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from lagros_benchmarks.report.records import episode_objects, summarise
from lagros_benchmarks.run.files import json_lines_text, plain, write_atomic, write_json
from lagros_benchmarks.run.runner import Case, run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from tests.benchmarks import fakes

# What a row of results is made of; a name that goes breaks who reads the JSON.
PUBLIC_KEYS = (
    *("task", "policy", "disturbance", "bound", "episodes", "safety_filter"),
    *("success_rate", "success_ci95", "strict_success_rate", "collision_rate"),
    *("effort_mean", "effort_ci95", "tube_violation_rate", "certified_violation_rate"),
    *("step_time_median_s", "step_time_p99_s", "step_time_max_s", "deadline_misses"),
)
POLICIES = ("steady", "timid", "idle", "raising")


@pytest.fixture(scope="module")
def run():
    return run_benchmark(BenchmarkSettings(policies=POLICIES, episodes=40), fakes.TOOLBOX)


@pytest.fixture(scope="module")
def rows(run):
    return summarise(run, ["lagros", "bench", "two words"])


def records_of(run, policy):
    return run.episodes[Case(policy, run.settings.conditions[0])]


def test_the_public_keys_are_there(rows):
    assert [row["policy"] for row in rows] == list(POLICIES)
    for row in rows:
        assert not set(PUBLIC_KEYS) - set(row)
        assert row["collision_rate"] == 0.0
        assert row["safety_filter"] is False
        assert row["command"] == "lagros bench 'two words'"
        assert row["versions"]["numpy"] == np.__version__
        assert row["machine"]["cpu_count"] >= 1
        assert set(row["threads"]) >= {"OMP_NUM_THREADS", "jobs"}


def test_the_rates_are_counts_of_episodes(run, rows):
    for row in rows:
        records = records_of(run, row["policy"])
        assert row["success_rate"] == sum(r.success for r in records) / 40
        assert row["strict_success_rate"] == sum(r.strict_success for r in records) / 40
        assert row["fall_rate"] == sum(r.fallen for r in records) / 40
        assert row["tube_violation_rate"] == sum(r.left_paper_tube for r in records) / 40
        low, high = row["success_ci95"]
        assert low - 1e-12 <= row["success_rate"] <= high + 1e-12


def test_errors_are_listed_and_have_no_effort(run, rows):
    row = rows[POLICIES.index("raising")]
    records = records_of(run, "raising")
    raised = [record for record in records if record.error is not None]
    assert row["errors"] == [{"seed": r.seed, "text": r.error} for r in raised]
    assert row["effort_episodes"] == 40 - len(raised)
    assert row["effort_mean"] == pytest.approx(
        np.mean([r.effort for r in records if r.error is None])
    )
    assert row["tracking_error_mean_below_tube"] is False


def test_counters_are_summed(rows):
    assert rows[0]["counters"] == {"calls": 40 * 90, "episodes": 40, "failures": 0}
    assert rows[POLICIES.index("idle")]["counters"] == {}


def test_the_mean_error_counts_falls_with_their_largest_error(run, rows):
    for row in rows:
        curves = []
        for record in records_of(run, row["policy"]):
            if record.max_tracking_error is None:
                continue
            curve, worst = [], 0.0
            for error in record.tracking_error:
                worst = worst if math.isnan(error) else max(worst, error)
                curve.append(worst if math.isnan(error) else error)
            curves.append(curve)
        assert row["tracking_episodes"] == len(curves) == 40 - row["plans_failed"]
        assert row["mean_tracking_error"] == pytest.approx(np.mean(curves, axis=0), abs=1e-6)
        assert np.all(np.array(row["tracking_error_p10"]) <= row["tracking_error_p90"])


def test_the_mean_is_below_the_tube_only_if_it_is_at_every_instant(run, rows):
    for row in rows:
        below = np.array(row["mean_tracking_error"]) <= np.array(row["paper_tube"]) + 1e-6
        assert row["tracking_error_mean_below_tube"] == (bool(below.all()) and not row["errors"])


def test_comparisons_are_paired(run, rows):
    ours, theirs = records_of(run, "timid"), records_of(run, "steady")
    versus = rows[1]["versus"]["steady"]
    both = [
        (a.effort, b.effort) for a, b in zip(ours, theirs, strict=True) if a.success and b.success
    ]
    assert versus["episodes_both_solve"] == len(both)
    assert versus["effort_ratio"] == pytest.approx(np.divide(*np.mean(both, axis=0)))
    assert versus["success_difference"] == pytest.approx(
        rows[1]["success_rate"] - rows[0]["success_rate"]
    )
    assert set(rows[1]["versus"]) == set(POLICIES) - {"timid"}


def test_the_bare_network_is_timed_where_there_is_one(rows):
    assert 0.0 < rows[0]["forward_time_median_s"] < 1e-3
    assert rows[2]["forward_time_median_s"] is None


def test_the_json_is_strict_and_reads_back(rows, tmp_path):
    path = write_json(tmp_path / "deep" / "results.json", rows)
    read = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert read == plain(rows)
    # A curve keeps to one line.
    assert len(path.read_text().splitlines()) < 160 * len(rows)


def test_every_episode_is_a_line(run, tmp_path):
    path = write_atomic(tmp_path / "episodes.jsonl", json_lines_text(episode_objects(run)))
    lines = [json.loads(line, parse_constant=pytest.fail) for line in path.read_text().splitlines()]
    assert len(lines) == 4 * 40
    assert [line["seed"] for line in lines[:40]] == run.settings.episode_seeds()
    assert len(lines[0]["tracking_error"]) == 91
    assert lines[0]["step_time_median_s"] > 0.0


def test_no_plan_at_all_leaves_the_curves_empty():
    class Hopeless(fakes.StraightPlanner):
        def plan(self, initial_state, goal):
            raise RuntimeError("never")

    toolbox = fakes.Toolbox(fakes.make_policy, Hopeless, fakes.load_metric)
    settings = BenchmarkSettings(policies=("steady",), episodes=3)
    (row,) = summarise(run_benchmark(settings, toolbox))
    assert row["plans_failed"] == 3
    assert row["tube_violation_rate"] == 1.0
    assert row["certified_violation_rate"] is None
    assert row["mean_tracking_error"] is None
    assert row["tracking_error_mean_below_tube"] is False
    assert row["success_rate"] > 0.0


def test_all_that_a_policy_counts_is_written(run, rows):
    timed = {
        case: [dataclasses.replace(one, timed_counters={"late_plans": 2}) for one in records]
        for case, records in run.episodes.items()
    }
    late = dataclasses.replace(run, episodes=timed)
    for row, before in zip(summarise(late, ["here"]), rows, strict=True):
        expected = {**before["counters"], "late_plans": 2 * before["episodes"]}
        assert row["counters"] == expected
    assert all(one["counters"]["late_plans"] == 2 for one in episode_objects(late))
    assert not any("timed_counters" in one for one in episode_objects(late))
