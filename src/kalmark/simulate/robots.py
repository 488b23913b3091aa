"""Move robots through a world and let them measure, with the models the filter uses.  [S] 4.1; [TB] SimRob, SimSen.

The guide disturbs the *estimator's* control and lets the robot move exactly (`noise_on: control`); with
`noise_on: robot` the robot is disturbed and the log holds what it was told.  Either way the log holds the control
the estimator is given.  A diffusion always disturbs the robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.random import Generator, SeedSequence
from scipy.spatial import cKDTree

from kalmark.config.classes import model_of
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose
from kalmark.logs.log import Log, Trajectory
from kalmark.models.landmarks import Point2D
from kalmark.simulate.routes import Driver
from kalmark.simulate.worlds import SimulatedRobot, World
from kalmark.slam.events import Control, Event, Id, Scan, order

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

_LOOK = Point2D()


@dataclass
class SimRobot:
    """A robot under way: its model, its true pose (3,), and what steers it."""

    name: str
    motion: Any
    pose: Array
    driver: Driver
    sensors: dict[str, tuple[Any, Array]]
    poses: list[Array] = field(default_factory=list)


@dataclass
class Landmarks:
    """The landmarks (M, 2|3), which of them were ever seen, and an index of where they are."""

    points: Array
    seen: npt.NDArray[np.bool_]
    tree: Any

    def near(self, place: Array, reach_m: float) -> Indices:
        """Return the landmarks within reach of a place (2,), in order."""
        if math.isinf(reach_m):
            return np.arange(len(self.points))
        return np.array(sorted(self.tree.query_ball_point(place, reach_m)), dtype=np.int64)


def simulate(world: World, seed: int | SeedSequence | Generator = 0) -> Log:
    """Return the log of one simulated run, with truth; the same seed gives the same log.

    Landmark ids are 1, 2, ... in the world's order.  A scan in which nothing is seen is left out.
    """
    layout, route, control, sight = np.random.default_rng(seed).spawn(4)
    landmarks = landmarks_of(world, layout)
    area = np.array([landmarks.points[:, :2].min(axis=0), landmarks.points[:, :2].max(axis=0)])
    robots = [sim_robot(name, robot, world.dt_s, area, route) for name, robot in world.robots.items()]
    times = [round(k * world.dt_s * 1e9) for k in range(world.steps + 1)]
    events: list[Event] = []
    for before, now in pairwise(times):
        for robot in robots:
            u = step(robot, world, control)
            events.append(Control(t_ns=before if robot.motion.held else now, robot=robot.name, u=u))
        for robot in robots:
            events += scans(robot, robots, landmarks, world, now, sight)
    return Log(
        name=world.name,
        robots=tuple(world.robots),
        events=sorted(events, key=order),
        format="simulated",
        truth={r.name: Trajectory(np.array(times), np.array([*r.poses, r.pose])) for r in robots},
        landmarks={i + 1: point[:2].copy() for i, point in enumerate(landmarks.points)},
        control_columns={r.name: r.motion.columns for r in robots},
        sensor_columns={(r.name, name): s.columns for r in robots for name, (s, _) in r.sensors.items()},
    )


def landmarks_of(world: World, rng: Generator) -> Landmarks:
    """Place the world's landmarks, with a signature each if a sensor measures signatures."""
    points = world.world.place(rng)
    if world.has_signatures:
        points = np.column_stack([points, rng.uniform(0.0, world.signature_max, len(points))])
    return Landmarks(points, np.zeros(len(points), dtype=np.bool_), cKDTree(points[:, :2]))


def sim_robot(name: str, robot: SimulatedRobot, dt_s: float, area: Array, rng: Generator) -> SimRobot:
    """Put a robot at its start, drawn from the start's Gaussian if it has sigmas."""
    start = robot.start
    motion = model_of(robot.motion)
    sigma = np.array([start.sigma_xy_m, start.sigma_xy_m, start.sigma_theta_rad])
    pose = np.array([start.x_m, start.y_m, start.theta_rad]) + sigma * rng.standard_normal(3)
    mounted = {key: (model_of(s), mount(s)) for key, s in robot.sensors.items()}
    return SimRobot(name, motion, pose, robot.route.driver(motion, dt_s, area, rng), mounted)


def mount(section: Any) -> Array:
    """Return a sensor's place (3,) on the robot."""
    return np.array([section.mount.x_m, section.mount.y_m, section.mount.theta_rad])


def step(robot: SimRobot, world: World, rng: Generator) -> Array:
    """Move a robot by one step and return the control that its estimator is given."""
    u = robot.driver(robot.pose)
    disturbed = u + gaussian(robot.motion.control_noise(u), rng)
    told, done = (disturbed, u) if world.noise_on == "control" else (u, disturbed)
    robot.poses.append(robot.pose)
    robot.pose, *_ = robot.motion.move(robot.pose, done, world.dt_s)
    Q = robot.motion.diffusion(done, world.dt_s)
    if Q is not None:
        robot.pose, *_ = compose(robot.pose, gaussian(Q, rng))
    return told


def scans(
    robot: SimRobot, robots: list[SimRobot], landmarks: Landmarks, world: World, t_ns: int, rng: Generator
) -> list[Event]:
    """Return the scans of a robot's sensors from its true pose."""
    events: list[Event] = []
    others = [r for r in robots if r is not robot] if world.sight_robots else []
    for name, (sensor, at) in robot.sensors.items():
        T, *_ = compose(robot.pose, at)
        seen = visible(sensor, T, landmarks, world, rng)
        ids: list[Id] = [int(i) + 1 for i in seen] + [r.name for r in others]
        points = np.concatenate([landmarks.points[seen], *(r.pose[None, :2] for r in others)])
        v, *_ = _LOOK.seen_from(T, points)
        keep = sensor.sees(v)
        y = measure(sensor, v[keep], rng)
        real = np.flatnonzero((y[:, 0] >= 0) | (sensor.columns[0] != "range_m"))  # noise took the others below zero
        if len(real):
            kept = [ids[i] for i in np.flatnonzero(keep)[real]]
            events.append(Scan(t_ns=t_ns, robot=robot.name, sensor=name, y=y[real], ids=kept if world.ids else None))
    return events


def visible(sensor: Any, T: Array, landmarks: Landmarks, world: World, rng: Generator) -> Indices:
    """Return the landmarks that a sensor at pose T reports, in order, and note them as seen."""
    near = landmarks.near(T[:2], sensor.range_max_m)
    v, *_ = _LOOK.seen_from(T, landmarks.points[near])
    inside = sensor.sees(v)
    near, distance = near[inside], np.hypot(v[inside, 0], v[inside, 1])
    if world.new_per_step is not None:
        new = np.flatnonzero(~landmarks.seen[near])
        kept = np.union1d(np.flatnonzero(landmarks.seen[near]), rng.permutation(new)[: world.new_per_step])
        near, distance = near[kept], distance[kept]
    if world.max_per_scan is not None:
        near = np.sort(near[np.argsort(distance, kind="stable")[: world.max_per_scan]])
    landmarks.seen[near] = True
    return near


def measure(sensor: Any, v: Array, rng: Generator) -> Array:
    """Return noisy measurements (K, m) of points v (K, d) in the sensor's frame, angles wrapped."""
    if len(v) == 0:
        return np.empty((0, len(sensor.columns)))
    e, _ = sensor.expect(v)
    y = e + gaussian(sensor.noise(e), rng)
    return np.where(sensor.angular, wrap(y), y)


def gaussian(cov: Array, rng: Generator) -> Array:
    """Draw from zero-mean Gaussians with positive semidefinite covariances (..., n, n)."""
    variances = np.einsum("...ii->...i", cov)
    if np.count_nonzero(cov) == np.count_nonzero(variances):
        return np.sqrt(variances) * rng.standard_normal(variances.shape)
    variances, axes = np.linalg.eigh(cov)
    draw = np.sqrt(np.maximum(variances, 0.0)) * rng.standard_normal(variances.shape)
    return np.einsum("...ij,...j->...i", axes, draw)
