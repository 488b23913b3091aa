"""What may become a landmark: measurements from kept poses, and the point that explains them best.  See `delayed`.

The point is a function of the poses, which are blocks of the map, so that its covariance with everything follows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.events import Id
from kalmark.geometry.frames import compose
from kalmark.models.observe import linearize

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam
    from kalmark.tracks.scene import View

Array = npt.NDArray[np.float64]


@dataclass
class Sight:
    """A measurement y (m,) with its noise R (m, m): the k-th one made at the kept pose number `at`."""

    at: int
    k: int
    y: Array
    R: Array


@dataclass
class Candidate:
    """Measurements that may be of one landmark; if several, its Gaussian in the frame of the sensor of the first.

    `missed` counts the kept poses in a row from which it was not seen, though in view.
    """

    name: Id | None
    sights: list[Sight]
    mean: Array | None = None
    cov: Array | None = None
    missed: int = 0


@dataclass
class Waiting:
    """What waits to become a landmark of one sensor: kept poses (number to slot of the map) and candidates."""

    poses: dict[int, int] = field(default_factory=dict)
    candidates: list[Candidate] = field(default_factory=list)
    numbered: int = 0


class Solution(NamedTuple):
    """A point p (2,) with covariance G P G' + Q, P the `rows` of the map's; how well it fits, and how surely.

    `vagueness` is its sigma by its distance, seen from the last pose, without that measurement that would be missed
    most: two landmarks seen in one direction for a while, and once something else across, are none.
    """

    p: Array
    G: Array
    Q: Array
    rows: npt.NDArray[np.int64]
    chi2: float
    dof: int
    vagueness: float


def solved(slam: Slam, view: View, c: Candidate) -> Solution:
    """Return the point that fits all measurements of a candidate best.

    Least squares weighted by S = H P H' + R, P of the poses: with W = (E' S^-1 E)^-1 E' S^-1 the point errs by
    -W (H d + v), d the error of the poses and v that of the measurements, so that G = -W H and Q = W R W'.
    """
    map_, slots, n, m = slam.map, _slots(view, c), len(c.sights), len(c.sights[0].y)
    P, index = map_.covariance(slots), np.concatenate([map_.index(slot) for slot in slots])
    R = np.zeros((n * m, n * m))
    for i, sight in enumerate(c.sights):
        R[i * m : (i + 1) * m, i * m : (i + 1) * m] = sight.R
    p = _in_the_world(slam, view, c)
    for _ in range(10):
        z, E, H = linearized(slam, view, c, p, len(P))
        W = _weights(E, H @ P @ H.T + R)
        step = W @ z
        p = p + step
        if not np.linalg.norm(step) >= 1e-9 * (1 + np.linalg.norm(p)):
            break
    z = z - E @ step
    chi2 = float(z @ np.linalg.solve(H @ P @ H.T + R, z)) if np.isfinite(z).all() else math.inf
    if not math.isfinite(chi2):
        return Solution(p, -W @ H, W @ R @ W.T, index, math.inf, n * m - 2, math.inf)
    last = view.pose(map_, slots[n - 1])
    v, V_T, V_p = (a[0] for a in view.landmark.seen_from(last, p[None]))
    V_P = np.zeros((2, len(P)))
    V_P[:, 3 * (n - 1) : 3 * n] = V_T @ compose(map_.mean(slots[n - 1]), mount_of(slam, view))[1]
    worst = 0.0
    for i in range(n):
        keep = np.repeat(np.arange(n) != i, m)
        W_i = _weights(E[keep], (H @ P @ H.T + R)[np.ix_(keep, keep)])
        J = V_P - V_p @ W_i @ H[keep]
        cov = J @ P @ J.T + V_p @ W_i @ R[np.ix_(keep, keep)] @ W_i.T @ V_p.T
        worst = max(worst, float(np.linalg.norm(cov, 2)) if np.isfinite(cov).all() else math.inf)
    return Solution(p, -W @ H, W @ R @ W.T, index, chi2, n * m - 2, math.sqrt(worst) / float(np.linalg.norm(v)))


def linearized(slam: Slam, view: View, c: Candidate, p: Array, size: int) -> tuple[Array, Array, Array]:
    """Return the innovations z (n m,) of a point p and their Jacobians E (n m, 2) in it and H (n m, size) in poses."""
    look, n, m = view.looks[view.landmark.kind], len(c.sights), len(c.sights[0].y)
    z, E, H = np.empty(n * m), np.empty((n * m, 2)), np.zeros((n * m, size))
    for i, sight in enumerate(c.sights):
        rows, pose = slice(i * m, (i + 1) * m), view.waiting.poses[sight.at]
        _, z_i, E_h, E_l = linearize(look.view, view.head(slam.map, pose), p[None], sight.y[None])
        E_i = slam.estimator.pose_jacobian(slam.map, pose, E_h[0])
        z[rows], E[rows], H[rows, 3 * i : 3 * i + 3] = z_i[0], E_l[0], E_i[:, :3]
        H[rows, 3 * n :] = E_i[:, 3:]
    return z, E, H


def _weights(E: Array, S: Array) -> Array:
    """Return W = (E' S^-1 E)^-1 E' S^-1, NaN where there is none: where the measurements do not meet."""
    try:
        S_E = np.linalg.solve(S, E)
        return np.linalg.solve(E.T @ S_E, S_E.T)
    except np.linalg.LinAlgError:
        return np.full(E.T.shape, np.nan)


def _slots(view: View, c: Candidate) -> list[int]:
    """Return the slots that a candidate's measurements depend on: the poses and, if it is in the map, the mount."""
    slots = [view.waiting.poses[sight.at] for sight in c.sights]
    return slots if view.mount < 0 else [*slots, view.mount]


def _in_the_world(slam: Slam, view: View, c: Candidate) -> Array:
    """Return the mean of a candidate in the map's frame."""
    assert c.mean is not None
    first = view.waiting.poses[c.sights[0].at]
    p: Array = view.landmark.from_view(view.pose(slam.map, first), c.mean[None])[0][0]
    return p


def mount_of(slam: Slam, view: View) -> Array:
    """Return where the sensor sits on its robot, as far as is known."""
    return view.at if view.mount < 0 else slam.map.mean(view.mount)[:3]
