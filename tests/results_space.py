"""A small simulated log in space that the tests of the results share: a robot that climbs a spiral among points."""

from __future__ import annotations

from typing import Any

import numpy as np

import kalmark as km
from kalmark.geometry.frames3d import compose, move, to_frame
from kalmark.geometry.rotations import exp
from kalmark.logs.log import Log, Trajectory
from kalmark.slam.events import Control, Event, Scan

STEP_NS = 100_000_000
U = np.array([0.1, 0.0, 0.004, 0.0, 0.0, 0.02])
START = np.array([5.0, 0.0, 0.0, *exp(np.array([0.0, 0.0, np.pi / 2]))])
SIGMA = (0.003, 0.003, 0.003, 0.002)
NOISE = (0.05, 0.01, 0.01)
MOUNT = np.concatenate([[0.2, 0.0, 0.3], exp(np.array([0.0, 0.1, 0.0]))])


def spiral(robots: tuple[str, ...] = ("rover",), steps: int = 80, landmarks: int = 20, seed: int = 1) -> Log:
    """Return a log of robots on one spiral, each a little behind, with range, azimuth and elevation of points."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-8, -8, -1], [8, 8, 3], (landmarks, 3))
    events: list[Event] = []
    poses: dict[str, list[np.ndarray]] = {}
    for behind, name in enumerate(robots):
        pose = START
        for _ in range(10 * behind):
            pose = move(pose, -U)[0]
        poses[name] = [pose]
        for k in range(1, steps + 1):
            pose = move(pose, U)[0]
            poses[name].append(pose)
            noise = rng.normal(size=6) * np.repeat([SIGMA[0], SIGMA[3]], 3)
            events.append(Control(t_ns=k * STEP_NS, robot=name, u=U + noise))
            events.append(sight(k * STEP_NS, name, pose, points, rng))
    events.sort(key=lambda e: (e.t_ns, isinstance(e, Scan)))
    t_ns = np.arange(steps + 1) * STEP_NS
    truth = {name: Trajectory(t_ns, np.array(path)) for name, path in poses.items()}
    return Log("spiral", robots, events, truth=truth, landmarks={i + 1: p for i, p in enumerate(points)})


def sight(t_ns: int, robot: str, pose: np.ndarray, points: np.ndarray, rng: np.random.Generator) -> Scan:
    v = to_frame(compose(pose, MOUNT)[0], points)[0]
    seen = np.flatnonzero(np.linalg.norm(v, axis=1) < 8.0)
    y = km.sensors.RangeBearing3D().expect(v[seen])[0] + rng.normal(size=(len(seen), 3)) * NOISE
    return Scan(t_ns=t_ns, robot=robot, sensor="lidar", y=y, ids=[int(i) + 1 for i in seen])


def slam_for(log: Log, start: Any = None, **options: Any) -> km.Slam:
    """Return a Slam for the log, its robots at their true starts unless `start` is given."""
    lidar = km.Mount(km.sensors.RangeBearing3D(*NOISE), MOUNT)
    starts = {name: log.truth[name].poses[0] if start is None else start for name in log.robots}
    robots = [km.Robot(name, km.motion.Odometry3D(*SIGMA), starts[name], {"lidar": lidar}) for name in log.robots]
    return km.Slam(robots, **options)
