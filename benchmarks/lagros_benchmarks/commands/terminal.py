"""What the commands say on the terminal: errors without a traceback, lists, progress."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import typer
from typer.core import TyperCommand, TyperGroup

from lagros_benchmarks.commands.extras import install_hint
from lagros_benchmarks.commands.streams import patient_streams
from lagros_benchmarks.run.process import no_exit

if TYPE_CHECKING:
    from rich.console import Console

    from lagros_benchmarks.run.workers import Progress

USAGE_ERROR = 2
# What a shell gives a process that Ctrl-C has ended: 128 and the number of the signal.
INTERRUPTED = 130

Value = TypeVar("Value")
# An option that several commands have.
BOUND = typer.Option(
    metavar="D",
    help="Bound d̄ of the disturbance, in units of the state per second; the task's own if not "
    "given.",
)
BACKEND = typer.Option(
    help="Where the workers run: loky (this machine), or a cluster of ray or dask."
)
ADDRESS = typer.Option(
    help="Of a running cluster of ray or dask, which is used with the workers that it has."
)
# Read by `progress_bar` and `progress_line`, so that no command passes it on.
QUIET = typer.Option("--quiet", help="No progress on the error stream; nor is there without one.")
# The command that runs.
_CONTEXT: ContextVar[Any] = ContextVar("context", default=None)
# How the settings begin a message on one of their fields.
_FIELD = re.compile(
    r"(\w+)=|unknown ([\w ]+?) ['\"]|(\w+) must not be empty|(\w+) ['\"]|"
    r"there is no (?:file|module) .+ for (?:a|the) (\w+)"
)
_SHOWN = 60  # letters of an entry in a message
_LONGEST = 800  # letters of a message


def file_option(explanation: str) -> Any:
    """Return the option of a file that is read or written."""
    return typer.Option(metavar="FILE", dir_okay=False, help=explanation)


def fail(error: Exception | str, status: int = USAGE_ERROR) -> NoReturn:
    """Say what is wrong, without a traceback, and end with the exit status."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        text = error.strerror
        text = text if error.filename is None else f"{error.filename}: {text}"
    text = _shortened(_named_by_option(text))
    if isinstance(error, Exception) and "pip install" not in text:
        text += install_hint(error)
    typer.echo(f"lagros: {text}", err=True)
    raise typer.Exit(status)


class Command(TyperCommand):
    """A command that is known, while it runs, to what is said of its options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Refuse what no option can mean: nothing at all, what no system takes in a name, two."""
        for before, argument in zip(["", *args], args, strict=False):
            option, equals, value = argument.partition("=")
            if not (equals and option.startswith("--")):
                option, value = before, argument
            if not value or "\0" in value:
                what = "a null byte" if value else "empty"
                raise typer.BadParameter(
                    f"it is {what}; give a value, or leave the option out",
                    ctx=ctx,
                    param_hint=repr(option if option.startswith("--") else self.name),
                )
        self._refuse_twice(ctx, args)
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help, in which {tasks} and such stand for what the registry says."""
        from lagros_benchmarks.commands.described import described

        for parameter in self.params:
            text: str | None = getattr(parameter, "help", None)
            if text and "{" in text:
                parameter.help = text.format_map(described())  # type: ignore[attr-defined]
        super().format_help(ctx, formatter)

    def _refuse_twice(self, ctx: Any, args: list[str]) -> None:
        """Refuse an option that stands twice, of which only the last value would count."""
        takes_value = {
            name
            for parameter in self.params
            if not (getattr(parameter, "is_flag", False) or parameter.multiple)
            for name in parameter.opts
        }
        given: set[str] = set()
        left = iter(args)
        for argument in left:
            option, equals, _ = argument.partition("=")
            if argument == "--":
                return
            if option not in takes_value or not option.startswith("--"):
                continue
            if option in given:
                raise typer.BadParameter(
                    "it stands twice; give it once", ctx=ctx, param_hint=repr(option)
                )
            given.add(option)
            if not equals:
                next(left, None)

    def invoke(self, context: Any) -> Any:
        """Run it."""
        try:
            os.getcwd()
        except OSError:
            fail("the folder that it was started in is no longer there; go to another", status=1)
        token = _CONTEXT.set(context)
        try:
            return super().invoke(context)
        finally:
            _CONTEXT.reset(token)


def options_given(but: Collection[str] = ()) -> list[str]:
    """Return the options that stand on the command line, such as "--bound", but for some."""
    context = _CONTEXT.get()
    if context is None:
        return []
    return [
        option
        for option, name in _options(context).items()
        if option not in but and context.get_parameter_source(name).name == "COMMANDLINE"
    ]


def refuse_options(given: Collection[str], why: str) -> None:
    """Refuse options that would do nothing, and say why, of those that stand on the command line.

    Raises:
        ValueError: One stands there.
    """
    idle = [option for option in options_given() if option in given]
    if idle:
        raise ValueError(f"{', '.join(idle)}: {why}; leave it out")


def _options(context: Any) -> dict[str, str]:
    """Return the parameters' names by their options."""
    return {
        parameter.opts[0]: parameter.name
        for parameter in context.command.params
        if parameter.opts[0].startswith("--")
    }


def interrupted(note: str = "") -> NoReturn:
    """Say that Ctrl-C has ended a command, and what remains, and end with its exit status."""
    typer.echo(f"lagros: interrupted{note}", err=True)
    raise typer.Exit(INTERRUPTED)


def _named_by_option(text: str) -> str:
    """Put the option before a message of the settings, which know the field but not the option."""
    context = _CONTEXT.get()
    if context is None:
        return text
    options = _options(context)
    if any(re.search(rf"{option}\b", text) for option in options):
        return text
    said = _FIELD.match(text)
    field = next(filter(None, said.groups())) if said else ""
    for option, name in options.items():
        if _stem(name) == _stem(field):
            return f"{option}: {text}"
    for option, name in options.items():
        value = context.params.get(name)
        if isinstance(value, Path) and _speaks_of(text, value):
            return f"{option}: {text}"
    return text


def _speaks_of(text: str, path: Path) -> bool:
    """Return whether a message names a path, alone or as the folder of another."""
    names = {re.escape(name) for name in (str(path), repr(str(path))[1:-1])}
    return re.search(rf"(^|[\s'\"(])({'|'.join(names)})([\s'\":,;)/]|$)", text) is not None


def _shortened(text: str) -> str:
    """Return a message on one line and of a length that can be read."""
    line = " ".join(text.split())
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} … {line[-_LONGEST // 2 :]}"


def _stem(name: str) -> str:
    """Return a name of a field or an option in one number and spelling."""
    plain = name.replace(" ", "_").removeprefix("num_")
    return f"{plain[:-3]}y" if plain.endswith("ies") else plain.removesuffix("s")


class Commands(TyperGroup):
    """All commands: what happens to any of them, and is no mistake of the program, in one line."""

    def main(self, *args: Any, **options: Any) -> Any:
        """Run a command; see `patient_streams` for what it prints."""
        with patient_streams(), no_exit():
            return super().main(*args, **options)

    def invoke(self, context: Any) -> Any:
        """Run a command; a full disk, a Ctrl-C, a missing package end it with one line."""
        try:
            return super().invoke(context)
        except KeyboardInterrupt:
            interrupted()
        except ModuleNotFoundError as error:
            if not install_hint(error):
                raise
            fail(error, status=1)
        except MemoryError:
            fail("the memory is too small for what was asked for", status=1)
        except OSError as error:
            fail(error, status=1)


def find_users_modules(policies: Iterable[str]) -> None:
    """Let a policy of the user's own, module:Class, lie in the folder that lagros is run from.

    The folder comes last: no file in it can take the place of a package that is installed. It is
    not searched at all where no policy is named so.
    """
    here = os.getcwd()
    if any(":" in name for name in policies) and here not in sys.path:
        sys.path.append(here)


def task_in_preset(task: str, preset: str | None) -> tuple[str, str | None]:
    """Return the task that is meant, and what is left of a preset: that of worlds of agents.

    Raises:
        ValueError: There is no such task, or one body has no such preset.
    """
    from lagros_envs.registry import called, find_any, in_preset

    if preset is None:
        return task, None
    found = find_any(task)
    if found.most_agents > 1 or not found.presets:
        return task, preset
    return called(in_preset(found, preset)), None


def listed(
    text: str | Sequence[str], convert: Callable[[str], Value], option: str
) -> tuple[Value, ...]:
    """Split a comma-separated option, or take its entries as they are, and convert each.

    Raises:
        ValueError: An entry is empty, or cannot be converted; the message names the option.
    """
    values = []
    entries = [part.strip() for part in text.split(",")] if isinstance(text, str) else text
    for entry in entries:
        shown = repr(entry if len(entry) <= _SHOWN else f"{entry[:_SHOWN]}…")
        if not entry:
            raise ValueError(f"{option}: an entry is empty; write them as a,b without a comma more")
        try:
            values.append(convert(entry))
        except ValueError:
            kind = "a whole number" if convert is int else "a number"
            raise ValueError(f"{option}: {shown} is not {kind}") from None
    return tuple(values)


def listed_or_none(
    text: str | Sequence[str] | None, convert: Callable[[str], Value], option: str
) -> tuple[Value, ...] | None:
    """Split a comma-separated option that may be left out; see `listed`."""
    return None if text is None else listed(text, convert, option)


def progress_line(line: str) -> None:
    """Print a line above the progress bar, unless the command is to be quiet."""
    if not _is_quiet():
        typer.echo(line, err=True)


def _is_quiet() -> bool:
    context = _CONTEXT.get()
    return context is not None and bool(context.params.get("quiet"))


@contextmanager
def progress_bar(console: Console | None = None) -> Iterator[Progress]:
    """Give a function that draws progress and the time left on the terminal's error stream.

    Nothing is drawn where that is no terminal, or where the command is to be quiet.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    console = console or Console(stderr=True)
    with Bar(
        TextColumn("{task.description:<9}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=console,
        transient=True,
        # The speed is that of the last hour: one of the last half minute would know none of
        # chunks that take longer.
        speed_estimate_period=3600.0,
        # Where nothing moves, all that would be left of it is an empty line.
        disable=not console.is_terminal or _is_quiet(),
    ) as bar:
        tasks: dict[str, Any] = {}

        def update(title: str, done: int, total: int) -> None:
            if title not in tasks:
                tasks[title] = bar.add_task(title, total=total)
            bar.update(tasks[title], completed=done)

        yield update
