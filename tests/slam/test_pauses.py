"""Events whose stamps are far ahead, and events that are sent again: what is refused, and that the map goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import kalmark as km
from kalmark.errors import EventError, ModelError
from kalmark.slam.slam import IN_A_ROW

DAY_S = 86_400.0


def a_slam(**options: Any) -> km.Slam:
    sensor = km.Mount(km.sensors.RangeBearing())
    return km.Slam([km.Robot(name, km.motion.Unicycle(), sensors={"lidar": sensor}) for name in "ab"], **options)


def control(t_s: float, robot: str = "a") -> km.Control:
    return km.Control(t_s, robot, (0.5, 0.1))


def test_one_stamp_a_day_ahead_is_refused_and_the_next_event_is_taken() -> None:
    slam, clean = a_slam(), a_slam()
    for one in (slam, clean):
        one.process(control(1.0))
    said = r"control at t=86401 s comes 86400 s after one at t=1 s, expected at most 43200 s \(longest_pause_s\), or 10"
    with pytest.raises(EventError, match=said):
        slam.process(control(1.0 + DAY_S))
    for one in (slam, clean):
        one.process(control(1.1))
    assert slam.covariance("a", "b").tobytes() == clean.covariance("a", "b").tobytes()


def test_a_pause_is_believed_after_ten_events_in_a_row_and_not_if_another_robot_goes_on() -> None:
    slam = a_slam(longest_pause_s=60.0)
    slam.process(control(0.0))
    for k in range(IN_A_ROW - 1):
        with pytest.raises(EventError, match="comes 10"):
            slam.process(control(100.0 + k))
    assert slam.process(control(100.0 + IN_A_ROW)).t_ns == (100 + IN_A_ROW) * 10**9
    for k in range(2 * IN_A_ROW):  # of a, whose clock is wrong, none is taken while b sends its own
        with pytest.raises(EventError, match="longest_pause_s"):
            slam.process(control(500.0 + k))
        slam.process(control(111.0 + k, "b"))
    for t_s in (1e3, 1e4, 1e5):  # and none of stamps that do not agree
        with pytest.raises(EventError, match="longest_pause_s"):
            slam.process(control(t_s))


def test_a_clock_that_is_set_back_does_not_stop_what_comes_after_the_map() -> None:
    slam = a_slam()
    slam.process(control(10.0))
    with pytest.raises(EventError, match=r"control at t=9 s comes after one at t=10 s"):
        slam.process(control(9.0))
    assert slam.process(control(10.1)).t_ns == 10_100_000_000


@pytest.mark.parametrize(
    ("value", "wanted"),
    [(0.0, "positive"), (-1.0, "positive"), (float("nan"), "finite"), ("1", "number"), (True, "number")],
)
def test_a_longest_pause_that_is_none_is_refused(value: Any, wanted: str) -> None:
    with pytest.raises(ModelError, match=rf"longest_pause_s is {value!r}, expected a {wanted}"):
        a_slam(longest_pause_s=value)


def test_the_configuration_sets_it_and_a_saved_map_keeps_it_with_what_was_taken_at_its_time(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("longest_pause_s: 5\nrobots: {a: {sensors: {lidar: {type: range_bearing}}}}\n")
    slam = km.Slam.from_config(tmp_path / "a.yaml")
    slam.process(control(0.0))
    scan = km.Scan(1.0, "a", "lidar", [[4.0, 0.1]], [7])
    slam.process(scan)
    slam.save(tmp_path / "map.kmk")
    loaded = km.Slam.load(tmp_path / "map.kmk")
    assert loaded.has_taken(scan) and not loaded.has_taken(control(1.0)) and not loaded.has_taken(control(0.0))
    with pytest.raises(EventError, match="expected at most 5 s"):
        loaded.process(control(7.0))
    loaded.process(control(1.5))
    assert not loaded.has_taken(scan)
