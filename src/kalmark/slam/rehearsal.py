"""Made-up events for the robots of a Slam: what `Slam.warm_up` lets its twin take."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.events import Control, Event, Fix, Id, Scan
from kalmark.filter.compressed.map import CompressedMap
from kalmark.geometry import frames, frames3d
from kalmark.models.check import views
from kalmark.models.protocols import (
    TWIST,
    Landmark,
    OfState,
    Reparametrizable,
    SeesVelocity,
    SegmentVisible,
    image_size,
)
from kalmark.models.sensors import Spatial
from kalmark.slam.estimate import Estimate
from kalmark.slam.robot import IDENTITY, Mount, Robot

ROUNDS = 12  # of a control and scans: enough for whatever waits for several
SEEN = 3  # observations in a scan
STEP_S = 0.5
MOVING = 0.5  # each number of a control
LOST_PIXELS = 0.2  # of an image, at its border


def without_detectors(robots: Iterable[Robot]) -> list[Robot]:
    """Return the robots with sensors that take measurements, not raw scans."""
    return [
        replace(robot, sensors={name: replace(mount, detector=None) for name, mount in robot.sensors.items()})
        for robot in robots
    ]


def rehearse(twin: Estimate, process: Callable[[Event], object]) -> list[tuple[Id, Array, Landmark]]:
    """Let a twin of a Slam take made-up events by `process`, and use all that they lead to.

    Return the landmarks that it has then: name, mean and model.
    """

    def pose(robot: str, sensor: str) -> Array:
        channel, slot = twin.state.channels.get((robot, sensor)), twin.state.moving[robot].slot
        return twin.map.mean(slot) if channel is None else channel.pose(twin.map, slot)

    for event in rehearsal(twin.robots.values(), pose):
        with suppress(Exception):  # it only tries; what is wrong shows when it is done in earnest
            process(event)
    tracks = [*twin.tracks.confirmed.values()]
    twin.covariance(*twin.robots, *twin.tracks.confirmed)
    found = [(track.id, twin.mean(track.id), track.model) for track in tracks]
    for track in tracks:
        if isinstance(track.model, Reparametrizable):
            track.model.to_point(twin.mean(track.id)[None])
    for track in tracks:
        twin.map.remove(track.slot)
    if isinstance(twin.map, CompressedMap):
        twin.map.finish()
    return found


def rehearsal(robots: Iterable[Robot], pose: Callable[[str, str], Array]) -> Iterator[Event]:
    """Yield events of each robot and sensor: a few landmarks seen again and again, with ids and without, and a fix.

    `pose` gives where a robot's sensor, both by name, is when it is asked, (3,) or (7,).
    """
    robots, t_s = list(robots), 0.0
    mounts = {(robot.name, name): mount for robot in robots for name, mount in robot.sensors.items()}
    readings = {key: _reading(m.sensor, len(m.at)) for key, m in mounts.items() if isinstance(m.sensor, OfState)}
    scenes = {key: _Scene(mount, pose(*key)) for key, mount in mounts.items() if key not in readings}
    for k in range(ROUNDS):
        for robot in robots:
            t_s += STEP_S
            yield Control(t_s, robot.name, np.full(len(robot.motion.columns), MOVING))
            for name in robot.sensors:
                if (robot.name, name) in readings:
                    t_s += STEP_S
                    yield Scan(t_s, robot.name, name, readings[robot.name, name])
                    continue
                y = scenes[robot.name, name].measured(pose(robot.name, name))
                for ids in ([f"{name} {i}" for i in range(len(y))], None):
                    t_s += STEP_S
                    yield Scan(t_s, robot.name, name, y, ids)
            if k == ROUNDS - 2:
                size = 2 if robot.motion.space.axes == 1 else 3
                yield Fix(t_s, robot.name, np.asarray(robot.start)[:size], np.eye(size))


def _reading(sensor: Any, pose: int) -> Array:
    """Return what a sensor of the state reads of a robot that stands at the origin; a pose has 3 or 7 numbers."""
    still = np.zeros((1, 3 if pose == 3 else 6))
    return np.asarray(sensor.expect(still if sensor.views == TWIST else np.array([IDENTITY[pose]]))[0])


class _Scene:
    """What a mounted sensor, at T in the beginning, sees: points that stay where they are, or always the same."""

    def __init__(self, mount: Mount, T: Array) -> None:
        self.sensor, rng = mount.sensor, np.random.default_rng(0)
        self.fixed: Array | None = None
        if isinstance(self.sensor, SegmentVisible) and (size := image_size(self.sensor)) is not None:
            inside = rng.uniform(LOST_PIXELS, 1.0 - LOST_PIXELS, (SEEN, len(self.sensor.columns)))
            self.fixed = inside * [*size, *size]
            return
        self.v = views(self.sensor, rng)[0][:SEEN].copy()
        self.places = None
        if len(T) == 3 or self.v.shape[1] == 3 or isinstance(self.sensor, SeesVelocity):
            here = frames.from_frame_many if len(T) == 3 else frames3d.from_frame_many
            self.places = here(T, np.ascontiguousarray(self.v[:, : 2 if len(T) == 3 else 3]))[0]

    def measured(self, T: Array) -> Array:
        """Return the measurements (SEEN, m) from T."""
        if self.fixed is not None:
            return self.fixed
        if self.places is not None:
            seen_from = frames.to_frame_many if len(T) == 3 else frames3d.to_frame_many
            self.v[:, : self.places.shape[1]] = seen_from(T, self.places)[0]
        y = np.tile([0.3 * (name == "size_m") for name in self.sensor.columns], (len(self.v), 1))
        e = self.sensor.expect(self.v, y)[0] if isinstance(self.sensor, Spatial) else self.sensor.expect(self.v)[0]
        return np.ascontiguousarray(e, dtype=np.float64)
