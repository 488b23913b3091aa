"""Extents of walls: observations on the line of a wall whose segment does not join its known segment.

Two walls of a corridor with a door between them are on one line, which their measurements fit alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.geometry.gaussian import gate
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.track import Track

TINY_M = 1e-9
SIGMAS = 3.0  # of the place along the wall, by which a gap may seem wider than it is
FARTHEST = gate(1.0 - 1e-9, 2)  # a line beyond this d2 is another one, whatever its extent


def gap(one: Array, other: Array) -> Array:
    """Return the length (K,) between intervals (K, 2), below 0 where they overlap."""
    return np.asarray(np.maximum(one[:, 0] - other[:, 1], other[:, 0] - one[:, 1]))


def disjoint_from_walls(scan: ScanContext, landmark: Any, tracks: Sequence[Track], rows: Index, d2: Array) -> Flags:
    """Return which observations `rows` (M,) do not join what is known of `tracks` of a `Joining` landmark, at d2 (M,).

    They do if the gap is at most `join_m` and three sigmas of where the robot is along the wall.
    """
    out = np.zeros(len(rows), dtype=np.bool_)
    some = [i for i in np.flatnonzero(d2 <= FARTHEST).tolist() if tracks[i].extent is not None]
    if not some:
        return out
    l = scan.map.means(np.array([tracks[i].slot for i in some]), landmark.space.size)
    v, T = scan.channel.sensor.invert(scan.y[rows[some]])[0], scan.pose()
    known: Any = np.array([tracks[i].extent for i in some])
    wide = gap(landmark.abscissas(T, l, v), known) - landmark.join_m
    p, P_l = landmark.endpoints(l, known)
    for k in np.flatnonzero(wide > 0.0).tolist():
        out[some[k]] = wide[k] > SIGMAS * _sigma_along(scan, tracks[some[k]], T, p[k], P_l[k])
    return out


def _sigma_along(scan: ScanContext, track: Track, T: Array, p: Array, P_l: Array) -> float:
    """Return the sigma of where the sensor, at T (3,), is along a wall, from the nearer one of its ends p (2, 2) on."""
    end = int(np.argmin(np.linalg.norm(p - T[:2], axis=1)))
    along = (p[1] - p[0]) / max(float(np.linalg.norm(p[1] - p[0])), TINY_M)
    off = p[end] - scan.map.mean(scan.robot)[:2]
    P, dof = scan.map.covariance([scan.robot, track.slot]), len(scan.map.rows(scan.robot))
    J = np.zeros(len(P))
    J[:3] = *along, along[1] * off[0] - along[0] * off[1]
    J[dof:] = -along @ P_l[end]
    return math.sqrt(max(float(J @ P @ J), 0.0))
