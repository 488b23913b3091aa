"""Observation models: one chain from the robot to what a sensor measures, by the chain rule.  [S] A.5, (63), (64).

    compose(robot, mount) -> look(landmark) -> expect(sensor)         a sensor of landmarks
    chain(robot, mount, state or clone)     -> expect(sensor)         a sensor of its own robot: `state_view.py`
    compose -> (look, chain)                -> expect(sensor)         one that sees its own velocity, too

The steps before `expect` are one function for each of the three, called by its address.  `expectation` is the readable
form of the first.  The filter's kernels call `linearize`: `linearize_chain`, compiled, for the built-in models, a
`PythonView` for a user's.  Both are tested to be equal.  Behind the robot's pose in the head is, where the map has it,
the mount, with the parameters that the sensor has in the map behind it; of a sensor that sees its own velocity, whose
mount is known, the state or a clone, from which its velocity follows.  Of a sensor whose lag is in the map, the lag is
behind the mount, which is then where it was that long ago.

Any of the blocks may be a given value, for which no Jacobian is computed: a mount that is not in the head, and what
stands behind the numbers that are measured.  Those are the numbers of a landmark known exactly, and for a sensor of
the state the time since its last reading and the control in force, or the mean of earlier readings and that time.

Motions are at the end: a built-in one is compiled and called by its address, a user's is run in Python.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

import numpy as np
from numba import types
from numba.extending import overload

from kalmark.arrays import Array, Flags
from kalmark.compiled import address_of, by_address, compiled, form_for, signature_of
from kalmark.declare import built_in
from kalmark.geometry.angles import exponential_v, wrap
from kalmark.geometry.frames import multiply_many
from kalmark.geometry.pose_frames import compose_poses
from kalmark.geometry.rotations import exp, left_jacobian, matrix
from kalmark.geometry.spaces import Space
from kalmark.models import landmark_views, landmarks, sensors
from kalmark.models.landmark_views import EXPECT, LOOK, VARY, residual
from kalmark.models.protocols import (
    TWIST,
    Completing,
    FullSensor,
    Landmark,
    Motion,
    SeesVelocity,
    Sensor,
    finds_depth,
    has_velocity_state,
    parameter_covariance,
)
from kalmark.models.state_view import CHAIN, CHAINS, VELOCITY, call_chain, seen, sees_state, velocity_of

View = tuple[int, int, int, int, int, int, int, int, Array, Array, Flags, int, Array]
# addresses of a linearizer, its `links`, the chain of a state (0: none), the landmark's `look` (0: none), the sensor's
# `expected`, its `varied` (0: its parameters are known), the motion's `velocity` (0: the state has none);
# then the sensor's code, mount, parameters (of one that sees its velocity: the time since the last scan and the
# control), angles; then the mount some time ago (0: without a lag), and the past of the robot
VIEW = "Tuple((i8, i8, i8, i8, i8, i8, i8, i8, f8[::1], f8[::1], b1[::1], i8, f8[::1]))"
LINEARIZE = signature_of(
    f"Tuple((f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1]))({VIEW}, f8[::1], f8[:, ::1], f8[:, ::1])"
)
SENSOR_AT = signature_of("Tuple((f8[::1], f8[:, ::1]))(f8[::1], i8, f8[::1])")
MOUNT_AGO = signature_of("Tuple((f8[::1], f8[:, ::1], f8[:, ::1]))(f8[::1], f8, f8[::1])")
# of view, head, landmarks l and the given block: v (K, d), V_T (K, d, n) of what is between, T_h (n, h), V_l (K, d, n)
LINKS = signature_of(
    f"Tuple((f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1]))({VIEW}, f8[::1], f8[:, ::1], f8[:, ::1])"
)
call_linearize, call_sensor_at = by_address(LINEARIZE), by_address(SENSOR_AT)
call_links, call_mount_ago = by_address(LINKS), by_address(MOUNT_AGO)
MOUNT: Final = 8  # where a view has the mount,
AGO: Final = 11  # the mount some time ago,
PAST: Final = 12  # and the past of its robot

# of the state r (size,), the control u (m,), parameters and seconds: the new r, R_r (dof, dof), R_u (dof, m)
MOVE = signature_of("Tuple((f8[::1], f8[:, ::1], f8[:, ::1]))(f8[::1], f8[::1], f8[::1], f8)")
call_move = by_address(MOVE)

Links = tuple[Array, Array, Array, Array]
NOTHING = np.zeros(0)


sensor_pose = compose_poses  # T = r o mount with T_r and T_s, in the plane (3,) or in space (7,)


@compiled
def follow_in_plane(twist: Array, seconds: float) -> tuple[Array, Array]:
    """Return the pose d (3,) to which a constant twist (3,) leads in some seconds, and d_t (3, 1)."""
    a, d, d_t = twist[2] * seconds, np.empty(3), np.empty((3, 1))
    p, q = exponential_v(a)
    d[0], d[1], d[2] = (p * twist[0] - q * twist[1]) * seconds, (q * twist[0] + p * twist[1]) * seconds, a
    cos, sin = math.cos(a), math.sin(a)
    d_t[0, 0], d_t[1, 0], d_t[2, 0] = cos * twist[0] - sin * twist[1], sin * twist[0] + cos * twist[1], twist[2]
    return d, d_t


@compiled
def follow_in_space(twist: Array, seconds: float) -> tuple[Array, Array]:
    """Return the pose d (7,) to which a constant twist (6,) leads in some seconds, and d_t (6, 1)."""
    d, d_t, v, w = np.empty(7), np.empty((6, 1)), twist[:3].copy(), twist[3:].copy()
    d[3:] = exp(w * seconds)
    d[:3] = left_jacobian(w * seconds) @ v * seconds
    d_t[:3, 0], d_t[3:, 0] = matrix(d[3:].copy()) @ v, w
    return d, d_t


@compiled
def follow_twist(twist: Array, seconds: float) -> tuple[Array, Array]:
    """Return the pose d (3 or 7,) to which a constant twist (3 or 6,) leads in some seconds, and d_t (3 or 6, 1)."""
    return follow_in_plane(twist, seconds) if len(twist) == 3 else follow_in_space(twist, seconds)


@compiled
def mount_ago(s: Array, lag_s: float, past: Array) -> tuple[Array, Array, Array]:
    """Return where a mount s (3 or 7,) was `lag_s` ago: B in the frame that its robot has now, B_s and B_lag.

    B = r0 o exp((t0 - lag) w) o s: `past` (7 or 14,) has the lag t0, the twist w about it and the robot's pose r0 then.
    """
    d, d_t = follow_twist(past[1 : len(past) - len(s)].copy(), past[0] - lag_s)
    D, _, D_d = compose_poses(past[len(past) - len(s) :].copy(), d)
    B, B_D, B_s = compose_poses(D, s)
    return B, B_s, -(B_D @ D_d @ d_t)


def expectation(r: Array, mount: Array, sensor: Sensor, landmark: Landmark, l: Array) -> tuple[Array, ...]:
    """Return e = h(v) (K, m) and E_r, E_s, E_l, v being landmarks l (K, n) seen from T = r o mount.  [S] (63)."""
    T, T_r, T_s = sensor_pose(r, mount)
    v, V_T, V_l = landmark.seen_from(T, l)
    e, E_v = sensor.expect(v)
    return e, E_v @ V_T @ T_r, E_v @ V_T @ T_s, E_v @ V_l  # E_s calibrates the mount, for free


def inverse_expectation(r: Array, mount: Array, sensor: FullSensor, landmark: Landmark, y: Array) -> tuple[Array, ...]:
    """Return the landmarks l (K, n) that explain y (K, m), with L_r, L_s, L_y and their prior.  [S] (64), (31)-(34).

    The prior (K, n, n) is the covariance of the components that y does not determine.
    """
    return landmark_at(r, mount, landmark, *sensor.invert(y), finds_depth(sensor))


def landmark_at(
    r: Array, mount: Array, landmark: Landmark, v: Array, V_y: Array, depth: bool = True
) -> tuple[Array, ...]:
    """Return the landmarks l (K, n) at v (K, d) in the sensor's frame; see `inverse_expectation`."""
    T, T_r, T_s = sensor_pose(r, mount)
    N = None
    if isinstance(landmark, Completing):
        v, V_y, N = landmark.complete(v, V_y, depth)
    l, L_T, L_v = landmark.from_view(T, v)
    prior = np.zeros((len(l), L_v.shape[1], L_v.shape[1])) if N is None else L_v @ N @ L_v.swapaxes(1, 2)
    return l, _product(L_T, T_r), _product(L_T, T_s), _product(L_v, V_y), prior


def _product(A: Array, B: Array) -> Array:
    """Return A B of K matrices A (K, a, b) and B (K, b, c) or (b, c), to the last bit as compiled code has it."""
    B = np.broadcast_to(B, (len(A), *B.shape[-2:]))
    return multiply_many(np.array(A, dtype=np.float64), np.array(B, dtype=np.float64))


@dataclass(frozen=True)
class PythonView:
    """The chain of a user's sensor, landmark or motion, evaluated in Python; without a landmark it is of the state.

    `since` (1 + k,) of a sensor that sees its own velocity: the seconds since its last scan and the control in force.
    `past` (7 or 14,) is that of the robot (`mount_ago`), of a sensor whose lag is in the map; else (0,).
    """

    sensor: Any
    landmark: Landmark | None
    mount: Array
    angular: Flags
    motion: Any = None
    since: Array = field(default_factory=lambda: NOTHING)
    past: Array = field(default_factory=lambda: NOTHING)

    @property
    def moving(self) -> bool:
        """True if the block behind the robot's pose determines the velocity of the sensor, and is no mount."""
        return self.landmark is not None and isinstance(self.sensor, SeesVelocity)

    def linearize(self, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Return e (K, m), z (K, p), E_h (K, p, 3 or more) and E_l (K, p, n), as `linearize_chain` does."""
        pose, m, sensor = len(self.mount), len(self.angular), self.sensor
        r, behind, measured, given = head[:pose], head[pose:], y[:, :m], y[:, m:]
        s, own, s_b = self.mount, behind[:0], None
        if len(behind) and not self.moving:
            s, own = behind[:pose], behind[pose:]
        if len(self.past):
            s, B_s, B_lag = mount_ago(s, own[0], self.past)
            own, s_b = own[1:], np.concatenate([B_s, B_lag], axis=1)
        if len(own):
            sensor = sensor.with_parameters(own)
        v, V_r, V_s, V_l = self._view(r, s, behind, l, given)
        e, E_v = sensor.expect(v)
        V_s = V_s if s_b is None else V_s @ s_b
        parts = [E_v @ V_r, *([E_v @ V_s] if len(behind) else [])]
        if len(own):
            parts.append(sensor.parameters_jacobian(v))
        known = given.shape[1] > 0 and self.landmark is not None
        z, E_l = residual(measured, e, self.angular), np.zeros((*e.shape, 0)) if known else E_v @ V_l
        return np.concatenate([e, given], axis=1), z, np.concatenate(parts, axis=2), E_l

    def _view(self, r: Array, s: Array, behind: Array, l: Array, given: Array) -> tuple[Array, Array, Array, Array]:
        """Return the view v (K, d), V_r, V_s or, of a moving sensor, that in the block behind the pose, and V_l."""
        if self.landmark is None:
            of_state = sees_state(self.sensor, self.motion)
            since = given[0] if of_state else given[0, -1:]
            v, V_r, V_s, V_l = seen(self.sensor.views, of_state, self.motion, r, s, l[0], since)
            return v[None], V_r[None], V_s[None], V_l[None]
        T, T_r, T_s = sensor_pose(r, s)
        v, V_T, V_l = self.landmark.seen_from(T, given if given.shape[1] else l)
        if not self.moving:
            return v, V_T @ T_r, V_T @ T_s, V_l
        t, t_r, t_x = (
            np.tile(part, (len(v), *[1] * part.ndim)) for part in velocity_of(self.motion, s, r, behind, self.since)
        )
        V_r, V_x = np.concatenate([V_T @ T_r, t_r], axis=1), np.concatenate([0 * t_x, t_x], axis=1)
        return np.concatenate([v, t], axis=1), V_r, V_x, np.concatenate([V_l, 0 * V_l], axis=1)


def is_built_in(sensor: Any, landmark: Any) -> bool:
    """Return whether both are kalmark's own, and no user's subclass of them."""
    known = type(landmark.ray if isinstance(landmark, landmarks.AsPoint) else landmark) in landmarks.BUILT_IN
    return (landmark is None or known) and type(sensor) in sensors.BUILT_IN


def view_of(
    sensor: Any, landmark: Any, mount: Array, motion: Any = None, since: Array = NOTHING, past: Array = NOTHING
) -> Any:
    """Return the argument of `linearize`, a `View` of compiled models or a `PythonView`; `mount` (3,) or (7,).

    Without a landmark it is that of a sensor of the state of a robot with this `motion`.  For a sensor of landmarks
    that sees its own velocity `since` (1 + k,) is read at each scan: the seconds since the last one, which count where
    the motion has no velocity in its state, and the control in force where that has the turn rate.  The `past`
    (7 or 14,) of its robot is read at each scan of a sensor whose lag is in the map.
    """
    angular = np.array(sensor.angular, dtype=np.bool_)
    links, chain, of_state = links_of(sensor, landmark, motion)
    if not is_built_in(sensor, landmark) or (of_state and type(motion) not in built_in("motion")):
        return PythonView(sensor, landmark, mount, angular, motion, since, past)
    known, numbers = parameter_covariance(sensor) is None, sensor.constants if landmark else sensor.parameters
    plain = known and type(sensor) is sensors.RangeBearing and type(landmark) is landmarks.Point2D and not len(past)
    return (
        address_of(linearize_ranges if plain else linearize_chain, LINEARIZE),
        _address(None if plain else links, LINKS),
        _address(chain, CHAIN),
        _address(landmark and landmark.look, LOOK),
        _address(type(sensor).expected, EXPECT),
        _address(None if known else type(sensor).varied, VARY),
        _address(type(motion).velocity if of_state else None, VELOCITY),
        int(sensor.code),
        mount,
        since if landmark and chain else np.array(numbers, dtype=np.float64),
        angular,
        _address(mount_ago if len(past) else None, MOUNT_AGO),
        past,
    )


def links_of(sensor: Any, landmark: Any, motion: Any) -> tuple[Any, Any, bool]:
    """Return the links of a sensor, its chain, and whether that is of its robot's state.

    A sensor that sees nothing but landmarks has no chain: None.
    """
    if landmark is None:
        of_state = sees_state(sensor, motion)
        return links_of_state, CHAINS[sensor.views, of_state], of_state
    if not isinstance(sensor, SeesVelocity):
        return links_of_landmarks, None, False
    of_state = has_velocity_state(motion)
    return links_of_moving, CHAINS[TWIST, of_state], of_state


def _address(function: Any, signature: Any) -> int:
    """Return the address of a function, 0 for none."""
    return 0 if function is None else address_of(function, signature)


def linearize(view: Any, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return what landmarks l (K, n) make y (K, m) look like from a robot.

    The expectations e (K, m), the innovations z (K, p), E_h (K, p, 3 or more) with respect to the head, E_l (K, p, n).
    """
    return call_linearize(view[0], (view, head, l, y)) if isinstance(view, tuple) else view.linearize(head, l, y)


@overload(linearize, strict=False)  # type: ignore[untyped-decorator]  # strict: the annotations differ
def _compiled_linearize(view: Any, head: Any, l: Any, y: Any) -> Any:
    if isinstance(view, types.BaseTuple):
        return lambda view, head, l, y: call_linearize(view[0], (view, head, l, y))
    return None


def innovations_and_jacobians(view: Any, head: Array, l: Array, y: Array) -> tuple[Array, Array]:
    """Return the innovations z (K, p) of y (K, m) and E (K, p, h + n) by the errors of head and landmark.  [S] (63).

    Row for row a `head` (K, .), pose and mount, observes a landmark l (K, .).
    """
    look = form_for(view, _looked)
    return look(view, *(np.ascontiguousarray(a) for a in (head, l, y)))


@compiled
def _looked(view: Any, head: Array, l: Array, y: Array) -> tuple[Array, Array]:
    _, _, H_0, L_0 = linearize(view, head[0], l[:1], y[:1])
    (p, columns), k = append_columns(H_0[0], L_0[0]).shape, len(y)
    z, E = np.empty((k, p)), np.empty((k, p, columns))
    for i in range(k):
        _, z_i, H_i, L_i = linearize(view, head[i], l[i : i + 1], y[i : i + 1])
        z[i], E[i] = z_i[0], append_columns(H_i[0], L_i[0])
    return z, E


def sensor_at(view: Any, head: Array, address: int) -> tuple[Array, Array]:
    """Return the position (2 or 3,) of the sensor of a view, and its Jacobian in the head, by `sensor_address`."""
    if isinstance(view, tuple):
        return call_sensor_at(address, (view[MOUNT], is_moving(view), head))
    moving = isinstance(view, PythonView) and view.moving
    return call_sensor_at(address, (view.mount, int(moving), head))


@overload(sensor_at, strict=False)  # type: ignore[untyped-decorator]
def _compiled_sensor_at(view: Any, head: Any, address: Any) -> Any:
    return lambda view, head, address: call_sensor_at(address, (view[MOUNT], is_moving(view), head))


def sensor_address() -> int:
    """Return the address of what `sensor_at` calls."""
    return address_of(place_of_sensor, SENSOR_AT)


@compiled
def place_of_sensor(at: Array, moving: int, head: Array) -> tuple[Array, Array]:
    """Return the position S (2 or 3,) of a sensor whose mount is `at` or in the head (h,), and S_h (2 or 3, h).

    It does not depend on a block of the head that determines the velocity of a `moving` one.
    """
    pose, mounted = len(at), len(head) > len(at) and moving == 0
    T, T_r, T_s = compose_poses(head[:pose], head[pose : 2 * pose] if mounted else at)
    d, dof = 2 if pose == 3 else 3, len(T_r)
    S_h = np.zeros((d, dof if len(head) == pose else 2 * dof + len(head) - 2 * pose))
    for i in range(d):
        for j in range(dof):
            S_h[i, j] = T_r[i, j]
            if mounted:
                S_h[i, dof + j] = T_s[i, j]
    return T[:d].copy(), S_h


@compiled
def is_moving(view: View) -> int:
    """Return 1 if the block behind the robot's pose in the head has the velocity of the sensor, 0 if it is a mount."""
    return 1 if view[2] != 0 and view[3] != 0 else 0


@compiled
def linearize_ranges(view: View, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return what `linearize_chain` does of ranges and bearings of points l (K, 2), its chain rule worked out.

    The points stand at d from the sensor, in the axes of the map.  [S] (56), (61).
    """
    at, (gain, offset) = view[MOUNT], view[9]
    s = head[3:6] if len(head) > 3 else at
    cos, sin = math.cos(head[2]), math.sin(head[2])
    b_x, b_y = cos * s[0] - sin * s[1], sin * s[0] + cos * s[1]  # from the robot to the sensor
    c_T, s_T = math.cos(head[2] + s[2]), math.sin(head[2] + s[2])
    k, known = len(y), y.shape[1] > 2
    e, z, E_h, E_l = y.copy(), np.empty((k, 2)), np.empty((k, 2, len(head))), np.empty((k, 2, 2))
    for i in range(k):
        x_l, y_l = (y[i, 2], y[i, 3]) if known else (l[i, 0], l[i, 1])
        d_x, d_y = x_l - (head[0] + b_x), y_l - (head[1] + b_y)
        d2 = d_x * d_x + d_y * d_y
        d = math.sqrt(d2)
        e[i, 0], e[i, 1] = (d + offset) / gain, math.atan2(c_T * d_y - s_T * d_x, c_T * d_x + s_T * d_y)
        z[i, 0], z[i, 1] = y[i, 0] - e[i, 0], wrap(y[i, 1] - e[i, 1])
        E_l[i, 0, 0], E_l[i, 0, 1] = d_x / d / gain, d_y / d / gain
        E_l[i, 1, 0], E_l[i, 1, 1] = -d_y / d2, d_x / d2
        for a in range(2):
            E_x, E_y = E_l[i, a, 0], E_l[i, a, 1]
            E_h[i, a, 0], E_h[i, a, 1], E_h[i, a, 2] = (
                -E_x,
                -E_y,
                E_x * b_y - E_y * b_x - a,
            )  # a turn is one of bearings
            if len(head) > 3:
                E_h[i, a, 3], E_h[i, a, 4], E_h[i, a, 5] = -E_x * cos - E_y * sin, E_x * sin - E_y * cos, -a
    return e, z, E_h, np.empty((k, 2, 0)) if known else E_l


@compiled
def linearize_chain(view: View, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return e (K, m), z (K, p), E_h (K, p, h) and E_l (K, p, n) of landmarks l (K, n) and measurements y (K, m).

    A block that is given behind the measurements, in y, is so in e.  E_h = E_v V_T T_h, and E_l = E_v V_l.
    """
    _, links_at, _, look_at, expect_at, vary_at, velocity_at, code, at, par, angular, ago_at, _ = view
    own = head[2 * len(at) + (ago_at != 0) if vary_at != 0 else len(head) :]
    measured, given = y[:, : len(angular)].copy(), y[:, len(angular) :].copy()
    v, V_T, T_h, V_l = call_links(links_at, (view, head, l, given))
    par = par.copy()
    par[: len(own)] = own
    e, z, E_v = landmark_views.expect(expect_at, (code, par, angular, v, measured))
    E_h = multiply_by_one(multiply_many(E_v, V_T), T_h, len(own))
    if len(own) > 0:  # of a sensor of the state they are taken at the mean of earlier readings, where that is given
        usual = look_at == 0 and velocity_at == 0 and given.shape[1] > 1
        at_e = given[:, : e.shape[1]].copy() if usual else e
        E_h[:, :, E_h.shape[2] - len(own) :] = landmark_views.vary(vary_at, (code, par, angular, v, at_e))
    return append_columns(e, given), z, E_h, multiply_many(E_v, V_l)


@compiled
def links_of_landmarks(view: View, head: Array, l: Array, given: Array) -> Links:
    """Return the view v (K, d) of landmarks l (K, n) or `given`, V_T, T_h of the sensor's pose T, and V_l.

    V_l has no columns for what is given.
    """
    at, known = view[MOUNT], given.shape[1] > 0
    pose, mounted = len(at), len(head) > len(at)
    s = head[pose : 2 * pose] if mounted else at
    if view[AGO] == 0:
        T, T_r, T_s = compose_poses(head[:pose], s)
    else:
        B, B_s, B_lag = call_mount_ago(view[AGO], (s, head[2 * pose], view[PAST]))
        T, T_r, T_B = compose_poses(head[:pose], B)
        T_s = T_B @ append_columns(B_s, B_lag)
    v, V_T, V_l = landmark_views.look(view[3], (T, given if known else l))
    return v, V_T, append_columns(T_r, T_s) if mounted else T_r, np.empty((len(v), V_l.shape[1], 0)) if known else V_l


@compiled
def links_of_moving(view: View, head: Array, l: Array, given: Array) -> Links:
    """Return the views (K, 2 d) of landmarks with the velocity t of their sensor behind each, V_T, T_h and V_l.

    Between them is the sensor's pose T and t, which depends on the block behind the robot's pose in the head.
    """
    at = view[MOUNT]
    pose = len(at)
    p, P_T, T_r, V_l = links_of_landmarks(view, head[:pose], l, given)
    t, t_r, _, t_x = call_chain(view[2], (head[:pose], at, head[pose:], view[9], view[6]))
    k, d = p.shape
    n, others = T_r.shape[1], t_x.shape[1]
    v, V_T, T_h = np.empty((k, 2 * d)), np.zeros((k, 2 * d, n + d)), np.zeros((n + d, n + others))
    v[:, :d], v[:, d:] = p, t[:d]
    V_T[:, :d, :n] = P_T
    for j in range(d):
        V_T[:, d + j, n + j] = 1.0
    T_h[:n, :n], T_h[n:, :n], T_h[n:, n:] = T_r, t_r[:d], t_x[:d]
    return v, V_T, T_h, V_l


@compiled
def links_of_state(view: View, head: Array, l: Array, given: Array) -> Links:
    """Return the view v (1, d) of a robot and its second block l (1, n), the identity, V_h, and V_l."""
    at, velocity_at = view[MOUNT], view[6]
    pose, mounted = len(at), len(head) > len(at)
    first = 0 if velocity_at != 0 else max(0, given.shape[1] - 1)  # behind the mean of earlier readings, if given
    s = head[pose : 2 * pose] if mounted else at
    v, V_r, V_s, V_l = call_chain(view[2], (head[:pose], s, l[0], given[0, first:], velocity_at))
    V_h = append_columns(V_r, V_s) if mounted else V_r
    n = len(V_r)
    return v.reshape((1, len(v))), np.eye(n).reshape((1, n, n)), V_h, V_l.reshape((1, n, V_l.shape[1]))


@compiled
def append_columns(a: Array, b: Array) -> Array:
    """Return the columns of a (K, m) and behind them those of b (K, n)."""
    k, m = a.shape
    if b.shape[1] == 0:
        return a
    out = np.empty((k, m + b.shape[1]))
    out[:, :m], out[:, m:] = a, b
    return out


@compiled
def multiply_by_one(E: Array, F: Array, more: int) -> Array:
    """Return the products E F (K, p, h) of E (K, p, n) with one F (n, h), with so many `more` columns of 0 behind."""
    out = np.zeros((len(E), E.shape[1], F.shape[1] + more))
    for i in range(len(E)):
        for a in range(E.shape[1]):
            for b in range(F.shape[0]):
                for c in range(F.shape[1]):
                    out[i, a, c] += E[i, a, b] * F[b, c]
    return out


# ------------------------------------------------------------------ motions
class Compiled:
    """A motion whose step is compiled."""

    moves: ClassVar[Any]
    space: ClassVar[Space]
    columns: ClassVar[tuple[str, ...]]
    held: ClassVar[bool]
    coasts: ClassVar[bool]
    state_columns: ClassVar[tuple[str, ...]]

    @property
    def parameters(self) -> Array:
        """The numbers that `moves` takes."""
        return NOTHING

    def move(self, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        """Return the moved state (size,), R_r (dof, dof) and R_u (dof, m) after the control u (m,).  [S] (1)."""
        return type(self).moves(r, u, self.parameters, dt_s)


class CompiledVelocity(Compiled):
    """A compiled motion whose state contains the velocity of the robot: a `HasVelocity`."""

    velocity: ClassVar[Any]

    def body_velocity(self, r: Array) -> tuple[Array, Array]:
        """Return the velocity of a state r (size,) in the robot's frame (3 or 6,), and its Jacobian (3 or 6, dof)."""
        return type(self).velocity(r, self.parameters)


def step_of(motion: Motion) -> Any:
    """Return the argument of `step`: address and parameters of a built-in motion, else the motion."""
    if type(motion) in built_in("motion") and isinstance(motion, Compiled):
        return address_of(type(motion).moves, MOVE), motion.parameters
    return motion


def step(model: Any, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
    """Return the state (size,) after a control u (m,) of `dt_s` seconds, R_r (dof, dof) and R_u (dof, m)."""
    return call_move(model[0], (r, u, model[1], dt_s)) if isinstance(model, tuple) else model.move(r, u, dt_s)


@overload(step, strict=False)  # type: ignore[untyped-decorator]  # strict: the annotations differ
def _compiled_step(model: Any, r: Any, u: Any, dt_s: Any) -> Any:
    if isinstance(model, types.BaseTuple):
        return lambda model, r, u, dt_s: call_move(model[0], (r, u, model[1], dt_s))
    return None
