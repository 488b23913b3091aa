"""The depth of pixels beside an image (RGB-D): what a measurement (u, v, 1 / z) has of it, and its uncertainty.

At the edge of a thing the depth image jumps, and the pixel may belong to either side.  So the depth counts where all
around the pixel agree within `EDGE` sigmas, and where it is within the gate of what the filter expects.  Elsewhere the
pixel counts alone: an inverse depth as expected, with a sigma of `UNKNOWN`; a new landmark has the prior of its type.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np

from kalmark.arrays import Array
from kalmark.vision.selection import GATE

AROUND = 1  # pixels on each side that must agree
EDGE = 6.0  # sigmas between the nearest and the farthest of them
UNKNOWN = 1e3  # 1/m


@runtime_checkable
class DepthPrior(Protocol):
    """A type of landmark with a prior of its inverse distance."""

    prior_rho_per_m: float
    sigma_rho_per_m: float


def inverse_depths(depth: Array, y: Array, sigma: float) -> Array:
    """Return 1 / depth (n,) [1/m] at pixels y (n, 2) of a depth image (H, W) in m; NaN: none, or at an edge."""
    offsets = np.arange(-AROUND, AROUND + 1)
    at = np.rint(y).astype(np.int64)
    rows = np.clip(at[:, 1, None, None] + offsets[:, None], 0, depth.shape[0] - 1)
    columns = np.clip(at[:, 0, None, None] + offsets, 0, depth.shape[1] - 1)
    near = depth[rows, columns].reshape(len(y), len(offsets) ** 2)
    there = near > 0
    rho = 1.0 / np.where(there, near, 1.0)
    good = there.all(axis=1) & (np.ptp(rho, axis=1) <= EDGE * sigma)
    return np.where(good, rho[:, rho.shape[1] // 2], np.nan)


def with_depths(sensor: Any, landmark: Any, y: Array, rho: Array, e: Array, variance: Array) -> tuple[Array, Array]:
    """Return measurements (n, 3) of pixels y (n, 2) with inverse depths rho (n,), NaN: none, and noise (n, 3, 3).

    The first of them are of landmarks whose inverse depths are expected, e (k,) with a variance (k,) of the innovation;
    the rest are new `landmark`s.  One that has no prior of its depth is left out where no depth is.
    """
    k, out = len(e), np.column_stack([y, rho])
    R = np.array(sensor.noise(out), dtype=np.float64)
    off = ~(np.square(out[:k, 2] - e) <= GATE * variance)
    out[:k, 2][off], R[:k, 2, 2][off] = np.maximum(e[off], 0.0), UNKNOWN**2
    bare = k + np.flatnonzero(np.isnan(out[k:, 2]))
    if len(bare) and isinstance(landmark, DepthPrior):
        z = np.maximum(sensor.rays(y[bare])[:, 2], 1e-6)  # the prior is of the distance, not along the axis
        out[bare, 2], R[bare, 2, 2] = landmark.prior_rho_per_m / z, np.square(landmark.sigma_rho_per_m / z)
    return out, R
