"""Rigid alignment of positions (rotation and shift, no scale), least squares and robust.

Kabsch 1976 / Umeyama 1991, equations (39-42) of the latter with unit scale.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.geometry.rotations import from_matrix, multiply

Array = npt.NDArray[np.float64]


class Rigid(NamedTuple):
    """A rotation (d, d) followed by a shift (d,): what takes one set of positions onto another."""

    rotation: Array
    shift: Array

    def __call__(self, points: Array) -> Array:
        """Return the points (..., d) rotated and shifted."""
        return points @ self.rotation.T + self.shift

    @property
    def angle(self) -> float:
        """The rotation angle of a 2-D alignment, in radians."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))

    @property
    def quaternion(self) -> Array:
        """The rotation of an alignment in space as a unit quaternion xyzw (4,)."""
        return from_matrix(np.ascontiguousarray(self.rotation))

    def inverse(self) -> Rigid:
        """Return the alignment that undoes this one."""
        return Rigid(self.rotation.T, -self.rotation.T @ self.shift)

    def poses(self, poses: Array) -> Array:
        """Return poses (N, 3) = (x, y, theta) or (N, 7) = (x, y, z, qx, qy, qz, qw) rotated and shifted."""
        if poses.shape[1] == 7:
            turn = self.quaternion
            turned = np.array([multiply(turn, q) for q in np.ascontiguousarray(poses[:, 3:])])
            return np.column_stack([self(poses[:, :3]), turned.reshape(-1, 4)])
        return np.column_stack([self(poses[:, :2]), poses[:, 2] + self.angle])


def identity(d: int = 2) -> Rigid:
    """Return the alignment in `d` dimensions that changes nothing."""
    return Rigid(np.eye(d), np.zeros(d))


def rigid(source: Array, target: Array, weights: Array | None = None) -> Rigid:
    """Fit the rotation and shift that take `source` (N, d) onto `target` (N, d) with least squares, d = 2 or 3.

    Optional `weights` (N,) multiply the squared distances.  No points give the identity, one point a shift.
    """
    d = source.shape[1]
    w = np.ones(len(source)) if weights is None else weights
    if len(source) == 0 or w.sum() <= 0:
        return identity(d)
    mean_s, mean_t = w @ source / w.sum(), w @ target / w.sum()
    cross = (target - mean_t).T @ ((source - mean_s) * w[:, None])
    u, _, vt = np.linalg.svd(cross)
    mirror = np.ones(d)
    mirror[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt))  # a rotation, never a reflection
    rotation = (u * mirror) @ vt
    return Rigid(rotation, mean_t - rotation @ mean_s)


def rigid_robust(source: Array, target: Array, floor_m: float = 0.1, iterations: int = 200) -> Rigid:
    """Fit the alignment of points (N, d) that minimises the sum of the *distances*, which limits outliers.

    Iteratively reweighted least squares with weights 1 / max(distance, `floor_m`), until the fit stands still.
    """
    fit = rigid(source, target)
    for _ in range(iterations):
        distance = np.linalg.norm(fit(source) - target, axis=1)
        new = rigid(source, target, 1.0 / np.maximum(distance, floor_m))
        change = max(np.abs(new.rotation - fit.rotation).max(), np.abs(new(source) - fit(source)).max(initial=0.0))
        fit = new
        if change < 1e-9:
            break
    return fit


def rmse(errors: Array) -> float:
    """Return the root of the mean squared length of the errors (N, d), NaN if there are none."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) if len(errors) else float("nan")
