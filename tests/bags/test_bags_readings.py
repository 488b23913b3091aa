"""Bags: what inertial units and compasses say of their own robot."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kalmark.bags.inertial_messages import means
from kalmark.errors import LogError
from kalmark.events import Control, Scan
from kalmark.logs import open_log

pytest.importorskip("rosbags", reason="rosbags is not installed: no bag can be read")

from ros_bags import (
    AT,
    IMU_TURN,
    T0,
    TOPICS,
    Outgoing,
    bag_of,
    field,
    header_fields,
    imu,
    odometry,
    pose,
    tf,
    transform,
)


def turned(angle: float, axis: int = 2) -> list[float]:
    q = [0.0, 0.0, 0.0, np.cos(angle / 2)]
    q[axis] = np.sin(angle / 2)
    return q


def unit_of(tmp_path: Path, *units: Outgoing, mount: Any = None, space: bool = False) -> Path:
    """Return a bag of odometry at 1 Hz, of an inertial unit, and of where it is mounted."""
    moved = [odometry(T0 + t * 10**9, pose(t, 0, 0, z=t if space else 0)) for t in range(4)]
    frames = [] if mount is None else [tf("/tf_static", T0, transform("base_link", "imu", T0, mount))]
    return bag_of(tmp_path, sorted([*frames, *moved, *units], key=lambda m: m.t_ns))


def readings(log: Any, sensor: str) -> list[tuple[float, list[float]]]:
    seen = (event for event in log.events if isinstance(event, Scan) and event.sensor == sensor)
    return [((scan.t_ns - T0) * 1e-9, scan.y[0].tolist()) for scan in seen]


def test_the_rates_of_a_robot_of_the_plane_are_about_its_vertical_axis(tmp_path: Path) -> None:
    """Of a unit whose x axis points up: the robot turns about it."""
    up = {"position": {"x": 0.5}, "orientation": dict(zip("xyzw", turned(-np.pi / 2, axis=1), strict=True))}
    path = unit_of(tmp_path, *(imu(T0 + t, (0.3, 0.1, 0.2)) for t in (10, 20, 20, 30)), mount=up)
    log = open_log(path, topics={"/odom": TOPICS["/odom"], "/imu": {"type": "imu"}})
    np.testing.assert_allclose([y for _, y in readings(log, "gyro")], [[0.3]] * 3, atol=1e-12)
    assert log.sensor_columns["robot", "gyro"] == ("w_radps",)
    assert log.describes["robots"]["robot"]["sensors"]["gyro"]["mount"] == {"x_m": 0.5, "y_m": 0.0, "theta_rad": 0.0}
    assert [line.split(": ", 1)[1] for line in log.skipped] == [
        "/imu: 1 readings of gyro at the time of the one before"
    ]


def test_rates_are_averaged_from_one_control_to_the_next(tmp_path: Path) -> None:
    """They grow by 1 rad/s each second, from 0.5 s on: the mean is the rate in the middle."""
    times = np.arange(0.5, 3.01, 0.25)
    path = unit_of(tmp_path, *(imu(T0 + round(t * 1e9), (0, 0, t)) for t in times))
    log = open_log(path, topics={"/odom": TOPICS["/odom"], "/imu": {"type": "imu", "at": "controls"}})
    (t1, y1), (t2, y2), (t3, y3) = readings(log, "gyro")
    assert (t1, t2, t3) == (1.0, 2.0, 3.0)
    np.testing.assert_allclose([y1[0], y2[0], y3[0]], [1.0, 1.5, 2.5], atol=1e-12)
    with pytest.raises(LogError, match="gyro of 'robot' has `at: controls`, expected controls of this robot"):
        open_log(path, topics={"/imu": {"type": "imu", "at": "controls"}})


@pytest.mark.parametrize(
    ("ends", "kept"), [([0, 10], [0, 10]), ([3, 4, 8], [3, 8]), ([1, 9, 30], [1, 9]), ([4], [4]), ([], []), ([20], [])]
)
def test_means_of_rates_are_their_integrals(ends: list[int], kept: list[int]) -> None:
    """An end with no rate since the last one is left out."""
    tenth = 10**8
    t_ns, w = np.array([0, 2, 3, 7, 10]) * tenth, np.random.default_rng(5).normal(size=(5, 3))
    found = means(t_ns, w, [end * tenth for end in ends])
    assert [t for t, _ in found] == [end * tenth for end in kept]
    for (a, _), (b, mean) in pairwise(found):
        t = np.linspace(a, b, 10_001)
        middle = (t[1:] + t[:-1]) / 2
        line = np.column_stack([np.interp(middle, t_ns, column) for column in w.T])
        np.testing.assert_allclose(mean, line.mean(axis=0), atol=1e-6)


def test_headings_are_those_of_the_robot_however_its_unit_is_turned(tmp_path: Path) -> None:
    units = [imu(T0 + t * 10**8, (0, 0, 0), turned(0.3 + IMU_TURN), 0.01) for t in range(10)]
    path = unit_of(tmp_path, *units, mount=pose(0.1, 0, IMU_TURN))
    topic = {"type": "imu", "gyro": None, "heading": "compass", "every_s": 0.45}
    log = open_log(path, topics={"/odom": TOPICS["/odom"], "/imu": topic})
    found = readings(log, "compass")
    assert [t for t, _ in found] == [0.0, 0.5]
    np.testing.assert_allclose([y for _, y in found], [[0.3]] * 2, atol=1e-12)


def test_a_robot_of_space_has_rates_inclination_and_gravity_of_its_unit(tmp_path: Path) -> None:
    q = turned(0.2, axis=0)
    path = unit_of(tmp_path, imu(T0, (1, 2, 3), q, a=(1, 2, 9)), mount=pose(0.1, 0, IMU_TURN), space=True)
    topic = {"type": "imu", "heading": "compass", "inclination": "level", "gravity": "down"}
    log = open_log(path, topics={"/odom": {"type": "odometry_3d"}, "/imu": topic})
    assert readings(log, "gyro")[0][1] == [1, 2, 3] and readings(log, "down")[0][1] == [1, 2, 9]
    np.testing.assert_allclose(readings(log, "level")[0][1], [0.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(readings(log, "compass")[0][1], [0.0], atol=1e-12)
    mounts = log.describes["robots"]["robot"]["sensors"]
    assert {name: mount["mount"]["yaw_deg"] for name, mount in mounts.items()} == dict.fromkeys(mounts, 90.0)


def test_a_magnetic_field_is_a_heading_from_magnetic_east(tmp_path: Path) -> None:
    """Ahead to the north the field is along x, and the heading is a quarter of a turn; to the east it is along y."""
    fields = [field(T0, (20, 0, -40)), field(T0 + 1, (0, 20, -40)), field(T0 + 2, (0, 0, -40))]
    path = unit_of(tmp_path, *fields)
    log = open_log(path, topics={"/odom": TOPICS["/odom"], "/mag": {"type": "compass"}})
    np.testing.assert_allclose([y for _, y in readings(log, "mag")], [[np.pi / 2], [0.0]], atol=1e-12)
    assert [line.split(": ", 1)[1] for line in log.skipped] == ["/mag: 1 fields that are steep"]


@pytest.mark.parametrize(
    ("odometry_", "topics", "said"),
    [
        ("odometry_3d", {"/mag": {"type": "compass"}}, "/mag gives headings by a magnetic field .*expected one of the"),
        (
            "odometry_2d",
            {"/imu": {"type": "imu", "gravity": "g"}},
            "gives inclinations or gravity to 'robot', expected",
        ),
        ("odometry_2d", {"/imu": {"type": "imu", "gyro": None}}, "gyro is None, expected a name, or one of heading"),
        ("odometry_2d", {"/mag": {"type": "imu"}}, "MagneticField .magnetic field., expected one of sensor_msgs/Imu"),
        ("odometry_2d", {"/imu": {"type": "imu", "every_s": -1.0}}, "every_s is -1.0, expected"),
    ],
)
def test_readings_that_cannot_be_get_one_line(odometry_: str, topics: Any, said: str, tmp_path: Path) -> None:
    path = unit_of(tmp_path, imu(T0, (0, 0, 0)), field(T0, (1, 0, 0)))
    with pytest.raises(LogError, match=said) as error:
        open_log(path, topics={"/odom": {"type": odometry_}} | topics)
    assert "\n" not in str(error.value)


def test_what_an_inertial_unit_does_not_measure_is_left_out(tmp_path: Path) -> None:
    path = unit_of(tmp_path, imu(T0, (0, 0, 0), (0, 0, 0, 0), -1.0), imu(T0 + 1, (0, 0, np.nan)))
    topics = {"/odom": TOPICS["/odom"], "/imu": {"type": "imu", "heading": "compass"}}
    with pytest.raises(LogError, match=r"/imu at t=1700000000.000000001 s: rates .*nan.*, expected finite numbers"):
        open_log(path, topics=topics)
    log = open_log(path, topics=topics, on_error="skip")
    assert [len(readings(log, name)) for name in ("gyro", "compass")] == [1, 0]
    assert "/imu: 1 messages without an orientation" in log.skipped[-1]


def test_an_inertial_unit_moves_a_robot_whose_frame_is_its_own(tmp_path: Path) -> None:
    mount = tf("/tf_static", T0, transform("base_link", "imu", T0, pose(1, 0, 0)))
    camera = tf("/tf_static", T0, transform("base_link", "camera", T0, pose(3, 0, 0)))
    units = [imu(T0 + k * 10**7, (0.1, 0.2, 0.3 + k), a=(0.0, 0.1, 9.8)) for k in range(3)]
    seen = {"markers": [{"id": 4, "header": header_fields(T0, "camera"), "pose": AT}]}
    messages = [mount, camera, *units, units[2], Outgoing("/seen", "visualization_msgs/msg/MarkerArray", T0, seen)]
    topics = {"/imu": {"type": "inertial"}, "level": {"type": "imu", "topic": "/imu", "gyro": "gyro"}}
    log = open_log(bag_of(tmp_path, messages), topics=topics | {"/seen": {"type": "scan"}})
    controls = [event for event in log.events if isinstance(event, Control)]
    assert [control.u.tolist() for control in controls] == [[0.1, 0.2, 0.3 + k, 0, 0.1, 9.8] for k in range(3)]
    assert log.describes["robots"]["robot"]["motion"] == {"type": "inertial"}
    assert log.describes["robots"]["robot"]["sensors"]["seen"]["mount"]["x_m"] == 2.0
    assert sum(isinstance(event, Scan) and event.sensor == "gyro" for event in log.events) == 3
    assert any("/imu: 1 readings at the time of the one before" in line for line in log.skipped)
