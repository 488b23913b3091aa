"""Observation models: composition of a sensor on a robot and a landmark, by the chain rule.  [S] A.5, (63), (64).

`expectation` is the readable form and serves any models.  The filter's kernels call `linearize`: plain
Python for a model written in Python, the compiled twin below for the built-in ones.  Both are tested to be equal.
The head is the robot's pose or, for a mount in the map, the pose and the mount, and behind it the parameters that the
sensor has in the map, gain and offset of its range.  Sensors of the robot itself have their own: `state_view.py`.

Motions are at the end: a built-in one is compiled and called by its address, a user's is run in Python.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numba import types
from numba.extending import overload

from kalmark.arrays import Array, Flags
from kalmark.compiled import address_of, by_address, compiled, signature_of
from kalmark.declare import built_in
from kalmark.geometry import frames3d
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose
from kalmark.geometry.spaces import Space
from kalmark.models import landmark_views, landmarks, sensors
from kalmark.models.landmark_views import EXPECT, LOOK, VARY, residual
from kalmark.models.landmarks3d import multiply_many
from kalmark.models.protocols import (
    Completing,
    FullSensor,
    Landmark,
    Motion,
    Sensor,
    finds_depth,
    parameter_covariance,
)

View = tuple[int, int, int, int, Array, Array, Flags, int]
# addresses of a `linearize_in_...`, the landmark's `look`, the sensor's `expected`; code, mount, parameters, angles;
# address of the sensor's `varied`, 0 where its parameters are known
VIEW = "Tuple((i8, i8, i8, i8, f8[::1], f8[::1], b1[::1], i8))"
LINEARIZE = signature_of(
    f"Tuple((f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1]))({VIEW}, f8[::1], f8[:, ::1], f8[:, ::1])"
)
SENSOR_AT = signature_of("Tuple((f8[::1], f8[:, ::1]))(f8[::1], f8[::1])")
call_linearize, call_sensor_at = by_address(LINEARIZE), by_address(SENSOR_AT)
MOUNT = 4  # where a view has the mount

# of the state r (size,), the control u (m,), parameters and seconds: the new r, R_r (dof, dof), R_u (dof, m)
MOVE = signature_of("Tuple((f8[::1], f8[:, ::1], f8[:, ::1]))(f8[::1], f8[::1], f8[::1], f8)")
call_move = by_address(MOVE)

# of the state r (size,) and parameters: the velocity in the robot's frame b (3 or 6,) and B_r (3 or 6, dof)
VELOCITY = signature_of("Tuple((f8[::1], f8[:, ::1]))(f8[::1], f8[::1])")
call_velocity = by_address(VELOCITY)

NOTHING = np.zeros(0)


def sensor_pose(r: Array, mount: Array) -> tuple[Array, Array, Array]:
    """Return the sensor's pose T = r o mount with T_r and T_s, in the plane (3,) or in space (7,)."""
    return compose(r, mount) if len(r) == 3 else frames3d.compose(r, mount)


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
    """A sensor on its mount looking at one type of landmark, evaluated in Python."""

    sensor: Sensor
    landmark: Landmark
    mount: Array
    angular: Flags

    def linearize(self, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Return e (K, m), z = y - e, E_h (K, m, 3 or more) and E_l (K, m, n)."""
        size = len(self.mount)
        r, mount = head[:size], head[size : 2 * size] if len(head) > size else self.mount
        if len(head) <= 2 * size:
            e, E_r, E_s, E_l = expectation(r, mount, self.sensor, self.landmark, l)
            E_h = E_r if len(head) == size else np.concatenate([E_r, E_s], axis=2)
            return e, residual(y, e, self.angular), E_h, E_l
        sensor: Any = self.sensor
        sensor = sensor.with_parameters(head[2 * size :])
        e, E_r, E_s, E_l = expectation(r, mount, sensor, self.landmark, l)
        E_p = sensor.parameters_jacobian(self.landmark.seen_from(sensor_pose(r, mount)[0], l)[0])
        return e, residual(y, e, self.angular), np.concatenate([E_r, E_s, E_p], axis=2), E_l


def fix_view(antenna: Array) -> View:
    """Return the view of an absolute position fix whose antenna sits at `antenna` (3,) or (7,) in the robot's frame."""
    return built_in_view(
        landmark_views.oneself, landmark_views.position, 0, antenna, NOTHING.copy(), np.zeros(3, dtype=np.bool_)
    )


def built_in_view(
    look: Any,
    expect: Any,
    code: int,
    mount: Array,
    par: Array,
    angular: Flags,
    varied: Any = None,
    linearized: Any = None,
) -> View:
    """Return the view of a landmark's `look` and a sensor's `expected`, compiled now; `mount` (3,) or (7,).

    `varied` is that of a sensor with parameters in the map, `linearized` a function for these two alone.
    """
    linearized = linearized or (linearize_in_plane if len(mount) == 3 else linearize_in_space)
    vary_at = 0 if varied is None else address_of(varied, VARY)
    return (
        address_of(linearized, LINEARIZE),
        address_of(look, LOOK),
        address_of(expect, EXPECT),
        code,
        mount,
        par,
        angular,
        vary_at,
    )


def is_built_in(sensor: Any, landmark: Any) -> bool:
    """Return whether both are kalmark's own, and no user's subclass of them."""
    known = type(landmark.ray if isinstance(landmark, landmarks.AsPoint) else landmark) in landmarks.BUILT_IN
    return known and type(sensor) in sensors.BUILT_IN


def view_of(sensor: Any, landmark: Any, mount: Array) -> Any:
    """Return the argument of `linearize`, a `View` of compiled models or a `PythonView`; `mount` (3,) or (7,)."""
    angular = np.array(sensor.angular, dtype=np.bool_)
    if is_built_in(sensor, landmark):
        par = np.array(sensor.constants, dtype=np.float64)
        varied = None if parameter_covariance(sensor) is None else type(sensor).varied
        plain = type(sensor) is sensors.RangeBearing and type(landmark) is landmarks.Point2D and varied is None
        models = landmark.look, type(sensor).expected, int(sensor.code)
        return built_in_view(*models, mount, par, angular, varied, linearize_ranges if plain else None)
    return PythonView(sensor, landmark, mount, angular)


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


def sensor_at(view: Any, head: Array, address: int) -> tuple[Array, Array]:
    """Return the position (2 or 3,) of the sensor of a view, and its Jacobian in the head, by `sensor_address`."""
    return call_sensor_at(address, (view[MOUNT] if isinstance(view, tuple) else view.mount, head))


@overload(sensor_at, strict=False)  # type: ignore[untyped-decorator]
def _compiled_sensor_at(view: Any, head: Any, address: Any) -> Any:
    return lambda view, head, address: call_sensor_at(address, (view[MOUNT], head))


def sensor_address(axes: int) -> int:
    """Return the address of what `sensor_at` calls in the plane (one axis) or in space."""
    return address_of(_sensor_in_plane if axes == 1 else _sensor_in_space, SENSOR_AT)


@compiled
def _sensor_in_plane(mount: Array, head: Array) -> tuple[Array, Array]:
    """Return the position S (2,) of a mount on a robot, and S_h (2, h); h is the pose and, if in the map, the mount.

    Of a mount with a mark behind it (`velocity_view.py`) h is the pose and a state that it does not depend on.
    """
    marked = len(mount) > 3
    T, T_r, T_s = compose(head[:3], head[3:6] if len(head) > 3 and not marked else mount[:3])
    S, S_h = _position(T, T_r, T_s, 2, len(head))
    if marked:
        S_h[:, 3:] = 0.0
    return S, S_h


@compiled
def _sensor_in_space(mount: Array, head: Array) -> tuple[Array, Array]:
    """Return the position S (3,) of a mount on a robot, and S_h (3, h); h is the pose and, if in the map, the mount.

    Of a mount with a mark behind it (`velocity_view.py`) h is the pose and a state that it does not depend on.
    """
    marked = len(mount) > 7
    T, T_r, T_s = frames3d.compose(head[:7], head[7:14] if len(head) > 7 and not marked else mount[:7])
    S, S_h = _position(T, T_r, T_s, 3, len(head))
    if marked:
        S_h[:, 6:] = 0.0
    return S, S_h


@compiled
def _position(T: Array, T_r: Array, T_s: Array, size: int, head: int) -> tuple[Array, Array]:
    pose, dof = len(T), len(T_r)
    S_h = np.zeros((size, dof if head == pose else 2 * dof + head - 2 * pose))
    for i in range(size):
        for j in range(dof):
            S_h[i, j] = T_r[i, j]
            if head > pose:
                S_h[i, dof + j] = T_s[i, j]
    return T[:size].copy(), S_h


@compiled
def linearize_in_plane(view: View, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return what `expectation` returns in the plane, compiled.

    The landmarks l are (K, n), the measurements y (K, m); e (K, m), z (K, p), E_h (K, p, h) and E_l (K, p, n).
    """
    mount = view[4]
    T, T_r, T_s = compose(head[:3], head[3:6] if len(head) > 3 else mount)
    return _linearized(view, head, T, T_r, T_s, l, y)


@compiled
def linearize_ranges(view: View, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return what `linearize_in_plane` does of ranges and bearings of points l (K, 2), its chain rule worked out.

    The points stand at d from the sensor, in the axes of the map.  [S] (56), (61).
    """
    gain, offset = view[5]
    s = head[3:6] if len(head) > 3 else view[4]
    cos, sin = math.cos(head[2]), math.sin(head[2])
    b_x, b_y = cos * s[0] - sin * s[1], sin * s[0] + cos * s[1]  # from the robot to the sensor
    c_T, s_T = math.cos(head[2] + s[2]), math.sin(head[2] + s[2])
    k = len(l)
    e, z, E_h, E_l = np.empty((k, 2)), np.empty((k, 2)), np.empty((k, 2, len(head))), np.empty((k, 2, 2))
    for i in range(k):
        d_x, d_y = l[i, 0] - (head[0] + b_x), l[i, 1] - (head[1] + b_y)
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
    return e, z, E_h, E_l


@compiled
def linearize_in_space(view: View, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return what `expectation` returns in space, compiled.

    The landmarks l are (K, n), the measurements y (K, m); e (K, m), z (K, p), E_h (K, p, h) and E_l (K, p, n).
    """
    mount = view[4]
    T, T_r, T_s = frames3d.compose(head[:7], head[7:14] if len(head) > 7 else mount)
    return _linearized(view, head, T, T_r, T_s, l, y)


@compiled
def _linearized(
    view: View, head: Array, T: Array, T_r: Array, T_s: Array, l: Array, y: Array
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Apply the chain rule from the sensor's pose T on, T_r and T_s being its Jacobians."""
    _, look_at, expect_at, code, at, par, angular, vary_at = view
    pose = len(at)
    if len(head) > 2 * pose:
        par = par.copy()
        for i in range(len(head) - 2 * pose):
            par[i] = head[2 * pose + i]
    v, V_T, V_l = landmark_views.look(look_at, (T, l))
    e, z, E_v = landmark_views.expect(expect_at, (code, par, angular, v, y))
    E_T, E_l = multiply_many(E_v, V_T), multiply_many(E_v, V_l)
    if len(head) == pose:
        return e, z, turn_jacobian(E_T, T_r), E_l
    k, p, n = E_T.shape
    E_h = np.zeros((k, p, 2 * n + len(head) - 2 * pose))
    for i in range(k):
        for a in range(p):
            for b in range(n):
                for c in range(n):
                    E_h[i, a, n + c] += E_T[i, a, b] * T_s[b, c]
    turn_jacobian(E_T, T_r)
    for i in range(k):
        for a in range(p):
            for c in range(n):
                E_h[i, a, c] = E_T[i, a, c]
    if len(head) > 2 * pose:
        write_last_columns(E_h, landmark_views.vary(vary_at, (code, par, angular, v, e)))
    return e, z, E_h, E_l


@compiled
def write_last_columns(E_h: Array, E_p: Array) -> None:
    """Write E_p (K, p, c) into the last columns of E_h (K, p, h)."""
    k, p, c = E_p.shape
    for i in range(k):
        for a in range(p):
            for b in range(c):
                E_h[i, a, E_h.shape[2] - c + b] = E_p[i, a, b]


@compiled
def turn_jacobian(E_T: Array, T_r: Array) -> Array:
    """Return E_T @ T_r (K, m, n) in place: T_r is the identity except for the rotation of the robot."""
    k, m, n = E_T.shape
    first = 2 if n == 3 else 3
    for i in range(k):
        for a in range(m):
            for c in range(first, n):
                for b in range(first):
                    E_T[i, a, c] += E_T[i, a, b] * T_r[b, c]
    return E_T


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
