"""The linearity of an observation over the uncertainty of the robot: whether one linearisation describes it.

An observation h is compared with its linearisation H at the sigma points x (+) d of the pose (Julier and Uhlmann 1997):

    n = h(x (+) d) - h(x) - H d,        |n| <= SHARE |H d| + 1        in sigmas of the noise

So a range at the middle of the robot needs no heading, however unknown that is, until the robot has moved.  An
iterated correction bears a part `SHARE` of the change, and a difference within the noise is not counted.

A place that is observed in the frame of the robot turns with the heading: v (E(d) - I).  There n and H d have the same
factor v, and the condition is one on the heading alone: `TURN_RAD`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.geometry.angles import wrap
from kalmark.models.observe import innovations_and_jacobians

SIGMAS = 2.0  # of the pose, at which its sigma points are
SHARE = 0.5  # of a change that an iterated correction bears to be left out by a linearisation
TURN_RAD = 0.5  # sigma of a heading: |E(d) - I - J d| = SHARE |d| at d = SIGMAS times it


def turn_holds(P: Array) -> bool:
    """Return whether turns by the errors of a pose of covariance P (3, 3) or (6, 6) are as good as linear."""
    return bool(P.diagonal()[2 if len(P) == 3 else 3 :].max() <= TURN_RAD**2)


def sigma_point_steps(P: Array) -> Array:
    """Return the steps (M, 3, 3) to the sigma points of poses, by rows, P (M, 3, 3) = sum of their squares.

    That of the heading, with the position as it is correlated, comes first, then those of the position.
    """
    sigma = np.sqrt(np.maximum(P[:, 2, 2:], 1e-24))
    along = P[:, 2] / sigma
    own, V = np.linalg.eigh((P - along[:, :, None] * along[:, None, :])[:, :2, :2])
    steps = np.zeros(P.shape)
    steps[:, 0] = along * np.minimum(SIGMAS, math.pi / sigma)
    steps[:, 1:, :2] = (SIGMAS * V * np.sqrt(np.maximum(own, 0.0))[:, None, :]).swapaxes(1, 2)
    return steps


def turn_pose(r: Array, step: Array) -> Array:
    """Return poses r (..., 3) moved by steps (..., 3), along the arcs that unknown turns are: by V(turn)."""
    turn = step[..., 2]
    arc = (step[..., 0] + 1j * step[..., 1]) * np.exp(0.5j * turn) * np.sinc(0.5 * turn / math.pi)
    return np.stack([r[..., 0] + arc.real, r[..., 1] + arc.imag, wrap(r[..., 2] + turn)], axis=-1)


def bends(view: Any, heads: Array, P: Array, y: Array, R: Array) -> Flags:
    """Return along which axes (N, 3) of poses no linearisation describes observations y (N, m + n), one of each pose.

    They are of landmarks known exactly, whose numbers come behind the measurement; `heads` (N, h) begin with the poses
    of the covariances P (N, 3, 3), and R (N, p, p) is the noise.  One pose, or one observation, stands for N.
    """
    count, steps, white = max(len(heads), len(y)), sigma_point_steps(P), np.linalg.inv(np.linalg.cholesky(R))
    heads, y = (np.repeat(each, count // len(each), axis=0) for each in (heads, y))
    both, there = np.concatenate([steps, -steps], axis=1), np.repeat(heads[:, None], 6, axis=1)
    there[..., :3] = turn_pose(there[..., :3], both)
    z, E_h = innovations_and_jacobians(view, heads, y[:, :0], y)
    y[:, : z.shape[1]] -= z  # innovations are wrapped: they count from what is expected
    y = np.repeat(y, 6, axis=0)
    change = -innovations_and_jacobians(view, there.reshape(len(y), -1), y[:, :0], y)[0].reshape(count, 6, -1)
    linear = both @ (white @ E_h[:, :, :3]).swapaxes(1, 2)
    off = change @ white.swapaxes(1, 2) - linear
    off[~np.isfinite(off)] = np.inf
    bent = np.linalg.norm(off, axis=2) > SHARE * np.linalg.norm(linear, axis=2) + 1.0
    return np.asarray(bent.reshape(-1, 2, 3).any(axis=1))
