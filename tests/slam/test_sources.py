"""Sources of scans: raw data of a user's own kind, searched with what the filter expects, without any image."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import kalmark as km
from kalmark.events import Id, Raw, kind_of, sort_key
from kalmark.slam.sources import FilterView, Found


@dataclass(frozen=True, eq=False)
class Sweep(Raw):
    """Ranges and bearings (K, 2) of a sweep, without ids."""

    t_ns: int
    robot: str
    sensor: str
    y: np.ndarray


class Nearest:
    """A detector that names what it finds by the landmark that is expected nearest to it."""

    def source(self, sensor: Any) -> NearestSource:
        return NearestSource()


class NearestSource:
    """Its source: the number of names given, and how often each was found."""

    takes: ClassVar[type[Raw]] = Sweep
    waits: ClassVar[bool] = False
    begins: ClassVar[bool] = False
    named: int
    times: dict[Id, int]

    def __init__(self) -> None:
        self.named, self.times, self.settled, self.surveyed = 0, {}, 0, list[Id]()

    def read(self, raw: Sweep) -> np.ndarray:
        return raw.y

    def located(self, data: Any, view: FilterView) -> None:
        """It is never lost."""

    def found(self, raw: Raw, data: Any, view: FilterView) -> Found:
        names = [*self.times]
        slots = view.tracks.slots_of(names)
        places, T = view.map.means(slots, 2), view.T
        ids: list[Id] = []
        for r, a in data:
            at = T[:2] + r * np.array([np.cos(T[2] + a), np.sin(T[2] + a)])
            distance = np.linalg.norm(places - at, axis=1)
            if names and distance.min() < 1.0:
                ids.append(names[int(distance.argmin())])
            else:
                self.named += 1
                ids.append(f"s{self.named}")
        return Found(km.Scan(t_ns=raw.t_ns, robot=raw.robot, sensor=raw.sensor, y=data, ids=ids), [])

    def update(self, report: km.Report, view: FilterView) -> None:
        for o in report.observations:
            if o.landmark is not None:
                self.times[o.landmark] = self.times.get(o.landmark, 0) + 1

    def replace_poses(self, poses: list[np.ndarray], names: Set[Id]) -> None:
        """It begins nothing."""

    def settle(self) -> None:
        self.settled += 1

    def survey(self, name: Id) -> None:
        self.surveyed.append(name)


def robot(detector: Any) -> km.Robot:
    sensors = {"sonar": km.Mount(km.sensors.RangeBearing(), detector=detector)}
    return km.Robot("boat", km.motion.Unicycle(), (0, 0, 0), sensors, np.diag([0.1, 0.1, 0.01]))


POSTS = np.array([[5.0, 1.0], [4.0, -3.0]])


def seen(x: float) -> np.ndarray:
    """Return the posts (2, 2) from a place on the x axis, along it."""
    v = POSTS - [x, 0.0]
    return np.column_stack([np.hypot(*v.T), np.arctan2(v[:, 1], v[:, 0])])


def drive(slam: km.Slam, first: int, last: int, scan: Any) -> None:
    for k in range(first, last):
        slam.process(km.Control(t_s=k * 1.0, robot="boat", u=(0.5, 0.0)))
        slam.process(scan(t_ns=k * 10**9, robot="boat", sensor="sonar", y=seen(0.5 * k)))


def test_a_source_makes_scans_of_raw_data_by_what_the_filter_expects() -> None:
    one, other = km.Slam(robot(Nearest())), km.Slam(robot(None))
    drive(one, 0, 6, Sweep)
    drive(other, 0, 6, lambda **event: km.Scan(ids=("s1", "s2"), **event))
    assert one.state.sources["boat", "sonar"].times == {"s1": 6, "s2": 6}  # type: ignore[attr-defined]
    for name in ("boat", "s1", "s2"):
        np.testing.assert_array_equal(one.mean(name), other.mean(name))
    np.testing.assert_array_equal(one.covariance("boat", "s1", "s2"), other.covariance("boat", "s1", "s2"))


def test_a_source_hears_of_controls_and_of_landmarks_known_beforehand() -> None:
    slam = km.Slam(robot(Nearest()))
    source: Any = slam.state.sources["boat", "sonar"]
    slam.add_landmark("post", POSTS[0], 0.1 * np.eye(2))
    assert (source.surveyed, source.settled) == (["post"], 1)
    drive(slam, 0, 1, Sweep)
    assert source.settled == 2, "its own events do not settle it"


def test_the_state_of_a_source_is_saved_by_its_annotations_and_goes_on_bit_for_bit(tmp_path: Path) -> None:
    slam = km.Slam(robot(Nearest()))
    drive(slam, 0, 3, Sweep)
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk", robots=[robot(Nearest())])
    for each in (slam, again):
        drive(each, 3, 6, Sweep)
    one, other = (each.state.sources["boat", "sonar"] for each in (slam, again))
    assert (one.named, one.times) == (other.named, other.times) == (2, {"s1": 6, "s2": 6})  # type: ignore[attr-defined]
    np.testing.assert_array_equal(slam.covariance("boat", "s1"), again.covariance("boat", "s1"))


def test_raw_data_are_ordered_like_scans_and_refused_without_a_detector_for_them() -> None:
    sweep = Sweep(10**9, "boat", "sonar", seen(0.5))
    scan = km.Scan(t_ns=10**9, robot="boat", sensor="sonar")
    assert sort_key(sweep) == sort_key(scan)
    assert kind_of(sweep) == ("Sweep", "boat", "sonar")
    slam = km.Slam(robot(None))
    with pytest.raises(km.errors.EventError, match="sweep at t=1 s: 'sonar' has no detector for a sweep"):
        slam.process(sweep)
    with pytest.raises(km.errors.EventError, match="'sonar' has no detector for a frame"):
        km.Slam(robot(Nearest())).process(km.Frame(1.0, "boat", "sonar", np.zeros((2, 2), np.uint8)))
    assert slam.t_ns is None
