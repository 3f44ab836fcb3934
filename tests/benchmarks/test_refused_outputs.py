"""Outputs that cannot be written are refused before the work, by every command and option."""

from __future__ import annotations

import errno
import os
import socket
import typing
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.commands.outputs import Delivery, check_outputs

# What a command does, none of which may begin.
WORK = (
    "lagros_benchmarks.run.runner.run_benchmark",
    "lagros_benchmarks.run.reproduction.reproduce",
    "lagros_benchmarks.worst_case.attack.run_attack",
    "lagros_benchmarks.evidence.single.certify",
    "lagros_benchmarks.tasks.spacecraft.certify.certify",
    "lagros_benchmarks.commands.train._train_one",
    "lagros_benchmarks.commands.export._written",
    "lagros_benchmarks.report.playback.Playback.play",
    "lagros_benchmarks.report.playback.Playback.page",
    "lagros_benchmarks.run.demonstrations.demonstrate",
    "lagros_benchmarks.run.suite.fly_task",
    "lagros_policies.inspection.inspect_task",
    "lagros_benchmarks.report.leaderboard.table",
)
BOARD = Path(__file__).resolve().parents[2] / "benchmarks" / "leaderboard"
SUBMISSION = next(BOARD.glob("*.json"))
START = {
    "bench": "bench spacecraft --policies learned --episodes 1",
    "reproduce": "reproduce cartpole",
    "attack": "attack cartpole --policy lqr",
    "certify": "certify cartpole",
    "train": "train cartpole",
    "export": "export lagros-cartpole",
    "data export": "data export --minari",
    "watch": "watch cartpole --policy lqr",
    "suite": "suite cartpole",
    "check": "check cartpole",
    "leaderboard": f"leaderboard {SUBMISSION}",
}
# Every option that takes a path: the suffix of the file that it writes, "" for a folder, and None
# for what is read.
PATHS = {
    ("bench", "--json"): ".json",
    ("bench", "--csv"): ".csv",
    ("bench", "--latex"): ".tex",
    ("bench", "--markdown"): ".md",
    ("bench", "--figure"): ".png",
    ("bench", "--scene"): ".svg",
    ("bench", "--episodes-file"): ".jsonl",
    ("bench", "--html"): ".html",
    ("bench", "--out"): "",
    ("reproduce", "--out"): "",
    ("attack", "--json"): ".json",
    ("attack", "--npz"): ".npz",
    ("attack", "--replay"): None,
    ("certify", "--json"): ".json",
    ("certify", "--metric"): None,
    ("train", "--json"): ".json",
    ("train", "--figure"): ".pdf",
    ("train", "--out"): "",
    ("export", "--out"): ".c",
    ("export", "--weights"): None,
    ("data export", "--out"): "",
    ("watch", "--video"): ".gif",
    ("watch", "--html"): ".html",
    ("watch", "--scenario"): None,
    ("check", "--json"): ".json",
    ("new", "--file"): None,  # is tried in test_new_and_check.py
    ("suite", "--json"): ".json",
    ("suite", "--markdown"): ".md",
    ("suite", "--figure"): ".png",
    ("suite", "--out"): "",
    ("suite", "--from"): None,
    ("leaderboard", "--files"): None,  # is tried in test_leaderboard.py
    ("leaderboard", "--markdown"): ".md",
}
WRITTEN = [(*key, suffix) for key, suffix in PATHS.items() if suffix is not None]
FILES = [(command, option, suffix) for command, option, suffix in WRITTEN if suffix]


@pytest.fixture
def refused(tmp_path, monkeypatch):
    """Run a command that must refuse; return what it said, without the spaces of its frame."""
    monkeypatch.chdir(tmp_path)
    for name in WORK:
        monkeypatch.setattr(name, lambda *_, **__: pytest.fail("the work began"))

    def run(arguments):
        before = sorted(tmp_path.rglob("*"))
        result = CliRunner().invoke(cli.app, arguments)
        assert result.exit_code == 2, result.output
        assert isinstance(result.exception, SystemExit)
        assert sorted(tmp_path.rglob("*")) == before
        return "".join(result.output.replace("│", " ").split())

    return run


def options(app, before=""):
    """Yield every command's name with the name and type of each of its options."""
    for command in app.registered_commands:
        name = before + (command.name or command.callback.__name__)
        hints = typing.get_type_hints(command.callback, include_extras=True)
        for parameter, hint in hints.items():
            if parameter != "return":
                kind, info = typing.get_args(hint)[:2]
                # In an annotation Typer takes the first name for the default.
                names = [name for name in (info.default, *(info.param_decls or ())) if name]
                names = [name for name in names if str(name).startswith("--")]
                option = names[0] if names else f"--{parameter.replace('_', '-')}"
                yield name, option, kind
    for group in app.registered_groups:
        yield from options(group.typer_instance, f"{before}{group.name} ")


def test_every_option_that_takes_a_path_is_tried_here():
    found = {
        (command, option)
        for command, option, kind in options(cli.app)
        if Path in (kind, *typing.get_args(kind))
    }
    assert found == PATHS.keys()


@pytest.mark.parametrize(("command", "option", "suffix"), WRITTEN)
@pytest.mark.parametrize("how", ["beneath a file", "on a file", "read-only", "too long", "a ring"])
def test_what_cannot_be_written_is_refused(refused, tmp_path, command, option, suffix, how):
    (tmp_path / "file").write_text("x")
    (tmp_path / "shut").mkdir(mode=0o555)
    (tmp_path / f"ring{suffix}").symlink_to(f"ring{suffix}")
    # No mode keeps root from writing; nobody may make a file in /proc.
    shut = "/proc" if os.geteuid() == 0 else "shut"
    path = {
        "beneath a file": f"file/deep/x{suffix}",
        "on a file": f"file/x{suffix}",
        "read-only": f"{shut}/none/x{suffix}",
        "too long": "x" * 300 + suffix,
        "a ring": f"ring{suffix}",
    }[how]
    said = refused([*START[command].split(), option, path])
    assert option in said


@pytest.mark.parametrize(("command", "option", "suffix"), FILES)
@pytest.mark.parametrize("what", ["folder", "socket"])
def test_what_is_no_file_is_refused(refused, tmp_path, command, option, suffix, what):
    path = tmp_path / f"x{suffix}"
    if what == "folder":
        path.mkdir()
        said = refused([*START[command].split(), option, path.name])
    else:
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(path.name)
            said = refused([*START[command].split(), option, path.name])
    assert option in said
    assert what == "socket" or path.is_dir()


PAIRS = [
    ("bench", "--json", "--csv"),
    ("bench", "--markdown", "--episodes-file"),
    ("bench", "--figure", "--scene"),
    ("bench", "--json", "--figure"),
    ("bench", "--csv", "--html"),
    ("attack", "--json", "--npz"),
    ("train", "--json", "--figure"),
]


@pytest.mark.parametrize(("command", "one", "other"), PAIRS)
@pytest.mark.parametrize("how", ["same", "relative", "absolute", "link", "folder link", "hard"])
def test_two_outputs_in_one_file_are_refused(refused, tmp_path, command, one, other, how):
    (tmp_path / "folder").mkdir()
    (tmp_path / "short").symlink_to("folder")
    path, second = "folder/x.png", "folder/x.png"
    if how == "relative":
        second = "short/../folder/./x.png"
    elif how == "absolute":
        second = str(tmp_path / path)
    elif how == "folder link":
        second = "short/x.png"
    elif how == "link":
        (tmp_path / "link.png").symlink_to(path)
        second = "link.png"
    elif how == "hard":
        (tmp_path / path).write_text("x")
        (tmp_path / "hard.png").hardlink_to(tmp_path / path)
        second = "hard.png"
    said = refused([*START[command].split(), one, path, other, second])
    assert one in said
    assert other in said


@pytest.mark.parametrize(("command", "one", "other"), PAIRS)
@pytest.mark.parametrize("linked", [False, True])
def test_a_file_that_is_a_folder_of_another_is_refused(
    refused, tmp_path, command, one, other, linked
):
    if linked:
        (tmp_path / "short").symlink_to("x.png")
    beneath = "short/deep/y.png" if linked else "x.png/deep/y.png"
    for first, second in ((one, other), (other, one)):
        said = refused([*START[command].split(), first, "x.png", second, beneath])
        assert f"{first}:'x.png'isafolderof{second}" in said


@pytest.mark.parametrize(
    "arguments",
    [
        "bench cartpole --json a --out a",
        "bench cartpole --csv a --out a/b",
        "bench cartpole --markdown runs",
        "bench cartpole --latex runs/bench",
        "train cartpole --json runs/train",
        "train cartpole --json a/cartpole-ppo/seed-0 --out a",
    ],
)
def test_a_file_that_is_a_folder_of_the_run_is_refused(refused, arguments):
    option, name = arguments.split()[2:4]
    assert f"{option}:'{name}'isafolderof" in refused(arguments.split())


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        ("export lagros-cartpole --weights w --out w", "--weights"),
        ("certify cartpole --metric w --json w", "--metric"),
        ("bench cartpole --policies sac:w.zip --json w.zip", "w.zip"),
        ("attack cartpole --policy w.zip --npz w.zip", "w.zip"),
        ("train cartpole --out t --json t/cartpole-ppo/seed-0/record.json", "record.json"),
    ],
)
def test_no_output_is_written_over_what_is_read(refused, tmp_path, monkeypatch, arguments, option):
    place = tmp_path / "t" / "cartpole-ppo" / "seed-0"
    place.mkdir(parents=True)
    for path in (tmp_path / "w", tmp_path / "w.zip", place / "record.json"):
        path.write_text("kept")
    monkeypatch.setattr("lagros_policies.export.source.load_source", lambda *_: None)
    said = refused(arguments.split())
    assert option in said
    assert "reads" in said or "thefileof--out" in said
    assert (tmp_path / "w").read_text() == "kept"


def test_the_demo_says_that_its_folder_is_in_the_way(refused, tmp_path):
    (tmp_path / "runs").write_text("x")
    assert "itsfolderisafile" in refused(["demo"])


def test_folders_of_a_refused_command_are_not_left(tmp_path):
    (tmp_path / "file").write_text("x")
    outputs = {"--json": tmp_path / "new" / "a.json", "--csv": tmp_path / "file" / "b.csv"}
    with pytest.raises(ValueError, match="--csv"):
        check_outputs(outputs)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_what_takes_more_than_one_output_may_have_two(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    check_outputs({"--json": tmp_path / "pipe", "--csv": tmp_path / "pipe"})


# Delivery


def test_a_file_that_fails_takes_no_other_with_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "blocked").mkdir()
    delivery = Delivery()
    delivery.write_text(tmp_path / "a", lambda: "first")
    delivery.write_text(tmp_path / "blocked", lambda: "second")
    delivery.write(tmp_path / "c.png", lambda _: 1 / 0)
    delivery.write_text(None, lambda: pytest.fail("left out"))
    delivery.write_text(tmp_path / "d", lambda: "last")
    assert delivery.written == [tmp_path / "a", tmp_path / "d"]
    (kept,) = tmp_path.glob("lagros-*/blocked")
    assert kept.read_text() == "second"
    with pytest.raises(typer.Exit) as ending:
        delivery.tell("a note")
    assert ending.value.exit_code == 1
    told = capsys.readouterr()
    assert told.out.splitlines() == [f"wrote {tmp_path / name} (a note)" for name in ("a", "d")]
    assert f"blocked': it is a folder; it is kept as {kept}" in told.err
    assert "c.png': division by zero" in told.err


def test_where_there_is_no_place_left_the_text_is_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    delivery = Delivery()
    delivery.write_text(tmp_path, lambda: "the text")
    delivery.write(tmp_path, lambda path: path.write_bytes(b""))
    with pytest.raises(typer.Exit):
        delivery.tell()
    told = capsys.readouterr()
    assert told.out == "the text\n"
    assert "printed instead" in told.err
    assert "no room in the temporary folder either" in told.err


# What happens to any command


@pytest.mark.parametrize("command", [*START, "demo"])
@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (KeyboardInterrupt(), 130, "lagros: interrupted"),
        (OSError(errno.ENOSPC, "No space left on device"), 1, "No space left on device"),
        (OSError(errno.EIO, "Input/output error", "a/b"), 1, "lagros: a/b: Input/output error"),
        (MemoryError(), 1, "memory"),
    ],
    ids=["ctrl-c", "disk", "file", "memory"],
)
def test_what_ends_a_command_is_said_in_one_line(
    tmp_path, monkeypatch, command, error, status, text
):
    def ends(*_, **__):
        raise error

    monkeypatch.chdir(tmp_path)
    for name in WORK:
        monkeypatch.setattr(name, ends)
    more = ["--video", "x.gif"] if command == "watch" else []
    result = CliRunner().invoke(cli.app, [*START.get(command, command).split(), *more])
    # An attack may be told of a file that is not there.
    assert result.exit_code in (status, 2 if command == "attack" else status), result.output
    assert text in result.stderr
    assert sum(line.startswith("lagros: ") for line in result.stderr.splitlines()) == 1
    assert isinstance(result.exception, SystemExit)
