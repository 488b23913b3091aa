"""Gaussians: ellipses, Mahalanobis distance, gates, and uncertain transforms compounded and merged.

[S] App. B for the first three; Smith and Cheeseman's approximate transformations, as in [T] 2, for the last two.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose

Array = npt.NDArray[np.float64]


def ellipse(mean: Any, cov: Any, sigmas: float = 1.0, points: int = 16) -> Array:
    """Return the n-sigma contour of a 2-D Gaussian as (points + 1, 2), closed.  [S] (85)-(87), `cov2elli`."""
    axes, d2, _ = np.linalg.svd(np.asarray(cov, dtype=np.float64))
    alpha = 2 * np.pi / points * np.arange(points + 1)
    circle = np.stack([np.cos(alpha), np.sin(alpha)])
    return np.asarray(mean, dtype=np.float64) + (sigmas * axes @ (np.sqrt(d2)[:, None] * circle)).T


def mahalanobis(x: Any, mean: Any, cov: Any) -> float:
    """Return the Mahalanobis distance (not its square) of x from a Gaussian.  [S] (83)."""
    d = np.asarray(x, dtype=np.float64) - np.asarray(mean, dtype=np.float64)
    return float(np.sqrt(d @ np.linalg.solve(np.asarray(cov, dtype=np.float64), d)))


def gate(probability: float, dof: int) -> float:
    """Return the squared Mahalanobis distance within which a Gaussian of `dof` dimensions lies so often."""
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(dof / 2, probability))  # the quantile of chi-square


def sigma_probability(sigmas: float, dof: int) -> float:
    """Return how often a Gaussian of `dof` dimensions lies inside its n-sigma ellipsoid.  [S] Table 3."""
    from scipy.special import chdtr

    return float(chdtr(dof, sigmas**2))


def sigma_table(sigmas: tuple[float, ...] = (1, 2, 3, 4), dofs: tuple[int, ...] = (2, 3)) -> Array:
    """Return the probabilities of [S] Table 3, one row a dimension, one column a number of sigmas."""
    return np.array([[sigma_probability(n, dof) for n in sigmas] for dof in dofs])


def compound(a: Any, A: Any, b: Any, B: Any) -> tuple[Array, Array]:
    """Compound two uncertain transforms in series: c = a o b with covariance C (3, 3).  [T] 2 (i)."""
    c, c_a, c_b = compose(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    return c, c_a @ np.asarray(A) @ c_a.T + c_b @ np.asarray(B) @ c_b.T


def merge(a: Any, A: Any, b: Any, B: Any) -> tuple[Array, Array]:
    """Merge two independent estimates of one frame (3,) or point (2,), in parallel.  [T] 2 (ii).

    A third component is an angle; the difference is wrapped before it is weighed.
    """
    a, A, B = (np.asarray(m, dtype=np.float64) for m in (a, A, B))
    z = np.asarray(b, dtype=np.float64) - a
    if len(a) == 3:
        z[2] = wrap(z[2])
    K = np.linalg.solve(A + B, A).T
    c = a + K @ z
    if len(c) == 3:
        c[2] = wrap(c[2])
    C = A - K @ A
    return c, (C + C.T) / 2
