"""Routes of a simulated robot: a constant control, waypoints, a random walk between places, lanes; and the way along.

`drive_leg` has one source: compiled for some `MOTIONS`, as plain Python for all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import cycle
from typing import Annotated, Any, Literal

import numpy as np
from numpy.random import Generator
from pydantic import model_validator

from kalmark.arrays import Array
from kalmark.compiled import address_of, by_address, compiled, python_form, signature_of
from kalmark.config.sections import Numbers, OneOf, Section
from kalmark.declare import NotNegative, Positive
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose
from kalmark.geometry.pose_frames import body_axes
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
from kalmark.models.observe import MOVE, NOTHING, call_move
from kalmark.models.protocols import HasVelocity, diffusion_of
from kalmark.simulate.layouts import Points, along_closed_line, closed
from kalmark.simulate.sights import correlated

SLOW_S = 1.0  # in which a robot steered by impulses turns to its target
REACHED_S = 0.2  # in which a robot of space turns to its target, and one that accelerates has its speed

STEER = signature_of("f8[::1](i8, f8[::1], f8[::1], f8[::1], UniTuple(f8, 2), f8)")
WALK = signature_of("Tuple((f8[::1], i8))(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])")
ERROR = signature_of("f8[::1](f8[::1], f8[::1])")
call_steer, call_walk, call_error = by_address(STEER), by_address(WALK), by_address(ERROR)

# what moves and steers a robot, the error of a control and the random walk, by address or as Python, then the number of
# the motion among `MOTIONS`; its parameters, the sigmas of a control (none: by the function) and those of the walk
Ways = tuple[tuple[Any, Any, Any, Any, int], tuple[Array, Array, Array]]
MOTIONS = (Unicycle, Odometry2D, Ackermann)  # driven in compiled code


# controls (steps, m), or none and places (D,) to drive to, and the speed in m/s and the tightest turn in m
Course = tuple[Array, Iterator[Array], tuple[float, float]]


class Constant(Section):
    """The same control at every step: a circle or a line, with stops if these take any time."""

    type: Literal["constant"] = "constant"
    u: Numbers
    """The control, in the motion model's columns."""
    drive_s: Positive = 10.0
    """Time between stops."""
    stop_s: NotNegative = 0.0
    """Time of a stop, in which the control is zero."""
    ramp_s: NotNegative = 0.0
    """Time in which the control rises after a stop and falls before the next, at most half of `drive_s` each."""

    def course(self, steps: int, dt_s: float, area: Array, rng: Generator) -> Course:
        """Return the course of so many steps."""
        u = np.array([self.u])
        if self.stop_s:
            driven, stops = (max(1, round(time / dt_s)) for time in (self.drive_s, self.stop_s))
            ramp = max(0.5, min(self.ramp_s, self.drive_s / 2) / dt_s)
            shares = np.clip((np.arange(driven) + 0.5) / ramp, 0.0, 1.0)
            u = np.append(np.minimum(shares, shares[::-1]), np.zeros(stops))[:, None] * u
        return np.resize(u, (steps, len(self.u))), cycle([NOTHING]), (0.0, 0.0)


class Drive(Section):
    """Steering from place to place.  In space a place (x, y) is at the height the robot is at."""

    speed_mps: Positive = 1.0
    """Speed along the route."""
    turn_radius_m: Positive = 1.0
    """Tightest turn; a place counts as reached within twice this."""

    def places(self, area: Array, rng: Generator) -> Iterator[Array]:
        """Yield the places (D,) to drive to, without end, within `area` (2, D)."""
        raise NotImplementedError

    def course(self, steps: int, dt_s: float, area: Array, rng: Generator) -> Course:
        """Return the course from place to place."""
        return np.zeros((0, 0)), self.places(area, rng), (self.speed_mps, self.turn_radius_m)


class Waypoints(Drive):
    """Given places one after the other, round and round."""

    type: Literal["waypoints"] = "waypoints"
    points_m: Points
    """The places (x, y), in space (x, y, z) too."""
    smooth_m: Positive | None = None
    """Drive along a smooth closed line through the places (x, y), from place to place at this distance."""

    @model_validator(mode="after")
    def _can_be_smooth(self) -> Waypoints:
        if self.smooth_m is not None:
            closed(self.points_m, "points_m")
        return self

    def places(self, area: Array, rng: Generator) -> Iterator[Array]:
        """Yield the places (D,) to drive to, without end, within `area` (2, D)."""
        points = np.array(self.points_m, dtype=np.float64)
        yield from cycle(points if self.smooth_m is None else along_closed_line(points, self.smooth_m)[0])


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


def aim(target: Array, ahead: Iterator[Array], reach_m: float, state: Array) -> Array:
    """Return the target (D,), or the next one ahead that is out of reach of a state (size,)."""
    for _ in range(1000):
        if math.dist(target, state[: len(target)]) > reach_m:
            break
        reached, target = target, next(ahead)
        if np.array_equal(target, reached):  # there is no other: in an area of one landmark
            break
    return target


@compiled
def turn_rate(r: Array, target: Array, limits: tuple[float, float], dt_s: float) -> float:
    """Return the rate (rad/s) that turns a robot at r (3,) towards a target (2,) in `dt_s`, or as fast as it may."""
    limit = limits[0] / limits[1]
    error = wrap(math.atan2(target[1] - r[1], target[0] - r[0]) - r[2])
    return min(limit, max(-limit, error / dt_s))


@compiled
def control_in_plane(number: int, par: Array, v: float, w: float, dt_s: float) -> Array:
    """Return the control (m,) of a motion among `MOTIONS`, with parameters `par`; see `control_of_velocity`."""
    if number == 0:
        return np.array([v, w])
    if number == 1:
        a = 0.5 * w * dt_s
        chord = v * dt_s * (math.sin(a) / a if a != 0.0 else 1.0)
        return np.array([chord * math.cos(a), chord * math.sin(a), 2 * a])
    tan = w * par[0] / v
    return np.array([v * (1.0 - tan * par[1] / par[0]), math.atan(tan)])


@compiled
def steer_in_plane(number: int, par: Array, r: Array, target: Array, limits: tuple[float, float], dt_s: float) -> Array:
    """Return the control (m,) that turns a robot at r (3,) towards a target (2,) as fast as it may."""
    return control_in_plane(number, par, limits[0], turn_rate(r, target, limits, dt_s), dt_s)


def control_of_velocity(motion: Any, v: float, w: float, dt_s: float) -> Array:
    """Return the control (m,) of `motion` that drives at v (m/s) and turns at w (rad/s) for `dt_s`."""
    if isinstance(motion, Omnidirectional):
        return np.array([v, 0.0, w])
    if isinstance(motion, Mecanum):
        return motion.wheels @ np.array([v, 0.0, w])
    if isinstance(motion, Tricycle):
        return np.array([math.hypot(v, w * motion.wheelbase_m), math.atan2(w * motion.wheelbase_m, v)])
    if isinstance(motion, DifferentialDrive):
        half = 0.5 * w * motion.track_m
        return np.array([(v - half) * dt_s / motion.left_radius_m, (v + half) * dt_s / motion.right_radius_m])
    number = 0 if isinstance(motion, SlippingUnicycle) else [isinstance(motion, of) for of in MOTIONS].index(True)
    return python_form(control_in_plane)(number, motion.parameters, v, w, dt_s)


def steer(motion: Any, r: Array, target: Array, limits: tuple[float, float], dt_s: float) -> Array:
    """Return the control (m,) that turns a robot at r (size,) towards a target (2,) or (3,) as fast as it may."""
    if motion.space.world == "space":
        return steer_in_space(motion, r, target, limits, dt_s)
    columns = motion.columns
    if not isinstance(motion, HasVelocity):
        return control_of_velocity(motion, limits[0], python_form(turn_rate)(r, target, limits, dt_s), dt_s)
    w = python_form(turn_rate)(r, target, limits, max(dt_s, SLOW_S))
    change = np.array([limits[0], 0.0, w]) - motion.body_velocity(r)[0]  # by impulses
    return change if len(columns) == 3 else change[[0, 2]]


def steer_in_space(motion: Any, state: Array, target: Array, limits: tuple[float, float], dt_s: float) -> Array:
    """Return the control that turns the nose, the x axis, towards a target (2,) or (3,), and levels the wings."""
    Q = matrix(state[3:7].copy())
    ahead = Q.T @ (np.append(target[:2], target[2] if len(target) == 3 else state[2]) - state[:3])
    up = Q[2]  # the world's, in the robot's frame
    pitch, yaw = math.atan2(-ahead[2], math.hypot(ahead[0], ahead[1])), math.atan2(ahead[1], ahead[0])
    error = np.array([-math.atan2(up[1], up[2]), pitch, yaw])
    w = error / max(dt_s, REACHED_S)
    w *= min(1.0, limits[0] / limits[1] / max(float(np.linalg.norm(w)), 1e-12))
    return control_in_space(motion, state, np.array([limits[0], 0.0, 0.0]), w, dt_s)


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


@compiled
def walk_in_plane(sigmas: Array, r: Array, u: Array, moved: Array, z: Array) -> tuple[Array, int]:
    """Return a pose (3,) that u (m,) moved, and walked at random by sigmas (3 or 0,) in its frame; and how many z."""
    if len(sigmas) == 0 or not u.any():
        return moved, 0
    return compose(moved, sigmas * z[:3])[0], 3


def compiled_ways(motion: Any, dt_s: float) -> Ways:
    """Return the addresses of one of `MOTIONS`, whose noise does not depend on the control."""
    u = np.ones(len(motion.columns))
    D = motion.diffusion(u, dt_s)
    covs = motion.control_noise(u), np.zeros((0, 0)) if D is None else D
    calls = address_of(type(motion).moves, MOVE), address_of(steer_in_plane, STEER), 0, address_of(walk_in_plane, WALK)
    sigmas, walks = (np.sqrt(np.diagonal(cov)) for cov in covs)
    return (*calls, MOTIONS.index(type(motion))), (motion.parameters, sigmas, walks)


def python_ways(motion: Any, dt_s: float) -> Ways:
    """Return the functions of any motion."""

    def walk(par: Array, r: Array, u: Array, moved: Array, z: Array) -> tuple[Array, int]:
        D = diffusion_of(motion, r, u, dt_s)
        return (moved, 0) if D is None else (disturb_state(motion, moved, correlated(D, z[: len(D)])), len(D))

    calls = (
        lambda r, u, par, dt_s: motion.move(r, u, dt_s), lambda number, par, *where: steer(motion, *where),
        lambda u, z: correlated(motion.control_noise(u), z), walk, -1,
    )  # fmt: skip
    return calls, (NOTHING, NOTHING, NOTHING)


@compiled
def drive_leg(
    ways: Ways, course: tuple[Array, Array, tuple[float, float]], chance: tuple[Array, int], span: tuple[int, int],
    rules: tuple[float, bool], out: tuple[Array, Array, Array],
) -> tuple[int, int]:  # fmt: skip
    """Drive through a span of steps, or until the target is reached; return the step, and how many z are used.

    `course` are the controls (steps, m), the target and the limits, `chance` standard normal numbers z and how many of
    them are used, `rules` the duration of a step and whether errors are the robot's.  Written are the states (steps +
    1, size), of which the first is given, the controls that the estimator is given, and those that are done (steps, m).
    """
    (move, steering, error, walk, number), (par, sigmas, walks) = ways
    (controls, target, limits), (z, at), (dt_s, on_robot), (states, told, done) = course, chance, rules, out
    for k in range(span[0], span[1]):
        r = states[k]
        u = controls[k] if len(controls) else call_steer(steering, (number, par, r, target, limits, dt_s))
        drawn = z[at : at + len(u)]
        wrong = u + (sigmas * drawn if len(sigmas) else call_error(error, (u, drawn)))
        told[k], done[k] = (u, wrong) if on_robot else (wrong, u)
        at += len(u)
        moved, used = call_walk(walk, (walks, r, done[k], call_move(move, (r, done[k], par, dt_s))[0], z[at:]))
        at += used
        states[k + 1] = moved
        far = 0.0
        for j in range(len(target)):
            far += (target[j] - moved[j]) ** 2
        if math.sqrt(far) < 2 * limits[1]:
            return k + 1, at
    return span[1], at


def disturb_state(motion: Any, state: Array, d: Array) -> Array:
    """Return a state (size,) disturbed by d (k,) in the robot's frame."""
    step = np.zeros(motion.space.dof)
    step[: len(d)] = body_axes(state, len(d)) @ d
    return np.asarray(motion.space.plus(state, step))
