"""What a page plays: where everything was at the instants of an episode, and how it ended."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from lagros_benchmarks.report.page.packed import packed
from lagros_envs.arrays import FloatArray, IntArray

Flight = dict[str, Any]

_MOST_FRAMES = 300  # of an episode; a page draws on a line between two of them
# Beyond so many spans of the scene something has left it, and is not followed.
_FOLLOWED, _KEPT = 0.25, 10.0


class Reel(NamedTuple):
    """An episode as a page plays it.

    Attributes:
        scene: What all policies meet: `box`, the corners [x, y, x, y] of what is asked for;
            `discs` and `goals`, centre and radius of each; `radius` of a body that is drawn as a
            disc, or None; `outline`, the corners of the goal's polygons, or None; `plan`, or None.
        flight: What one policy made of it: `text`; `ending`, or None; `times`, and by these
            `places` (bodies, 2 or 3) with the heading, `polygons`, `push` (bodies, 2 or 4) as a
            share of its bound, and `measures`.
    """

    scene: dict[str, Any]
    flight: Flight


class Camera(Protocol):
    """Notes where everything is while an episode is flown."""

    def note(self, loop: Any) -> None:
        """Note this control instant of a closed loop."""

    def reel(self, error: str | None, proved: FloatArray | None = None) -> Reel:
        """Return what was noted.

        Args:
            error: The exception that ended the episode, or None.
            proved: What is proved of ||x - x_d|| at every control instant, or None.
        """


def kept_instants(count: int) -> IntArray:
    """Return which of so many instants are kept, the first and the last among them."""
    stride = max(1, math.ceil((count - 1) / _MOST_FRAMES))
    return np.unique(np.append(np.arange(0, count, stride), count - 1))


def box_of(points: FloatArray) -> FloatArray:
    """Return the corners (x, y, x, y) of the box around points (..., 2), without what is none."""
    flat = points.reshape(-1, 2)
    flat = flat[np.isfinite(flat).all(axis=-1)]
    return np.concatenate([flat.min(axis=0), flat.max(axis=0)])


def within(points: FloatArray, box: FloatArray, spans: float = _KEPT) -> FloatArray:
    """Return points (..., 2) no farther from a box than so many of its spans."""
    span = max(float(np.max(box[2:] - box[:2])), 1.0)
    near: FloatArray = np.clip(points, box[:2] - spans * span, box[2:] + spans * span)
    return near


def joined(box: Sequence[float], flights: Sequence[Flight]) -> list[float]:
    """Return the view that holds a scene and what flights make of it, unless they leave it."""
    corners = np.array(box, np.float64)
    around = [corners] + [
        within(np.reshape(one["reach"], (2, 2)), corners, _FOLLOWED).ravel() for one in flights
    ]
    every = np.array(around)
    return [*every[:, :2].min(axis=0).tolist(), *every[:, 2:].max(axis=0).tolist()]


def flight(
    text: str,
    error: str | None,
    ending: dict[str, Any] | None,
    events: list[dict[str, Any]],
    times: FloatArray,
    parts: dict[str, FloatArray | None],
    measures: dict[str, FloatArray | None],
    reach: FloatArray,
) -> Flight:
    """Return a flight, its arrays (instants, ...) thinned out and packed.

    Args:
        text: What it came to.
        error: The exception that ended it, or None.
        ending: What ended it, `time` [s], `label` and `body`, or None.
        events: What happened to a body, likewise with `kind`, "arrival" or "collision".
        times: The instants [s].
        parts: What is drawn, by name; None is left out.
        measures: What is plotted, likewise.
        reach: Box of all that is drawn.
    """
    kept = kept_instants(len(times))

    def thinned(arrays: dict[str, FloatArray | None]) -> dict[str, Any]:
        return {name: packed(a[kept]) for name, a in arrays.items() if a is not None}

    return {
        "text": text,
        "error": error,
        "ending": ending,
        "events": events,
        "times": packed(times[kept]),
        "parts": thinned(parts),
        "measures": thinned(measures),
        "reach": np.round(reach, 4).tolist(),
    }
