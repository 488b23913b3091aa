"""Density of landmarks: their number in a unit of volume of space, and of a measurement.

The density about a place is n / (V_d r^d), r the distance to the n-th nearest of other landmarks, in metres, V_d the
volume of the unit ball: the estimate from the nearest neighbours, which has nothing to do with what is uncertain about
pose or landmarks.  In the units of a measurement y it is multiplied by |dl / dy|, as a spatial density of targets and
clutter is in Blackman and Popoli, ch. 6.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array

NEIGHBOURS = 4  # by whose distance the density is estimated
LEAST_M = 0.1  # they are not taken to stand closer than this


def log_ball(d: int) -> float:
    """Return the logarithm of the volume of the unit ball of d dimensions."""
    return 0.5 * d * math.log(math.pi) - math.lgamma(0.5 * d + 1)


def log_density(gaps: Array, alone: Array | float, d: int) -> Array:
    """Return the logarithm of how many landmarks there are per m^d about each of some places (K,).

    `gaps` (K, C) are the distances to other landmarks [m], the least first.  Without any there is one in the space
    within `alone` (K,), from where it was observed.
    """
    near = gaps[:, :NEIGHBOURS]
    reach = near[:, -1] if near.shape[1] else np.broadcast_to(np.asarray(alone, dtype=np.float64), len(gaps))
    return np.asarray(np.log(max(near.shape[1], 1)) - log_ball(d) - d * np.log(np.maximum(reach, LEAST_M)))


def log_volume_change(V: Array, R: Array) -> Array:
    """Return log |dl / dy| (K,) of places with covariance V (K, d, d), measured with the noise R (K, p, p).

    Numbers of y beyond the d that determine a place are those of any landmark: each counts as its own likelihood, one
    in sqrt(2 pi) sigma.
    """
    extra = R.shape[1] - V.shape[1]
    log_V, log_R = np.linalg.slogdet(V)[1], np.linalg.slogdet(R)[1]
    return np.asarray(0.5 * (log_V - log_R) - 0.5 * extra * math.log(2 * math.pi))
