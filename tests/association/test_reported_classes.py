"""Classes that a sensor reports of landmarks: a likelihood in the association, sometimes wrong, kept with the map."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import EventError, ModelError
from kalmark.logs import open_log, write_native

CONES = km.Classes(("blue", "yellow"), error=0.02)
ASSOCIATIONS = [
    km.association.NearestNeighbour(), km.association.GlobalAssignment(), km.association.JointCompatibility(),
]  # fmt: skip


def slam_of(association: Any, classes: km.Classes | None = CONES) -> km.Slam:
    """Return a filter with a blue and a yellow cone 1 m apart, at (4, .5) and (4, -.5), each seen three times."""
    lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.02), classes=classes)
    rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar}, cov=np.diag([0.1, 0.1, 0.005]))
    slam = km.Slam(rover, association=association)
    y = [[np.hypot(4.0, 0.5), b] for b in np.arctan2([0.5, -0.5], 4.0)]
    for t_s in range(3):
        slam.process(km.Scan(t_s, "rover", "lidar", y, ["left", "right"], classes=["blue", "yellow"]))
    return slam


@pytest.mark.parametrize("association", ASSOCIATIONS, ids=lambda a: type(a).__name__)
def test_a_class_decides_between_two_landmarks(association: Any) -> None:
    """One cone halfway between both, which are .24 rad apart: of the class that is reported."""
    for of, name in (("blue", "left"), ("yellow", "right")):
        slam = slam_of(association)
        seen = [[4.0, 0.01 if of == "yellow" else -0.01]]  # a little nearer to the other one
        slam.process(km.Control(2.0, "rover", (0.0, 0.0)))
        R = np.diag([0.04, 0.04])
        report = slam.process(km.Scan(3.0, "rover", "lidar", seen, cov=R, classes=[of]))
        assert [o.landmark for o in report.observations if o.outcome == "associated"] == [name]


def test_a_class_is_a_likelihood_in_the_posterior_of_matchings() -> None:
    """Without a class each of both is as likely as the other, with one .98 / .02 times likelier."""
    for of, shares in ((None, {"left": 0.5, "right": 0.5}), ("blue", {"left": 0.98, "right": 0.02})):
        slam = slam_of(km.association.Automatic())
        R = np.diag([0.04, 0.04])
        report = slam.process(km.Scan(3.0, "rover", "lidar", [[4.0, 0.0]], cov=R, classes=[of]))
        found = dict(re.findall(r"'(\w+)' (\d.\d+)", report.observations[0].reason))
        total = sum(map(float, found.values()))
        assert {name: float(share) / total for name, share in found.items()} == pytest.approx(shares, abs=0.02)


def test_without_a_reported_class_or_without_classes_nothing_changes() -> None:
    found = []
    for classes, reported in ((CONES, None), (CONES, [None]), (None, ["blue"]), (None, None)):
        slam = slam_of(km.association.Automatic(), classes)
        slam.process(km.Scan(3.0, "rover", "lidar", [[4.05, 0.12]], classes=reported))
        found.append(slam.mean("left"))
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_the_classes_of_a_landmark_follow_the_reports_by_bayes_rule() -> None:
    slam = slam_of(km.association.ByIdentity())
    p = slam.classes("left")
    assert p["blue"] == pytest.approx(0.98**3 / (0.98**3 + 0.02**3))
    for t_s in (4.0, 5.0, 6.0, 7.0):  # the first three were wrong ones
        slam.process(
            km.Scan(t_s, "rover", "lidar", [[np.hypot(4, 0.5), np.arctan2(0.5, 4)]], ["left"], classes=["yellow"])
        )
    assert slam.classes("left")["yellow"] == pytest.approx(0.98)
    assert slam.classes("right")["yellow"] > 0.99


def test_an_unknown_class_is_refused_and_changes_nothing() -> None:
    slam = slam_of(km.association.Automatic())
    before = slam.mean("rover")
    with pytest.raises(EventError, match=r"scan at t=9 s: class is 'red', expected blue or yellow"):
        slam.process(km.Scan(9.0, "rover", "lidar", [[4.0, 0.1]], classes=["red"]))
    np.testing.assert_array_equal(slam.mean("rover"), before)
    with pytest.raises(EventError, match="one text or None for each of 1 observations"):
        km.Scan(9.0, "rover", "lidar", [[4.0, 0.1]], classes=["red", "blue"])


@pytest.mark.parametrize("parquet", [False, True])
def test_classes_are_written_and_read_with_a_log(tmp_path: Path, parquet: bool) -> None:
    scans = {
        "t_s": [0.0, 0.0, 0.5], "robot": ["r"] * 3, "sensor": ["lidar"] * 3, "id": [None] * 3,
        "class": ["blue", None, "yellow"], "range_m": [1.0, 2.0, 3.0], "bearing_rad": [0.1, 0.2, 0.3],
    }  # fmt: skip
    log = km.log_from(scans=scans)
    again = open_log(write_native(log, tmp_path / "log", parquet=parquet))
    for each in (log, again):
        assert [e.classes for e in each.events if isinstance(e, km.Scan)] == [("blue", None), ("yellow",)]


def test_classes_go_with_a_saved_map(tmp_path: Path) -> None:
    slam = slam_of(km.association.Automatic())
    slam.save(tmp_path / "map.kmk")
    other = km.Slam.load(tmp_path / "map.kmk")
    assert other.classes("left") == slam.classes("left")
    assert other.robots["rover"].sensors["lidar"].classes == CONES


def test_classes_of_a_sensor_that_measures_its_robot_are_refused() -> None:
    with pytest.raises(ModelError, match="classes are given, but a Gyro2D measures its robot, expected None"):
        km.Mount(km.sensors.Gyro2D(), classes=km.Classes())
