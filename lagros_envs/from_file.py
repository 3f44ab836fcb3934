"""Imports files that users name, under module names that say where the file is.

A process that unpickles a task of such a file, a worker or a spawned one, imports that name and so
finds the file again: nothing has to be sent along. The file has to be at the same place there.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType

from lagros_envs.checks import shown

# So that Python takes this module for a package and asks for what is in it.
__path__: list[str] = []


def imported(path: Path) -> ModuleType:
    """Import a file, again if it has changed since.

    Raises:
        ValueError: There is no such file, or it cannot be imported; the message says where.
    """
    path = path.expanduser().resolve()
    if not path.is_file():
        raise ValueError(f"task={shown(str(path))}: there is no such file")
    readable = re.sub(r"\W", "_", path.stem)
    name = f"{__name__}.{readable}_{str(path).encode().hex()}"
    changed = path.stat().st_mtime_ns
    module = sys.modules.get(name)
    if module is not None and module.__dict__.get("__changed__") != changed:
        del sys.modules[name]
    try:
        module = importlib.import_module(name)
    except (Exception, SystemExit) as error:
        line = _line_of(error, path)
        raise ValueError(
            f"{path}{line and f', line {line}'}: {type(error).__name__}: {error}"
        ) from error
    module.__dict__["__changed__"] = changed
    return module


def _line_of(error: BaseException, path: Path) -> int | None:
    """Return the last line of the file on the way to an error."""
    line = error.lineno if isinstance(error, SyntaxError) else None
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == str(path):
            line = trace.tb_lineno
        trace = trace.tb_next
    return line


class _Finder:
    """Finds the file that the name of a module stands for."""

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return where a module of this package is; None for any other."""
        package, _, own = name.rpartition(".")
        if package != __name__:
            return None
        try:
            place = Path(bytes.fromhex(own.rpartition("_")[2]).decode())
        except ValueError:
            return None
        if not place.is_file():
            return None
        if str(place.parent) not in sys.path:
            # Last, so that what the file imports from beside it hides nothing.
            sys.path.append(str(place.parent))
        return spec_from_file_location(name, place)


if not any(isinstance(finder, type) and finder.__name__ == "_Finder" for finder in sys.meta_path):
    sys.meta_path.append(_Finder)
