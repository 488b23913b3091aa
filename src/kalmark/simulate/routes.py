"""Routes of a simulated robot: a constant control, waypoints, a random walk between places, lanes; and the way along.

`drive_leg` has one source: compiled for the motions of `CONTROLS`, as plain Python for all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import cycle
from typing import Annotated, Any, Literal

import numpy as np
from numpy.random import Generator
from pydantic import Field

from kalmark.arrays import Array
from kalmark.compiled import address_of, by_address, compiled, python_form, signature_of
from kalmark.config.sections import NotNegative, Number, OneOf, Positive, Section
from kalmark.geometry.angles import rotation, wrap
from kalmark.geometry.frames import compose
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
from kalmark.simulate.layouts import Points
from kalmark.simulate.sights import correlated

SLOW_S = 1.0  # in which a robot steered by impulses turns to its target
REACHED_S = 0.2  # in which a robot of space turns to its target, and one that accelerates has its speed

CONTROL = signature_of("f8[::1](f8[::1], f8, f8, f8)")
STEER = signature_of("f8[::1](i8, f8[::1], f8[::1], f8[::1], UniTuple(f8, 2), f8)")
DISTURB = signature_of("f8[::1](f8[::1], f8[::1], f8[::1])")
WALK = signature_of("Tuple((f8[::1], i8))(f8[::1], f8[::1], f8[::1], f8[::1], f8[::1])")
call_control, call_steer = by_address(CONTROL), by_address(STEER)
call_disturb, call_walk = by_address(DISTURB), by_address(WALK)

# what moves, steers and disturbs a robot, by address or as Python, and the parameters of the motion, of the error of a
# control and of the random walk
Ways = tuple[tuple[Any, Any, Any, Any, Any], tuple[Array, Array, Array]]


@dataclass
class Course:
    """What steers a robot: controls (steps, m), or a `target` (D,) and the places ahead.

    `limits` are the speed in m/s and the tightest turn in m.
    """

    controls: Array
    target: Array
    limits: tuple[float, float]
    ahead: Iterator[Array]

    def aim(self, state: Array) -> None:
        """Take the next place as the target where a state (size,) is near this one."""
        for _ in range(1000):
            if math.dist(self.target, state[: len(self.target)]) > 2 * self.limits[1]:
                return
            reached, self.target = self.target, next(self.ahead)
            if np.array_equal(self.target, reached):  # there is no other: in an area of one landmark
                return


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

    def course(self, steps: int, dt_s: float, area: Array, rng: Generator) -> Course:
        """Return the course of so many steps."""
        u = np.array([self.u])
        if self.stop_s:
            driven, stops = (max(1, round(time / dt_s)) for time in (self.drive_s, self.stop_s))
            ramp = max(0.5, min(self.ramp_s, self.drive_s / 2) / dt_s)
            shares = np.clip((np.arange(driven) + 0.5) / ramp, 0.0, 1.0)
            u = np.append(np.minimum(shares, shares[::-1]), np.zeros(stops))[:, None] * u
        return Course(np.resize(u, (steps, len(self.u))), NOTHING, (0.0, 0.0), cycle([NOTHING]))


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
        places = self.places(area, rng)
        return Course(np.zeros((0, 0)), next(places), (self.speed_mps, self.turn_radius_m), places)


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


@compiled
def unicycle_control(par: Array, v: float, w: float, dt_s: float) -> Array:
    """Return the speed and the turn rate (2,)."""
    return np.array([v, w])


@compiled
def increment_control(par: Array, v: float, w: float, dt_s: float) -> Array:
    """Return the increment (3,) along an arc."""
    a = 0.5 * w * dt_s
    chord = v * dt_s * (math.sin(a) / a if a != 0.0 else 1.0)
    return np.array([chord * math.cos(a), chord * math.sin(a), 2 * a])


@compiled
def car_control(par: Array, v: float, w: float, dt_s: float) -> Array:
    """Return the speed of the wheel and the steering angle (2,) of a car of the parameters `par` (2,)."""
    tan = w * par[0] / v
    return np.array([v * (1.0 - tan * par[1] / par[0]), math.atan(tan)])


CONTROLS: dict[type, Any] = {
    Unicycle: unicycle_control, SlippingUnicycle: unicycle_control, Odometry2D: increment_control,
    Ackermann: car_control,
}  # fmt: skip


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
    control = next(control for of, control in CONTROLS.items() if isinstance(motion, of))
    return np.asarray(python_form(control)(motion.parameters, v, w, dt_s))


@compiled
def steer_in_plane(
    control: Any, par: Array, r: Array, target: Array, limits: tuple[float, float], dt_s: float
) -> Array:
    """Return the control (m,) that turns a robot at r (3,) towards a target (2,) as fast as it may."""
    limit, error = limits[0] / limits[1], wrap(math.atan2(target[1] - r[1], target[0] - r[0]) - r[2])
    return call_control(control, (par, limits[0], min(limit, max(-limit, error / dt_s)), dt_s))  # type: ignore[no-any-return]


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
def constant_errors(sigmas: Array, u: Array, z: Array) -> Array:
    """Return the error (m,) of a control u (m,) from standard normal numbers z, by its sigmas (m,)."""
    return sigmas * z[: len(sigmas)]


@compiled
def walk_in_plane(sigmas: Array, r: Array, u: Array, moved: Array, z: Array) -> tuple[Array, int]:
    """Return a pose (3,) that u (m,) moved, and walked at random by sigmas (3 or 0,) in its frame; and how many z."""
    if len(sigmas) == 0 or not u.any():
        return moved, 0
    return compose(moved, sigmas * z[:3])[0], 3


def compiled_ways(motion: Any, dt_s: float) -> Ways:
    """Return the addresses of a motion of the plane, one of `CONTROLS` whose noise is the same at all times."""
    u = np.ones(len(motion.columns))
    D = motion.diffusion(u, dt_s)
    calls = (
        address_of(type(motion).moves, MOVE), address_of(steer_in_plane, STEER),
        address_of(CONTROLS[type(motion)], CONTROL), address_of(constant_errors, DISTURB),
        address_of(walk_in_plane, WALK),
    )  # fmt: skip
    sigmas = [np.sqrt(np.diagonal(cov)) for cov in (motion.control_noise(u), np.zeros((0, 0)) if D is None else D)]
    return calls, (motion.parameters, sigmas[0], sigmas[1])


def python_ways(motion: Any, dt_s: float) -> Ways:
    """Return the functions of any motion."""

    def walk(par: Array, r: Array, u: Array, moved: Array, z: Array) -> tuple[Array, int]:
        D = diffusion_of(motion, r, u, dt_s)
        return (moved, 0) if D is None else (disturb_state(motion, moved, correlated(D, z[: len(D)])), len(D))

    def impulse(control: Any, par: Array, r: Array, target: Array, limits: tuple[float, float], dt_s: float) -> Array:
        wanted = turn_in_plane(lambda par, v, w, dt_s: np.array([v, 0.0, w]), par, r, target, limits, max(dt_s, SLOW_S))
        change = wanted - motion.body_velocity(r)[0]
        return change if len(motion.columns) == 3 else change[[0, 2]]

    steer = turn_in_plane = python_form(steer_in_plane)
    if motion.space.world == "space":
        steer = lambda control, par, *where: steer_in_space(motion, *where)  # noqa: E731
    elif isinstance(motion, HasVelocity):
        steer = impulse
    calls = (
        lambda r, u, par, dt_s: motion.move(r, u, dt_s), steer,
        lambda par, *velocity: control_of_velocity(motion, *velocity),
        lambda par, u, z: correlated(motion.control_noise(u), z[: len(u)]), walk,
    )  # fmt: skip
    return calls, (NOTHING, NOTHING, NOTHING)


@compiled
def drive_leg(
    ways: Ways, course: tuple[Array, Array, tuple[float, float]], chance: tuple[Array, int], span: tuple[int, int],
    rules: tuple[float, bool], out: tuple[Array, Array, Array],
) -> tuple[int, int]:  # fmt: skip
    """Drive through a span of steps, or until the target is near; return the step, and how many z are used.

    `course` are the controls (steps, m), the target and the limits, `chance` standard normal numbers z and how many of
    them are used, `rules` the duration of a step and whether errors are the robot's.  Written are the states (steps +
    1, size), of which the first is given, the controls that the estimator is given, and those that are done (steps, m).
    """
    ((move, steer, control, disturb, walk), par), (controls, target, limits), (z, at), (dt_s, on_robot) = (
        ways, course, chance, rules,
    )  # fmt: skip
    states, told, done = out
    for k in range(span[0], span[1]):
        r = states[k]
        u = controls[k] if len(controls) else call_steer(steer, (control, par[0], r, target, limits, dt_s))
        wrong = u + call_disturb(disturb, (par[1], u, z[at:]))
        at += len(u)
        told[k], done[k] = (u, wrong) if on_robot else (wrong, u)
        moved, used = call_walk(walk, (par[2], r, done[k], call_move(move, (r, done[k], par[0], dt_s))[0], z[at:]))
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


def body_axes(state: Array, size: int) -> Array:
    """Return the matrix (size, size) from errors in the robot's frame to the world's; rates stay in the body's."""
    G = np.eye(size)
    if len(state) < 7:  # a velocity behind a pose of the plane is in the robot's frame anyway
        G[:2, :2] = rotation(state[2])
        return G
    Q = matrix(state[3:7].copy())
    for at in range(0, min(size, 9), 3):
        G[at : at + 3, at : at + 3] = Q
    return G
