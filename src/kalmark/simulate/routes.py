"""Routes of a simulated robot: a constant control, waypoints, a random walk between places, lanes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import cycle
from typing import Annotated, Any, Literal

import numpy as np
from numpy.random import Generator
from pydantic import Field

from kalmark.arrays import Array
from kalmark.config.sections import NotNegative, Number, OneOf, Positive, Section
from kalmark.geometry.angles import wrap
from kalmark.geometry.rotations import left_jacobian, matrix
from kalmark.models.motion import (
    Ackermann,
    DifferentialDrive,
    Inertial,
    InertialGravity,
    Mecanum,
    Odometry2D,
    Odometry3D,
    Omnidirectional,
    SlippingUnicycle,
    Tricycle,
    Unicycle,
)
from kalmark.models.protocols import HasVelocity
from kalmark.simulate.layouts import Points

SLOW_S = 1.0  # in which a robot steered by impulses turns to its target
REACHED_S = 0.2  # in which a robot of space turns to its target, and one that accelerates has its speed

Driver = Callable[[Array], Array]  # true state -> control of the next step


class Constant(Section):
    """The same control at every step: a circle or a line, with stops if these take any time."""

    type: Literal["constant"] = "constant"
    u: Annotated[tuple[Number, ...], Field(strict=False)]
    """The control, in the motion model's columns."""
    drive_s: Positive = 10.0
    """Time between stops."""
    stop_s: NotNegative = 0.0
    """Time of a stop, in which the control is zero."""
    ramp_s: NotNegative = 0.0
    """Time in which the control rises after a stop and falls before the next, at most half of `drive_s` each."""

    def driver(self, motion: Any, dt_s: float, area: Array, rng: Generator) -> Driver:
        """Return the function from a true state (size,) to the control (m,)."""
        u, stop = np.array(self.u), np.zeros(len(self.u))
        if not self.stop_s:
            return lambda state: u
        steps, stops = (max(1, round(time / dt_s)) for time in (self.drive_s, self.stop_s))
        ramp = max(0.5, min(self.ramp_s, self.drive_s / 2) / dt_s)
        shares = np.clip((np.arange(steps) + 0.5) / ramp, 0.0, 1.0)
        controls = cycle([*(np.minimum(shares, shares[::-1])[:, None] * u), *[stop] * stops])
        return lambda state: next(controls)


class Drive(Section):
    """Steering from place to place.  In space a place (x, y) is at the height the robot is at."""

    speed_mps: Positive = 1.0
    """Speed along the route."""
    turn_radius_m: Positive = 1.0
    """Tightest turn; a place counts as reached within twice this."""

    def places(self, area: Array, rng: Generator) -> Iterator[Array]:
        """Yield the places (D,) to drive to, without end, within `area` (2, D)."""
        raise NotImplementedError

    def driver(self, motion: Any, dt_s: float, area: Array, rng: Generator) -> Driver:
        """Return the function from a true state (size,) to the control (m,) towards the next place."""
        places = self.places(area, rng)
        target = next(places)
        steer = steer_in_space if motion.space.world == "space" else steer_in_plane

        def drive(state: Array) -> Array:
            nonlocal target
            for _ in range(1000):
                n = min(len(target), 3 if motion.space.world == "space" else 2)
                if math.dist(target[:n], state[:n]) > 2 * self.turn_radius_m:
                    break
                reached, target = target, next(places)
                if np.array_equal(target, reached):  # there is no other: in an area of one landmark
                    break
            return steer(motion, state, target, self, dt_s)

        return drive


class Waypoints(Drive):
    """Given places one after the other, round and round."""

    type: Literal["waypoints"] = "waypoints"
    points_m: Points
    """The places (x, y), in space (x, y, z) too."""

    def places(self, area: Array, rng: Generator) -> Iterator[Array]:
        """Yield the places (D,) to drive to, without end, within `area` (2, D)."""
        yield from cycle(np.array(self.points_m, dtype=np.float64))


class Wander(Drive):
    """Random places between the landmarks."""

    type: Literal["wander"] = "wander"

    def places(self, area: Array, rng: Generator) -> Iterator[Array]:
        """Yield the places (D,) to drive to, without end, within `area` (2, D)."""
        while True:
            yield rng.uniform(area[0], area[1])


class Lanes(Drive):
    """Lanes up and down between the landmarks, then back: every part of the area is seen."""

    type: Literal["lanes"] = "lanes"
    spacing_m: Positive = 10.0
    """Distance between lanes."""

    def places(self, area: Array, rng: Generator) -> Iterator[Array]:
        """Yield the places (D,) to drive to, without end, within `area` (2, D)."""
        (west, south), (east, north) = area[:, :2]
        lanes = np.linspace(west, east, max(2, math.ceil((east - west) / self.spacing_m) + 1))
        ends = [(x, y) for i, x in enumerate(lanes) for y in ((south, north) if i % 2 == 0 else (north, south))]
        yield from cycle(np.array(ends + ends[-2:0:-1]))


Route = Annotated[Any, OneOf(Constant, Waypoints, Wander, Lanes)]


def steer_in_plane(motion: Any, state: Array, target: Array, drive: Drive, dt_s: float) -> Array:
    """Return the control that turns the robot towards a target (2,) as fast as it may."""
    error = wrap(math.atan2(target[1] - state[1], target[0] - state[0]) - state[2])
    limit, columns = drive.speed_mps / drive.turn_radius_m, motion.columns
    if isinstance(motion, HasVelocity):  # by impulses
        w = min(limit, max(-limit, error / max(dt_s, SLOW_S)))
        change = np.array([drive.speed_mps, 0.0, w]) - motion.body_velocity(state)[0]
        return change if len(columns) == 3 else change[[0, 2]]
    return control_of_velocity(motion, drive.speed_mps, min(limit, max(-limit, error / dt_s)), dt_s)


def control_of_velocity(motion: Any, v: float, w: float, dt_s: float) -> Array:
    """Return the control (m,) of `motion` that drives at v (m/s) and turns at w (rad/s) for `dt_s`."""
    if isinstance(motion, Unicycle | SlippingUnicycle):
        return np.array([v, w])
    if isinstance(motion, Omnidirectional):
        return np.array([v, 0.0, w])
    if isinstance(motion, Mecanum):
        return motion.wheels @ np.array([v, 0.0, w])
    if isinstance(motion, Tricycle):
        return np.array([math.hypot(v, w * motion.wheelbase_m), math.atan2(w * motion.wheelbase_m, v)])
    if isinstance(motion, DifferentialDrive):
        half = 0.5 * w * motion.track_m
        return np.array([(v - half) * dt_s / motion.left_radius_m, (v + half) * dt_s / motion.right_radius_m])
    if isinstance(motion, Odometry2D):
        a = 0.5 * w * dt_s
        chord = v * dt_s * (math.sin(a) / a if a else 1.0)
        return np.array([chord * math.cos(a), chord * math.sin(a), 2 * a])
    assert isinstance(motion, Ackermann)
    tan = w * motion.wheelbase_m / v
    return np.array([v * (1.0 - tan * motion.encoder_offset_m / motion.wheelbase_m), math.atan(tan)])


def steer_in_space(motion: Any, state: Array, target: Array, drive: Drive, dt_s: float) -> Array:
    """Return the control that turns the nose, the x axis, towards a target (2,) or (3,), and levels the wings."""
    Q = matrix(state[3:7].copy())
    ahead = Q.T @ (np.append(target[:2], target[2] if len(target) == 3 else state[2]) - state[:3])
    up = Q[2]  # the world's, in the robot's frame
    pitch, yaw = math.atan2(-ahead[2], math.hypot(ahead[0], ahead[1])), math.atan2(ahead[1], ahead[0])
    error = np.array([-math.atan2(up[1], up[2]), pitch, yaw])
    w = error / max(dt_s, REACHED_S)
    limit = drive.speed_mps / drive.turn_radius_m
    w *= min(1.0, limit / max(float(np.linalg.norm(w)), 1e-12))
    return control_in_space(motion, state, np.array([drive.speed_mps, 0.0, 0.0]), w, dt_s)


def control_in_space(motion: Any, state: Array, v: Array, w: Array, dt_s: float) -> Array:
    """Return the control (m,) of `motion` for v (3,) m/s and w (3,) rad/s in the robot's frame, for `dt_s`."""
    if motion.columns == Odometry3D.columns:  # the exact screw
        return np.concatenate([left_jacobian(w * dt_s) @ v * dt_s, w * dt_s])
    if isinstance(motion, Inertial):
        g = state[16:] if isinstance(motion, InertialGravity) else np.array([0.0, 0.0, -motion.gravity_mps2])
        Q = matrix(state[3:7].copy())
        a = (Q @ v - state[7:10]) / max(dt_s, REACHED_S)
        return np.concatenate([w + state[10:13], Q.T @ (a - g) + state[13:16]])
    if len(state) == 7:
        return np.concatenate([v, w])
    return np.concatenate([matrix(state[3:7].copy()) @ v - state[7:10], w - state[10:13]])  # impulses
