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

`Chain` functions have one form and are called by their addresses; `linearize_state` applies the chain rule from there
on.  The corrections call it as they call any `observe.linearize`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import address_of, by_address, compiled, signature_of
from kalmark.declare import built_in
from kalmark.geometry import frames, frames3d
from kalmark.geometry.angles import exponential_v, exponential_v_rate
from kalmark.geometry.rotations import left_jacobian_inverse, left_jacobian_rate, log, matrix, skew
from kalmark.models import landmark_views
from kalmark.models.landmark_views import EXPECT, VARY, residual
from kalmark.models.observe import LINEARIZE, VELOCITY, View, call_velocity
from kalmark.models.protocols import CHANGE, POSE, TWIST, HasVelocity, HoldsRate, OfState, sees_rates, velocity_in

# of robot, mount, second block, seconds since the last reading and control, address of a VELOCITY: v, V_r, V_s, V_l
CHAIN = signature_of("Tuple((f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]))(f8[::1], f8[::1], f8[::1], f8[::1], i8)")
call_chain = by_address(CHAIN)

Chain = tuple[Array, Array, Array, Array]


# ------------------------------------------------------------------ what is seen of a state
@compiled
def pose_in_plane(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return the pose T = r o s (3,), T_r and T_s (3, 3); there is no second block."""
    T, T_r, T_s = frames.compose(r, s)
    return T, T_r, T_s, np.zeros((3, 0))


@compiled
def pose_in_space(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return the pose T = r o s (7,), T_r and T_s (6, 6); there is no second block."""
    T, T_r, T_s = frames3d.compose(r, s)
    return T, T_r, T_s, np.zeros((6, 0))


@compiled
def change_in_plane(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return C = (l o s)^-1 o (r o s) (3,), the way of a mount s while its robot went from l to r, and Jacobians."""
    A, A_l, A_s = frames.compose(l, s)
    B, B_r, B_s = frames.compose(r, s)
    I, I_A = frames.inverse(A)
    C, C_I, C_B = frames.compose(I, B)
    C_A = C_I @ I_A
    return C, C_B @ B_r, C_B @ B_s + C_A @ A_s, C_A @ A_l


@compiled
def change_in_space(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return C = (l o s)^-1 o (r o s) (7,), the way of a mount s while its robot went from l to r, and Jacobians."""
    A, A_l, A_s = frames3d.compose(l, s)
    B, B_r, B_s = frames3d.compose(r, s)
    I, I_A = frames3d.inverse(A)
    C, C_I, C_B = frames3d.compose(I, B)
    C_A = C_I @ I_A
    return C, C_B @ B_r, C_B @ B_s + C_A @ A_s, C_A @ A_l


@compiled
def mean_twist_in_plane(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return the constant twist (vx, vy, w) of a mount s with which its robot goes from l to r, and Jacobians."""
    C, C_r, C_s, C_l = change_in_plane(r, s, l, since, velocity)
    p, q = exponential_v(C[2])
    p_a, q_a = exponential_v_rate(C[2])
    n = p * p + q * q
    x, y = (p * C[0] + q * C[1]) / n, (p * C[1] - q * C[0]) / n  # V (x, y) = (C_x, C_y)
    dx, dy = p_a * x - q_a * y, q_a * x + p_a * y
    J = np.array([[p / n, q / n, -(p * dx + q * dy) / n], [-q / n, p / n, (q * dx - p * dy) / n], [0.0, 0.0, 1.0]])
    J /= since[0]
    return np.array([x, y, C[2]]) / since[0], J @ C_r, J @ C_s, J @ C_l


@compiled
def mean_twist_in_space(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return the constant twist (v, w) (6,) of a mount s with which its robot goes from l to r, and Jacobians."""
    C, C_r, C_s, C_l = change_in_space(r, s, l, since, velocity)
    turn = log(C[3:].copy())
    inverse = left_jacobian_inverse(turn)
    way, J, t = inverse @ C[:3].copy(), np.zeros((6, 6)), np.empty(6)
    t[:3], t[3:] = way / since[0], turn / since[0]
    J[:3, :3] = J[3:, 3:] = inverse / since[0]
    J[:3, 3:] = -(inverse @ (left_jacobian_rate(turn, way) @ inverse)) / since[0]
    return t, J @ C_r, J @ C_s, J @ C_l


@compiled
def twist_in_plane(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return the twist (vx, vy, w) of a mount s of a robot with the state l (n,), and Jacobians."""
    t, T_l = call_velocity(velocity, (l, since[1:].copy()))
    return carried_in_plane(t, T_l, s)


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
def twist_in_space(r: Array, s: Array, l: Array, since: Array, velocity: int) -> Chain:
    """Return the twist (v, w) (6,) of a mount s of a robot with the state l (n,), and Jacobians."""
    t, T_l = call_velocity(velocity, (l, since[1:].copy()))
    return carried_in_space(t, T_l, s)


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


CHAINS: dict[tuple[str, bool], tuple[Any, Any]] = {  # by view, and whether it is of the state: in plane and space
    (POSE, False): (pose_in_plane, pose_in_space),
    (CHANGE, False): (change_in_plane, change_in_space),
    (TWIST, False): (mean_twist_in_plane, mean_twist_in_space),
    (TWIST, True): (twist_in_plane, twist_in_space),
}


# ------------------------------------------------------------------ and what a sensor makes of it
@compiled
def linearize_state(view: View, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return e (1, .), z (1, p), E_h (1, p, h), E_l (1, p, n) of one reading y of a sensor of the state.

    Like `observe.linearize`: the head is the robot's pose and, if in the map, the mount and the sensor's parameters.
    y (1, m + 1) ends with the time since the last reading, and may have the control in force behind it where the
    velocity is of the state.  Else in y (1, 2 m + 1) the mean of earlier readings comes before the time: the
    parameters' Jacobian is taken there (docs/motions.md).
    """
    _, chain_at, expect_at, velocity, at, par, angular, vary_at = view
    pose, m = len(at), len(angular)
    mount = head[pose : 2 * pose].copy() if len(head) > pose else at
    if len(head) > 2 * pose:
        par = head[2 * pose :].copy()
    since = y[0, m if velocity != 0 else y.shape[1] - 1 :].copy()
    v, V_r, V_s, V_l = call_chain(chain_at, (head[:pose].copy(), mount, l[0].copy(), since, velocity))
    row, e = v.reshape((1, len(v))), y.copy()
    expected, z, E_v = landmark_views.expect(expect_at, (0, par, angular, row, y[:, :m].copy()))
    e[:, :m] = expected
    p, n = z.shape[1], V_r.shape[1]
    E_h = np.zeros((1, p, n if len(head) == pose else 2 * n + len(head) - 2 * pose))
    E_h[0, :, :n] = E_v[0] @ V_r
    if len(head) > pose:
        E_h[0, :, n : 2 * n] = E_v[0] @ V_s
    if len(head) > 2 * pose:
        usual = y[:, m : 2 * m].copy() if velocity == 0 and y.shape[1] > m + 1 else expected
        E_h[0, :, 2 * n :] = landmark_views.vary(vary_at, (0, par, angular, row, usual))[0]
    E_l = np.zeros((1, p, V_l.shape[1]))
    if V_l.shape[1] > 0:
        E_l[0] = E_v[0] @ V_l
    return e, z, E_h, E_l


@dataclass(frozen=True)
class PythonStateView:
    """A sensor of the state on its mount, evaluated in Python: `linearize_state` for a user's sensor or motion."""

    sensor: Any
    motion: Any
    mount: Array
    angular: Flags

    def linearize(self, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Return e (1, .), z (1, p), E_h (1, p, h) and E_l (1, p, n)."""
        pose, m, sensor = len(self.mount), len(self.angular), self.sensor
        mount = head[pose : 2 * pose] if len(head) > pose else self.mount
        if len(head) > 2 * pose:
            sensor = sensor.with_parameters(head[2 * pose :])
        if sees_state(sensor, self.motion):
            carried: Any = carried_in_plane if pose == 3 else carried_in_space
            v, V_r, V_s, V_l = carried(*velocity_in(self.motion, l[0], y[0, m + 1 :]), np.array(mount))
        else:
            chain = CHAINS[sensor.views, False][pose != 3]
            v, V_r, V_s, V_l = chain(head[:pose].copy(), np.array(mount), l[0].copy(), y[0, -1:].copy(), 0)
        expected, E_v = sensor.expect(v[None])
        e = y.copy()
        e[:, :m] = expected
        parts = [E_v @ V_r]
        if len(head) > pose:
            parts.append(E_v @ V_s)
        if len(head) > 2 * pose:
            parts.append(sensor.parameters_jacobian(v[None]))
        return e, residual(y[:, :m].copy(), expected, self.angular), np.concatenate(parts, axis=2), E_v @ V_l


def state_view_of(sensor: OfState, motion: Any, mount: Array) -> Any:
    """Return the argument of `observe.linearize` for a sensor of the state on a mount, (3,) or (7,), of a robot."""
    angular = np.array(sensor.angular, dtype=np.bool_)
    of_state = sees_state(sensor, motion)
    if type(sensor) not in built_in("sensor") or (of_state and type(motion) not in built_in("motion")):
        return PythonStateView(sensor, motion, mount, angular)
    of: Any = sensor
    chain = CHAINS[of.views, of_state][len(mount) != 3]
    return (
        address_of(linearize_state, LINEARIZE),
        address_of(chain, CHAIN),
        address_of(type(of).expected, EXPECT),
        address_of(type(motion).velocity, VELOCITY) if of_state else 0,
        mount,
        np.array(of.parameters, dtype=np.float64),
        angular,
        0 if of.parameter_cov is None else address_of(type(of).varied, VARY),
    )


def sees_state(sensor: OfState, motion: Any) -> bool:
    """Return whether a sensor measures a twist that is in the robot's state: of some motions the velocity alone is."""
    held = isinstance(motion, HoldsRate) and not sees_rates(sensor)
    return sensor.views == TWIST and (held or isinstance(motion, HasVelocity))


def view_of_state(sensor: OfState, motion: Any, mount: Array, state: Array, before: Array, since: Array) -> Array:
    """Return the view v of a robot in a `state`, whose pose was `before` at the last reading.

    `since` (1 + k,): the seconds since then, and the control in force.
    """
    pose = len(mount)
    if sees_state(sensor, motion):
        carried: Any = carried_in_plane if pose == 3 else carried_in_space
        v: Array = carried(*velocity_in(motion, state, since[1:]), mount)[0]
        return v
    return CHAINS[sensor.views, False][pose != 3](state[:pose].copy(), mount, before, since, 0)[0]
