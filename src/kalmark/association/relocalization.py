"""The pose of a robot of unknown heading, by the landmarks that agree with a scan, whatever the pose was.

A correction linearises at the predicted pose, and from one that is turned by more than a right angle its iteration ends
anywhere.  Observed places v and landmarks l in pairs determine the pose in closed form, l = T v: Umeyama 1991.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.association.posterior import consistent_matchings
from kalmark.association.query import Query
from kalmark.events import Id
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import from_frame
from kalmark.geometry.gaussian import gate as chi2_gate

FEWEST = 3  # pairs
GATE = 0.99  # for two pairs, whose distances should agree
WIDEST = 256  # candidates for an observation
MOST_NODES = 5_000_000  # comparisons of pairs
FITS = 0.999  # of right matchings pass
SAME_M, SAME_RAD = 0.5, 0.1  # two matchings so near to each other are of one pose


def relocalize(query: Query) -> Array | None:
    """Return the pose (3,) of the sensor that a scan of points in the plane determines by itself, None if it does not.

    Of the largest matchings the one that fits best is taken, unless another one fits from elsewhere.
    """
    if query.scan.dimensions != 2:
        return None
    names, matchings = _by_constellation(query) if None in query.ids else _by_id(query)
    together = query.together(names) if len(matchings) else None
    if together is None:
        return None
    v, V, l, C = together.places()
    noise, spread = np.trace(V, axis1=1, axis2=2) / 2, C.diagonal().reshape(-1, 2).mean(axis=1)
    fits: list[tuple[float, Array]] = []
    for matching in matchings:
        rows = np.flatnonzero(matching >= 0)
        columns = matching[rows]
        T = align_points(v[rows], l[columns], 1.0 / noise[rows])
        off = l[columns] - from_frame(T, v[rows])[0]
        misfit = float((np.sum(off**2, axis=1) / (noise[rows] + spread[columns])).sum())
        if misfit <= chi2_gate(FITS, 2 * len(rows) - 3):
            fits.append((misfit, T))
    if not fits:
        return None
    best = min(fits, key=lambda fit: fit[0])[1]
    return best if all(is_same_pose(best, T) for _, T in fits) else None


def _by_constellation(query: Query) -> tuple[list[Id], Index]:
    """Return landmarks, and the largest matchings (N, K) of a scan with them by distances alone."""
    names, size = query.candidates(WIDEST, math.inf), len(query.ids)
    if len(names) < FEWEST:
        return names, np.zeros((0, size), dtype=np.int64)
    together, d2 = query.together(names), query.distances(names)
    near = np.isfinite(d2)
    if together is None or not near.any():
        return names, np.zeros((0, size), dtype=np.int64)
    found, finished = consistent_matchings(together, np.arange(size), d2, near, GATE, MOST_NODES)
    sizes = (found >= 0).sum(axis=1)
    most = sizes.max(initial=0)
    if not finished or most < FEWEST or 2 * most <= size:
        return names, found[:0]
    return names, found[sizes == most]


def _by_id(query: Query) -> tuple[list[Id], Index]:
    """Return the landmarks of a scan, and the one matching (1, K) that their ids are."""
    tracks = query.scan.tracks
    names = [i for i in query.ids if i is not None and (i in tracks.confirmed or i in tracks.known)]
    if len(names) < FEWEST:
        return names, np.zeros((0, len(query.ids)), dtype=np.int64)
    return names, np.array([[names.index(i) if i in names else -1 for i in query.ids]])


def align_points(v: Array, l: Array, weights: Array) -> Array:
    """Return the pose T (3,) with the least weighted squares of l - T v; v and l are (K, 2)."""
    w = weights / weights.sum()
    a, b = w @ v, w @ l
    p, q = v - a, l - b
    theta = math.atan2(float(w @ (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])), float(w @ np.sum(p * q, axis=1)))
    x, y = b - from_frame(np.array([0.0, 0.0, theta]), a)[0]
    return np.array([x, y, theta])


def is_same_pose(one: Array, other: Array) -> bool:
    """Return whether two poses (3,) are so near to each other that they are one."""
    return math.dist(one[:2], other[:2]) <= SAME_M and abs(wrap(one[2] - other[2])) <= SAME_RAD
