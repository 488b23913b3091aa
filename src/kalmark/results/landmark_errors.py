"""Errors of landmarks against the truth: one judge of the maps of runs and of campaigns.

A landmark is judged by what of it has a truth, whatever its state in the map is:

=======  ====================================================================  =====
point    its Euclidean position                                                2|3
line     across itself, where the true ends are: along it, nothing is known    2|4
tag      its pose; its centre where the truth is a point                       6|3
=======  ====================================================================  =====

Of a point that is not Euclidean yet, and of a line of space, the depth may not be determined.  Then the error is one
of the prior of the depth, not of the map.  Such a landmark counts once three of its sigmas are below the distance from
which it was observed last: infinity is then excluded, however inaccurate it still is.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.results.landmark_table import EUCLIDEAN, TAG, across_line
from kalmark.results.measures import point_error, pose_error

DETERMINED = 3.0  # a depth is determined once the distance exceeds so many of its sigmas
NO_POINTS = np.empty((0, 0))


class BlockError(NamedTuple):
    """A block's error d (f,) in own and in world coordinates, and its Jacobian F (f, dof) in the block's error.

    `place` (k, 2|3) and `truth` (k, 2|3) are the points of it to align maps by: of a line two.
    """

    own: Array
    world: Array
    F: Array
    place: Array = NO_POINTS
    truth: Array = NO_POINTS


def landmark_error(
    kind: str, place: Array, P: Array, truth: Array, eye: Array, turn: Any = None, coordinates: str = "world"
) -> BlockError | None:
    """Return the error of a landmark's `place` (n,), covariance P (q, q), last observed from `eye` (d,), d = 2 or 3.

    F is that in the error of the place (`kalmark.results.landmark_table`).  `turn` is the error of the orientation of
    the robot that observes, for errors in log coordinates.  None while the depth is not determined, of a line whose
    truth is none, and of one whose ends are one point.
    """
    d = len(eye)
    if 2 * d in (len(place), len(truth)):
        return _line_error(place, P, truth, eye, turn, coordinates) if len(place) == len(truth) else None
    if len(place) == len(truth) == TAG:
        own, world = (pose_error(place, truth, c, turn) for c in (coordinates, "world"))
        return BlockError(own, world, np.eye(6), place[None, :d], truth[None, :d])
    point, true = place[:d], truth[:d]
    if kind not in EUCLIDEAN and not is_determined(point, P[:d, :d], eye):
        return None
    own, world = (point_error(point, true, turn, c) for c in (coordinates, "world"))
    return BlockError(own, world, np.eye(d, len(P)), point[None], true[None])


def is_determined(point: Array, P: Array, eye: Array) -> bool:
    """Return whether all sigmas of a point (d,), covariance P (d, d), are below a third of its distance from `eye`."""
    return bool(np.isfinite(P).all() and DETERMINED**2 * np.linalg.norm(P, 2) < np.sum((point - eye) ** 2))


def _line_error(place: Array, P: Array, truth: Array, eye: Array, turn: Any, coordinates: str) -> BlockError | None:
    """Return how far a line (2 d,) passes from the two true ends (2 d,): in the plane two numbers, in space four."""
    d, a, ends = len(eye), place[: len(eye)], truth.reshape(2, -1)
    along = place[d:] - a
    if not (np.isfinite(P).all() and along.any()):
        return None
    t = (ends - a) @ along / (along @ along)
    q = a + t[:, None] * along
    Q_l = np.concatenate([np.multiply.outer(1.0 - t, np.eye(d)), np.multiply.outer(t, np.eye(d))], axis=2)
    to_eye = across_line(place.reshape(2, d))
    if d == 3 and not all(
        is_determined(to_eye @ q_i, to_eye @ Q_i @ P @ Q_i.T @ to_eye, to_eye @ eye)
        for q_i, Q_i in zip(q, Q_l, strict=True)
    ):
        return None
    across = np.linalg.svd(along[None])[2][1:]  # (d - 1, d): at right angles to the line
    own, world = (point_error(q, ends, turn, c) @ across.T for c in (coordinates, "world"))
    return BlockError(own.ravel(), world.ravel(), (across @ Q_l).reshape(own.size, -1), q, q + world @ across)
