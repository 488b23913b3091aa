"""The first map of one moving camera: inverse distances of its landmarks, from the first frames together.

While the camera has moved little, its images show products of motion and inverse distance.  Nearly the same images
result where it moves the other way and what is near is far (Koenderink and van Doorn 1991): a filter, which takes a
frame at a time and begins with landmarks at one distance, chooses one of the two by the noise of its first frames.  All
first frames together determine it better.  So they are fitted by least squares from two sides, by the essential matrix
of the last one (Nister 2004) and by the estimate of the filter, and from the reversed solution of the better one.

The sensor at t, turned by Exp(w), both in the frame of the first image, sees a landmark on the unit ray m at

    v = Exp(w)' (m - rho t),    v_w = Exp(w)' [m - rho t]x V(w),    v_t = -rho Exp(w)',    v_rho = -Exp(w)' t.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.events import Id, Scan
from kalmark.geometry.rotations import conjugate, exp, from_matrix, left_jacobian, log, matrix, multiply, skew
from kalmark.slam.sources import BufferedScans
from kalmark.vision import opencv as cv2

FIRST, LATER, LAST = 8, 1.4, 250  # frames: the first attempt, how much later the next one is, the last one
FRAMES, FEWEST = 8, 12  # that are fitted, spread over all; landmarks that must be left
PARALLAX_RAD = 0.035  # 2 deg, of half of the landmarks
SURE = 25.0  # by so many times the variance of a residual the reversed solution must fit worse
LEAST_RHO = 0.02  # of the median inverse distance: what is found to be farther begins there


class Reconstruction(NamedTuple):
    """Poses of F frames, w (F, 3) and t (F, 3), inverse distances rho (N,), and the sum of squares, px^2, robust."""

    w: Array
    t: Array
    rho: Array
    cost: float
    variance: float  # of a residual, by their median


@dataclass
class Beginning:
    """Window of a sensor's first frames, kept until they determine the distances of the first landmarks."""

    scans: list[tuple[Scan, list[Id]]] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)  # (7,) of the sensor, by the filter
    matched: list[dict[Id, Array]] = field(default_factory=list)
    next: int = FIRST
    over: bool = False

    def add(self, scan: Scan, removed: list[Id], fitted: dict[Id, Array], T: Array) -> None:
        """Add a frame: what was `fit_poses` of its scan, pixels (2,) by id, the sensor being at T (7,)."""
        self.scans.append((scan, removed))
        self.poses.append(T.copy())
        self.matched.append(fitted)

    def tried(self, sensor: Any, prior: float) -> BufferedScans | None:
        """Return the start of the map, once determined; the median of its inverse distances is the `prior`, 1/m."""
        k = len(self.scans) - 1
        if self.over or k < self.next:
            return None
        self.next = int(self.next * LATER) + 1
        left = [name for name in self.matched[0] if name in self.matched[-1]]
        if len(left) < FEWEST or k > LAST:
            self.end()
            return None
        some = np.unique(np.round(np.linspace(0, k, FRAMES + 1)).astype(np.int64))[1:].tolist()
        nowhere = np.full(2, np.nan)
        y = np.array([[self.matched[j].get(name, nowhere) for name in left] for j in some])
        rays = sensor.invert(np.array([self.matched[0][name] for name in left]))[0]
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        fit = self._sure(sensor, rays, y, some, prior)
        if fit is None:
            return None
        rho = np.maximum(fit.rho / np.median(fit.rho), LEAST_RHO) * prior
        begun = BufferedScans(self.scans, dict(zip(left, rho.tolist(), strict=True)))
        self.end()
        return begun

    def end(self) -> None:
        """Keep no more frames."""
        self.over, self.scans, self.poses, self.matched = True, [], [], []

    def _sure(self, sensor: Any, rays: Array, y: Array, some: list[int], prior: float) -> Reconstruction | None:
        """Return the fit to y (F, N, 2) if the landmarks are seen under some parallax and none other is as good."""
        first = self.poses[0]
        back = matrix(first[3:]).T
        w = np.array([log(multiply(conjugate(first[3:]), self.poses[j][3:])) for j in some])
        t = np.array([back @ (self.poses[j][:3] - first[:3]) for j in some])
        starts = [(w, t, np.full(len(rays), prior))]
        of_last = solve_essential_matrix(sensor, rays, y[-1], prior)
        if of_last is not None:
            share = np.array(some)[:, None] / some[-1]
            starts.append((of_last[0] * share, of_last[1] * share, of_last[2]))
        best = min((fit_poses(sensor, rays, y, *start, prior) for start in starts), key=lambda fit: fit.cost)
        middle = float(np.median(best.rho))
        parallax = float(np.median(np.abs(best.rho))) * float(np.linalg.norm(best.t[-1]))
        if parallax < PARALLAX_RAD or middle <= 0.0:
            return None
        reversed_rho = np.maximum(2.0 * middle - best.rho, LEAST_RHO * middle)
        other = fit_poses(sensor, rays, y, best.w, -best.t, reversed_rho, prior)
        if other.cost < best.cost:
            best, other = other, best
        same = float(np.corrcoef(best.rho, other.rho)[0, 1]) > 0.99
        return best if same or other.cost - best.cost > SURE * best.variance else None


def solve_essential_matrix(sensor: Any, rays: Array, y: Array, prior: float) -> tuple[Array, Array, Array] | None:
    """Return w (3,), t (3,), rho (N,) by the essential matrix of unit rays (N, 3) and pixels y (N, 2), or None."""
    seen = np.isfinite(y[:, 0])
    now = sensor.invert(y[seen])[0]
    a, b = rays[seen], now / now[:, 2:]
    if len(b) < FEWEST:
        return None
    flat = np.ascontiguousarray(a[:, :2] / a[:, 2:]), np.ascontiguousarray(b[:, :2])
    E, mask = cv2.findEssentialMat(*flat, np.eye(3), cv2.RANSAC, 0.999, 1.0 / sensor.fx_px)
    if E is None:
        return None
    _, Q, s, _ = cv2.recoverPose(E[:3], *flat, np.eye(3), mask=mask)
    t = -Q.T @ s[:, 0]
    m_b, t_b = np.cross(b, a @ Q.T), np.cross(b, Q @ t)
    found = (m_b * t_b).sum(axis=1) / np.maximum((t_b * t_b).sum(axis=1), 1e-12)
    middle = float(np.median(np.abs(found)))
    if not middle > 0.0:
        return None
    rho = np.full(len(rays), middle)
    rho[seen] = np.clip(found, 0.1 * middle, 5.0 * middle)
    return log(from_matrix(np.ascontiguousarray(Q.T))), t * middle / prior, rho * prior / middle


def fit_poses(sensor: Any, rays: Array, y: Array, w: Array, t: Array, rho: Array, prior: float) -> Reconstruction:
    """Fit poses w, t (F, 3) and rho (N,) to pixels y (F, N, 2), NaN where there is none, of unit rays (N, 3).

    Residuals of more than a pixel count less (Huber 1964); rho is kept about the prior +- the same.
    """
    from scipy.optimize import least_squares

    seen = np.isfinite(y[..., 0])
    frames = len(w)
    start = np.concatenate([w.ravel(), t.ravel(), rho])
    made = least_squares(
        lambda x: np.append(residuals(sensor, rays, y, seen, x)[0], x[6 * frames :] / prior - 1.0), start,
        lambda x: _with_prior(residuals(sensor, rays, y, seen, x)[1], frames, prior),
        loss="huber", ftol=1e-5, xtol=1e-5, max_nfev=40,
    )  # fmt: skip
    z = residuals(sensor, rays, y, seen, made.x)[0].reshape(-1, 2)
    middle = float(np.median(np.sum(z * z, axis=1))) / (2.0 * np.log(2.0))  # of a chi-square of 2
    w, t = made.x[: 6 * frames].reshape(2, frames, 3)
    return Reconstruction(w, t, made.x[6 * frames :], 2.0 * float(made.cost), max(middle, 1e-4))


def residuals(sensor: Any, rays: Array, y: Array, seen: Flags, x: Array) -> tuple[Array, Array]:
    """Return e - y of what was `seen` (F, N), (2 M,), at x = (w, t, rho), (6 F + N,), and its Jacobian.

    A point behind the camera counts as at the side.
    """
    count = len(y)
    w, t = x[: 6 * count].reshape(2, count, 3)
    f, n = np.nonzero(seen)
    u = rays[n] - x[6 * count + n, None] * t[f]
    turns = [exp(one) for one in w]
    back = np.array([matrix(q).T for q in turns])[f]
    v = np.einsum("kab,kb->ka", back, u)
    v[:, 2] = np.maximum(v[:, 2], 1e-3)
    e, E_v = sensor.expect(np.ascontiguousarray(v))
    E_u = E_v @ back
    E_w = E_u @ np.array([skew(one) for one in u]) @ np.array([left_jacobian(one) for one in w])[f]
    J, k = np.zeros((len(f), 2, len(x))), np.arange(len(f))
    for a in range(3):
        J[k, :, 3 * f + a] = E_w[:, :, a]
        J[k, :, 3 * (count + f) + a] = -x[6 * count + n, None] * E_u[:, :, a]
    J[k, :, 6 * count + n] = -np.einsum("kab,kb->ka", E_u, t[f])
    return (e - y[f, n]).ravel(), J.reshape(-1, len(x))


def _with_prior(J: Array, frames: int, prior: float) -> Array:
    """Return J with the rows of the prior of rho."""
    rows = np.zeros((J.shape[1] - 6 * frames, J.shape[1]))
    rows[:, 6 * frames :] = np.eye(len(rows)) / prior
    return np.concatenate([J, rows])
