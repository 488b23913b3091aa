"""Does an estimate err as much as it says?  NEES in the estimator's coordinates, NIS, and their chi-square bounds.

Bar-Shalom, Li, Kirubarajan 2001, section 5.4; Bailey et al. 2006 for the use in SLAM.  In the plane poses are
(x, y, theta) and the error of a heading is a number; in space poses are (x, y, z, qx, qy, qz, qw), and the error of an
orientation is the rotation vector in the world's frame that turns the estimate into the truth.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from kalmark.geometry.angles import wrap

Array = npt.NDArray[np.float64]

SINGULAR = 1e-12  # smallest eigenvalue of a correlation matrix that still counts as regular
DIVERGED_SIGMAS = 10.0
DIVERGED_PATH = 0.05


def left_jacobian_inverse(a: Any) -> Array:
    """Return V(a)^-1 (..., 2, 2) for angles a (...), with V(a) = [[sin a, -(1-cos a)], [1-cos a, sin a]] / a."""
    half = 0.5 * np.asarray(a, dtype=np.float64)
    small = np.abs(half) < 1e-4
    safe = np.where(small, 1.0, half)
    diagonal = np.where(small, 1.0 - half**2 / 3.0, safe / np.tan(safe))
    return np.stack([np.stack([diagonal, half], -1), np.stack([-half, diagonal], -1)], -2)


def turned_back(turn: Array, d: Array) -> Array:
    """Return V(turn)^-1 d (..., 3) for rotation vectors (..., 3), V the left Jacobian of SO(3), angles up to pi."""
    half = 0.5 * np.linalg.norm(turn, axis=-1, keepdims=True)
    small = half < 1e-2
    safe = np.where(small, 1.0, half)
    series = 1 / 12 + half**2 * (1 / 180 + half**2 / 1890)
    q = np.where(small, series, (1.0 - safe / np.tan(safe)) / (4.0 * safe**2))
    once = np.cross(turn, d)
    return d - 0.5 * once + q * np.cross(turn, once)


def rotation_error(mean: Array, truth: Array) -> Array:
    """Return Log(Q_truth Q_mean') (..., 3), at most pi long, for unit quaternions (..., 4)."""
    mean, truth = np.asarray(mean, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    v, w, v2, w2 = truth[..., :3], truth[..., 3:], -mean[..., :3], mean[..., 3:]
    vector = w * v2 + w2 * v + np.cross(v, v2)
    scalar = w * w2 - np.sum(v * v2, axis=-1, keepdims=True)
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, np.abs(scalar))
    scale = np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0)
    return np.where(scalar < 0.0, -scale, scale) * vector


def point_error(mean: Array, truth: Array, dtheta: Any, coordinates: str) -> Array:
    """Return the error (..., 2 or 3) of points in the estimator's coordinates, "world" or "log".

    World: d = truth - mean.  Log: V(dtheta)^-1 d with the heading error (...), in space the rotation error (..., 3),
    of the (observing) robot.
    """
    d = np.asarray(truth, dtype=np.float64) - np.asarray(mean, dtype=np.float64)
    if coordinates == "world":
        return d
    if coordinates != "log":
        raise ValueError(f"coordinates is {coordinates!r}, expected 'world' or 'log'")
    if d.shape[-1] == 3:
        return turned_back(np.asarray(dtheta, dtype=np.float64), d)
    return np.einsum("...ij,...j->...i", left_jacobian_inverse(dtheta), d)


def pose_error(mean: Array, truth: Array, coordinates: str = "world") -> Array:
    """Return the errors (..., 3 or 6) of poses (..., 3 or 7): position, then orientation, in "world" or "log".

    In log coordinates the estimate's retraction by the error is the truth: the orientation turned by Exp(d_theta), the
    position moved by V(d_theta) d_p.
    """
    mean, truth = np.asarray(mean, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if mean.shape[-1] == 7:
        turn = rotation_error(mean[..., 3:], truth[..., 3:])
        return np.concatenate([point_error(mean[..., :3], truth[..., :3], turn, coordinates), turn], axis=-1)
    dtheta = np.asarray(wrap(truth[..., 2] - mean[..., 2]))
    position = point_error(mean[..., :2], truth[..., :2], dtheta, coordinates)
    return np.concatenate([position, dtheta[..., None]], axis=-1)


def nees(d: Array, P: Array) -> Array:
    """Return d^T P^-1 d (...) for errors (..., n) and covariances (..., n, n); NaN where P is singular.

    Singular: a variance that is not positive, or a correlation matrix with an eigenvalue below 1e-12.
    """
    d, P = np.asarray(d, dtype=np.float64), np.asarray(P, dtype=np.float64)
    variance = np.einsum("...ii->...i", P)
    regular = (variance > 0.0).all(-1) & np.isfinite(P).all((-2, -1)) & np.isfinite(d).all(-1)
    sigma = np.sqrt(np.where(regular[..., None], variance, 1.0))
    correlation = np.where(
        regular[..., None, None], P / (sigma[..., :, None] * sigma[..., None, :]), np.eye(d.shape[-1])
    )
    regular &= np.linalg.eigvalsh(correlation)[..., 0] > SINGULAR
    correlation = np.where(regular[..., None, None], correlation, np.eye(d.shape[-1]))
    scaled = np.where(regular[..., None], d / sigma, 0.0)
    value = np.einsum("...i,...i->...", scaled, np.linalg.solve(correlation, scaled[..., None])[..., 0])
    return np.where(regular, value, np.nan)


def nis(z: Array, Z: Array) -> tuple[Array, npt.NDArray[np.int64]]:
    """Return z^T Z^-1 z (K,) and its degrees of freedom (K,) for innovations (K, m) padded with NaN."""
    dof = np.isfinite(z).sum(axis=1)
    value = np.full(len(z), np.nan)
    for m in np.unique(dof[dof > 0]):  # a sensor's rows come first, the padding after them
        rows = dof == m
        value[rows] = nees(z[rows, :m], Z[rows, :m, :m])
    return value, np.where(np.isfinite(value), dof, 0)


def anees_interval(dof: float, runs: float = 1, probability: float = 0.95) -> tuple[float, float]:
    """Return the two-sided bounds of the mean of `runs` independent NEES values of `dof` degrees of freedom each."""
    tail = (1.0 - probability) / 2.0
    return float(chi2.ppf(tail, dof * runs)) / runs, float(chi2.ppf(1.0 - tail, dof * runs)) / runs


def diverged(d: Array, P: Array, error_m: Array, path_m: float) -> bool:
    """Tell whether the position error ever exceeds 10 of its own sigmas and 5 % of the path.

    `d` (N, 2 or 3) is the position error in the estimator's coordinates, `P` its covariance, `error_m` (N,) its
    length in metres.  Sigmas are counted as the Mahalanobis distance.
    """
    far = np.sqrt(nees(d, P)) > DIVERGED_SIGMAS
    return bool(np.any(far & (error_m > DIVERGED_PATH * path_m)))
