"""The places that landmarks are at: Euclidean points, the endpoints of lines, the poses of tags, with covariances.

A place is a row of numbers, and its covariance that of its error:

==========  ==============================  ==========================  =====
kind        place                           error                       sizes
==========  ==============================  ==========================  =====
point       x y z                           x y z                       3, 3
line        both endpoints, x y z x2 y2 z2  the same                    6, 6
tag         x y z qx qy qz qw               x y z, rotation vector      7, 6
==========  ==============================  ==========================  =====

Whatever else a landmark is in the map (inverse depth, homogeneous, Pluecker), its model says where that is: `to_point`
gives the points (K, d) of states (K, m) and their Jacobian (K, d, dof), `endpoints` those (K, 2, 3) of lines at the
abscissas (K, 2) of their ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

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


def place(model: Any, mean: Array, covariance: Array, ends: Array | None = None) -> tuple[Array, Array]:
    """Return the place and covariance of one landmark's state; `ends` (2,) are the abscissas of a line's ends.

    A model that does not say where it is, is its own place, and so is the pose of a tag.
    """
    mean, covariance = np.array(mean, dtype=np.float64), np.array(covariance, dtype=np.float64)
    ends = getattr(model, "first_ends", None) if ends is None else ends
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if ends is not None:
            p, P_l = model.endpoints(mean[None], np.array(ends, dtype=np.float64)[None])
            p, P_l = p.reshape(1, LINE), P_l.reshape(1, LINE, -1)
        elif hasattr(model, "to_point") and model.kind != "tag":
            p, P_l = model.to_point(mean[None])
        else:
            return mean, covariance
        covariance = P_l[0] @ covariance @ P_l[0].T
    at_infinity = ~np.isfinite(p[0])
    return np.where(at_infinity, np.inf, p[0]), np.where(np.isfinite(covariance), covariance, np.inf)


class Points(NamedTuple):
    """Gaussian points in space to draw: which landmark each belongs to (K,), positions (K, 3), covariances."""

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


def shapes(means: Array, covariances: Array, kinds: Sequence[str]) -> Shapes:
    """Sort the places (K, n) of landmarks in space, padded with NaN, and covariances (K, q, q), by what they are."""
    size = (~np.isnan(means)).sum(axis=1)
    lines, tags = np.flatnonzero(size == LINE), np.flatnonzero(size == TAG)
    row = np.concatenate([np.arange(len(means)), lines])
    ends = means[lines]
    return Shapes(
        Points(
            row,
            np.concatenate([means[:, :3].reshape(-1, 3), ends[:, 3:6].reshape(-1, 3)]),
            np.concatenate([covariances[:, :3, :3].reshape(-1, 3, 3), covariances[lines, 3:6, 3:6].reshape(-1, 3, 3)]),
        ),
        ends[:, :6].reshape(-1, 2, 3),
        means[tags][:, :7].reshape(-1, 7),
        np.where(np.isin(row, lines), LINES, np.where(np.isin(kinds, EUCLIDEAN), EUCLIDEANS, OTHERS)[row]),
    )
