"""Bags by topic: the same log from ROS 1, sqlite3 and MCAP, each type of message, and one line for what is wrong."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kalmark.config import build_slam, open_run
from kalmark.errors import LogError
from kalmark.events import Control, Fix, Scan
from kalmark.logs import open_log, write_native
from kalmark.logs.geodesy import A_M, E2, FLATTENING, earth_centred, to_tangent_plane
from kalmark.results.record import record

pytest.importorskip("rosbags", reason="rosbags is not installed: no bag can be read")

from ros_bags import (
    AT,
    GYRO_BIAS,
    MOUNT,
    ORIGIN,
    POSTS,
    T0,
    TOPICS,
    Outgoing,
    bag_of,
    drive,
    events_of,
    fix,
    geodetic,
    header_fields,
    odometry,
    pose,
    same_logs,
    tf,
    transform,
    twist,
)

CONFIG = """
log: {{path: {path}{topics}}}
robots:
  robot:
    motion: {{type: odometry_2d, sigma_x_m: 0.01, sigma_y_m: 0.002, sigma_theta_rad: 0.004}}
    sensors:
      lidar: {{type: range_bearing, detector: {{type: trunks, sigma_range_m: 0.01}}}}
      gyro: {{type: gyro, sigma_radps: 0.005, sigma_bias_radps: 0.02}}
      compass: {{type: heading, sigma_heading_rad: 0.02}}
association: {{type: auto}}
"""
IN_YAML = f""", topics: {{
  /odom: {{type: odometry_2d}}, /scan: {{type: scan, sensor: lidar}},
  /fix: {{type: fix, origin: {[*ORIGIN]}}}, /truth: {{type: truth}},
  /imu: {{type: imu, at: controls, heading: compass, every_s: 1.0}}}}"""


# ------------------------------------------------------------------ the same from every file
def test_ros_1_sqlite_and_mcap_are_the_same_log_as_csv(bags: dict[str, Path], tmp_path: Path) -> None:
    logs = [open_log(path, topics=TOPICS) for path in bags.values()]
    native = open_log(write_native(logs[0], tmp_path / "csv"))
    assert len(logs[0].events) == 1077 and len(logs[0].truth["robot"]) == 400
    assert all(same_logs(logs[0], log) for log in (*logs[1:], native))


def test_ros_1_sqlite_mcap_and_csv_make_the_same_map(bags: dict[str, Path], tmp_path: Path) -> None:
    write_native(open_log(bags["ros1.bag"], topics=TOPICS), tmp_path / "csv")
    found = []
    for path in (*bags.values(), tmp_path / "csv"):
        file = tmp_path / "config.yaml"
        file.write_text(CONFIG.format(path=path, topics="" if path.name == "csv" else IN_YAML))
        config, log = open_run(file)
        slam = build_slam(config, log)
        run = record(slam, log, progress=False)
        ids = [landmark.id for landmark in slam.landmarks()]
        means = tuple(slam.mean(name).tobytes() for name in ("robot", *ids))
        found.append((*ids, *means, slam.covariance("robot", *ids).tobytes()))
    assert len(set(found)) == 1 and len(ids) == len(POSTS)
    assert run.evaluate()["robots"]["robot"]["ate_raw_m"] < 0.05
    (gyro,) = (mount for mount in run.history.mounts if "gyro" in mount.name)
    np.testing.assert_allclose(gyro.mean[-1], GYRO_BIAS, atol=3 * np.sqrt(gyro.covariance[-1, -1]))


def test_the_controls_are_the_differences_of_the_poses(bags: dict[str, Path]) -> None:
    log = open_log(bags["mcap"], topics={"/truth": {"type": "odometry_2d"}})
    t_ns, poses = drive()
    assert [c.t_ns for c in log.events] == t_ns[1:].tolist()
    here = poses[0].copy()
    for control in log.events:
        c, s = np.cos(here[2]), np.sin(here[2])
        here += np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ control.u
    np.testing.assert_allclose(here, poses[-1], atol=1e-9)


def test_increments_end_at_the_scans_where_odometry_is_slower_than_them(tmp_path: Path) -> None:
    messages = [odometry(T0 + t * 10**9, pose(2 * t, 0, 0.1 * t)) for t in range(3)]
    seen = {"header": header_fields(T0, "sonar"), "range": 2.0, "max_range": 9.0}
    for t in (5 * 10**8, 75 * 10**7, 15 * 10**8, 25 * 10**8):
        messages.append(
            Outgoing("/sonar", "sensor_msgs/msg/Range", T0 + t, seen | {"header": header_fields(T0 + t, "s")})
        )
    path = bag_of(tmp_path, sorted(messages, key=lambda message: message.t_ns))
    topics = {"/odom": {"type": "odometry_2d", "at": "scans"}, "/sonar": {"type": "scan", "landmark": 1}}
    log = open_log(path, topics=topics)
    controls = [event for event in log.events if isinstance(event, Control)]
    assert [line.split(": ", 1)[1] for line in log.skipped] == ["/odom: 1 scans and fixes outside the odometry"]
    assert [c.t_ns - T0 for c in controls] == [75 * 10**7, 15 * 10**8]
    np.testing.assert_allclose([c.u[2] for c in controls], [0.025, 0.075], atol=1e-12)
    np.testing.assert_allclose([c.u[0] for c in controls], [0.5 * np.cos(0.05), 1.5 * np.cos(0.075)], atol=1e-12)
    with pytest.raises(LogError, match="own_noise is True, expected False with at: scans"):
        open_log(path, topics=topics | {"/odom": topics["/odom"] | {"own_noise": True}})


def test_fixes_are_metres_east_and_north_of_the_origin(bags: dict[str, Path]) -> None:
    log = open_log(bags["sqlite3"], topics={"/odom": TOPICS["/odom"], "/fix": TOPICS["/fix"]})
    t_ns, poses = drive()
    fixes = [event for event in log.events if isinstance(event, Fix)]
    true = poses[np.searchsorted(t_ns, [event.t_ns for event in fixes]), :2]
    assert np.abs(np.array([event.y for event in fixes]) - true).max() < 2.0
    assert all(event.cov.tolist() == [[0.25, 0], [0, 0.25]] for event in fixes)


def test_the_origin_is_the_first_fix_if_none_is_given(bags: dict[str, Path]) -> None:
    log = open_log(bags["mcap"], topics={"/odom": TOPICS["/odom"], "/fix": {"type": "fix"}})
    first = next(event for event in log.events if isinstance(event, Fix))
    assert first.y.tolist() == [0, 0]


def test_frames_of_tf_are_odometry_truth_and_mounts(bags: dict[str, Path]) -> None:
    of_tf = {"/tf": {"type": "odometry_2d", "frame": "odom", "child_frame": "base_link"}}
    a, b = (open_log(bags["mcap"], topics=topics) for topics in (of_tf, {"/odom": TOPICS["/odom"]}))
    assert same_logs(a, b)
    mount = open_log(bags["ros1.bag"], topics=TOPICS).describes["robots"]["robot"]["sensors"]["lidar"]["mount"]
    np.testing.assert_allclose([mount["x_m"], mount["y_m"], mount["theta_rad"]], MOUNT, atol=1e-12)


def test_a_laser_that_hangs_upside_down_sees_the_same(tmp_path: Path) -> None:
    flipped = {"position": {"x": 0.2}, "orientation": {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}}
    scan = {"header": header_fields(T0, "laser"), "angle_min": -0.5, "angle_increment": 0.25, "range_max": 9.0}
    scan |= {"ranges": [1.0, 2.0, np.inf, 4.0, 5.0]}
    messages = [
        tf("/tf_static", T0, transform("base_link", "laser", T0, flipped)),
        odometry(T0, pose(0, 0, 0)),
        Outgoing("/scan", "sensor_msgs/msg/LaserScan", T0, scan),
        odometry(T0 + 10**8, pose(0.1, 0, 0)),
    ]
    log = open_log(bag_of(tmp_path, messages), topics={"/odom": TOPICS["/odom"], "/scan": {"type": "scan"}})
    seen = next(event for event in log.events if isinstance(event, Scan))
    np.testing.assert_allclose(seen.y, [[5, -0.5], [4, -0.25], [2, 0.25], [1, 0.5]])
    assert log.describes["robots"]["robot"]["sensors"]["scan"]["mount"] == {"x_m": 0.2, "y_m": 0.0, "theta_rad": 0.0}


# ------------------------------------------------------------------ positions on the globe
def test_a_degree_of_latitude_and_longitude_has_its_length() -> None:
    """The radii of curvature of the ellipsoid: M = a (1 - e^2) / w^3 along a meridian, N cos lat along a parallel."""
    for lat in (-60.0, 0.0, 48.1, 89.0):
        w = np.sqrt(1 - E2 * np.sin(np.radians(lat)) ** 2)
        step = 1e-5
        north = to_tangent_plane([lat + step, 11.0, 0.0], [lat, 11.0, 0.0])
        east = to_tangent_plane([lat, 11.0 + step, 0.0], [lat, 11.0, 0.0])
        np.testing.assert_allclose(north[1] / np.radians(step), A_M * (1 - E2) / w**3, rtol=1e-6)
        np.testing.assert_allclose(east[0] / np.radians(step), A_M / w * np.cos(np.radians(lat)), rtol=1e-6)
        np.testing.assert_allclose(to_tangent_plane([lat, 11.0, 7.0], [lat, 11.0, 2.0]), [0, 0, 5], atol=1e-8)


def test_the_poles_and_the_equator_are_where_the_ellipsoid_has_them() -> None:
    np.testing.assert_allclose(earth_centred([0, 0, 0]), [A_M, 0, 0], atol=1e-8)
    np.testing.assert_allclose(earth_centred([90, 0, 0]), [0, 0, A_M * (1 - FLATTENING)], atol=1e-8)
    np.testing.assert_allclose(to_tangent_plane(geodetic([120.0, -35.0, 4.0]), ORIGIN), [120, -35, 4], atol=1e-6)


def test_messages_without_a_fix_are_left_out(tmp_path: Path) -> None:
    messages = [odometry(T0 + k, pose(0, 0, 0)) for k in (0, 10)]
    messages += [
        fix(T0 + 20, [48.0, 11.0, 0.0]),
        fix(T0 + 30, [48.0, 11.0, np.nan]),
        fix(T0 + 40, [0, 0, 0], status=-1),
    ]
    log = open_log(bag_of(tmp_path, messages), topics={"/odom": TOPICS["/odom"], "/fix": {"type": "fix"}})
    assert sum(isinstance(event, Fix) for event in log.events) == 2
    assert [line.split(": ", 1)[1] for line in log.skipped] == ["/fix: 1 messages without a fix"]


def test_a_satellite_truth_only_scores(tmp_path: Path) -> None:
    messages = [odometry(T0 + k * 10**9, pose(k, 0, 0)) for k in range(3)]
    messages += [fix(T0 + 10**9, geodetic([3.0, 4.0, 0.0]))]
    topics = {"/odom": TOPICS["/odom"], "/fix": {"type": "truth", "origin": list(ORIGIN)}}
    log = open_log(bag_of(tmp_path, messages), topics=topics)
    np.testing.assert_allclose(log.gps["robot"].xy, [[3, 4]], atol=1e-6)


# ------------------------------------------------------------------ each type of message
@pytest.mark.parametrize(
    ("kind", "fields", "topic", "u"),
    [
        ("geometry_msgs/msg/Twist", twist(1.0, 0.5), {"type": "unicycle"}, [1.0, 0.5]),
        ("geometry_msgs/msg/TwistStamped", {"twist": twist(1.0, 0.5)}, {"type": "unicycle"}, [1.0, 0.5]),
        ("geometry_msgs/msg/TwistStamped", {"twist": twist(1.0, 0.5)}, {"type": "velocity_3d"},
         [1.0, 0.1, 0.2, 0.3, 0.4, 0.5]),
        ("geometry_msgs/msg/TwistWithCovarianceStamped", {"twist": {"twist": twist(2.0, 0.25)}}, {"type": "unicycle"},
         [2.0, 0.25]),
        ("ackermann_msgs/msg/AckermannDriveStamped", {"drive": {"speed": 2.0, "steering_angle": 0.25}},
         {"type": "ackermann"}, [2.0, 0.25]),
        ("ackermann_msgs/msg/AckermannDrive", {"speed": 2.0, "steering_angle": 0.25}, {"type": "ackermann"},
         [2.0, 0.25]),
    ],
)  # fmt: skip
def test_velocities_are_controls(
    kind: str, fields: dict[str, Any], topic: dict[str, Any], u: list[float], tmp_path: Path
) -> None:
    stamped = {"header": header_fields(T0 + 5, "base_link")} if "Stamped" in kind else {}
    path = bag_of(tmp_path, [Outgoing("/drive", kind, T0, stamped | fields)])
    (control,) = open_log(path, topics={"/drive": topic}).events
    assert isinstance(control, Control) and control.u.tolist() == u
    assert control.t_ns == (T0 + 5 if stamped else T0)
    assert (
        open_log(path, topics={"/drive": topic | {"time": "recorded", "shift_s": -0.5}}).events[0].t_ns
        == T0 - 5 * 10**8
    )


def test_own_noise_is_that_of_the_twist_over_the_interval(tmp_path: Path) -> None:
    path = bag_of(tmp_path, [odometry(T0 + k * 10**8, pose(0.1 * k, 0, 0), 1.0) for k in range(2)])
    (moved,) = open_log(path, topics={"/odom": {"type": "odometry_2d", "own_noise": True}}).events
    np.testing.assert_allclose(moved.cov, np.diag([0.01, 1, 0.02]) * 0.01)
    held = open_log(path, topics={"/odom": {"type": "unicycle", "own_noise": True}}).events
    np.testing.assert_allclose(held[0].cov, np.diag([0.01, 0.02]))


@pytest.mark.parametrize("kind", ["odometry_2d", "unicycle", "odometry_3d"])
def test_own_noise_that_is_not_finite_is_refused(kind: str, tmp_path: Path) -> None:
    sent = [odometry(T0 + k * 10**8, pose(0.1 * k, 0, 0), 1.0) for k in range(2)]
    sent[1].fields["twist"]["covariance"][:] = np.nan
    path = bag_of(tmp_path, sent)
    with pytest.raises(LogError, match=r"noise .*nan.*, expected finite numbers"):
        open_log(path, topics={"/odom": {"type": kind, "own_noise": True}})


# ------------------------------------------------------------------ the robot itself
def corners(*points: tuple[float, float]) -> list[dict[str, float]]:
    return [{"x": x, "y": y} for x, y in points]


SQUARE = ((10.0, 20.0), (30.0, 20.0), (30.0, 40.0), (10.0, 40.0))
AWAY = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]


def hypotheses(*named: tuple[str, float]) -> list[dict[str, Any]]:
    return [{"hypothesis": {"class_id": name, "score": score}} for name, score in named]


@pytest.mark.parametrize(
    ("kind", "fields", "topic", "y", "ids"),
    [
        ("sensor_msgs/msg/Range", {"range": 2.5, "max_range": 9.0}, {"landmark": "b1"}, [[2.5]], ("b1",)),
        ("sensor_msgs/msg/Range", {"range": 9.5, "max_range": 9.0}, {"landmark": "b1"}, [], None),
        ("vision_msgs/msg/Detection2DArray",
         {"detections": [{"id": "7", "bbox": {"center": {"position": {"x": 4.0, "y": 5.0}}}},
                         {"id": "", "results": hypotheses(("a", 0.2), ("b", 0.8))}]}, {}, [[4, 5], [0, 0]], (7, "b")),
        ("vision_msgs/msg/Detection3DArray",
         {"detections": [{"id": "x", "bbox": {"center": AT}, "results": hypotheses(("post", 1.0))}]},
         {"take": ["x_m", "y_m", "z_m"]}, [[1, 2, 3]], ("x",)),
        ("vision_msgs/msg/Detection3DArray",
         {"detections": [{"id": "x", "bbox": {"center": AT}, "results": hypotheses(("post", 1.0))}]},
         {"ids": "class"}, [AWAY], ("post",)),
        ("vision_msgs/msg/Detection3DArray", {"detections": [{"id": "x", "bbox": {"center": AT}}]},
         {"ids": "none", "take": ["elevation_rad"]}, [[np.arctan2(3, np.hypot(1, 2))]], (None,)),
        ("visualization_msgs/msg/MarkerArray",
         {"markers": [{"id": 4, "pose": AT}, {"id": 5, "action": 3, "pose": AT}, {"id": 4, "pose": AT}]}, {}, [AWAY],
         (4,)),
        ("visualization_msgs/msg/Marker", {"id": 4, "pose": AT}, {}, [AWAY], (4,)),
        ("visualization_msgs/msg/MarkerArray", {"markers": [{"ns": "a", "id": 4, "pose": AT}, {"ns": "b", "pose": AT}]},
         {}, [AWAY, AWAY], ("a/4", "b/0")),
        ("apriltag_msgs/msg/AprilTagDetectionArray",
         {"detections": [{"id": 3, "corners": corners(*SQUARE)}, {"id": 4, "corners": corners(*SQUARE), "hamming": 3}]},
         {"size_m": 0.2}, [[*np.ravel(SQUARE), 0.2]], (3,)),
        ("apriltag_msgs/msg/AprilTagDetectionArray", {"detections": [{"id": 3, "corners": corners(*SQUARE)}]},
         {"size_m": 0.2, "sizes": {"3": 0.4}}, [[*np.ravel(SQUARE), 0.4]], (3,)),
        ("aruco_msgs/msg/MarkerArray", {"markers": [{"id": 6, "pose": {"pose": AT}}]}, {}, [AWAY], (6,)),
    ],
)  # fmt: skip
def test_observations_are_scans(
    kind: str, fields: dict[str, Any], topic: dict[str, Any], y: list[Any], ids: Any, tmp_path: Path
) -> None:
    stamped = {} if kind.endswith("visualization_msgs/msg/MarkerArray") else {"header": header_fields(T0, "camera")}
    path = bag_of(tmp_path, [Outgoing("/seen", kind, T0, stamped | fields)])
    (scan,) = open_log(path, topics={"/seen": {"type": "scan"} | topic}).events
    assert isinstance(scan, Scan) and scan.sensor == "seen" and scan.ids == ids
    np.testing.assert_array_equal(scan.y, np.array(y).reshape(len(y), -1) if y else np.empty((0, 0)))


def test_observations_are_left_out_by_their_ids_and_times(tmp_path: Path) -> None:
    t_ns = [T0 + 123_456_789, T0 + 223_456_789]
    listed = [{"id": k, "pose": AT} for k in (4, 5)]
    messages = [Outgoing("/seen", "visualization_msgs/msg/MarkerArray", t, {"markers": listed}) for t in t_ns]
    path = bag_of(tmp_path, messages)

    def ids(ignore: Any) -> list[Any]:
        log = open_log(path, topics={"/seen": {"type": "scan", "take": ["x_m", "y_m", "z_m"], "ignore": ignore}})
        assert [line.split(": ", 1)[1] for line in log.skipped] == ["/seen: 2 observations that `ignore` names"]
        return [event.ids for event in log.events]

    assert ids([5]) == [(4,), (4,)]
    assert ids({5: [1700000000.123456789], "4": ["1700000000.223456789"]}) == [(4,), (5,)]
    for wrong in (5, "5", {5: 1}, {5: ["soon"]}):
        with pytest.raises(LogError, match=r"ignore is .*, expected a list of ids, or a mapping"):
            open_log(path, topics={"/seen": {"type": "scan", "ignore": wrong}})


def cloud(points: np.ndarray, names: str = "x y z id") -> dict[str, Any]:
    """Return the fields of a PointCloud2 of float32 coordinates and 16 bit numbers."""
    kind = np.dtype({"names": names.split(), "formats": ["<f4"] * 3 + ["<u2"] * (len(names.split()) - 3)}, align=True)
    rows = np.zeros(len(points), kind)
    for k, name in enumerate(kind.names or ()):
        rows[name] = points[:, k]
    sorts = {"<f4": 7, "<u2": 4}
    fields = [
        {"name": name, "offset": kind.fields[name][1], "datatype": sorts[kind.fields[name][0].str], "count": 1}
        for name in kind.names
    ]
    return {
        "header": header_fields(T0, "lidar"), "height": 1, "width": len(rows), "fields": fields,
        "point_step": kind.itemsize, "row_step": rows.nbytes, "data": rows.view(np.uint8),
    }  # fmt: skip


def test_points_of_a_cloud_are_taken_by_their_ids_or_clusters(tmp_path: Path) -> None:
    points = np.array([[1, 0, 0, 7], [2, 0, 0, 9], [4, 2, 0, 9], [np.nan, 0, 0, 9]])
    path = bag_of(tmp_path, [Outgoing("/points", "sensor_msgs/msg/PointCloud2", T0, cloud(points))])
    log = open_log(path, topics={"/points": {"type": "scan", "ids": "id"}})
    assert log.events[0].ids == (7, 9) and log.events[0].y.tolist() == [[1, 0, 0], [3, 1, 0]]
    assert [line.split(": ", 1)[1] for line in log.skipped] == ["/points: 1 points without coordinates"]
    (scan,) = open_log(path, topics={"/points": {"type": "scan", "clusters": "id"}}).events
    assert scan.ids == (None, None) and scan.y.tolist() == [[1, 0, 0], [3, 1, 0]]


def test_what_a_camera_sees_is_made_level_for_a_robot_of_the_plane(tmp_path: Path) -> None:
    """A camera that looks ahead has z forward: a marker 3 m ahead and 1 m to the right is at (3, -1)."""
    optical = {"position": {"x": 0.1, "y": 0.0, "z": 0.5}, "orientation": {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}}
    ahead = {"position": {"x": 1.0, "y": 0.0, "z": 3.0}, "orientation": AT["orientation"]}
    messages = [
        tf("/tf_static", T0, transform("base_link", "camera", T0, optical)),
        odometry(T0, pose(0, 0, 0)),
        odometry(T0 + 1, pose(0, 0, 0)),
        Outgoing("/seen", "visualization_msgs/msg/MarkerArray", T0,
                 {"markers": [{"id": 4, "header": header_fields(T0, "camera"), "pose": ahead}]}),
    ]  # fmt: skip
    log = open_log(bag_of(tmp_path, messages), topics={"/odom": TOPICS["/odom"], "/seen": {"type": "scan"}})
    scan = next(event for event in log.events if isinstance(event, Scan))
    np.testing.assert_allclose(scan.y, [[3, -1]], atol=1e-12)
    assert log.sensor_columns["robot", "seen"] == ("x_m", "y_m")


# ------------------------------------------------------------------ what is wrong
@pytest.mark.parametrize(
    ("topics", "said"),
    [
        (None, "log.topics is missing"),
        ({"/odm": {"type": "odometry_2d"}}, "no topic '/odm', expected .*; did you mean '/odom'"),
        ({"/odom": {"type": "odometry2d"}}, "type is 'odometry2d', expected one of .*; did you mean 'odometry_2d'"),
        ({"/odom": {"type": "odometry_2d", "robt": "a"}}, "unknown key 'robt'.*; did you mean 'robot'"),
        ({"/odom": "odometry_2d"}, "is 'odometry_2d', expected a mapping with a type"),
        ({"/odom": {"type": "scan"}}, "type nav_msgs/Odometry .odometry., expected one of .*LaserScan"),
        ({"/tf": {"type": "truth"}}, "expected `frame` and `child_frame`"),
        ({"/odom": {"type": "odometry_2d"}, "/truth": {"type": "odometry_2d"}}, "both controls of 'robot'"),
        ({"/fix": {"type": "fix", "origin": [1, 2]}}, "origin is .1, 2., expected .latitude_deg"),
        ({"/fix": {"type": "fix", "sigma_m": -1.0}}, "sigma_m is -1.0, expected a positive number"),
        ({"/fix": {"type": "fix", "sigma_z_m": 2.0}}, "sigma_m is None, expected a positive number beside sigma_z_m"),
        ({"/truth": {"type": "fix"}}, "the position has no covariance, expected .* sigma_m"),
        ({"/scan": {"type": "scan", "take": ["depth"]}}, "take has depth, expected some of range_m"),
    ],
)
def test_a_topic_that_cannot_be_gets_one_line(topics: Any, said: str, bags: dict[str, Path]) -> None:
    with pytest.raises(LogError, match=said) as error:
        open_log(bags["mcap"], topics=topics)
    assert "\n" not in str(error.value)


def test_an_unknown_type_of_message_gets_one_line(tmp_path: Path) -> None:
    path = bag_of(tmp_path, [Outgoing("/other", "some_msgs/msg/Other", T0, {"value": 1.0})])
    with pytest.raises(LogError, match="/other has messages of the type some_msgs/Other, expected one of"):
        open_log(path, topics={"/other": {"type": "fix"}})


def test_a_topic_without_messages_gets_one_line(tmp_path: Path) -> None:
    path = bag_of(tmp_path, [odometry(T0 + k, pose(0, 0, 0)) for k in range(2)], "sqlite3")
    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        database.execute("delete from messages")
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 2", "message_count: 0"))
    with pytest.raises(LogError, match="topic /odom has no messages"):
        open_log(path, topics={"/odom": TOPICS["/odom"]})


def test_a_log_of_a_bag_uses_its_inertial_unit_and_its_satellite_fixes(bags: dict[str, Path]) -> None:
    """So the map that is the same from all containers is made of them, too."""
    events = events_of(bags["mcap"])
    kinds = [event.sensor if isinstance(event, Scan) else type(event).__name__ for event in events]
    assert {kind: kinds.count(kind) for kind in ("gyro", "compass", "Fix")} == {"gyro": 398, "compass": 40, "Fix": 40}


@pytest.mark.parametrize(("motion", "sigmas"), [("odometry_2d", (1.5, 1.5)), ("odometry_3d", (1.5, 1.5, 4.0))])
def test_a_height_may_have_a_noise_of_its_own(motion: str, sigmas: tuple[float, ...], bags: dict[str, Path]) -> None:
    topics = {"/odom": {"type": motion}, "/fix": {"type": "fix", "sigma_m": 1.5, "sigma_z_m": 4.0}}
    fix = next(event for event in open_log(bags["mcap"], topics=topics) if isinstance(event, Fix))
    np.testing.assert_array_equal(fix.cov, np.diag(np.square(sigmas)))
