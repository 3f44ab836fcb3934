"""Sets of errors along plans: sums of balls and segments, whose support functions are sums."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lagros_envs.arrays import BoolArray, FloatArray

# A sum of n products errs by n 2^-53 of the sum of their sizes; n is below 2^7.
ROUNDING = 2.0**-46
# A sum of up to 2^12 positive floats is wider than this times what is computed.
WIDER = 1.0 + 2.0**-40
_PASSES = 4


@dataclass(frozen=True)
class ErrorSet:
    """{c + sum_j X_j d_j + sum_i y_i g_i: ||d_j|| <= 1, |g_i| <= 1}, one for each of p plans.

    Attributes:
        centre: c, shape (p, n).
        balls: X_j, shape (p, n, J, q).
        segments: y_i, shape (p, n, I).
    """

    centre: FloatArray
    balls: FloatArray
    segments: FloatArray

    @cached_property
    def generators(self) -> FloatArray:
        """All columns side by side, shape (p, n, J q + I)."""
        flat = self.balls.reshape(*self.balls.shape[:2], -1)
        return np.concatenate([flat, self.segments], axis=-1)

    @cached_property
    def spread(self) -> FloatArray:
        """Sums of the sizes of the columns: bounds of |e - c|, if not sharp, shape (p, n)."""
        spread: FloatArray = np.abs(self.generators).sum(axis=-1) * WIDER
        return spread

    @cached_property
    def radius(self) -> FloatArray:
        """Bounds of |e_i - c_i|, shape (p, n)."""
        plans, n = self.centre.shape
        return self.support(np.broadcast_to(np.eye(n), (plans, n, n)))

    def support(self, directions: FloatArray) -> FloatArray:
        """Bound l'(e - c) over the set from above.

        Args:
            directions: l, shape (p, k, n).

        Returns:
            The support function, exact but for rounding outwards, shape (p, k).
        """
        plans, n, count, width = self.balls.shape
        turned = directions @ self.balls.reshape(plans, n, -1)
        turned *= turned
        turned = turned.reshape(plans, directions.shape[1], count, width)
        reach = np.sqrt(turned.sum(axis=-1)).sum(axis=-1)
        reach = reach + np.abs(directions @ self.segments).sum(axis=-1)
        slack = (np.abs(directions) @ self.spread[..., None])[..., 0]
        bound: FloatArray = reach * WIDER + ROUNDING * slack
        return bound

    def bound(self, directions: FloatArray) -> FloatArray:
        """Bound |l'e| over the set, for l (p, k, n), shape (p, k)."""
        middle = np.abs(directions @ self.centre[..., None])[..., 0]
        slack = (np.abs(directions) @ np.abs(self.centre)[..., None])[..., 0]
        return middle + ROUNDING * slack + self.support(directions)

    def norm(self) -> FloatArray:
        """Bound ||e|| over the set, shape (p,).

        sum_j ||X_j'l|| <= sqrt(sum_j w_j) sqrt(l' (sum_j X_j X_j' / w_j) l) for any w > 0, with
        equality where w_j = ||X_j'l||: w is taken at the l that is longest so far.
        """
        weights = None
        least = np.full(len(self.centre), np.inf)
        for _ in range(_PASSES):
            shape = self.ellipsoid(self.balls, self.segments, weights)
            values, vectors = np.linalg.eigh(shape)
            least = np.minimum(least, np.sqrt(values[:, -1] * WIDER))
            longest = vectors[:, :, -1]
            weights = (
                np.sqrt((np.einsum("pi,pijq->pjq", longest, self.balls) ** 2).sum(axis=-1)),
                np.abs(np.einsum("pi,pij->pj", longest, self.segments)),
            )
        slack = ROUNDING * self.spread.sum(axis=-1)
        bound: FloatArray = (np.linalg.norm(self.centre, axis=-1) + least + slack) * WIDER
        return bound

    @staticmethod
    def ellipsoid(
        balls: FloatArray,
        segments: FloatArray,
        weights: tuple[FloatArray, FloatArray] | None = None,
    ) -> FloatArray:
        """Return P of an ellipsoid {y: |l'y|^2 <= l'P l} around a sum of balls and segments.

        Args:
            balls: Shape (p, r, J, q).
            segments: Shape (p, r, I).
            weights: Of balls (p, J) and segments (p, I), any that are not negative; their sizes if
                left out.

        Returns:
            P, shape (p, r, r), but for a rounding of `ROUNDING` relative to its diagonal.
        """
        if weights is None:
            weights = np.sqrt((balls**2).sum(axis=(1, 3))), np.sqrt((segments**2).sum(axis=1))
        total = weights[0].sum(axis=-1) + weights[1].sum(axis=-1)
        # None may be zero; a little of the mean hardly widens the sum.
        least = (1e-4 / (balls.shape[2] + segments.shape[2])) * total + 1e-100
        ball, segment = (weight + least[:, None] for weight in weights)
        total = ball.sum(axis=-1) + segment.sum(axis=-1)
        flat = balls / np.sqrt(ball)[:, None, :, None]
        flat = flat.reshape(*flat.shape[:2], -1)
        thin = segments / np.sqrt(segment)[:, None, :]
        square = flat @ np.swapaxes(flat, 1, 2) + thin @ np.swapaxes(thin, 1, 2)
        shape: FloatArray = total[:, None, None] * square
        return shape

    def moved(
        self, matrix: FloatArray, centre: FloatArray, balls: FloatArray, segments: FloatArray
    ) -> ErrorSet:
        """Return {A (e - c) + c' + X d + y g}: what e leads to, with new columns.

        What the product A X rounds is not counted, see `rounded`.

        Args:
            matrix: A, shape (p, n, n).
            centre: c', shape (p, n).
            balls: X, shape (p, n, q).
            segments: y, shape (p, n, i).
        """
        plans, n, count, width = self.balls.shape
        turned = (matrix @ self.balls.reshape(plans, n, -1)).reshape(plans, n, count, width)
        return ErrorSet(
            centre,
            np.concatenate([turned, balls[:, :, None]], axis=2),
            np.concatenate([matrix @ self.segments, segments], axis=2),
        )

    def rounded(self, matrix: FloatArray) -> FloatArray:
        """Bound what floats lose of A (e - c), shape (p, n)."""
        lost: FloatArray = ROUNDING * (np.abs(matrix) @ self.spread[..., None])[..., 0]
        return lost

    def emptied(self, where: BoolArray) -> ErrorSet:
        """Return the set with those of some plans (p,) shrunk to zero."""
        keep = ~where
        return ErrorSet(
            np.where(keep[:, None], self.centre, 0.0),
            np.where(keep[:, None, None, None], self.balls, 0.0),
            np.where(keep[:, None, None], self.segments, 0.0),
        )


def boxed(radius: FloatArray, pushes: int) -> ErrorSet:
    """Return boxes around zero.

    Args:
        radius: Shape (p, n).
        pushes: Width q of the balls that are to come.
    """
    plans, n = radius.shape
    return ErrorSet(
        np.zeros((plans, n)), np.zeros((plans, n, 0, pushes)), radius[:, :, None] * np.eye(n)
    )
