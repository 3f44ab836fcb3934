"""A benchmark that was killed goes on where it was, and ends with the same records to the bit."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.run.fingerprints import fingerprint
from lagros_benchmarks.run.keeping import Kept, decode, encode
from lagros_benchmarks.run.library import Toolbox
from lagros_benchmarks.run.runner import kept_in, run_benchmark
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_benchmarks.run.single import SingleExperiment
from lagros_benchmarks.tasks.spacecraft.episodes import AgentRecord, Flight
from lagros_envs import registry
from tests.benchmarks import fakes, killed_runs, toys

TIMES = ("timed_counters", "step_times", "deadline_misses", "steps", "batches", "plans")


def same(one, two):
    """Compare two records to the bit, times left out."""
    if dataclasses.is_dataclass(one):
        return type(one) is type(two) and all(
            same(getattr(one, field.name), getattr(two, field.name))
            for field in dataclasses.fields(one)
            if field.name not in TIMES
        )
    if isinstance(one, np.ndarray):
        return (one.dtype, one.shape, one.tobytes()) == (two.dtype, two.shape, two.tobytes())
    if isinstance(one, list | tuple):
        return type(one) is type(two) and len(one) == len(two) and all(map(same, one, two))
    if isinstance(one, float):
        return np.float64(one).tobytes() == np.float64(two).tobytes()
    return type(one) is type(two) and one == two


def same_runs(one, two):
    return list(one.episodes) == list(two.episodes) and all(
        same(list(one.episodes[case]), list(two.episodes[case])) for case in one.episodes
    )


# Chunks


numbers = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
arrays = st.lists(st.floats(width=32), max_size=5).map(lambda values: np.array(values, np.float32))
values = st.recursive(
    numbers | arrays,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text(), inner, max_size=3)
        | st.builds(Flight, inner, inner)
    ),
    max_leaves=8,
)


@given(values)
def test_a_chunk_is_read_back_to_the_bit(value):
    def equal(one, two):
        if isinstance(one, dict):
            return one.keys() == two.keys() and all(equal(one[key], two[key]) for key in one)
        if isinstance(one, Flight):
            return equal([one.worlds, one.counters], [two.worlds, two.counters])
        if isinstance(one, list | tuple):
            return type(one) is type(two) and len(one) == len(two) and all(map(equal, one, two))
        return same(one, two)

    assert equal(value, decode(json.loads(json.dumps(encode(value)))))


@pytest.mark.parametrize("shape", [(0, 3), (2, 0), (2, 3, 4), ()])
def test_an_array_keeps_its_shape(shape):
    value = np.zeros(shape)
    assert same(value, decode(json.loads(json.dumps(encode(value)))))


@pytest.mark.parametrize("value", [object(), {1: 2}, np.array([object()]), {3}, 1j])
def test_what_is_not_known_is_not_kept(value, tmp_path, caplog):
    with pytest.raises(TypeError):
        encode(value)
    kept = Kept(tmp_path / "x", "key")
    kept.add("episodes", 0, value)
    kept.add("episodes", 1, 1)
    assert len(caplog.records) == 1
    assert "begins anew" in caplog.text
    assert not len(kept)


def damage(path, how):
    content = path.read_bytes()
    if how == "gone":
        path.unlink()
    elif how == "folder":
        path.unlink()
        path.mkdir()
    elif how == "link":
        path.unlink()
        path.symlink_to(path)
    else:
        path.write_bytes(
            {
                "empty": b"",
                "truncated": content[:-40],
                "no end": content[:-1],
                "digit": content[:-30] + b"1" + content[-29:],
                "binary": b"\xff" * 100,
                "longer": content + b"x",
            }[how]
        )


@pytest.mark.parametrize(
    "how",
    ["gone", "folder", "link", "empty", "truncated", "no end", "digit", "binary", "longer"],
)
def test_a_chunk_that_is_not_whole_is_made_again(tmp_path, how, caplog):
    settings, toolbox = killed_runs.RUNS["cartpole"]
    whole = run_benchmark(settings, toolbox)
    kept = kept_in(tmp_path, settings, toolbox)
    run_benchmark(settings, toolbox, kept=kept)
    for path in list(kept.folder.iterdir())[::2]:
        damage(path, how)
    again = run_benchmark(settings, toolbox, kept=kept_in(tmp_path, settings, toolbox))
    assert same_runs(whole, again)
    # All are whole again, but where a folder stands in the way, which is said once.
    assert len(caplog.records) == (how in ("folder", "link"))


def test_a_chunk_of_another_place_or_run_is_not_taken(tmp_path):
    kept = Kept(tmp_path, "key")
    kept.add("episodes", 0, 1)
    (tmp_path / "episodes-00000.json").rename(tmp_path / "episodes-00001.json")
    assert kept.found("episodes", 2) == {}
    kept.add("episodes", 0, None)
    assert kept.found("episodes", 2) == {0: None}
    assert Kept(tmp_path, "another").found("episodes", 2) == {}


def test_a_policy_may_change_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kept = Kept(Path("runs"), "key")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    kept.add("episodes", 0, 1)
    monkeypatch.chdir(tmp_path)
    assert os.listdir("runs") == ["episodes-00000.json"]
    assert kept.found("episodes", 1) == {0: 1}


# Runs


@pytest.fixture(scope="module")
def plain():
    return {task: run_benchmark(*killed_runs.RUNS[task]) for task in killed_runs.RUNS}


@pytest.mark.parametrize("task", killed_runs.RUNS)
def test_a_run_that_is_killed_at_ten_moments_ends_as_one_that_was_not(tmp_path, plain, task):
    code = "from tests.benchmarks.killed_runs import main; import pathlib, sys; "
    ended = subprocess.run(
        [
            sys.executable,
            "-c",
            code + "main(sys.argv[1], pathlib.Path(sys.argv[2]))",
            task,
            tmp_path,
        ],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
        # Libraries with threads of their own do not like to be forked.
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    # Each run goes on where the one before was killed, so that every moment is another.
    assert [int(line) for line in ended.stdout.split()] == [-signal.SIGKILL] * 10
    assert list(tmp_path.rglob("*.json"))
    assert same_runs(plain[task], killed_runs.run(task, tmp_path))


@pytest.mark.parametrize("task", killed_runs.RUNS)
def test_what_is_kept_is_not_run_again(tmp_path, plain, task):
    killed_runs.run(task, tmp_path)
    settings, toolbox = killed_runs.RUNS[task]
    (folder,) = tmp_path.iterdir()
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    told = []
    again = run_benchmark(
        settings, toolbox, lambda *line: told.append(line), kept_in(tmp_path, settings, toolbox)
    )
    assert same_runs(plain[task], again)
    assert before == {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    # One line a stage: all of it is there.
    assert all(done == total for _, done, total in told)


def test_what_is_kept_of_other_settings_is_refused(tmp_path):
    settings, toolbox = killed_runs.RUNS["cartpole"]
    kept = kept_in(tmp_path, settings, toolbox)
    with pytest.raises(ValueError, match="of other settings"):
        run_benchmark(dataclasses.replace(settings, seed=1), toolbox, kept=kept)


def test_two_processes_may_share_a_folder(tmp_path, plain):
    code = (
        "from tests.benchmarks.killed_runs import run; import pathlib, sys; "
        "run('cartpole', pathlib.Path(sys.argv[1]))"
    )
    both = [
        subprocess.Popen([sys.executable, "-c", code, tmp_path], cwd=Path(__file__).parents[2])
        for _ in range(2)
    ]
    assert [one.wait() for one in both] == [0, 0]
    assert same_runs(plain["cartpole"], killed_runs.run("cartpole", tmp_path))


def test_a_folder_that_takes_nothing_ends_no_run(tmp_path, plain, caplog):
    (tmp_path / "file").write_text("x")
    run = killed_runs.run("cartpole", tmp_path / "file")
    assert same_runs(plain["cartpole"], run)
    assert len(caplog.records) == 1


# What a run depends on


def test_the_key_changes_with_all_that_a_result_depends_on(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    model, module, metric = (tmp_path / name for name in ("m.zip", "pilots.py", "metric.json"))
    odd = tmp_path / "m:a=1.zip"
    for path in (model, module, metric, odd):
        path.write_text("1")
    module.write_text("import os\nfrom gains.of_mine import GAIN\n\ndef late():\n    import gains2")
    (tmp_path / "gains").mkdir()
    (tmp_path / "gains2").mkdir()
    (tmp_path / "more").mkdir()
    settings = BenchmarkSettings(
        policies=("lagros", "sac:m.zip", "ppo:m:a=1.zip", "pilots:Good"), metric="metric.json"
    )

    def key(**changes):
        return fingerprint(dataclasses.replace(settings, **changes), Toolbox())

    first = key()
    assert key() == first
    different = [
        key(episodes=51),
        key(seed=1),
        key(chunk=24),
        key(policies=("lagros",)),
        key(policy_settings={"lagros": {"weights": "w.safetensors"}}),
        key(jobs=2),  # other processes contend for the one whose steps are timed
        fingerprint(settings, fakes.EASY),
    ]
    (tmp_path / "more" / "unrelated.py").write_text("1")
    assert key() == first
    imported = (tmp_path / "gains" / "of_mine.py", tmp_path / "gains2" / "weights.bin")
    beside = (tmp_path / "helper.py", tmp_path / "weights.npz")
    for path in (*imported, model, odd, metric, *beside, module):
        path.write_text("2")
        different.append(key())
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    different.append(key())
    monkeypatch.setattr("lagros_benchmarks.run.fingerprints.versions", lambda: {"numpy": "0"})
    different.append(key())
    assert len({first, *different}) == 1 + len(different)
    assert key(jobs=2) == key(jobs=3)


def test_the_key_changes_with_a_task_of_ones_own_and_what_it_needs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = Path(toys.__file__).read_text(encoding="utf-8")
    (tmp_path / "coin.py").write_text(text.replace('"slider", "Slider"', '"coin", "Coin"'))
    settings = BenchmarkSettings.for_task("./coin.py", policies=("lqr",))
    folder = tmp_path / "runs" / "reproduce-coin"
    folder.mkdir(parents=True)
    keys = [fingerprint(settings, Toolbox())]
    for name in ("results.json", "lagros_checkpoint.safetensors"):
        (folder / name).write_text("of no policy")
    assert fingerprint(settings, Toolbox()) == keys[0]
    needed = (folder / "metric.json", folder / "coin_lagros.safetensors", tmp_path / "physics.py")
    for path in (*needed, tmp_path / "coin.py"):
        path.write_text(path.read_text() + "\n" if path.exists() else "1")
        keys.append(fingerprint(settings, Toolbox()))
    assert len(set(keys)) == 5


def test_the_key_changes_with_the_equation_of_a_task_that_has_no_file(monkeypatch):
    """Such as one of a notebook."""
    monkeypatch.setattr("lagros_benchmarks.run.fingerprints.inspect.getsourcefile", lambda _: None)
    task = type("Slide", (toys.Slide,), {"name": "in-hand", "title": "InHand"})()
    monkeypatch.setitem(registry._FOUND, "in-hand", task)
    settings = BenchmarkSettings.for_task("in-hand", policies=("lqr",))
    first = fingerprint(settings, Toolbox())
    monkeypatch.setattr(
        toys.Puck, "derivative", lambda _, x, u, functions: (x[2], x[3], u[0] - 0.1 * x[2], u[1])
    )
    assert fingerprint(settings, Toolbox()) != first


# The command


@pytest.fixture
def bench(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lagros_benchmarks.run.runner.Toolbox", lambda: fakes.EASY)
    monkeypatch.setattr("lagros_benchmarks.run.settings.check_policy", lambda *_: None)
    arguments = ("bench", "cartpole", "--policies", "steady,idle", "--episodes", "3")
    return lambda *more: CliRunner().invoke(cli.app, (*arguments, *more))


@pytest.fixture
def interrupted(monkeypatch):
    """Ctrl-C in the second chunk of episodes."""
    play = SingleExperiment.play

    def stop(self, case, units):
        if case.policy == "idle":
            raise KeyboardInterrupt
        return play(self, case, units)

    with monkeypatch.context() as patch:
        patch.setattr(SingleExperiment, "play", stop)
        yield patch


def test_ctrl_c_says_how_to_go_on_and_the_same_command_does(bench, tmp_path, interrupted):
    result = bench("--json", "a.json")
    assert result.exit_code == 130
    assert "kept in runs/bench/cartpole-" in result.stderr
    assert "the same command goes on" in result.stderr
    assert not (tmp_path / "a.json").exists()
    interrupted.undo()
    result = bench("--json", "a.json")
    assert result.exit_code == 0, result.output
    assert "going on with 2 finished chunks of runs/bench/cartpole-" in result.stderr
    assert [row["policy"] for row in json.loads((tmp_path / "a.json").read_text())] == [
        "steady",
        "idle",
    ]
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_folder_that_was_named_keeps_what_is_finished(bench, tmp_path):
    assert bench("--out", "kept").exit_code == 0
    assert len(list((tmp_path / "kept").rglob("*.json"))) == 3
    result = bench("--out", "kept", "--json", "a.json", "--csv", "a.csv")
    assert "going on with 3 finished chunks of kept/" in result.stderr
    assert (tmp_path / "a.json").exists()
    assert (tmp_path / "a.csv").exists()
    # Another command does not take them.
    assert "going on" not in bench("--out", "kept", "--seed", "1").stderr
    assert len(list((tmp_path / "kept").iterdir())) == 2


def test_a_folder_that_cannot_be_written_is_refused(bench, tmp_path):
    (tmp_path / "file").write_text("x")
    result = bench("--out", "file/kept")
    assert result.exit_code == 2
    assert "--out: cannot write 'file/kept': its folder is a file" in result.stderr


def test_records_are_kept_with_every_field():
    agent = AgentRecord(
        True, 1.5, False, True, True, False, None, 0.1, 0.2, float("nan"), None, True, 0.3
    )
    assert same(agent, decode(json.loads(json.dumps(encode(agent)))))
