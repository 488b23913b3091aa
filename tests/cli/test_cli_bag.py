"""`kalmark bag`: what it lists, and the configuration that it writes, which runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import Kalmark
from kalmark.bags.first_config import first_config
from kalmark.bags.survey import survey
from kalmark.config import build_slam, load_config, open_run
from kalmark.config.opening import open_config_log
from kalmark.errors import LogError
from kalmark.events import Control, Scan
from kalmark.logs import open_log

pytest.importorskip("rosbags", reason="rosbags is not installed: no bag can be read")

from ros_bags import (
    MOUNT,
    START,
    Outgoing,
    field,
    fix,
    geodetic,
    header_fields,
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
    unmeasured = {"header": header_fields(T0, "imu"), "angular_velocity_covariance": np.full(9, -1.0)}
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


@pytest.mark.parametrize(("roll", "up"), [(90.0, (0.0, 1.0, 0.0)), (180.0, (0.0, 0.0, -1.0)), (0.0, (0.0, 0.0, 1.0))])
def test_gravity_says_how_an_inertial_unit_lies_that_tf_does_not_have(
    roll: float, up: tuple[float, ...], tmp_path: Path
) -> None:
    """The robot drives round: its rate about the vertical is on the axis that points up; one second it rests."""
    rows, u = [odometry(T0 + k * 10**8, pose(0.1 * k, 0, 0.02 * k)) for k in range(40)], np.array(up)
    for k in range(400):
        turns = 0.0 if k < 100 else 0.2
        across = np.array([0.0, 0.0, 3.0]) if roll == 90 else np.array([0.0, 3.0, 0.0])  # inward, as it turns
        rows.append(imu(T0 + k * 10**7, turns * u, a=9.8 * u + (across if turns else 0.0)))
    text = config_of(tmp_path, sorted(rows, key=lambda m: m.t_ns))
    assert (f"mount: {{roll_deg: {roll:g}, pitch_deg: 0}}" in text) == (roll != 0)
    log = open_config_log(load_config(tmp_path / "config.yaml"))
    rates = [e.y[0, 0] for e in log.events if isinstance(e, Scan) and e.sensor == "gyro"]
    np.testing.assert_allclose(rates[-1], 0.2, atol=1e-6)


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
        "header": header_fields(10**9, "map"),
        "pose": {"pose": pose(1, 2, 0), "covariance": np.eye(6).ravel()},
    }
    messages.append(Outgoing("/amcl_pose", "geometry_msgs/msg/PoseWithCovarianceStamped", T0 + 5, located))
    text = config_of(tmp_path, messages)
    assert text.count("time: recorded") == 2
    assert open_run(tmp_path / "config.yaml")[1].events[-1].t_ns == T0 + 5


def test_the_numbers_of_a_camera_are_those_of_its_info(tmp_path: Path) -> None:
    info = {"header": header_fields(T0, "camera"), "width": 800, "height": 600, "distortion_model": "plumb_bob"}
    info |= {"k": [500.0, 0, 400, 0, 510, 300, 0, 0, 1], "d": [0.1, 0.01, 0, 0, 0]}
    corners = [{"x": float(x), "y": float(y)} for x, y in ((10, 20), (30, 20), (30, 40), (10, 40))]
    tags = {"header": header_fields(T0, "camera"), "detections": [{"id": 3, "corners": corners}]}
    text = config_of(tmp_path, [
        Outgoing("/camera_info", "sensor_msgs/msg/CameraInfo", T0, info),
        Outgoing("/tags", "apriltag_msgs/msg/AprilTagDetectionArray", T0, tags),
    ])  # fmt: skip
    assert (
        "tag_corners, fx_px: 500, fy_px: 510, cx_px: 400, cy_px: 300, width_px: 800, height_px: 600, lens: radtan"
        in text
    )
    assert "landmarks: {type: tag}" in text and "motion: {type: constant_velocity_3d" in text
    assert "CameraInfo; GUESS: the images were not rectified" in text
    assert "GUESS: the edge of the tags" in text, "a wrong one is a map of a wrong scale"


@pytest.mark.parametrize(
    ("info", "said"),
    [
        (
            {"distortion_model": "double_sphere", "d": [0.1]},
            "distortion_model is 'double_sphere', expected one of radtan",
        ),
        ({"distortion_model": "rational_polynomial", "d": [0.1] * 8}, "at most the 5 coefficients of radtan"),
        ({"k": [0.0] * 9}, "focal lengths 0, 0 of a camera that is not calibrated"),
    ],
)
def test_the_numbers_of_a_camera_that_kalmark_does_not_have_are_to_be_given(
    info: dict[str, Any], said: str, tmp_path: Path
) -> None:
    given = {
        "header": header_fields(T0, "camera"),
        "width": 800,
        "height": 600,
        "k": [500.0, 0, 400, 0, 510, 300, 0, 0, 1],
    }
    boxes = {
        "header": header_fields(T0, "camera"),
        "detections": [{"bbox": {"center": {"position": {"x": 9.0, "y": 9.0}}}}],
    }
    text = config_of(tmp_path, [
        Outgoing("/camera_info", "sensor_msgs/msg/CameraInfo", T0, given | info),
        Outgoing("/boxes", "vision_msgs/msg/Detection2DArray", T0, boxes),
    ])  # fmt: skip
    assert "GUESS: its numbers: /camera_info has " in text and said in text and "# not used: /camera_info" in text


def test_images_are_counted_and_the_configuration_says_what_to_do_with_them(kalmark: Kalmark, tmp_path: Path) -> None:
    image = Outgoing("/camera/image_raw", "sensor_msgs/msg/Image", T0, {"header": header_fields(T0, "camera")})
    text = config_of(tmp_path, [image, odometry(T0, pose(0, 0, 0)), odometry(T0 + 9, pose(1, 0, 0))])
    assert "# not used: /camera/image_raw (sensor_msgs/Image): images: `{type: images}` gives them to" in text
    assert "images" in kalmark("bag", tmp_path / "mcap").out


# ------------------------------------------------------------------ what bags of the field have
def test_an_odometry_whose_poses_stand_still_is_taken_for_its_velocities(tmp_path: Path) -> None:
    text = config_of(tmp_path, [odometry(T0 + t * 10**8, pose(0, 0, 0), 1.0, 0.1) for t in range(5)])
    assert "/odom: {type: unicycle}" in text and "GUESS: its velocities, because its poses stand still" in text


def test_velocities_and_satellite_fixes_start_with_an_unknown_heading(tmp_path: Path) -> None:
    twist = {"header": header_fields(T0, "base_link"), "twist": {"linear": {"x": 1.0}}}
    messages = [Outgoing("/twist", "geometry_msgs/msg/TwistStamped", T0, twist)]
    messages += [fix(T0 + t * 10**9, geodetic([float(t), 0.0, 0.0])) for t in range(5)]
    assert "theta_rad: 0, sigma_xy_m: 5, sigma_theta_rad: 1.5}  # GUESS" in config_of(tmp_path, messages)


@pytest.mark.parametrize("space", [False, True])
def test_a_robot_without_controls_goes_on_as_it_goes(space: bool, tmp_path: Path) -> None:
    beams = {"header": header_fields(T0, "laser"), "angle_increment": 0.1, "range_max": 9.0, "ranges": [1.0, 2.0]}
    if space:
        messages = [fix(T0 + t * 10**9, geodetic([0.0, 0.0, 0.0])) for t in range(3)]
    else:
        messages = [Outgoing("/scan", "sensor_msgs/msg/LaserScan", T0, beams)]
    text = config_of(tmp_path, messages)
    assert f"motion: {{type: {'constant_velocity_3d' if space else 'constant_velocity'}," in text
    open_run(tmp_path / "config.yaml")


def markers(frame: str, w: float = 1.0, topic: str = "/markers") -> Outgoing:
    """Return two markers, of which one has the place of the other; w of 0 leaves their rotations away."""
    listed = [
        {"id": k, "header": header_fields(T0, frame), "pose": {"position": {"x": 1.0 + k}, "orientation": {"w": w}}}
        for k in range(2)
    ]
    return Outgoing(topic, "visualization_msgs/msg/MarkerArray", T0, {"markers": listed})


def test_markers_in_a_frame_of_the_world_are_a_map_and_no_observations(tmp_path: Path) -> None:
    messages = [
        odometry(T0, pose(0, 0, 0)),
        odometry(T0 + 1, pose(1, 0, 0)),
        markers("map"),
        markers("odom", topic="/b"),
    ]
    text = config_of(tmp_path, messages)
    assert text.count("is one of the world: a map, not what a sensor of the robot sees") == 2


def test_an_inertial_unit_moves_a_robot_of_space_without_other_controls(tmp_path: Path) -> None:
    units = [
        imu(T0 + k * 5 * 10**6, (0.001 * (-1) ** k, 0.0, 0.0), a=(0.01 * (-1) ** k, 0.0, 9.81)) for k in range(300)
    ]
    text = config_of(tmp_path, units)
    assert "/imu: {type: inertial}" in text and "motion: {type: inertial, preset: mems_imu}" in text
    assert "gyro" not in text, "a unit that moves the robot is no sensor of it as well"
    config, log = open_run(tmp_path / "config.yaml")
    slam = build_slam(config, log)
    for event in log.events:
        slam.process(event)
    assert np.linalg.norm(slam.mean("robot")[:3]) < 0.1
    beams = {"header": header_fields(T0, "laser"), "angle_increment": 0.1, "range_max": 9.0, "ranges": [1.0, 2.0]}
    (tmp_path / "flat").mkdir()
    assert "type: inertial" not in config_of(
        tmp_path / "flat", [*units, Outgoing("/scan", "sensor_msgs/msg/LaserScan", T0, beams)]
    )


@pytest.mark.parametrize("frame", ["odom", "vicon"])
def test_fixes_say_where_a_robot_starts_unless_the_truth_is_in_their_frame(frame: str, tmp_path: Path) -> None:
    messages = [odometry(T0 + t * 10**9, pose(t, 0, 0)) for t in range(5)]
    for k, (topic, kind, x) in enumerate((("/amcl", "PoseWithCovarianceStamped", 3.0), ("/vicon", "PoseStamped", 7.0))):
        at = {"pose": pose(x, 0, 0), "covariance": np.eye(6).ravel()} if k == 0 else pose(x, 0, 0)
        fields = {"header": header_fields(T0, "odom" if k == 0 else frame), "pose": at}
        messages.append(Outgoing(topic, f"geometry_msgs/msg/{kind}", T0, fields))
    text = config_of(tmp_path, messages)
    assert "/vicon: {type: truth}" in text and ("start: {x_m: 3" in text) == (frame == "vicon")


def test_satellite_positions_that_are_the_truth_by_their_name_only_score(tmp_path: Path) -> None:
    fixes = [fix(T0 + t * 10**9, geodetic([float(t), 0.0, 0.0])) for t in range(3)]
    messages = [odometry(T0 + t * 10**9, pose(t, 0, 0)) for t in range(3)]
    text = config_of(tmp_path, [*messages, *(each._replace(topic="/gps_truth/fix") for each in fixes)])
    assert "/gps_truth/fix: {type: truth}" in text
    assert len(open_run(tmp_path / "config.yaml")[1].gps["robot"].xy) == 3


def test_a_message_whose_definition_lacks_a_field_is_listed_and_refused_with_one_line(
    kalmark: Kalmark, tmp_path: Path
) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    kind = "sensor_msgs/msg/Range"
    store.register(get_types_from_msg("float32 range\nfloat32 min_range\n", kind))
    with Writer(tmp_path / "odd.bag") as writer:
        connection = writer.add_connection("/sonar", kind, typestore=store)
        writer.write(connection, T0, store.serialize_ros1(store.types[kind](range=1.0, min_range=0.1), kind))
    said = "sensor_msgs/msg/Range, as the bag defines it, has no field 'max_range'"
    assert said in first_config(survey(tmp_path / "odd.bag"))
    with pytest.raises(LogError, match=said):
        open_log(tmp_path / "odd.bag", topics={"/sonar": {"type": "scan", "landmark": "post"}})


def test_markers_without_rotations_are_points(tmp_path: Path) -> None:
    empty = Outgoing("/markers", "visualization_msgs/msg/MarkerArray", T0, {})
    base = tf("/tf_static", T0, transform("base_link", "camera", T0, pose(0.5, 0, 0)))
    text = config_of(tmp_path, [base, odometry(T0, pose(0, 0, 0)), odometry(T0 + 1, pose(1, 0, 0)), empty,
                                markers("camera", w=0.0)])  # fmt: skip
    assert "markers: {type: position}  # its mount is that of tf" in text
    log = open_run(tmp_path / "config.yaml")[1]
    assert log.events[0].y.tolist() == [] and log.events[1].y.tolist() == [[1.0, 0.0], [2.0, 0.0]]
    assert log.describes["robots"]["robot"]["sensors"]["markers"]["mount"]["x_m"] == 0.5


@pytest.mark.parametrize("levels", ["", "/fleet"])
def test_frames_with_the_prefix_of_a_robot_are_its_own(levels: str, tmp_path: Path) -> None:
    """Of commanded velocities, which name no frame."""
    messages = []
    for k, name in enumerate(("a", "b")):
        messages += [Outgoing(f"{levels}/{name}/cmd_vel", "geometry_msgs/msg/Twist", T0, {"linear": {"x": 1.0}})]
        messages += [tf("/tf_static", T0, transform(f"{name}/base_link", f"{name}/camera", T0, pose(k + 1.0, 0, 0)))]
        messages += [markers(f"{name}/camera", topic=f"{levels}/{name}/seen")]
    text = config_of(tmp_path, messages)
    assert text.count("its mount is that of tf") == 2 and f"{levels}/b/cmd_vel: {{type: unicycle, robot: b}}" in text
    robots = open_run(tmp_path / "config.yaml")[1].describes["robots"]
    assert [m["mount"]["x_m"] for name in "ab" for m in robots[name]["sensors"].values()] == [1.0, 2.0]


def test_two_odometries_of_one_robot_are_not_two_robots(tmp_path: Path) -> None:
    messages = [
        odometry(T0 + t, pose(t, 0, 0), topic=f"/{name}/odom") for t in range(3) for name in ("wheel", "visual")
    ]
    messages += [tf("/tf", T0 + t, transform("odom", "base_link", T0 + t, pose(t, 0, 0))) for t in range(3)]
    text = config_of(tmp_path, messages)
    assert "/visual/odom: {type: odometry_2d}  #" in text and "# not used: /wheel/odom" in text


def test_robots_whose_odometry_is_in_tf_alone_have_their_names_there(tmp_path: Path) -> None:
    messages = []
    for t in range(3):
        messages += [
            tf("/tf", T0 + t, transform(f"{n}/odom", f"{n}/base_link", T0 + t, pose(t * (1 + (n == "b")), 0, 0)))
            for n in "ab"
        ]
    text = config_of(tmp_path, [*messages, markers("b/base_link", topic="/b/seen")])
    assert "frame: a/odom, child_frame: a/base_link, robot: a}" in text
    assert "'/tf of b': {topic: /tf, type: odometry_2d, frame: b/odom, child_frame: b/base_link, robot: b}" in text
    assert "sensor: b_seen, take: [x_m, y_m], robot: b" in text
    log = open_run(tmp_path / "config.yaml")[1]
    moved = {(e.robot, e.u.tolist()[0]) for e in log.events if isinstance(e, Control)}
    assert moved == {("a", 1.0), ("b", 2.0)} and log.robots == ("a", "b")


@pytest.mark.parametrize("kind", ["all", "some"])
def test_a_time_of_0_in_headers_is_none(kind: str, tmp_path: Path) -> None:
    messages = [odometry(T0 + t * 10**9, pose(t, 0, 0)) for t in range(4)]
    for message in messages if kind == "all" else messages[:1]:
        message.fields["header"] = header_fields(0, "odom")
    text = config_of(tmp_path, messages)
    assert ("time: recorded" in text) == (kind == "all")
    log = open_run(tmp_path / "config.yaml")[1]
    assert [event.t_ns for event in log.events] == [m.t_ns for m in messages[1 if kind == "all" else 2 :]]
    assert [line.split(": ", 1)[1] for line in log.skipped] == (
        [] if kind == "all" else ["/odom: 1 messages with a time of 0; `time: recorded` takes the recorder's"]
    )


@pytest.mark.parametrize(("back_ns", "wanted"), [(3600 * 10**9, "time: recorded"), (1, "on_error: skip")])
def test_a_clock_that_was_set_back_gives_way_to_the_recorder(back_ns: int, wanted: str, tmp_path: Path) -> None:
    messages = [odometry(T0 + t * 10**9, pose(t, 0, 0)) for t in range(6)]
    late = messages[3:] if back_ns > 1 else messages[3:4]
    for message in late:
        message.fields["header"] = header_fields(message.t_ns - back_ns - (10**9 if back_ns == 1 else 0), "odom")
    text = config_of(tmp_path, messages)
    assert wanted in text and ("runs back by 3.6e+03 s" in text or "run back by 1e-09 s" in text)
    controls = open_run(tmp_path / "config.yaml")[1].events
    assert sum(control.u[0] for control in controls) == pytest.approx(5)


def test_positions_without_a_covariance_get_a_guess(tmp_path: Path) -> None:
    bare = {"header": header_fields(T0, "map"), "pose": {"pose": pose(0, 0, 0)}}
    messages = [odometry(T0, pose(0, 0, 0)), odometry(T0 + 1, pose(1, 0, 0)), fix(T0, [48.0, 11.0, 0.0], sigma=0.0),
                Outgoing("/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", T0, bare)]  # fmt: skip
    text = config_of(tmp_path, messages)
    assert "/pose: {type: fix, sigma_m: 0.5}" in text and "sigma_m: 2}" in text
    open_run(tmp_path / "config.yaml")


def test_poses_that_a_robot_is_to_have_are_not_its_odometry(tmp_path: Path) -> None:
    goals = [Outgoing("/goal_pose", "geometry_msgs/msg/PoseStamped", T0 + t, {"header": header_fields(T0 + t, "map"),
             "pose": pose(t, 0, 0)}) for t in range(20)]  # fmt: skip
    assert "# not used: /goal_pose" in config_of(tmp_path, [*goals, fix(T0, [48.0, 11.0, 0.0])])


def test_a_car_s_wheelbase_is_to_be_looked_at(tmp_path: Path) -> None:
    car = Outgoing("/drive", "ackermann_msgs/msg/AckermannDriveStamped", T0, {"header": header_fields(T0, "base_link")})
    text = config_of(tmp_path, [car])
    assert "motion: {type: ackermann, wheelbase_m: 2.83, encoder_offset_m: 0}  # GUESS: its wheelbase" in text


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
