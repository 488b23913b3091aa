"""The prediction: a robot moves by one part of its control.  R <- f(R, u), P <- F P F' + Q.  [S] (14)-(17).

The same source runs twice, as in `corrections`: compiled for the built-in motions, as plain Python for a user's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.filter import kernels
from kalmark.filter.corrections import call_generator
from kalmark.geometry.frames import product
from kalmark.geometry.pose_frames import body_axes
from kalmark.geometry.spaces import HOMOGENEOUS, KIND, P_AT, Table
from kalmark.models.observe import step

Map = tuple[Array, Array, Array, int, Table, Table, int]  # x, x_first, P, n, blocks, atoms, the generator's address
Motion = tuple[Any, int, Index, bool, bool, Array, Array, Array, Array, float]  # as `estimators.Movement`


@compiled
def noise_in_world(state: Array, D: Array) -> Array:
    """Return a noise D (k, k) of the robot's frame in the world's: in the plane (3 or more), in space (6 or more)."""
    return kernels.quadratic(body_axes(state, len(D)), D)


@compiled
def append_constants(
    F: Array, R_a: Array, R_u: Array, N: Array, Q: Array, shared: bool, begins: bool
) -> tuple[Array, Array]:
    """Return F and Q (n + c, .) of a robot and the constants that change its control, R_a (n, c) by these.

    With a `shared` error the control's noise is that of the first of them, which `begins` or goes on.
    """
    (n, c), m = R_a.shape, len(N) if begins else 0
    if c == 0:
        return F, Q
    size = n + c
    F_all, Q_all = np.eye(size), np.zeros((size, size))
    for i in range(n):
        for j in range(n):
            F_all[i, j] = F[i, j]
            if begins or not shared:
                Q_all[i, j] = Q[i, j]
        for j in range(m, c):
            F_all[i, n + j] = R_a[i, j]
    R_N = product(R_u, N)
    for j in range(m):
        F_all[n + j, n + j] = 0.0
        for i in range(n):
            Q_all[i, n + j] = Q_all[n + j, i] = R_N[i, j]
        for i in range(m):
            Q_all[n + i, n + j] = N[i, j]
    return F_all, Q_all


@compiled
def transport_jacobian(F: Array, now: Array, then: Array, at: int) -> Array:
    """Return F (I + (now - then) e_theta'), the rows `at` and following of two generators (n, axes)."""
    axes, out = now.shape[1], F.copy()
    theta = 2 if axes == 1 else 3
    for i in range(len(F)):
        for a in range(axes):
            for j in range(len(F)):
                out[i, theta + a] += F[i, j] * (now[at + j, a] - then[at + j, a])
    return out


@compiled
def spread_rays(P: Array, atoms: Table, Q: Array) -> None:
    """Add Cov(rho_i, rho_j) Q_p to the covariance of h_i and h_j, of all homogeneous points (h, rho).

    Q is that of a motion's noise n, Q_p that of its position.  It moves the rays h - rho p by -rho n, and the mean of
    rho_i n n' rho_j is (rho_i rho_j + Cov(rho_i, rho_j)) Q_p: F and Q have its first term.  docs/bearing_only.md.
    """
    places = np.empty(len(atoms), np.int64)
    count = 0
    for i in range(len(atoms)):
        if atoms[i, KIND] == HOMOGENEOUS:
            places[count] = atoms[i, P_AT]
            count += 1
    for i in range(count):
        for j in range(count):
            k, l = places[i], places[j]
            if l <= k:
                c = P[k + 3, l + 3]
                for a in range(3):
                    for b in range(a + 1 if l == k else 3):
                        P[k + a, l + b] += c * Q[a, b]


@compiled
def predict(map_: Map, motion: Motion, from_first: bool, spreads: bool) -> bool:
    """Move a robot in a map; return whether all of it is finite: if not, nothing has changed.

    `from_first`: displacements count from the first estimates, F (I + (generator(x) - generator(x_first)) e_theta').
    `spreads`: with the mean square of what the noise does to homogeneous points, `spread_rays`.
    """
    x, x_first, P, n, blocks, atoms, turns = map_
    model, robot, added, shared, begins, B, u, N, D, dt_s = motion
    at, size, p_at, dof = blocks[robot, 0], blocks[robot, 1], blocks[robot, 2], blocks[robot, 3]
    index, total, c = np.empty(dof + B.shape[1], np.int64), u.copy(), 0
    for i in range(dof):
        index[i] = p_at + i
    for b in range(len(added)):
        for j in range(blocks[added[b], 1]):
            index[dof + c] = blocks[added[b], 2] + j
            for i in range(len(u)):
                total[i] += B[i, c] * x[blocks[added[b], 0] + j] if b > 0 or not begins else 0.0
            c += 1
    r = x[at : at + size].copy()
    moved, F, R_u = step(model, r, total, dt_s)  # [S] (14)
    if from_first:
        axes, origin = 1 if size < 7 else 3, np.zeros(3)
        now = call_generator(turns, (atoms, x, n, axes, origin))
        then = call_generator(turns, (atoms, x_first, n, axes, origin))
        F = transport_jacobian(F, now, then, p_at)
    Q, valid = kernels.moved_noise(moved, F, R_u, N)  # the last term of [S] (15)
    if not valid:
        return False
    F, Q = append_constants(F, product(R_u, B), R_u, N, Q, shared, begins)
    if len(D):
        Q_D = noise_in_world(moved, D)
        for i in range(len(D)):
            for j in range(len(D)):
                Q[i, j] += Q_D[i, j]
    kernels.predict(P, n, index, F, Q)  # [S] (15)-(17)
    if spreads:
        spread_rays(P, atoms, Q)
    x[at : at + size] = x_first[at : at + size] = moved
    if begins:
        first = blocks[added[0], 0]
        x[first : first + len(u)] = x_first[first : first + len(u)] = 0.0
    return True
