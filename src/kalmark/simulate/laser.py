"""A laser among walls: where each of its beams ends."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.detect.laser_scan import Laser
from kalmark.simulate.sights import SEGMENTS, SimulatedSensing, Things


def beams(laser: Laser, sensing: SimulatedSensing, T: Array, things: dict[str, Things], rng: Generator) -> Array:
    """Return ranges and bearings (B, 2) of a raw scan from the pose T (3,), noise included; without a return, no beam.

    Its beams, its noise and its ranges are those that its detector takes it to have.
    """
    half = math.radians(sensing.beams_fov_deg) / 2
    full = sensing.beams_fov_deg == 360.0  # then the last one is not the first again
    angles = np.linspace(-half, half, sensing.beams, endpoint=not full)
    ranges = cast(T, angles, np.ascontiguousarray(things[SEGMENTS].values))
    ranges += laser.sigma_range_m * rng.standard_normal(len(ranges))
    kept = (laser.range_min_m <= ranges) & (ranges < laser.range_max_m)
    if sensing.dropouts:
        kept &= rng.random(len(ranges)) >= sensing.dropouts
    return np.column_stack([ranges[kept], angles[kept]])


@compiled
def cast(T: Array, angles: Array, walls: Array) -> Array:
    """Return how far beams at angles (B,) go from the pose T (3,) to the nearest of the walls (S, 4); inf: to none."""
    out = np.full(len(angles), np.inf)
    for i in range(len(angles)):
        c, s = math.cos(T[2] + angles[i]), math.sin(T[2] + angles[i])
        for k in range(len(walls)):
            x, y = walls[k, 0] - T[0], walls[k, 1] - T[1]
            u, v = walls[k, 2] - walls[k, 0], walls[k, 3] - walls[k, 1]
            cross = c * v - s * u
            if cross == 0.0:
                continue
            r, t = (x * v - y * u) / cross, (x * s - y * c) / cross
            if 0.0 < r < out[i] and 0.0 <= t <= 1.0:
                out[i] = r
    return out
