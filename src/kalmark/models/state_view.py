"""Views of sensors that measure their own robot: functions of its state, the chain rule written out.

A sensor of landmarks observes v, a landmark in its frame (`models/observe.py`).  A sensor of the state observes one of
these:

======  =========================================================  ===================  =======================
view    v                                                          second block l       numbers in plane, space
======  =========================================================  ===================  =======================
pose    the sensor's pose in the map's frame, T = r o s            none                 3, 7
change  its pose in the frame in which its last reading was made   a clone of r         3, 7
twist   its velocity and turn rate, in its own frame               the robot, or clone  3, 6
======  =========================================================  ===================  =======================

r is the robot, s the mount.  The twist is that of the robot's state where this has one (`HasVelocity`), else the mean
since the sensor's last reading: of the constant twist that leads from there to here.  The velocity of an inertial
unit's state is joined by the turn rate of the control in force (`HoldsRate`), for sensors of velocities alone.  Behind
the sensor's m numbers the filter's measurement has the time since the last reading in seconds, and that control.

`Chain` functions have one form and are called by their addresses; `models/observe.py` applies the chain rule from there
on.  A sensor of landmarks that sees its own velocity, too, has the first part of the twist behind each landmark: its
second block is the state or the clone, in the head where another sensor has its mount.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import by_address, compiled, signature_of
from kalmark.geometry import frames, frames3d
from kalmark.geometry.angles import exponential_v, exponential_v_rate
from kalmark.geometry.pose_frames import ORIGIN, compose_poses
from kalmark.geometry.rotations import left_jacobian_inverse, left_jacobian_rate, log, matrix, skew
from kalmark.models.protocols import (
    CHANGE,
    POSE,
    TWIST,
    HasVelocity,
    HoldsRate,
    OfState,
    has_velocity_state,
    sees_rates,
    velocity_in,
)

# of the state r (size,) and parameters: the velocity in the robot's frame b (3 or 6,) and B_r (3 or 6, dof)
VELOCITY = signature_of("Tuple((f8[::1], f8[:, ::1]))(f8[::1], f8[::1])")
call_velocity = by_address(VELOCITY)
# of robot, mount, second block, seconds since the last reading and control, address of a VELOCITY: v, V_r, V_s, V_l
CHAIN = signature_of("Tuple((f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]))(f8[::1], f8[::1], f8[::1], f8[::1], i8)")
call_chain = by_address(CHAIN)

Chain = tuple[Array, Array, Array, Array]


# ------------------------------------------------------------------ what is seen of a state
@compiled
def pose_chain(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return the pose T = r o s (3 or 7,), T_r and T_s (3, 3) or (6, 6); there is no second block."""
    T, T_r, T_s = compose_poses(r, s)
    return T, T_r, T_s, np.zeros((len(T_r), 0))


@compiled
def change_chain(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return C = (l o s)^-1 o (r o s), the way of a mount s (3 or 7,) while its robot goes from l to r, Jacobians."""
    A, A_l, A_s = compose_poses(l, s)
    B, B_r, B_s = compose_poses(r, s)
    I, I_A = frames.inverse(A) if len(A) == 3 else frames3d.inverse(A)
    C, C_I, C_B = compose_poses(I, B)
    C_A = C_I @ I_A
    return C, C_B @ B_r, C_B @ B_s + C_A @ A_s, C_A @ A_l


@compiled
def mean_twist_chain(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return the constant twist (3 or 6,) of a mount s with which its robot goes from l to r, and Jacobians."""
    C, C_r, C_s, C_l = change_chain(r, s, l, since, velocity)
    t, J = constant_twist_in_plane(C, since[0]) if len(C) == 3 else constant_twist_in_space(C, since[0])
    return t, J @ C_r, J @ C_s, J @ C_l


@compiled
def constant_twist_in_plane(C: Array, seconds: float) -> tuple[Array, Array]:
    """Return the constant twist (vx, vy, w) that leads to the pose C (3,) in so many seconds, and T_C (3, 3)."""
    p, q = exponential_v(C[2])
    p_a, q_a = exponential_v_rate(C[2])
    n = p * p + q * q
    x, y = (p * C[0] + q * C[1]) / n, (p * C[1] - q * C[0]) / n  # V (x, y) = (C_x, C_y)
    dx, dy = p_a * x - q_a * y, q_a * x + p_a * y
    J = np.array([[p / n, q / n, -(p * dx + q * dy) / n], [-q / n, p / n, (q * dx - p * dy) / n], [0.0, 0.0, 1.0]])
    return np.array([x, y, C[2]]) / seconds, J / seconds


@compiled
def constant_twist_in_space(C: Array, seconds: float) -> tuple[Array, Array]:
    """Return the constant twist (v, w) (6,) that leads to the pose C (7,) in so many seconds, and T_C (6, 6)."""
    turn = log(C[3:].copy())
    inverse = left_jacobian_inverse(turn)
    way, J, t = inverse @ C[:3].copy(), np.zeros((6, 6)), np.empty(6)
    t[:3], t[3:] = way / seconds, turn / seconds
    J[:3, :3] = J[3:, 3:] = inverse / seconds
    J[:3, 3:] = -(inverse @ (left_jacobian_rate(turn, way) @ inverse)) / seconds
    return t, J


def twist_between(before: Array, after: Array, seconds: float) -> Array:
    """Return the constant twist (3 or 6,) with which a robot goes from one pose, (3,) or (7,), to another."""
    return np.asarray(mean_twist_chain(after, ORIGIN[len(after)], before, np.array([seconds]), 0)[0])


@compiled
def twist_chain(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return the twist (3 or 6,) of a mount s of a robot with the state l (n,), and Jacobians."""
    t, T_l = call_velocity(velocity, (l, since[1:].copy()))
    return carried_twist(t, T_l, s)


@compiled
def carried_twist(t: Array, T_l: Array, s: Array) -> Chain:
    """Return the twist of a mount s (3 or 7,) of a robot with the twist t (3 or 6,), whose Jacobian is T_l."""
    return carried_in_plane(t, T_l, s) if len(t) == 3 else carried_in_space(t, T_l, s)


@compiled
def carried_in_plane(t: Array, T_l: Array, s: Array) -> Chain:
    """Return the twist of a mount s (3,) of a robot with the twist t (3,), whose Jacobian is T_l (3, n)."""
    c, d = np.cos(s[2]), np.sin(s[2])
    x, y = t[0] - t[2] * s[1], t[1] + t[2] * s[0]
    v = np.array([c * x + d * y, c * y - d * x, t[2]])
    V_t = np.array([[c, d, d * s[0] - c * s[1]], [-d, c, c * s[0] + d * s[1]], [0.0, 0.0, 1.0]])
    V_s = np.array([[d * t[2], -c * t[2], v[1]], [c * t[2], d * t[2], -v[0]], [0.0, 0.0, 0.0]])
    return v, np.zeros((3, 3)), V_s, V_t @ T_l


@compiled
def carried_in_space(t: Array, T_l: Array, s: Array) -> Chain:
    """Return the twist of a mount s (7,) of a robot with the twist t (6,), whose Jacobian is T_l (6, n)."""
    R, w, p = matrix(s[3:]).T.copy(), t[3:].copy(), s[:3].copy()
    u = t[:3] + skew(w) @ p
    v, V_t, V_s = np.empty(6), np.zeros((6, 6)), np.zeros((6, 6))
    v[:3], v[3:] = R @ u, R @ w
    V_t[:3, :3] = V_t[3:, 3:] = R
    V_t[:3, 3:] = -(R @ skew(p))
    V_s[:3, :3] = R @ skew(w)
    V_s[:3, 3:], V_s[3:, 3:] = R @ skew(u), R @ skew(w)
    return v, np.zeros((6, 6)), V_s, V_t @ T_l


CHAINS: dict[tuple[str, bool], Any] = {  # by view, and whether it is of the state
    (POSE, False): pose_chain,
    (CHANGE, False): change_chain,
    (TWIST, False): mean_twist_chain,
    (TWIST, True): twist_chain,
}


def seen(views: str, of_state: bool, motion: Any, r: Array, s: Array, l: Array, since: Array) -> Chain:
    """Return what a chain does, v, V_r, V_s and V_l, in Python: of a user's motion, too.

    `since` (1 + k,): the seconds since the last reading and, where the velocity is of the state, the control in force.
    """
    s = np.array(s)
    if of_state:
        return carried_twist(*velocity_in(motion, l, since[1:]), s)
    return CHAINS[views, False](np.array(r), s, np.array(l), np.array(since), 0)


def sees_state(sensor: OfState, motion: Any) -> bool:
    """Return whether a sensor measures a twist that is in the robot's state: of some motions the velocity alone is."""
    held = isinstance(motion, HoldsRate) and not sees_rates(sensor)
    return sensor.views == TWIST and (held or isinstance(motion, HasVelocity))


def view_of_state(sensor: OfState, motion: Any, mount: Array, state: Array, before: Array, since: Array) -> Array:
    """Return the view v of a robot in a `state`, whose pose was `before` at the last reading.

    `since` (1 + k,): the seconds since then, and the control in force.
    """
    of_state = sees_state(sensor, motion)
    second = state if of_state else before
    return seen(sensor.views, of_state, motion, state[: len(mount)], mount, second, since)[0]


def velocity_of(motion: Any, at: Array, r: Array, x: Array, since: Array) -> tuple[Array, Array, Array]:
    """Return the velocity t (2 or 3,) of a sensor at `at`, in its frame, and its Jacobians t_r and t_x.

    The robot's pose is r, and x its state if that has the velocity, else its pose since[0] seconds ago; the rest of
    `since` is the control in force.
    """
    d = 2 if len(at) == 3 else 3
    t, t_r, _, t_x = seen(TWIST, has_velocity_state(motion), motion, r, at, x, since)
    return t[:d], t_r[:d], t_x[:d]
