"""Frozen dataclasses as values: equal, hashed and written by what they hold, and never changed."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import fields
from typing import Any, cast

import numpy as np


class ByValue:
    """Base of a frozen dataclass with arrays among its fields, to be declared with `eq=False`.

    Two are equal if their fields are, arrays entry by entry. Arrays are read-only, after copying
    and pickling as well.
    """

    def __eq__(self, other: object) -> bool:
        """Return whether the other is of the same class and all fields are equal."""
        if type(other) is not type(self):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self) -> int:
        """Return a hash of the fields."""
        return hash(self._key())

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the fields of a copy; NumPy does not keep that an array was read-only."""
        self.__dict__.update(state)
        self._lock()

    def _lock(self) -> None:
        for value in self.__dict__.values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def _key(self) -> tuple[Hashable, ...]:
        # What a dataclass caches beside its fields does not count.
        return tuple(_hashable(getattr(self, item.name)) for item in fields(cast(Any, self)))


def _hashable(value: Any) -> Hashable:
    if isinstance(value, np.ndarray):
        # Adding zero makes -0.0 and 0.0 the same bytes, as they are the same number.
        return value.shape, value.dtype.str, (value + 0).tobytes()
    hashable: Hashable = value
    return hashable


def use_plain_numbers(settings: Any) -> None:
    """Turn NumPy's numbers in a frozen dataclass into Python's, and lists into tuples.

    So that settings are equal, hashed and written as JSON by what they say.

    Args:
        settings: The dataclass, while it is being built.
    """
    for item in fields(settings):
        value = getattr(settings, item.name)
        plain = _plain(value)
        if plain is not value:
            object.__setattr__(settings, item.name, plain)


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple):
        return tuple(_plain(one) for one in value)
    return value
