"""The part of a map that a scan observes: a few rows, the Jacobian of the measurements by them, the expectation.

The head of the observed block is the observing robot's pose and, if it is in the map, the sensor's mount; the first
numbers of K landmarks follow.  An observation is of the head and of one landmark: of its rows of a Jacobian H, all else
is zero.
"""

from __future__ import annotations

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.compiled import compiled
from kalmark.filter import kernels
from kalmark.geometry.spaces import ERROR_SIZE, HEADING, Table

Linear = tuple[Array, Array, Array, Array]  # of all observations at once: innovation v (K p,), H, H P, Z


@compiled
def head_sizes(blocks: Table, atoms: Table, robot: int, mount: int) -> tuple[int, int]:
    """Return the numbers of a robot's pose, and those of the head: the pose and, if it is in the map, the mount.

    With the mount come the parameters that its sensor has in the map.
    """
    pose = 3 if atoms[blocks[robot, 4] + 1, 0] == HEADING else 7
    return pose, pose if mount < 0 else pose + blocks[mount, 1]


@compiled
def observed_block(
    x: Array, blocks: Table, atoms: Table, robot: int, mount: int, slots: Index, d: int
) -> tuple[Index, Table, Array]:
    """Return the rows in P, the atoms and the mean of the head and of the first d numbers of K landmarks."""
    pose, head = head_sizes(blocks, atoms, robot, mount)
    before = 1 if mount < 0 else 2  # blocks in the head
    size = head + d * len(slots)
    index, mean = np.empty(size, np.int64), np.empty(size)
    table = np.empty((size, 3), np.int64)
    count = x_to = p_to = 0
    for i in range(before + len(slots)):
        slot, width = (robot, pose) if i == 0 else ((mount, head - pose) if i < before else (slots[i - before], d))
        x_at, p_at, first = blocks[slot, 0], blocks[slot, 2], blocks[slot, 4]
        for j in range(width):
            mean[x_to + j] = x[x_at + j]
        rows = 0
        for a in range(first, first + blocks[slot, 5]):
            if atoms[a, 1] - x_at < width:
                table[count, 0] = atoms[a, 0]
                table[count, 1], table[count, 2] = x_to + atoms[a, 1] - x_at, p_to + rows
                rows += ERROR_SIZE[atoms[a, 0]]
                count += 1
        for j in range(rows):
            index[p_to + j] = p_at + j
        x_to, p_to = x_to + width, p_to + rows
    return index[:p_to], table[:count], mean


@compiled
def concatenate(E_r: Array, E_l: Array, H: Array) -> None:
    """Set H (p, h + d) to (E_r, E_l), element by element: numba compiles the check of a slice's shape for 2 s."""
    head = E_r.shape[1]
    for a in range(len(H)):
        for c in range(H.shape[1]):
            H[a, c] = E_r[a, c] if c < head else E_l[a, c - head]


@compiled
def innovation(P: Array, index: Index, E_r: Array, E_l: Array, R: Array, z: Array) -> tuple[Array, Array, bool]:
    """Return each observation's innovation covariance Z (K, p, p), its d2 (K,), and whether all Z are valid.

    [S] (27), (83); `squared_distances`.
    """
    k, p, d = E_l.shape
    head = E_r.shape[2]
    n = head + d
    Z, H, HP = np.empty((k, p, p)), np.empty((p, n)), np.empty((p, n))
    S = np.empty((n, n))
    kernels.copy_submatrix(P, index[:head], S)
    for i in range(k):
        concatenate(E_r[i], E_l[i], H)
        own = index[head + i * d] if d > 0 else 0
        for a in range(head, n):
            row = own + a - head
            for b in range(a + 1):
                column = index[b] if b < head else own + b - head
                S[a, b] = S[b, a] = P[max(row, column), min(row, column)]
        for a in range(p):
            for c in range(n):
                s = 0.0
                for j in range(n):
                    s += H[a, j] * S[j, c]
                HP[a, c] = s
        for a in range(p):
            for b in range(p):
                s = 0.0
                for c in range(n):
                    s += H[a, c] * HP[b, c]
                Z[i, a, b] = s + R[i, a, b]
            Z[i, a, a] *= 1.0 + kernels.RAISED
    d2, valid = squared_distances(Z, z)
    return Z, d2, valid


@compiled
def squared_distances(Z: Array, z: Array) -> tuple[Array, bool]:
    """Return d2 = z' Z^-1 z (K,) of innovations z (K, p) with their covariances Z (K, p, p).

    d2 is infinite where nothing can be expected (a landmark behind the camera), for what is seen there is beyond any
    gate.  It is NaN where Z is not positive definite.  The last answer is False if either is so of any.
    """
    k, p = z.shape
    d2, valid = np.zeros(k), True
    L, w = np.empty((p, p)), np.empty(p)
    for i in range(k):
        positive, expected = True, True
        for a in range(p):  # Z = L L', w = L^-1 z, row by row
            w[a] = z[i, a]
            expected = expected and not np.isnan(z[i, a])
            for b in range(a + 1):
                s = Z[i, a, b]
                for c in range(b):
                    s -= L[a, c] * L[b, c]
                if b < a:
                    L[a, b] = s / L[b, b]
                    w[a] -= L[a, b] * w[b]
                else:
                    positive = positive and s > 0.0
                    L[a, a] = np.sqrt(s) if s > 0.0 else 1.0
            w[a] /= L[a, a]
            d2[i] += w[a] * w[a]
        if not positive:
            d2[i], valid = np.nan if expected else np.inf, False
    return d2, valid


@compiled
def stack_jacobians(E_r: Array, E_l: Array, n: int) -> Array:
    """Return the Jacobian H (K p, n) of all observations of a scan with respect to the observed block of n rows.

    It is zero in rows between those of the head and those of the landmarks.
    """
    k, p, d = E_l.shape
    head = n - k * d
    H = np.zeros((k * p, n))
    for i in range(k):
        for a in range(p):
            for c in range(E_r.shape[2]):
                H[i * p + a, c] = E_r[i, a, c]
            for c in range(d):
                H[i * p + a, head + i * d + c] = E_l[i, a, c]
    return H


@compiled
def sparse_product(H: Array, S: Array, head: int, k: int) -> Array:
    """Return H S, H being zero but in the columns of the head and, for each of K observations, of its landmark."""
    p, n = len(H) // k, S.shape[1]
    d = (H.shape[1] - head) // k
    out, columns = np.zeros((len(H), n)), np.empty(head + d, np.int64)
    for r in range(len(H)):
        for i in range(head + d):
            columns[i] = i if i < head else r // p * d + i
        i = 0
        while i + 4 <= head + d:  # four rows of S at a time
            c_0, c_1, c_2, c_3 = columns[i], columns[i + 1], columns[i + 2], columns[i + 3]
            h_0, h_1, h_2, h_3 = H[r, c_0], H[r, c_1], H[r, c_2], H[r, c_3]
            for j in range(n):
                out[r, j] += h_0 * S[c_0, j] + h_1 * S[c_1, j] + h_2 * S[c_2, j] + h_3 * S[c_3, j]
            i += 4
        while i < head + d:
            c, h = columns[i], H[r, columns[i]]
            for j in range(n):
                out[r, j] += h * S[c, j]
            i += 1
    return out


@compiled
def add_blocks(S: Array, R: Array) -> None:
    """S += blockdiag(R), R (K, p, p), and raise its diagonal by what rounding may have taken off it."""
    k, p, _ = R.shape
    for i in range(k):
        for a in range(p):
            for b in range(p):
                S[i * p + a, i * p + b] += R[i, a, b]
            S[i * p + a, i * p + a] *= 1.0 + kernels.RAISED


@compiled
def observation_of(z: Array, E_r: Array, E_l: Array, P_ss: Array, R: Array) -> Linear:
    """Return a scan whose innovations are z (K, p), Jacobians E_r and E_l and noise R (K, p, p) as one observation.

    P_ss is the covariance of the observed block.
    """
    k, _p, d = E_l.shape
    H = stack_jacobians(E_r, E_l, len(P_ss))
    HP, Z = joint_innovation(H, P_ss, R, len(P_ss) - k * d)
    return z.ravel(), H, HP, Z


@compiled
def joint_innovation(H: Array, P_ss: Array, R: Array, head: int) -> tuple[Array, Array]:
    """Return H P and Z = H P H' + blockdiag(R) of all observations, R (K, p, p)."""
    HP = sparse_product(H, P_ss, head, len(R))
    Z = sparse_product(H, np.ascontiguousarray(HP.T), head, len(R))
    add_blocks(Z, R)
    return HP, Z


@compiled
def within_gate(d2: Array, gate: float) -> tuple[Flags, int]:
    """Return which squared distances (K,) are finite and within the gate, and how many."""
    near, count = np.zeros(len(d2), np.bool_), 0
    for i in range(len(d2)):
        if d2[i] <= gate and d2[i] < np.inf:
            near[i] = True
            count += 1
    return near, count


@compiled
def transport_rows(H: Array, v: Array, a: Array, theta: Index, correction: Array) -> None:
    """Transport the rows of H from an iterate to the mean, H <- H (I + a e_theta'), then v += H correction."""
    n, k = a.shape
    added = np.empty(k)
    for r in range(len(H)):
        for i in range(k):
            added[i] = 0.0
            for c in range(n):
                added[i] += H[r, c] * a[c, i]
        for i in range(k):
            H[r, theta[i]] += added[i]
        for c in range(n):
            v[r] += H[r, c] * correction[c]


@compiled
def diagonal_blocks(Z: Array, p: int) -> Array:
    """Return the blocks (K, p, p) on the diagonal of Z (K p, K p)."""
    blocks = np.empty((len(Z) // p, p, p))
    for i in range(len(blocks)):
        own = slice(i * p, (i + 1) * p)
        blocks[i] = Z[own, own]
    return blocks


@compiled
def least_squares(HP: Array, H: Array, M: Array, v: Array) -> tuple[Array, Array]:
    """Return the step P H' Z^-1 v and H' Z^-1 v (n,) for H (m, n), HP = H P and M = L^-1, L L' = Z."""
    m, n = HP.shape
    u, step, weights = np.zeros(m), np.zeros(n), np.zeros(n)
    for i in range(m):
        w = 0.0
        for j in range(i + 1):
            w += M[i, j] * v[j]
        for j in range(i + 1):
            u[j] += M[i, j] * w
    for i in range(m):
        for j in range(n):
            step[j] += u[i] * HP[i, j]
            weights[j] += u[i] * H[i, j]
    return step, weights


@compiled
def cost_of(z: Array, R: Array, step: Array, weights: Array) -> float:
    """Return the cost z' R^-1 z + d' P^-1 d of innovations z (K, p) after a step d = P w (n,) from the prior mean.

    It is infinite where nothing can be expected of an observation, NaN where its noise R (K, p, p) is singular.
    """
    cost = squared_distances(R, z)[0].sum()
    for i in range(len(step)):
        cost += step[i] * weights[i]
    return cost


@compiled
def has_settled(table: Table, now: Array, before: Array, P: Array, tolerance: float) -> bool:
    """Return whether each atom of a mean moves by less than that many of its sigmas between two corrections.

    However the world is turned.
    """
    for i in range(len(table)):
        size, variance = 0.0, 0.0
        for j in range(table[i, 2], table[i, 2] + ERROR_SIZE[table[i, 0]]):
            size += (now[j] - before[j]) ** 2
            variance += P[j, j]
        if size > tolerance**2 * variance:
            return False
    return True
