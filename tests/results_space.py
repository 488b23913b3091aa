"""A small simulated log in space that the tests of the results share: a robot that climbs a spiral among points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

import kalmark as km
from kalmark.events import Control, Event, Scan
from kalmark.geometry.frames3d import compose, move, to_frame
from kalmark.geometry.rotations import exp, from_euler
from kalmark.logs.log import Log, Trajectory
from kalmark.models.cameras import project_pinhole

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


@dataclass(frozen=True)
class Eye:
    """A pin-hole camera written by a user."""

    width_px: float = 640.0
    height_px: float = 480.0
    fx_px: float = 320.0
    fy_px: float = 320.0
    cx_px: float = 320.0
    cy_px: float = 240.0
    sigma_px: float = 1.0
    columns: ClassVar[tuple[str, ...]] = ("u_px", "v_px")
    angular: ClassVar[tuple[bool, ...]] = (False, False)

    def expect(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k = np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px])
        return project_pinhole(np.ascontiguousarray(v), k, np.zeros(0))

    def noise(self, y: np.ndarray) -> np.ndarray:
        return np.tile(self.sigma_px**2 * np.eye(2), (len(y), 1, 1))


FORWARD = np.array([0.2, 0.0, 0.3, *from_euler(np.array([-np.pi / 2, 0.0, -np.pi / 2]))[0]])


def with_camera(log: Log, wrong: int | None = None) -> tuple[km.Slam, Log]:
    """Return a filter with laser and camera, and a log in which the camera, too, sees what is in its image.

    The camera's measurements of the landmark `wrong` are 60 pixels off.
    """
    rng, eye = np.random.default_rng(7), Eye()
    points = np.array(list(log.landmarks.values()))
    events: list[Event] = []
    for event in log.events:
        events.append(event)
        if isinstance(event, Scan):
            T = compose(log.truth[event.robot].at(event.t_ns), FORWARD)[0]
            v = to_frame(T, points)[0]
            y = eye.expect(v)[0]
            seen = np.flatnonzero((v[:, 2] > 0.5) & (y > 0).all(axis=1) & (y < [640, 480]).all(axis=1))
            seen = np.array([k for k in seen if k + 1 in event.ids], dtype=int)
            y = y[seen] + rng.normal(size=(len(seen), 2)) + np.where(seen + 1 == wrong, 60.0, 0.0)[:, None]
            events.append(Scan(t_ns=event.t_ns, robot=event.robot, sensor="eye", y=y, ids=(seen + 1).tolist()))
    slam = slam_for(log)
    robots = [
        km.Robot(r.name, r.motion, r.start, {**r.sensors, "eye": km.Mount(eye, FORWARD)}) for r in slam.robots.values()
    ]
    return km.Slam(robots, km.association.ByIdentity(0.999)), replace(log, events=events)
