"""What the chunks of a benchmark depend on, as one number."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import inspect
import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lagros_benchmarks.run.library import Toolbox
from lagros_benchmarks.run.settings import BenchmarkSettings
from lagros_benchmarks.run.surroundings import machine, threads, versions
from lagros_envs.dynamics.straight_line import statements, straight_line
from lagros_envs.foreign import Foreign
from lagros_envs.numbers import functions
from lagros_envs.task import Described, Task
from lagros_policies.naming import is_file, model_file, user_class
from lagros_policies.room import shipped_file, weights_folder

_PACKAGES = ("lagros_envs", "lagros_policies", "lagros_benchmarks")
# Modules, weights and settings that a class of the user's own may read.
_BESIDE = {
    *(".py", ".npz", ".npy", ".pt", ".pth", ".safetensors", ".zip", ".onnx", ".h5"),
    *(".json", ".yaml", ".yml", ".toml"),
}
# What changes no result; whether the work is done in parallel does, for it decides what is timed.
_FREE = ("jobs", "backend")
# What metric, plans and networks ask of a task besides its settings, equation and scenarios.
_ASKED = (
    *("metric", "feedback", "position", "body_radius", "most_discs", "margin"),
    *("state_low", "state_high", "state_scale"),
    *("control_low", "control_high", "control_scale", "control_centre", "control_spread"),
)


def fingerprint(settings: BenchmarkSettings, toolbox: Toolbox) -> str:
    """Return a hash of all that the chunks of a run depend on.

    These are the settings, the content of the files and modules that they name, our own code and
    weights, the versions of what is installed, the threads and the processor: the last digit of a
    product may depend on each.
    """
    record = {name: value for name, value in asdict(settings).items() if name not in _FREE}
    made_by, task = machine(), settings.description
    depends = {
        "settings": record,
        "parallel": settings.backend.in_parallel(settings.jobs),
        "files": {text: _digest(files) for text, files in _named_files(record)},
        "task": _digest(_task_files(task)),
        "described": described(task) if isinstance(task, Task) else _plain(repr(task)),
        "code": _own_code(),
        "toolbox": [_origin(value) for value in vars(toolbox).values()],
        "versions": versions(),
        "threads": {name: value for name, value in threads().items() if name != "torch"},
        "machine": [made_by["platform"], made_by["processor"]],
    }
    text = json.dumps(depends, sort_keys=True, default=repr)
    return hashlib.sha256(text.encode(errors="backslashreplace")).hexdigest()


def seeds_digest(seeds: Iterable[int]) -> str:
    """Return a hash of the seeds of episodes, in their order."""
    return hashlib.sha256(",".join(map(str, seeds)).encode()).hexdigest()


def policy_digest(name: str, task: Described) -> str | None:
    """Return the SHA-256 of the file that a policy flies from: weights, a model, or its module.

    Returns:
        The hash; None for a policy without such a file.
    """
    from lagros_policies.policy import policy_names

    model = model_file(name)
    if name in policy_names(task):
        path = shipped_file(task, f"{name.partition(':')[0]}.safetensors")
    elif model is not None:
        path = model.path
    else:
        # It has been imported where it has flown; nothing is imported here.
        module = sys.modules.get(_module_named(name) or "")
        path = Path(getattr(module, "__file__", None) or "")
    return hashlib.sha256(path.read_bytes()).hexdigest() if is_file(path) else None


def described(task: Task) -> dict[str, Any]:
    """Return what of a task its author may change: equation, limits, scenarios."""
    n, m = task.system.state_dim, task.system.control_dim

    def equation(numbers: Sequence[Any]) -> Sequence[Any]:
        return task.system.derivative(numbers[:n], numbers[n:], functions)

    names = [f"{kind}{index}" for kind, count in (("x", n), ("u", m)) for index in range(count)]
    lines, rates = statements(straight_line(equation, names))
    said = {name: repr(getattr(task, name)) for name in _ASKED}
    first = repr(task.sample(np.random.default_rng(0)))
    return {"settings": _plain(repr(task)), "equation": [*lines, *rates], "first": first, **said}


def _plain(text: str) -> str:
    """Return what an object says of itself without where it lies, which says nothing of it."""
    return re.sub(r" at 0x[0-9a-f]+", "", text)


def _task_files(task: Any) -> list[Path]:
    """Return the files in which a task and its system are described, and its weights."""
    folder = weights_folder(task)
    weights = sorted([folder / "metric.json", *folder.glob(f"{task.name}_*")])
    kinds = [type(task), type(getattr(task, "system", task))]
    if isinstance(task, Foreign):
        kinds.append(task.facts.source)
    return [*(path for kind in kinds for path in _python_of(kind)), *weights]


def _python_of(kind: type) -> list[Path]:
    """Return the file of a class and the modules beside it, which it may import."""
    try:
        path = Path(inspect.getsourcefile(kind) or "")
    except (OSError, TypeError):  # such as one of a notebook
        return []
    modules = [path, *path.parent.glob("*.py")]
    return sorted({*modules, *_packages_beside(path.parent, modules)})


def _named_files(value: Any) -> Iterator[tuple[str, list[Path]]]:
    """Yield each text among some settings that names a file or a module, with its files."""
    if isinstance(value, Mapping):
        for item in (*value.keys(), *value.values()):
            yield from _named_files(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _named_files(item)
    elif isinstance(value, str | Path):
        text = str(value)
        model = model_file(text)
        path = Path(text) if model is None else model.path
        if is_file(path):
            yield text, [path]
        elif (module := _module_named(text)) is not None:
            yield text, _module_files(module)


def _module_named(text: str) -> str | None:
    """Return the module of module:Class; None if the text is something else."""
    try:
        named = user_class(text)
    except ValueError:
        return None
    return None if named is None else named.module


def _module_files(module: str) -> list[Path]:
    """Return the files of a module, and those beside it, which it may import or read."""
    try:
        found = importlib.util.find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        return []
    if found is None:
        return []
    if found.submodule_search_locations:
        return [path for place in found.submodule_search_locations for path in _files(Path(place))]
    if found.origin is None:
        return []
    place = Path(found.origin).parent
    beside = [path for path in place.glob("*") if path.suffix in _BESIDE and path.is_file()]
    return sorted({*beside, *_packages_beside(place, beside)})


def _packages_beside(place: Path, modules: Iterable[Path]) -> Iterator[Path]:
    """Yield the files of the folders of a place that modules import from."""
    names: set[str] = set()
    for module in modules:
        if module.suffix == ".py":
            # What is no Python is said where it is imported.
            with suppress(OSError, SyntaxError, ValueError, RecursionError, MemoryError):
                for node in ast.walk(ast.parse(module.read_bytes())):
                    names |= _imported(node)
    for name in names:
        if (place / name).is_dir():
            yield from _files(place / name)


def _imported(node: ast.AST) -> set[str]:
    """Return the packages that a statement imports from."""
    if isinstance(node, ast.Import):
        return {alias.name.partition(".")[0] for alias in node.names}
    if isinstance(node, ast.ImportFrom) and node.module and not node.level:
        return {node.module.partition(".")[0]}
    return set()


def _files(folder: Path) -> list[Path]:
    found = (path for path in folder.rglob("*") if "__pycache__" not in path.parts)
    return sorted(path for path in found if path.is_file())


@cache
def _own_code() -> str:
    return _digest(path for package in _PACKAGES for path in _module_files(package))


def _digest(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        try:
            content = path.read_bytes()
        except OSError:  # what nobody can read changes no result
            continue
        digest.update(f"{path.name} {len(content)} ".encode(errors="backslashreplace"))
        digest.update(content)
    return digest.hexdigest()


def _origin(function: Any) -> str:
    return f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', '')}"
