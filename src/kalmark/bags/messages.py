"""The content of each type of message: one row a type in `MESSAGES`.

A row names what can be read from the message: where the robot is (`pose`; `noisy`: with a covariance), how fast it
moves (`twist`), its speed and steering (`drive`), a position on the globe (`globe`), what a sensor saw (`seen`), what
an inertial unit measured (`rates`, `attitude`, `force`), a magnetic field (`field`), frames (`transforms`), a camera
(`camera`), an image in grey values (`image`).  A topic of a configuration (`topics.py`) asks for one of them.  A
function refuses a message by `Refused`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.bags.bag_opening import header_time
from kalmark.bags.topics import Scans
from kalmark.events import unit_quaternion
from kalmark.logs.log import Names, Section
from kalmark.logs.table import Refused
from kalmark.logs.table_columns import BEAM, CORNERS, POSE3, POSITION
from kalmark.vision.camera_calibration import lens

NO_FIX = 0  # of NavSatStatus: what is below has no fix
UNKNOWN_COVARIANCE = 0
NOT_MEASURED = -1  # the first number of a covariance in an Imu that does not measure this
DELETED = 2  # of Marker.action: this and what is above removes markers
TYPES_OF_A_FIELD = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # of PointField


class Measured(NamedTuple):
    """Numbers of a message, with their covariance, None if it is unknown."""

    v: Array
    cov: Array | None = None


@dataclass
class Seen:
    """Part of a scan in one message: rows in the order of `columns`, ids, and numbers of left-out rows by reason."""

    columns: Names
    y: list[list[float]] | Array = field(default_factory=list)
    ids: list[Any] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)

    def add(self, y: Iterable[float], id_: Any) -> None:
        """Add an observation; a second one with the same id is left out."""
        if id_ is not None and id_ in self.ids:
            self.left_out[f"observations of {id_!r} twice in one message"] += 1
            return
        self.y.append(list(y))  # type: ignore[union-attr]
        self.ids.append(id_)

    @classmethod
    def of(cls, columns: Names, rows: Iterable[tuple[Iterable[float], Any]]) -> Seen:
        """Return the observations of these numbers and ids."""
        seen = cls(columns)
        for y, id_ in rows:
            seen.add(y, id_)
        return seen

    def without(self, ignored: Sequence[bool]) -> Seen:
        """Return this without the observations that `ignore` of the topic names."""
        if not any(ignored):
            return self
        rows = [(y, id_) for y, id_, out in zip(self.y, self.ids, ignored, strict=True) if not out]
        left_out = self.left_out + Counter({"observations that `ignore` names": sum(ignored)})
        return Seen(self.columns, [y for y, _ in rows], [id_ for _, id_ in rows], left_out)


Reads = Callable[[Any], Measured | None] | None
"""Reads a measurement of an inertial unit or a compass from a message, None where it has none."""


class Transform(NamedTuple):
    """The frame `child` (7,) in the frame `parent`, at a time (ns)."""

    t_ns: int
    parent: str
    child: str
    frame: Array


@dataclass(frozen=True)
class Message:
    """Contents that can be read from messages of one type, None of what they do not have.

    `pose` (7,) with a covariance (6, 6); `twist` (6,), m/s and rad/s along and about x, y, z of the robot, likewise;
    `globe` (3,), latitude, longitude (deg) and height (m), with the covariance of east, north, up; the measurements of
    an inertial unit or a compass in its own frame (3,), an orientation (4,).
    """

    what: str
    pose: Callable[[Any], Measured] | None = None
    noisy: bool = False
    twist: Callable[[Any], Measured] | None = None
    drive: Callable[[Any], Array] | None = None
    globe: Reads = None
    seen: Callable[[Any, Scans], Seen] | None = None
    rates: Reads = None
    attitude: Reads = None
    force: Reads = None
    field: Reads = None
    transforms: Callable[[Any], list[Transform]] | None = None
    camera: Callable[[Any], Section] | None = None
    image: Callable[[Any], Any] | None = None


# ------------------------------------------------------------------ where it is, how fast it is
NO_ROTATION = "quaternion has length 0, expected 1"


def frame_of(position: Any, rotation: Any, error: type[Exception] = Refused) -> Array:
    """Return the frame (7,) of a position and a quaternion, which is normalised.  Raises `error`."""
    return np.append([position.x, position.y, position.z], unit(rotation, error))


def unit(rotation: Any, error: type[Exception] = Refused) -> Array:
    """Return a geometry_msgs/Quaternion (4,), normalised.  Raises `error`."""
    return unit_quaternion(np.array([rotation.x, rotation.y, rotation.z, rotation.w]), error)


def pose_frame(pose: Any) -> Array:
    """Return the frame (7,) of a geometry_msgs/Pose.  Raises Refused.

    Its rotation is NaN where the message has none: zeros, as programs write that have positions only.
    """
    q = pose.orientation
    if any((q.x, q.y, q.z, q.w)):
        return frame_of(pose.position, q)
    return np.array([pose.position.x, pose.position.y, pose.position.z, *[np.nan] * 4])


def covariance_of_values(values: Any, size: int = 6) -> Array:
    """Return a covariance (size, size) of a message, which holds it row by row."""
    return np.array(values, dtype=np.float64).reshape(size, size)


def pose(m: Any) -> Measured:
    """Return the pose of a geometry_msgs/PoseStamped."""
    return Measured(pose_frame(m.pose))


def uncertain_pose(m: Any) -> Measured:
    """Return the pose of a nav_msgs/Odometry or a geometry_msgs/PoseWithCovarianceStamped."""
    return Measured(pose_frame(m.pose.pose), covariance_of_values(m.pose.covariance))


def velocity(twist: Any) -> Measured:
    """Return a geometry_msgs/Twist."""
    return Measured(np.array([getattr(part, axis) for part in (twist.linear, twist.angular) for axis in "xyz"]))


def uncertain_velocity(m: Any) -> Measured:
    """Return the velocity of a nav_msgs/Odometry or a geometry_msgs/TwistWithCovarianceStamped."""
    return Measured(velocity(m.twist.twist).v, covariance_of_values(m.twist.covariance))


def drive(m: Any) -> Array:
    """Return speed (m/s) and steering angle (rad) of an ackermann_msgs/AckermannDrive."""
    return np.array([m.speed, m.steering_angle], dtype=np.float64)


def satellite_fix(m: Any) -> Measured | None:
    """Return the position of a sensor_msgs/NavSatFix, None where the receiver has none."""
    if m.status.status < NO_FIX:
        return None
    cov = covariance_of_values(m.position_covariance, 3) if m.position_covariance_type != UNKNOWN_COVARIANCE else None
    return Measured(np.array([m.latitude, m.longitude, m.altitude]), cov)


def vector(v: Any, cov: Any) -> Measured | None:
    """Return the measurement of an inertial unit along its axes, None without one.

    Its covariance is None where it is unknown: all zeros.
    """
    if cov[0] == NOT_MEASURED:
        return None
    told = covariance_of_values(cov, 3)
    return Measured(np.array([v.x, v.y, v.z], dtype=np.float64), told if told.any() else None)


def attitude(m: Any) -> Measured | None:
    """Return the orientation (4,) of a sensor_msgs/Imu: its frame in that of east, north, up; None if it has none.

    Some that have none write zeros.  Raises Refused.
    """
    told, q = vector(m.orientation, m.orientation_covariance), m.orientation
    return None if told is None or not any((q.x, q.y, q.z, q.w)) else Measured(unit(q), told.cov)


def transforms(m: Any) -> list[Transform]:
    """Return those of a tf2_msgs/TFMessage."""
    return [transform(each) for each in m.transforms]


def transform(m: Any) -> Transform:
    """Return a geometry_msgs/TransformStamped."""
    frame = frame_of(m.transform.translation, m.transform.rotation)
    return Transform(header_time(m), m.header.frame_id.lstrip("/"), m.child_frame_id.lstrip("/"), frame)


def camera(m: Any) -> Section:
    """Return the keys of a camera's section for a sensor_msgs/CameraInfo, whose matrix is K in ROS 1, k in ROS 2.

    Raises Refused: of a camera that is not calibrated, and of a lens that kalmark does not have.
    """
    K, D = ([float(v) for v in getattr(m, name, getattr(m, name.upper(), ()))] for name in "kd")
    section: Section = {"fx_px": K[0], "fy_px": K[4], "cx_px": K[2], "cy_px": K[5]}
    section |= {"width_px": int(m.width), "height_px": int(m.height)}
    if not (K[0] > 0 and K[4] > 0):
        raise Refused(f"focal lengths {K[0]:g}, {K[4]:g} of a camera that is not calibrated, expected numbers > 0")
    try:
        return section | (lens(m.distortion_model, D) if any(D) else {})
    except ValueError as error:
        raise Refused(str(error)) from None


# ------------------------------------------------------------------ images
def image(m: Any) -> Any:
    """Return a sensor_msgs/Image in grey values (H, W).  Raises OSError."""
    from kalmark.vision import opencv as cv2

    encodings = {
        "mono8": (np.uint8, 1, None), "8UC1": (np.uint8, 1, None), "mono16": (np.uint16, 1, None),
        "16UC1": (np.uint16, 1, None), "bgr8": (np.uint8, 3, cv2.COLOR_BGR2GRAY),
        "8UC3": (np.uint8, 3, cv2.COLOR_BGR2GRAY),
        "rgb8": (np.uint8, 3, cv2.COLOR_RGB2GRAY), "bgra8": (np.uint8, 4, cv2.COLOR_BGRA2GRAY),
        "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2GRAY), "bayer_rggb8": (np.uint8, 1, cv2.COLOR_BayerBG2GRAY),
        "bayer_bggr8": (np.uint8, 1, cv2.COLOR_BayerRG2GRAY), "bayer_gbrg8": (np.uint8, 1, cv2.COLOR_BayerGR2GRAY),
        "bayer_grbg8": (np.uint8, 1, cv2.COLOR_BayerGB2GRAY),
    }  # fmt: skip
    if m.encoding not in encodings:
        raise OSError(f"encoding {m.encoding!r}, expected one of {', '.join(encodings)}")
    kind, channels, code = encodings[m.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if m.is_bigendian else "<")
    data = np.frombuffer(np.ascontiguousarray(m.data).tobytes(), dtype=np.uint8)
    width = int(m.width) * channels * dtype.itemsize
    if not m.height or not width or int(m.step) < width or len(data) != int(m.step) * int(m.height):
        raise OSError(f"{len(data)} bytes, expected {m.height} rows of {m.step} for {m.width} pixels of {m.encoding}")
    pixels = np.ascontiguousarray(data.reshape(int(m.height), int(m.step))[:, :width]).view(dtype)
    if dtype.itemsize == 2:
        return (pixels >> 8).astype(np.uint8)
    pixels = pixels.reshape(int(m.height), int(m.width), channels) if channels > 1 else pixels
    return pixels.copy() if code is None else cv2.cvtColor(pixels, code)


def compressed_image(m: Any) -> Any:
    """Return a sensor_msgs/CompressedImage in grey values (H, W).  Raises OSError."""
    from kalmark.vision import opencv as cv2

    data = np.frombuffer(np.ascontiguousarray(m.data).tobytes(), dtype=np.uint8)
    decoded = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if decoded is None:
        raise OSError(f"{len(data)} bytes of {m.format!r} that cannot be decoded, expected an image")
    return decoded


# ------------------------------------------------------------------ what a sensor saw
def beams(m: Any, scan: Scans) -> Seen:
    """Return the beams of a sensor_msgs/LaserScan that returned, at increasing angles."""
    r = np.asarray(m.ranges, dtype=np.float64)
    a = float(m.angle_min) + float(m.angle_increment) * np.arange(len(r))
    intensities = np.asarray(m.intensities, dtype=np.float64)
    columns: Names = BEAM
    rows = np.column_stack([r, a])
    if len(r) and len(intensities) == len(r):
        columns, rows = (*BEAM, "intensity"), np.column_stack([rows, intensities])
    returned = (r >= float(m.range_min)) & (r <= float(m.range_max)) & np.isfinite(r)
    rows = rows[returned]
    return Seen(columns, rows[::-1] if m.angle_increment < 0 else rows)


def one_range(m: Any, scan: Scans) -> Seen:
    """Return the range of a sensor_msgs/Range, of the landmark that the configuration names; none without an echo."""
    seen = Seen(("range_m",))
    if math.isfinite(m.range) and m.min_range <= m.range <= m.max_range:
        seen.add([float(m.range)], scan.landmark)
    else:
        seen.left_out["ranges without an echo"] += 1
    return seen


def cloud(m: Any, scan: Scans) -> Seen:
    """Return the points of a sensor_msgs/PointCloud2: the mean of those with one id or of one cluster."""
    fields = {each.name: each for each in m.fields}
    name = scan.ids if scan.ids not in (None, "none") else scan.clusters
    if name is None:
        raise Refused(f"its points have the fields {', '.join(fields)}, expected `ids` or `clusters`: one of them")
    for each in (*"xyz", name):
        if each not in fields or fields[each].datatype not in TYPES_OF_A_FIELD:
            raise Refused(f"its points have the fields {', '.join(fields)}, expected {each} among them")
    order = ">" if m.is_bigendian else "<"
    names = dict.fromkeys((*"xyz", name))
    kind = np.dtype({
        "names": [*names], "formats": [order + TYPES_OF_A_FIELD[fields[each].datatype] for each in names],
        "offsets": [fields[each].offset for each in names], "itemsize": m.point_step,
    })  # fmt: skip
    rows = np.frombuffer(np.ascontiguousarray(m.data), np.uint8).reshape(m.height, m.row_step)
    points = np.ascontiguousarray(rows[:, : m.width * m.point_step]).view(kind).reshape(-1)
    xyz = np.column_stack([points[axis].astype(np.float64) for axis in "xyz"])
    whole = np.isfinite(xyz).all(axis=1)
    seen = Seen(POSITION)
    if not whole.all():
        seen.left_out["points without coordinates"] += int((~whole).sum())
    named, xyz = points[name][whole], xyz[whole]
    for value in np.unique(named).tolist():
        seen.add(xyz[named == value].mean(axis=0).tolist(), int(value) if scan.ids == name else None)
    return seen


def first_id(scan: Scans, *names: Any) -> Any:
    """Return the first id, as a number where it is one; None if the configuration excludes ids."""
    text = next((str(name) for name in names if str(name)), "") if scan.ids != "none" else ""
    digits = text.removeprefix("-")
    return None if not text else int(text) if digits.isdecimal() and digits.isascii() and len(digits) < 19 else text


def _of_class(results: Any) -> str:
    """Return the likeliest class of a vision_msgs detection, "" for none."""
    told = [getattr(each, "hypothesis", each) for each in results]
    best = max(told, key=lambda each: each.score, default=None)
    return "" if best is None else str(getattr(best, "class_id", getattr(best, "id", "")))


def detection_id(each: Any, scan: Scans) -> Any:
    """Return the id of a vision_msgs detection: its own, or else its likeliest class; `ids: class` takes the class."""
    own = getattr(each, "id", getattr(each, "tracking_id", ""))
    return first_id(scan, "" if scan.ids == "class" else own, _of_class(each.results))


def boxes(m: Any, scan: Scans) -> Seen:
    """Return the centres (px) of a vision_msgs/Detection2DArray."""
    centres = ((getattr(each.bbox.center, "position", each.bbox.center), each) for each in m.detections)
    rows = (([float(centre.x), float(centre.y)], detection_id(each, scan)) for centre, each in centres)
    return Seen.of(("u_px", "v_px"), rows)


def boxes_of_space(m: Any, scan: Scans) -> Seen:
    """Return the poses of the boxes of a vision_msgs/Detection3DArray."""
    return Seen.of(POSE3, ((pose_frame(each.bbox.center).tolist(), detection_id(each, scan)) for each in m.detections))


def markers(listed: Iterable[Any], scan: Scans) -> Seen:
    """Return the poses of visualization_msgs/Markers; ids are `namespace/id` where there are namespaces."""
    seen = Seen(POSE3)
    listed = list(listed)
    several = len({each.ns for each in listed}) > 1
    for each in listed:
        if each.action >= DELETED:
            seen.left_out["markers that are deleted"] += 1
            continue
        seen.add(pose_frame(each.pose).tolist(), first_id(scan, f"{each.ns}/{each.id}" if several else each.id))
    return seen


def _corners(scan: Scans, tags: Iterable[Any]) -> Seen:
    """Return tags with `id`, `hamming` and four `corners`, in the order of the AprilTag library."""
    seen = Seen(CORNERS)
    for tag in tags:
        id_, size = int(tag.id), scan.size(int(tag.id))
        if tag.hamming > scan.max_hamming:
            seen.left_out[f"tags with more than {scan.max_hamming} corrected bits"] += 1
        elif size is None:
            seen.left_out["tags without a size: size_m or sizes of the topic"] += 1
        else:
            seen.add([c for corner in tag.corners for c in (float(corner.x), float(corner.y))] + [size], id_)
    return seen


def tag_poses(m: Any, scan: Scans) -> Seen:
    """Return the poses of tags of apriltag_ros (ROS 1), aruco_msgs, aruco_opencv and fiducial_msgs, by their ids."""
    seen = Seen(POSE3)
    for tag in getattr(m, "detections", getattr(m, "markers", getattr(m, "transforms", ()))):
        id_ = next(getattr(tag, name) for name in ("id", "marker_id", "fiducial_id") if hasattr(tag, name))
        if np.size(id_) != 1:
            seen.left_out["bundles of tags"] += 1
            continue
        pose = getattr(tag, "pose", None) or tag.transform
        while hasattr(pose, "pose"):
            pose = pose.pose
        at = pose_frame(pose) if hasattr(pose, "position") else frame_of(pose.translation, pose.rotation)
        seen.add(at.tolist(), int(np.ravel(id_)[0]))
    return seen


def listed_poses(m: Any, scan: Scans) -> Seen:
    """Return the poses of a ros2_aruco_interfaces/ArucoMarkers, whose ids are a list of their own."""
    rows = zip(m.marker_ids, m.poses, strict=True)
    return Seen.of(POSE3, ((pose_frame(pose).tolist(), int(id_)) for id_, pose in rows))


# ------------------------------------------------------------------ the table
MESSAGES: dict[str, Message] = {
    "nav_msgs/msg/Odometry": Message("odometry", pose=uncertain_pose, twist=uncertain_velocity),
    "geometry_msgs/msg/PoseStamped": Message("pose", pose=pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": Message("pose", pose=uncertain_pose, noisy=True),
    "geometry_msgs/msg/Twist": Message("velocity", twist=velocity),
    "geometry_msgs/msg/TwistStamped": Message("velocity", twist=lambda m: velocity(m.twist)),
    "geometry_msgs/msg/TwistWithCovarianceStamped": Message("velocity", twist=uncertain_velocity),
    "ackermann_msgs/msg/AckermannDrive": Message("speed and steering", drive=drive),
    "ackermann_msgs/msg/AckermannDriveStamped": Message("speed and steering", drive=lambda m: drive(m.drive)),
    "sensor_msgs/msg/NavSatFix": Message("satellite fix", globe=satellite_fix),
    "sensor_msgs/msg/LaserScan": Message("laser beams", seen=beams),
    "sensor_msgs/msg/PointCloud2": Message("points", seen=cloud),
    "sensor_msgs/msg/Range": Message("range", seen=one_range),
    "sensor_msgs/msg/CameraInfo": Message("camera", camera=camera),
    "sensor_msgs/msg/Image": Message("images", image=image),
    "sensor_msgs/msg/CompressedImage": Message("images", image=compressed_image),
    "vision_msgs/msg/Detection2DArray": Message("detections in an image", seen=boxes),
    "vision_msgs/msg/Detection3DArray": Message("detections in space", seen=boxes_of_space),
    "visualization_msgs/msg/MarkerArray": Message("markers", seen=lambda m, scan: markers(m.markers, scan)),
    "visualization_msgs/msg/Marker": Message("marker", seen=lambda m, scan: markers([m], scan)),
    "apriltag_msgs/msg/AprilTagDetectionArray": Message("corners of tags",
                                                        seen=lambda m, scan: _corners(scan, m.detections)),
    "apriltag_msgs/msg/ApriltagArrayStamped": Message("corners of tags",
                                                      seen=lambda m, scan: _corners(scan, m.apriltags)),
    "apriltag_ros/msg/AprilTagDetectionArray": Message("poses of tags", seen=tag_poses),
    "aruco_msgs/msg/MarkerArray": Message("poses of tags", seen=tag_poses),
    "aruco_opencv_msgs/msg/ArucoDetection": Message("poses of tags", seen=tag_poses),
    "ros2_aruco_interfaces/msg/ArucoMarkers": Message("poses of tags", seen=listed_poses),
    "fiducial_msgs/msg/FiducialTransformArray": Message("poses of tags", seen=tag_poses),
    "tf2_msgs/msg/TFMessage": Message("frames", transforms=transforms),
    "tf/msg/tfMessage": Message("frames", transforms=transforms),
    "sensor_msgs/msg/Imu": Message(
        "inertial unit", attitude=attitude,
        rates=lambda m: vector(m.angular_velocity, m.angular_velocity_covariance),
        force=lambda m: vector(m.linear_acceleration, m.linear_acceleration_covariance)),
    "sensor_msgs/msg/MagneticField": Message(
        "magnetic field", field=lambda m: vector(m.magnetic_field, m.magnetic_field_covariance)),
}  # fmt: skip
