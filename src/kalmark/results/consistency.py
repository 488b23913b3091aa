"""Does an estimate err as much as it says?  NEES in the estimator's coordinates, NIS, and their chi-square bounds.

Bar-Shalom, Li, Kirubarajan 2001, section 5.4; Bailey et al. 2006 for the use in SLAM.  Points, poses: 2-D.
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


def point_error(mean: Array, truth: Array, dtheta: Any, coordinates: str) -> Array:
    """Return the error (..., 2) of points in the estimator's coordinates, "world" or "log".

    World: d = truth - mean.  Log: V(dtheta)^-1 d with the heading error of the (observing) robot.
    """
    d = np.asarray(truth, dtype=np.float64) - np.asarray(mean, dtype=np.float64)
    if coordinates == "world":
        return d
    if coordinates != "log":
        raise ValueError(f"coordinates is {coordinates!r}, expected 'world' or 'log'")
    return np.einsum("...ij,...j->...i", left_jacobian_inverse(dtheta), d)


def pose_error(mean: Array, truth: Array, coordinates: str = "world") -> Array:
    """Return the error (..., 3) of poses (x, y, theta), the heading's wrapped, in "world" or "log" coordinates."""
    mean, truth = np.asarray(mean, dtype=np.float64), np.asarray(truth, dtype=np.float64)
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

    `d` (N, 2) is the position error in the estimator's coordinates, `P` (N, 2, 2) its covariance, `error_m` (N,) its
    length in metres.  Sigmas are counted as the Mahalanobis distance.
    """
    far = np.sqrt(nees(d, P)) > DIVERGED_SIGMAS
    return bool(np.any(far & (error_m > DIVERGED_PATH * path_m)))
