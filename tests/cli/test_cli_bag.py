"""`kalmark bag`: what it lists, and the configuration that it writes, which runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import Kalmark
from kalmark.config import load_config, open_run
from kalmark.logs.bag.first_config import first_config
from kalmark.logs.bag.survey import survey

pytest.importorskip("rosbags", reason="rosbags is not installed: no bag can be read")

from ros_bags import (
    MOUNT,
    START,
    Outgoing,
    field,
    fix,
    geodetic,
    header,
    imu,
    odometry,
    pose,
    robot_among_posts,
    tf,
    transform,
    write_bag,
)

T0 = 1_700_000_000_000_000_000


def config_of(tmp_path: Path, messages: list[Outgoing], kind: str = "mcap") -> str:
    """Return the first configuration of a bag of these messages, which kalmark reads."""
    text = first_config(survey(write_bag(tmp_path, kind, messages)))
    (tmp_path / "config.yaml").write_text(text)
    load_config(tmp_path / "config.yaml")
    return text


def test_a_bag_is_listed_and_runs_with_the_configuration_that_is_written(kalmark: Kalmark, tmp_path: Path) -> None:
    messages = [m for m in robot_among_posts() if m.topic != "/truth"]
    bag = write_bag(tmp_path, "ros1.bag", messages)
    listed = kalmark("bag", bag, "--out", "robot.yaml")
    assert listed.status == 0 and "39.9 s" in listed.out
    rows = {line.split()[0]: line.split() for line in listed.out.splitlines() if line.strip().startswith("/")}
    assert rows["/scan"][1:7] == ["sensor_msgs/LaserScan", "200", "5", "0", "0.2", "-"]
    assert (
        "base_link in odom" in listed.out
        and "frames that stand still: imu in base_link, laser in base_link" in listed.out
    )
    done = kalmark("run", "robot.yaml", "--out", "out")
    assert done.status == 0, done.err
    config, _ = open_run(tmp_path / "robot.yaml")
    start, mount = config.robots["robot"].start, config.robots["robot"].sensors["scan"].mount
    log = open_run(tmp_path / "robot.yaml")[1]
    assert log.sensor_columns["robot", "gyro"] == ("w_radps",)
    assert log.sensor_columns["robot", "compass"] == ("heading_rad",)
    assert np.hypot(start.x_m - START[0], start.y_m - START[1]) < 2.5  # the origin is the first fix
    np.testing.assert_allclose(start.theta_rad, START[2], atol=3 * start.sigma_theta_rad)
    np.testing.assert_allclose([mount.x_m, mount.y_m, mount.theta_rad], MOUNT, atol=1e-9)
    again = kalmark("bag", bag, "--out", "robot.yaml")
    assert again.status == 2 and "exists already" in again.err


def test_gaps_are_those_longer_than_five_usual_intervals(tmp_path: Path) -> None:
    times = [0, 1, 2, 3, 4, 14, 15, 16, 24, 25]
    found = survey(write_bag(tmp_path, "sqlite3", [odometry(T0 + t * 10**8, pose(t, 0, 0)) for t in times]))
    topic = found.named("/odom")
    assert (topic.count, topic.gaps, topic.longest_s, topic.longest_at_s) == (10, 2, 1.0, pytest.approx(0.4))
    assert topic.rate_hz == pytest.approx(10)


def test_what_kalmark_cannot_read_is_listed_and_not_used(tmp_path: Path) -> None:
    messages = [odometry(T0 + t, pose(t, 0, 0)) for t in range(3)]
    unmeasured = {"header": header(T0, "imu"), "angular_velocity_covariance": np.full(9, -1.0)}
    messages += [Outgoing("/imu/data", "sensor_msgs/msg/Imu", T0, unmeasured)]
    messages += [Outgoing("/other", "some_msgs/msg/Other", T0, {})]
    text = config_of(tmp_path, messages)
    assert "# not used: /imu/data (sensor_msgs/Imu): no rates, and no covariance of its orientation" in text
    assert "# not used: /other (some_msgs/Other): no type of message that kalmark reads" in text


def test_an_inertial_unit_is_a_gyroscope_and_a_compass_whose_first_heading_is_that_of_the_start(tmp_path: Path) -> None:
    messages = [odometry(T0 + t * 10**8, pose(t, 0, 0)) for t in range(10)]
    messages += [imu(T0 + t * 10**7, (0, 0, 0), (0, 0, np.sin(0.4), np.cos(0.4)), 0.01) for t in range(90)]
    text = config_of(tmp_path, sorted(messages, key=lambda m: m.t_ns))
    assert "/imu: {type: imu, gyro: gyro, at: controls, heading: compass, every_s: 1}" in text
    assert "gyro: {type: gyro, sigma_radps: 0.00316228, sigma_bias_radps: 0.01" in text  # of 10 readings each
    wanted = "compass: {type: heading, sigma_heading_rad: 0.1, declination_rad: -0.8, sigma_declination_rad: 0.1}"
    assert f"{wanted}  # GUESS: its first heading is that of the start; GUESS: its axes are those of the robot" in text


def test_a_robot_that_hardly_moves_starts_with_the_heading_of_its_compass(tmp_path: Path) -> None:
    """Satellite fixes say where it is; without a way to lay upon them only the compass says where it looks."""
    messages = [odometry(T0 + t * 10**8, pose(0.01 * t, 0, 0)) for t in range(10)]
    messages += [fix(T0 + t * 3 * 10**8, geodetic([0.0, 0.0, 0.0])) for t in range(3)]
    messages += [imu(T0 + 5, (0, 0, 0), (0, 0, np.sin(0.4), np.cos(0.4)), 0.01)]
    text = config_of(tmp_path, sorted(messages, key=lambda m: m.t_ns))
    wanted = (
        "start: {x_m: 0, y_m: 0, theta_rad: 0.8, sigma_xy_m: 5, sigma_theta_rad: 0.2}  # GUESS: its heading is that of"
    )
    assert wanted in text
    assert "declination_rad: 0, sigma_declination_rad: 0.2}  # GUESS: its north is true north, or nearly" in text


def test_an_orientation_without_a_covariance_is_not_taken(tmp_path: Path) -> None:
    messages = [odometry(T0 + t, pose(t, 0, 0)) for t in range(3)] + [imu(T0 + 5, (0, 0, 0))]
    assert "/imu: {type: imu, gyro: gyro, at: controls}" in config_of(tmp_path, messages)


def test_a_magnetic_field_is_a_compass_where_there_is_no_other(tmp_path: Path) -> None:
    messages = [odometry(T0 + t, pose(t, 0, 0)) for t in range(3)] + [field(T0 + 5, (20, 0, -40))]
    assert "/mag: {type: compass, sensor: compass, every_s: 1}" in config_of(tmp_path, messages)
    found = survey(write_bag(tmp_path, "sqlite3", [*messages, imu(T0 + 6, (0, 0, 0), spread=0.01)]))
    text = first_config(found)
    assert "# not used: /mag (sensor_msgs/MagneticField): headings by a magnetic field are for the plane, and" in text


def test_two_inertial_units_have_sensors_of_their_own_in_space_too(tmp_path: Path) -> None:
    messages = [odometry(T0 + t, pose(t, 0, 0, z=t)) for t in range(5)]
    messages += [imu(T0 + 5 + k, (0, 0, 0), spread=0.01, topic=f"/{name}/imu") for k, name in enumerate("ab")]
    text = config_of(tmp_path, messages)
    assert "gyro: gyro, at: controls, heading: compass, inclination: level, every_s: 1}" in text
    assert "gyro: b_imu_gyro" in text and "b_imu_level: {type: inclination, sigma_rad: 0.1}" in text


def test_a_path_that_rises_is_one_of_space(tmp_path: Path) -> None:
    text = config_of(tmp_path, [odometry(T0 + t, pose(t, 0, 0, z=0.1 * t)) for t in range(5)])
    assert "/odom: {type: odometry_3d}" in text and "motion: {type: odometry_3d}" in text


def test_frames_of_tf_are_the_odometry_where_there_is_no_other(tmp_path: Path) -> None:
    moved = [tf("/tf", T0 + t, transform("odom", "base_link", T0 + t, pose(t, 0, 0))) for t in range(5)]
    text = config_of(tmp_path, moved)
    assert "/tf: {type: odometry_2d, frame: odom, child_frame: base_link}" in text
    assert [control.u.tolist() for control in open_run(tmp_path / "config.yaml")[1].events] == [[1, 0, 0]] * 4


def test_robots_are_told_apart_by_the_first_part_of_their_topics(tmp_path: Path) -> None:
    messages = [odometry(T0 + t, pose(t, 0, 0), topic=f"/{name}/odom") for t in range(3) for name in ("a", "b")]
    text = config_of(tmp_path, messages)
    assert "/a/odom: {type: odometry_2d, robot: a}" in text and "/b/odom: {type: odometry_2d, robot: b}" in text
    assert open_run(tmp_path / "config.yaml")[1].robots == ("a", "b")


def test_a_clock_of_a_simulator_beside_messages_without_header_gives_way_to_the_recorder(tmp_path: Path) -> None:
    twist = {"linear": {"x": 1.0}, "angular": {"z": 0.1}}
    messages = [Outgoing("/cmd_vel", "geometry_msgs/msg/Twist", T0 + t, twist) for t in range(3)]
    located: dict[str, Any] = {
        "header": header(10**9, "map"),
        "pose": {"pose": pose(1, 2, 0), "covariance": np.eye(6).ravel()},
    }
    messages.append(Outgoing("/amcl_pose", "geometry_msgs/msg/PoseWithCovarianceStamped", T0 + 5, located))
    text = config_of(tmp_path, messages)
    assert text.count("time: recorded") == 2
    assert open_run(tmp_path / "config.yaml")[1].events[-1].t_ns == T0 + 5


def test_the_numbers_of_a_camera_are_those_of_its_info(tmp_path: Path) -> None:
    info = {"header": header(T0, "camera"), "width": 800, "height": 600, "distortion_model": "plumb_bob"}
    info |= {"k": [500.0, 0, 400, 0, 510, 300, 0, 0, 1], "d": [0.1, 0.01, 0, 0, 0]}
    corners = [{"x": float(x), "y": float(y)} for x, y in ((10, 20), (30, 20), (30, 40), (10, 40))]
    tags = {"header": header(T0, "camera"), "detections": [{"id": 3, "corners": corners}]}
    text = config_of(tmp_path, [
        Outgoing("/camera_info", "sensor_msgs/msg/CameraInfo", T0, info),
        Outgoing("/tags", "apriltag_msgs/msg/AprilTagDetectionArray", T0, tags),
    ])  # fmt: skip
    assert (
        "tag_corners, fx_px: 500, fy_px: 510, cx_px: 400, cy_px: 300, width_px: 800, height_px: 600, lens: radtan"
        in text
    )
    assert "landmarks: {type: tag}" in text and "motion: {type: constant_velocity_3d" in text


def test_a_file_that_is_no_bag_gets_one_line(kalmark: Kalmark, tmp_path: Path) -> None:
    for name, content in (("x.bag", b"not a bag"), ("x.mcap", b""), ("x.db3", b"SQLite format 3"), ("x.txt", b"a")):
        (tmp_path / name).write_bytes(content)
        done = kalmark("bag", tmp_path / name)
        assert done.status == 2 and done.err.count("\n") == 1 and "expected a whole bag" in done.err
    assert kalmark("bag", tmp_path / "missing.bag").status == 2


def test_the_nav2_bag_runs_as_it_is_written(kalmark: Kalmark, data: Any) -> None:
    assert kalmark("bag", data("rosbags/nav2_turtlebot.mcap"), "--out", "nav2.yaml").status == 0
    done = kalmark("run", "nav2.yaml", "--out", "out")
    assert done.status == 0 and "fixes given to the filter           135" in done.out
