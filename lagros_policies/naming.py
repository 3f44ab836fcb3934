"""What the name of a policy that is not ours means: a model's file, or a class of the user's."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

# Of stable-baselines3, whose models this package loads.
ALGORITHMS = ("A2C", "DDPG", "PPO", "SAC", "TD3")
_ENDING = ".zip"
# A name in a list that is cut at its commas has at most so many.
_MOST_COMMAS = 16


class ModelFile(NamedTuple):
    """The file of a stable-baselines3 model.

    Attributes:
        algorithm: As it was written before the path, in any case; None to detect it.
        path: The file, which need not exist.
    """

    algorithm: str | None
    path: Path


class UserClass(NamedTuple):
    """A class of the user's own.

    Attributes:
        module: As Python imports it.
        attribute: Name of the class in it.
    """

    module: str
    attribute: str


def model_file(name: str) -> ModelFile | None:
    """Return the file that a name means: PATH.zip, or ALGORITHM:PATH. None if it means none.

    A path may hold whatever the system allows, colons too: a file of just that name comes first.
    """
    found = _existing_model(name)
    if found is not None or not name.lower().endswith(_ENDING):
        return found
    first, colon, rest = name.partition(":")
    if colon and first.upper() in ALGORITHMS:
        return ModelFile(first, Path(rest))
    # Of an algorithm that is not known, which is said where the model is loaded.
    first, colon, rest = name.rpartition(":")
    if colon and first and is_file(Path(rest)):
        return ModelFile(first, Path(rest))
    return ModelFile(None, Path(name))


def _existing_model(name: str) -> ModelFile | None:
    if name.lower().endswith(_ENDING) and is_file(Path(name)):
        return ModelFile(None, Path(name))
    first, colon, rest = name.partition(":")
    if colon and first.upper() in ALGORITHMS and is_file(Path(rest)):
        return ModelFile(first, Path(rest))
    return None


def user_class(name: str) -> UserClass | None:
    """Return the class that module:Class means; None if the name has no colon, or means a file.

    Raises:
        ValueError: One of the two is no name of Python's.
    """
    module, colon, attribute = name.partition(":")
    if not colon or model_file(name) is not None:
        return None
    if not all(part.isidentifier() for part in module.split(".")):
        folder, _, file = module.replace("\\", "/").rpartition("/")
        stem = file.removesuffix(".py")
        hint = f"write {stem}:{attribute or 'Class'}" if stem.isidentifier() else ""
        if hint and folder:
            hint += f" and run lagros in {folder}"
        raise ValueError(
            f"policy {name!r}: {module!r} is no module; module:Class must name both as Python "
            f"imports them{', ' if hint else ''}{hint}"
        )
    if module.endswith(".py"):
        raise ValueError(
            f"policy {name!r}: {module!r} is a file; write {module[:-3]}:{attribute or 'Class'}, "
            "as Python imports it"
        )
    if not attribute.isidentifier():
        raise ValueError(f"policy {name!r}: {attribute!r} is no class; write {module}:Class")
    return UserClass(module, attribute)


def with_parts(given: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """Return names of policies with what "ablation" stands for in its place.

    These are the known ones that are no row of a main table: other laws around the plans of what is
    shipped (`tube-mpc:least-norm`, ...), and `lqr-plan`, a plain regulator around them.
    """
    # What plans otherwise is no law around the same plans.
    parts = [name for name in known if ":" in name and not name.endswith(":replan")]
    parts += [name for name in known if name == "lqr-plan"]
    # What is named beside it stands where it is named; what is named twice stays to be refused.
    rest = [name for name in parts if name not in given]
    return tuple(one for name in given for one in (rest if name == "ablation" else [name]))


def is_code(name: str) -> bool:
    """Return whether a name means code of somebody's: a module, or a model, which holds pickles."""
    return ":" in name or model_file(name) is not None


def is_importable(module: str) -> bool:
    """Return whether the package of a module can be found; nothing of it runs."""
    try:
        return importlib.util.find_spec(module.partition(".")[0]) is not None
    except (ImportError, ValueError):  # such as __main__, which has no place
        return False


def is_file(path: Path) -> bool:
    """Return whether there is such a file; not where the system allows no such name."""
    try:
        return path.is_file()
    except OSError:
        return False


def listed_names(text: str) -> tuple[str, ...]:
    """Split a list of policies at its commas, except within the name of a file that is there.

    An empty entry stays one.
    """
    parts = text.split(",")
    return tuple(_names(parts))


def _names(parts: list[str]) -> Iterator[str]:
    at = 0
    while at < len(parts):
        last = min(len(parts), at + 1 + _MOST_COMMAS)
        whole = (",".join(parts[at:end]) for end in range(last, at, -1))
        found = next((name for name in whole if _existing_model(name) is not None), None)
        if found is None:
            yield parts[at].strip()
            at += 1
        else:
            yield found
            at += found.count(",") + 1
