"""Made-up events for a robot that stands in its world: what `Slam.warm_up` lets its twin take."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from kalmark.arrays import Array
from kalmark.events import Control, Event, Fix, Id, Scan
from kalmark.models.check import views
from kalmark.models.sensors import Spatial
from kalmark.slam.robot import Mount, Robot

ROUNDS = 12  # of a control and scans: enough for whatever waits for several
SEEN = 3  # observations in a scan
CREEP = 1e-3


def rehearsal(robots: Iterable[Robot]) -> Iterator[Event]:
    """Yield events of each robot and sensor: a few landmarks seen again and again, with ids and without, and a fix."""
    robots = list(robots)
    y = {id(mount): _measured(mount) for robot in robots for mount in robot.sensors.values()}
    ids: list[Id] = [f"seen {i}" for i in range(SEEN)]
    for k in range(ROUNDS):
        for robot in robots:
            pose = 2 if robot.motion.space.axes == 1 else 3
            yield Control(float(k), robot.name, np.full(len(robot.motion.columns), CREEP))
            for name, mount in robot.sensors.items():
                yield Scan(k + 0.25, robot.name, name, y[id(mount)], [f"{name} {i}" for i in ids])
                yield Scan(k + 0.5, robot.name, name, y[id(mount)])
            if k == ROUNDS - 2:
                yield Fix(k + 0.75, robot.name, np.asarray(robot.start)[:pose], np.eye(pose))


def _measured(mount: Mount) -> Array:
    """Return a few measurements (SEEN, m) that a sensor can make."""
    sensor, m = mount.sensor, len(mount.sensor.columns)
    v = views(sensor, np.random.default_rng(0))[0][:SEEN]
    y = np.tile([0.3 * (name == "size_m") for name in sensor.columns], (len(v), 1))
    e = sensor.expect(v, y)[0] if isinstance(sensor, Spatial) else sensor.expect(v)[0]
    return np.ascontiguousarray(np.reshape(e, (-1, m)), dtype=np.float64)
