"""One scan with the map and tracks that it is compared with, read-only: only `Slam` changes these."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.events import Id, Scan
from kalmark.filter.estimators import Estimator, Update
from kalmark.filter.map import Map
from kalmark.geometry.spaces import Space
from kalmark.report import Report
from kalmark.tracks.channel import Channel, ObservationModel, Parts
from kalmark.tracks.classes import add_report
from kalmark.tracks.clones import Clones, Measurement
from kalmark.tracks.track import ChannelKey, Tracks

FEWEST_RANGES = 4  # distances of space by which a place is one


class Start(NamedTuple):
    """A block to be added to the map, computed from blocks that are in it: mean, covariance G P G' + Q.  [S] (35)-(38).

    The columns of G are the rows of the `parts`, one after the other.
    """

    space: Space
    mean: Array
    parts: Parts
    G: Array
    Q: Array

    @property
    def is_finite(self) -> bool:
        """True if all its numbers are finite."""
        return bool(np.isfinite(self.mean).all() and np.isfinite(self.G).all() and np.isfinite(self.Q).all())


@dataclass(slots=True, eq=False)
class ScanContext:
    """A scan of K observations with their ids and noise R (K, p, p), and the state it is read against.

    `y` are the measurements (K, m), `key` are robot and sensor, `robot` is the slot of the robot that observes,
    `report` the answer that is being made.  A robot is `adrift` while a gap leaves its heading unknown.
    """

    map: Map
    tracks: Tracks
    clones: Clones
    estimator: Estimator
    channel: Channel
    robot: int
    event: Scan
    ids: tuple[Id | None, ...]
    R: Array
    report: Report = field(repr=False)
    adrift: bool = False
    y: Array = field(init=False, repr=False)
    key: ChannelKey = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.y, self.key = self.event.y, (self.event.robot, self.event.sensor)

    @property
    def reported(self) -> tuple[str | None, ...] | None:
        """The class that the sensor reports of each observation (K,); None where it reports none, or none count."""
        return self.event.classes if self.channel.classes is not None else None

    def class_distances(self, names: Sequence[Id], tentative: bool = False) -> tuple[Array, Array]:
        """Return by how much the class that is reported adds to d2 of each pair (K, L), and of new landmarks (K,)."""
        tracks = self.tracks.tentative if tentative else self.tracks.confirmed
        if self.reported is None or self.channel.classes is None:
            return np.zeros((len(self.y), len(names))), np.zeros(len(self.y))
        known = [tracks[name].classes if name in tracks else {} for name in names]
        return self.channel.classes.distances(self.reported, known)

    def add_reports(self, names: Sequence[Any], rows: Iterable[int], used: Iterable[bool]) -> None:
        """Add the classes that the observations `rows` (K,) report to their landmarks, where they were `used`."""
        reported, classes = self.event.classes, self.channel.classes
        if reported is None or classes is None:
            return
        for name, k, fused in zip(names, rows, used, strict=True):
            track = self.tracks.confirmed.get(name) or self.tracks.tentative.get(name)
            if fused and track is not None:
                add_report(track.classes, classes, reported[k])

    @property
    def own_noise(self) -> bool:
        """True if the scan came with its own noise."""
        return self.event.cov is not None

    @property
    def locates(self) -> bool:
        """True if the scan determines where its robot is."""
        ids, channel = self.event.ids, self.channel
        enough = not channel.gives_distances or len(self.y) >= FEWEST_RANGES
        return channel.locates or (channel.locates_by_ids and enough and ids is not None and None not in ids)

    @property
    def noise_varies(self) -> bool:
        """True if the noise of an observation depends on where its landmark is."""
        return self.channel.noise_at is not None and self.event.cov is None

    @property
    def dimensions(self) -> int:
        """2 in the plane, 3 in space."""
        return self.channel.dimensions

    def pose(self) -> Array:
        """Return the pose of the sensor as it is estimated now, (3,) or (7,)."""
        return self.channel.pose(self.map, self.robot)

    def distances(self) -> tuple[Array, Array]:
        """Return the distances (K,) that observations of a sensor stand for, and their sigmas (K,)."""
        sensor = self.channel.calibrated(self.map)
        r = np.maximum(sensor.distances(self.y), 1e-3)
        ahead = np.zeros((len(r), self.dimensions))
        ahead[:, 0] = r
        slopes = np.linalg.norm(sensor.expect(ahead)[1][:, 0], axis=1)
        return r, np.sqrt(self.R[:, 0, 0]) / slopes

    def places(self) -> tuple[Array, Array]:
        """Return where observations are from a sensor that gives places (K, 2 or 3), and their sigmas (K,)."""
        d = self.dimensions
        v, V = (a[:, :d] for a in self.channel.calibrated(self.map).invert(self.y))
        return v, np.sqrt(np.trace(V @ self.R @ V.swapaxes(1, 2), axis1=1, axis2=2) / d)

    def size_of(self, k: int) -> float | None:
        """Return the size of the tag of the k-th observation, m, if its sensor measures one."""
        return float(self.y[k, -1]) if "size_m" in self.channel.sensor.columns else None

    def noise(self, model: ObservationModel, slots: Index, rows: Index | list[int]) -> Array:
        """Return the noise (M, p, p) of the observations `rows` if they are of the blocks `slots` (M,)."""
        return self.channel.noise(self.map, self.robot, model, slots, self.R[rows], self.own_noise)

    def noise_of(self, model: ObservationModel, l: Array, rows: Index | list[int]) -> Array:
        """Return the noise (M, p, p) of the observations `rows` if they are of the landmarks l (M, n)."""
        return self.channel.noise_of(self.map, self.robot, model, l, self.R[rows], self.own_noise)

    def predict(self, model: ObservationModel, slots: Index, rows: Index | list[int]) -> tuple[Array, Array, Array]:
        """Return Z (M, p, p), d2 (M,) and the noise (M, p, p) of the observations `rows` of the blocks `slots` (M,)."""
        R = self.noise(model, slots, rows)
        return *self.channel.predict(self.map, self.robot, model, slots, self.y[rows], R), R

    def update(self, model: ObservationModel, slots: Index, rows: list[int]) -> Update:
        """Return the correction by the observations `rows` of the blocks `slots` (K,)."""
        y, R = (self.y, self.R) if len(rows) == len(self.y) else (self.y[rows], self.R[rows])
        R = self.channel.noise(self.map, self.robot, model, slots, R, self.own_noise)
        R, second = self._weighed(model, slots, y, R), self.channel.second(self.robot)
        parallax = not self.channel.finds_depth
        return Update(model.model, self.robot, second, slots, model.d, y, R, self.channel.gate, parallax)

    def known_update(self, model: ObservationModel, l: Array, rows: list[int]) -> Update:
        """Return the correction by the observations `rows` of the landmarks l (K, n), which are known exactly."""
        y, slots = np.concatenate([self.y[rows], l], axis=1), np.full(len(rows), self.robot)
        R = np.ascontiguousarray(self.noise_of(model, l, rows))
        exactly, second = model.exactly, self.channel.second(self.robot)
        R = self._weighed(exactly, slots, y, R)
        return Update(exactly.model, self.robot, second, slots, exactly.d, y, R, self.channel.gate)

    def _weighed(self, model: ObservationModel, slots: Index, y: Array, R: Array) -> Array:
        """Return the noise (K, p, p) with which outliers count less, where that is wanted."""
        how = self.channel.robust
        if how is None:
            return R
        return model.weighed(*self.map.marginal(self.robot, self.channel.second(self.robot), slots), y, R, how)

    def start_of(self, k: int, which: int = 0, way: float = 0.0) -> Start:
        """Return the landmark that explains the k-th observation; of two that do, `which`.

        The nearest one of a prior of its depth is at least at twice a `way`.
        """
        R = self.R[k]
        if self.event.cov is not None and self.channel.start_noise is not None:
            R = np.broadcast_to(self.event.cov, (len(self.y), *self.event.cov.shape[-2:]))[k]
        l, L_h, Q = self.channel.landmark_of(
            self.map, self.robot, self.y[k : k + 1], R, self.own_noise, which, self.ids[k], way
        )
        G = self.estimator.pose_jacobian(self.map, self.robot, L_h)
        return Start(self.channel.landmark.space, l, self.channel.parts(self.map, self.robot), G, Q)

    def measurement(self, k: int, clone: int) -> Measurement:
        """Return the k-th observation as made from a cloned pose."""
        return Measurement(clone, self.event.t_ns, *self.key, k, self.y[k], self.R[k], self.own_noise)
