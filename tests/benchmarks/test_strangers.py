"""Policies that go wrong in every way, over every command that flies policies, on both tasks."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.evidence.calibration import single_scores
from lagros_benchmarks.run.flying import AnswerError, Attempt, ask, describe_error
from lagros_benchmarks.run.runner import run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_benchmarks.worst_case.flights import draw_episodes, fly, policy_law
from lagros_benchmarks.worst_case.goals import GOALS, scores
from lagros_envs.tasks.cartpole.task import CartPoleSettings
from lagros_policies.tasks.cartpole.expert import CartPoleExpert
from tests.benchmarks import strangers

PLACE = "tests.benchmarks.strangers"


def name_of(kind):
    return f"{PLACE}:{kind.__name__}"


def bench(task, kind):
    return (
        *("bench", task, "--policies", name_of(kind), "--episodes", "1", "--bound", "0.3"),
        *(("--agents", "2", "--safety-filter", "none") if task == "spacecraft" else ()),
        *("--timing-episodes", "1", "--json", "out.json", "--latex", "out.tex"),
        *("--csv", "out.csv", "--markdown", "out.md"),
    )


def watch(task, kind):
    many = ("--agents", "2") if task == "spacecraft" else ()
    return (
        *("watch", task, "--policy", name_of(kind), *many, "--seconds", "1", "--speed", "10"),
        *("--video", "out.gif"),
    )


def attack(task, kind):
    return (
        *("attack", task, "--policy", name_of(kind), "--episodes", "1", "--budget", "2"),
        *("--json", "out.json"),
    )


COMMANDS = {"bench": bench, "watch": watch, "attack": attack}
TASKS = ("cartpole", "spacecraft")
EVERYWHERE = [(command, task) for command in COMMANDS for task in TASKS]


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(cli.app, arguments)


@pytest.mark.parametrize("kind", strangers.UNFIT)
@pytest.mark.parametrize(("command", "task"), EVERYWHERE)
def test_what_cannot_run_is_refused_before_the_first_episode(invoke, tmp_path, command, task, kind):
    result = invoke(*COMMANDS[command](task, kind))
    assert result.exit_code == 1, result.output
    assert isinstance(result.exception, SystemExit)
    last = [line for line in result.stderr.splitlines() if line.startswith("lagros: ")]
    assert len(last) == 1
    assert kind.__name__ in last[0]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", strangers.FAILING)
@pytest.mark.parametrize("task", TASKS)
def test_an_episode_that_raises_is_a_marked_failure(invoke, tmp_path, task, kind):
    result = invoke(*bench(task, kind))
    assert result.exit_code == 3, result.output
    assert isinstance(result.exception, SystemExit)
    assert "1 of 1" in result.stderr
    (row,) = json.loads((tmp_path / "out.json").read_text())
    assert (row["raised"], row["success_rate"], row["strict_success_rate"]) == (1, 0.0, 0.0)
    (error,) = row["errors"]
    assert error["text"].isprintable()
    files = (tmp_path / "out.tex", tmp_path / "out.md")
    for text in (result.stdout, *(file.read_text() for file in files)):
        assert any("!" in line and kind.__name__[:8] in line for line in text.splitlines())
        assert "raised and count as failures" in " ".join(text.split())


@pytest.mark.parametrize("kind", [strangers.Raises, strangers.Leaves, strangers.NotANumber])
@pytest.mark.parametrize(("command", "task"), EVERYWHERE)
def test_every_command_says_so_and_ends_with_status_3(invoke, tmp_path, command, task, kind):
    result = invoke(*COMMANDS[command](task, kind))
    assert result.exit_code == 3, result.output
    assert isinstance(result.exception, SystemExit)
    assert "failure" in result.output
    assert list(tmp_path.iterdir())  # what was asked for is written all the same


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("jobs", [1, 2])
def test_what_a_policy_does_to_its_observations_changes_nothing(task, jobs):
    more = {"agents": (2,), "safety_filter": "none"} if task == "spacecraft" else {}

    def flown(kind):
        settings = BenchmarkSettings.for_task(
            task, policies=(name_of(kind),), episodes=2, bounds=(0.3,), jobs=jobs, chunk=1, **more
        )
        (episodes,) = run_benchmark(settings).episodes.values()
        return episodes

    for one, two in zip(flown(strangers.Calm), flown(strangers.Writes), strict=True):
        assert one.error is two.error is None
        if task == "cartpole":
            assert one.effort == two.effort
            np.testing.assert_array_equal(one.tracking_error, two.tracking_error)
        else:
            assert one == two


@pytest.mark.parametrize("task", TASKS)
def test_workers_tell_of_what_raised(invoke, tmp_path, task):
    result = invoke(*bench(task, strangers.Leaves), "--jobs", "2")
    assert result.exit_code == 3, result.output
    assert json.loads((tmp_path / "out.json").read_text())[0]["raised"] == 1


def test_what_raises_only_where_it_is_timed_is_told(invoke, tmp_path):
    result = invoke(*bench("spacecraft", strangers.Alone))
    assert result.exit_code == 3, result.output
    (row,) = json.loads((tmp_path / "out.json").read_text())
    assert (row["raised"], row["timing_raised"], row["steps_timed"]) == (0, 1, 0)
    assert "! Alone, uniform 0.3: 1 worlds raised where Δt was measured" in result.stdout


@pytest.mark.parametrize("task", TASKS)
def test_a_policy_leaves_nothing_behind_in_the_process(invoke, tmp_path, task):
    before, path = process_state(), set(sys.path)
    result = invoke(*bench(task, strangers.Wanders))
    assert result.exit_code == 0, result.output
    assert "wrote out.json" in result.stdout
    assert stat.S_IMODE((tmp_path / "out.json").stat().st_mode) == 0o666 & ~before[0]
    (row,) = json.loads((tmp_path / "out.json").read_text())
    assert "another" not in row["command"]
    assert os.path.samefile(".", tmp_path)
    assert process_state() == before
    assert path <= set(sys.path)


def process_state():
    mask = os.umask(0)
    os.umask(mask)
    return mask, np.geterr(), list(sys.argv), sys.getrecursionlimit(), os._exit


def test_a_command_ends_though_a_thread_does_not():
    program = """
import threading, time
from lagros_benchmarks.run import process
process._PATIENCE = 0.1
threading.Thread(target=time.sleep, args=(600,)).start()
process.end_with_threads(3)
"""
    assert subprocess.run([sys.executable, "-c", program], timeout=60).returncode == 3


def test_counters_that_raise_fail_their_episode(invoke, tmp_path):
    result = invoke(*bench("cartpole", strangers.BadCounters))
    assert result.exit_code == 3
    (row,) = json.loads((tmp_path / "out.json").read_text())
    assert row["errors"][0]["text"] == "KeyError: 'plans'"


def test_only_an_interrupt_passes_an_attempt():
    for error in (ValueError("one"), SystemExit(0), GeneratorExit(), StopIteration()):
        with Attempt() as attempt:
            raise error
        assert attempt.error == describe_error(error)
    with pytest.raises(KeyboardInterrupt), Attempt():
        raise KeyboardInterrupt
    with pytest.raises(AnswerError), Attempt(AnswerError):
        raise AnswerError
    with Attempt() as attempt:
        pass
    assert attempt.error is None


def test_a_text_is_one_line_that_can_be_printed():
    long = describe_error(ValueError("x\r\n\ty\x07\ud800" + "z" * 2000))
    assert long.isprintable()
    assert long.startswith("ValueError: x y\\x07\\ud800zzz")
    assert len(long) < 600


def test_a_policy_writes_into_copies():
    seen, starts = np.zeros((2, 20)), np.ones(2, bool)
    ask(strangers.Writes(None, preset=None), seen, None, starts, (2, 8))
    assert not seen.any()
    assert starts.all()


def test_an_answer_is_a_copy_of_the_right_shape():
    class Reuses(strangers.Calm):
        buffer = np.zeros((2, 8), np.float32)

        def answer(self, seen, zero):
            return self.buffer, None

    policy = Reuses(None, preset=None)
    seen = np.zeros((2, 20))
    answer = ask(policy, seen, None, [True, True], (2, 8))
    policy.buffer[:] = 7.0
    assert answer.action.dtype == np.float32
    assert not answer.action.any()
    with pytest.raises(AnswerError, match=r"by an action of shape \(2, 8\); it must be \(3, 8\)"):
        ask(policy, seen, None, [True, True], (3, 8))


@pytest.mark.parametrize("kind", [strangers.Raises, strangers.Leaves, strangers.NotANumber])
def test_a_calibration_counts_what_raises_as_infinitely_far(kind):
    found = single_scores(CartPoleSettings(), name_of(kind), 3)
    assert found.failed == 3
    assert all(np.isinf(values).all() for values in found.values.values())


def test_a_search_finds_what_makes_a_policy_raise():
    episodes = draw_episodes(CartPoleExpert(), [1, 2, 3])

    class Picky(strangers.Calm):
        def answer(self, seen, zero):
            if (seen[:, 4] == np.float32(episodes.goals[1, 0])).any():
                raise ArithmeticError("not this goal")
            return zero, None

    law = policy_law(Picky(None), episodes)
    every = np.arange(3)
    flown = fly(episodes, law, every, np.zeros((3, episodes.settings.steps, 4)))
    assert np.isnan(flown.controls).any(axis=(1, 2)).tolist() == [False, True, False]
    for goal in GOALS:
        assert np.isinf(scores(episodes, goal, every, flown)[0]).tolist() == [False, True, False]
