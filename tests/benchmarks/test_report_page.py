"""`lagros bench --html` and `lagros watch --html`: what stands in the page, without a browser."""

from __future__ import annotations

import itertools
import json
import random
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.report import tables
from lagros_benchmarks.report.page import assemble, worthy
from lagros_benchmarks.report.page.packed import packed, unpacked
from lagros_benchmarks.report.page.reels import box_of, joined, kept_instants
from lagros_benchmarks.report.page.single import SingleReels
from lagros_benchmarks.report.page.worthy import FAILURE, MEDIAN, WORST, Merit
from lagros_benchmarks.report.records import summarise
from lagros_benchmarks.run.files import json_text
from lagros_benchmarks.run.room import room_named
from lagros_benchmarks.run.runner import run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_envs.env import TaskEnv
from lagros_envs.registry import find_task, task_named, task_names
from tests.benchmarks import fakes, spacecraft_fakes
from tests.found import SINGLE_BODY, named, task_of

SINGLE = [name for name in task_names() if task_named(name).most_agents == 1]
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>&amp;\"'"


def data_of(page):
    """What the page's own scripts read."""
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    return json.loads(text)


@pytest.fixture(scope="module")
def run():
    settings = BenchmarkSettings(
        policies=("steady", "idle", "raising"),
        episodes=9,
        disturbances=("none", "uniform"),
        bounds=(0.3, 0.75),
    )
    return run_benchmark(settings, fakes.TOOLBOX)


@pytest.fixture(scope="module")
def rows(run):
    return json.loads(json_text(summarise(run)))


@pytest.fixture(scope="module")
def page(run, rows):
    return assemble.bench_page(run, rows, toolbox=fakes.TOOLBOX)


def test_the_numbers_of_the_page_are_those_of_the_rows(page, rows):
    data = data_of(page)
    assert len(data["rows"]) == len(rows) == 9
    columns = tables.texts(rows[0]).columns(rows[0])
    for shown, row in zip(data["rows"], rows, strict=True):
        condition = data["conditions"][shown["condition"]]
        assert (condition["kind"], condition["bound"]) == (row["disturbance"], row["bound"])
        assert data["series"][shown["series"]]["name"] == row["policy"]
        assert shown["cells"] == [cell(row).strip() for _, _, cell in columns]
        assert shown["figures"].items() <= row.items()
        assert {"success_rate", "success_ci95", "effort_mean", "mean_tracking_error"} <= (
            shown["figures"].keys()
        )
    assert data["command"] == rows[0]["command"]


def test_each_episode_of_the_page_is_the_one_of_its_record(page, run):
    data = data_of(page)
    assert data["episodes"]
    for one in data["episodes"]:
        condition = data["conditions"][one["condition"]]
        found = {
            case.policy: records[one["index"]]
            for case, records in run.episodes.items()
            if tuple(case.condition) == (condition["kind"], condition["bound"])
        }
        # Everybody flew it, so that any two can stand side by side.
        names = [data["series"][int(series)]["name"] for series in one["flights"]]
        assert names == list(found)
        for name, flight in zip(names, one["flights"].values(), strict=True):
            record = found[name]
            assert int(one["seed"]) == record.seed
            assert flight["as_recorded"]
            assert (flight["ending"] is None) == record.success
            assert flight["error"] == record.error
            assert ("success at" in flight["text"]) == record.success
            if record.fallen:
                assert flight["ending"]["label"] == "fallen"
            errors = record.tracking_error[np.isfinite(record.tracking_error)]
            if len(errors):
                # A 16-bit number is off by half a step of the span.
                shown = unpacked(flight["measures"]["error"])
                np.testing.assert_allclose(shown, errors, atol=1e-4 * errors.max())


def test_the_states_of_the_page_are_those_of_the_environment(page, run):
    data = data_of(page)
    steady = next(k for k, one in enumerate(data["series"]) if one["name"] == "steady")
    for one in data["episodes"][:3]:
        condition = data["conditions"][one["condition"]]
        env = TaskEnv(condition["kind"], condition["bound"], task=run.task)
        policy, over = fakes.LinearPolicy(), False
        observation, _ = env.reset(seed=int(one["seed"]))
        states = [env.state]
        while not over:
            action, _ = policy.predict(observation)
            observation, _, fallen, late, _ = env.step(action)
            states.append(env.state)
            over = fallen or late
        flight = one["flights"][str(steady)]
        shown = unpacked(flight["parts"]["states"])
        np.testing.assert_allclose(shown, states, atol=1e-4 * np.abs(states).max())
        corners = unpacked(flight["parts"]["polygons"])
        assert corners.shape[1] == sum(data["corners"])
        for state, drawn in zip(states, corners, strict=True):
            expected = np.concatenate(run.task.outline(state))
            np.testing.assert_allclose(drawn, expected, atol=2e-3)


def test_the_tube_of_the_picture_is_the_published_one(page, run):
    for one in data_of(page)["episodes"]:
        plan = one["scene"]["plan"]
        if plan is None:
            continue
        # It reaches along the rail, and not above it.
        np.testing.assert_allclose(
            unpacked(plan["spread"]), [[1.0, 0.0]] * (fakes.STEPS + 1), atol=1e-4
        )
        for flight in one["flights"].values():
            times = unpacked(flight["times"])
            tube = unpacked(flight["measures"]["tube"])
            np.testing.assert_allclose(tube, run.task.tube_radius(times), atol=1e-3)


@pytest.mark.parametrize("task", SINGLE)
def test_every_task_of_one_body_has_a_page(task):
    settings = BenchmarkSettings.for_task(task, policies=("lqr", "random"), episodes=2)
    done = run_benchmark(settings)
    data = data_of(assemble.bench_page(done, summarise(done)))
    described = task_named(task)
    assert len(data["states"]) == described.system.state_dim
    assert data["speed"] == described.defaults.speed
    for one in data["episodes"]:
        for flight in one["flights"].values():
            assert flight["as_recorded"]
            states = unpacked(flight["parts"]["states"])
            assert states.shape[1] == described.system.state_dim
            assert np.isfinite(states).all()
            places = unpacked(flight["parts"]["places"])[:, 0, :2]
            at = np.array([described.place(state) for state in states])
            inside = np.abs(states).max(axis=-1) < 50.0
            np.testing.assert_allclose(places[inside], at[inside], atol=0.05)
            assert unpacked(flight["parts"]["push"]).shape[:2] == (len(states), 1)


def test_worlds_of_agents_have_a_page():
    settings = BenchmarkSettings.for_task(
        "spacecraft",
        policies=("spring", "joint", "raising"),
        episodes=3,
        agents=(2,),
        bounds=(0.3,),
        preset="open",
        safety_filter="none",
        timing_episodes=1,
    )
    done = run_benchmark(settings, spacecraft_fakes.TOOLBOX)
    rows = summarise(done)
    data = data_of(assemble.bench_page(done, rows, toolbox=spacecraft_fakes.TOOLBOX))
    (condition,) = data["conditions"]
    assert condition["agents"] == "2 agents"
    for one in data["episodes"]:
        assert len(one["scene"]["goals"]) == 2
        for series, flight in one["flights"].items():
            name = data["series"][int(series)]["name"]
            case = next(case for case in settings.cases if case.policy == name)
            world = done.episodes[case][one["index"]]
            assert flight["as_recorded"]
            assert flight["error"] == world.error
            collided = [event["body"] for event in flight["events"] if event["kind"] == "collision"]
            expected = [k for k, agent in enumerate(world.agents) if agent.collided]
            assert sorted(collided) == expected
            assert (flight["ending"] is None) == all(agent.success for agent in world.agents)
            places = unpacked(flight["parts"]["places"])
            assert places.shape[1:] == (2, 3)
            if world.error is None:
                goals = np.array(one["scene"]["goals"])[:, :2]
                off = np.linalg.norm(places[-1, :, :2] - goals, axis=-1)
                found = [agent.goal_distance for agent in world.agents]
                np.testing.assert_allclose(off, found, atol=1e-2)
            assert ("plan" in flight) == (name == "joint")


def test_who_flies_otherwise_the_second_time_is_said_so(run):
    calls = itertools.count()

    class Fickle(fakes.LinearPolicy):
        def __init__(self):
            super().__init__(scale=1.0 if next(calls) % 2 else 0.0)

    settings = BenchmarkSettings(policies=("steady",), episodes=2)
    toolbox = fakes.Toolbox(
        lambda name, env, given: Fickle() if name == "fickle" else fakes.make_policy(name, env, {}),
        fakes.easy_planner,
    )
    done = run_benchmark(settings, toolbox)
    ((case, records),) = done.episodes.items()
    (same, other) = (
        SingleReels.fly(settings, toolbox, case._replace(policy=name), done.plans, records)
        for name in ("steady", "fickle")
    )
    assert all(reel.flight["as_recorded"] for reel in same)
    assert not all(reel.flight["as_recorded"] for reel in other)


def test_names_and_errors_are_text_and_never_tags():
    class Hostile(fakes.LinearPolicy):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            raise ValueError(HOSTILE)

    settings = BenchmarkSettings(policies=("steady",), episodes=2)
    done = run_benchmark(settings, fakes.EASY, policies={HOSTILE: Hostile()})
    toolbox = fakes.Toolbox(
        lambda name, env, given: (
            Hostile() if name == HOSTILE else fakes.make_policy(name, env, given)
        ),
        fakes.easy_planner,
    )
    page = assemble.bench_page(done, summarise(done, ["lagros", HOSTILE]), toolbox=toolbox)
    found = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag, attrs):
            found.append(tag)

    Reader().feed(page)
    assert found.count("script") == 2
    assert "img" not in found
    data = data_of(page)
    assert HOSTILE in data["command"]
    assert data["series"][1]["name"] == HOSTILE
    assert HOSTILE in data["episodes"][0]["flights"]["1"]["error"]


def test_the_page_asks_nobody_for_anything(page):
    assert "default-src 'none'" in page
    page = page.replace("http://www.w3.org/2000/svg", "")  # the name of a namespace is no address
    for word in ("http://", "https://", "src=", "@import", "url(", "fetch(", "XMLHttp"):
        assert word not in page


def test_a_page_has_as_many_episodes_as_fit(run, rows, page, monkeypatch):
    whole = data_of(page)["episodes"]
    bare = len(page.encode()) - sum(len(assemble.json_in_script(one)) + 1 for one in whole)
    for room in (0, 10_000, 200_000):
        monkeypatch.setattr(assemble, "LARGEST", bare + room)
        small = assemble.bench_page(run, rows, toolbox=fakes.TOOLBOX)
        kept = data_of(small)["episodes"]
        assert len(small.encode()) <= bare + room or not kept
        assert kept == whole[: len(kept)]
    assert 0 < len(kept) <= len(whole)


@pytest.mark.slow
def test_a_thousand_episodes_stay_below_five_megabytes():
    settings = BenchmarkSettings(policies=("steady", "timid", "idle"), episodes=1000)
    done = run_benchmark(settings, fakes.EASY)
    page = assemble.bench_page(done, summarise(done), toolbox=fakes.EASY)
    assert len(page.encode()) < 5_000_000
    assert len(data_of(page)["episodes"]) >= 3


# What is worth watching.


def merits(generator, count):
    return [Merit(generator.random() < 0.2, generator.random()) for _ in range(count)]


@pytest.mark.parametrize("seed", range(20))
def test_what_is_kept_is_what_failed_what_was_worst_and_what_is_usual(seed):
    generator = random.Random(seed)
    groups = [
        {f"policy {k}": merits(generator, 30) for k in range(generator.randint(1, 4))}
        for _ in range(generator.randint(1, 3))
    ]
    picks = worthy.worthy(groups, 1000)
    assert len({pick[:2] for pick in picks}) == len(picks)
    for pick in picks:
        assert pick.why
        for name, reason in pick.why:
            failed, badness = groups[pick.group][name][pick.episode]
            rest = sorted(m.badness for m in groups[pick.group][name] if not m.failed)
            if reason == FAILURE:
                assert failed
            else:
                expected = {WORST: rest[-1], MEDIAN: rest[(len(rest) - 1) // 2]}[reason]
                assert not failed
                assert badness == expected
    for group, every in enumerate(groups):
        kept = {pick.episode for pick in picks if pick.group == group}
        for one in every.values():
            failures = [index for index, merit in enumerate(one) if merit.failed]
            assert set(failures[:1]) <= kept
    # The fewer are kept, the first of the same ones.
    for most in (1, 2, 5):
        assert worthy.worthy(groups, most) == picks[:most]
    assert {pick.group for pick in picks[: len(groups)]} == set(range(len(groups)))


@pytest.mark.parametrize("failed", [True, False])
def test_policies_that_always_fail_or_never_do_are_kept_too(failed):
    one = [Merit(failed, float(k)) for k in range(7)]
    found = worthy.ranked(one)
    expected = [(0, FAILURE), (1, FAILURE), (2, FAILURE)] if failed else [(6, WORST), (3, MEDIAN)]
    assert found == expected
    assert worthy.ranked(one[:1]) == [(0, FAILURE if failed else WORST)]


# Arrays and views.


@pytest.mark.parametrize("shape", [(0,), (1,), (7,), (5, 2, 3)])
def test_arrays_come_back_from_text(shape):
    array = np.random.default_rng(0).normal(3.0, 50.0, shape)
    array.flat[::3] = np.nan if len(array) > 4 else array.flat[::3]
    found = unpacked(json.loads(json.dumps(packed(array))))
    assert found.shape == shape
    np.testing.assert_array_equal(np.isnan(found), np.isnan(array))
    span = np.ptp(array[np.isfinite(array)]) if array.size else 0.0
    np.testing.assert_allclose(found, array, rtol=0.0, atol=span / 131068.0 * 1.001)


def test_constants_and_infinities_come_back_too():
    assert unpacked(packed([2.5, 2.5])).tolist() == [2.5, 2.5]
    found = unpacked(packed([0.0, np.inf, 1.0, -np.inf]))
    assert np.isnan(found[[1, 3]]).all()
    assert found[[0, 2]].tolist() == [0.0, 1.0]


@pytest.mark.parametrize("count", [1, 2, 91, 300, 301, 302, 451, 5000])
def test_the_instants_that_are_kept_hold_both_ends(count):
    kept = kept_instants(count)
    assert (kept[0], kept[-1]) == (0, count - 1)
    assert len(kept) <= 302
    assert len(set(np.diff(kept)[:-1].tolist())) <= 1


def test_the_view_holds_the_scene_and_no_flight_that_leaves_it():
    near, far = {"reach": [-0.5, 0.0, 2.0, 1.0]}, {"reach": [-1e6, 0.0, 1e6, 1.0]}
    assert joined([0.0, 0.0, 4.0, 1.0], [near]) == [-0.5, 0.0, 4.0, 1.0]
    left, _, right, _ = joined([0.0, 0.0, 4.0, 1.0], [far])
    assert -4.0 < left < 0.0
    assert 4.0 < right < 8.0
    points = np.array([[0.0, 1.0], [np.nan, 3.0], [2.0, -1.0]])
    assert box_of(points).tolist() == [0.0, -1.0, 2.0, 1.0]


def test_the_parts_of_every_room_make_pages():
    for name in task_names():
        room = room_named(name)
        for part in ("merit", "units", "fly"):
            assert callable(getattr(room.part("reels"), part))
        with pytest.raises(ValueError, match="nothing was noted"):
            room.part("camera")().reel(None)


# The commands.


def invoke(*arguments):
    return CliRunner().invoke(cli.app, list(arguments))


def test_bench_writes_the_page_of_its_table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ("bench", "pvtol", "--policies", "lqr,random", "--episodes", "3")
    result = invoke(*command, "--html", "deep/report.html", "--json", "a.json")
    assert result.exit_code == 0, result.output
    assert "wrote deep/report.html" in result.stdout
    rows = json.loads(Path("a.json").read_text())
    data = data_of(Path("deep/report.html").read_text())
    assert [one["figures"]["success_rate"] for one in data["rows"]] == [
        row["success_rate"] for row in rows
    ]


@pytest.mark.parametrize("task", named(SINGLE_BODY))
def test_watch_writes_a_page_without_pygame(task, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "pygame", None)
    result = invoke("watch", task, "--policy", "lqr", "--seconds", "2", "--html", "one.html")
    assert result.exit_code == 0, result.output
    data = data_of(Path("one.html").read_text())
    (one,) = data["episodes"]
    assert one["seed"] == "0"
    assert not data["rows"]
    (flight,) = one["flights"].values()
    assert flight["text"] in result.stdout
    times, states = unpacked(flight["times"]), unpacked(flight["parts"]["states"])
    # Of a task whose control is held for longer, one step.
    assert times[-1] <= max(2.0, find_task(task).control_period) + 1e-3
    assert states.shape == (len(times), len(data["states"]))
    # Who has no place is not drawn.
    drawn = task_of(task).place(states[0]).size > 0
    assert ("places" in flight["parts"]) == drawn


def test_watch_opens_the_page_it_writes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    short = ("watch", "cartpole", "--policy", "lqr", "--seconds", "1")
    assert invoke(*short, "--browser").exit_code == 0
    assert invoke(*short, "--browser", "--html", "mine.html").exit_code == 0
    (temporary,) = tmp_path.glob("lagros-*/episode.html")
    assert opened == [temporary.as_uri(), (tmp_path / "mine.html").as_uri()]
    monkeypatch.setattr("webbrowser.open", lambda address: False)
    result = invoke(*short, "--browser", "--html", "mine.html")
    assert result.exit_code == 0
    assert "no browser can be opened here; open mine.html yourself" in result.stderr


def test_a_film_and_a_page_are_not_made_at_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = invoke("watch", "cartpole", "--html", "a.html", "--video", "a.gif")
    assert result.exit_code == 2
    assert "--video" in result.stderr
    assert not list(tmp_path.iterdir())
