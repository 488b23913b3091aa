"""Robots on wheels of other kinds: differential drive, tricycle, omnidirectional, mecanum, a unicycle that slips.

Ackermann and the unicycle are in `motion`.  Radii, track and wheelbase: Siegwart, Nourbakhsh and Scaramuzza 2011, 3.2.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.declare import Estimated, NotNegative, Positive, register
from kalmark.geometry.frames import product
from kalmark.geometry.spaces import HEADING, SCALAR, VECTOR, Space
from kalmark.models.kinematics import (
    NODES,
    WEIGHTS,
    PlanarMotion,
    Scale,
    SpeedAndTurn,
    Steered,
    SteeringBias,
    SteeringNoise,
    SteeringScale,
    TurnBias,
    TurnPerMetre,
    TurnScale,
    WheelSpeedBias,
    add_noise,
    arc,
    screw,
    still_to_come,
    white_steps,
)


@compiled
def wheel_increments(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (3,) along the arc of its wheels' turns u (2,) = (left, right), rad; R_r (3, 3), R_u (3, 2).

    `par`: radii of the left and the right wheel, and the track between them.
    """
    left, right, track = par[0], par[1], par[2]
    v, w = 0.5 * (right * u[1] + left * u[0]), (right * u[1] - left * u[0]) / track
    r2, R_r, R_vw = arc(r, v, w, 1.0)
    VW_u = np.array([[0.5 * left, 0.5 * right], [-left / track, right / track]])
    return r2, R_r, product(R_vw, VW_u)


@compiled
def tricycle(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move the rear axle's centre r (3,) by u (2,) = (speed of the front wheel, its steering angle), along the arc.

    `par`: the wheelbase.
    """
    c, s = math.cos(u[1]), math.sin(u[1])
    r2, R_r, R_vw = arc(r, u[0] * c, u[0] * s / par[0], dt)
    VW_u = np.array([[c, -u[0] * s], [s / par[0], u[0] * c / par[0]]])
    return r2, R_r, product(R_vw, VW_u)


@compiled
def sideways(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (3,) by the velocity u (3,) = (vx, vy, w) for dt s: the new r, R_r (3, 3), R_u (3, 3)."""
    return screw(r, u, dt)


@compiled
def mecanum(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (3,) for dt s by the rates of its wheels u (4,), by the matrix `par` (12,) to its velocity; R_u (3, 4)."""
    W, v = par.reshape(3, 4), np.zeros(3)
    for i in range(3):
        for j in range(4):
            v[i] += W[i, j] * u[j]
    r2, R_r, R_v = screw(r, v, dt)
    return r2, R_r, product(R_v, W)


@compiled
def move_with_slip(r: Array, u: Array, par: Array, dt: float) -> tuple[Array, Array, Array]:
    """Move r (4,) = (pose, slip) by u (2,) = (v, w) for dt s, with the velocity slip v to the left; R_u (4, 2)."""
    v = np.array([u[0], r[3] * u[0], u[1]])
    pose, P_r, P_v = screw(r[:3].copy(), v, dt)
    moved, R_r, R_u = r.copy(), np.eye(4), np.zeros((4, 2))
    for i in range(3):
        moved[i], R_r[i, 3] = pose[i], u[0] * P_v[i, 1]
        R_u[i, 0], R_u[i, 1] = P_v[i, 0] + r[3] * P_v[i, 1], P_v[i, 2]
        for j in range(3):
            R_r[i, j] = P_r[i, j]
    return moved, R_r, R_u


@compiled
def walk_of_slip(u: Array, q: float, dt: float) -> Array:
    """Return the covariance (4, 4), in the frame where an arc ends, of a white change of the slip, q in a second."""
    D, G, v, one = np.zeros((4, 4)), np.zeros((4, 1)), np.array([u[0], 0.0, u[1]]), np.ones((1, 1))
    G[3, 0] = 1.0
    pieces = 1 + int(abs(u[1] * dt))
    for k in range(pieces):
        for n in range(len(NODES)):
            G_v = still_to_come(v, (k + NODES[n]) * dt / pieces)[1]
            for i in range(3):
                G[i, 0] = u[0] * G_v[i, 1]
            add_noise(D, G, one, WEIGHTS[n] / pieces * dt * q)
    return D


@register("motion", "differential_drive")
class DifferentialDrive(PlanarMotion):
    """Two driven wheels: by how much each has turned.

    A control is u = (left rad, right rad), the turns of the wheels (of the wheels, not of the motors) in the interval
    that ended at its time; the robot moved on an arc.  The noise of a wheel's way is white along it, so it grows with
    the way that this wheel has rolled, however often the wheels are read (Chong and Kleeman 1997).  Radii and track
    with sigmas above 0 are in the map and are estimated.

    >>> km.motion.DifferentialDrive().move(np.zeros(3), np.array((10.0, 12.0)), 0.1)[0].round(3)
    array([1.071, 0.217, 0.4  ])
    """

    left_radius_m: Annotated[Positive, "Radius of the left wheel."] = 0.1
    right_radius_m: Annotated[Positive, "Radius of the right wheel."] = 0.1
    track_m: Annotated[Positive, "Distance between the wheels, where they touch the ground."] = 0.5
    sigma_way_m_per_sqrt_m: Annotated[NotNegative, "Error of a wheel's way, after one metre that it has rolled."] = 0.01
    sigma_wheel_rad: Annotated[NotNegative, "Error of each reading of a wheel: its resolution."] = 0.0
    sigma_radius_m: Annotated[
        NotNegative, "Standard deviation of each radius; above 0 both are in the map and are estimated."
    ] = 0.0
    sigma_track_m: Annotated[Estimated, "Standard deviation of the track"] = 0.0

    columns = ("left_rad", "right_rad")
    held = False
    moves = wheel_increments
    sigmas = ("sigma_wheel_rad", "sigma_wheel_rad")
    calibrations = (
        ("left_radius_m", "sigma_radius_m"),
        ("right_radius_m", "sigma_radius_m"),
        ("track_m", "sigma_track_m"),
    )

    @cached_property
    def parameters(self) -> Array:
        """The radii of the left and the right wheel and the track (3,), m."""
        return np.array([self.left_radius_m, self.right_radius_m, self.track_m])

    def control_noise(self, u: Array) -> Array:
        """Return N (2, 2) of the turns u (2,) of the wheels, rad^2."""
        radii = self.parameters[:2]
        return self._N + np.diag(self.sigma_way_m_per_sqrt_m**2 * np.abs(u) / radii)

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (3, 3) of where on its arc the noise of the ways arose, in the robot's frame."""
        D = super().diffusion(u, dt_s)
        ways = self.parameters[:2] * u
        if not (self.sigma_way_m_per_sqrt_m and ways.any()):
            return D
        M = np.array([[0.5, 0.5], [0.0, 0.0], [-1.0 / self.track_m, 1.0 / self.track_m]])
        q = (M * (self.sigma_way_m_per_sqrt_m**2 * np.abs(ways))) @ M.T
        bridge = white_steps(M @ ways, q, 1.0, True)
        return bridge if D is None else D + bridge

    def calibrated(self, u: Array, a: Array, dt_s: float) -> tuple[Array, Array]:
        """Return the turns (2,) that move a robot of these parameters as u (2,) moves one that differs by a (c,).

        And U_a (2, c).  Both move by (l + r) / 2 and turn by (r - l) / track, l and r the ways of the wheels.
        """
        differs, radii = np.zeros(3), self.parameters[:2]
        differs[self._unknown] = a
        l, r = (radii + differs[:2]) * u
        track = self.track_m + differs[2]
        share = self.track_m / track
        forward, half = 0.5 * (l + r), 0.5 * (r - l) * share
        forward_a = np.array([0.5 * u[0], 0.5 * u[1], 0.0])
        half_a = np.array([-0.5 * u[0] * share, 0.5 * u[1] * share, -half / track])
        U_a = np.array([forward_a - half_a, forward_a + half_a]) / radii[:, None]
        return np.array([forward - half, forward + half]) / radii, np.ascontiguousarray(U_a[:, self._unknown])

    def _effects(self, u: Array, dt_s: float) -> Array:
        return self.calibrated(u, np.zeros(len(self._unknown)), dt_s)[1]

    def calibration_effect(self, u: Array, dt_s: float) -> Array:
        """Return B (2, c), U_a of `calibrated` where nothing differs."""
        return self._effects(u, dt_s)


@register("motion", "tricycle")
class Tricycle(Steered):
    """A tricycle with a steered and driven front wheel: its speed and its angle, each held until the next control.

    A control is u = (speed of the front wheel m/s, steering rad); the state is the rear axle's centre.

    >>> km.motion.Tricycle().move(np.zeros(3), np.array((1.0, 0.2)), 1.0)[0].round(3)
    array([0.974, 0.097, 0.199])
    """

    wheelbase_m: Annotated[Positive, "Distance from the rear axle to the front wheel."] = 1.0
    sigma_v_mps: Annotated[NotNegative, "Error of the wheel's speed held over its interval."] = 0.1
    sigma_steering_rad: SteeringNoise = 0.02
    sigma_v_bias_mps: WheelSpeedBias = 0.0
    sigma_steering_bias_rad: SteeringBias = 0.0
    sigma_v_scale: Scale = 0.0
    sigma_steering_scale: SteeringScale = 0.0

    moves = tricycle

    @cached_property
    def parameters(self) -> Array:
        """The wheelbase (1,), m."""
        return np.array([self.wheelbase_m])


@register("motion", "omnidirectional")
class Omnidirectional(PlanarMotion):
    """Velocity in any direction and turn rate, each held until the next control.

    A control is u = (vx m/s, vy m/s, w rad/s) in the robot's frame; the robot moves on the exact arc.

    >>> km.motion.Omnidirectional().move(np.zeros(3), np.array((1.0, 0.5, 0.2)), 1.0)[0].round(3)
    array([0.944, 0.596, 0.2  ])
    """

    sigma_vx_mps: Annotated[NotNegative, "Error of the velocity held over its interval, forward."] = 0.1
    sigma_vy_mps: Annotated[NotNegative, "Error of the velocity held over its interval, to the left."] = 0.1
    sigma_w_radps: Annotated[NotNegative, "Error of the turn rate held over its interval."] = 0.05
    sigma_v_bias_mps: Annotated[Estimated, "Constant part of the speed's error on each axis"] = 0.0
    sigma_w_bias_radps: TurnBias = 0.0
    sigma_v_scale: Scale = 0.0
    sigma_w_scale: TurnScale = 0.0
    sigma_turn_rad_per_m: TurnPerMetre = 0.0

    columns = ("vx_mps", "vy_mps", "w_radps")
    held = True
    moves = sideways
    sigmas = ("sigma_vx_mps", "sigma_vy_mps", "sigma_w_radps")
    calibrations = (
        ("vx_mps", "sigma_v_bias_mps"),
        ("vy_mps", "sigma_v_bias_mps"),
        ("w_radps", "sigma_w_bias_radps"),
        ("v_scale", "sigma_v_scale"),
        ("w_scale", "sigma_w_scale"),
        ("turn_rad_per_m", "sigma_turn_rad_per_m"),
    )

    def _effects(self, u: Array, dt_s: float) -> Array:
        vx, vy, w = u
        more = [[vx, 0.0, 0.0], [vy, 0.0, 0.0], [0.0, w, math.hypot(vx, vy)]]
        return np.hstack([np.eye(3), more])


@register("motion", "mecanum")
class Mecanum(PlanarMotion):
    """Four mecanum wheels, their rollers as an X seen from above: the rate of each, held until the next control.

    A control is u = (front left, front right, rear left, rear right), rad/s, each turning forward.  Four rates
    determine three velocities by least squares (Taheri, Qiao and Ghaeminezhad 2015), with l half of wheelbase and track
    together and R the radius: vx = R/4 (fl + fr + rl + rr), vy = R/4 (-fl + fr + rl - rr),
    w = R/4 (-fl + fr - rl + rr) / l.

    >>> km.motion.Mecanum().move(np.zeros(3), np.array((5.0, 5.0, 5.0, 5.0)), 1.0)[0].round(3)
    array([0.5, 0. , 0. ])
    """

    radius_m: Annotated[Positive, "Radius of the wheels."] = 0.1
    wheelbase_m: Annotated[Positive, "Distance between the axles."] = 0.5
    track_m: Annotated[Positive, "Distance between the wheels of an axle."] = 0.5
    sigma_wheel_radps: Annotated[NotNegative, "Error of each wheel's rate held over its interval; slip too."] = 0.5
    sigma_v_scale: Scale = 0.0
    sigma_w_scale: TurnScale = 0.0

    columns = (
        "front_left_radps", "front_right_radps", "rear_left_radps", "rear_right_radps",
    )  # fmt: skip
    held = True
    moves = mecanum
    sigmas = 4 * ("sigma_wheel_radps",)
    calibrations = (("v_scale", "sigma_v_scale"), ("w_scale", "sigma_w_scale"))

    @cached_property
    def wheels(self) -> Array:
        """The rates (4, 3) of the wheels by the velocity (vx, vy, w)."""
        l = 0.5 * (self.wheelbase_m + self.track_m)
        return np.array([[1.0, -1.0, -l], [1.0, 1.0, l], [1.0, 1.0, -l], [1.0, -1.0, l]]) / self.radius_m

    @cached_property
    def parameters(self) -> Array:
        """The matrix (3, 4) from the rates of the wheels to the velocity, row by row (12,)."""
        return np.array(np.linalg.pinv(self.wheels).ravel(), dtype=np.float64)

    def _effects(self, u: Array, dt_s: float) -> Array:
        v = self.parameters.reshape(3, 4) @ u
        return self.wheels @ np.array([[v[0], 0.0], [v[1], 0.0], [0.0, v[2]]])


@register("motion", "slipping_unicycle")
class SlippingUnicycle(SpeedAndTurn):
    """Speed and turn rate, held until the next control, of a robot that slips sideways: the slip is in the state.

    A control is u = (v m/s, w rad/s).  The state is pose and slip, the velocity to the left as a share of the speed:
    the tangent of the angle between course and heading.  It is a random walk while the robot moves (Le, Rye and
    Durrant-Whyte 1997), because slip is of the ground (a slope, soft soil) and lasts.  For slip that comes and goes
    from step to step `sigma_across_m_per_sqrt_s` of any motion of the plane is enough.

    >>> robot = km.Robot("tractor", km.motion.SlippingUnicycle(), start=(0.0, 0.0, 0.0, 0.1))
    >>> slam = km.Slam(robot)
    >>> for t in (0.0, 2.0):
    ...     report = slam.process(km.Control(t, "tractor", (1.0, 0.0)))
    >>> slam.mean("tractor").round(2)  # x, y, theta, slip
    array([2. , 0.2, 0. , 0.1])
    """

    sigma_slip_per_sqrt_s: Annotated[NotNegative, "Random walk of the slip, while it moves."] = 0.02

    space = Space("SE2 with slip", (VECTOR, HEADING, SCALAR))
    moves = move_with_slip
    state_columns = ("slip",)

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance (4, 4) of the walks of pose and slip in `dt_s`, in the frame where the robot ends."""
        D = super().diffusion(u, dt_s)
        if not (self.sigma_slip_per_sqrt_s and u.any()):
            return D
        walk = walk_of_slip(u, self.sigma_slip_per_sqrt_s**2, dt_s)
        if D is not None:
            walk[:3, :3] += D
        return walk
