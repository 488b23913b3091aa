"""The geometry of the batch problem, many rows at once and compiled: poses (n, 3) of the plane or (n, 7) of space.

Their errors are those of the map's blocks, (3,) and (6,): position and orientation of the world.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.compiled import compiled
from kalmark.geometry import frames, frames3d
from kalmark.geometry.angles import wrap
from kalmark.geometry.rotations import left_jacobian_inverse
from kalmark.geometry.spaces import POINT2, POINT3, SE2, SE3, Space, Table, retract
from kalmark.models.observe import linearize

Array = npt.NDArray[np.float64]
SPACES: dict[int, Space] = {3: SE2, 7: SE3}  # of poses, by their numbers
POINTS: dict[int, Space] = {2: POINT2, 3: POINT3}
ORIGIN = {3: np.zeros(3), 7: np.array([0.0, 0, 0, 0, 0, 0, 1])}


def plus(space: Space, x: Array, d: Array, turns: Array | None = None) -> Array:
    """Return rows x of a space moved by the errors d (k, dof); with `turns` (k, axes) along the exponential."""
    turns = np.zeros((len(x), 0)) if turns is None else turns
    return _plus(space.atoms, *(np.ascontiguousarray(a) for a in (x, d, turns)))


def looked(view: Any, r: Array, l: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return y - e (K, m) of points l (K, d) that poses r see, E_r (K, m, q) and E_l (K, m, d).  [S] (63)."""
    look = _looked if isinstance(view, tuple) else _looked.py_func  # type: ignore[attr-defined]
    return look(view, r, l, y)


@compiled
def _plus(atoms: Table, x: Array, d: Array, turns: Array) -> Array:
    moved = x.copy()
    for i in range(len(x)):
        retract(atoms, moved[i], d[i], turns[i])
    return moved


@compiled
def _looked(view: Any, r: Array, l: Array, y: Array) -> tuple[Array, Array, Array]:
    k, m = y.shape
    z, E_r, E_l = np.empty((k, m)), np.empty((k, m, 3 if r.shape[1] == 3 else 6)), np.empty((k, m, l.shape[1]))
    for i in range(k):
        _, z_i, R_i, L_i = linearize(view, r[i], l[i : i + 1], y[i : i + 1])
        z[i], E_r[i], E_l[i] = z_i[0], R_i[0], L_i[0]
    return z, E_r, E_l


@compiled
def beyond(a: Array, b: Array, step: Array) -> tuple[Array, Array, Array]:
    """Return what the poses b after a imply beyond the steps: w (n, q) in the frames a, W_a and W_b (n, q, q)."""
    n, size = a.shape
    q = 3 if size == 3 else 6
    w, W_a, W_b = np.empty((n, q)), np.empty((n, q, q)), np.empty((n, q, q))
    for i in range(n):
        if size == 3:
            back, B_a = frames.inverse(a[i])
            d, D_back, D_b = frames.compose(back, b[i])
            w[i] = d - step[i]
            w[i, 2] = wrap(w[i, 2])
            W_a[i], W_b[i] = D_back @ B_a, D_b
        else:
            back, B_a = frames3d.inverse(a[i])
            d, D_back, D_b = frames3d.compose(back, b[i])
            w[i] = frames3d.minus(d, step[i])
            W = np.eye(6)
            W[3:, 3:] = left_jacobian_inverse(w[i, 3:])
            W_a[i], W_b[i] = W @ D_back @ B_a, W @ D_b
    return w, W_a, W_b
