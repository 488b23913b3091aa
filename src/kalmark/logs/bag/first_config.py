"""A first configuration of a bag: what its topics probably are, with a comment where that is a guess."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.geometry import rotations
from kalmark.logs.bag.frames import BASES
from kalmark.logs.bag.geodesy import local
from kalmark.logs.bag.importer import DAY_NS, sensor_name, short
from kalmark.logs.bag.inertial import heading_of, heading_of_field
from kalmark.logs.bag.messages import BEAM, CORNERS, POSE, Measured
from kalmark.logs.bag.survey import Poses, Survey, TopicSummary, yaw
from kalmark.logs.bag.topics import Scans
from kalmark.logs.source import placed

TRUE = ("truth", "vicon", "mocap", "optitrack", "/gt", "gt_", "_gt")
LATER = ("filtered", "global", "map", "gps")  # odometry of these names has been corrected by something else
WANTED = ("goal", "target", "setpoint", "clicked", "initial", "desired")  # poses that the robot is to have
WORLD = ("map", "odom", "world", "earth")
LEAST_POSES = 10
IDS, CLUSTERS = ("id", "ids", "track_id", "label"), ("cluster", "cluster_id", "segment")
SPACE = ("", "odometry_3d", "velocity_3d")
COASTING = {
    True: {"type": "constant_velocity_3d", "sigma_v_mps_per_sqrt_s": 0.3, "sigma_w_radps_per_sqrt_s": 0.3},
    False: {"type": "constant_velocity", "sigma_vx_mps_per_sqrt_s": 0.3, "sigma_vy_mps_per_sqrt_s": 0.3,
            "sigma_w_radps_per_sqrt_s": 0.3},
}  # fmt: skip
"""The motion of a robot without controls, in space or in the plane."""
AT_REST = {"sigma_v_mps": 0.5, "sigma_w_radps": 0.5}
SLOW = 0.5
"""An odometry of less than two messages for each of a sensor's gives increments that end at its scans."""
NEAR_NS = 500_000_000
LEAST_WAY_M = 2.0
JUMP_S = 1.0  # headers that run backwards by more are of a clock that was set
SATELLITE_M, POSE_M, POSE_RAD = 2.0, 0.5, 0.2  # sigmas of positions and headings that come without a covariance
GUESS = "GUESS:"
HEADING_S, HEADING_RAD = 1.0, 0.02
"""Headings are taken so often, and are not believed to be better: errors of a compass last."""
NORTH_RAD, START_RAD, FIELD_RAD = 0.2, 0.1, 0.1
"""Sigmas: of where north is, of a declination by the first heading, of a heading by a magnetic field."""
GYRO_RADPS, BIAS = 0.005, {"sigma_bias_radps": 0.01, "sigma_bias_radps_per_sqrt_s": 0.0001}


@dataclass
class _Lines:
    """Lines of the file: of the log, its topics, and of each robot its motion, start and sensors."""

    log: list[str] = field(default_factory=list)
    topics: list[str] = field(default_factory=list)
    entries: dict[str, tuple[dict[str, Any], str]] = field(default_factory=dict)
    robots: dict[str, list[str]] = field(default_factory=dict)
    unused: list[str] = field(default_factory=list)


def first_config(found: Survey, file: Path | None = None) -> str:
    """Return the text of a first configuration of a bag, for a file at this place."""
    beside = file is not None and file.resolve().parent == found.path.resolve().parent
    path = found.path.name if beside else str(found.path.resolve())
    head = [
        f"# A first configuration of {found.path.name}, by `kalmark bag`.  Look at each line with {GUESS[:-1]}.",
        "log:",
        f"  path: {quoted(path)}",
        "  format: bag",
    ]
    if found.holds_log:
        return "\n".join([*head, "  # kalmark wrote this bag: it holds a whole log, and no topics are needed", ""])
    writer = _Writer(found)
    lines = writer.lines()
    out = [*head, *lines.log, "  topics:", *(f"    {line}" for line in lines.topics)]
    out += [f"    # not used: {line}" for line in lines.unused]
    if lines.robots:
        out.append("robots:")
    for robot, told in lines.robots.items():
        out += [f"  {quoted(robot)}:", *(f"    {line}" for line in told)]
    out += writer.tail
    return "\n".join(out) + "\n"


def quoted(text: str) -> str:
    """Return a text as YAML has it."""
    plain = text and text[0].isalpha() | (text[0] in "/_") and all(c.isalnum() or c in "/_-." for c in text)
    return text if plain and text not in ("true", "false", "null", "yes", "no", "on", "off") else f"'{text}'"


def number(value: float) -> str:
    """Return a number with as many digits as mean something here."""
    return f"{value:.6g}"


def mapping(values: dict[str, Any]) -> str:
    """Return a mapping on one line of YAML."""
    parts = []
    for key, value in values.items():
        if isinstance(value, dict):
            text = mapping(value)
        elif isinstance(value, list | tuple):
            text = f"[{', '.join(v if isinstance(v, str) else repr(float(v)) for v in value)}]"
        elif value is None:
            text = "null"
        else:
            words = quoted(value) if isinstance(value, str) else str(value)
            text = number(value) if isinstance(value, float) else words
        parts.append(f"{key}: {text}")
    return f"{{{', '.join(parts)}}}"


def told(topic: TopicSummary) -> str:
    """Return a topic in words."""
    rate = f", {topic.rate_hz:.3g} Hz" if math.isfinite(topic.rate_hz) else ""
    frames = f", {topic.frames}" if topic.frames else ""
    return f"{topic.count} {short(topic.type).split('/')[-1]}{rate}{frames}"


@dataclass
class _Start:
    """Where a robot starts: x, y, heading, their two sigmas, and why.

    `north`: the map's axes are east and north; `known`: whether something tells the heading.
    """

    at: list[float]
    sigmas: list[float]
    why: str
    north: bool = False
    known: bool = True


class _Writer:
    """Decides what each topic is, robot by robot."""

    def __init__(self, found: Survey) -> None:
        self.found = found
        self.usable = [topic for topic in found.topics if topic.count]
        self.spaces = self._namespaces()
        self.tail: list[str] = []

    def _namespaces(self) -> list[str]:
        """Return the names of the robots: the one part in which topics of controls, or frames of odometry, differ."""
        moving, named = [topic for topic in self.usable if _moves(topic)], set[str]()
        one_tree = any(topic.name in ("/tf", "tf") for topic in self.usable)
        for a, b in combinations(moving, 2):
            pairs = list(zip(_parts(a), _parts(b), strict=False))
            other = [k for k, (x, y) in enumerate(pairs) if x != y]
            alike = a.type == b.type and len(_parts(a)) == len(_parts(b)) and len(other) == 1
            same = one_tree and a.child and a.child == b.child
            if alike and not same and other[0] < len(pairs) - 1:
                named.update(pairs[other[0]])
        if not moving:
            named = {child.split("/")[0] for parent, child in self.found.pairs if _is_odometry(parent, child)}
        return sorted(named) if len(named) > 1 else []

    def robot(self, topic: TopicSummary) -> str:
        """Return the robot that a topic is of."""
        mine = next((name for name in self.spaces if name in _parts(topic)), None)
        return mine or (self.spaces[0] if self.spaces else "robot")

    def useless(self, topic: TopicSummary) -> str:
        """Return why a topic of observations cannot be used, "" if it can."""
        frame = topic.frame.lstrip("/")
        odometries = {each.frame.lstrip("/") for each in self.usable if each.offers.twist and each.offers.pose}
        if topic.offers.seen is not None and frame and (frame in odometries or frame.split("/")[-1] in WORLD):
            return f"its frame {frame} is one of the world: a map, not what a sensor of the robot sees"
        return _useless(topic)

    def lines(self) -> _Lines:
        """Return what is to be written."""
        out = _Lines()
        robots: dict[str, list[TopicSummary]] = {}
        for topic in self.usable:
            robots.setdefault(self.robot(topic), []).append(topic)
        for robot, topics in robots.items():
            self.one(robot, topics, out)
        self.clock([self.found.named(name) for name in out.entries], out)
        for name, (entry, why) in out.entries.items():
            out.topics.append(f"{quoted(name)}: {mapping(entry)}  # {why}")
        for topic in self.found.topics:
            if not topic.count:
                out.unused.append(f"{topic.name} ({short(topic.type)}): no messages")
        return out

    def one(self, robot: str, topics: Sequence[TopicSummary], out: _Lines) -> None:
        """Add the lines of one robot."""
        scans = [topic for topic in topics if topic.offers.seen is not None and not self.useless(topic)]
        control, kind = self.control(robot, topics, not any(map(_in_pixels, scans)))
        space = kind in SPACE if kind else not any(topic.columns[:2] == BEAM for topic in scans)
        used = self.used(topics, scans, control, kind, space)
        start = self.start(control, used, space)
        true = [self.found.named(name).poses.frames for name, (entry, _) in used.items() if entry["type"] == "truth"]
        ahead = start.at[2] if start is not None else yaw(true[0][0]) if true else 0.0
        readings = _Readings(self, control, kind, space, start, ahead)
        used |= readings.entries(topics)
        whose = {"robot": robot} if robot != "robot" else {}
        out.entries |= {name: (entry | whose, why) for name, (entry, why) in used.items()}
        out.unused += [
            f"{topic.name} ({short(topic.type)}): "
            f"{self.useless(topic) or readings.unused(topic) or self.why_not(topic)}"
            for topic in topics
            if topic.name not in used
        ]
        lines = []
        if kind:
            car = {"wheelbase_m": 2.83, "encoder_offset_m": 0.0} if kind == "ackermann" else {}
            why = f"{GUESS} its wheelbase; " if car else ""
            motion = mapping({"type": kind} | car)
            lines.append(f"motion: {motion}  # {why}its noise has defaults; `kalmark tune` estimates it")
        elif used:
            lines += [f"motion: {mapping(COASTING[space])}  # {GUESS} there is no topic of controls"]
            lines += [f"start: {mapping(AT_REST)}  # {GUESS} at rest, about"]
        lines += [] if start is None else [readings.start()]
        if scans or readings.sensors:
            lines += ["sensors:", *(f"  {line}" for line in readings.sensors)]
        for topic in scans:
            lines.append(f"  {self.sensor(topic, control, space)}")
            if topic.columns == CORNERS or (space and topic.columns == POSE and _is_tag(topic)):
                self.tail = ["landmarks: {type: tag}"]
        if lines:
            out.robots[robot] = lines

    def used(
        self, topics: Sequence[TopicSummary], scans: Sequence[TopicSummary], control: Any, kind: str, space: bool
    ) -> dict[str, tuple[dict[str, Any], str]]:
        """Return the entries of the topics that are used, each with the reason."""
        used: dict[str, tuple[dict[str, Any], str]] = {}
        if isinstance(control, TopicSummary):
            slow = control.offers.pose is not None and any(scan.rate_hz > SLOW * control.rate_hz for scan in scans)
            entry: dict[str, Any] = {"type": kind} | ({"at": "scans"} if slow and "odometry" in kind else {})
            used[control.name] = (entry, self.of_control(control))
        elif control is not None:
            entry = {"type": kind, "frame": control[0], "child_frame": control[1]}
            name = next(topic.name for topic in topics if _has_frames(topic))
            used[name] = (entry, f"{GUESS} these two frames are the odometry's")
        for topic in topics:
            if topic.name not in used and (entry_and_why := self.place(topic)) is not None:
                used[topic.name] = entry_and_why
        return used | {topic.name: (self.of_scan(topic, space), told(topic)) for topic in scans}

    # -------------------------------------------------------------- controls
    def control(
        self, robot: str, topics: Sequence[TopicSummary], flat: bool
    ) -> tuple[TopicSummary | tuple[str, str] | None, str]:
        """Return the topic, or the frames, of a robot's controls, and their type."""
        odometries = [t for t in topics if t.offers.twist and t.offers.pose and not _is_true(t) and t.poses.frames]
        odometries.sort(key=lambda t: (not t.poses.moves, any(word in t.name.lower() for word in LATER), t.name))
        for topic in odometries[:1]:
            if topic.turns and not topic.poses.moves:
                return topic, "unicycle" if flat else "velocity_3d"
            return topic, "odometry_2d" if flat and topic.poses.flat else "odometry_3d"
        for pair, poses in self.found.pairs.items():
            whose = pair[1].split("/")[0] == robot if self.spaces else True
            if any(map(_has_frames, topics)) and _is_odometry(*pair) and whose:
                return pair, "odometry_2d" if flat and poses.flat else "odometry_3d"
        for topic in (t for t in topics if t.offers.drive):
            return topic, "ackermann"
        for topic in sorted((t for t in topics if t.offers.twist), key=lambda t: ("cmd" in t.name, t.name)):
            return topic, "unicycle" if flat else "velocity_3d"
        for topic in (t for t in topics if t.offers.pose and not _is_true(t) and not t.offers.noisy and _is_path(t)):
            return topic, "odometry_2d" if flat and topic.poses.flat else "odometry_3d"
        return None, ""

    def of_control(self, topic: TopicSummary) -> str:
        """Return why this is the control."""
        path = f"its path is {'flat' if topic.poses.frames and topic.poses.flat else 'not flat'}"
        if topic.offers.pose is not None and topic.poses.frames and not topic.poses.moves and topic.turns:
            return f"{told(topic)}; {GUESS} its velocities, because its poses stand still"
        if topic.offers.pose is not None:
            return f"{told(topic)}: {path}" + ("" if topic.offers.twist else f"; {GUESS} it is an odometry")
        commanded = ", as commanded" if "cmd" in topic.name else ""
        return f"{told(topic)}; {GUESS} these are velocities of the robot{commanded}"

    # -------------------------------------------------------------- fixes and truth
    def place(self, topic: TopicSummary) -> tuple[dict[str, Any], str] | None:
        """Return what a topic of positions is, None if it is none or not to be used."""
        if topic.offers.globe is not None and topic.origin is not None:
            entry: dict[str, Any] = {"type": "fix", "origin": [float(v) for v in topic.origin]}
            if topic.poses.cov is None:
                why = f"{told(topic)}; {GUESS} sigma_m, as the receiver has no covariance"
                return entry | {"sigma_m": SATELLITE_M}, why
            return entry, f"{told(topic)}; the origin is the first fix"
        if topic.offers.pose is None or not topic.poses.frames:
            return None
        if _is_true(topic):
            return {"type": "truth"}, f"{told(topic)}; {GUESS} by its name"
        if topic.offers.twist is None and topic.offers.noisy and not _is_wanted(topic):
            if topic.poses.cov is None:
                why = f"{told(topic)}; {GUESS} positions in the map, and sigma_m, as they have no covariance"
                return {"type": "fix", "sigma_m": POSE_M}, why
            return {"type": "fix"}, f"{told(topic)}; {GUESS} positions in the map, with their covariance"
        return None

    def why_not(self, topic: TopicSummary) -> str:
        """Return why a topic is not used."""
        if topic.error:
            return topic.error
        if topic.offers.transforms is not None:
            return "frames: the mounts of sensors are taken from them"
        if topic.offers.camera is not None:
            return "the numbers of a camera"
        if topic.offers.pose is not None or topic.offers.twist is not None:
            return "if it is `truth` or a `fix`, say so"
        return "no type of message that kalmark reads"

    def start(self, control: Any, used: dict[str, tuple[dict[str, Any], str]], space: bool) -> _Start | None:
        """Return a robot's start in the frame of its fixes, None if nothing tells it or truth does."""
        if control is None or space or any(entry["type"] == "truth" for entry, _ in used.values()):
            return None
        fixes = [self.found.named(name) for name, (entry, _) in used.items() if entry["type"] == "fix"]
        if not fixes:
            return None
        fix, poses = fixes[0], control.poses if isinstance(control, TopicSummary) else self.found.pairs[control]
        if fix.offers.pose is not None:
            cov = np.diag([POSE_M**2] * 3 + [POSE_RAD**2] * 3) if fix.poses.cov is None else fix.poses.cov
            sigmas = [math.sqrt(max(cov[0, 0], cov[1, 1], 1e-4)), math.sqrt(max(cov[5, 5], 1e-4))]
            first = fix.poses.frames[0]
            at = [float(first[0]), float(first[1]), yaw(first)]
            return _Start(at, sigmas, f"{GUESS} the first pose of {fix.name}")
        if (found := aligned(poses, fix)) is not None:
            return _Start(*found, f"{GUESS} the way by odometry laid upon that by {fix.name}", north=True)
        return _Start([0.0] * 3, [5.0, 1.5], f"{GUESS} its heading, from east to the left", north=True, known=False)

    def clock(self, topics: Sequence[TopicSummary], out: _Lines) -> None:
        """Take the recorder's time where headers have none; for all where theirs is another clock, or one that was set.

        Messages out of order by less are left out.
        """
        other = any(topic.header and abs(topic.offset_s) > DAY_NS * 1e-9 for topic in topics)
        bare = any(not topic.header and topic.offers.transforms is None for topic in topics)
        jumped = next((topic for topic in topics if topic.back_s > JUMP_S), None)
        late = next((topic for topic in topics if topic.back_s > 0 and topic.offers.pose is not None), None)
        since = ""
        if jumped is not None:
            since = f"; {GUESS} the recorder's time, as that of {jumped.name} runs back by {jumped.back_s:.3g} s"
        for name, (entry, why) in out.entries.items():
            if jumped is not None or (other and bare) or self.found.named(name).unset:
                out.entries[name] = entry | {"time": "recorded"}, why + since
        if late is not None and jumped is None:
            why = f"the times of {late.name} run back by {late.back_s:.3g} s: such messages are left out"
            out.log.append(f"  on_error: skip  # {GUESS} {why}")

    # -------------------------------------------------------------- sensors
    def of_scan(self, topic: TopicSummary, space: bool) -> dict[str, Any]:
        """Return the entry of a topic of observations."""
        entry: dict[str, Any] = {"type": "scan", "sensor": sensor_name(topic.name, Scans())}
        for key, names in (("ids", IDS), ("clusters", CLUSTERS)):
            name = next((each for each in topic.fields if each in names), None)
            if name and not {"ids", "clusters"} & entry.keys():
                entry[key] = name
        if topic.columns == CORNERS:
            entry["size_m"] = 0.16
        if topic.columns == ("range_m",):
            entry["landmark"] = sensor_name(topic.name, Scans())
        if topic.columns == POSE and not _is_tag(topic):
            entry["take"] = [*POSE[:3]] if space else [*POSE[:2]]
        return entry

    def sensor(self, topic: TopicSummary, control: Any, space: bool) -> str:
        """Return the line of a sensor's section."""
        mount = self.mount(topic, control)
        section, why = self.model(topic, space)
        if mount is None:
            section["mount"] = dict.fromkeys(placed(np.array([0.0] * 6 + [1.0])), 0.0) if space else {
                "x_m": 0.0, "y_m": 0.0, "theta_rad": 0.0}  # fmt: skip
            why = f"{why}; {GUESS} the mount: tf does not have {topic.frame or 'its frame'}".removeprefix("; ")
        else:
            why = f"{why}; its mount is that of tf".removeprefix("; ")
        return f"{sensor_name(topic.name, Scans())}: {mapping(section)}  # {why}"

    def mount(self, topic: TopicSummary, control: Any) -> Array | None:
        """Return where tf has the frame of a sensor in that of its robot."""
        named = control.child if isinstance(control, TopicSummary) else control[1] if control else ""
        base = self.found.frames.base([named], topic.frame)
        return None if base is None else self.found.frames.fixed(base, topic.frame)

    def model(self, topic: TopicSummary, space: bool) -> tuple[dict[str, Any], str]:
        """Return a sensor's section, and why."""
        columns = topic.columns
        if columns[:2] == BEAM:
            detector = {"type": "trunks"}
            section = {"type": "range_bearing", "detector": detector, "association": {"type": "auto"}}
            return section, f"{GUESS} posts and trunks are its landmarks; or corners, reflectors"
        if columns == ("range_m",):
            section = {"type": "range"} if space else {"type": "range", "initialization": {"type": "trilateration"}}
            return section, f"{GUESS} `landmark` of its topic is what it measures"
        if columns == CORNERS or columns[:1] == ("u_px",):
            camera = self.camera(topic)
            kind = "tag_corners" if columns == CORNERS else "pinhole"
            numbers = camera or {"fx_px": 600.0, "fy_px": 600.0, "cx_px": 640.0, "cy_px": 512.0,
                                 "width_px": 1280, "height_px": 1024}  # fmt: skip
            why = "its numbers are those of CameraInfo" if camera else f"{GUESS} its numbers: there is no CameraInfo"
            return {"type": kind} | numbers, why
        kind = ("tag_pose" if _is_tag(topic) else "position_3d") if space else "position"
        named = {} if topic.named or {*topic.fields} & {*IDS} else {"association": {"type": "auto"}}
        return {"type": kind} | named, ""

    def camera(self, topic: TopicSummary) -> dict[str, Any] | None:
        """Return the numbers of the camera of a topic: of its frame, or else the only ones."""
        infos = [each for each in self.found.topics if each.camera is not None]
        mine = [each for each in infos if each.frame == topic.frame] or (infos if len(infos) == 1 else [])
        return mine[0].camera if mine else None


class _Readings:
    """Decides which readings of inertial units and compasses are taken, for one robot, and how good they may be."""

    def __init__(
        self, writer: _Writer, control: Any, kind: str, space: bool, start: _Start | None, ahead: float
    ) -> None:
        self.writer, self.control, self.kind, self.begin, self.ahead = writer, control, kind, start, ahead
        self.space = space
        self.sensors: list[str] = []
        self.taken: set[str] = set()
        self.heading: float | None = None  # the first that was measured, and taken

    def entries(self, topics: Sequence[TopicSummary]) -> dict[str, tuple[dict[str, Any], str]]:
        """Return the entries of the topics that are used, each with the reason."""
        used = {}
        for topic in sorted(topics, key=lambda each: each.offers.rates is None):  # compasses last
            if {"rates", "attitude"} & topic.first.keys() and (entry := self.unit(topic)) is not None:
                used[topic.name] = (entry, told(topic))
            elif "field" in topic.first and not self.space and self.heading is None:
                used[topic.name] = (self.compass(topic), told(topic))
        return used

    def unused(self, topic: TopicSummary) -> str:
        """Return why a topic of an inertial unit or a compass is not used, "" if it is no such."""
        if topic.offers.rates is not None:
            return topic.error or "no rates, and no covariance of its orientation"
        if topic.offers.field is not None:
            return "headings by a magnetic field are for the plane, and for robots without another heading"
        return ""

    def unit(self, topic: TopicSummary) -> dict[str, Any] | None:
        """Return the entry of an inertial unit, None if nothing of it is taken; note its sensors."""
        entry: dict[str, Any] = {"type": "imu"}
        rates, attitude = topic.first.get("rates"), topic.first.get("attitude")
        spread = None if attitude is None or attitude.cov is None else np.diagonal(attitude.cov)
        level = self.space and spread is not None and spread[:2].min() > 0
        if rates is None:
            entry["gyro"] = None
        else:
            entry |= self.gyro(topic, rates)
        if attitude is not None and spread is not None and spread[2] > 0:
            entry |= {"heading": self.named("compass", topic)}
            self.compass_line(entry["heading"], topic, attitude.v, max(math.sqrt(spread[2]), HEADING_RAD))
        if level and spread is not None:
            entry |= {"inclination": self.named("level", topic)}
            section = {"type": "inclination", "sigma_rad": max(math.sqrt(spread[:2].max()), HEADING_RAD)}
            self.line(entry["inclination"], section, topic, f"{GUESS} its noise")
        if {"heading", "inclination"} & entry.keys():
            entry["every_s"] = HEADING_S
        return None if entry == {"type": "imu", "gyro": None} else entry

    def gyro(self, topic: TopicSummary, rates: Measured) -> dict[str, Any]:
        """Return what an entry says of the rates; note their sensor."""
        name = self.named("gyro", topic)
        sigma, why = GYRO_RADPS, f"{GUESS} its noise and its bias"
        if rates.cov is not None and rates.cov[2, 2] > 0:
            sigma, why = math.sqrt(rates.cov[2, 2]), f"{GUESS} its bias; its noise is that of its message"
        at = {}
        if "odometry" in self.kind:
            at = {"at": "controls"}
            usual = self.control.rate_hz if isinstance(self.control, TopicSummary) else math.nan
            many = topic.rate_hz / usual
            sigma /= math.sqrt(many) if many > 1 else 1.0
        self.line(name, {"type": "gyro", "sigma_radps": sigma} | BIAS, topic, why)
        return {"gyro": name} | at

    def compass(self, topic: TopicSummary) -> dict[str, Any]:
        """Return the entry of a magnetic field; note its sensor."""
        name = self.named("compass", topic)
        self.compass_line(name, topic, topic.first["field"].v, FIELD_RAD)
        return {"type": "compass", "sensor": name, "every_s": HEADING_S}

    def compass_line(self, name: str, topic: TopicSummary, v: Array, sigma: float) -> None:
        """Note a sensor of headings, its declination such that its first heading is that of the start."""
        mount = self.writer.mount(topic, self.control)
        R = np.eye(3) if mount is None else rotations.matrix(np.array(mount[3:]))
        heading = heading_of(v, np.eye(3) if self.space else R) if len(v) == 4 else heading_of_field(R @ v)
        self.heading = heading if self.heading is None else self.heading
        section: dict[str, Any] = {"type": "heading", "sigma_heading_rad": sigma}
        if self.begin is not None and self.begin.north:
            section |= {"declination_rad": 0.0, "sigma_declination_rad": NORTH_RAD}
            self.line(name, section, topic, f"{GUESS} its north is true north, or nearly")
            return
        ahead = heading_of(np.array([0.0, 0, 0, 1]), R.T) if self.space else 0.0  # of the sensor, at the start
        off = 0.0 if heading is None else math.remainder(self.ahead + ahead - heading, 2 * math.pi)
        section |= {"declination_rad": off, "sigma_declination_rad": START_RAD}
        self.line(name, section, topic, f"{GUESS} its first heading is that of the start")

    def start(self) -> str:
        """Return the line of the robot's start; a heading that nothing else tells is that of the compass."""
        begin = self.begin
        assert begin is not None
        at, sigmas, why = begin.at, begin.sigmas, begin.why
        if not begin.known and self.heading is not None:
            at, sigmas = [*at[:2], self.heading], [sigmas[0], NORTH_RAD]
            why = f"{GUESS} its heading is that of its compass"
        keys = ("x_m", "y_m", "theta_rad", "sigma_xy_m", "sigma_theta_rad")
        return f"start: {mapping(dict(zip(keys, [*at, *sigmas], strict=True)))}  # {why}"

    def named(self, name: str, topic: TopicSummary) -> str:
        """Return the name of a sensor, with that of its topic if another has it."""
        name = f"{sensor_name(topic.name, Scans())}_{name}" if name in self.taken else name
        self.taken.add(name)
        return name

    def line(self, name: str, section: dict[str, Any], topic: TopicSummary, why: str) -> None:
        """Note the line of a sensor; a mount that tf does not have is to be given where it counts."""
        if self.writer.mount(topic, self.control) is not None:
            why = f"{why}; its mount is that of tf"
        else:
            why = f"{why}; {GUESS} its axes are those of the robot"
        self.sensors.append(f"{quoted(name)}: {mapping(section)}  # {why}")


def _parts(topic: TopicSummary) -> list[str]:
    return topic.name.strip("/").split("/")


def _moves(topic: TopicSummary) -> bool:
    return topic.offers.twist is not None or topic.offers.drive is not None


def _is_true(topic: TopicSummary) -> bool:
    return any(word in topic.name.lower() for word in TRUE)


def _is_wanted(topic: TopicSummary) -> bool:
    return any(word in topic.name.lower() for word in WANTED)


def _is_path(topic: TopicSummary) -> bool:
    return topic.poses.moves and len(topic.poses.frames) >= LEAST_POSES and not _is_wanted(topic)


def _is_odometry(parent: str, child: str) -> bool:
    return "odom" in parent and any(base in child for base in BASES)


def _has_frames(topic: TopicSummary) -> bool:
    return topic.offers.transforms is not None and "static" not in topic.name


def _in_pixels(topic: TopicSummary) -> bool:
    return topic.columns[:1] in (("u_px",), ("u1_px",))


def _is_tag(topic: TopicSummary) -> bool:
    return topic.what.endswith("of tags")


def _useless(topic: TopicSummary) -> str:
    """Return why a topic of observations cannot be used, "" if it can."""
    if topic.offers.seen is None or topic.columns:
        return ""
    if topic.fields:
        known = {*IDS, *CLUSTERS} & {*topic.fields}
        return "" if known else f"points with {', '.join(topic.fields)}, no ids and no clusters"
    return topic.error or "nothing was seen"


def aligned(odometry: Poses, fixes: TopicSummary) -> tuple[list[float], list[float]] | None:
    """Return the start (x, y, heading) that lays a way by odometry upon satellite fixes, and its sigmas.

    By least squares; None where they have too little way in common.
    """
    if not odometry.moves:
        return None
    t_ns, frames = np.array(odometry.t_ns), np.array(odometry.frames)
    lla = np.array([frame[:3] for frame in fixes.poses.frames])
    enu = local(lla, fixes.origin)[:, :2]
    after = np.clip(np.searchsorted(t_ns, fixes.poses.t_ns), 1, len(t_ns) - 1)
    near = np.abs(t_ns[after] - np.array(fixes.poses.t_ns)) < NEAR_NS
    p, q = frames[after[near], :2], enu[near]
    if len(p) < 3 or np.ptp(p, axis=0).max() < LEAST_WAY_M:
        return None
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    turn = math.atan2(float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(np.sum(a * b)))
    R = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    spread = math.sqrt(float(np.mean((b - a @ R.T) ** 2))) + 0.05
    start = R @ (frames[0, :2] - p.mean(axis=0)) + q.mean(axis=0)
    heading = math.remainder(yaw(frames[0]) + turn, 2 * math.pi)
    return [float(start[0]), float(start[1]), heading], [spread, max(spread / float(np.linalg.norm(a)), 0.05)]
