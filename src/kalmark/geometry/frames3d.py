"""Frames of space, F = (x, y, z, qx, qy, qz, qw), with Jacobians in minimal error coordinates.

A frame's error is (position, rotation vector), both in the frame that F is given in: p = p_hat + d_p,
Q = Exp(d_theta) Q_hat.  Value first, then Jacobians in argument order, as in `frames`; frames are (7,) and their errors
(6,), points (3,) or K at once, (K, 3).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.geometry import rotations
from kalmark.geometry.frames import one_or_many

__all__ = [
    "compose", "from_euler_pose", "from_frame", "from_frame_many", "inverse", "minus", "move", "plus", "to_euler_pose",
    "to_frame", "to_frame_many", "turned_rates",
]  # fmt: skip


@compiled
def plus(a: Array, d: Array) -> Array:
    """Return the frame a moved by the error d (6,): p + d_p, Exp(d_theta) Q.

    >>> a = np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    >>> km.geometry.frames3d.plus(a, np.array([1.0, 0.0, 0.0, 0.0, 0.0, np.pi])).round(3)
    array([2., 2., 0., 0., 0., 1., 0.])
    """
    b = np.empty(7)
    b[:3] = a[:3] + d[:3]
    b[3:] = rotations.multiply(rotations.exp(d[3:]), a[3:])
    return b


@compiled
def minus(b: Array, a: Array) -> Array:
    """Return the error d (6,) with a plus d = b, its rotation at most pi.

    >>> a = np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    >>> km.geometry.frames3d.minus(a, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.6, 0.8])).round(3)
    array([ 1.   ,  2.   ,  0.   ,  0.   ,  0.   , -1.287])
    """
    d = np.empty(6)
    d[:3] = b[:3] - a[:3]
    d[3:] = rotations.log(rotations.multiply(b[3:], rotations.conjugate(a[3:])))
    return d


@compiled
def compose(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Return c = a o b (frame b given in frame a), C_a (6, 6) and C_b (6, 6).  [S] (55) in space.

    >>> a = np.array([1.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    >>> c, C_a, C_b = km.geometry.frames3d.compose(a, a)
    >>> c.round(3)
    array([ 0.,  0.,  0.,  0.,  0.,  0., -1.])
    """
    Q, q = rotations.matrix(a[3:]), rotations.multiply(a[3:], b[3:])
    c, C_a, C_b = np.empty(7), np.eye(6), np.zeros((6, 6))
    for i in range(3):
        p = Q[i, 0] * b[0] + Q[i, 1] * b[1] + Q[i, 2] * b[2]
        c[i] = a[i] + p
        j, k = (i + 1) % 3, (i + 2) % 3
        C_a[j, 3 + k], C_a[k, 3 + j] = p, -p  # -[p]x
        for n in range(3):
            C_b[i, n] = C_b[3 + i, 3 + n] = Q[i, n]
    for i in range(4):
        c[3 + i] = q[i]
    return c, C_a, C_b


@compiled
def inverse(a: Array) -> tuple[Array, Array]:
    """Return the inverse frame b, with b o a = identity, and B_a (6, 6).

    >>> b, B_a = km.geometry.frames3d.inverse(np.array([1.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.0]))
    >>> b.round(3)
    array([ 1.,  2., -0., -0., -0., -1.,  0.])
    """
    q = rotations.normalize(rotations.conjugate(a[3:]))
    Q = rotations.matrix(q)
    b = np.empty(7)
    b[:3] = -(Q @ a[:3].copy())
    b[3:] = q
    B_a = np.zeros((6, 6))
    B_a[:3, :3] = -Q
    B_a[:3, 3:] = -(Q @ rotations.skew(a[:3]))
    B_a[3:, 3:] = -Q
    return b, B_a


@compiled
def move(a: Array, u: Array) -> tuple[Array, Array, Array]:
    """Move frame a by u = (dx, dy, dz, rotation vector) of its own axes: b, B_a (6, 6), B_u (6, 6).  [TB] `odo3`.

    >>> a = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    >>> b, B_a, B_u = km.geometry.frames3d.move(a, np.array([1.0, 0.0, 0.0, 0.0, 0.0, np.pi]))
    >>> b.round(3)
    array([1., 0., 0., 0., 0., 1., 0.])
    """
    step, turn, V = np.empty(7), rotations.exp(u[3:]), rotations.left_jacobian(u[3:])
    for i in range(3):
        step[i] = u[i]
    for i in range(4):
        step[3 + i] = turn[i]
    b, B_a, B_u = compose(a, step)
    for i in range(3):
        for j in range(3):
            B_u[3 + i, 3 + j] = B_u[i, 0] * V[0, j] + B_u[i, 1] * V[1, j] + B_u[i, 2] * V[2, j]
    return b, B_a, B_u


@compiled
def from_euler_pose(e: Array) -> tuple[Array, Array]:
    """Return the frame of (x, y, z, roll, pitch, yaw) and F_e (6, 6).

    >>> f, F_e = km.geometry.frames3d.from_euler_pose(np.array([1.0, 2.0, 0.0, 0.0, 0.0, np.pi]))
    >>> f.round(3)
    array([1., 2., 0., 0., 0., 1., 0.])
    """
    f, F_e = np.empty(7), np.eye(6)
    f[:3] = e[:3]
    f[3:], F_e[3:, 3:] = rotations.from_euler(e[3:])
    return f, F_e


@compiled
def to_euler_pose(f: Array) -> tuple[Array, Array]:
    """Return (x, y, z, roll, pitch, yaw) of a frame and E_f (6, 6).

    >>> e, E_f = km.geometry.frames3d.to_euler_pose(np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.6, 0.8]))
    >>> e.round(3)
    array([1.   , 2.   , 0.   , 0.   , 0.   , 1.287])
    """
    e, E_f = np.empty(6), np.eye(6)
    e[:3] = f[:3]
    e[3:], E_f[3:, 3:] = rotations.to_euler(f[3:])
    return e, E_f


@compiled
def turned_rates(Q: Array, d: Array) -> Array:
    """Return Q [d]x (3, 3), the rate of Q Exp(-a) d in a; each row is the cross product of Q's row with d.

    >>> km.geometry.frames3d.turned_rates(np.eye(3), np.array([1.0, 2.0, 3.0]))
    array([[ 0., -3.,  2.],
           [ 3.,  0., -1.],
           [-2.,  1.,  0.]])
    """
    out = np.empty((3, 3))
    for j in range(3):
        out[j, 0] = Q[j, 1] * d[2] - Q[j, 2] * d[1]
        out[j, 1] = Q[j, 2] * d[0] - Q[j, 0] * d[2]
        out[j, 2] = Q[j, 0] * d[1] - Q[j, 1] * d[0]
    return out


@compiled
def to_frame_many(f: Array, p: Array) -> tuple[Array, Array, Array]:
    """Express K global points (K, 3) in frame F: pf, PF_f (K, 3, 6), PF_p (K, 3, 3).  [S] (56) in space.

    >>> f = np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    >>> km.geometry.frames3d.to_frame_many(f, np.array([[1.0, 2.0, 3.0]]))[0].round(3)
    array([[0., 0., 3.]])
    """
    Q = rotations.matrix(f[3:]).T.copy()
    k = len(p)
    pf, PF_f, PF_p = np.empty((k, 3)), np.empty((k, 3, 6)), np.empty((k, 3, 3))
    for i in range(k):
        d = p[i] - f[:3]
        PF_f[i, :, 3:] = turned_rates(Q, d)
        for j in range(3):
            pf[i, j] = Q[j, 0] * d[0] + Q[j, 1] * d[1] + Q[j, 2] * d[2]
            for a in range(3):
                PF_f[i, j, a] = -Q[j, a]
                PF_p[i, j, a] = Q[j, a]
    return pf, PF_f, PF_p


@compiled
def from_frame_many(f: Array, pf: Array) -> tuple[Array, Array, Array]:
    """Express K points (K, 3) of frame F globally: pw, PW_f (K, 3, 6), PW_pf (K, 3, 3).  [S] (55) in space.

    >>> f = np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    >>> km.geometry.frames3d.from_frame_many(f, np.array([[0.0, 0.0, 3.0]]))[0].round(3)
    array([[1., 2., 3.]])
    """
    Q = rotations.matrix(f[3:])
    k = len(pf)
    pw, PW_f, PW_pf = np.empty((k, 3)), np.zeros((k, 3, 6)), np.empty((k, 3, 3))
    for i in range(k):
        d = np.empty(3)
        for j in range(3):
            d[j] = Q[j, 0] * pf[i, 0] + Q[j, 1] * pf[i, 1] + Q[j, 2] * pf[i, 2]
            pw[i, j] = f[j] + d[j]
            PW_f[i, j, j] = 1.0
        PW_f[i, :, 3:] = -rotations.skew(d)
        PW_pf[i] = Q
    return pw, PW_f, PW_pf


def to_frame(f: Any, p: Any) -> tuple[Array, Array, Array]:
    """Express global points p (3,) or (K, 3) in frame F: pf, PF_f, PF_p.  [S] (56) in space.

    >>> f = np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    >>> km.geometry.frames3d.to_frame(f, [1.0, 2.0, 3.0])[0].round(3)
    array([0., 0., 3.])
    """
    return one_or_many(to_frame_many, f, p)


def from_frame(f: Any, pf: Any) -> tuple[Array, Array, Array]:
    """Express points pf (3,) or (K, 3) of frame F globally: pw, PW_f, PW_pf.  [S] (55) in space.

    >>> f = np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    >>> km.geometry.frames3d.from_frame(f, [0.0, 0.0, 3.0])[0].round(3)
    array([1., 2., 3.])
    """
    return one_or_many(from_frame_many, f, pf)
