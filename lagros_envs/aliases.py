"""Old names of modules that have moved: they import what is at the new place, with a warning.

Each package has a table in its `tasks/moved.py`. The names go with the next release.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any


def install(moved: Mapping[str, str]) -> None:
    """Let old names import what they stand for.

    Args:
        moved: The new name of each module or package by its old one; names below a package move
            along with it.
    """
    # First, since a package that has moved would find its old modules once more at the new place.
    sys.meta_path.insert(0, Moved(moved))


def moved_names(module: str) -> None:
    """Let a module find names that have left it, by the table of its package.

    It is not assigned there as `__getattr__`: type checkers would take every name for known.
    """

    def find(name: str) -> Any:
        table = importlib.import_module(f"{module.partition('.')[0]}.tasks.moved")
        homes = table.NAMES[module]
        home = homes if isinstance(homes, str) else homes.get(name)
        if home is None or name.startswith("__"):
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(home), name)
        _warn(f"{module}.{name}", f"{home}.{name}")
        return value

    vars(sys.modules[module])["__getattr__"] = find


class Moved(MetaPathFinder):
    """Finds modules by their old names.

    Args:
        moved: As in `install`.
    """

    def __init__(self, moved: Mapping[str, str]) -> None:
        self._moved = moved
        self._packages = {name.partition(".")[0] for name in moved}

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return where a module is now; None for one that has not moved."""
        if name.partition(".")[0] not in self._packages:
            return None
        package = name.rpartition(".")[0]
        unmoved = sys.modules[package].__name__ == package if package in sys.modules else False
        if name in self._moved and unmoved and PathFinder.find_spec(name, path) is not None:
            # Another module has this name now.
            return None
        old, below = name, ""
        while old and old not in self._moved:
            old, _, last = old.rpartition(".")
            below = f".{last}{below}"
        return ModuleSpec(name, _Alias(self._moved[old] + below)) if old else None


class _Alias(Loader):
    """Gives a module that has another name already.

    Args:
        name: That name.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._spec: ModuleSpec | None = None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(self._name)
        _warn(spec.name, self._name)
        self._spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        # Python has just written the old name's into it.
        module.__spec__ = self._spec


def _warn(old: str, new: str) -> None:
    text = f"{old} has moved to {new}; the old name goes with the next release"
    # Of who imports; what Python has in between does not count.
    warnings.warn(text, DeprecationWarning, stacklevel=3)
