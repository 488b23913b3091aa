"""The meaning of a topic of a bag: the types of `log.topics.TOPIC` in a configuration, each declared once.

`needs` names the content that the topic's messages must have, an attribute of `kalmark.bags.messages.Message`;
`columns` are those of the control that comes of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

from kalmark.declare import Number, Within, class_of, classes, declared, parameters, refuse, register
from kalmark.errors import LogError, ModelError
from kalmark.events import Id, is_number, short_text
from kalmark.geometry.named_poses import POSES
from kalmark.logs.log import Names
from kalmark.logs.source import landmark_id, nanoseconds_of_text, one_of
from kalmark.logs.table_columns import INCREMENT2, INCREMENT3, INERTIAL, TWIST3

SensorName = Annotated[str | None, "The sensor's name among those of the robot; if absent the topic's, / as _."]


@declared
class Topic:
    """Options of all topics: robot, and time."""

    needs: ClassVar[Names] = ()
    columns: ClassVar[Names] = ()
    space: ClassVar[bool] = False

    robot: Annotated[str, "Robot that it belongs to."] = "robot"
    topic: Annotated[
        str | None, "The topic, if the key is another name: for a second entry of one topic, such as tf of two robots."
    ] = None
    time: Annotated[
        Literal["auto", "header", "recorded"],
        "Time of a message: in its header, or when it was recorded; auto: the header's, if it has one.",
    ] = "auto"
    shift_s: Annotated[Number, "Added to the time of every message."] = 0.0
    fields: Annotated[
        Any,
        "Columns, and the fields of the messages that have them, of a type that kalmark does not read itself: "
        "`{id: tags[].id, range_m: tags[].distance}`; `[]`: of each element.",
    ] = None


@declared
class Posed(Topic):
    """Poses of the robot: Odometry, PoseStamped, PoseWithCovarianceStamped, or a frame of tf."""

    needs: ClassVar[Names] = ("pose", "transforms")

    frame: Annotated[str | None, "tf: the frame in which the pose is, such as odom."] = None
    child_frame: Annotated[str | None, "tf: the frame whose pose it is, such as base_link."] = None


@declared
class Noisy:
    """Controls may bring their own noise."""

    own_noise: Annotated[bool, "Take the covariance of the message's twist instead of the motion's noise."] = False


@declared
class Moved(Posed, Noisy):
    """Increments of odometry: differences of poses, of successive ones or at the times of scans."""

    at: Annotated[
        Literal["messages", "scans"],
        "Ends of the increments: at the messages, or, on the interpolated path, at the scans: for slow odometry.",
    ] = "messages"

    def __post_init__(self) -> None:
        if self.at == "scans" and self.own_noise:
            raise refuse(self, "own_noise", "False with at: scans")


@register("topic", "odometry_2d")
class Odometry2DTopic(Moved):
    """Increments of odometry in the plane: differences of successive poses."""

    columns: ClassVar[Names] = INCREMENT2


@register("topic", "odometry_3d")
class Odometry3DTopic(Moved):
    """Increments of odometry in space: differences of successive poses."""

    columns: ClassVar[Names] = INCREMENT3
    space: ClassVar[bool] = True


@register("topic", "unicycle")
class UnicycleTopic(Topic, Noisy):
    """Speed and turn rate, held until the next message: Odometry, Twist, TwistStamped, TwistWithCovarianceStamped."""

    needs: ClassVar[Names] = ("twist",)
    columns: ClassVar[Names] = ("v_mps", "w_radps")


@register("topic", "velocity_3d")
class Velocity3DTopic(Topic, Noisy):
    """Velocities in space, held until the next message: Odometry, Twist, TwistStamped, TwistWithCovarianceStamped."""

    needs: ClassVar[Names] = ("twist",)
    columns: ClassVar[Names] = TWIST3
    space: ClassVar[bool] = True


@register("topic", "ackermann")
class AckermannTopic(Topic):
    """Speed and steering angle, held until the next message: AckermannDrive, AckermannDriveStamped."""

    needs: ClassVar[Names] = ("drive",)
    columns: ClassVar[Names] = ("v_mps", "steering_rad")


@register("topic", "inertial")
class InertialTopic(Topic):
    """Rates and specific forces of an Imu, held until the next one: controls of a robot whose frame is the Imu's."""

    needs: ClassVar[Names] = ("force",)
    columns: ClassVar[Names] = INERTIAL
    space: ClassVar[bool] = True


@declared
class Carried(Topic):
    """Measurements of a sensor on the robot."""

    base_frame: Annotated[
        str | None, "The robot's frame in tf, for the sensor's mount; if absent that of its odometry, or base_link."
    ] = None
    mount: Annotated[
        Any, "Its pose in the robot, where tf does not have it: x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg, or some."
    ] = None

    def mounted(self) -> dict[str, float] | None:
        """Return its pose in the robot as given, None if it is not.  Raises ModelError."""
        given = self.mount
        numbers = isinstance(given, Mapping) and all(is_number(v) and math.isfinite(v) for v in given.values())
        if given is not None and not (numbers and {*given} <= {*POSES["space"]}):
            raise refuse(self, "mount", f"a mapping of numbers with keys among {', '.join(POSES['space'])}")
        return None if given is None else dict(given)

    def sensors(self, topic: str) -> Names:
        """Return the names of the sensors that a topic of this name has readings of."""
        return (getattr(self, "sensor", None) or topic.strip("/").replace("/", "_"),)


@register("topic", "scan")
class Scans(Carried):
    """Observations of a sensor: laser beams, points, ranges, detections, corners or poses of tags, markers."""

    needs: ClassVar[Names] = ("seen",)

    sensor: SensorName = None
    take: Annotated[
        Any, "The columns to take of those that the message has, such as [x_m, y_m]; if absent what fits the robot."
    ] = None
    ids: Annotated[
        str | None,
        "Source of the ids: of a point cloud the name of a field, of detections `class`; `none`: there are none.",
    ] = None
    clusters: Annotated[str | None, "Point cloud: the field that numbers clusters; their means are taken."] = None
    landmark: Annotated[Any, "Range: id of the landmark that is measured."] = None
    size_m: Annotated[float | None, Within(gt=0), "Corners of tags: side of the black square."] = None
    sizes: Annotated[Any, "Corners of tags: sides by id, of tags with another one; all others have `size_m`."] = None
    ignore: Annotated[
        Any, "Observations to leave out: a list of ids, or a mapping of ids to lists of times in s, to the microsecond."
    ] = None
    max_hamming: Annotated[int, Within(ge=0), "Tags: the most corrected bits."] = 2

    def __post_init__(self) -> None:
        if self.take is not None:
            names = self.take if isinstance(self.take, list | tuple) else ()
            if not names or not all(isinstance(each, str) for each in names):
                raise refuse(self, "take", "a list of columns")
        if self.landmark is not None and (isinstance(self.landmark, bool) or not isinstance(self.landmark, int | str)):
            raise refuse(self, "landmark", "an id")
        if self.sizes is not None and not (
            isinstance(self.sizes, Mapping) and all(is_number(size) and 0 < size < 1e3 for size in self.sizes.values())
        ):
            raise refuse(self, "sizes", "a mapping of ids to lengths in m")
        try:
            self.ignored  # noqa: B018 - what is not a list or a mapping is refused here
        except (TypeError, ValueError):
            raise refuse(self, "ignore", "a list of ids, or a mapping of ids to lists of times in s") from None

    @cached_property
    def ignored(self) -> dict[Id, frozenset[int] | None]:
        """The ids of `ignore`, with the times (us) at which they are left out, None: at all times."""
        given = self.ignore or {}
        if isinstance(given, Mapping):
            return {
                landmark_id(str(id_)): frozenset((nanoseconds_of_text(str(time)) + 500) // 1000 for time in times)
                for id_, times in given.items()
            }
        if isinstance(given, str):
            raise TypeError(given)
        return dict.fromkeys(landmark_id(str(id_)) for id_ in given)

    def ignores(self, id_: Id | None, t_ns: int) -> bool:
        """Return whether an observation of this id at this time is to be left out."""
        if id_ not in self.ignored:
            return False
        times = self.ignored[id_]
        return times is None or (t_ns + 500) // 1000 in times

    def size(self, tag: Id) -> float | None:
        """Return the size (m) of a tag, None if it has none."""
        named = {landmark_id(str(name)): size for name, size in (self.sizes or {}).items()}
        return named.get(tag, self.size_m)


@register("topic", "images")
class Images(Carried):
    """Images of a camera: Image, CompressedImage; its calibration is that of the CameraInfo beside it."""

    needs: ClassVar[Names] = ("image",)

    sensor: SensorName = None
    info: Annotated[
        str | None, "The topic of its CameraInfo; if absent `camera_info` beside it, as ROS names them."
    ] = None


@declared
class Sparse(Carried):
    """Readings of which only some are taken."""

    every_s: Annotated[
        float, Within(ge=0), "Take no heading, inclination or gravity sooner than this after the last: its errors last."
    ] = 0.0


@register("topic", "imu")
class Imu(Sparse):
    """Readings of sensors of the robot itself by an Imu: of a gyroscope, and those that are given a name."""

    needs: ClassVar[Names] = ("rates",)

    gyro: Annotated[str | None, "Name of the sensor, a `gyro`, of its rates; null: they are not taken."] = "gyro"
    heading: Annotated[str | None, "Name of the sensor, a `heading`, of its orientation."] = None
    inclination: Annotated[str | None, "In space, name of the sensor, an `inclination`, of its orientation."] = None
    gravity: Annotated[str | None, "In space, name of the sensor, a `gravity`, of its accelerations."] = None
    at: Annotated[
        Literal["messages", "controls"],
        "Rates as they come, or their means from one control of the robot to the next: for increments.",
    ] = "messages"

    def __post_init__(self) -> None:
        if not self.sensors(""):
            raise refuse(self, "gyro", "a name, or one of heading, inclination, gravity")

    def sensors(self, topic: str) -> Names:
        """Return the names of the sensors that this topic has readings of."""
        return tuple(filter(None, (self.gyro, self.heading, self.inclination, self.gravity)))


@register("topic", "compass")
class Compass(Sparse):
    """Headings by a MagneticField, of a robot of the plane: `heading`, counted from magnetic east to the left."""

    needs: ClassVar[Names] = ("field",)

    sensor: SensorName = None


@declared
class Placed(Posed):
    """Poses, or positions on the globe, whose origin is that of metres."""

    needs: ClassVar[Names] = ("pose", "globe", "transforms")

    origin: Annotated[
        Any, "NavSatFix: [latitude_deg, longitude_deg, height_m] of the map's origin; the first fix if absent."
    ] = None

    def __post_init__(self) -> None:
        if self.origin is None:
            return
        given = self.origin if isinstance(self.origin, list | tuple) else ()
        numbers = [float(v) for v in given if is_number(v)]
        limits = (90.0, 360.0, 1e5)
        if len(numbers) != 3 or len(given) != 3 or not all(abs(v) <= m for v, m in zip(numbers, limits, strict=True)):
            raise refuse(self, "origin", "[latitude_deg, longitude_deg, height_m]")


@register("topic", "fix")
class Fixes(Placed):
    """Absolute positions: NavSatFix (metres east, north, up of the origin), poses with covariance, poses."""

    sigma_m: Annotated[
        float | None, Within(gt=0), "Noise of each coordinate; the message's own covariance if absent."
    ] = None
    sigma_z_m: Annotated[float | None, Within(gt=0), "Noise of the height, beside `sigma_m`; that if absent."] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sigma_z_m is not None and self.sigma_m is None:
            raise refuse(self, "sigma_m", "a positive number beside sigma_z_m")


@register("topic", "truth")
class Truths(Placed):
    """True poses, to score against; of a NavSatFix positions that only score."""


def topic_of(name: str, section: Any) -> Topic:
    """Return a topic of a configuration's mapping, which has its `type`.  Raises LogError."""
    if isinstance(section, Topic):
        return section
    where, kinds = f"log option topics: {name}", classes("topic")
    if not isinstance(section, Mapping) or not isinstance(section.get("type"), str):
        raise LogError(f"{where} is {short_text(section)}, expected a mapping with a type: {', '.join(kinds)}")
    if section["type"] not in kinds:
        raise LogError(f"{where}: type is {section['type']!r}, {one_of(kinds, section['type'])}")
    model = class_of("topic", section["type"])
    given, known = {key: value for key, value in section.items() if key != "type"}, [p.name for p in parameters(model)]
    for key in given:
        if key not in known:
            raise LogError(f"{where}: unknown key {key!r}, {one_of(known, key)}")
    try:
        topic: Topic = model(**given)
        if isinstance(topic, Carried):
            topic.mounted()
    except ModelError as error:
        raise LogError(f"{where}: {error}") from None
    return topic
