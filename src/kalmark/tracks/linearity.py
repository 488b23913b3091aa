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
from kalmark.geometry.angles import rotation, wrap
from kalmark.geometry.spaces import SE2
from kalmark.models.observe import linearize

SIGMAS = 2.0  # of the pose, at which its sigma points are
SHARE = 0.5  # of a change that an iterated correction bears to be left out by a linearisation
TURN_RAD = 0.5  # sigma of a heading: |E(d) - I - J d| = SHARE |d| at d = SIGMAS times it


def turn_holds(P: Array) -> bool:
    """Return whether turns by the errors of a pose of covariance P (3, 3) or (6, 6) are as good as linear."""
    return bool(P.diagonal()[2 if len(P) == 3 else 3 :].max() <= TURN_RAD**2)


def sigma_point_steps(P: Array) -> Array:
    """Return the steps (3, 3) to the sigma points of a pose, by rows, P (3, 3) = sum of their squares.

    That of the heading, with the position as it is correlated, comes first, then those of the position.
    """
    sigma = math.sqrt(max(float(P[2, 2]), 1e-24))
    along = P[:, 2] / sigma
    own, V = np.linalg.eigh((P - np.outer(along, along))[:2, :2])
    steps = np.zeros((3, 3))
    steps[0] = along * min(SIGMAS, math.pi / sigma)
    steps[1:, :2] = (SIGMAS * V * np.sqrt(np.maximum(own, 0.0))).T
    return steps


def turn_pose(r: Array, step: Array) -> Array:
    """Return a pose r (3,) moved by a step (3,), along the arc that an unknown turn is."""
    if step[2] == 0.0:
        return SE2.plus(r, step)
    arm = np.array([step[1], -step[0]]) / step[2]  # from the place about which the heading turns the position
    return np.array([*r[:2] - arm + rotation(step[2]) @ arm, wrap(r[2] + step[2])])


def bends(view: Any, head: Array, P: Array, y: Array, R: Array) -> Flags:
    """Return along which axes (3,) of a pose no linearisation describes some of the observations y (K, m + n).

    They are of landmarks known exactly, whose numbers come behind the measurement; `head` (h,) begins with the pose of
    the covariance P (3, 3), and R (K, p, p) is the noise.
    """
    none, steps = np.zeros((len(y), 0)), sigma_point_steps(P)
    e, _, E_h, _ = linearize(view, head, none, y)  # innovations are wrapped: they count from what is expected
    white = np.linalg.inv(np.linalg.cholesky(R))
    linear = np.einsum("kpq,kqi,ai->akp", white, E_h[:, :, :3], steps)
    off = np.empty((2, *linear.shape))
    for a, step in enumerate(steps):
        for i, sign in enumerate((1.0, -1.0)):
            there = np.concatenate([turn_pose(head[:3], sign * step), head[3:]])
            change = -linearize(view, there, none, e)[1]
            off[i, a] = np.einsum("kpq,kq->kp", white, change) - sign * linear[a]
    off[~np.isfinite(off)] = np.inf
    worst = np.linalg.norm(off, axis=3).max(axis=0)
    return np.asarray((worst > SHARE * np.linalg.norm(linear, axis=2) + 1.0).any(axis=1))
