"""Made-up events for the robots of a Slam: what `Slam.warm_up` lets its twin take."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from kalmark.arrays import Array
from kalmark.association import ByIdentity
from kalmark.association.global_start import search
from kalmark.events import Control, Event, Fix, Id, Scan
from kalmark.filter import kernels
from kalmark.filter.compressed.compressed_map import CompressedMap
from kalmark.filter.compressed.restoring import NUMBERS
from kalmark.filter.compressed.storage import Triangle
from kalmark.filter.map import StochasticMap
from kalmark.geometry.pose_frames import FRAMES
from kalmark.geometry.spaces import VECTOR, VECTOR3
from kalmark.management.repeated_places import find_repeats
from kalmark.models.landmark_views import Spatial
from kalmark.models.landmarks import Point2D
from kalmark.models.model_check import views
from kalmark.models.protocols import (
    TWIST,
    Landmark,
    OfState,
    Reparametrizable,
    SeesVelocity,
    measures_blocks,
    sample_segments,
)
from kalmark.slam.estimate import Estimate
from kalmark.slam.merging import make_equal
from kalmark.slam.robot import IDENTITY, Mount, Robot
from kalmark.tracks.known_landmarks import Known
from kalmark.tracks.track import ChannelKey, Track, Tracks

ROUNDS = 12  # of a control and scans: enough for whatever waits for several
SEEN = 3  # observations in a scan
STEP_S = 0.5
INTERVAL = 5  # events in a compression interval
REPEATS = 4  # scans of one landmark, while all others are inactive
POINTS = ((VECTOR,), (VECTOR3,))
MOVING = 0.5  # each number of a control


def without_detectors(robots: Iterable[Robot]) -> list[Robot]:
    """Return the robots with sensors that take measurements, not raw scans."""
    return [
        replace(robot, sensors={name: replace(mount, detector=None) for name, mount in robot.sensors.items()})
        for robot in robots
    ]


@runtime_checkable
class CompilingDetector(Protocol):
    """A detector that compiles what it needs before its first scan."""

    def warm_up(self) -> None:
        """Compile it."""


def warm_up_detectors(robots: Iterable[Robot]) -> None:
    """Let the detectors of robots compile what they need."""
    for robot in robots:
        for mount in robot.sensors.values():
            if isinstance(mount.detector, CompilingDetector):
                mount.detector.warm_up()


def process_made_up_events(
    twin: Estimate, process: Callable[[Event], object], add: Callable[..., None]
) -> list[tuple[Id, Array, Landmark]]:
    """Let a twin of a Slam take made-up events by `process`, and use all that they lead to; `add` adds landmarks.

    Return the landmarks that it has then: name, mean and model.
    """

    def pose(robot: str, sensor: str) -> Array:
        channel, slot = twin.state.channels.get((robot, sensor)), twin.state.moving[robot].slot
        return twin.map.mean(slot) if channel is None else channel.pose(twin.map, slot)

    kernels.are_covariances(np.eye(1)[None], 0.0)  # as of an event with noise of its own
    for k, event in enumerate(made_up_events(twin.robots.values(), pose)):
        with suppress(Exception):  # it only tries; what is wrong shows when it is done in earnest
            process(event)
        if k % INTERVAL == INTERVAL - 1 and isinstance(twin.map, CompressedMap):
            twin.map.full_update()  # what comes next activates some blocks again, not all
    _add_landmarks(twin, process, pose, add)
    with suppress(Exception):
        _observe_all(twin, process)
    _merge(twin)
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
    elif isinstance(twin.map, StochasticMap):  # it may grow
        CompressedMap.from_dense(twin.map, Triangle(NUMBERS[twin.state.settings.numbers]))
    return found


def _add_landmarks(
    twin: Estimate, process: Callable[[Event], object], pose: Callable[[str, str], Array], add: Callable[..., None]
) -> None:  # fmt: skip
    """Start landmarks of each sensor at its pose, and add points of its kinds, which other landmarks may become."""
    for key, channel in [*twin.state.channels.items()]:
        scene = _Scene(twin.robots[key[0]].sensors[key[1]], pose(*key))
        with suppress(Exception):
            y = scene.measured(pose(*key))
            process(_scan(twin, key, y, [f"{key} {k}" for k in range(len(y))]))
        for kind, model in channel.models.items():
            if model.landmark.space.kinds in POINTS and scene.points is not None:
                for k, place in enumerate(scene.points):
                    with suppress(Exception):
                        add(f"{key} {kind} {k}", place, 0.01 * np.eye(len(place)), model.landmark)


def _observe_all(twin: Estimate, process: Callable[[Event], object]) -> None:
    """Let each sensor observe what it can, of what others have begun, too, as it is expected.

    First one landmark in view again and again, while the others are inactive, then all of them together, then twice in
    a scan without ids, so that an association has to decide; then each alone, in view or not.
    """
    for key in [*twin.state.channels]:
        asked = twin.expect(*key)
        finite = np.isfinite(asked.e).all(axis=1)
        seen = np.flatnonzero(finite & asked.in_view)
        scans = [seen[:1]] * REPEATS + [seen, np.repeat(seen, 2), *np.flatnonzero(finite)[:, None]]
        for k, rows in enumerate(scans):
            ids = None if k == REPEATS + 1 else [asked.names[i] for i in rows]
            with suppress(Exception):
                process(_scan(twin, key, asked.e[rows], ids))
            if k % 2 and isinstance(twin.map, CompressedMap):
                twin.map.full_update()


def _scan(twin: Estimate, key: ChannelKey, y: Array, ids: list[Id] | None) -> Scan:
    """Return a scan of a robot's sensor that comes next."""
    return Scan(t_ns=(twin.t_ns or 0) + 1, robot=key[0], sensor=key[1], y=y, ids=ids)


def _merge(twin: Estimate) -> None:
    """Make two landmarks equal, as where observations have no ids: through a model in Python; search for places."""
    for (robot, sensor), policy in twin.state.policies.items():
        channel = twin.state.channels[robot, sensor]
        if isinstance(policy.association, ByIdentity):
            continue
        _search_places()
        mine = [track.id for track in twin.tracks.confirmed.values() if track.model.kind == channel.landmark.kind]
        if policy.upkeep.merge and len(mine) > 1:
            with suppress(Exception):
                make_equal(twin.state, channel, twin.state.moving[robot].slot, [(mine[0], mine[1])])


def _search_places() -> None:
    """Search a map in which a place is twice, and the pose from which its landmarks are seen."""
    map_, tracks, places = StochasticMap(), Tracks([]), np.random.default_rng(0).uniform(0.0, 9.0, (9, 2))
    point, known = Point2D(), Known(Point2D())
    for x in (0, 20):
        names = [f"u{x + k}" for k in range(len(places))]
        for name, place in zip(names, places + x, strict=True):
            slot = map_.add(point.space, place, 1e-4 * np.eye(2))
            tracks.confirm(Track(name, point, slot, covisible={*names}))
            known.add(name, place)
    find_repeats(map_, tracks)
    search(known, places, np.full(len(places), 0.01))


def made_up_events(robots: Iterable[Robot], pose: Callable[[str, str], Array]) -> Iterator[Event]:
    """Yield events of each robot and sensor: a few landmarks seen again and again, with ids and without, and a fix.

    `pose` gives where a robot's sensor, both by name, is at the time of the call, (3,) or (7,).
    """
    robots, t_s = list(robots), 0.0
    mounts = mounts_to_warm_up(robots)
    readings = {key: _reading(m.sensor, len(m.at)) for key, m in mounts.items() if isinstance(m.sensor, OfState)}
    scenes = {key: _Scene(mount, pose(*key)) for key, mount in mounts.items() if key not in readings}
    for k in range(ROUNDS):
        for robot in robots:
            t_s += STEP_S
            yield Control(t_s, robot.name, np.full(len(robot.motion.columns), MOVING))
            for _, name in (key for key in mounts if key[0] == robot.name):
                if (robot.name, name) in readings:
                    t_s += STEP_S
                    yield Scan(t_s, robot.name, name, readings[robot.name, name])
                    continue
                y = scenes[robot.name, name].measured(pose(robot.name, name))
                for ids in ([f"{name} {i}" for i in range(len(y))], None):
                    t_s += STEP_S
                    yield Scan(t_s, robot.name, name, y, ids)
            if k == ROUNDS - 2:
                d = robot.motion.space.d
                yield Fix(t_s, robot.name, np.asarray(robot.start)[:d], np.eye(d))


def mounts_to_warm_up(robots: Iterable[Robot]) -> dict[ChannelKey, Mount]:
    """Return the mounts of robots by their names, but those of sensors of blocks, which compile nothing."""
    every = {(robot.name, name): mount for robot in robots for name, mount in robot.sensors.items()}
    return {key: mount for key, mount in every.items() if not measures_blocks(mount.sensor)}


def _reading(sensor: Any, pose: int) -> Array:
    """Return what a sensor of the state reads of a robot that stands at the origin; a pose has 3 or 7 numbers."""
    still = np.zeros((1, 3 if pose == 3 else 6))
    return np.asarray(sensor.expect(still if sensor.views == TWIST else np.array([IDENTITY[pose]]))[0])


class _Scene:
    """The scene of a mounted sensor, at T in the beginning: points that stay where they are, or constant views."""

    def __init__(self, mount: Mount, T: Array) -> None:
        self.sensor, rng = mount.sensor, np.random.default_rng(0)
        self.fixed: Array | None = None
        self.places: Array | None = None  # where the points are that stay, (SEEN, 2 or 3),
        self.points: Array | None = None  # and others that it observes
        if (segments := sample_segments(self.sensor)) is not None:
            self.fixed = segments(rng, SEEN)
            return
        self.v = views(self.sensor, rng)[0][:SEEN].copy()
        d, numbers = 2 if len(T) == 3 else 3, self.v.shape[1]
        if d == 2 or numbers in (3, 4) or isinstance(self.sensor, SeesVelocity):
            rays = numbers == d + 1 == 4
            v = self.v[:, :d] / self.v[:, 3:] if rays else self.v[:, :d]
            self.points = FRAMES[len(T)].from_frame_many(T, np.ascontiguousarray(v))[0]
            self.places = None if rays else self.points

    def measured(self, T: Array) -> Array:
        """Return the measurements (SEEN, m) from T."""
        if self.fixed is not None:
            return self.fixed
        if self.places is not None:
            self.v[:, : self.places.shape[1]] = FRAMES[len(T)].to_frame_many(T, self.places)[0]
        y = np.tile([0.3 * (name == "size_m") for name in self.sensor.columns], (len(self.v), 1))
        e = self.sensor.expect(self.v, y)[0] if isinstance(self.sensor, Spatial) else self.sensor.expect(self.v)[0]
        return np.ascontiguousarray(e, dtype=np.float64)
