"""Relocation of a robot by fixes that agree with each other and do not fit its estimated pose.

Fixes are positions of the robot, or those of an antenna on it, which a sensor of the state measures.

A fix outside its gate is left out.  A filter that has lost its robot would leave out all of them.  So the last fixes
that were left out, one after the other, are compared with the estimated positions of the robot: if a shift and a turn
about the vertical axis lead from there to all of them, within their noise, the robot is moved by it, or, where fixes
have fitted before, a second hypothesis begins there.  Components that this does not determine, and all correlation of
the robot with the map, are dropped.

If nothing has determined yet where the map is in the world, no survey and fewer fixes that fitted than must agree, it
was the start that was wrong: then the whole map is moved with the robot.  Its covariance gets that of the shift and of
the turn, which all of it shares.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from kalmark.arrays import Array
from kalmark.geometry.angles import rotation, wrap
from kalmark.geometry.gaussian import gate
from kalmark.geometry.rotations import exp, multiply
from kalmark.geometry.spaces import ANCHOR, VECTOR, VECTOR3, Space
from kalmark.tracks.linearity import TURN_RAD

NEEDED, KEPT = 5, 30  # fixes that must agree, and the last so many that are compared
SHARE = 0.999  # of agreeing fixes that are accepted
LOOSE = 2.0  # sigmas of a fix, for what the robot's motion adds between the fixes


class RejectedFix(NamedTuple):
    """A fix y (d,) with covariance R (d, d) that was left out when the estimate of what it measures was p (d,)."""

    y: Array
    R: Array
    p: Array


class Shift(NamedTuple):
    """A motion of the world: a turn by `yaw` about the vertical axis, then by t (d,).

    `cov` (d + 1, d + 1) is that of t and of the turn, which counts from `pivot` (d,).
    """

    yaw: float
    t: Array
    pivot: Array
    cov: Array


class Relocation(NamedTuple):
    """The robot's new pose (3,) or (7,), and the covariance (3, 3) or (6, 6) of that; and by what it was moved."""

    pose: Array
    cov: Array
    shift: Shift


def pose_by_fixes(pose: Array, P: Array, left_out: Sequence[RejectedFix]) -> Relocation | None:
    """Return the new pose of a robot estimated at `pose` with covariance P; None where fixes do not determine it."""
    if len(left_out) < NEEDED:
        return None
    y, p = (np.array([getattr(one, name) for one in left_out]) for name in ("y", "p"))
    R, d = np.mean([one.R for one in left_out], axis=0) * LOOSE**2, y.shape[1]
    y0, p0 = y.mean(axis=0), p.mean(axis=0)
    a, b = p[:, :2] - p0[:2], y[:, :2] - y0[:2]
    variance = 0.5 * float(np.trace(R[:2, :2])) / max(float(np.sum(a**2)), 1e-300)
    if variance > TURN_RAD**2:
        return None
    yaw = float(np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b)))
    turned = np.column_stack([a @ rotation(yaw).T, p[:, 2:] - p0[2:]])
    residuals = y - y0 - turned
    if np.einsum("ki,ij,kj->", residuals, np.linalg.inv(R), residuals) > gate(SHARE, d * len(y) - d - 1):
        return None
    new, cov = pose.copy(), P.copy()
    arm = rotation(yaw) @ (pose[:2] - p0[:2])
    new[:2], new[2:d] = y0[:2] + arm, pose[2:d] + y0[2:] - p0[2:]
    heading = 2 if d == 2 else 5
    cov[:d, :d] = R / len(y)
    cov[:d, d:] = cov[d:, :d] = 0.0
    cov[heading, :], cov[:, heading] = 0.0, 0.0
    across = np.array([-arm[1], arm[0]])  # what an error of the turn does to a robot that is not amid its fixes
    cov[:2, :2] += variance * np.outer(across, across)
    cov[:2, heading] = cov[heading, :2] = variance * across
    cov[heading, heading] = variance
    if d == 2:
        new[2] = wrap(pose[2] + yaw)
    else:
        new[3:] = multiply(exp(np.array([0.0, 0.0, yaw])), pose[3:])
    t = y0 - np.array([*rotation(yaw) @ p0[:2], *p0[2:]])
    return Relocation(new, cov, Shift(yaw, t, y0, block_diag(R / len(y), variance)))


def can_move(space: Space) -> bool:
    """Return whether a block of the map can be moved: it has a place, or none at all."""
    return space.world == "" or space.kinds[0] in (VECTOR, VECTOR3, ANCHOR)


def shift_block(space: Space, x: Array, shift: Shift) -> tuple[Array, Array]:
    """Return a block's mean x (size,) after a motion of the world, and G (dof, d + 1) by that motion's error."""
    d, G = len(shift.t), np.zeros((space.dof, len(shift.t) + 1))
    if space.world == "":
        return x, G
    new = space.rotated(x, shift.yaw if d == 2 else np.array([0.0, 0.0, shift.yaw]))
    new[:d] += shift.t
    G[:d, :d], G[:, d] = np.eye(d), space.generator(new)[:, -1]
    G[:2, d] += [shift.pivot[1], -shift.pivot[0]]
    return new, G
