"""Recordings of the SLAM toolbox ([TB]), and its conventions brought into kalmark's.

The toolbox differentiates with respect to four quaternion numbers (w first), of a form that is quadratic off the unit
sphere too.  A small world rotation d moves the quaternion by dq = (0, d) q / 2: with that, its Jacobians become those
with respect to d, and its quaternion outputs rotation vectors.  What it moves along the quaternion itself is dropped.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]
Case = dict[str, Array]


@cache
def recorded(path: Path) -> dict[str, list[dict[str, dict[str, Any]]]]:
    with gzip.open(path) as file:
        return json.load(file)


def arrays(entries: dict[str, Any]) -> Case:
    """Return matrices; columns and rows of numbers flat."""
    out = {}
    for name, entry in entries.items():
        a = np.reshape(np.asarray(entry["data"], dtype=np.float64), entry["shape"], order="F")
        out[name] = a.ravel() if 1 in a.shape and "_" not in name else a
        if a.size == 0 and "_" not in name:
            out[name] = np.zeros(0)
    return out


def xyzw(q: Array) -> Array:
    return np.ascontiguousarray(np.roll(q, -1))


def frame(f: Array) -> Array:
    return np.concatenate([f[:3], xyzw(f[3:])])


def k_of(k: Array) -> Array:
    """Return (fx, fy, cx, cy) of the toolbox's (u0, v0, au, av)."""
    return np.roll(k, 2)


def tangent(q: Array) -> Array:
    """Return d q / d d (4, 3), w first, of the toolbox's quaternion q under a world rotation Exp(d)."""
    w, x, y, z = q
    return 0.5 * np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]])


def frame_tangent(f: Array) -> Array:
    Q = np.zeros((7, 6))
    Q[:3, :3], Q[3:, 3:] = np.eye(3), tangent(f[3:])
    return Q


def frame_error(f: Array) -> Array:
    """Return d error / d numbers (6, 7) of a frame that comes out."""
    return frame_tangent(f).T * np.array([1, 1, 1, 4, 4, 4])[:, None]


def unstacked(R_x: Array, R: Array) -> Array:
    """Return the rotation vectors (3, n) of the derivatives (9, n) of a matrix R, by columns."""
    columns = []
    for column in R_x.T:
        W = column.reshape(3, 3, order="F") @ R.T
        np.testing.assert_allclose(W, -W.T, atol=1e-9)
        columns.append([W[2, 1], W[0, 2], W[1, 0]])
    return np.array(columns).T


TURNED = [0, 1, 2, 4, 3, 5]  # the toolbox's pitch, yaw are kalmark's elevation, azimuth: the other order

Pair = tuple[Any, Any]  # ours, theirs


def quaternion_pairs(ours: Array, theirs: Array) -> Pair:
    theirs = xyzw(theirs)
    return ours * np.sign(ours @ theirs), theirs


def frame_pairs(ours: Array, theirs: Array) -> list[Pair]:
    return [(ours[:3], theirs[:3]), quaternion_pairs(ours[3:], theirs[3:])]


def one(function: Callable[..., Any], *arguments: Any, row: int = 0) -> tuple[Array, ...]:
    """Call a function of many rows with a single one, argument number `row`."""
    given = [np.ascontiguousarray(a[None]) if i == row else a for i, a in enumerate(arguments)]
    return tuple(a[0] for a in function(*given))
