"""A first configuration of a bag: what its topics probably are, with a comment where that is a guess."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.logs.bag.geodesy import local
from kalmark.logs.bag.importer import BASES, DAY_NS, sensor_name, short
from kalmark.logs.bag.messages import BEAM, CORNERS, POSE
from kalmark.logs.bag.survey import Poses, Survey, TopicSummary, yaw
from kalmark.logs.bag.topics import Scans
from kalmark.logs.source import placed

TRUE = ("truth", "vicon", "mocap", "optitrack", "/gt", "gt_", "_gt")
LATER = ("filtered", "global", "map", "gps")  # odometry of these names has been corrected by something else
IDS, CLUSTERS = ("id", "ids", "track_id", "label"), ("cluster", "cluster_id", "segment")
SPACE = ("", "odometry_3d", "velocity_3d")
COASTING = {"type": "constant_velocity_3d", "sigma_v_mps_per_sqrt_s": 0.3, "sigma_w_radps_per_sqrt_s": 0.3}
AT_REST = {"sigma_v_mps": 0.5, "sigma_w_radps": 0.5}
SLOW = 0.5
"""An odometry of less than two messages for each of a sensor's gives increments that end at its scans."""
NEAR_NS = 500_000_000
LEAST_WAY_M = 2.0
GUESS = "GUESS:"


@dataclass
class _Lines:
    """Lines of the file: topics of the log, and of each robot its motion, start and sensors."""

    topics: list[str] = field(default_factory=list)
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
    out = [*head, "  topics:", *(f"    {line}" for line in lines.topics)]
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


class _Writer:
    """Decides what each topic is, robot by robot."""

    def __init__(self, found: Survey) -> None:
        self.found = found
        self.usable = [topic for topic in found.topics if topic.count]
        self.spaces = self._namespaces()
        self.tail: list[str] = []

    def _namespaces(self) -> list[str]:
        """Return the names of the robots: the first parts of topics, where several of them have controls."""
        named = {topic.name.strip("/").split("/")[0] for topic in self.usable if _moves(topic) and _parts(topic) > 1}
        return sorted(named) if len(named) > 1 else []

    def robot(self, topic: TopicSummary) -> str:
        """Return the robot that a topic is of."""
        first = topic.name.strip("/").split("/")[0]
        return first if first in self.spaces else self.spaces[0] if self.spaces else "robot"

    def lines(self) -> _Lines:
        """Return what is to be written."""
        out = _Lines()
        robots: dict[str, list[TopicSummary]] = {}
        for topic in self.usable:
            robots.setdefault(self.robot(topic), []).append(topic)
        for robot, topics in robots.items():
            self.one(robot, topics, out)
        for topic in self.found.topics:
            if not topic.count:
                out.unused.append(f"{topic.name} ({short(topic.type)}): no messages")
        return out

    def one(self, robot: str, topics: Sequence[TopicSummary], out: _Lines) -> None:
        """Add the lines of one robot."""
        scans = [topic for topic in topics if topic.offers.seen is not None and not _useless(topic)]
        control, kind = self.control(topics, not any(map(_in_pixels, scans)))
        used = self.used(topics, scans, control, kind)
        clock = self.clock([self.found.named(name) for name in used])
        whose = {"robot": robot} if robot != "robot" else {}
        out.topics += [
            f"{quoted(name)}: {mapping(entry | whose | clock)}  # {why}" for name, (entry, why) in used.items()
        ]
        out.unused += [
            f"{topic.name} ({short(topic.type)}): {_useless(topic) or self.why_not(topic)}"
            for topic in topics
            if topic.name not in used
        ]
        space = kind in SPACE
        lines = []
        if kind:
            lines.append(f"motion: {{type: {kind}}}  # its noise has defaults; `kalmark tune` estimates it")
        elif scans:
            lines += [f"motion: {mapping(COASTING)}  # {GUESS} there is no topic of controls"]
            lines += [f"start: {mapping(AT_REST)}  # {GUESS} at rest, about"]
        lines += self.start(control, used, space)
        if scans:
            lines.append("sensors:")
        for topic in scans:
            lines.append(f"  {self.sensor(topic, control, space)}")
            if topic.columns == CORNERS or (space and topic.columns == POSE and _is_tag(topic)):
                self.tail = ["landmarks: {type: tag}"]
        if lines:
            out.robots[robot] = lines

    def used(
        self, topics: Sequence[TopicSummary], scans: Sequence[TopicSummary], control: Any, kind: str
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
        space = kind in SPACE
        return used | {topic.name: (self.of_scan(topic, space), told(topic)) for topic in scans}

    # -------------------------------------------------------------- controls
    def control(self, topics: Sequence[TopicSummary], flat: bool) -> tuple[TopicSummary | tuple[str, str] | None, str]:
        """Return the topic, or the frames, of a robot's controls, and their type."""
        odometries = [t for t in topics if t.offers.twist and t.offers.pose and not _is_true(t) and t.poses.frames]
        odometries.sort(key=lambda t: (not t.poses.moves, any(word in t.name.lower() for word in LATER), t.name))
        for topic in odometries[:1]:
            return topic, "odometry_2d" if flat and topic.poses.flat else "odometry_3d"
        for pair, poses in self.found.pairs.items():
            if any(map(_has_frames, topics)) and "odom" in pair[0] and any(base in pair[1] for base in BASES):
                return pair, "odometry_2d" if flat and poses.flat else "odometry_3d"
        for topic in (t for t in topics if t.offers.drive):
            return topic, "ackermann"
        for topic in sorted((t for t in topics if t.offers.twist), key=lambda t: ("cmd" in t.name, t.name)):
            return topic, "unicycle" if flat else "velocity_3d"
        for topic in (t for t in topics if t.offers.pose and not _is_true(t) and t.poses.cov is None and t.poses.moves):
            return topic, "odometry_2d" if flat and topic.poses.flat else "odometry_3d"
        return None, ""

    def of_control(self, topic: TopicSummary) -> str:
        """Return why this is the control."""
        path = f"its path is {'flat' if topic.poses.frames and topic.poses.flat else 'not flat'}"
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
                return entry | {"sigma_m": 2.0}, f"{told(topic)}; {GUESS} sigma_m, as the receiver has no covariance"
            return entry, f"{told(topic)}; the origin is the first fix"
        if topic.offers.pose is None or not topic.poses.frames:
            return None
        if _is_true(topic):
            return {"type": "truth"}, f"{told(topic)}; {GUESS} by its name"
        if topic.offers.twist is None and topic.poses.cov is not None and "initial" not in topic.name:
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
        return "not read yet" if topic.what else "no type of message that kalmark reads"

    def start(self, control: Any, used: dict[str, tuple[dict[str, Any], str]], space: bool) -> list[str]:
        """Return the line of a robot's start in the frame of its fixes, none if nothing tells it or truth does."""
        if control is None or space or any(entry["type"] == "truth" for entry, _ in used.values()):
            return []
        fixes = [self.found.named(name) for name, (entry, _) in used.items() if entry["type"] == "fix"]
        if not fixes:
            return []
        fix, poses = fixes[0], control.poses if isinstance(control, TopicSummary) else self.found.pairs[control]
        if fix.offers.pose is not None:
            cov = np.zeros((6, 6)) if fix.poses.cov is None else fix.poses.cov
            sigmas = [math.sqrt(max(cov[0, 0], cov[1, 1], 1e-4)), math.sqrt(max(cov[5, 5], 1e-4))]
            first = fix.poses.frames[0]
            at, why = [float(first[0]), float(first[1]), yaw(first)], f"{GUESS} the first pose of {fix.name}"
        elif (found := aligned(poses, fix)) is not None:
            at, sigmas = found
            why = f"{GUESS} the way by odometry laid upon that by {fix.name}"
        else:
            at, sigmas, why = [0.0, 0.0, 0.0], [5.0, 1.5], f"{GUESS} its heading, from east to the left"
        keys = ("x_m", "y_m", "theta_rad", "sigma_xy_m", "sigma_theta_rad")
        return [f"start: {mapping(dict(zip(keys, [*at, *sigmas], strict=True)))}  # {why}"]

    def clock(self, topics: Sequence[TopicSummary]) -> dict[str, str]:
        """Return `time: recorded` for all if some messages have no header and the others' is another clock."""
        other = any(topic.header and abs(topic.offset_s) > DAY_NS * 1e-9 for topic in topics)
        bare = any(not topic.header and topic.offers.transforms is None for topic in topics)
        return {"time": "recorded"} if other and bare else {}

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
        base = control.child if isinstance(control, TopicSummary) else control[1] if control else ""
        bases = [each for each in (base, *BASES) if each and each.lstrip("/") in self.found.frames.names()]
        mount = self.found.frames.fixed(bases[0], topic.frame) if bases else None
        section, why = self.model(topic, space)
        if mount is None:
            section["mount"] = dict.fromkeys(placed(np.array([0.0] * 6 + [1.0])), 0.0) if space else {
                "x_m": 0.0, "y_m": 0.0, "theta_rad": 0.0}  # fmt: skip
            why = f"{why}; {GUESS} the mount: tf does not have {topic.frame or 'its frame'}".removeprefix("; ")
        else:
            why = f"{why}; its mount is that of tf".removeprefix("; ")
        return f"{sensor_name(topic.name, Scans())}: {mapping(section)}  # {why}"

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


def _parts(topic: TopicSummary) -> int:
    return len(topic.name.strip("/").split("/"))


def _moves(topic: TopicSummary) -> bool:
    return topic.offers.twist is not None or topic.offers.drive is not None


def _is_true(topic: TopicSummary) -> bool:
    return any(word in topic.name.lower() for word in TRUE)


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
