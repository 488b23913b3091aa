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
from kalmark.bags.bag_opening import Bag, Received, find_bag, has_header, header_time, refuse_undeclared_fields
from kalmark.bags.configured_topics import Asked, sensor_name, short
from kalmark.bags.messages import (
    MESSAGES,
    NO_ROTATION,
    Measured,
    Seen,
)
from kalmark.bags.state_topics import Gathered, OwnReadings, TopicMessage
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
from kalmark.declare import Values, registered_name
from kalmark.errors import EventError, LogError
from kalmark.events import Control, Fix, Frame, Scan, fixed_seconds, sort_key
from kalmark.logs.geodesy import fault, to_tangent_plane
from kalmark.logs.increments import increment_between
from kalmark.logs.log import Log, Names, PositionTrack, Section, SensorKey, Trajectory, poses_of_size
from kalmark.logs.source import Format, Request
from kalmark.logs.table import Refused
from kalmark.logs.table_columns import BEAM, POSE3, POSITION
from kalmark.vision.image_files import Forward

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
            raise LogError(
                f"{path}: log.topics is missing, expected what they are: topics {there}; `kalmark bag {path} --out "
                "config.yaml` writes a configuration to start from"
            )
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
        self.cameras: dict[SensorKey, Section] = {}
        self.clocks: dict[bool, tuple[str, int]] = {}

    # -------------------------------------------------------------- messages
    def log(self) -> Log:
        """Return the log."""
        self.mounts.look_ahead()
        self.calibrate()
        for received in self.bag.messages({*self.named.values()}):
            for name in self.asked.entries(received):
                self.take(name, received)
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

    def describes(self) -> Section:
        """Return the motions by the topics' types, and the mounts of tf, in the shape of a configuration."""
        robots: dict[str, Section] = {}
        for topic in self.topics.values():
            if topic.columns:
                robots.setdefault(topic.robot, {})["motion"] = {"type": registered_name(type(topic))}
        for (robot, sensor), camera in self.cameras.items():
            robots.setdefault(robot, {}).setdefault("sensors", {})[sensor] = camera
        for (robot, sensor), mount in self.mounts.mounts.items():
            robots.setdefault(robot, {}).setdefault("sensors", {}).setdefault(sensor, {})["mount"] = mount
        return {"robots": robots} if robots else {}

    def take(self, name: str, received: Received) -> None:
        """Take one message of a topic; what is bad in it is refused, with its topic and time."""
        self.received[name] += 1
        t_ns = self.time(name, received)
        if t_ns is None:
            self.out.left_out[name, "messages with a time of 0; `time: recorded` takes the recorder's"] += 1
            return
        try:
            with refuse_undeclared_fields():
                self.taken(TopicMessage(name, self.topics[name], self.asked.offers[name], received.message, t_ns))
        except (Refused, EventError) as refused:
            self.request.refuse(f"{self.bag.path}: {name} at t={fixed_seconds(t_ns)} s: {refused}")

    def taken(self, m: TopicMessage) -> None:
        """Take the parts of a message that its topic is configured for.  Raises Refused and EventError."""
        topic, offer = m.topic, m.offer
        if isinstance(topic, Scans):
            self.scan(m, topic)
        elif isinstance(topic, Images):
            self.image(m, topic)
        elif isinstance(topic, InertialTopic):
            self.own.inertial(m)
        elif isinstance(topic, Sparse):
            self.own.take(m, topic)
        elif isinstance(topic, Placed) and offer.globe is not None:
            self.globe(m, topic, offer.globe(m.message))
        elif isinstance(topic, Posed):
            self.poses(m, topic)
        elif offer.drive is not None and "drive" in topic.needs:
            self.control(m, offer.drive(m.message), None)
        elif offer.twist is not None:  # a velocity, held from now on
            own = [0, 1, 2, 3, 4, 5] if topic.space else [0, 5]
            self.control(m, offer.twist(m.message).v[own], own_noise(m, own))

    def time(self, name: str, received: Received) -> int | None:
        """Return the time (ns) of a message, None if its header has 0, which is no time.

        Raises LogError if headers and the recorder have different clocks.
        """
        topic = self.topics[name]
        own = has_header(received.message) and topic.time != "recorded"
        if own and topic.time == "auto" and header_time(received.message) == 0:
            return None
        if topic.time == "header" and not own:
            what = f"topic {name}: messages of the type {short(received.type)} have no header"
            raise LogError(f"{self.bag.path}: {what}, expected `time: recorded`")
        t_ns = header_time(received.message) if own else received.recorded_ns
        first = self.clocks.setdefault(own, (name, t_ns))
        other = self.clocks.get(not own)
        if other is not None and abs(first[1] - other[1]) > DAY_NS:
            (a, t_a), (b, t_b) = self.clocks[True], self.clocks[False]
            what = f"{a} begins at {t_a * 1e-9:.0f} s by its headers, {b} at {t_b * 1e-9:.0f} s as recorded"
            raise LogError(f"{self.bag.path}: {what}, expected one clock: `time: recorded` for both")
        return t_ns + round(topic.shift_s * 1e9)

    def poses(self, m: TopicMessage, topic: Posed) -> None:
        """Take the pose in a message, or those of its frames that the topic asks for, each at its own time."""
        if m.offer.transforms is not None:
            wanted = ((topic.frame or "").lstrip("/"), (topic.child_frame or "").lstrip("/"))
            shift = round(topic.shift_s * 1e9)
            for each in m.offer.transforms(m.message):
                if (each.parent, each.child) == wanted:
                    at = m if topic.time == "recorded" else m._replace(t_ns=each.t_ns + shift)
                    self.pose(at, Measured(each.frame))
        elif m.offer.pose is not None:
            self.pose(m, m.offer.pose(m.message))

    def pose(self, m: TopicMessage, pose: Measured) -> None:
        """Take one pose: of odometry, as a fix or as truth."""
        if not np.isfinite(pose.v[:3]).all():
            raise Refused(f"pose {pose.v.tolist()}, expected finite numbers")
        if np.isnan(pose.v[3:]).any() and not isinstance(m.topic, Fixes):
            raise Refused(NO_ROTATION)
        if isinstance(m.topic, Fixes):
            self.fix(m, m.topic, pose.v[:3], None if pose.cov is None else pose.cov[:3, :3])
        elif isinstance(m.topic, Truths):
            size = 7 if self.in_space(m.topic.robot) else 3
            self.kept(self.paths, m, poses_of_size(pose.v[None], size)[0])
        else:
            self.add_odometry_pose(m, pose.v)

    def add_odometry_pose(self, m: TopicMessage, frame: Array) -> None:
        """Take a pose (7,) of odometry: the increment from the one before it."""
        topic, before = m.topic, self.last.get(m.name)
        if not self.out.is_next(m, before and before[0], "poses"):
            return
        self.last[m.name] = (m.t_ns, frame)
        if isinstance(topic, Moved) and topic.at == "scans":
            self.ways.setdefault(m.name, {})[m.t_ns] = frame
            return
        if before is None:
            return
        cov, dt_s = own_noise(m, [0, 1, 2, 3, 4, 5] if topic.space else [0, 1, 5]), (m.t_ns - before[0]) * 1e-9
        self.control(m, self.step(topic, before[1], frame), None if cov is None else cov * dt_s**2)

    def step(self, topic: Topic, a: Array, b: Array) -> Array:
        """Return the control that leads from the pose a (7,) to b: an increment of the plane or of space."""
        return increment_between(*poses_of_size(np.array([a, b]), 7 if self.in_space(topic.robot) else 3))

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
                self.out.events.append(Control(t_ns=t, robot=topic.robot, u=self.step(topic, a, b)))

    def control(self, m: TopicMessage, u: Array, cov: Array | None) -> None:
        """Take a control."""
        if cov is not None:
            if not np.isfinite(cov).all():
                raise Refused(f"noise {cov.tolist()}, expected finite numbers")
            if np.linalg.eigvalsh(cov)[0] < -1e-12 * np.abs(cov).max(initial=0.0):
                raise Refused(f"noise {cov.tolist()}, expected it positive semidefinite")
        self.out.events.append(Control(t_ns=m.t_ns, robot=m.topic.robot, u=u, cov=cov))

    def globe(self, m: TopicMessage, topic: Placed, place: Measured | None) -> None:
        """Take a position on the globe: as a fix, or to score only."""
        if place is None:
            self.out.left_out[m.name, "messages without a fix"] += 1
            return
        if wrong := fault(place.v):
            raise Refused(wrong)
        lla = np.where(np.isfinite(place.v), place.v, 0.0)  # a fix in two dimensions has no height
        origin = self.origins.setdefault("", lla if topic.origin is None else np.array(topic.origin, dtype=np.float64))
        enu = to_tangent_plane(lla, origin)
        if isinstance(topic, Fixes):
            self.fix(m, topic, enu, place.cov)
        else:
            self.kept(self.positions, m, enu[:2])

    def fix(self, m: TopicMessage, topic: Fixes, p: Array, cov: Array | None) -> None:
        """Take a position as a fix, with the noise of the topic or else its own."""
        own = _AXES3 if self.in_space(topic.robot) else _AXES2
        N = None if cov is None else cov[np.ix_(own, own)]
        if topic.sigma_m is not None:
            N = np.diag(np.square([topic.sigma_m, topic.sigma_m, topic.sigma_z_m or topic.sigma_m]))[np.ix_(own, own)]
        if N is None or not np.isfinite(N).all() or np.linalg.eigvalsh(N)[0] <= 0:
            told = "no covariance" if N is None else f"the covariance {N.tolist()}"
            raise Refused(f"the position has {told}, expected a positive definite one, or sigma_m of the topic")
        self.out.events.append(Fix(t_ns=m.t_ns, robot=topic.robot, y=p[own], cov=N))

    def kept(self, table: dict[str, dict[int, Array]], m: TopicMessage, value: Array) -> None:
        """Keep a true pose or position; times must increase."""
        mine = table.setdefault(m.topic.robot, {})
        if self.out.is_next(m, next(reversed(mine), None), "poses"):
            mine[m.t_ns] = value

    def scan(self, m: TopicMessage, topic: Scans) -> None:
        """Take what a sensor saw."""
        seen = m.offer.seen(m.message, topic)  # type: ignore[misc]
        seen = seen.without([topic.ignores(id_, m.t_ns) for id_ in seen.ids])
        for reason, count in seen.left_out.items():
            self.out.left_out[m.name, reason] += count
        columns, y = self.chosen(m.name, topic, seen)
        sensor = sensor_name(m.name, topic)
        known = self.out.sensor_columns.setdefault((topic.robot, sensor), columns)
        if known != columns and len(y):
            raise Refused(f"columns {', '.join(columns)}, expected {', '.join(known)} as in its first message")
        self.out.events.append(Scan(t_ns=m.t_ns, robot=topic.robot, sensor=sensor, y=y, ids=seen.ids or None))

    def image(self, m: TopicMessage, topic: Images) -> None:
        """Take an image, whose pixels are read from the bag when they are needed."""
        if m.name not in self.images:
            self.images[m.name] = Forward(partial(images_of, self.bag.path, self.named[m.name]))
        read, sensor = partial(self.images[m.name].at, self.received[m.name] - 1), sensor_name(m.name, topic)
        self.out.events.append(Frame(t_ns=m.t_ns, robot=topic.robot, sensor=sensor, image=read))

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

    def chosen(self, name: str, topic: Scans, seen: Seen) -> tuple[Names, Any]:
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


def own_noise(m: TopicMessage, rows: list[int]) -> Array | None:
    """Return the covariance of some numbers of a message's twist, if controls take it.  Raises Refused."""
    if not isinstance(m.topic, Noisy) or not m.topic.own_noise:
        return None
    cov = None if m.offer.twist is None else m.offer.twist(m.message).cov
    if cov is None:
        raise Refused("the message has no covariance, expected one for `own_noise`")
    return cov[np.ix_(rows, rows)]


def turned_at_all(columns: Names, y: Array) -> Array:
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


BAG = Format(
    "bag", "a ROS bag (.bag, .mcap, .db3, the folder of a ROS 2 bag), with log.topics", find_bag, read, general=True
)
