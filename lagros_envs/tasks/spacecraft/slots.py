"""The slots of an observation that hold what is sensed, each with a mark that it does."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lagros_envs.arrays import Float32Array, FloatArray, IntArray


class Slots(NamedTuple):
    """The slots of one kind of body in an observation, and their mask.

    Attributes:
        begin: Where the first slot begins.
        mask: Where the mask begins.
        room: How many slots there are.
        most: How many bodies of that kind one agent might sense in a world.
    """

    begin: int
    mask: int
    room: int
    most: int

    @classmethod
    def between(cls, slots: slice, mask: slice, most: int) -> Slots:
        """Return the slots that lie here, with a mask that lies there."""
        return cls(slots.start, mask.start, mask.stop - mask.start, most)

    def fill(
        self,
        rows: Float32Array,
        whose: IntArray,
        which: IntArray,
        values: Float32Array,
        distances: FloatArray,
    ) -> None:
        """Write what is sensed.

        Each body has the slot of its number where there are as many slots. Else those that are
        sensed lie side by side in the order of their numbers, and should more be sensed than there
        are slots, which bodies that keep clear of each other cannot do, the nearest.

        Args:
            rows: The observations, shape (rows, size), in which nothing is sensed yet.
            whose: The row that senses, ascending, shape (p,).
            which: The number of what it senses among those of its world, likewise for each row.
            values: What is to be seen of it, shape (p, numbers).
            distances: In whose order they are nearest, shape (p,).
        """
        (count, size), room = rows.shape, self.room
        if room < self.most:
            which = _places_among(whose, count)
            if which.max(initial=0) >= room:
                order = np.lexsort((distances, whose))
                order = np.sort(order[_places_among(whose[order], count) < room])
                whose, values = whose[order], values[order]
                which = _places_among(whose, count)
        flat, begin, dim = rows.reshape(-1), whose * size, values.shape[1]
        flat[begin + (self.mask + which)] = 1.0
        begin += self.begin + dim * which
        flat[begin[:, None] + np.arange(dim)] = values


def _places_among(whose: IntArray, rows: int) -> IntArray:
    """Return of ascending rows (p,) how many of the same came before."""
    counts = np.bincount(whose, minlength=rows)
    begins: IntArray = np.cumsum(counts) - counts
    return np.arange(len(whose)) - begins[whose]
