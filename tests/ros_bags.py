"""Bags written for tests: the same messages as ROS 1, ROS 2 in sqlite3 and ROS 2 in MCAP; a robot among posts."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.bags.mcap_writer import Outgoing, Types, header_fields
from kalmark.events import Control, Event, Scan
from kalmark.logs import Log, open_log
from kalmark.logs.geodesy import earth_centred
from laser_worlds import LaserWorld

KINDS = ("ros1.bag", "sqlite3", "mcap")
ORIGIN = (48.1, 11.6, 520.0)  # deg, deg, m
TOPICS: dict[str, dict[str, Any]] = {
    "/odom": {"type": "odometry_2d"},
    "/scan": {"type": "scan", "sensor": "lidar"},
    "/fix": {"type": "fix", "origin": [*ORIGIN]},
    "/truth": {"type": "truth"},
    "/imu": {"type": "imu", "at": "controls", "heading": "compass", "every_s": 1.0},
}
T0 = 1_700_000_000_000_000_000
AT = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
EXTRA = {  # types that ROS does not define itself
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "ackermann_msgs/msg/AckermannDrive": "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\n"
    "float32 acceleration\nfloat32 jerk\n",
    "ackermann_msgs/msg/AckermannDriveStamped": "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    "apriltag_msgs/msg/AprilTagDetection": "string family\nint32 id\nint32 hamming\nfloat32 goodness\n"
    "float32 decision_margin\napriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography\n",
    "apriltag_msgs/msg/AprilTagDetectionArray": "std_msgs/Header header\n"
    "apriltag_msgs/AprilTagDetection[] detections\n",
    "aruco_msgs/msg/Marker": "std_msgs/Header header\nuint32 id\ngeometry_msgs/PoseWithCovariance pose\n"
    "float64 confidence\n",
    "aruco_msgs/msg/MarkerArray": "std_msgs/Header header\naruco_msgs/Marker[] markers\n",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
    "geometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection2D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox2D bbox\nstring id\n",
    "vision_msgs/msg/Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id\n",
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
    "some_msgs/msg/Other": "float64 value\n",
}


def types(ros1: bool) -> Types:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for kind, text in EXTRA.items():
        if kind not in store.types:
            store.register(get_types_from_msg(text, kind))
    return Types(store)


def write_bag(folder: Path, kind: str, messages: Iterable[Outgoing]) -> Path:
    """Write messages as one of KINDS and return the bag."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    known, ros1 = types(kind == "ros1.bag"), kind == "ros1.bag"
    path = folder / kind
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=plugin) as writer:
        topics: dict[str, Any] = {}
        for topic, name, t_ns, fields in messages:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, name, typestore=known.store)
            made = known.made(name, fields)
            raw = (known.store.serialize_ros1 if ros1 else known.store.serialize_cdr)(made, name)
            writer.write(topics[topic], t_ns, raw)
    return path


def pose(x: float, y: float, theta: float, z: float = 0.0) -> dict[str, Any]:
    """Return the fields of a geometry_msgs/Pose."""
    turn = {"x": 0.0, "y": 0.0, "z": float(np.sin(theta / 2)), "w": float(np.cos(theta / 2))}
    return {"position": {"x": float(x), "y": float(y), "z": float(z)}, "orientation": turn}


def transform(parent: str, child: str, t_ns: int, at: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a geometry_msgs/TransformStamped."""
    moved = {"translation": at["position"], "rotation": at["orientation"]}
    return {"header": header_fields(t_ns, parent), "child_frame_id": child, "transform": moved}


def tf(topic: str, t_ns: int, *transforms: dict[str, Any]) -> Outgoing:
    return Outgoing(topic, "tf2_msgs/msg/TFMessage", t_ns, {"transforms": list(transforms)})


def odometry(t_ns: int, at: dict[str, Any], v: float = 0.0, w: float = 0.0, topic: str = "/odom") -> Outgoing:
    twist = {"linear": {"x": v, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": w}}
    fields = {"header": header_fields(t_ns, "odom"), "child_frame_id": "base_link"}
    fields |= {"pose": {"pose": at, "covariance": np.zeros(36)}}
    fields |= {"twist": {"twist": twist, "covariance": np.diag([0.01, 1, 1, 1, 1, 0.02]).ravel()}}
    return Outgoing(topic, "nav_msgs/msg/Odometry", t_ns, fields)


def geodetic(enu: Any) -> list[float]:
    """Return latitude, longitude (deg) and height (m) of a point east, north, up of ORIGIN, by Newton's method."""
    lat, lon = np.radians(ORIGIN[:2])
    s, c, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    R = np.array([[-sl, cl, 0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
    goal, lla = earth_centred(ORIGIN) + np.asarray(enu) @ R, np.array(ORIGIN)
    for _ in range(6):
        steps = np.array([1e-5, 1e-5, 1.0])
        J = np.column_stack([(earth_centred(lla + d) - earth_centred(lla - d)) for d in np.diag(steps)]) / (2 * steps)
        lla = lla + np.linalg.solve(J, goal - earth_centred(lla))
    return [float(v) for v in lla]


POSTS = np.array(
    [(4, 3), (9, -3), (12, 4), (17, 0.5), (14, 10), (7, 9), (2, 12), (-3, 7), (-2, 1), (18, 7)], dtype=float
)
RADIUS = 0.15
MOUNT = (0.3, 0.05, 0.2)
START = (0.0, 0.0, 0.1)
BEAMS = 541


def drive(seconds: float = 40.0, hz: float = 10.0) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) ns and true poses (N, 3) of a round among the posts."""
    n = int(seconds * hz)
    t_ns = 1_700_000_000_000_000_000 + np.arange(n) * round(1e9 / hz)
    poses = np.empty((n, 3))
    poses[0], v, w, dt = START, 1.0, 2 * np.pi / seconds, 1 / hz
    for k in range(1, n):
        x, y, a = poses[k - 1]
        poses[k] = x + v * dt * np.cos(a + w * dt / 2), y + v * dt * np.sin(a + w * dt / 2), a + w * dt
    return t_ns, poses


GYRO_BIAS, IMU_TURN = 0.01, np.pi / 2  # rad/s; how its x axis is turned from the robot's


def imu(
    t_ns: int, w: Any, q: Any = (0.0, 0.0, 0.0, 1.0), spread: float = 0.0, a: Any = (0.0, 0.0, 9.8), topic: str = "/imu"
) -> Outgoing:
    """Return an Imu: rates (3,), orientation (4,) with the variance `spread`, unknown at 0 and absent at -1."""
    fields: dict[str, Any] = {"header": header_fields(t_ns, "imu")}
    fields["angular_velocity"] = dict(zip("xyz", map(float, w), strict=True))
    fields["angular_velocity_covariance"] = np.diag([1e-4, 1e-4, 1e-4]).ravel()
    fields["orientation"] = dict(zip("xyzw", map(float, q), strict=True))
    fields["orientation_covariance"] = np.diag([spread] * 3).ravel()
    fields["linear_acceleration"] = dict(zip("xyz", map(float, a), strict=True))
    return Outgoing(topic, "sensor_msgs/msg/Imu", t_ns, fields)


def field(t_ns: int, b: Any) -> Outgoing:
    """Return a MagneticField (3,)."""
    fields = {"header": header_fields(t_ns, "imu"), "magnetic_field": dict(zip("xyz", map(float, b), strict=True))}
    return Outgoing("/mag", "sensor_msgs/msg/MagneticField", t_ns, fields)


def robot_among_posts(seed: int = 1, inertial: bool = True) -> list[Outgoing]:
    """Return odometry (10 Hz), a laser (5 Hz), satellite fixes (1 Hz), an Imu (50 Hz), tf and truth of a robot."""
    out, random = _robot_among_posts(seed), np.random.default_rng(seed + 100)
    if not inertial:
        return out
    t_ns, poses = drive()
    here = pose(0.1, 0, IMU_TURN)
    units = [tf("/tf_static", int(t_ns[0]), transform("base_link", "imu", int(t_ns[0]), here))]
    w, dt_ns = 2 * np.pi / 40.0, 20_000_000
    for t in range(int(t_ns[0]), int(t_ns[-1]), dt_ns):
        heading = poses[0, 2] + w * (t - t_ns[0]) * 1e-9 + IMU_TURN + random.normal(0, 0.02)
        q = (0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2))
        units.append(imu(t, (0.0, 0.0, w + GYRO_BIAS + random.normal(0, 0.01)), q, 0.0004))
    return sorted([*out, *units], key=lambda message: message.t_ns)


def _robot_among_posts(seed: int) -> list[Outgoing]:
    random = np.random.default_rng(seed)
    t_ns, poses = drive()
    out = [tf("/tf_static", int(t_ns[0]), transform("base_link", "laser", int(t_ns[0]), pose(*MOUNT, z=0.2)))]
    angles = np.linspace(-0.75 * np.pi, 0.75 * np.pi, BEAMS)
    here = np.zeros(3)  # where odometry believes to be
    for k, (t, true) in enumerate(zip(t_ns.tolist(), poses, strict=True)):
        if k:
            c, s = np.cos(poses[k - 1, 2]), np.sin(poses[k - 1, 2])
            dx, dy = np.array([[c, s], [-s, c]]) @ (true[:2] - poses[k - 1, :2])
            step = np.array([dx, dy, true[2] - poses[k - 1, 2]]) + random.normal(0, (0.01, 0.002, 0.004))
            c, s = np.cos(here[2]), np.sin(here[2])
            here += np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ step
        out.append(odometry(t, pose(*here), 1.0, 0.15))
        out.append(tf("/tf", t, transform("odom", "base_link", t, pose(*here))))
        out.append(
            Outgoing(
                "/truth", "geometry_msgs/msg/PoseStamped", t, {"header": header_fields(t, "map"), "pose": pose(*true)}
            )
        )
        if k % 2 == 0:
            out.append(laser_scan(t, true, angles, random))
        if k % 10 == 5:
            out.append(fix(t, geodetic([*(true[:2] + random.normal(0, 0.5, 2)), 0.0])))
    return out


def laser_scan(t_ns: int, true: np.ndarray, angles: np.ndarray, random: np.random.Generator) -> Outgoing:
    c, s = np.cos(true[2]), np.sin(true[2])
    at = true[:2] + np.array([[c, -s], [s, c]]) @ MOUNT[:2]
    a = true[2] + MOUNT[2]
    local = (POSTS - at) @ np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    world = LaserWorld(np.column_stack([local, np.full(len(POSTS), RADIUS), np.zeros(len(POSTS))]))
    r, _ = world.scan(angles, 0.01, random)
    r[r > 30] = np.inf
    fields = {"header": header_fields(t_ns, "laser"), "angle_min": angles[0], "angle_max": angles[-1]}
    fields |= {"angle_increment": angles[1] - angles[0], "range_min": 0.05, "range_max": 30.0, "ranges": r}
    return Outgoing("/scan", "sensor_msgs/msg/LaserScan", t_ns, fields)


def fix(t_ns: int, lla: list[float], status: int = 0, kind: int = 2, sigma: float = 0.5) -> Outgoing:
    fields: dict[str, Any] = {"header": header_fields(t_ns, "gps"), "status": {"status": status}}
    fields |= dict(zip(("latitude", "longitude", "altitude"), lla, strict=True))
    fields |= {"position_covariance": np.diag([sigma**2, sigma**2, 1.0]).ravel(), "position_covariance_type": kind}
    return Outgoing("/fix", "sensor_msgs/msg/NavSatFix", t_ns, fields)


def same(a: Event, b: Event) -> bool:
    """Return whether two events are the same to the last bit."""
    if type(a) is not type(b) or (a.t_ns, a.robot) != (b.t_ns, b.robot):
        return False
    if isinstance(a, Scan) and isinstance(b, Scan) and (a.sensor, a.ids or ()) != (b.sensor, b.ids or ()):
        none = {None}
        if a.sensor != b.sensor or set(a.ids or none) != none or set(b.ids or none) != none:
            return False
    numbers = [(e.u if isinstance(e, Control) else e.y, e.cov) for e in (a, b)]
    return all(
        (x is None) == (y is None) and (x is None or (x.shape == y.shape and x.tobytes() == y.tobytes()))
        for x, y in zip(*numbers, strict=True)
    )


def same_logs(a: Log, b: Log) -> bool:
    return (
        len(a.events) == len(b.events)
        and all(map(same, a.events, b.events))
        and {r: (p.t_ns.tobytes(), p.poses.tobytes()) for r, p in a.truth.items()}
        == {r: (p.t_ns.tobytes(), p.poses.tobytes()) for r, p in b.truth.items()}
        and {k: v.tobytes() for k, v in a.landmarks.items()} == {k: v.tobytes() for k, v in b.landmarks.items()}
        and (a.control_columns, a.sensor_columns) == (b.control_columns, b.sensor_columns)
        and a.describes == b.describes
    )


def bag_of(tmp_path: Path, messages: Iterable[Outgoing], kind: str = "mcap") -> Path:
    return write_bag(tmp_path, kind, messages)


def twist(v: float, w: float) -> dict[str, Any]:
    return {"linear": {"x": v, "y": 0.1, "z": 0.2}, "angular": {"x": 0.3, "y": 0.4, "z": w}}


def events_of(path: Path) -> list[Any]:
    return list(open_log(path, topics=TOPICS).events)
