"""The distance of segments, exactly."""

import numpy as np


def segment_distance(first, second):
    """Return the distance of segments (B, 2, 2), zero where they cross."""
    ends = []
    for one, other in ((first, second), (second, first)):
        way = other[:, 1] - other[:, 0]
        square = np.maximum(np.sum(way * way, axis=-1), 1e-300)
        for end in (one[:, 0], one[:, 1]):
            share = np.clip(np.sum((end - other[:, 0]) * way, axis=-1) / square, 0.0, 1.0)
            ends.append(np.linalg.norm(end - other[:, 0] - share[:, None] * way, axis=-1))

    def side(base, tip, point):
        return np.sign(np.linalg.det(np.stack([tip - base, point - base], axis=-2)))

    parts = (first, second), (second, first)
    cross = [side(a[:, 0], a[:, 1], b[:, 0]) * side(a[:, 0], a[:, 1], b[:, 1]) for a, b in parts]
    return np.where((cross[0] < 0) & (cross[1] < 0), 0.0, np.min(ends, axis=0))
