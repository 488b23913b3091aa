"""The path of a rig of cameras and the tags that explain all their corners best: bundle adjustment, without motion.

A sighting is y = e(v), v = (r o s)^-1 o l: rig pose r at its time, mount s, tag l.  `adjust` minimises the squared
distances in pixels over all r, l and, if asked, s, by Levenberg's method.  One pose or one tag is held, for the whole
may be moved anywhere, and one pose of each part that shares no tag with the others (`parts`).  Given tags and mounts
the poses are independent: the normal equations reduce to tags and mounts, and an iteration takes O(sightings) and
O(tags^3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy.linalg as la
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from threadpoolctl import threadpool_limits

from kalmark.errors import KalmarkError
from kalmark.geometry.frames3d import compose, plus
from kalmark.models.tags import project_corners, tag_seen_from
from kalmark.results.batch_factors import block_matrix
from kalmark.results.batch_linear import FLAT
from kalmark.results.corners import rms_of_corners

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Sightings:
    """K tags seen by cameras: `pose`, `camera`, `tag` (K,) say whose, `y` (K, 8) are corners in pixels, `size` (K,) m.

    `lenses` has a code and parameters (see `kalmark.models.lenses`) for each camera.
    """

    pose: Ints
    camera: Ints
    tag: Ints
    y: Array
    size: Array
    lenses: Sequence[tuple[int, Array]]


@dataclass(frozen=True, eq=False)
class Tags:
    """Where everything is: rig poses (n, 7), tags (m, 7), mounts (c, 7); and what is left of the corners, px (K, 8).

    `covariances` (m, 6, 6) are those of the tags, zero for one that is held; `iterations` is 0 if nothing was adjusted.
    """

    poses: Array
    tags: Array
    mounts: Array
    residuals: Array
    covariances: Array
    iterations: int = 0

    @property
    def errors_px(self) -> Array:
        """The distance (K, 4) of every corner from where it is expected."""
        return np.hypot(self.residuals[:, ::2], self.residuals[:, 1::2])

    @property
    def rms_px(self) -> float:
        """The root of the mean squared distance of the corners."""
        return float(np.sqrt(np.mean(self.errors_px**2)))


def adjust(
    seen: Sightings,
    poses: Array,
    tags: Array,
    mounts: Array,
    *,
    hold_pose: int | Sequence[int] | None = 0,
    hold_tag: int | None = None,
    free_mounts: Sequence[int] = (),
    sigma_px: float = 1.0,
    huber_px: float = np.inf,
    iterations: int = 100,
    tolerance: float = 1e-9,
) -> Tags:
    """Move poses, tags and the mounts `free_mounts` to where the sum of squared pixels is least.

    Sightings that are off by more than `huber_px` (RMS of the corners) count less, by Huber's function.  Covariances
    are for independent pixels of `sigma_px`.  Raises KalmarkError if the start does not show a tag that was seen, if
    something is not determined, or unless steps fall below `tolerance` m and rad.
    """
    n, m, c = len(poses), len(tags), len(mounts)
    free = np.repeat([True, False], [n + m, c])
    free[n + m + np.array(free_mounts, dtype=np.int64)] = True
    for held, first in ((hold_pose, 0), (hold_tag, n)):
        if held is not None:
            free[first + np.array(held)] = False
    at, E = look(seen, poses, tags, mounts)
    hidden = np.flatnonzero(np.isnan(at.residuals).any(axis=1))
    if len(hidden):
        pose, camera, tag = (int(each[hidden[0]]) for each in (seen.pose, seen.camera, seen.tag))
        raise KalmarkError(f"tags: the start does not show tag {tag} to camera {camera} at pose {pose}, which saw it")
    damping, size = 1e-4, np.inf
    with threadpool_limits(1):
        for iteration in range(1, iterations + 1):
            step, _ = _step(seen, at, E, free, huber_px, damping)
            new, E_new = look(seen, *_moved(at, step))
            size, lower = float(np.abs(step).max()), _cost(new, huber_px) < _cost(at, huber_px)  # NaN is not lower
            damping = 0.1 * damping if lower else max(10 * damping, 1e-9)
            at, E = (new, E_new) if lower else (at, E)
            if size < (tolerance if lower else 1e3 * tolerance):  # the cost cannot tell the smallest steps any more
                P = sigma_px**2 * _step(seen, at, E, free, huber_px, 0.0)[1][:m, :, :m]
                return replace(at, covariances=P[np.arange(m), :, np.arange(m)], iterations=iteration)
    raise KalmarkError(f"tags: the last of {iterations} steps is {size:.3g} m or rad, expected {tolerance:g}")


def look(seen: Sightings, poses: Array, tags: Array, mounts: Array) -> tuple[Tags, Array]:
    """Return a state with its residuals y - e, and the Jacobians E (3, K, 8, 6) of e in poses, tags and mounts."""
    k = len(seen.y)
    v, V = np.empty((k, 7)), np.empty((3, k, 6, 6))
    e, E = np.empty((k, 8)), np.empty((3, k, 8, 6))
    order = np.lexsort((seen.pose, seen.camera))
    ends = np.flatnonzero(np.diff(seen.pose[order]) | np.diff(seen.camera[order])) + 1
    for rows in np.split(order, ends):
        r, s = seen.pose[rows[0]], seen.camera[rows[0]]
        T, T_r, T_s = compose(poses[r], mounts[s])
        v[rows], V_T, V[1, rows] = tag_seen_from(T, tags[seen.tag[rows]])
        V[0, rows], V[2, rows] = V_T @ T_r, V_T @ T_s
    for camera, (lens, par) in enumerate(seen.lenses):
        rows = np.flatnonzero(seen.camera == camera)
        e[rows], E_v = project_corners(lens, v[rows], seen.size[rows], par)
        E[:, rows] = E_v @ V[:, rows]
    return Tags(poses, tags, mounts, seen.y - e, np.zeros((len(tags), 6, 6))), E


def parts(seen: Sightings) -> Ints:
    """Return the first pose of each part of the sightings that no tag connects with the others."""
    n, m = int(seen.pose.max()) + 1, int(seen.tag.max()) + 1
    links = coo_array((np.ones(len(seen.y)), (seen.pose, n + seen.tag)), shape=(n + m, n + m))
    _, part = connected_components(links, directed=False)
    first: Ints = np.unique(part[:n], return_index=True)[1]
    return first


def together(seen: Sightings) -> list[int]:
    """Return the cameras that saw a tag at the same pose as another: the mounts of others move with their poses."""
    pairs = np.unique(np.stack([seen.pose, seen.camera], axis=1), axis=0)
    shared = np.bincount(pairs[:, 0])[pairs[:, 0]] > 1
    return [int(k) for k in np.unique(pairs[shared, 1])]


def _step(
    seen: Sightings, at: Tags, E: Array, free: npt.NDArray[np.bool_], huber_px: float, damping: float
) -> tuple[Array, Array]:
    """Return the step (n + m + c, 6) and the covariance (m + c, 6, m + c, 6) of tags and mounts for pixels of 1 px.

    Solves (A + damping diag A) dx = E' W z, A = E' W E, by elimination of the poses, whose part of A is block diagonal.
    """
    k, n, behind = len(seen.y), len(at.poses), len(at.tags) + len(at.mounts)
    root = np.sqrt(np.minimum(1.0, huber_px / np.maximum(rms_of_corners(at.residuals), 1e-300)))
    index: Ints = np.stack([seen.pose, n + seen.tag, n + len(at.tags) + seen.camera])
    E, z = E * (root * free[index])[:, :, None, None], root[:, None] * at.residuals
    g, D = np.zeros((n + behind, 6)), np.zeros((n, 6, 6))
    np.add.at(g, index, np.einsum("bkij,ki->bkj", E, z))
    np.add.at(D, seen.pose, E[0].swapaxes(1, 2) @ E[0])
    row, diagonal = 8 * np.arange(k), np.arange(6)
    J_r = block_matrix([(row, 6 * index[0], E[0])], (8 * k, 6 * n))
    J_b = block_matrix([(row, 6 * (index[b] - n), E[b]) for b in (1, 2)], (8 * k, 6 * behind))
    A, B = (J_b.T @ J_b).toarray(), J_r.T @ J_b
    D[:, diagonal, diagonal] += _lifted(D[:, diagonal, diagonal], damping)
    A[np.diag_indices_from(A)] += _lifted(A.diagonal(), damping)
    try:
        poses: Ints = 6 * np.arange(n)
        D_inverse = np.asarray(np.linalg.inv(D), dtype=np.float64)
        inverse = block_matrix([(poses, poses, D_inverse)], (6 * n, 6 * n))
        L = la.cho_factor(A - (B.T @ inverse @ B).toarray(), lower=True)
        determined = (L[0].diagonal() ** 2 > FLAT * A.diagonal()).all()
    except la.LinAlgError:
        determined = False
    if not determined:
        raise KalmarkError("tags: the sightings do not determine all poses and tags, expected more of them")
    g_r, g_b = g[:n].ravel(), g[n:].ravel()
    dx_b = la.cho_solve(L, g_b - B.T @ (inverse @ g_r))
    dx_r = inverse @ (g_r - B @ dx_b)
    P = la.cho_solve(L, np.eye(6 * behind)).reshape(behind, 6, behind, 6)
    P[~free[n:]], P[:, :, ~free[n:]] = 0.0, 0.0
    return np.concatenate([dx_r, dx_b]).reshape(-1, 6), P


def _moved(at: Tags, step: Array) -> list[Array]:
    """Return poses, tags and mounts after a step."""
    ends = np.cumsum([len(at.poses), len(at.tags)])
    rows = zip(np.concatenate([at.poses, at.tags, at.mounts]), step, strict=True)
    return np.split(np.array([plus(x, d) for x, d in rows]), ends)


def _lifted(diagonal: Array, damping: float) -> Array:
    """Return what to add to a diagonal: its damping, and 1 where nothing moves."""
    return damping * diagonal + (diagonal == 0.0)


def _cost(at: Tags, huber_px: float) -> float:
    """Return the sum over the corners of the squared distances, of Huber's function beyond `huber_px`."""
    rms = rms_of_corners(at.residuals)
    if not rms.max(initial=0.0) > huber_px:
        return float(4 * rms @ rms)
    inside = np.minimum(rms, huber_px)
    return float(4 * inside @ (2 * rms - inside))
