"""Import of a bag by topics: a configuration assigns to each topic its part in the log (`topics.py`, docs/bags.md)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from kalmark.arrays import Array
from kalmark.bags import tables
from kalmark.bags.configured_topics import Asked, sensor_name, short
from kalmark.bags.messages import (
    MESSAGES,
    NO_ROTATION,
    Message,
    Place,
    Pose,
    Seen,
)
from kalmark.bags.opening import Bag, Received, find_bag, has_header, header_time, refuse_undeclared_fields
from kalmark.bags.state_topics import Gathered, OwnReadings
from kalmark.bags.tf_mounts import Mounts
from kalmark.bags.topics import (
    Fixes,
    Images,
    InertialTopic,
    Moved,
    Noisy,
    Placed,
    Posed,
    Scans,
    Sparse,
    Topic,
    Truths,
    topic_of,
)
from kalmark.declare import Values
from kalmark.errors import EventError, LogError
from kalmark.events import Control, Fix, Frame, Scan, fixed_seconds, sort_key
from kalmark.geometry import rotations
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames3d import compose, inverse
from kalmark.logs.geodesy import fault, to_tangent_plane
from kalmark.logs.image_files import Forward
from kalmark.logs.log import Log, PositionTrack, Trajectory
from kalmark.logs.source import Format, Request
from kalmark.logs.table import Refused
from kalmark.logs.table_columns import BEAM, POSE3, POSITION

FOREVER_S = 1e9
DAY_NS = 86_400_000_000_000
_AXES2, _AXES3 = [0, 1], [0, 1, 2]


def read(
    path: Path,
    request: Request,
    topics: Annotated[Any, Values("topic"), "Topics by name, and what each of them is in the log, see below."] = None,
    definitions: Annotated[
        Any,
        Values(ending=".msg"),
        "Types of messages that it does not define, each with its .msg file, or the text of one.",
    ] = None,
) -> Log:
    """Return the log that these topics of a bag are; of a bag that kalmark wrote, the log itself.

    Raises LogError: a topic that is not there, messages that do not offer what the topic is to be.
    """
    with Bag(path, definitions) as bag:
        if topics is None and tables.holds_log(bag):
            return tables.read(bag, request)
        if not topics:
            there = ", ".join(bag.topics) or "none"
            hint = f"topics {there}; `kalmark bag {path} --out config.yaml` writes a configuration to start from"
            raise LogError(f"{path}: log.topics is missing, expected what they are: {hint}")
        asked = Asked(bag, {name: topic_of(name, section) for name, section in topics.items()})
        return _Importer(asked, request).log()


class _Importer:
    """Takes messages one by one and gathers what becomes of them."""

    def __init__(self, asked: Asked, request: Request) -> None:
        self.asked, self.bag, self.request = asked, asked.bag, request
        self.topics, self.named, self.in_space = asked.topics, asked.named, asked.in_space
        self.out, self.mounts = Gathered(), Mounts(asked, request)
        self.own = OwnReadings(self.out, self.mounts.level, self.in_space)
        self.paths: dict[str, dict[int, Array]] = {}
        self.positions: dict[str, dict[int, Array]] = {}
        self.last: dict[str, tuple[int, Array]] = {}
        self.ways: dict[str, dict[int, Array]] = {}
        self.origins: dict[str, Array] = {}
        self.received: Counter[str] = Counter()
        self.images: dict[str, Forward] = {}
        self.cameras: dict[tuple[str, str], dict[str, Any]] = {}
        self.clocks: dict[bool, tuple[str, int]] = {}

    # -------------------------------------------------------------- messages
    def log(self) -> Log:
        """Return the log."""
        self.mounts.look_ahead()
        self.calibrate()
        for received in self.bag.messages({*self.named.values()}):
            for name in self.asked.entries(received):
                self.take(received._replace(topic=name))
        self.interpolated()
        self.own.averaged(self.bag.path)
        for (name, reason), count in sorted(self.out.left_out.items()):
            self.request.leave_out(count, f"{self.bag.path}: {name}: {count} {reason}")
        for name in self.topics:
            if not self.bag.topics[self.named[name]].number:
                raise LogError(f"{self.bag.path}: topic {name} has no messages, expected at least one")
        robots = tuple(dict.fromkeys(topic.robot for topic in self.topics.values()))
        return Log(
            name=self.bag.path.name.partition(".")[0], format="bag", path=self.bag.path,
            robots=tuple(robot for robot in robots if any(event.robot == robot for event in self.out.events)),
            events=sorted(self.out.events, key=sort_key), skipped=self.request.skipped,
            truth={robot: Trajectory.of(path) for robot, path in self.paths.items()},
            gps={robot: PositionTrack(np.array([*at]), np.array([*at.values()]), np.zeros(2))
                 for robot, at in self.positions.items()},
            control_columns=self.asked.columns, sensor_columns=self.out.sensor_columns, describes=self.describes(),
        )  # fmt: skip

    def describes(self) -> dict[str, Any]:
        """Return the motions by the topics' types, and the mounts of tf, in the shape of a configuration."""
        robots: dict[str, dict[str, Any]] = {}
        for topic in self.topics.values():
            if topic.columns:
                robots.setdefault(topic.robot, {})["motion"] = {"type": type_of(topic)}
        for (robot, sensor), camera in self.cameras.items():
            robots.setdefault(robot, {}).setdefault("sensors", {})[sensor] = camera
        for (robot, sensor), mount in self.mounts.mounts.items():
            robots.setdefault(robot, {}).setdefault("sensors", {}).setdefault(sensor, {})["mount"] = mount
        return {"robots": robots} if robots else {}

    def take(self, received: Received) -> None:
        """Take one message; what is bad in it is refused, with its topic and time."""
        topic, offer = self.topics[received.topic], self.asked.offers[received.topic]
        self.received[received.topic] += 1
        t_ns = self.time(received, topic)
        if t_ns is None:
            self.out.left_out[received.topic, "messages with a time of 0; `time: recorded` takes the recorder's"] += 1
            return
        try:
            with refuse_undeclared_fields():
                self.taken(received, topic, offer, t_ns)
        except (Refused, EventError) as refused:
            at = f"{received.topic} at t={fixed_seconds(t_ns)} s"
            self.request.refuse(f"{self.bag.path}: {at}: {refused}")

    def taken(self, received: Received, topic: Topic, offer: Message, t_ns: int) -> None:
        """Take the parts of a message that its topic is configured for.  Raises Refused and EventError."""
        if isinstance(topic, Scans):
            self.scan(received, topic, offer, t_ns)
        elif isinstance(topic, Images):
            self.image(received, topic, t_ns)
        elif isinstance(topic, InertialTopic):
            self.own.inertial(received, topic, offer, t_ns)
        elif isinstance(topic, Sparse):
            self.own.take(received, topic, offer, t_ns)
        elif isinstance(topic, Fixes | Truths) and offer.globe is not None:
            self.globe(received, topic, offer.globe(received.message), t_ns)
        elif isinstance(topic, Posed):
            self.poses(received, topic, offer, t_ns)
        elif offer.drive is not None and "drive" in topic.needs:
            self.control(topic, t_ns, offer.drive(received.message), None)
        elif offer.twist is not None:
            self.velocity(topic, t_ns, offer, received.message)

    def time(self, received: Received, topic: Topic) -> int | None:
        """Return the time (ns) of a message, None if its header has 0, which is no time.

        Raises LogError if headers and the recorder have different clocks.
        """
        own = has_header(received.message) and topic.time != "recorded"
        if own and topic.time == "auto" and header_time(received.message) == 0:
            return None
        if topic.time == "header" and not own:
            what = f"topic {received.topic}: messages of the type {short(received.type)} have no header"
            raise LogError(f"{self.bag.path}: {what}, expected `time: recorded`")
        t_ns = header_time(received.message) if own else received.recorded_ns
        first = self.clocks.setdefault(own, (received.topic, t_ns))
        other = self.clocks.get(not own)
        if other is not None and abs(first[1] - other[1]) > DAY_NS:
            (a, t_a), (b, t_b) = self.clocks[True], self.clocks[False]
            what = f"{a} begins at {t_a * 1e-9:.0f} s by its headers, {b} at {t_b * 1e-9:.0f} s as recorded"
            raise LogError(f"{self.bag.path}: {what}, expected one clock: `time: recorded` for both")
        return t_ns + round(topic.shift_s * 1e9)

    def poses(self, received: Received, topic: Posed, offer: Message, t_ns: int) -> None:
        """Take the pose in a message, or those of its frames that the topic asks for, each at its own time."""
        if offer.transforms is not None:
            wanted = ((topic.frame or "").lstrip("/"), (topic.child_frame or "").lstrip("/"))
            shift = round(topic.shift_s * 1e9)
            for each in offer.transforms(received.message):
                if (each.parent, each.child) == wanted:
                    at = t_ns if topic.time == "recorded" else each.t_ns + shift
                    self.pose(received, topic, offer, Pose(each.frame, None, *wanted), at)
        elif offer.pose is not None:
            self.pose(received, topic, offer, offer.pose(received.message), t_ns)

    def pose(self, received: Received, topic: Posed, offer: Message, pose: Pose, t_ns: int) -> None:
        """Take one pose: of odometry, as a fix or as truth."""
        if not np.isfinite(pose.frame[:3]).all():
            raise Refused(f"pose {pose.frame.tolist()}, expected finite numbers")
        if np.isnan(pose.frame[3:]).any() and not isinstance(topic, Fixes):
            raise Refused(NO_ROTATION)
        if isinstance(topic, Fixes):
            self.fix(topic, t_ns, pose.frame[:3], None if pose.cov is None else pose.cov[:3, :3])
        elif isinstance(topic, Truths):
            own = pose.frame if self.in_space(topic.robot) else pose_in_plane(pose.frame)
            self.kept(self.paths, received, topic.robot, t_ns, own)
        else:
            self.add_odometry_pose(received, topic, offer, pose, t_ns)

    def add_odometry_pose(self, received: Received, topic: Posed, offer: Message, pose: Pose, t_ns: int) -> None:
        """Take a pose of odometry: the increment from the one before it."""
        before = self.last.get(received.topic)
        if not self.out.is_next(received, before and before[0], t_ns, "poses"):
            return
        self.last[received.topic] = (t_ns, pose.frame)
        if isinstance(topic, Moved) and topic.at == "scans":
            self.ways.setdefault(received.topic, {})[t_ns] = pose.frame
            return
        if before is None:
            return
        rows = [0, 1, 2, 3, 4, 5] if topic.space else [0, 1, 5]
        cov, dt_s = self.own_noise(topic, offer, received.message, rows), (t_ns - before[0]) * 1e-9
        self.control(topic, t_ns, self.step(topic, before[1], pose.frame), None if cov is None else cov * dt_s**2)

    def own_noise(self, topic: Topic, offer: Message, message: Any, rows: list[int]) -> Array | None:
        """Return the covariance of some numbers of a message's twist, if controls take it.  Raises Refused."""
        if not isinstance(topic, Noisy) or not topic.own_noise:
            return None
        cov = None if offer.twist is None else offer.twist(message).cov
        if cov is None:
            raise Refused("the message has no covariance, expected one for `own_noise`")
        return cov[np.ix_(rows, rows)]

    def step(self, topic: Topic, a: Array, b: Array) -> Array:
        """Return the control that leads from the pose a (7,) to b: an increment of the plane or of space."""
        if not self.in_space(topic.robot):
            return relative_pose(pose_in_plane(a), pose_in_plane(b))
        step = compose(inverse(a)[0], b)[0]
        return np.append(step[:3], rotations.log(step[3:]))

    def interpolated(self) -> None:
        """Add the increments that end at the scans and fixes of a robot, on the interpolated path of its odometry.

        Those outside the path are left out: how the robot moved to them is not known.
        """
        for name, way in self.ways.items():
            topic, path = self.topics[name], Trajectory.of(way)
            first, last, every = path.t_ns[0], path.t_ns[-1], len(self.out.events)
            self.out.events = [e for e in self.out.events if e.robot != topic.robot or first <= e.t_ns <= last]
            if len(self.out.events) < every:
                self.out.left_out[name, "scans and fixes outside the odometry"] += every - len(self.out.events)
            t_ns = sorted({event.t_ns for event in self.out.events if event.robot == topic.robot})
            for t, (a, b) in zip(t_ns[1:], pairwise(path.at(t_ns, max_gap_s=FOREVER_S)), strict=True):
                self.control(topic, t, self.step(topic, a, b), None)

    def velocity(self, topic: Topic, t_ns: int, offer: Message, message: Any) -> None:
        """Take a velocity, held from now on."""
        own = [0, 1, 2, 3, 4, 5] if topic.space else [0, 5]
        noise = self.own_noise(topic, offer, message, own)
        self.control(topic, t_ns, offer.twist(message).v[own], noise)  # type: ignore[misc]

    def control(self, topic: Topic, t_ns: int, u: Array, cov: Array | None) -> None:
        """Take a control."""
        if cov is not None:
            if not np.isfinite(cov).all():
                raise Refused(f"noise {cov.tolist()}, expected finite numbers")
            if np.linalg.eigvalsh(cov)[0] < -1e-12 * np.abs(cov).max(initial=0.0):
                raise Refused(f"noise {cov.tolist()}, expected it positive semidefinite")
        self.out.events.append(Control(t_ns=t_ns, robot=topic.robot, u=u, cov=cov))

    def globe(self, received: Received, topic: Placed, place: Place | None, t_ns: int) -> None:
        """Take a position on the globe: as a fix, or to score only."""
        if place is None:
            self.out.left_out[received.topic, "messages without a fix"] += 1
            return
        if wrong := fault(place.lla):
            raise Refused(wrong)
        lla = np.where(np.isfinite(place.lla), place.lla, 0.0)  # a fix in two dimensions has no height
        origin = self.origins.setdefault("", lla if topic.origin is None else np.array(topic.origin, dtype=np.float64))
        enu = to_tangent_plane(lla, origin)
        if isinstance(topic, Fixes):
            self.fix(topic, t_ns, enu, place.cov)
        else:
            self.kept(self.positions, received, topic.robot, t_ns, enu[:2])

    def fix(self, topic: Fixes, t_ns: int, p: Array, cov: Array | None) -> None:
        """Take a position as a fix, with the noise of the topic or else its own."""
        own = _AXES3 if self.in_space(topic.robot) else _AXES2
        N = None if cov is None else cov[np.ix_(own, own)]
        if topic.sigma_m is not None:
            N = np.diag(np.square([topic.sigma_m, topic.sigma_m, topic.sigma_z_m or topic.sigma_m]))[np.ix_(own, own)]
        if N is None or not np.isfinite(N).all() or np.linalg.eigvalsh(N)[0] <= 0:
            told = "no covariance" if N is None else f"the covariance {N.tolist()}"
            raise Refused(f"the position has {told}, expected a positive definite one, or sigma_m of the topic")
        self.out.events.append(Fix(t_ns=t_ns, robot=topic.robot, y=p[own], cov=N))

    def kept(self, table: dict[str, dict[int, Array]], received: Received, robot: str, t_ns: int, value: Array) -> None:
        """Keep a true pose or position; times must increase."""
        mine = table.setdefault(robot, {})
        if self.out.is_next(received, next(reversed(mine), None), t_ns, "poses"):
            mine[t_ns] = value

    def scan(self, received: Received, topic: Scans, offer: Message, t_ns: int) -> None:
        """Take what a sensor saw."""
        seen = offer.seen(received.message, topic)  # type: ignore[misc]
        seen = seen.without([topic.ignores(id_, t_ns) for id_ in seen.ids])
        for reason, count in seen.left_out.items():
            self.out.left_out[received.topic, reason] += count
        columns, y = self.chosen(received.topic, topic, seen)
        sensor = sensor_name(received.topic, topic)
        known = self.out.sensor_columns.setdefault((topic.robot, sensor), columns)
        if known != columns and len(y):
            raise Refused(f"columns {', '.join(columns)}, expected {', '.join(known)} as in its first message")
        ids = seen.ids if seen.ids else None
        self.out.events.append(Scan(t_ns=t_ns, robot=topic.robot, sensor=sensor, y=y, ids=ids))

    def image(self, received: Received, topic: Images, t_ns: int) -> None:
        """Take an image, whose pixels are read from the bag when they are needed."""
        name = received.topic
        if name not in self.images:
            self.images[name] = Forward(partial(images_of, self.bag.path, self.named[name]))
        read, sensor = partial(self.images[name].at, self.received[name] - 1), sensor_name(name, topic)
        self.out.events.append(Frame(t_ns=t_ns, robot=topic.robot, sensor=sensor, image=read))

    def calibrate(self) -> None:
        """Take the calibrations of the cameras whose images are taken.  Raises LogError."""
        for name, topic in self.topics.items():
            if not isinstance(topic, Images):
                continue
            parts = self.named[name].removesuffix("/compressed").rpartition("/")
            info = self.bag.find(topic.info) if topic.info else f"{parts[0]}{parts[1]}camera_info"
            known = MESSAGES.get(self.bag.topics[info].type) if info in self.bag.topics else None
            first = next(iter(self.bag.messages({info})), None) if known and known.camera else None
            if first is None or known is None or known.camera is None:
                continue
            try:
                numbers = known.camera(first.message)
            except Refused as refused:
                raise LogError(f"{self.bag.path}: {info}: {refused}") from None
            self.cameras[topic.robot, sensor_name(name, topic)] = {"type": "pinhole"} | numbers

    def chosen(self, name: str, topic: Scans, seen: Seen) -> tuple[tuple[str, ...], Any]:
        """Return the columns to take, and the observations (K, m), for a robot of the plane made level."""
        y = np.asarray(seen.y, dtype=np.float64).reshape(-1, len(seen.columns))
        R, turned = self.mounts.level.get(name, (np.eye(3), False))
        space, points = self.in_space(topic.robot), seen.columns[:3] == POSITION
        if points and not space:
            y = np.column_stack([y[:, :3] @ R.T, y[:, 3:]])
        if turned:
            y = (y * np.where(np.array(seen.columns) == BEAM[1], -1.0, 1.0))[::-1]
        default = seen.columns if space or not points else POSITION[:2]
        wanted = tuple(topic.take) if topic.take is not None else default
        if wanted == seen.columns:
            return wanted, turned_at_all(wanted, y)
        given = dict(zip(seen.columns, y.T, strict=True))
        if points:
            given |= polar(y, space)
        for column in wanted:
            if column not in given or (column in POSE3[3:] and not space):
                raise Refused(f"take has {column}, expected some of {', '.join(given)}")
        return wanted, turned_at_all(wanted, np.column_stack([given[column] for column in wanted]))


def turned_at_all(columns: tuple[str, ...], y: Array) -> Array:
    """Return observations (K, m) whose rotations, if they are taken, are there.  Raises Refused."""
    if np.isnan(y[:, [column in POSE3[3:] for column in columns]]).any():
        raise Refused(f"{NO_ROTATION}, or `take: [{', '.join(POSITION)}]`")
    return y


def polar(p: Array, space: bool) -> dict[str, Array]:
    """Return ranges and angles of points (K, 3 or more), in the plane or in space."""
    x, y, z = p[:, 0], p[:, 1], p[:, 2]
    across, angle = np.hypot(x, y), np.arctan2(y, x)
    if not space:
        return {"range_m": across, "bearing_rad": angle}
    return {"range_m": np.hypot(across, z), "azimuth_rad": angle, "elevation_rad": np.arctan2(z, across)}


def type_of(topic: Topic) -> str:
    """Return the type of a topic as configurations write it."""
    from kalmark.declare import registered_name

    return registered_name(type(topic)) or type(topic).__name__


def images_of(path: Path, name: str) -> Iterator[Any]:
    """Yield the images of a topic in grey values (H, W); an OSError instead of one that cannot be decoded."""
    with Bag(path) as bag:
        decode = MESSAGES[bag.topics[name].type].image
        assert decode is not None
        for received in bag.messages({name}):
            try:
                yield decode(received.message)
            except OSError as error:
                yield error


def pose_in_plane(frame: Array) -> Array:
    """Return x, y and yaw (3,) of a frame (7,)."""
    x, y, z, w = frame[3:]
    return np.array([frame[0], frame[1], np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))])


def relative_pose(a: Array, b: Array) -> Array:
    """Return the pose b (3,) in the frame of a: the way between them."""
    c, s = np.cos(a[2]), np.sin(a[2])
    x, y = b[:2] - a[:2]
    return np.array([c * x + s * y, c * y - s * x, wrap(b[2] - a[2])])


BAG = Format(
    "bag", "a ROS bag (.bag, .mcap, .db3, the folder of a ROS 2 bag), with log.topics", find_bag, read, general=True
)
