"""Every option of every command, and what a hand may put there by mistake.

A new option fails `test_every_option_has_a_row` until it has a row in `ROWS`. Nothing here may
begin any work: what is wrong is refused before it, in one line that names the option.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import pytest
import typer.main
from typer.testing import CliRunner

from lagros_benchmarks.commands import cli
from lagros_benchmarks.commands.terminal import task_in_preset

LONG = "x" * 100_000
NAMES = ("", "nonsense", "None", "ünï🚀", "a b", "-", "--", LONG, "a\0b", "a\nb", "../x")
POLICIES = (
    *NAMES,
    "absent.zip",
    "sac:absent.zip",
    "folder.zip",
    "a:",
    ":x",
    "..:x",
    "../mine:Good",
    "a:b:c",
    "no_module_of_that_name:Class",
)
TEXTS_NO_NUMBER = ("", "x", "True", "None", "0x10", "1,5", "٣x", "🚀", LONG, "a\0b")
WHOLE = (*TEXTS_NO_NUMBER, "1.5", "1e3", "nan", "inf", "-1", "9" * 400, "9" * 5000)
POSITIVE_WHOLE = (*WHOLE, "0", "1000000000000")
# No flight stays a number beyond.
BOUND = ("1e7", "1e300")
NUMBER = (*TEXTS_NO_NUMBER, "nan", "inf", "-inf", "1e400", "-1")
POSITIVE = (*NUMBER, "0", "-0.0")


def lists(values: Sequence[str], good: str) -> tuple[str, ...]:
    """Return bad lists: of bad entries, with an empty entry, with one entry twice."""
    commas = (",", ",,", f"{good},", f",{good}", f"{good},,{good}", f"{good},{good}")
    return (*(value for value in values if "," not in value), f"{good},{values[1]}", *commas)


FILES = {
    "folder": "a folder",
    "absent/absent": "nothing there",
    "empty": "an empty file",
    "binary": "bytes of no format",
    "text": "a text of no format",
    "beneath/absent": "a file where its folder should be",
    "pipe": "a pipe",
    "": "no name",
    LONG: "too long a name",
    "a\0b": "a name with a null byte",
    "ünï🚀\n": "a name of letters that few have",
}
READ = tuple(FILES)
WRITTEN = ("folder", "beneath/absent", "", LONG, "a\0b")
FIGURES = (*WRITTEN, "figure", "figure.gif", "figure.", "png", ".png")
FOLDERS = ("text", "beneath/absent", "", LONG, "a\0b")
FLAG = ("",)  # any value is one too many


@dataclass(frozen=True)
class Row:
    """What an option refuses.

    Attributes:
        values: Bad values.
        bases: Command lines that it stands in.
        idle: Command lines in which its good value does nothing, and is refused.
        good: That value; None for a flag.
    """

    values: Sequence[str]
    bases: Sequence[str] = ("cartpole", "spacecraft")
    idle: Sequence[str] = ()
    good: str | None = field(default=None)


CARTPOLE, SPACECRAFT = ("cartpole",), ("spacecraft",)
MINARI = ("--minari",)
KINDS = lists(NAMES, "gust")
BENCH = {
    "--policies": Row(lists(POLICIES, "lagros")),
    "--episodes": Row(POSITIVE_WHOLE),
    "--seed": Row(WHOLE),
    "--disturbance": Row(KINDS),
    "--bound": Row(
        lists((*NUMBER, *BOUND), "0.5"), idle=("cartpole --disturbance none",), good="0.5"
    ),
    "--channels": Row(NAMES),
    "--agents": Row(lists(POSITIVE_WHOLE, "3"), SPACECRAFT, CARTPOLE, "3"),
    "--preset": Row(NAMES, SPACECRAFT, CARTPOLE, "open"),
    "--safety-filter": Row(NAMES, SPACECRAFT, CARTPOLE, "both"),
    "--jobs": Row(POSITIVE_WHOLE),
    "--backend": Row(NAMES),
    "--address": Row(("",), ("cartpole --backend dask",), ("cartpole",), "tcp://127.0.0.1:1"),
    "--timing-episodes": Row(POSITIVE_WHOLE),
    "--guarantee": Row(FLAG, CARTPOLE, SPACECRAFT),
    "--quiet": Row(FLAG),
    "--initial-error": Row(NUMBER, CARTPOLE, SPACECRAFT, "0.1"),
    "--replan-every": Row(POSITIVE_WHOLE, CARTPOLE, ("spacecraft", "cartpole --policies lqr"), "2"),
    "--json": Row(WRITTEN),
    "--csv": Row(WRITTEN),
    "--latex": Row(WRITTEN),
    "--markdown": Row(WRITTEN),
    "--figure": Row(FIGURES),
    "--scene": Row(FIGURES, SPACECRAFT, CARTPOLE, "scene.png"),
    "--scene-world": Row(
        (*WHOLE, "50"), ("spacecraft --scene scene.png",), ("spacecraft", "cartpole"), "1"
    ),
    "--episodes-file": Row(WRITTEN),
    "--html": Row(WRITTEN),
    "--out": Row(FOLDERS),
}
REPRODUCE = {
    "--out": Row(FOLDERS),
    "--jobs": Row(POSITIVE_WHOLE),
    "--backend": Row(NAMES),
    "--address": Row(("",), ("cartpole --backend dask",), ("cartpole",), "tcp://127.0.0.1:1"),
    "--episodes": Row(POSITIVE_WHOLE),
    "--shipped-weights": Row(FLAG),
    "--quiet": Row(FLAG),
}
WATCH = {
    "--policy": Row(POLICIES),
    "--agents": Row(POSITIVE_WHOLE, SPACECRAFT, CARTPOLE, "3"),
    "--preset": Row(NAMES, SPACECRAFT, CARTPOLE, "open"),
    "--disturbance": Row((*NAMES, "worst")),
    "--bound": Row((*NUMBER, *BOUND), idle=("cartpole --disturbance none",), good="0.5"),
    "--seed": Row(WHOLE),
    "--scenario": Row(READ, SPACECRAFT, CARTPOLE, "scenario.json"),
    "--safety-filter": Row(FLAG, SPACECRAFT, CARTPOLE),
    "--video": Row((*WRITTEN, "film", "film.avi", "film.", ".gif")),
    "--html": Row(WRITTEN),
    "--browser": Row(FLAG),
    "--quiet": Row(FLAG),
    "--speed": Row(POSITIVE),
    "--seconds": Row(POSITIVE),
}
EXPORT = {
    "--format": Row(NAMES, ("lagros-cartpole",)),
    "--out": Row(WRITTEN, ("lagros-cartpole", "lagros-spacecraft --format onnx")),
    "--weights": Row(READ, ("lagros-cartpole", "learned-spacecraft")),
    "--tanh": Row(
        NAMES,
        ("lagros-cartpole",),
        ("lagros-cartpole --format onnx", "lagros-spacecraft"),
        "libm",
    ),
    "--preset": Row(NAMES, ("lagros-spacecraft",), ("lagros-cartpole",), "open"),
    "--agents": Row(POSITIVE_WHOLE, ("lagros-spacecraft",), ("lagros-cartpole",), "3"),
}
CERTIFY = {
    "--metric": Row(READ),
    "--policy": Row(NAMES),
    "--json": Row(WRITTEN),
    "--bound": Row((*POSITIVE, *BOUND)),
    "--episodes": Row(WHOLE),
    "--seconds": Row(POSITIVE),
    "--largest": Row(FLAG, CARTPOLE, SPACECRAFT),
    "--quiet": Row(FLAG),
}
TRAIN = {
    "--algo": Row((*lists(NAMES, "ppo"), "lqr")),
    "--seed": Row((*lists(WHOLE, "1"), str(1 << 32))),
    "--out": Row(FOLDERS),
    "--segments": Row((*POSITIVE_WHOLE, "65536")),
    "--residual": Row((*POSITIVE, "41"), CARTPOLE, SPACECRAFT, "4"),
    "--preset": Row(NAMES, SPACECRAFT, CARTPOLE, "open"),
    "--agents": Row(POSITIVE_WHOLE, SPACECRAFT, CARTPOLE, "3"),
    "--parallel-env": Row(FLAG, SPACECRAFT, CARTPOLE),
    "--tensorboard": Row(FLAG),
    "--quiet": Row(FLAG),
    "--json": Row(WRITTEN),
    "--figure": Row(FIGURES),
}
ATTACK = {
    "--policy": Row((*POLICIES, "random")),
    "--goal": Row(NAMES),
    "--bound": Row((*POSITIVE, *BOUND)),
    "--episodes": Row(POSITIVE_WHOLE),
    "--budget": Row(POSITIVE_WHOLE),
    "--seed": Row(WHOLE),
    "--method": Row(NAMES, CARTPOLE, SPACECRAFT, "cma"),
    "--safety-filter": Row(FLAG, SPACECRAFT, CARTPOLE),
    "--proved-filter": Row(FLAG, SPACECRAFT, CARTPOLE),
    "--agents": Row(POSITIVE_WHOLE, SPACECRAFT, CARTPOLE, "3"),
    "--preset": Row(NAMES, SPACECRAFT, CARTPOLE, "open"),
    "--json": Row(WRITTEN),
    "--npz": Row(WRITTEN),
    "--replay": Row(READ),
}
# With a file to fly again, what says how to search does nothing.
ATTACK |= {
    option: Row(row.values, row.bases, (*row.idle, "cartpole --replay text"), row.good or good)
    for option, good in {
        "--goal": "tube",
        "--bound": "0.5",
        "--episodes": "3",
        "--budget": "9",
        "--seed": "1",
        "--json": "a.json",
        "--npz": "a.npz",
    }.items()
    for row in [ATTACK[option]]
}
DATA = {
    "--minari": Row(FLAG, ("",)),
    "--quiet": Row(FLAG, ("",)),
    "--task": Row(NAMES, MINARI),
    "--episodes": Row(POSITIVE_WHOLE, MINARI),
    "--seed": Row(WHOLE, MINARI),
    "--disturbance": Row((*NAMES, "worst"), MINARI),
    "--bound": Row((*NUMBER, *BOUND), MINARI, ("--minari --disturbance none",), "0.5"),
    "--out": Row(FOLDERS, MINARI),
}
SUITE = {
    "--policies": Row(lists(POLICIES, "lagros"), CARTPOLE),
    "--episodes": Row(POSITIVE_WHOLE, CARTPOLE),
    "--fewer": Row(
        ("", "mpc", "mpc=", "=3", "mpc=x", "mpc=0", "mpc=1.5", "mpc=201", "mpc=2,", LONG), CARTPOLE
    ),
    "--worlds": Row(POSITIVE_WHOLE, SPACECRAFT),
    "--disturbance": Row(KINDS),
    "--initial-error": Row(NUMBER, CARTPOLE),
    "--proved": Row(WHOLE, CARTPOLE),
    "--worst": Row(WHOLE, CARTPOLE),
    "--worst-flights": Row(POSITIVE_WHOLE, CARTPOLE),
    "--seed": Row(WHOLE),
    "--jobs": Row(POSITIVE_WHOLE),
    "--from": Row(READ),
    "--json": Row(WRITTEN),
    "--markdown": Row(WRITTEN),
    "--figure": Row(FIGURES),
    "--out": Row(FOLDERS),
    "--quiet": Row(FLAG),
    "tasks": Row(NAMES, ("",)),
}
ROWS = {
    "": {"--version": Row(FLAG, ("",))},
    "bench": BENCH | {"task": Row(NAMES, ("",))},
    "demo": {"--quiet": Row(FLAG, ("",))},
    "reproduce": REPRODUCE | {"task": Row(NAMES, ("",))},
    "watch": WATCH | {"task": Row(NAMES, ("",))},
    "export": EXPORT | {"policy": Row((*NAMES, "lqr"), ("",)), "task": Row(NAMES, ("",))},
    "certify": CERTIFY | {"task": Row(NAMES, ("",))},
    "train": TRAIN | {"task": Row(NAMES, ("",))},
    "attack": ATTACK | {"--quiet": Row(FLAG), "task": Row(NAMES, ("",))},
    "data export": DATA,
    "suite": SUITE,
    "new": {
        "file": Row((".", "../x", "a b.py", "ünï🚀.py"), ("",)),
        "--discs": Row(FLAG, ("x.py",)),
    },
    "check": {
        "task": Row(NAMES, ("",)),
        "--episodes": Row(POSITIVE_WHOLE, CARTPOLE),
        "--seed": Row(WHOLE),
        "--json": Row(WRITTEN),
        "--quiet": Row(FLAG),
    },
    "doctor": {"--json": Row(FLAG, ("",))},
    "leaderboard": {
        "--rerun": Row((*WHOLE, "201"), ("text",)),
        "--trust": Row(("",), ("text --rerun 1",), ("text",), "mine:Mine"),
        "--markdown": Row(WRITTEN, ("text",)),
        "--quiet": Row(FLAG, ("text",)),
        "files": Row(("absent.json", "folder", ""), ("",)),
    },
}


COMMAND = typer.main.get_command(cli.app)


def commands() -> Iterator[tuple[str, object]]:
    """Yield the name of every command, "" for the program itself, and the command."""

    def walk(name: str, command) -> Iterator[tuple[str, object]]:
        yield name, command
        for inner, found in getattr(command, "commands", {}).items():
            yield from walk(f"{name} {inner}".strip(), found)

    yield from walk("", COMMAND)


def options(command) -> set[str]:
    """Return the options of a command, and its arguments by name."""
    found = {parameter.opts[0] for parameter in command.params}
    flags = {other for parameter in command.params for other in parameter.secondary_opts}
    return (found | flags) - {"--help"}


def test_every_option_has_a_row():
    for name, command in commands():
        assert options(command) == set(ROWS.get(name, {})), name
    assert set(ROWS) <= {name for name, _ in commands()}


class BeganError(Exception):
    """Work began although an option was wrong."""


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    """Run a command where any work, and whatever is written, is seen."""

    def begin(*_, **__):
        raise BeganError

    for place in (
        "commands.cli.run_and_report",
        "run.reproduction.reproduce",
        "report.playback.Playback.play",
        "tasks.cartpole.certify.cartpole_proofs",
        "evidence.single.evidence_of",
        "tasks.spacecraft.certify.make_worlds",
        "tasks.spacecraft.certify._of_the_network",
        "commands.train._train_one",
        "run.suite.fly_task",
        "worst_case.attack.run_attack",
        "worst_case.attack.fly_again",
        "commands.export._written",
    ):
        monkeypatch.setattr(f"lagros_benchmarks.{place}", begin)
    monkeypatch.setattr("lagros_benchmarks.run.demonstrations.demonstrate", begin)
    monkeypatch.setenv("COLUMNS", "500")
    # Building the commands takes nine tenths of a call that refuses.
    monkeypatch.setattr("typer.testing._get_command", lambda _: COMMAND)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "kept").touch()
    (tmp_path / "beneath").touch()
    (tmp_path / "empty").touch()
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    (tmp_path / "text").write_text("[1, 2\n")
    os.mkfifo(tmp_path / "pipe")
    before = sorted(tmp_path.rglob("*"))

    def run(arguments: Sequence[str]):
        result = CliRunner().invoke(cli.app, arguments)
        assert sorted(tmp_path.rglob("*")) == before, arguments
        return result

    return run


def words(name: str, base: str) -> list[str]:
    return [*name.split(), *base.split()]


def check_refused(result, option: str, arguments: Sequence[str]) -> None:
    """Check that a command ended with a line that names the option."""
    told = [argument[:40] for argument in arguments]
    assert isinstance(result.exception, SystemExit), (told, result.exception)
    assert result.exit_code in (1, 2), told
    assert "Traceback" not in result.output, told
    assert option in result.output, (told, result.output[:500])
    assert len(result.output) < 3000, told


CASES = [(name, option) for name, rows in ROWS.items() for option in rows]


@pytest.mark.parametrize(("name", "option"), CASES)
def test_a_bad_value_is_refused_by_the_options_name_before_any_work(invoke, name, option):
    row = ROWS[name][option]
    for base in row.bases:
        for value in row.values:
            if option.startswith("--"):
                # With "=", so that a value may begin with a dash.
                arguments = [*words(name, base), f"{option}={value}"]
            else:
                arguments = [*words(name, base), "--", value]
            check_refused(invoke(arguments), option, arguments)


@pytest.mark.parametrize(("name", "option"), [(a, b) for a, b in CASES if ROWS[a][b].idle])
def test_an_option_that_would_do_nothing_is_refused_by_its_name(invoke, name, option):
    row = ROWS[name][option]
    for base in row.idle:
        value = [] if row.good is None else [row.good]
        arguments = [*words(name, base), option, *value]
        check_refused(invoke(arguments), option, arguments)


@pytest.mark.parametrize("name", [name for name in ROWS if name], ids=str)
def test_an_unknown_option_and_an_argument_too_many_are_refused(invoke, name):
    for arguments in (["--nonsense"], ["--nonsense=1"], ["a", "b", "c"]):
        result = invoke([*name.split(), *arguments])
        assert isinstance(result.exception, SystemExit)
        assert result.exit_code == 2
        assert "Traceback" not in result.output


VALUED = [
    (name, option)
    for name, command in commands()
    for parameter in command.params
    for option in parameter.opts
    if option.startswith("--") and not parameter.is_flag
]


@pytest.mark.parametrize(("name", "option"), VALUED)
def test_an_option_that_stands_twice_is_refused(invoke, name, option):
    for twice in ([option, "1", option, "1"], [f"{option}=1", f"{option}=2"]):
        arguments = [*words(name, ROWS[name][option].bases[0]), *twice]
        result = invoke(arguments)
        check_refused(result, option, arguments)
        assert "stands twice" in result.output


@pytest.mark.parametrize(
    "arguments",
    [
        ["bench", "cartpole", "--bound", "nan"],
        ["watch", "spacecraft", "--scenario", "binary"],
        ["attack", "cartpole", "--replay", "binary"],
        ["train", "cartpole", "--seed", "1,,2"],
        ["export", "lagros-cartpole", "--weights", "binary"],
    ],
    ids=" ".join,
)
def test_the_installed_program_refuses_in_one_line_too(tmp_path, arguments):
    (tmp_path / "folder").mkdir()
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    done = subprocess.run(
        [sys.executable, "-m", "lagros_benchmarks", *arguments],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode in (1, 2)
    assert done.stderr.startswith("lagros: ")
    assert done.stderr.count("\n") == 1
    assert arguments[2] in done.stderr
    assert not done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["binary", "folder"]


def test_a_preset_of_one_body_is_a_task_and_that_of_many_agents_an_option():
    assert task_in_preset("quadrotor", "10") == ("quadrotor-10", None)
    assert task_in_preset("quadrotor", "9") == ("quadrotor", None)
    assert task_in_preset("spacecraft", "open") == ("spacecraft", "open")
    # One body without presets: whoever asks for one is told so by the command.
    assert task_in_preset("pvtol", "open") == ("pvtol", "open")
    with pytest.raises(ValueError, match=r"unknown preset '12' of quadrotor.*Valid: 9, 10"):
        task_in_preset("quadrotor", "12")
