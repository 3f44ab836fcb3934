"""Rows of a spacecraft run, against counts of worlds that are written down by hand."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from lagros_benchmarks.report.records import episode_objects, summarise
from lagros_benchmarks.run.files import json_lines_text, write_atomic, write_json
from lagros_benchmarks.run.metrics import wilson_interval
from lagros_benchmarks.run.runner import Case, run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings, Condition
from lagros_benchmarks.tasks.spacecraft import records
from lagros_benchmarks.tasks.spacecraft.episodes import AgentRecord, WorldRecord
from lagros_benchmarks.tasks.spacecraft.experiment import SpacecraftRun
from lagros_benchmarks.tasks.spacecraft.timing import Timing
from tests.benchmarks import spacecraft_fakes as fakes

# What a row of results is made of; a name that goes breaks who reads the JSON.
PUBLIC_KEYS = (
    *("task", "policy", "disturbance", "bound", "episodes", "safety_filter", "agents", "preset"),
    *("success_rate", "success_ci95", "success_world_ci95", "strict_success_rate"),
    *("collision_rate", "effort_mean", "effort_ci95", "paper_success_rate"),
    *("tube_violation_rate", "certified_violation_rate", "counters", "errors", "versus"),
    *("step_time_median_s", "step_time_p99_s", "step_time_max_s", "deadline_misses"),
    *("step_time_batch_per_agent_s", "plan_time_median_s", "plan_time_p99_s"),
    *("machine", "versions", "command"),
)
UNIFORM = Condition("uniform", 0.4)


def agent(success=True, effort=1.0, **changes):
    values = {
        "success": success,
        "success_time": 10.0 if success else None,
        "strict_success": success,
        "reached": success,
        "paper_success": success,
        "collided": not success,
        "collision_time": None if success else 5.0,
        "effort": effort,
        "effort_total": 2.0 * effort,
        "goal_distance": 0.1,
        "left_paper_tube": None,
        "left_certified_tube": None,
        "max_position_error": None,
    }
    return AgentRecord(**(values | changes))


def world(seed, *agents, planned=None, error=None):
    return WorldRecord(seed, planned, error, agents)


OURS = (
    world(1, agent(effort=1.0), agent(effort=2.0)),
    world(2, agent(effort=4.0), agent(False, effort=8.0)),
    world(3, agent(effort=3.0), agent(False, 9.0), error="ValueError: no"),
)
THEIRS = (
    world(1, agent(effort=2.0), agent(False, effort=1.0)),
    world(2, agent(effort=2.0), agent(effort=1.0)),
    world(3, agent(False, 5.0), agent(False, 5.0)),
)
PLANNED = (
    world(
        1,
        *(agent(left_paper_tube=True, left_certified_tube=False, max_position_error=0.2),) * 2,
        planned=True,
    ),
    world(
        2,
        *(agent(left_paper_tube=False, left_certified_tube=False, max_position_error=0.1),) * 2,
        planned=True,
    ),
    world(
        3,
        *(agent(False, left_paper_tube=True, left_certified_tube=True, max_position_error=0.4),)
        * 2,
        planned=False,
    ),
)


@pytest.fixture(scope="module")
def rows():
    settings = BenchmarkSettings.for_task(
        "spacecraft",
        policies=("ours", "theirs", "joint"),
        episodes=3,
        bounds=(0.4,),
        agents=(2,),
        safety_filter="both",
    )
    local = Timing(np.array([0.01, 0.02, 0.3]), np.array([0.02, 0.04, 0.06]), np.array([]), 2, 0)
    joint = Timing(np.array([0.01, 0.03]), np.array([0.5, 0.01, 0.03]), np.array([0.5, 1.5]), 2, 0)
    worlds = {"ours": OURS, "theirs": THEIRS, "joint": PLANNED}
    episodes = {case: worlds[case.policy] for case in settings.cases}
    # The filter turns our second world into a success.
    filtered = Case("ours", UNIFORM, True, 2)
    episodes[filtered] = (OURS[0], world(2, agent(effort=4.0), agent(effort=8.0)), OURS[2])
    run = SpacecraftRun(
        settings=settings,
        episodes=episodes,
        timing={case: [joint if case.policy == "joint" else local] for case in settings.cases},
        control_period=0.1,
        counters={case: {"plans": 3} for case in settings.cases},
    )
    return summarise(run, ["lagros", "bench"])


def row_of(rows, policy, filtered=False):
    return next(r for r in rows if r["policy"] == policy and r["safety_filter"] is filtered)


def test_the_public_keys_are_there(rows):
    assert len(rows) == 6
    for row in rows:
        assert not set(PUBLIC_KEYS) - set(row)
        assert (row["task"], row["preset"], row["agents"]) == ("spacecraft", "paper", 2)
        assert row["command"] == "lagros bench"
        assert row["counters"] == {"plans": 3}


def test_the_rates_are_counts_of_agents(rows):
    row = row_of(rows, "ours")
    assert row["success_rate"] == row["strict_success_rate"] == 4 / 6
    assert row["paper_success_rate"] == 4 / 6
    assert row["collision_rate"] == 2 / 6
    assert row["world_success_rate"] == 1 / 3
    assert row["success_ci95"] == wilson_interval(4, 6)
    low, high = row["success_world_ci95"]
    assert low <= 4 / 6 <= high
    # Resampled worlds have two, one or one successes of two agents.
    assert (low, high) == (0.5, 1.0)


def test_the_effort_is_that_of_all_agents_whose_flight_is_known(rows):
    row = row_of(rows, "ours")
    # Not the agent that had not arrived when its world raised; its neighbour had.
    assert row["effort_agents"] == 5
    assert row["effort_mean"] == pytest.approx((1 + 2 + 4 + 8 + 3) / 5)
    assert row["effort_of_successes_mean"] == pytest.approx((1 + 2 + 4 + 3) / 4)
    assert row["effort_total_mean"] == pytest.approx((2 + 4 + 8 + 16) / 4)
    assert row["errors"] == [{"seed": 3, "text": "ValueError: no"}]
    low, high = row["effort_ci95"]
    assert low < row["effort_mean"] < high


def test_policies_are_compared_on_the_same_agents(rows):
    versus = row_of(rows, "ours")["versus"]["theirs"]
    # Only ours: two agents; only theirs: one; both solve the first of the first two worlds.
    assert versus["success_difference"] == pytest.approx((2 - 1) / 6)
    assert versus["agents_both_solve"] == 2
    assert versus["effort_ratio"] == pytest.approx((1.0 + 4.0) / (2.0 + 2.0))
    low, high = versus["effort_ratio_ci95"]
    assert (low, high) == (0.5, 2.0)
    mirrored = row_of(rows, "theirs")["versus"]["ours"]
    assert mirrored["success_difference"] == -versus["success_difference"]
    assert mirrored["effort_ratio"] == pytest.approx(1.0 / versus["effort_ratio"])
    # Filtered rows are compared with filtered ones.
    assert row_of(rows, "ours", True)["versus"]["theirs"]["success_difference"] == pytest.approx(
        2 / 6
    )
    assert set(row_of(rows, "joint")["versus"]) == {"ours", "theirs"}


def test_the_filter_is_compared_with_the_bare_policy(rows):
    assert row_of(rows, "ours")["filter_effect"] is None
    effect = row_of(rows, "ours", True)["filter_effect"]
    assert effect["success_difference"] == pytest.approx(1 / 6)
    assert effect["effort_ratio"] == pytest.approx(1.0)
    assert row_of(rows, "joint", True)["filter_effect"]["success_difference"] == 0.0


def test_tubes_are_those_of_policies_with_a_plan(rows):
    row = row_of(rows, "joint")
    assert row["tube_violation_rate"] == 4 / 6
    assert row["certified_violation_rate"] == 2 / 6
    assert row["plan_rate"] == 2 / 3
    assert row["success_rate_where_planned"] == 1.0
    assert row["position_error_max_median"] == pytest.approx(0.2)
    other = row_of(rows, "ours")
    for name in ("tube_violation_rate", "certified_violation_rate", "plan_rate"):
        assert other[name] is None


def test_the_times_are_those_of_one_agent_or_of_the_plan(rows):
    row = row_of(rows, "ours")
    assert row["step_time_median_s"] == 0.02
    assert row["step_time_max_s"] == 0.3
    assert row["step_time_batch_per_agent_s"] == 0.02
    assert row["deadline_misses"] == pytest.approx(1 / 3)
    assert row["plan_time_median_s"] is None
    assert row["step_time_of"] == "one agent"
    row = row_of(rows, "joint")
    assert row["plan_time_median_s"] == 1.0
    assert row["plan_time_max_s"] == 1.5
    assert row["step_time_median_s"] == 0.02
    assert row["step_time_of"] == "all agents"
    # Of the calls of the timed worlds one is late: their plan.
    assert row["deadline_misses"] == pytest.approx(1 / 3)


@pytest.fixture(scope="module")
def flown():
    settings = BenchmarkSettings.for_task(
        "spacecraft",
        policies=("spring", "joint"),
        episodes=4,
        bounds=(0.4,),
        agents=(2,),
        timing_episodes=1,
    )
    return run_benchmark(settings, fakes.TOOLBOX)


def test_a_run_becomes_json_and_lines(flown, tmp_path):
    rows = summarise(flown)
    path = write_json(tmp_path / "rows.json", rows)
    read = json.loads(path.read_text())
    assert [(r["policy"], r["safety_filter"]) for r in read] == [
        ("spring", False),
        ("joint", False),
        ("spring", True),
        ("joint", True),
    ]
    path = write_atomic(tmp_path / "agents.jsonl", json_lines_text(episode_objects(flown)))
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert len(lines) == 4 * 4 * 2
    for row in read:
        own = [
            line
            for line in lines
            if (line["policy"], line["safety_filter"]) == (row["policy"], row["safety_filter"])
        ]
        assert row["success_rate"] == np.mean([line["success"] for line in own])
        assert row["effort_mean"] == pytest.approx(np.mean([line["effort"] for line in own]))
        assert {line["agent"] for line in own} == {0, 1}


def test_one_world_has_no_interval_over_worlds_but_that_over_agents(flown):
    one = dataclasses.replace(
        flown,
        episodes={case: worlds[:1] for case, worlds in flown.episodes.items()},
    )
    for row in summarise(one):
        assert row["effort_ci95"] is None
        low, high = row["success_world_ci95"]
        assert low <= row["success_rate"] <= high
        assert not math.isnan(low)


def test_what_is_proved_of_worlds_is_counted_and_held_against_the_flights():
    def proved(seed, error, **changes):
        part = agent(max_position_error=error)
        said = {"guaranteed": True, "arriving": True, "position_error_bound": 0.2}
        return dataclasses.replace(world(seed, part, part, planned=True), **(said | changes))

    sound = (
        proved(1, 0.1),
        proved(2, 0.16, arriving=False),
        proved(3, 0.1, guaranteed=False, arriving=False, position_error_bound=None),
    )
    row = records._guarantees(sound)
    assert row["guaranteed_rate"] == pytest.approx(2 / 3)
    assert row["guaranteed_arriving_rate"] == pytest.approx(1 / 3)
    assert row["guaranteed_ci95"] == wilson_interval(2, 3)
    assert row["bound_over_worst"] == pytest.approx(0.2 / 0.16)
    assert row["guarantees_contradicted"] == 0
    crash = dataclasses.replace(proved(4, 0.1), agents=(agent(False, max_position_error=0.1),))
    wrong = (proved(5, 0.3), crash)
    assert records._guarantees(wrong)["guarantees_contradicted"] == 2
    # The proved filter bounds no error to a plan that flies behind it.
    only = records._guarantees((proved(6, 0.1, arriving=False, position_error_bound=None),))
    assert (only["guaranteed_rate"], only["bound_over_worst"]) == (1.0, None)
    # No statement is about a policy that tracks no plan.
    assert set(records._guarantees(OURS).values()) == {None}


def test_efforts_are_compared_over_the_same_time_too():
    versus = records.comparison(OURS, THEIRS)
    # Not of the third world, in which ours raised.
    assert versus["effort_total_ratio"] == pytest.approx((2 + 4 + 8 + 16) / (4 + 2 + 4 + 2))
