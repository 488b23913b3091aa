"""The corrections: textbook, invariant and first-estimates, each one function from innovation to corrected map.

The same source runs twice: compiled for the built-in models, as plain Python for a user's (`linearize` is the only
place that differs).  A map is its mean x, covariance P with n rows in use, and tables of `blocks` and `atoms`.  A scan
is the slot of its robot, the slots of K landmarks of which the first d numbers are seen, measurements y (K, m) with
noise R (K, m, m), which of them are `angular`, and the gate on d2.  Nothing is changed unless all of it succeeds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba.extending import register_jitable

from kalmark.compiled import compiled
from kalmark.filter.kernels import Index, cholesky_inverse, columns, downdate, submatrix, transport
from kalmark.geometry.angles import wrap
from kalmark.geometry.spaces import HEADING, VECTOR, VECTOR3, Table, generator, retract
from kalmark.models.observe import linearize

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Map = tuple[Array, Array, int, Table, Table]  # x, P, n, blocks, atoms
Scan = tuple[int, Index, int, Array, Array, Flags, float]  # robot, slots, d, y, R, angular, gate


@compiled
def pose_sizes(blocks: Table, atoms: Table, robot: int) -> tuple[int, int, int]:
    """Return the numbers of a robot's pose, its degrees of freedom, and the axes it turns about: its last rows."""
    return (3, 3, 1) if atoms[blocks[robot, 4] + 1, 0] == HEADING else (7, 6, 3)


@compiled
def observed_block(
    x: Array, blocks: Table, atoms: Table, robot: int, slots: Index, d: int
) -> tuple[Index, Table, Array]:
    """Return the rows in P, the atoms and the mean of the robot's pose and the first d numbers of K landmarks."""
    pose, _, _ = pose_sizes(blocks, atoms, robot)
    size = pose + d * len(slots)
    index, mean = np.empty(size, np.int64), np.empty(size)
    table = np.empty((size, 3), np.int64)
    count = x_to = p_to = 0
    for i in range(len(slots) + 1):
        slot, width = (robot, pose) if i == 0 else (slots[i - 1], d)
        x_at, p_at, first = blocks[slot, 0], blocks[slot, 2], blocks[slot, 4]
        mean[x_to : x_to + width] = x[x_at : x_at + width]
        rows = 0
        for a in range(first, first + blocks[slot, 5]):
            if atoms[a, 1] - x_at < width:
                kind = atoms[a, 0]
                table[count, 0] = kind
                table[count, 1], table[count, 2] = x_to + atoms[a, 1] - x_at, p_to + rows
                rows += 3 if kind >= VECTOR3 else (2 if kind == VECTOR else 1)
                count += 1
        for j in range(rows):
            index[p_to + j] = p_at + j
        x_to, p_to = x_to + width, p_to + rows
    return index[:p_to], table[:count], mean


@compiled
def residual(y: Array, e: Array, angular: Flags) -> Array:
    """Return z = y - e (K, m), the angles among them wrapped.  [S] (26)."""
    z = y - e
    for j in range(len(angular)):
        if angular[j]:
            for i in range(len(z)):
                z[i, j] = wrap(z[i, j])
    return z


@compiled
def innovation(P: Array, index: Index, E_r: Array, E_l: Array, R: Array, z: Array) -> tuple[Array, Array, bool]:
    """Return each observation's innovation covariance Z (K, m, m) and d2 = z' Z^-1 z (K,).  [S] (27), (83).

    d2 is NaN where nothing can be expected (a landmark at the sensor).  The last answer is False if a Z is not positive
    definite: the filter is broken.
    """
    k, m, d = E_l.shape
    pose = E_r.shape[2]
    Z, d2, healthy = np.empty((k, m, m)), np.empty(k), True
    rows, H = np.empty(pose + d, np.int64), np.empty((m, pose + d))
    rows[:pose] = index[:pose]
    for i in range(k):
        rows[pose:] = index[pose + i * d : pose + (i + 1) * d]
        H[:, :pose], H[:, pose:] = E_r[i], E_l[i]
        S = submatrix(P, rows)
        for a in range(m):
            for b in range(a + 1):
                s = R[i, a, b]
                for c in range(pose + d):
                    t = 0.0
                    for f in range(pose + d):
                        t += S[c, f] * H[b, f]
                    s += H[a, c] * t
                Z[i, a, b] = Z[i, b, a] = s
        M, positive = cholesky_inverse(Z[i])
        d2[i] = np.nan
        if positive:
            w = 0.0
            for a in range(m):
                s = 0.0
                for b in range(a + 1):
                    s += M[a, b] * z[i, b]
                w += s * s
            d2[i] = w
        elif np.isfinite(Z[i]).all():
            healthy = False
    return Z, d2, healthy


@compiled
def stacked(E_r: Array, E_l: Array) -> Array:
    """Return the Jacobian H (K m, pose + K d) of all observations of a scan with respect to the observed block."""
    k, m, d = E_l.shape
    pose = E_r.shape[2]
    H = np.zeros((k * m, pose + k * d))
    for i in range(k):
        H[i * m : (i + 1) * m, :pose] = E_r[i]
        H[i * m : (i + 1) * m, pose + i * d : pose + (i + 1) * d] = E_l[i]
    return H


@compiled
def add_blocks(S: Array, R: Array) -> None:
    """S += blockdiag(R), R (K, m, m)."""
    k, m, _ = R.shape
    for i in range(k):
        S[i * m : (i + 1) * m, i * m : (i + 1) * m] += R[i]


@register_jitable  # type: ignore[untyped-decorator]
def iterate(
    view: Any,
    sizes: tuple[int, int, int],
    table: Table,
    mean: Array,
    P_ss: Array,
    y: Array,
    R: Array,
    angular: Flags,
    most: int,
    tolerance: float,
) -> tuple[Array, Array, Array, bool]:
    """Relinearise on the observed block only: return H, M = L^-1 of its Z, and the innovation to fuse.

    The prior covariance P_ss is in the error coordinates of the prior mean; the Jacobian H_j at the iterate x_j is in
    those of x_j, so H_j is transported: H~_j = H_j (I + (generator(x_j) - generator(x)) e_theta').
    """
    pose, dof, axes = sizes
    k, d = len(y), (len(mean) - pose) // len(y)
    correction = np.zeros(len(P_ss))
    turned = generator(table, mean, len(P_ss), axes)
    x_j = mean
    for _ in range(most):
        e, E_r, E_l = linearize(view, x_j[:pose], x_j[pose:].reshape(k, d))
        H = stacked(E_r, E_l)
        H[:, dof - axes : dof] += H @ (generator(table, x_j, len(P_ss), axes) - turned)
        v = residual(y, e, angular).ravel() + H @ correction
        PH = P_ss @ H.T
        Z = H @ PH
        add_blocks(Z, R)
        M, positive = cholesky_inverse(Z)
        if not positive:
            break
        step = PH @ (M.T @ (M @ v))
        change = np.abs(step - correction).max()
        correction = step
        x_j = mean.copy()
        retract(table, x_j, correction, correction[dof - axes : dof])
        if change < tolerance:
            break
    return H, M, v, positive


@compiled
def fuse(P: Array, n: int, index: Index, H: Array, M: Array, v: Array) -> Array:
    """P <- P - W W' with W = P H' L^-T, M = L^-1; return the correction K v (n,) of the mean.  [S] (28)-(30)."""
    W = (columns(P, index, n) @ H.T) @ M.T
    d = W @ (M @ v)
    downdate(P, W)
    return d


def invariant(
    view: Any, map_: Map, scan: Scan, most: int
) -> tuple[Array, Array, Array, Array, Flags, bool]:  # fmt: skip
    """Correct with one scan: gate, iterate, fuse, retract, transport.  docs/invariant.md.

    Returns e, z, Z, d2 at the prediction, which were fused, and whether the filter can go on.
    """
    x, P, n, blocks, atoms = map_
    robot, slots, d, y, R, angular, gate = scan
    index, table, mean = observed_block(x, blocks, atoms, robot, slots, d)
    pose, dof, axes = pose_sizes(blocks, atoms, robot)
    e, E_r, E_l = linearize(view, mean[:pose], mean[pose:].reshape(len(slots), d))
    z = residual(y, e, angular)
    Z, d2, healthy = innovation(P, index, E_r, E_l, R, z)
    near = (d2 <= gate) & (d2 < np.inf)
    if not healthy or not near.any():
        return e, z, Z, d2, near, healthy
    if not near.all():
        y, R = y[near], R[near]
        index, table, mean = observed_block(x, blocks, atoms, robot, slots[near], d)
    H, M, v, positive = iterate(view, (pose, dof, axes), table, mean, submatrix(P, index), y, R, angular, most, 1e-7)
    if not positive:
        return e, z, Z, d2, near, False
    before = generator(atoms, x, n, axes)
    correction = fuse(P, n, index, H, M, v)
    theta = index[dof - axes]
    retract(atoms, x, correction, correction[theta : theta + axes].copy())
    transport(P, generator(atoms, x, n, axes) - before, theta)
    return e, z, Z, d2, near, True


def textbook(
    view: Any, map_: Map, scan: Scan, _: None
) -> tuple[Array, Array, Array, Array, Flags, bool]:  # fmt: skip
    """Correct with one landmark after the other, each at the state the last one left.  [S] (26)-(30), C.3."""
    x, P, n, blocks, atoms = map_
    robot, slots, d, y, R, angular, gate = scan
    k, m = y.shape
    e, z, Z, d2 = np.empty((k, m)), np.empty((k, m)), np.empty((k, m, m)), np.empty(k)
    near, healthy, pose = np.zeros(k, np.bool_), True, pose_sizes(blocks, atoms, robot)[0]
    for i in range(k):
        one = slice(i, i + 1)
        index, _table, mean = observed_block(x, blocks, atoms, robot, slots[one], d)
        e[one], E_r, E_l = linearize(view, mean[:pose], mean[pose:].reshape(1, d))
        z[one] = residual(y[one], e[one], angular)
        Z[one], d2[one], sound = innovation(P, index, E_r, E_l, R[one], z[one])
        healthy = healthy and sound
        near[i] = d2[i] < gate
        if near[i]:
            M, _positive = cholesky_inverse(Z[i])
            retract(atoms, x, fuse(P, n, index, stacked(E_r, E_l), M, z[i].copy()), np.zeros(0))
    return e, z, Z, d2, near, healthy


def first_estimates(
    view: Any, map_: Map, scan: Scan, x_first: Array
) -> tuple[Array, Array, Array, Array, Flags, bool]:  # fmt: skip
    """Correct with one scan, innovation at the estimate, Jacobians at the first estimates `x_first`."""
    x, P, n, blocks, atoms = map_
    robot, slots, d, y, R, angular, gate = scan
    k, pose = len(slots), pose_sizes(blocks, atoms, robot)[0]
    index, _, mean = observed_block(x, blocks, atoms, robot, slots, d)
    _, _, first = observed_block(x_first, blocks, atoms, robot, slots, d)
    e, _, _ = linearize(view, mean[:pose], mean[pose:].reshape(k, d))
    _, E_r, E_l = linearize(view, first[:pose], first[pose:].reshape(k, d))
    z = residual(y, e, angular)
    Z, d2, healthy = innovation(P, index, E_r, E_l, R, z)
    near = (d2 <= gate) & (d2 < np.inf)
    if not healthy or not near.any():
        return e, z, Z, d2, near, healthy
    index, _, _ = observed_block(x, blocks, atoms, robot, slots[near], d)
    H = stacked(E_r[near], E_l[near])
    Z_all = H @ (submatrix(P, index) @ H.T)
    add_blocks(Z_all, R[near])
    M, positive = cholesky_inverse(Z_all)
    if positive:
        retract(atoms, x, fuse(P, n, index, H, M, z[near].ravel()), np.zeros(0))
    return e, z, Z, d2, near, positive


compiled_invariant = compiled(invariant)
compiled_textbook = compiled(textbook)
compiled_first_estimates = compiled(first_estimates)
