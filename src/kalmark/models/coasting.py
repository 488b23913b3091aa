"""Robots of the plane with their velocity in the state: they go on as they go, without controls.

The velocity is that in the robot's frame, so it turns with the robot and no rotation of the world changes it: its atoms
are scalars.  Its changes are white accelerations in that frame.  Bar-Shalom, Li and Kirubarajan 2001, 11.7 (coordinated
turn); robot_localization's omnidirectional model has the same state.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.declare import NotNegative, register
from kalmark.geometry.spaces import HEADING, SCALAR, VECTOR, Space
from kalmark.models.kinematics import MotionModel, screw, white_accelerations
from kalmark.models.observe import CompiledVelocity

ALONG_AND_TURN = np.array([0, 1, 2, 3, 5])  # of pose and velocity (6,): without the velocity to the left


@compiled
def coast_in_plane(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (6,) for dt s at its own velocity (vx, vy, w), which u (3,) then changes; R_r (6, 6), R_u (6, 3)."""
    moved, R_r, R_u = r.copy(), np.eye(6), np.zeros((6, 3))
    pose, P_r, P_v = screw(r[:3].copy(), r[3:].copy(), dt)
    for i in range(3):
        moved[i] = pose[i]
        moved[3 + i] += u[i]
        R_u[3 + i, i] = 1.0
        for j in range(3):
            R_r[i, j], R_r[i, 3 + j] = P_r[i, j], P_v[i, j]
    return moved, R_r, R_u


@compiled
def velocity_of_plane(r: Array, par: Array) -> tuple[Array, Array]:
    """Return the velocity (vx, vy, w) of a state r (6,) in the robot's frame, and its Jacobian (3, 6)."""
    B_r = np.zeros((3, 6))
    for i in range(3):
        B_r[i, 3 + i] = 1.0
    return r[3:].copy(), B_r


@compiled
def coast_ahead(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (5,) for dt s at its own speed and turn rate (v, w), which u (2,) then changes; R_r (5, 5), R_u (5, 2)."""
    state, change = np.zeros(6), np.zeros(3)
    state[ALONG_AND_TURN] = r
    change[0], change[2] = u[0], u[1]
    moved, R_r, R_u = coast_in_plane(state, change, par, dt)
    return moved[ALONG_AND_TURN], R_r[ALONG_AND_TURN][:, ALONG_AND_TURN], R_u[ALONG_AND_TURN][:, ALONG_AND_TURN[3:] - 3]


@compiled
def velocity_ahead(r: Array, par: Array) -> tuple[Array, Array]:
    """Return the velocity (v, 0, w) of a state r (5,) in the robot's frame, and its Jacobian (3, 5)."""
    state = np.zeros(6)
    state[ALONG_AND_TURN] = r
    b, B_r = velocity_of_plane(state, par)
    return b, B_r[:, ALONG_AND_TURN]


@register("motion", "constant_velocity")
class ConstantVelocity(MotionModel, CompiledVelocity):
    """Velocity and turn rate of a robot of the plane are in the state: it goes on as it goes, and needs no control.

    The state is pose and velocity in the robot's frame, (x, y, theta, vx, vy, w); it moves on an arc.  The robot coasts
    to the time of each event.  A control is an impulse u = (dvx, dvy, dw) in its frame, at its time, with sigmas
    `sigma_v_mps`, `sigma_w_radps`; `..._per_sqrt_s` are white accelerations.

    >>> robot = km.Robot("cart", km.motion.ConstantVelocity(), start=(0.0, 0.0, 0.0, 1.0, 0.2, 0.0))
    >>> slam = km.Slam(robot)
    >>> for t in (0.0, 2.0):
    ...     report = slam.process(km.Control(t, "cart", (0.0, 0.0, 0.0)))
    >>> slam.mean("cart")[:3].round(2)
    array([2. , 0.4, 0. ])
    """

    sigma_v_mps: Annotated[NotNegative, "Error of the change of velocity that a control is, on each axis."] = 0.01
    sigma_w_radps: Annotated[NotNegative, "Error of the change of turn rate that a control is."] = 0.002
    sigma_vx_mps_per_sqrt_s: Annotated[NotNegative, "Random walk of the velocity forward, all the time."] = 0.1
    sigma_vy_mps_per_sqrt_s: Annotated[NotNegative, "Random walk of the velocity to the left, all the time."] = 0.1
    sigma_w_radps_per_sqrt_s: Annotated[NotNegative, "Random walk of the turn rate, all the time."] = 0.1

    space = Space("SE2 with velocity", (VECTOR, HEADING, SCALAR, SCALAR, SCALAR))
    columns = ("dvx_mps", "dvy_mps", "dw_radps")
    held = False
    moves = coast_in_plane
    velocity = velocity_of_plane
    coasts = True
    state_columns = ("vx_mps", "vy_mps", "w_radps")
    sigmas = ("sigma_v_mps", "sigma_v_mps", "sigma_w_radps")

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (6, 6) gathered in `dt_s` at rest."""
        return self.diffusion_at(np.zeros(6), u, dt_s)

    def diffusion_at(self, r: Array, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (6, 6) gathered in `dt_s` from a state r (6,) on, in the frame where the robot ends."""
        sigmas = [self.sigma_vx_mps_per_sqrt_s, self.sigma_vy_mps_per_sqrt_s, self.sigma_w_radps_per_sqrt_s]
        q = np.diag(np.square(sigmas))
        return white_accelerations(r[3:], q, dt_s) if q.any() else None


@register("motion", "constant_turn_rate")
class ConstantTurnRate(MotionModel, CompiledVelocity):
    """Speed and turn rate of a robot that does not slip are in the state: it goes on as it goes, and needs no control.

    The state is (x, y, theta, v, w); it moves on an arc (the CTRV model of tracking).  The robot coasts to the time of
    each event.  A control is an impulse u = (dv, dw) at its time, with sigmas `sigma_v_mps`, `sigma_w_radps`;
    `..._per_sqrt_s` are white accelerations.

    >>> robot = km.Robot("boat", km.motion.ConstantTurnRate(), start=(0.0, 0.0, 0.0, 1.0, 0.1))
    >>> slam = km.Slam(robot)
    >>> for t in (0.0, 2.0):
    ...     report = slam.process(km.Control(t, "boat", (0.0, 0.0)))
    >>> slam.mean("boat").round(2)
    array([1.99, 0.2 , 0.2 , 1.  , 0.1 ])
    """

    sigma_v_mps: Annotated[NotNegative, "Error of the change of speed that a control is."] = 0.01
    sigma_w_radps: Annotated[NotNegative, "Error of the change of turn rate that a control is."] = 0.002
    sigma_v_mps_per_sqrt_s: Annotated[NotNegative, "Random walk of the speed, all the time."] = 0.1
    sigma_w_radps_per_sqrt_s: Annotated[NotNegative, "Random walk of the turn rate, all the time."] = 0.1

    space = Space("SE2 with speed", (VECTOR, HEADING, SCALAR, SCALAR))
    columns = ("dv_mps", "dw_radps")
    held = False
    moves = coast_ahead
    velocity = velocity_ahead
    coasts = True
    state_columns = ("vx_mps", "w_radps")
    sigmas = ("sigma_v_mps", "sigma_w_radps")

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (5, 5) gathered in `dt_s` at rest."""
        return self.diffusion_at(np.zeros(5), u, dt_s)

    def diffusion_at(self, r: Array, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (5, 5) gathered in `dt_s` from a state r (5,) on, in the frame where the robot ends."""
        q = np.diag(np.square([self.sigma_v_mps_per_sqrt_s, 0.0, self.sigma_w_radps_per_sqrt_s]))
        if not q.any():
            return None
        return white_accelerations(np.array([r[3], 0.0, r[4]]), q, dt_s)[np.ix_(ALONG_AND_TURN, ALONG_AND_TURN)]
