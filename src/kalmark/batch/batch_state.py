"""The state of the batch problem, groups of blocks on spaces of the map, and its geometry, many rows at once, compiled.

Poses are (n, 3) in the plane or (n, 7) in space; their errors are position and orientation of the world.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.errors import KalmarkError
from kalmark.geometry import frames, frames3d
from kalmark.geometry.angles import wrap
from kalmark.geometry.rotations import left_jacobian_inverse
from kalmark.geometry.spaces import SE2, SE3, Space, Table, retract, retract_plane

Ints = Index

POSES, LANDMARKS, FIRST_MOUNT = range(3)  # the first two groups; from the third on each group is one mount
POSE_SPACES: dict[int, Space] = {3: SE2, 7: SE3}  # by their numbers


def unsolvable_problem(what: str) -> KalmarkError:
    """Return the error of a problem that cannot be stated or solved."""
    return KalmarkError(f"batch solution: {what}")


class BatchState(NamedTuple):
    """The values of all blocks: rows (k, size) of a space for each group; the first are poses, the second landmarks.

    A step of the whole state is one error for each row of each group, in this order.
    """

    spaces: tuple[Space, ...]
    groups: tuple[Array, ...]

    @property
    def d(self) -> int:
        """Numbers in a position: 2 in the plane, 3 in space."""
        return 2 if self.spaces[POSES] is SE2 else 3

    @property
    def ends(self) -> list[int]:
        """Ends of the errors of each group in a step; those of the poses come first."""
        sizes = [space.dof * len(rows) for space, rows in zip(self.spaces, self.groups, strict=True)]
        return [int(end) for end in np.cumsum(sizes)]

    def columns(self, group: int, row: Ints) -> Ints:
        """Return where (K,) in a step the errors of the rows `row` (K,) of a group begin."""
        return (self.ends[group - 1] if group else 0) + self.spaces[group].dof * row

    def parts(self, step: Array) -> list[Array]:
        """Return the errors (k, dof) of each group in a step."""
        split = np.split(step, self.ends[:-1])
        return [part.reshape(-1, space.dof) for space, part in zip(self.spaces, split, strict=True)]

    def moved(self, step: Array, followers: sp.csr_array) -> BatchState:
        """Return the state after a step along the exponential, x + V(dtheta) dx.

        A pose turns by its own dtheta, a landmark with the poses that see it, by the weights `followers` (m, n).
        """
        parts = self.parts(step)
        turns = [parts[POSES][:, self.d :], followers @ parts[POSES][:, self.d :]]
        turns += [np.zeros((1, 0))] * len(parts[FIRST_MOUNT:])
        return BatchState(self.spaces, tuple(map(plus, self.spaces, self.groups, parts, turns)))

    def relative(self, step: Array) -> float:
        """Return the largest rotation in a step (n,) (rad), or translation over half the map extent (at least 1 m)."""
        d, parts = self.d, self.parts(np.abs(step))
        places = np.concatenate([rows[:, :d] for rows in self.groups[:FIRST_MOUNT]])
        extent = max(1.0, 0.5 * float(np.ptp(places, axis=0).max()))
        return float(max(max(p[:, :d].max(initial=0.0) / extent, p[:, d:].max(initial=0.0)) for p in parts))


def plus(space: Space, x: Array, d: Array, turns: Array) -> Array:
    """Return rows x of a space moved by the errors d (k, dof), along the exponential for turns (k, axes) if any."""
    run = _plus if space.world == "space" else _plus_in_plane
    return run(space.atoms, *(np.ascontiguousarray(a) for a in (x, d, turns)))


@compiled
def _plus(atoms: Table, x: Array, d: Array, turns: Array) -> Array:
    moved = x.copy()
    for i in range(len(x)):
        retract(atoms, moved[i], d[i], turns[i])
    return moved


@compiled
def _plus_in_plane(atoms: Table, x: Array, d: Array, turns: Array) -> Array:
    moved = x.copy()
    for i in range(len(x)):
        retract_plane(atoms, moved[i], d[i], turns[i])
    return moved


def step_residuals(a: Array, b: Array, step: Array) -> tuple[Array, Array]:
    """Return what the poses b after a imply beyond the steps: w (n, q) in the frames a, W (n, q, 2 q) by a and b."""
    return (_step_residuals_in_plane if a.shape[1] == 3 else _step_residuals_in_space)(a, b, step)


@compiled
def _step_residuals_in_plane(a: Array, b: Array, step: Array) -> tuple[Array, Array]:
    n = len(a)
    w, W = np.empty((n, 3)), np.empty((n, 3, 6))
    for i in range(n):
        back, B_a = frames.inverse(a[i])
        d, D_back, D_b = frames.compose(back, b[i])
        for j in range(3):
            w[i, j] = d[j] - step[i, j]
            for c in range(3):
                W[i, j, c], W[i, j, 3 + c] = 0.0, D_b[j, c]
                for m in range(3):
                    W[i, j, c] += D_back[j, m] * B_a[m, c]
        w[i, 2] = wrap(w[i, 2])
    return w, W


@compiled
def _step_residuals_in_space(a: Array, b: Array, step: Array) -> tuple[Array, Array]:
    n = len(a)
    w, W = np.empty((n, 6)), np.empty((n, 6, 12))
    for i in range(n):
        back, B_a = frames3d.inverse(a[i])
        d, D_back, D_b = frames3d.compose(back, b[i])
        w[i] = frames3d.minus(d, step[i])
        W[i, :, :6], W[i, :, 6:] = D_back @ B_a, D_b
        W[i, 3:] = left_jacobian_inverse(w[i, 3:]) @ W[i, 3:].copy()
    return w, W
