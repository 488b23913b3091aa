"""Rotations of space: quaternions xyzw, rotation vectors, Euler angles, and SO(3)'s exponential with its Jacobian.

Quaternions are Hamilton's, real part last, local to global: p_global = Q p_local with Q = `matrix(q)`.  An
orientation's error is a rotation vector in the **world** frame, Q = Exp(d) Q_hat, as the heading's is in two
dimensions.  In these coordinates the Jacobian of `exp` is `left_jacobian`, that of `log` its inverse, that of
`multiply(a, b)` is I and `matrix(a)`, that of `conjugate` -`matrix` of the result.
"""

from __future__ import annotations

import math

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.geometry.angles import wrap

__all__ = [
    "conjugate", "exp", "from_euler", "from_matrix", "left_jacobian", "left_jacobian_inverse", "left_jacobian_rate",
    "log", "matrix", "multiply", "normalize", "skew", "to_euler",
]  # fmt: skip


@compiled
def skew(v: Array) -> Array:
    """Return [v]x (3, 3), with [v]x w = v x w.

    >>> km.geometry.rotations.skew(np.array([1.0, 2.0, 3.0]))
    array([[ 0., -3.,  2.],
           [ 3.,  0., -1.],
           [-2.,  1.,  0.]])
    """
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@compiled
def _square(v: Array) -> float:
    """Return v'v of the first three numbers of v (3 or more,)."""
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]


@compiled
def normalize(q: Array) -> Array:
    """Return q (4,) divided by its norm.

    >>> km.geometry.rotations.normalize(np.array([0.0, 0.0, 0.0, 2.0]))
    array([0., 0., 0., 1.])
    """
    return q / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])


@compiled
def multiply(a: Array, b: Array) -> Array:
    """Return the normalised product (4,) of two unit quaternions a, b (4,): the rotation b, then a.

    >>> q = km.geometry.rotations.exp(np.array([0.0, 0.0, 0.2]))
    >>> km.geometry.rotations.log(km.geometry.rotations.multiply(q, q)).round(3)
    array([0. , 0. , 0.4])
    """
    return normalize(
        np.array(
            [
                a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
                a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
                a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
                a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
            ]
        )
    )


@compiled
def conjugate(q: Array) -> Array:
    """Return the inverse (4,) of a unit quaternion q (4,).

    >>> km.geometry.rotations.conjugate(np.array([0.0, 0.0, 0.6, 0.8]))
    array([-0. , -0. , -0.6,  0.8])
    """
    return np.array([-q[0], -q[1], -q[2], q[3]])


@compiled
def matrix(q: Array) -> Array:
    """Return the rotation matrix (3, 3) of a unit quaternion (4,).

    >>> km.geometry.rotations.matrix(np.array([0.0, 0.0, 1.0, 0.0]))
    array([[-1.,  0.,  0.],
           [ 0., -1.,  0.],
           [ 0.,  0.,  1.]])
    """
    x, y, z, w = q[0], q[1], q[2], q[3]
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@compiled
def from_matrix(Q: Array) -> Array:
    """Return the unit quaternion, w >= 0, of a rotation matrix (3, 3); divides by its largest component.

    >>> km.geometry.rotations.from_matrix(np.diag([-1.0, -1.0, 1.0]))
    array([0., 0., 1., 0.])
    """
    trace = Q[0, 0] + Q[1, 1] + Q[2, 2]
    q = np.empty(4)
    if trace > max(Q[0, 0], Q[1, 1], Q[2, 2]):
        q[0], q[1], q[2] = Q[2, 1] - Q[1, 2], Q[0, 2] - Q[2, 0], Q[1, 0] - Q[0, 1]
        q[3] = 1 + trace
    else:
        i = 0
        for a in range(1, 3):
            if Q[a, a] > Q[i, i]:
                i = a
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1 + 2 * Q[i, i] - trace
        q[j], q[k] = Q[j, i] + Q[i, j], Q[k, i] + Q[i, k]
        q[3] = Q[k, j] - Q[j, k]
    return normalize(q) if q[3] >= 0 else normalize(-q)


@compiled
def exp(v: Array) -> Array:
    """Return the quaternion of a rotation vector (3,), rad.

    >>> km.geometry.rotations.exp(np.array([0.0, 0.0, np.pi])).round(3)
    array([0., 0., 1., 0.])
    """
    a = math.sqrt(_square(v))
    s = math.sin(0.5 * a) / a if a > 1e-12 else 0.5
    return np.array([s * v[0], s * v[1], s * v[2], math.cos(0.5 * a)])


@compiled
def log(q: Array) -> Array:
    """Return the rotation vector (3,) of a unit quaternion, of length at most pi.

    >>> km.geometry.rotations.log(np.array([0.0, 0.0, 1.0, 0.0])).round(3)
    array([0.   , 0.   , 3.142])
    """
    s = math.sqrt(_square(q))
    sign = -1.0 if q[3] < 0 else 1.0
    k = sign * (2.0 * math.atan2(s, abs(q[3])) / s if s > 1e-12 else 2.0)
    return np.array([k * q[0], k * q[1], k * q[2]])


@compiled
def _polynomial(p: float, q: float, v: Array) -> Array:
    """Return I + p [v]x + q [v]x^2 (3, 3), with [v]x^2 = v v' - v'v I."""
    out, rest = np.empty((3, 3)), 1.0 - q * _square(v)
    for i in range(3):
        for j in range(3):
            out[i, j] = q * v[i] * v[j]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i, i] += rest
        out[k, j] += p * v[i]
        out[j, k] -= p * v[i]
    return out


@compiled
def _coefficients(a2: float) -> tuple[float, float]:
    """Return p and q of V(v) = I + p [v]x + q [v]x^2, with a2 = v'v."""
    if a2 < 1e-2:
        p = 1 / 2 - a2 * (1 / 24 - a2 * (1 / 720 - a2 / 40320))
        return p, 1 / 6 - a2 * (1 / 120 - a2 * (1 / 5040 - a2 / 362880))
    a = math.sqrt(a2)
    half = math.sin(0.5 * a)
    return 2.0 * half * half / a2, (a - math.sin(a)) / (a2 * a)


@compiled
def left_jacobian(v: Array) -> Array:
    """Return V(v) (3, 3) of SO(3): Exp(v + d) = Exp(V d) Exp(v) to first order, and (Exp(v) - I) p = V(v) (v x p).

    The right Jacobian is that of -v.

    >>> km.geometry.rotations.left_jacobian(np.array([0.0, 0.0, 0.2])).round(3)
    array([[ 0.993, -0.1  ,  0.   ],
           [ 0.1  ,  0.993,  0.   ],
           [ 0.   ,  0.   ,  1.   ]])
    """
    p, q = _coefficients(_square(v))
    return _polynomial(p, q, v)


@compiled
def left_jacobian_inverse(v: Array) -> Array:
    """Return V(v)^-1 (3, 3): Log(Exp(d) Exp(v)) = v + V^-1 d to first order; regular for |v| below 2 pi.

    >>> km.geometry.rotations.left_jacobian_inverse(np.array([0.0, 0.0, 0.2])).round(3)
    array([[ 0.997,  0.1  ,  0.   ],
           [-0.1  ,  0.997,  0.   ],
           [ 0.   ,  0.   ,  1.   ]])
    """
    a2 = _square(v)
    if a2 < 1e-2:
        q = 1 / 12 + a2 * (1 / 720 + a2 * (1 / 30240 + a2 / 1209600))
    else:
        half = 0.5 * math.sqrt(a2)
        q = (1.0 - half * math.cos(half) / math.sin(half)) / a2
    return _polynomial(-0.5, q, v)


@compiled
def left_jacobian_rate(v: Array, a: Array) -> Array:
    """Return d (V(v) a) / d v (3, 3).

    >>> km.geometry.rotations.left_jacobian_rate(np.array([0.0, 0.0, 0.2]), np.array([1.0, 0.0, 0.0])).shape
    (3, 3)
    """
    a2 = _square(v)
    p, q = _coefficients(a2)
    if a2 < 1e-2:
        p_a2, q_a2 = -1 / 24 + a2 * (1 / 360 - a2 / 13440), -1 / 120 + a2 * (1 / 2520 - a2 / 120960)
    else:
        t = math.sqrt(a2)
        p_a2, q_a2 = 0.5 * math.sin(t) / (a2 * t) - p / a2, 0.5 * p / a2 - 1.5 * q / a2
    c = np.cross(v, a)
    cc = np.cross(v, c)
    rate = np.outer(p_a2 * c + q_a2 * cc, 2.0 * v)
    return rate - p * skew(a) - q * (skew(c) + skew(v) @ skew(a))


@compiled
def from_euler(e: Array) -> tuple[Array, Array]:
    """Return the quaternion of (roll, pitch, yaw), rad, about x, then y, then z: Q = Qz Qy Qx; and Q_e (3, 3).

    >>> q, Q_e = km.geometry.rotations.from_euler(np.array([0.0, 0.0, np.pi / 2]))
    >>> q.round(3)
    array([0.   , 0.   , 0.707, 0.707])
    """
    cr, cp, cy = math.cos(0.5 * e[0]), math.cos(0.5 * e[1]), math.cos(0.5 * e[2])
    sr, sp, sy = math.sin(0.5 * e[0]), math.sin(0.5 * e[1]), math.sin(0.5 * e[2])
    q = np.array(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )
    cos_p, sin_p, cos_y, sin_y = math.cos(e[1]), math.sin(e[1]), math.cos(e[2]), math.sin(e[2])
    return q, np.array([[cos_p * cos_y, -sin_y, 0.0], [cos_p * sin_y, cos_y, 0.0], [-sin_p, 0.0, 1.0]])


@compiled
def to_euler(q: Array) -> tuple[Array, Array]:
    """Return (roll, pitch, yaw), rad, of a unit quaternion, pitch within +-pi/2; and E_q (3, 3).

    Through the half sum and half difference of roll and yaw, so that the rotation is kept to the last digit near
    pitch = +-pi/2 too.  There only one of the two is defined: roll is 0, and E_q grows without bound.

    >>> e, E_q = km.geometry.rotations.to_euler(np.array([0.0, 0.0, 0.6, 0.8]))
    >>> e.round(3)
    array([0.   , 0.   , 1.287])
    """
    x, y, z, w = q[0], q[1], q[2], q[3]
    above, below = math.hypot(x - z, w + y), math.hypot(x + z, w - y)  # sqrt(1 +- sin pitch)
    half_difference, half_sum = math.atan2(x - z, w + y), math.atan2(x + z, w - y)
    if below < 1e-15:
        half_sum = -half_difference
    elif above < 1e-15:
        half_difference = -half_sum
    pitch = 2.0 * math.atan2(above, below) - 0.5 * math.pi
    roll, yaw = wrap(half_sum + half_difference), wrap(half_sum - half_difference)
    c, s, cos_p = math.cos(yaw), math.sin(yaw), above * below
    t = math.sin(pitch) / cos_p
    E_q = np.array([[c / cos_p, s / cos_p, 0.0], [-s, c, 0.0], [t * c, t * s, 1.0]])
    return np.array([roll, pitch, yaw]), E_q
