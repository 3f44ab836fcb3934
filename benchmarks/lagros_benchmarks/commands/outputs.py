"""The files of a command: refused before the work or written after it, each on its own."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from lagros_benchmarks.commands.extras import install_hint

if TYPE_CHECKING:
    from lagros_envs.files import Writable

# What a command asks for or reads, by the option that names it; None where it is left out.
Paths = Mapping[str, Path | None]
_ANY = ".lagros"  # a name that no file of ours has


def check_outputs(
    outputs: Paths,
    inputs: Paths | None = None,
    folders: Paths | None = None,
    kept: Path | None = None,
) -> tuple[Path, ...]:
    """Check by trying that all files of a command can be written, and make their folders.

    Args:
        outputs: What the command writes.
        inputs: What it reads, and must not write over.
        folders: Where it writes files of its own choice.
        kept: Folder where it keeps its work if it can, and goes on without if it cannot.

    Returns:
        The folders that were made.

    Raises:
        ValueError: One cannot be written, two are one file, one is a folder of another, or one is
            what the command reads.
    """
    from lagros_envs.files import remove_folders

    _check_nesting(outputs, {**(folders or {}), "finished work": kept})
    seen: dict[object, str] = {}
    for option, path in (inputs or {}).items():
        # What cannot be looked at is no file, and is refused by whoever reads it.
        with suppress(OSError, ValueError):
            if path is not None and path.is_file():
                status = path.stat()
                seen[status.st_dev, status.st_ino] = f"what {option} reads"
    made: tuple[Path, ...] = ()
    try:
        for option, path in outputs.items():
            if path is None:
                continue
            found = _writable(option, path, path)
            made += found.made
            if found.place in seen:
                raise ValueError(
                    f"{option}: {str(path)!r} is {seen[found.place]}, too; name another file"
                )
            if found.place is not None:
                seen[found.place] = f"the file of {option}"
        for option, path in (folders or {}).items():
            if path is not None:
                made += _writable(option, path / _ANY, path).made
    except ValueError:
        remove_folders(made)
        raise
    return made


def _check_nesting(outputs: Paths, folders: Paths) -> None:
    """Check that no file has the name of a folder that another output needs.

    Raises:
        ValueError: One has.
    """
    needed = {option: path for option, path in folders.items() if path is not None}
    needed |= {option: path.parent for option, path in outputs.items() if path is not None}
    for option, path in outputs.items():
        if path is None:
            continue
        file = os.path.realpath(path)
        for other, folder in needed.items():
            place = Path(os.path.realpath(folder))
            if file in map(str, (place, *place.parents)):
                raise ValueError(
                    f"{option}: {str(path)!r} is a folder of {other}; name another file"
                )


def policy_files(policies: Iterable[str]) -> dict[str, Path]:
    """Return the policies that are files, which may be written algorithm:file, as inputs."""
    from lagros_policies.naming import model_file

    models = filter(None, map(model_file, policies))
    return {f"the policy {model.path}": model.path for model in models}


def _writable(option: str, path: Path, named: Path) -> Writable:
    from lagros_envs.files import check_writable

    try:
        return check_writable(path)
    except OSError as error:
        raise ValueError(
            f"{option}: cannot write {str(named)!r}: {error.strerror or error}; name another"
        ) from error


class Delivery:
    """Writes the files of a command, so that one that fails takes no other with it.

    What cannot be written where it was asked for is kept in a temporary folder, and where that
    fails, too, its text is printed. Write all files first, and only then `tell`.
    """

    def __init__(self) -> None:
        self.written: list[Path] = []
        self.problems: list[str] = []
        self._texts: list[str] = []

    def write(
        self, path: Path | None, write: Callable[[Path], Any], text: Callable[[], str] | None = None
    ) -> None:
        """Write one file, unless the path is None, by a function that takes it.

        The text is what to print if there is no place left; None for what is no text.
        """
        if path is None:
            return
        try:
            write(path)
        except OSError as error:
            kept = self._keep(path, write, text)
            self.problems.append(f"cannot write {str(path)!r}: {error.strerror or error}; {kept}")
        except Exception as error:
            # A figure that cannot be drawn, for instance, is not the business of the other files.
            self.problems.append(f"cannot make {str(path)!r}: {error}{install_hint(error)}")
        else:
            self.written.append(path)

    def write_text(self, path: Path | None, text: Callable[[], str]) -> None:
        """Write one file of text; see `write`."""
        from lagros_envs.files import write_atomic

        self.write(path, lambda place: write_atomic(place, text()), text)

    def tell(self, note: str = "") -> None:
        """Say what was written, with a note on it, and what was not.

        Raises:
            typer.Exit: With status 1, if a file was not written where it was asked for.
        """
        for text in self._texts:
            typer.echo(text)
        for path in self.written:
            typer.echo(f"wrote {path} ({note})" if note else f"wrote {path}")
        for problem in self.problems:
            typer.echo(f"lagros: {problem}", err=True)
        if self.problems:
            raise typer.Exit(1)

    def _keep(
        self, path: Path, write: Callable[[Path], Any], text: Callable[[], str] | None
    ) -> str:
        try:
            kept = Path(tempfile.mkdtemp(prefix="lagros-")) / path.name
            write(kept)
        except OSError:
            if text is None:
                return "there is no room in the temporary folder either"
            self._texts.append(text())
            return "it is printed instead"
        return f"it is kept as {kept}"
