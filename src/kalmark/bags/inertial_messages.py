"""Inertial units and compasses of a bag as readings of sensors of the state.

ROS gives orientations in the axes east, north, up: a heading is 0 to the east and grows to the left (REP 103).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kalmark.arrays import Array
from kalmark.geometry.rotations import matrix
from kalmark.logs.log import Times

GYRO = {False: ("w_radps",), True: ("wx_radps", "wy_radps", "wz_radps")}  # of the plane, and of space
HEADING, INCLINATION, GRAVITY = ("heading_rad",), ("roll_rad", "pitch_rad"), ("ax_mps2", "ay_mps2", "az_mps2")
STEEP = 1e-3  # of the whole: a field that is less along the ground has no direction there


def heading_of(q: Array, R: Array) -> float:
    """Return the heading (rad) of a robot by the orientation q (4,) of a unit whose axes in its frame are R (3, 3)."""
    Q = matrix(np.ascontiguousarray(q)) @ R.T
    return math.atan2(Q[1, 0], Q[0, 0])


def heading_of_field(b: Array) -> float | None:
    """Return the heading (rad) from magnetic east by a field (3,) in the frame of a level robot, None if it is steep.

    The field points to magnetic north, the y axis of the world: b = (sin heading, cos heading) along the ground.
    """
    if not math.hypot(b[0], b[1]) > STEEP * float(np.linalg.norm(b)):
        return None
    return math.atan2(b[0], b[1])


def means(t_ns: Times, w: Array, ends: Sequence[int]) -> list[tuple[int, Array]]:
    """Return the means of rates w (N, m), linear between the times t_ns (N,), from each end to the next, at the next.

    The first is the rate itself.  An end before which there was no rate since the last one is left out; so are those
    outside the times.
    """
    from scipy.interpolate import make_interp_spline

    inside = [end for end in ends if t_ns[0] <= end <= t_ns[-1]]
    kept: list[int] = []
    for end in inside:
        if not kept or np.searchsorted(t_ns, end, "right") > np.searchsorted(t_ns, kept[-1], "right"):
            kept.append(end)
    if not kept:
        return []
    t, at = ((np.asarray(times) - t_ns[0]) * 1e-9 for times in (t_ns, kept))
    rate = make_interp_spline(t, w, k=min(len(t) - 1, 1))
    mean = np.diff(rate.antiderivative()(at), axis=0) / np.diff(at)[:, None]
    return list(zip(kept, [rate(at[0]), *mean], strict=True))
