"""The places that landmarks are at: Euclidean points, the endpoints of lines, the poses of tags, with covariances.

A place is a row of numbers, and its covariance that of its error:

==========  ==============================  ==========================  =====
kind        place                           error                       sizes
==========  ==============================  ==========================  =====
point       x y z                           x y z                       3, 3
line        both endpoints, x y z x2 y2 z2  the same                    6, 6
tag         x y z qx qy qz qw               x y z, rotation vector      7, 6
==========  ==============================  ==========================  =====

Whatever else a landmark is in the map (inverse depth, homogeneous, Pluecker), its model says where that is: by `place`,
lines by `endpoints` at the abscissas of their ends (`kalmark.models.protocols.Placed`, `Segmented`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.geometry.spaces import SE3
from kalmark.models.landmarks import PointSignature2D
from kalmark.models.protocols import Landmark, Segmented, place_of

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

POINT, LINE, TAG = 3, 6, 7
EUCLIDEANS, OTHERS, LINES = range(3)  # groups of what is drawn alike
EUCLIDEAN = (  # kinds whose state is their place; what is not (inverse depth, say) is not well known yet
    "",
    "point",
    "point3",
    "point_signature",
    "tag",
)


def place(
    model: Landmark | None, mean: Array, covariance: Array, ends: Array | None = None
) -> tuple[Array, Array] | None:
    """Return the place and covariance of one landmark's state; `ends` (2,) are the abscissas of a line's ends.

    The pose of a tag and a point with its signature are their own places.  None if a model does not say where it is.
    """
    mean, covariance = np.array(mean, dtype=np.float64), np.array(covariance, dtype=np.float64)
    if model is None or model.space.kinds == SE3.kinds or isinstance(model, PointSignature2D):
        return mean, covariance
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if isinstance(model, Segmented):
            p, P_l = model.endpoints(mean[None], np.array(model.first_ends if ends is None else ends)[None])
            p, P_l = p.reshape(1, LINE), P_l.reshape(1, LINE, -1)
        elif (found := place_of(model, mean[None])) is not None:
            p, P_l = found
        else:
            return None
        covariance = P_l[0] @ covariance @ P_l[0].T
    at_infinity = ~np.isfinite(p[0])
    return np.where(at_infinity, np.inf, p[0]), np.where(np.isfinite(covariance), covariance, np.inf)


class Points(NamedTuple):
    """Gaussian points to draw: which landmark each belongs to (K,), positions (K, d), covariances (K, d, d)."""

    row: Ints
    means: Array
    covariances: Array


class Shapes(NamedTuple):
    """What is to be drawn of a map: `points` (of lines both endpoints), `lines` (L, 2, 3) and `tags` (T, 7).

    `group` tells of each point whether it is of a Euclidean landmark (0), another (1) or a line (2).
    """

    points: Points
    lines: Array
    tags: Array
    group: Ints


def shapes(means: Array, covariances: Array, kinds: Sequence[str], d: int = 3) -> Shapes:
    """Sort the places (K, n) of landmarks, in space padded with NaN, and covariances (K, q, q), by what they are.

    In the plane (d = 2) all are points.
    """
    size = (~np.isnan(means)).sum(axis=1)
    lines, tags = np.flatnonzero(size == LINE), np.flatnonzero(size == TAG)
    row = np.concatenate([np.arange(len(means)), lines])
    ends, P = means[lines, :LINE].reshape(-1, 2, 3), covariances[lines, 3:LINE, 3:LINE].reshape(-1, d, d)
    return Shapes(
        Points(
            row,
            np.concatenate([means[:, :d].reshape(-1, d), ends[:, 1, :d]]),
            np.concatenate([covariances[:, :d, :d].reshape(-1, d, d), P]),
        ),
        ends,
        means[tags, :TAG].reshape(-1, TAG),
        np.where(np.isin(row, lines), LINES, np.where(np.isin(kinds, EUCLIDEAN), EUCLIDEANS, OTHERS)[row]),
    )
