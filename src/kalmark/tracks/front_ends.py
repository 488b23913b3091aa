"""The makers of scans of images: detectors of single images, front ends that search where landmarks are expected."""

from __future__ import annotations

from collections.abc import Set
from typing import Any, Protocol, runtime_checkable

from kalmark.arrays import Array
from kalmark.events import Frame, Id, Scan
from kalmark.filter.map import Map
from kalmark.report import Report
from kalmark.tracks.channel import Channel
from kalmark.tracks.track import Tracks


@runtime_checkable
class FrameDetector(Protocol):
    """A detector that finds landmarks in images."""

    def scan_of(self, frame: Frame) -> Scan:
        """Return the scan of what is found in a frame.  Raises EventError."""
        ...


class FrontEnd(Protocol):
    """Searches the frames of one sensor for the landmarks that it should see.

    One that `waits` begins when no other keeps first frames any more, as `beginning` of that has it; None: none kept.
    """

    waits: bool
    beginning: Any

    def recognised(self, image: Any, map_: Map, tracks: Tracks, channel: Channel) -> tuple[Array, Array] | None:
        """Return where the sensor is (7,), and the covariance (6, 6), if it was lost and has recognised the place."""
        ...

    def prospect_of(self, map_: Map, tracks: Tracks, channel: Channel, robot: str) -> Any:
        """Return the input of its search: the expected measurements of the landmarks in view."""
        ...

    def search(
        self, frame: Frame, image: Any, prospect: Any, beside: Any
    ) -> tuple[Scan, list[tuple[Id, str]], tuple[list[Id], float] | None]:
        """Return what was found in an image (H, W), and the landmarks that are given up, each with the reason.

        And, if a place seen again shows that, landmarks that have drifted with the sensor, and the factor by which the
        covariance of all these is too small.

        `beside` (H, W) is the depth of its pixels in m, 0 where there is none, or the right image of a pair, as the
        sensor has it; None: the sensor, or the frame, has none.
        """
        ...

    def update(self, report: Report, T: Array) -> None:
        """Update the views of landmarks by the report of the last frame; T (7,) is its sensor's pose."""
        ...

    def watch_beginning(self) -> None:
        """Keep the first frames, which alone move the map: together they may determine its start."""
        ...

    def settle(self) -> None:
        """Keep them no longer: something else has changed the map."""
        ...

    def survey(self, name: Id) -> None:
        """Search for a landmark known beforehand, too."""
        ...

    def frames_to_filter_again(self, prior: float) -> tuple[list[tuple[Scan, list[Id]]], dict[Id, float]] | None:
        """Return the frames so far, if they are to be filtered again, each with the landmarks removed before it.

        And inverse distances of landmarks, 1/m, at which these are to start then; their median is the `prior`.
        """
        ...

    def replace_poses(self, poses: list[Array], names: Set[Id]) -> None:
        """Set the poses (7,) of the sensor in all frames so far, one a frame, and remove all landmarks but `names`."""
        ...


@runtime_checkable
class SearchingDetector(Protocol):
    """A detector that searches images for landmarks where they are expected."""

    def front_end(self, sensor: Any) -> FrontEnd:
        """Return what searches the frames of a sensor."""
        ...
