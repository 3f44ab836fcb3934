"""Files that a user hands over are read here: a value, or one line that names the file.

Whatever lies under the name (a folder, a pipe, a device, half a file, another format, a bomb), a
reader gives the value or raises ValueError, and FileNotFoundError where there is nothing. Nothing
in a file is executed or unpickled.
"""

from __future__ import annotations

import io
import json
import math
import stat
import warnings
import zipfile
from collections import Counter
from collections.abc import Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagros_envs.arrays import FloatArray
from lagros_envs.checks import is_finite, is_whole, shown

# More than any file of ours has [bytes], and little enough to be read at once.
MOST_BYTES = 1 << 30
MOST_TEXT = 1 << 24
# Digits of an integer; no double reaches further.
_DIGITS = 309


def read_bytes(path: str | Path, most: int = MOST_BYTES) -> bytes:
    """Read a whole file.

    Args:
        path: The file; a link is followed.
        most: A larger one is refused [bytes].

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no regular file (a folder, a pipe, a device), is too large, or cannot be
            read.
    """
    name = check_file(path, most)
    try:
        with Path(path).open("rb") as stream:
            # What states no size, as under /proc, ends here.
            data = stream.read(most + 1)
    except OSError as error:
        raise ValueError(f"{name} cannot be read: {error.strerror}") from None
    if len(data) > most:
        raise ValueError(_too_large(name, most))
    return data


def check_file(path: str | Path, most: int = MOST_BYTES) -> str:
    """Check, before a library opens it, that a path is a file which can be read at once.

    Args:
        path: The file; a link is followed.
        most: A larger one is refused [bytes].

    Returns:
        How messages name it.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no path, no regular file (a folder, a pipe, a device) or too large.
    """
    if not isinstance(path, str | Path):
        raise ValueError(f"{shown(path)} must be the path of a file")
    name = named(path)
    try:
        found = Path(path).stat()
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no file {name}") from None
    except OSError as error:
        raise ValueError(f"{name} cannot be read: {error.strerror}") from None
    except ValueError as error:
        # A name with a null byte.
        raise ValueError(f"{name}: {error}") from None
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a pipe, a device or a socket"
        raise ValueError(f"{name} is {kind}, not a file; write what it gives to a file first")
    if found.st_size > most:
        raise ValueError(_too_large(name, most))
    return name


def read_json(path: str | Path, what: str = "JSON") -> Any:
    """Read a value from JSON in UTF-8, as RFC 8259 defines it; a byte order mark is skipped.

    Args:
        path: The file.
        what: What it should hold, for the message.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read or is not JSON, holds NaN, Infinity or a number that no double
            reaches, states a name twice, or is nested too deeply.
    """
    return parse_json(read_bytes(path, MOST_TEXT), named(path), what)


def parse_json(data: bytes | str, name: str, what: str = "JSON", all_finite: bool = True) -> Any:
    """Read a value from the bytes or text of JSON; see `read_json`.

    Args:
        data: The JSON.
        name: Where it is from, for the message.
        what: What it should hold, for the message.
        all_finite: Whether NaN and infinities, which Python writes, are refused.

    Raises:
        ValueError: As for `read_json`.
    """
    try:
        text = data if isinstance(data, str) else data.decode("utf-8-sig")
        if not text.strip():
            raise ValueError("it is empty")
        strange: list[str] = []
        value = json.loads(
            text,
            parse_int=partial(_integer, strange),
            parse_float=partial(_finite, strange),
            parse_constant=partial(_finite, strange),
            object_pairs_hook=_object,
        )
        if strange and all_finite:
            raise ValueError(f"{_not_finite(value)} is a number that is not finite or too large")
    except RecursionError:
        reason = "it is nested too deeply"
    except UnicodeDecodeError as error:
        reason = f"byte {error.start} is not UTF-8"
    except ValueError as error:
        reason = str(error)
    else:
        return value
    raise ValueError(f"{name} is not {what}: {reason}")


def read_npz(
    path: str | Path, names: Collection[str] = (), most: int = MOST_BYTES
) -> dict[str, NDArray[Any]]:
    """Read the arrays of an .npz file; one that holds pickled objects is refused.

    Args:
        path: The file.
        names: Arrays that must be there; others may.
        most: Bytes of all arrays together; a file that would expand to more is refused.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, is no .npz, is damaged or too large, or lacks an array.
    """
    data, name = read_bytes(path, most), named(path)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            # What a member says of itself: no more of it is ever unpacked.
            expanded = sum(member.file_size for member in archive.infolist())
        if expanded > most:
            raise ValueError(f"it would expand to {expanded} bytes, above {most}")
        with warnings.catch_warnings(), np.load(io.BytesIO(data), allow_pickle=False) as file:
            warnings.simplefilter("error")
            arrays = {key: np.asarray(file[key]) for key in file.files}
    except Exception as error:
        # zlib, zipfile, tokenize, struct and NumPy each raise their own for what is damaged.
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise ValueError(f"{name} is damaged or not an .npz file ({reason})") from None
    missing = [key for key in names if key not in arrays]
    if missing:
        raise ValueError(f"{name} has no array {missing[0]!r}; it has {shown(sorted(arrays))}")
    return arrays


class Record:
    """An object of JSON, whose entries are asked for by name and type.

    Args:
        value: What was read.
        name: Where it is from: file, and place within it.

    Raises:
        ValueError: It is not an object.
    """

    def __init__(self, value: Any, name: str) -> None:
        """Check that it is an object."""
        if not isinstance(value, Mapping):
            raise ValueError(f"{name} must be an object {{…}} of JSON and not {shown(value)}")
        self.entries: Mapping[str, Any] = value
        self.name = name

    @classmethod
    def load(cls, path: str | Path, what: str = "JSON") -> Record:
        """Read an object from a file; see `read_json`."""
        return cls(read_json(path, what), named(path))

    def __getitem__(self, key: str) -> Any:
        """Return an entry.

        Raises:
            ValueError: There is none.
        """
        if key not in self.entries:
            raise ValueError(
                f"{self.name} has no entry {key!r}; it has {shown(list(self.entries))}"
            )
        return self.entries[key]

    def only(self, names: Collection[str]) -> None:
        """Check that these entries and no others are there.

        Raises:
            ValueError: One is missing, or one is not known.
        """
        for key in names:
            self[key]
        for key in self.entries:
            if key not in names:
                raise ValueError(
                    f"{self.name} has the unknown entry {shown(key)}; known are {', '.join(names)}"
                )

    def must(self, key: str, value: str) -> None:
        """Check an entry that can have one value, such as the format.

        Raises:
            ValueError: It has another, or there is none.
        """
        if key not in self.entries or self.entries[key] != value:
            found = shown(self.entries[key]) if key in self.entries else "missing"
            raise ValueError(f"{self.name}: {key!r} is {found} and must be {value!r}")

    def record(self, key: str) -> Record:
        """Return an entry that is an object.

        Raises:
            ValueError: There is none, or it is something else.
        """
        return Record(self[key], f"{self.name}: {key!r}")

    def list(self, key: str) -> list[Any]:
        """Return an entry that is a list.

        Raises:
            ValueError: There is none, or it is something else.
        """
        value = self[key]
        if not isinstance(value, list):
            raise self._refusal(key, value, "a list")
        return value

    def text(self, key: str) -> str:
        """Return an entry that is text.

        Raises:
            ValueError: There is none, or it is something else.
        """
        value = self[key]
        if not isinstance(value, str):
            raise self._refusal(key, value, "text")
        return value

    def number(self, key: str) -> float:
        """Return an entry that is a finite number; text, true and null are none.

        Raises:
            ValueError: There is none, or it is something else.
        """
        value = self[key]
        if not is_finite(value):
            raise self._refusal(key, value, "a number, written without quotes")
        return float(value)

    def whole(self, key: str) -> int:
        """Return an entry that is an integer.

        Raises:
            ValueError: There is none, or it is something else.
        """
        value = self[key]
        if not (is_whole(value) and is_finite(value)):
            raise self._refusal(key, value, "a whole number, written without quotes")
        return int(value)

    def array(self, key: str, shape: tuple[int | None, ...] | None = None) -> FloatArray:
        """Return an entry that is numbers in nested lists of equal lengths.

        Args:
            key: Its name.
            shape: What it must have, None for an axis of any length; None for any shape. A list
                that is empty has all of them whose first axis may be 0.

        Raises:
            ValueError: There is none, or it is something else.
        """
        value = self[key]
        stranger = _stranger(value)
        if stranger is not None:
            raise ValueError(
                f"{self.name}: {key!r} holds {shown(stranger[0])}; all in it must be numbers, "
                "written without quotes"
            )
        try:
            array = np.array(value, dtype=np.float64)
        except ValueError:
            raise self._refusal(key, value, "lists of equal lengths") from None
        if shape is not None and array.shape == (0,) and shape[0] in (0, None):
            array = array.reshape([axis or 0 for axis in shape])
        fits = shape is None or (
            array.ndim == len(shape)
            and all(axis in (None, length) for axis, length in zip(shape, array.shape, strict=True))
        )
        if not fits:
            wanted = ", ".join("n" if axis is None else str(axis) for axis in shape or ())
            raise ValueError(
                f"{self.name}: {key!r} has the shape {array.shape} and must have ({wanted})"
            )
        return array

    def _refusal(self, key: str, value: Any, needed: str) -> ValueError:
        return ValueError(f"{self.name}: {key!r} is {shown(value)} and must be {needed}")


def named(path: str | Path) -> str:
    """Return a path as messages name it: on one line, in letters that can be printed."""
    text = str(path)
    return text if text.isprintable() and text and text == text.strip() else repr(text)


def _too_large(name: str, most: int) -> str:
    return f"{name} has more than the {most} bytes that are read; is it the right file?"


def _stranger(value: Any) -> tuple[Any] | None:
    """Return what is no number in nested lists, in a tuple of its own; None if all are."""
    left = [value]
    while left:
        one = left.pop()
        if isinstance(one, list):
            left += one
        elif not is_finite(one):
            return (one,)
    return None


def _integer(strange: list[str], text: str) -> float:
    # Python takes minutes for a million digits, and refuses 4301.
    value = int(text) if len(text) <= _DIGITS + 1 else math.inf
    return value if is_finite(value) else _finite(strange, text)


def _finite(strange: list[str], text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        strange.append(text)
    return value


def _not_finite(value: Any) -> str:
    """Return where a number is that is infinite or NaN, as "goals[0][1]"; one there must be."""
    left: list[tuple[str, Any]] = [("", value)]
    while left:
        place, one = left.pop()
        if isinstance(one, dict):
            left += [(f"{place}.{key}" if place else key, item) for key, item in one.items()]
        elif isinstance(one, list):
            left += [(f"{place}[{index}]", item) for index, item in enumerate(one)]
        elif isinstance(one, float) and not math.isfinite(one):
            return place[:_DIGITS] or "it"
    return "an entry"  # of a name that is stated again


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        twice = counts.most_common(1)[0][0]
        raise ValueError(f"it states {shown(twice)} twice")
    return entries
