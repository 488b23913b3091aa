"""Sources of scans: makers of the scans of a sensor from its raw data, which may ask what the filter expects.

A detector with `scan_of` makes a scan of each event by itself.  One with `source` gives its sensor a source of its own,
which has a state: the attributes that its class annotates are saved with the map (`kalmark.codec`).
"""

from __future__ import annotations

from collections.abc import Set
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

from kalmark.arrays import Array
from kalmark.declare import is_own
from kalmark.events import Id, Raw, Scan
from kalmark.filter.map import Map
from kalmark.models.protocols import has_second_camera
from kalmark.report import Report
from kalmark.tracks.channel import Channel
from kalmark.tracks.track import Tracks


class FilterView(NamedTuple):
    """The part of the filter that a source reads: map, tracks, the channel of its sensor, the name of the robot."""

    map: Map
    tracks: Tracks
    channel: Channel
    robot: str

    @property
    def T(self) -> Array:
        """The sensor's pose (3,) or (7,) in the map's frame."""
        return self.channel.pose(self.map, self.tracks.slots[self.robot])


class Found(NamedTuple):
    """The result of a search in raw data: a scan, and the removed landmarks, each with the reason.

    `drifted` are landmarks that have drifted with the sensor, and the factor by which their covariance is too small.
    """

    scan: Scan
    removed: list[tuple[Id, str]]
    drifted: tuple[list[Id], float] | None = None


class BufferedScans(NamedTuple):
    """The scans so far, each with the landmarks given up before it, to be filtered again from the first one on.

    `rho` are inverse distances, 1/m, at which landmarks are to start then.
    """

    scans: list[tuple[Scan, list[Id]]]
    rho: dict[Id, float]


class Source(Protocol):
    """Makes scans of the raw data of one sensor, of the kind that it `takes`.

    It `begins` as long as it keeps its first scans for a `BufferedScans`; one that `waits` makes none until no other
    begins.
    """

    takes: ClassVar[type[Raw]]
    waits: ClassVar[bool]

    @property
    def begins(self) -> bool:
        """True if it keeps its first scans."""
        ...

    def read(self, raw: Any) -> Any:
        """Return the data of an event as the other methods take them.  Raises EventError."""
        ...

    def located(self, data: Any, view: FilterView) -> tuple[Array, Array] | None:
        """Return the pose (7,) of a lost sensor that has recognised the place, and its covariance (6, 6)."""
        ...

    def found(self, raw: Raw, data: Any, view: FilterView) -> Found:
        """Return the scan of the data of an event, to the time of which the filter has predicted."""
        ...

    def update(self, report: Report, view: FilterView) -> BufferedScans | None:
        """Update its state by the report of its last scan; return what is to be filtered again, None for nothing."""
        ...

    def replace_poses(self, poses: list[Array], names: Set[Id]) -> None:
        """Set the poses (7,) of the sensor at all scans so far, and remove all landmarks but `names`."""
        ...

    def settle(self) -> None:
        """Keep the first scans no longer: something else than they changes the map."""
        ...

    def survey(self, name: Id) -> None:
        """Search for a landmark known beforehand, too."""
        ...


@runtime_checkable
class RawDetector(Protocol):
    """A detector that finds landmarks in raw data of one kind, of each event by itself."""

    takes: ClassVar[type[Raw]]

    def scan_of(self, raw: Any) -> Scan:
        """Return the scan of what is found in an event.  Raises EventError."""
        ...


@runtime_checkable
class SearchingDetector(Protocol):
    """A detector that finds landmarks in raw data by what the filter expects."""

    def source(self, sensor: Any) -> Source:
        """Return the source of the scans of a sensor."""
        ...


def finds(detector: Any, sensor: Any) -> bool:
    """Return whether a detector's class may find what a sensor's measures: if both are kalmark's, by their columns.

    One that searches images takes the left one of a pair, too.
    """
    if not (is_own(detector) and is_own(sensor)):
        return True
    pair = issubclass(detector, SearchingDetector) and has_second_camera(sensor)
    return bool(pair or detector.columns[:2] == sensor.columns[:2])
