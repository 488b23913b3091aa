"""Gaussians: density, expectation, propagation, ellipses, distances, gates; operations on uncertain frames.

[S] App. B up to the gates; Smith and Cheeseman's approximate transformations, as in [T] 2, for the rest.  How
landmarks are started from them is in `kalmark.management.delayed`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose, inverse


def density(x: Any, mean: Any, cov: Any) -> Array:
    """Return the density (...) of an n-D Gaussian at x (..., n), of which `mean` is (n,) and `cov` (n, n).  [S] (69).

    >>> float(km.geometry.density([0.0, 0.0], [0.0, 0.0], np.eye(2)).round(3))  # 1 / (2 pi)
    0.159
    """
    P = np.asarray(cov, dtype=np.float64)
    d = np.asarray(x, dtype=np.float64) - np.asarray(mean, dtype=np.float64)
    exponent = -0.5 * (d * np.linalg.solve(P, d[..., None])[..., 0]).sum(-1)
    return np.asarray(np.exp(exponent) / np.sqrt(np.linalg.det(2 * np.pi * P)))


def expectation(f: Callable[[Array], Any], mean: Any, cov: Any, points: int = 20) -> Array:
    """Return E[f(x)], of the shape of f(x), of a Gaussian x with `mean` (n,) and `cov` (n, n).  [S] (66).

    Gauss-Hermite quadrature at `points` places along each axis: exact if f is a polynomial of degree 2 points - 1.

    >>> km.geometry.expectation(lambda x: x**2, [1.0], [[0.25]]).round(3)  # mean^2 + variance
    array([1.25])
    """
    axes, d2, _ = np.linalg.svd(np.asarray(cov, dtype=np.float64))
    nodes, weights = np.polynomial.hermite_e.hermegauss(points)
    grid, weight = (np.stack(np.meshgrid(*[each] * len(d2)), axis=-1).reshape(-1, len(d2)) for each in (nodes, weights))
    x = np.asarray(mean, dtype=np.float64) + (grid * np.sqrt(d2)) @ axes.T
    return np.tensordot(weight.prod(axis=1) / weights.sum() ** len(d2), np.array([f(each) for each in x]), axes=1)


def propagate(f: Callable[[Array], tuple[Array, Array]], mean: Any, cov: Any) -> tuple[Array, Array]:
    """Return the mean (m,) and covariance (m, m) of f(x) to first order, of x with `mean` (n,) and `cov` (n, n).

    f returns its value (m,) and its Jacobian (m, n).  [S] (76)-(77); if f is linear, exactly (72)-(73).

    >>> p, P = km.geometry.propagate(km.geometry.inv_scan, [2.0, 0.0], np.diag([0.1, 0.2]) ** 2)
    >>> np.diag(P).round(3)
    array([0.01, 0.16])
    """
    y, F = f(np.asarray(mean, dtype=np.float64))
    return y, F @ np.asarray(cov, dtype=np.float64) @ F.T


def ellipse_axes(cov: Any, sigmas: float = 1.0) -> tuple[Array, float]:
    """Return the semi-axes (2,), the greater first, of the n-sigma ellipse of `cov` (2, 2), and the angle of that one.

    The angle (rad) is in (-pi/2, pi/2].  [S] (79)-(82), Fig. 8.

    >>> axes, angle = km.geometry.ellipse_axes([[2.5, 1.5], [1.5, 2.5]])
    >>> axes.round(3), round(angle, 3)
    (array([2., 1.]), 0.785)
    """
    axes, d2, _ = np.linalg.svd(np.asarray(cov, dtype=np.float64))
    return sigmas * np.sqrt(d2), float(wrap(2 * np.arctan2(axes[1, 0], axes[0, 0])) / 2)


def ellipse(mean: Any, cov: Any, sigmas: float = 1.0, points: int = 16) -> Array:
    """Return the n-sigma contour of a 2-D Gaussian as (points + 1, 2), closed.  [S] (85)-(87), `cov2elli`.

    >>> km.geometry.ellipse([0.0, 0.0], np.diag([4.0, 1.0]), sigmas=3, points=4).round(3) + 0.0
    array([[ 6.,  0.],
           [ 0.,  3.],
           [-6.,  0.],
           [ 0., -3.],
           [ 6.,  0.]])
    """
    axes, d2, _ = np.linalg.svd(np.asarray(cov, dtype=np.float64))
    alpha = 2 * np.pi / points * np.arange(points + 1)
    circle = np.stack([np.cos(alpha), np.sin(alpha)])
    return np.asarray(mean, dtype=np.float64) + (sigmas * axes @ (np.sqrt(d2)[:, None] * circle)).T


def ellipses(means: Array, covs: Array, sigmas: float = 1.0, points: int = 16) -> Array:
    """Return the n-sigma contours (K, points + 1, 2) of 2-D Gaussians, closed; NaN of what is not finite."""
    return contours(means, covs, sigmas, points)[:, 0]


def contours(means: Array, covs: Array, sigmas: float = 3.0, points: int | None = None) -> Array:
    """Return the contours (K, C, points + 1, d) of Gaussians, closed: ellipses, in space three great circles each.

    [S] (85)-(87).  NaN where a Gaussian is not finite.  By default 40 points, in space 24.
    """
    d = means.shape[1]
    alpha = np.linspace(0.0, 2.0 * np.pi, 1 + (points or (40 if d == 2 else 24)))
    circles = np.zeros((d * (d - 1) // 2, d, len(alpha)))
    for circle, (i, j) in zip(circles, combinations(range(d), 2), strict=True):
        circle[i], circle[j] = np.cos(alpha), np.sin(alpha)
    known = is_finite(means, covs)
    values, axes = np.linalg.eigh(np.where(known[:, None, None], covs, 0.0))
    half = axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    out = means[:, None, None, :] + sigmas * np.einsum("kij,cjp->kcpi", half, circles)
    return np.where(known[:, None, None, None], out, np.nan)


def is_finite(means: Array, covs: Array) -> Flags:
    """Return which Gaussians (K,) are finite."""
    return np.logical_and(np.isfinite(covs).all(axis=(1, 2)), np.isfinite(means).all(axis=1))


def mahalanobis(x: Any, mean: Any, cov: Any) -> float:
    """Return the Mahalanobis distance (not its square) of x from a Gaussian.  [S] (83).

    >>> round(km.geometry.mahalanobis([2.0, 0.0], [0.0, 0.0], np.diag([4.0, 1.0])), 3)
    1.0
    """
    d = np.asarray(x, dtype=np.float64) - np.asarray(mean, dtype=np.float64)
    return float(np.sqrt(d @ np.linalg.solve(np.asarray(cov, dtype=np.float64), d)))


def bhattacharyya(a: Any, A: Any, b: Any, B: Any) -> float:
    """Return the Bhattacharyya distance between two Gaussians (n,): how far apart they are, and how unlike.  [T] 2.

    (a - b)' (A + B)^-1 (a - b) / 4 + log(det((A + B) / 2) / sqrt(det A det B)) / 2.

    >>> float(np.round(km.geometry.bhattacharyya([2.0], [[1.0]], [0.0], [[1.0]]), 3))
    0.5
    """
    A, B = np.asarray(A, dtype=np.float64), np.asarray(B, dtype=np.float64)
    d = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
    _, both = np.linalg.slogdet((A + B) / 2)
    apart = d @ np.linalg.solve(A + B, d) / 4
    return float(apart + (both - (np.linalg.slogdet(A)[1] + np.linalg.slogdet(B)[1]) / 2) / 2)


def normalized_weights(log_weights: Array) -> Array:
    """Return the weights (H,), whose sum is 1, of their logarithms."""
    w = np.exp(log_weights - log_weights.max())
    return np.asarray(w / w.sum())


def quantile(probability: Any, dof: Any) -> Any:
    """Return the quantile of chi-square: of numbers, or of arrays that go together."""
    from scipy.special import gammaincinv

    return 2.0 * gammaincinv(np.asarray(dof) / 2, probability)


@lru_cache(maxsize=256)
def gate(probability: float, dof: int) -> float:
    """Return the squared Mahalanobis distance within which a Gaussian of `dof` dimensions lies so often.

    >>> round(km.geometry.gate(0.95, dof=2), 3)
    5.991
    """
    return float(quantile(probability, dof))


def sigma_probability(sigmas: float, dof: int) -> float:
    """Return how often a Gaussian of `dof` dimensions lies inside its n-sigma ellipsoid.  [S] Table 3.

    >>> round(km.geometry.sigma_probability(3.0, dof=2), 4)
    0.9889
    """
    from scipy.special import chdtr

    return float(chdtr(dof, sigmas**2))


def sigma_table(sigmas: tuple[float, ...] = (1, 2, 3, 4), dofs: tuple[int, ...] = (2, 3)) -> Array:
    """Return the probabilities (D, S) of [S] Table 3 for D dimensions and S numbers of sigmas.

    >>> km.geometry.sigma_table().round(3)
    array([[0.393, 0.865, 0.989, 1.   ],
           [0.199, 0.739, 0.971, 0.999]])
    """
    return np.array([[sigma_probability(n, dof) for n in sigmas] for dof in dofs])


def compound(a: Any, A: Any, b: Any, B: Any) -> tuple[Array, Array]:
    """Compound two uncertain transforms in series: c = a o b with covariance C (3, 3).  [T] 2 (i).

    >>> a, A = [1.0, 2.0, np.pi / 2], np.diag([0.01, 0.01, 0.0025])
    >>> c, C = km.geometry.compound(a, A, [1.0, 0.0, 0.0], A)
    >>> np.diag(C).round(4)
    array([0.0225, 0.02  , 0.005 ])
    """
    c, c_a, c_b = compose(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    return c, c_a @ np.asarray(A) @ c_a.T + c_b @ np.asarray(B) @ c_b.T


def merge(a: Any, A: Any, b: Any, B: Any) -> tuple[Array, Array]:
    """Merge two independent estimates of one frame (3,) or point (2,), in parallel.  [T] 2 (ii).

    A third component is an angle; the difference is wrapped before it is weighed.

    >>> m, M = km.geometry.merge([1.0, 0.0], np.eye(2), [2.0, 0.0], np.eye(2))
    >>> m.round(3), np.diag(M).round(3)
    (array([1.5, 0. ]), array([0.5, 0.5]))
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


def relative_frame(a: Any, b: Any) -> tuple[Array, Array, Array]:
    """Return the frame b as seen from the frame a, c = a^-1 o b (3,), with C_a and C_b (3, 3).

    >>> c, C_a, C_b = km.geometry.relative_frame([1.0, 2.0, np.pi / 2], [1.0, 3.0, np.pi / 2])
    >>> c.round(3)
    array([1., 0., 0.])
    """
    back, A_a = inverse(np.array(a, dtype=np.float64))
    c, C_back, C_b = compose(back, np.array(b, dtype=np.float64))
    return c, C_back @ A_a, C_b


def intersection(a: Any, b: Any) -> tuple[Array, Array, Array]:
    """Return where two rays meet, p (..., 2), with P_a and P_b (..., 2, 3).  [T] 2.

    A ray is a frame (..., 3) and runs along its x axis; p is NaN where they do not meet ahead of both.

    >>> p, P_a, P_b = km.geometry.intersection([0.0, 0.0, 0.0], [2.0, -1.0, np.pi / 2])
    >>> p.round(3)
    array([2., 0.])
    """
    a, b = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    u_a, u_b = (np.stack([np.cos(r[..., 2]), np.sin(r[..., 2])], axis=-1) for r in (a, b))
    w = b[..., :2] - a[..., :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        sin = _cross(u_a, u_b)
        t_a, t_b = _cross(w, u_b) / sin, _cross(w, u_a) / sin
        p = a[..., :2] + t_a[..., None] * u_a
        P_a, P_b = _moved(u_a, u_b, t_a, sin), _moved(u_b, u_a, t_b, -sin)
    p[~((t_a > 0) & (t_b > 0))] = np.nan
    return p, P_a, P_b


def _cross(u: Array, v: Array) -> Array:
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])


def _moved(u: Array, other: Array, t: Array, sin: Array) -> Array:
    """Return how the point at t along the ray u moves with that ray: along the other one, by what u moves across."""
    across = np.stack([-u[..., 1], u[..., 0], t], axis=-1)  # of the point, with (x, y, heading)
    return np.asarray(-other[..., :, None] * across[..., None, :] / -sin[..., None, None])
