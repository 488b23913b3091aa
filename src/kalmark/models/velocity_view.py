"""The seam of sensors that see, besides a landmark, how fast they move themselves: the chain rule written out.

The view is v = (p, t): the landmark in the sensor's frame, as in `models/observe.py`, and the velocity of the
sensor in its own frame, the first part of the twist of `models/state_view.py`.  It depends on three blocks: on the
robot's pose, on the landmark, and on the state that has the velocity or, where the motion has none, on a clone of the
pose at the sensor's last scan: then the velocity is the mean since.  This is the second block of the head, where
another sensor's mount would be: the head is the pose and, behind it, the whole state of the robot or the clone.  So
such a sensor has a mount that is known.  The corrections call these functions as they call any `observe.linearize`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import address_of, compiled
from kalmark.declare import built_in
from kalmark.geometry import frames3d
from kalmark.geometry.frames import compose
from kalmark.models import landmark_views
from kalmark.models.landmark_views import EXPECT, LOOK, residual
from kalmark.models.landmarks3d import multiply_many
from kalmark.models.observe import LINEARIZE, VELOCITY, View, is_built_in, sensor_pose
from kalmark.models.protocols import TWIST, Landmark, Sensor, tells_velocity, velocity_in
from kalmark.models.state_view import CHAIN, CHAINS, call_chain, carried_in_plane, carried_in_space

MARK = 1.0  # behind a mount: the second block of the head is no mount


@compiled
def linearize_moving(view: View, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Return e, z (K, m), E_h (K, m, h) and E_l (K, m, n) of landmarks l (K, n) and the velocity of the sensor.

    The head is the robot's pose and its state or its clone; the view has the chain of the twist instead of a sensor's
    code, `since` (1 + k,) instead of parameters, and the address of the velocity instead of that of
    `varied`.
    """
    _, look_at, expect_at, chain_at, marked, since, angular, velocity = view
    pose = len(marked) - 1
    at, r = marked[:pose].copy(), head[:pose].copy()
    t, t_r, _t_s, t_x = call_chain(chain_at, (r, at, head[pose:].copy(), since, velocity))
    T, T_r = moving_sensor_pose(r, at)
    p, P_T, P_l = landmark_views.look(look_at, (T, l))
    k, d, n, m = p.shape[0], p.shape[1], T_r.shape[0], y.shape[1]
    v = np.empty((k, 2 * d))
    for i in range(k):
        for a in range(d):
            v[i, a], v[i, d + a] = p[i, a], t[a]
    e, z, E_v = landmark_views.expect(expect_at, (0, since, angular, v, y))
    E_p, E_h = E_v[:, :, :d].copy(), np.zeros((k, m, n + t_x.shape[1]))
    E_T, E_l = multiply_many(E_p, P_T), multiply_many(E_p, P_l)
    for i in range(k):
        E_t = E_v[i, :, d:].copy()
        E_h[i, :, :n] = E_T[i] @ T_r + E_t @ t_r[:d].copy()
        E_h[i, :, n:] = E_t @ t_x[:d].copy()
    return e, z, E_h, E_l


@compiled
def moving_sensor_pose(r: Array, at: Array) -> tuple[Array, Array]:
    """Return the sensor's pose T = r o at, (3,) or (7,), and T_r."""
    if len(r) == 3:
        T, T_r, _T_s = compose(r, at)
        return T, T_r
    T, T_r, _T_s = frames3d.compose(r, at)
    return T, T_r


@dataclass(frozen=True)
class PythonMovingView:
    """A sensor of landmarks and its velocity, evaluated in Python: for a user's sensor, landmark or motion."""

    sensor: Sensor
    landmark: Landmark
    motion: Any
    at: Array
    since: Array
    angular: Flags

    @property
    def mount(self) -> Array:
        """The mount of the sensor, with the mark behind it."""
        return np.append(self.at, MARK)

    def linearize(self, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Return e, z (K, m), E_h (K, m, h) and E_l (K, m, n), as `linearize_moving` does."""
        pose = len(self.at)
        t, t_r, t_x = velocity_of(self.motion, self.at, head[:pose], head[pose:], self.since)
        T, T_r, _ = sensor_pose(head[:pose], self.at)
        p, P_T, P_l = self.landmark.seen_from(T, l)
        e, E_v = self.sensor.expect(np.concatenate([p, np.tile(t, (len(p), 1))], axis=1))
        E_p, E_t = E_v[:, :, : p.shape[1]], E_v[:, :, p.shape[1] :]
        E_h = np.concatenate([E_p @ P_T @ T_r + E_t @ t_r, E_t @ t_x], axis=2)
        return e, residual(y, e, self.angular), E_h, E_p @ P_l


def velocity_of(motion: Any, at: Array, r: Array, x: Array, since: Array) -> tuple[Array, Array, Array]:
    """Return the velocity t (2 or 3,) of a sensor at `at`, in its frame, and its Jacobians t_r and t_x.

    The robot's pose is r, and x its state if that has the velocity, else its pose since[0] seconds ago; the rest of
    `since` is the control in force.
    """
    d = 2 if len(at) == 3 else 3
    if tells_velocity(motion):
        carried: Any = carried_in_plane if d == 2 else carried_in_space
        t, t_r, _, t_x = carried(*velocity_in(motion, x, since[1:]), at)
    else:
        t, t_r, _, t_x = CHAINS[TWIST, False][d == 3](r.copy(), at, x.copy(), since, 0)
    return t[:d], t_r[:d], t_x[:d]


def moving_view_of(sensor: Any, landmark: Any, motion: Any, at: Array, since: Array) -> Any:
    """Return the argument of `linearize` for a sensor on a mount (3,) or (7,) that measures landmarks and its velocity.

    `since` (1 + k,) is read at each scan: the seconds since the last one, which count where the motion has no velocity
    in its state, and the control in force where that has the turn rate.
    """
    angular, of_state = np.array(sensor.angular, dtype=np.bool_), tells_velocity(motion)
    if not is_built_in(sensor, landmark) or (of_state and type(motion) not in built_in("motion")):
        return PythonMovingView(sensor, landmark, motion, at, since, angular)
    of: Any = motion
    return (
        address_of(linearize_moving, LINEARIZE),
        address_of(landmark.look, LOOK),
        address_of(type(sensor).expected, EXPECT),
        address_of(CHAINS[TWIST, of_state][len(at) != 3], CHAIN),
        np.append(at, MARK),
        since,
        angular,
        address_of(type(of).velocity, VELOCITY) if of_state else 0,
    )
