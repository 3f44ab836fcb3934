"""Every command with an output that fails: nothing that was computed is lost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("minari")

from tests.benchmarks.hostile_streams import COMMANDS, CONDITIONS

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """The folder, and the exit status and text of every command in every condition."""
    folder = tmp_path_factory.mktemp("hostile")
    ended = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks.hostile_streams", str(folder)],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        # Libraries with threads of their own do not like to be forked.
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    lines = [json.loads(line) for line in ended.stdout.splitlines()]
    return folder, {(line["name"], line["condition"]): line for line in lines}


def files_of(folder, name):
    return {path: (folder / path).stat().st_size for path in COMMANDS[name][1]}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_file_is_there_whatever_happens_to_what_is_printed(ran, name):
    folder, runs = ran
    plain = runs[name, "plain"]
    assert plain["status"] == 0, plain["err"]
    expected = files_of(folder / "plain" / name, name)
    assert all(size > 0 for size in expected.values())
    for condition in CONDITIONS[1:-1]:
        run = runs[name, condition]
        assert "Traceback" not in run["err"]
        assert run["status"] == (0 if condition == "ascii" else 1), run["err"]
        found = files_of(folder / condition / name, name)
        assert found.keys() == expected.keys()
        assert all(found.values())


@pytest.mark.parametrize("name", COMMANDS)
def test_what_could_not_be_printed_is_kept_and_named(ran, name):
    folder, runs = ran
    plain = runs[name, "plain"]["out"].split()
    for condition, reason in (("full", "No space left"), ("closed", "Bad file descriptor")):
        (line,) = runs[name, condition]["err"].strip().splitlines()
        assert line.startswith(f"lagros: cannot print: {reason}")
        kept = Path(line.rpartition(" ")[2])
        assert kept.is_relative_to(folder / condition / name / "tmp")
        # All but times is as it was.
        assert len(kept.read_text().split()) == len(plain)
    # A reader who has gone is no news.
    assert runs[name, "pipe"]["err"].strip() == ""


@pytest.mark.parametrize("name", COMMANDS)
def test_a_terminal_without_our_letters_gets_all_others(ran, name):
    _, runs = ran
    ours, theirs = (runs[name, condition]["out"] for condition in ("plain", "ascii"))
    assert theirs
    assert len(theirs.splitlines()) == len(ours.splitlines())


@pytest.mark.parametrize("name", COMMANDS)
def test_on_a_full_disk_each_file_is_named_and_all_text_is_printed(ran, name):
    folder, runs = ran
    run = runs[name, "disk"]
    assert run["status"] == 1
    assert "Traceback" not in run["err"]
    if name == "train":  # its first file is the checkpoint, without which it cannot go on
        assert "checkpoint.pt: File too large" in run["err"]
        return
    for path in COMMANDS[name][1]:
        reported = path if name != "data" else "d/lagros/cartpole/expert-v0"
        assert f"cannot write {reported!r}: File too large" in run["err"]
        if path.endswith((".json", ".csv", ".tex", ".md", ".jsonl")) and name != "data":
            text = (folder / "plain" / name / path).read_text()
            # The first line of each, which has no times.
            assert text.splitlines()[0] in run["out"]
    assert not [path for path in (folder / "disk" / name).rglob("*") if path.is_file()]


def test_the_program_itself_ends_quietly_when_its_reader_has_gone(tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    command = "-m lagros_benchmarks bench cartpole --policies random --episodes 1 --json b.json"
    ended = subprocess.run(
        [sys.executable, *command.split()],
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (1, "")
    assert os.listdir(tmp_path) == ["b.json"]


def test_worker_processes_need_no_stream_either(tmp_path):
    command = "-m lagros_benchmarks bench cartpole --policies random --episodes 1 --json b.json"
    shell = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", sys.executable, *command.split()]
    (tmp_path / "tmp").mkdir()
    ended = subprocess.run(
        [*shell, "--jobs", "2"],
        check=False,
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(tmp_path / "tmp")},
    )
    assert ended.returncode == 1  # the table was not printed
    assert sorted(os.listdir(tmp_path)) == ["b.json", "tmp"]
    (kept,) = tmp_path.glob("tmp/lagros-*/printed.txt")
    assert "random" in kept.read_text()
