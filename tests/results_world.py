"""A small simulated log that the tests of the results share."""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.events import Control, Event, Scan
from kalmark.filter.estimators import Invariant
from kalmark.logs.log import Log, PositionTrack, Trajectory
from kalmark.models.motion import Unicycle
from kalmark.models.sensors import RangeBearing
from kalmark.slam.robot import Mount, Robot
from kalmark.slam.slam import Slam

STEP_NS = 100_000_000


def circle(
    robots: tuple[str, ...] = ("rover",),
    steps: int = 120,
    landmarks: int = 12,
    seed: int = 1,
    truth: bool = True,
    gps: bool = False,
) -> Log:
    """Return a log of robots on one circle of 5 m radius, phases apart, with range and bearing to landmarks near it."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, landmarks)
    points = np.column_stack([np.cos(angle), np.sin(angle)]) * rng.uniform(3, 8, (landmarks, 1)) + [0.0, 5.0]
    events: list[Event] = []
    paths: dict[str, list[np.ndarray]] = {name: [start_of(robots, name)] for name in robots}
    for k in range(steps):
        for name in robots:
            v, w = 1.0, 0.2
            x, y, th = paths[name][-1]
            u = (v + 0.05 * rng.normal(), w + 0.02 * rng.normal())
            events.append(Control(t_ns=k * STEP_NS, robot=name, u=u))
            a = w * 0.1
            paths[name].append(
                np.array([x + v / w * (np.sin(th + a) - np.sin(th)), y - v / w * (np.cos(th + a) - np.cos(th)), th + a])
            )
            events.append(sight((k + 1) * STEP_NS, name, paths[name][-1], points, rng))
    events.sort(key=lambda e: (e.t_ns, isinstance(e, Scan)))
    t_ns = np.arange(steps + 1) * STEP_NS
    trajectories = {name: Trajectory(t_ns, np.array(path)) for name, path in paths.items()}
    tracks = {
        name: PositionTrack(t_ns[::3] + 7_000_000, path.poses[::3, :2] + [50.0, -20.0], np.zeros(2))
        for name, path in trajectories.items()
    }
    return Log(
        name="circle",
        robots=robots,
        events=events,
        truth=trajectories if truth else {},
        landmarks={i + 1: point for i, point in enumerate(points)} if truth else {},
        gps=tracks if gps else {},
    )


def start_of(robots: tuple[str, ...], name: str) -> np.ndarray:
    phase = 2 * np.pi * robots.index(name) / len(robots)
    return np.array([5 * np.sin(phase), 5 - 5 * np.cos(phase), phase])


def sight(t_ns: int, robot: str, pose: np.ndarray, points: np.ndarray, rng: np.random.Generator) -> Scan:
    d = points - pose[:2]
    distance = np.linalg.norm(d, axis=1)
    seen = np.flatnonzero((distance > 0.5) & (distance < 6.0))
    bearing = np.arctan2(d[seen, 1], d[seen, 0]) - pose[2] + 0.02 * rng.normal(size=len(seen))
    y = np.column_stack([distance[seen] + 0.05 * rng.normal(size=len(seen)), (bearing + np.pi) % (2 * np.pi) - np.pi])
    return Scan(t_ns=t_ns, robot=robot, sensor="lidar", y=y, ids=[int(i) + 1 for i in seen])


def slam_for(log: Log, start: Any = None, estimator: Any = None) -> Slam:
    """Return a Slam for the log, its robots at their true starts unless `start` is given."""
    return Slam(
        [
            Robot(
                name,
                Unicycle(sigma_v_mps=0.05, sigma_w_radps=0.02),
                start=start_of(log.robots, name) if start is None else start,
                sensors={"lidar": Mount(RangeBearing(sigma_range_m=0.05, sigma_bearing_rad=0.02))},
            )
            for name in log.robots
        ],
        estimator=estimator or Invariant(),
    )
