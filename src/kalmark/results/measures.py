"""Errors and consistency of an estimate: rigid alignment, RMSE, NEES, NIS and their chi-square bounds.

Alignment (rotation and shift, no scale): Kabsch 1976 / Umeyama 1991, equations (39-42) of the latter with unit scale.
Consistency: Bar-Shalom, Li, Kirubarajan 2001, section 5.4; Bailey et al. 2006 for the use in SLAM.  In the plane poses
are (x, y, theta) and the error of a heading is a number; in space poses are (x, y, z, qx, qy, qz, qw), and the error of
an orientation is the rotation vector in the world's frame that turns the estimate into the truth.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtr

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.filter import kernels
from kalmark.geometry.angles import exponential_v, wrap
from kalmark.geometry.gaussian import quantile
from kalmark.geometry.rotations import conjugate, exp, from_matrix, left_jacobian_inverse, log, multiply
from kalmark.results.history import History, Ints

SINGULAR = 1e-12  # 1 / tr C^-1, at most the smallest eigenvalue of a correlation matrix C, up to which it is singular
FEW = 8  # numbers of an error up to which a Cholesky factor takes less time without LAPACK
MAP_NEES = ("landmarks", "landmarks_world", "landmarks_dof", "joint", "joint_world", "joint_dof")
"""The NEES of landmarks (the mean) and of the joint state, in own and in world coordinates, and degrees of freedom."""
TINY = 1e-300
CONSISTENT, ALONE = 0.9999, 0.97  # of good runs, of single values: above them a NEES is worth a warning
DIVERGED_SIGMAS = 10.0
DIVERGED_PATH = 0.05


class Rigid(NamedTuple):
    """A rotation (d, d) followed by a shift (d,): what takes one set of positions onto another."""

    rotation: Array
    shift: Array

    def __call__(self, points: Array) -> Array:
        """Return the points (..., d) rotated and shifted."""
        return points @ self.rotation.T + self.shift

    def inverse(self) -> Rigid:
        """Return the alignment that undoes this one."""
        return Rigid(self.rotation.T, -self.rotation.T @ self.shift)

    def poses(self, poses: Array) -> Array:
        """Return poses (N, 3) = (x, y, theta) or (N, 7) = (x, y, z, qx, qy, qz, qw) rotated and shifted."""
        if poses.shape[1] == 7:
            turn = from_matrix(np.ascontiguousarray(self.rotation))
            product = np.array([multiply(turn, q) for q in np.eye(4)])  # of quaternions: linear in the second
            return np.column_stack([self(poses[:, :3]), poses[:, 3:] @ product])
        angle = np.arctan2(self.rotation[1, 0], self.rotation[0, 0])
        return np.column_stack([self(poses[:, :2]), poses[:, 2] + angle])


def identity_alignment(d: int = 2) -> Rigid:
    """Return the alignment in `d` dimensions that changes nothing."""
    return Rigid(np.eye(d), np.zeros(d))


def rigid(source: Array, target: Array, weights: Array | None = None) -> Rigid:
    """Fit the rotation and shift that take `source` (N, d) onto `target` (N, d) with least squares, d = 2 or 3.

    Optional `weights` (N,) multiply the squared distances.  No points give the identity, one point a shift.
    """
    d = source.shape[1]
    w = np.ones(len(source)) if weights is None else weights
    if len(source) == 0 or w.sum() <= 0:
        return identity_alignment(d)
    mean_s, mean_t = w @ source / w.sum(), w @ target / w.sum()
    cross = (target - mean_t).T @ ((source - mean_s) * w[:, None])
    u, _, vt = np.linalg.svd(cross)
    mirror = np.ones(d)
    mirror[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt))  # a rotation, never a reflection
    rotation = (u * mirror) @ vt
    return Rigid(rotation, mean_t - rotation @ mean_s)


def level(source: Array, target: Array) -> Rigid:
    """Fit a turn about the vertical axis and a shift that take `source` (N, d) onto `target` (N, d), d = 2 or 3."""
    rotation = np.eye(source.shape[1])
    rotation[:2, :2] = rigid(source[:, :2], target[:, :2]).rotation
    return Rigid(rotation, np.mean(target - source @ rotation.T, axis=0))


def level_sigmas(target: Array, variance: float, point: Array) -> tuple[float, float]:
    """Return the sigmas, m and rad, of a point (d,) moved by `level` and its turn: `target` (N, d) has a variance."""
    arms = (target - target.mean(axis=0))[:, :2]
    turn = variance / max(float(np.sum(arms**2)), variance)
    off = point[:2] - target[:, :2].mean(axis=0)
    return float(np.sqrt(variance / len(target) + turn * (off @ off))), float(np.sqrt(turn))


def similarity(source: Array, target: Array) -> tuple[Rigid, float]:
    """Fit the scale s, then the rotation and shift, that take `source` (N, d) onto `target` (N, d).  Umeyama 1991.

    The result takes points p to rotation (s p) + shift.  Points in one place give the scale 1.
    """
    fit = rigid(source, target)
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    spread = float(np.sum(a * a))
    scale = float(np.sum(b * (a @ fit.rotation.T))) / spread if spread > 0.0 else 1.0
    return Rigid(fit.rotation, target.mean(axis=0) - scale * fit.rotation @ source.mean(axis=0)), scale


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


def finite_mean(values: Any) -> float:
    """Return the mean of the values (N, ...) that are finite, NaN if none is."""
    values = np.asarray(values)[np.isfinite(values)]
    return float(values.mean()) if len(values) else float("nan")


def ratio(total: float, number: float) -> float:
    """Return a sum over the number of what was added, NaN if there is nothing."""
    return float(total / number) if number else float("nan")


def aligned_rmse(estimate: Array, truth: Array) -> float:
    """Return the RMSE of positions (N, d) after the rigid alignment that makes it least."""
    return rmse(rigid(estimate, truth)(estimate) - truth)


def sigmas(P: Array) -> Array:
    """Return the sigmas (..., n) of covariances (..., n, n): 0 of a variance that rounding made negative."""
    out: Array = np.sqrt(np.maximum(np.einsum("...ii->...i", P), 0.0))
    return out


def correlations_of(P: Array) -> Array:
    """Return the correlations (n, n) of a covariance (n, n), at most 1 in magnitude."""
    sigma = np.sqrt(np.maximum(np.diagonal(P), TINY))
    return np.clip(P / np.outer(sigma, sigma), -1.0, 1.0)


def place_sigma(P: Array, d: int) -> Array:
    """Return the sigma (...) of a coordinate, on average, of covariances (..., n, n) that begin with a place (d,)."""
    out: Array = np.sqrt(np.maximum(np.trace(P[..., :d, :d], axis1=-2, axis2=-1) / d, 0.0))
    return out


def path_m(positions: Array) -> float:
    """Return the length of a path of positions (N, d) in metres."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


@compiled
def log_translation(turn: float, x: float, y: float) -> tuple[float, float]:
    """Return V(turn)^-1 (x, y) in the plane."""
    p, q = exponential_v(turn)
    square = p * p + q * q
    return (p * x + q * y) / square, (p * y - q * x) / square


@compiled
def all_in_log(turn: Array, d: Array) -> Array:
    """Return V(turn)^-1 d (N, 3) of errors d with turns (N, 3), rotation vectors up to pi."""
    out = np.empty_like(d)
    for i in range(len(d)):
        inverse = left_jacobian_inverse(turn[i])
        for j in range(3):
            out[i, j] = inverse[j, 0] * d[i, 0] + inverse[j, 1] * d[i, 1] + inverse[j, 2] * d[i, 2]
    return out


@compiled
def rotations_between(mean: Array, truth: Array) -> Array:
    """Return Log(Q_truth Q_mean') (N, 3) of quaternions (N, 4)."""
    out = np.empty((len(mean), 3))
    for i in range(len(mean)):
        turn = log(multiply(truth[i], conjugate(mean[i])))
        for j in range(3):
            out[i, j] = turn[j]
    return out


def rotation_error(mean: Array, truth: Array) -> Array:
    """Return Log(Q_truth Q_mean') (..., 3), at most pi long, for unit quaternions (..., 4)."""
    return rotations_between(contiguous_rows(mean), contiguous_rows(truth)).reshape(*np.shape(mean)[:-1], 3)


def contiguous_rows(values: Any, shape: tuple[int, ...] | None = None) -> Array:
    """Return values (..., n), broadcast to a shape if one is given, as contiguous rows (N, n)."""
    values = np.asarray(values, dtype=np.float64)
    values = values if shape is None else np.broadcast_to(values, shape)
    return np.ascontiguousarray(values).reshape(-1, values.shape[-1])


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
    turn = np.asarray(dtheta)
    if d.shape[-1] == 3:
        return all_in_log(contiguous_rows(turn, d.shape), contiguous_rows(d)).reshape(d.shape)
    half = np.sinc(turn / (2.0 * np.pi))  # V^-1 is that of half the turn, scaled by a / 2 / sin(a / 2)
    c, s = np.cos(0.5 * turn) / half, np.sin(0.5 * turn) / half
    return np.stack([c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]], axis=-1)


def pose_error(mean: Array, truth: Array, coordinates: str = "world", turn: Any = None) -> Array:
    """Return the errors (..., 3 or 6) of poses (..., 3 or 7): position, then orientation, in "world" or "log".

    In log coordinates the estimate's retraction by the error is the truth: the orientation turned by Exp(d_theta), the
    position moved by V(d_theta) d_p.  `turn` is the error of the orientation of the robot that observed the pose, its
    own if absent: then the orientation's is that turn, and of what is left its logarithm.
    """
    mean, truth = np.asarray(mean, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if mean.shape[-1] == 3:
        own = np.asarray(wrap(truth[..., 2] - mean[..., 2]))
        position = point_error(mean[..., :2], truth[..., :2], own if turn is None else turn, coordinates)
        return np.concatenate([position, own[..., None]], axis=-1)
    own = rotation_error(mean[..., 3:], truth[..., 3:])
    position = point_error(mean[..., :3], truth[..., :3], own if turn is None else turn, coordinates)
    if turn is not None and coordinates == "log":
        own = turn + log(multiply(conjugate(exp(turn)), exp(own)))
    return np.concatenate([position, own], axis=-1)


@compiled
def factorize(S: Array, n: int) -> bool:
    """Replace the first n columns of S (n + E, n + E) by those of its Cholesky factor; return whether it is regular."""
    if n > FEW:
        return kernels.cholesky(S)
    for i in range(len(S)):
        for j in range(min(i + 1, n)):
            s = S[i, j]
            for k in range(j):
                s -= S[i, k] * S[j, k]
            S[i, j] = math.sqrt(max(s, 0.0)) if i == j else s / S[j, j]
    return True


@compiled
def write_nees(d: Array, P: Array, at: int, n: int, out: Array) -> None:
    """Write the NEES (E,) of E errors d (E, .), of their n numbers from `at` on, whose covariance P has in these rows.

    Of P the lower triangle is read.  NaN where P is singular.  By the Cholesky factor L of the correlation C with the
    scaled errors and the unit matrix as more rows: there it has L^-1 d and L^-1, whose squares sum up to tr C^-1.
    """
    E = len(d)
    S, sigma = np.zeros((2 * n + E, 2 * n + E)), np.empty(n)
    out.fill(np.nan)
    for i in range(n):
        variance = P[at + i, at + i]
        if not 0.0 < variance < np.inf:
            return
        sigma[i] = math.sqrt(variance)
        for j in range(i + 1):
            S[i, j] = P[at + i, at + j] / (sigma[i] * sigma[j])
        for c in range(E):
            S[n + c, i], S[n + c, n + c] = d[c, at + i] / sigma[i], 1e300
        S[n + E + i, i], S[n + E + i, n + E + i] = 1.0, 1e300
    if not factorize(S, n):
        return
    inverse = np.sum(S[n + E :, :n] ** 2)
    for c in range(E):
        out[c] = np.sum(S[n + c, :n] ** 2) if inverse * SINGULAR < 1.0 else np.nan


@compiled
def nees_of_rows(d: Array, P: Array) -> Array:
    """Return the NEES (N,) of errors d (N, n) with covariances P (N, n, n), as `write_nees`."""
    out = np.empty(len(d))
    for k in range(len(d)):
        write_nees(d[k : k + 1], P[k], 0, d.shape[1], out[k : k + 1])
    return out


def nees(d: Array, P: Array) -> Array:
    """Return d^T P^-1 d (...) for errors (..., n) and covariances (..., n, n); NaN where P is singular.

    Singular: a variance that is not positive, or tr C^-1 above 1e12, C being the correlation matrix.
    """
    P = np.array(P, dtype=np.float64, order="C")
    d = np.array(np.broadcast_to(d, P.shape[:-1]), dtype=np.float64, order="C")
    n = P.shape[-1]
    return nees_of_rows(d.reshape(-1, n), P.reshape(-1, n, n)).reshape(P.shape[:-2])


@compiled
def map_nees(d: Array, P: Array, first: Index, sizes: Index) -> Array:
    """Return the NEES of a map (6,), as `MAP_NEES` names them, of errors d (2, n) in own and in world coordinates.

    P (n or more, n or more) is the covariance of the joint state, in which landmarks have the rows from `first` (B,)
    on, `sizes` (B,) of them.
    """
    out, value, n = np.full(6, np.nan), np.empty(2), d.shape[1]
    sums, regular, dof = np.zeros(2), np.zeros(2), 0.0
    for i in range(len(first)):
        write_nees(d, P, first[i], sizes[i], value)
        dof += sizes[i] if np.isfinite(value[0]) else 0.0
        for c in range(2):
            if np.isfinite(value[c]):
                sums[c], regular[c] = sums[c] + value[c], regular[c] + 1.0
    out[0], out[1], out[2] = sums[0] / regular[0], sums[1] / regular[1], dof / regular[0]  # NaN of none
    write_nees(d, P, 0, n, value)
    out[3], out[4] = value[0], value[1]
    if np.isfinite(value[0]):
        out[5] = n
    return out


def nees_limit(d: Array, P: Array) -> float:
    """Return the limit of the mean NEES of errors d (N, n), covariances P (N, n, n), of a consistent run.

    They are worth N / (1 + 2 sum (1 - k / N) |C_k|^2 / n) independent ones, one at least: C_k (n, n) is the correlation
    of errors in their sigmas over k steps, up to the first of which the trace is not positive.  The mean is below
    in a share `CONSISTENT` of runs, and `nees_limit` never below what one value is in a share `ALONE`, because the
    correlation is that of this run, and changes along it.  NaN where every P is singular.
    """
    known = np.isfinite(nees(d, P))
    d, P = d[known], P[known]
    number, dof = d.shape
    if not number:
        return math.nan
    sigma = np.sqrt(np.einsum("kii->ki", P))
    L = np.linalg.cholesky(P / (sigma[:, :, None] * sigma[:, None, :]))
    f = np.fft.rfft(np.linalg.solve(L, (d / sigma)[..., None])[..., 0], 2 * number, axis=0)
    C = np.fft.irfft(f.conj()[:, :, None] * f[:, None, :], axis=0)[:number]
    trace = np.einsum("kii->k", C)
    first = int(np.argmax(trace <= 0.0)) if (trace <= 0.0).any() else number
    left, scale = 1.0 - np.arange(1, first) / number, max(float(trace[0]) / dof, TINY)
    squares = np.minimum(np.sum((C[1:first] / scale) ** 2, axis=(1, 2)) / left**2 / dof, dof)
    independent = max(number / (1.0 + 2.0 * float(left @ squares)), 1.0)
    return max(float(quantile(CONSISTENT, dof * independent)) / independent, float(quantile(ALONE, dof)))


def nis(z: Array, Z: Array) -> tuple[Array, Ints]:
    """Return z^T Z^-1 z (K,) and its degrees of freedom (K,) for innovations (K, m) padded with NaN."""
    dof = np.isfinite(z).sum(axis=1)
    value = np.full(len(z), np.nan)
    for m in np.unique(dof[dof > 0]):  # a sensor's rows come first, the padding after them
        rows = dof == m
        value[rows] = nees(z[rows, :m], Z[rows, :m, :m])
    return value, np.where(np.isfinite(value), dof, 0)


def associated_nis(history: History) -> tuple[Array, Ints, Ints]:
    """Return the NIS, its degrees of freedom and the step (K,) of each associated observation whose Z is regular."""
    used = history.outcome == "associated"
    value, dof = nis(history.z[used], history.Z[used])
    return value[dof > 0], dof[dof > 0], history.step[used][dof > 0]


def nis_of_groups(value: Array, dof: Ints, group: Ints) -> tuple[Ints, Array, Array]:
    """Return the groups (G,) with any NIS, their NIS per degree of freedom, and the bounds (G, 2) of 95 % of each.

    `value` (K,), `dof` (K,) and `group` (K,) are of observations.
    """
    total, dof = np.bincount(group, value), np.bincount(group, dof).astype(np.int64)
    groups = np.flatnonzero(dof)
    number, which = np.unique(dof[groups], return_inverse=True)
    bounds = np.array([anees_interval(n) for n in number.tolist()]).reshape(-1, 2)[which]
    return groups, total[groups] / dof[groups], bounds / dof[groups, None]


def truncated_variance(gate: float, dof: int) -> float:
    """Return the variance of whitened innovations of `dof` numbers of which a gate on d2 leaves out the rest.

    That of a Gaussian without what is farther than the gate: F(dof + 2) / F(dof), F of chi-square at the gate.
    """
    return float(chdtr(dof + 2, gate) / chdtr(dof, gate)) if np.isfinite(gate) else 1.0


def anees_interval(dof: float, runs: float = 1, probability: float = 0.95) -> tuple[float, float]:
    """Return the two-sided bounds of the mean of `runs` independent NEES values of `dof` degrees of freedom each."""
    tail = (1.0 - probability) / 2.0
    return float(quantile(tail, dof * runs)) / runs, float(quantile(1.0 - tail, dof * runs)) / runs


def has_diverged(own: Array, world: Array, P: Array, truth: Array) -> bool:
    """Return whether the position error ever exceeds 10 of its own sigmas and 5 % of the path.

    Errors (N, 2 or more) of true poses (N, 3 or 7) begin with those of the position: `own` in the estimator's
    coordinates, with covariances P (N, 2 or more, 2 or more), `world` in m.  Sigmas are counted as the Mahalanobis
    distance.
    """
    d = 2 if truth.shape[1] == 3 else 3
    far = np.sqrt(nees(own[:, :d], P[:, :d, :d])) > DIVERGED_SIGMAS
    return bool(np.any(far & (np.linalg.norm(world[:, :d], axis=1) > DIVERGED_PATH * path_m(truth[:, :d]))))
