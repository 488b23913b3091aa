"""A first configuration of a bag: what its topics probably are, with a comment where that is a guess."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

from kalmark.bags.configured_topics import short
from kalmark.bags.first_readings import Readings
from kalmark.bags.first_sensors import CLUSTERS, IDS, entry_of, is_tag, section_line
from kalmark.bags.first_start import POSE_M, start_of
from kalmark.bags.first_text import GUESS, Entry, topic_text, yaml_mapping, yaml_text
from kalmark.bags.importer import DAY_NS
from kalmark.bags.survey import Poses, Survey, TopicSummary, yaw
from kalmark.bags.tf_frames import BASES
from kalmark.logs.log import Section
from kalmark.logs.table_columns import BEAM, CORNERS, POSE3

TRUE = ("truth", "vicon", "mocap", "optitrack", "/gt", "gt_", "_gt")
LATER = ("filtered", "global", "map", "gps")  # odometry of these names has been corrected by something else
WANTED = ("goal", "target", "setpoint", "clicked", "initial", "desired")  # poses that the robot is to have
WORLD = ("map", "odom", "world", "earth")
LEAST_POSES = 10
SPACE = ("odometry_3d", "velocity_3d", "inertial")
COASTING = {
    True: {"type": "constant_velocity_3d", "sigma_v_mps_per_sqrt_s": 0.3, "sigma_w_radps_per_sqrt_s": 0.3},
    False: {"type": "constant_velocity", "sigma_vx_mps_per_sqrt_s": 0.3, "sigma_vy_mps_per_sqrt_s": 0.3,
            "sigma_w_radps_per_sqrt_s": 0.3},
}  # fmt: skip
"""The motion of a robot without controls, in space or in the plane."""
GUESSED: dict[str, tuple[Section, str]] = {
    "ackermann": ({"wheelbase_m": 2.83, "encoder_offset_m": 0.0}, f"{GUESS} its wheelbase; "),
    "inertial": ({"preset": "mems_imu"}, f"{GUESS} a small unit, whose frame is the robot's; "),
}
"""Further keys of motions, and the words for them."""
AT_REST = {"sigma_v_mps": 0.5, "sigma_w_radps": 0.5}
STILL_UNIT = {"at_rest": True, "sigma_bias_w_radps": 0.1, "sigma_bias_a_mps2": 0.1}
IMAGES_ADVICE = "images: `{type: images}` gives them to the detector of a sensor, such as tags (docs/detectors.md)"
SLOW = 0.5
"""An odometry of less than two messages for each of a sensor's gives increments that end at its scans."""
JUMP_S = 1.0  # headers that run backwards by more are of a clock that was set
SATELLITE_M = 2.0  # sigma of positions on the globe that come without a covariance


@dataclass
class _Lines:
    """Lines of the file: of the log, its topics, and of each robot its motion, start and sensors."""

    log: list[str] = field(default_factory=list)
    topics: list[str] = field(default_factory=list)
    entries: dict[str, Entry] = field(default_factory=dict)
    robots: dict[str, list[str]] = field(default_factory=dict)
    unused: list[str] = field(default_factory=list)


def first_config(found: Survey, file: Path | None = None) -> str:
    """Return the text of a first configuration of a bag, for a file at this place."""
    beside = file is not None and file.resolve().parent == found.path.resolve().parent
    path = found.path.name if beside else str(found.path.resolve())
    head = [
        f"# A first configuration of {found.path.name}, by `kalmark bag`.  Look at each line with {GUESS[:-1]}.",
        "log:",
        f"  path: {yaml_text(path)}",
        "  format: bag",
    ]
    if found.holds_log:
        head.append("  # kalmark wrote this bag: it holds a whole log, and no topics are needed")
        head.append("# robots and sensors are in its configuration: kalmark run CONFIG --log FILE --set log.format=bag")
        return "\n".join([*head, ""])
    if found.definitions:
        head += ["  definitions:", *(f"    {yaml_text(kind)}: {yaml_text(d)}" for kind, d in found.definitions.items())]
    writer = _Writer(found)
    lines = writer.lines()
    out = [*head, *lines.log, "  topics:", *(f"    {line}" for line in lines.topics)]
    out += [f"    # not used: {line}" for line in lines.unused]
    if lines.robots:
        out.append("robots:")
    for robot, section in lines.robots.items():
        out += [f"  {yaml_text(robot)}:", *(f"    {line}" for line in section)]
    out += writer.tail
    return "\n".join(out) + "\n"


def motion_lines(kind: str, space: bool) -> Iterator[str]:
    """Yield the lines of a robot's motion of this kind, "" without controls, and of its start if it is at rest."""
    if kind == "inertial":
        yield f"start: {yaml_mapping(STILL_UNIT)}  # {GUESS} at rest for half a second or more"
    if kind:
        more, why = GUESSED.get(kind, ({}, ""))
        motion = yaml_mapping({"type": kind} | more)
        yield f"motion: {motion}  # {why}its noise has defaults; `kalmark tune` estimates it"
    else:
        yield f"motion: {yaml_mapping(COASTING[space])}  # {GUESS} there is no topic of controls"
        yield f"start: {yaml_mapping(AT_REST)}  # {GUESS} at rest, about"


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
        """Return the reason against a topic of observations, "" without one."""
        frame = topic.frame.lstrip("/")
        odometries = {each.frame.lstrip("/") for each in self.usable if each.offers.twist and each.offers.pose}
        if topic.offers.seen is not None and frame and (frame in odometries or frame.split("/")[-1] in WORLD):
            return f"its frame {frame} is one of the world: a map, not what a sensor of the robot sees"
        if topic.offers.seen is None or topic.columns or {*IDS, *CLUSTERS} & {*topic.fields}:
            return ""
        if topic.fields:
            return f"points with {', '.join(topic.fields)}, no ids and no clusters"
        return topic.error or "nothing was seen"

    def lines(self) -> _Lines:
        """Return the lines to write."""
        out = _Lines()
        robots: dict[str, list[TopicSummary]] = {robot: [] for robot in self.spaces}
        for topic in self.usable:
            robots.setdefault(self.robot(topic), []).append(topic)
        for robot, topics in robots.items():
            self.one(robot, topics, out)
        self.clock([self.found.named(entry.get("topic", name)) for name, (entry, _) in out.entries.items()], out)
        for name, (entry, why) in out.entries.items():
            out.topics.append(f"{yaml_text(name)}: {yaml_mapping(entry)}  # {why}")
        for topic in self.found.topics:
            if not topic.count:
                out.unused.append(f"{topic.name} ({short(topic.type)}): no messages")
        return out

    def one(self, robot: str, topics: Sequence[TopicSummary], out: _Lines) -> None:
        """Add the lines of one robot."""
        scans = [topic for topic in topics if topic.offers.seen is not None and not self.useless(topic)]
        control, kind = self.control(
            robot, topics, not any(topic.columns[:1] in (("u_px",), ("u1_px",)) for topic in scans)
        )
        beams = any(topic.columns[:2] == BEAM for topic in scans)
        if control is None and not beams:
            control, kind = self.inertial(topics)
        space = kind in SPACE if kind else not beams
        used = self.used(robot, topics, scans, control, kind, space)
        start = start_of(self.found, control, used, space)
        true = [self.found.named(name).poses.frames for name, (entry, _) in used.items() if entry["type"] == "truth"]
        ahead = start.at[2] if start is not None else yaw(true[0][0]) if true else 0.0
        readings = Readings(self.found, control, kind, space, start, ahead)
        used |= readings.entries([topic for topic in topics if kind != "inertial" or topic is not control])
        whose = {"robot": robot} if robot != "robot" else {}
        out.entries |= {name: (entry | whose, why) for name, (entry, why) in used.items()}
        out.unused += [
            f"{topic.name} ({short(topic.type)}): "
            f"{self.useless(topic) or readings.unused(topic) or self.why_not(topic)}"
            for topic in topics
            if topic.name not in used
        ]
        lines = [*motion_lines(kind, space)] if kind or used else []
        lines += [] if start is None else [readings.start()]
        if scans or readings.sensors:
            lines += ["sensors:", *(f"  {line}" for line in readings.sensors)]
        for topic in scans:
            lines.append(f"  {section_line(self.found, topic, control, space)}")
            if topic.columns == CORNERS or (space and topic.columns == POSE3 and is_tag(topic)):
                self.tail = ["landmarks: {type: tag}"]
        if lines:
            out.robots[robot] = lines

    def used(
        self,
        robot: str,
        topics: Sequence[TopicSummary],
        scans: Sequence[TopicSummary],
        control: Any,
        kind: str,
        space: bool,
    ) -> dict[str, Entry]:
        """Return the entries of the topics that are used, each with the reason."""
        used: dict[str, Entry] = {}
        if isinstance(control, TopicSummary):
            slow = control.offers.pose is not None and any(scan.rate_hz > SLOW * control.rate_hz for scan in scans)
            entry: Section = {"type": kind} | ({"at": "scans"} if slow and "odometry" in kind else {})
            used[control.name] = (entry, self.of_control(control))
        elif control is not None:
            entry = {"type": kind, "frame": control[0], "child_frame": control[1]}
            name = next(topic.name for topic in (*topics, *self.usable) if _has_frames(topic))
            if not any(topic.name == name for topic in topics):  # one topic has the frames of several robots
                entry, name = {"topic": name} | entry, f"{name} of {robot}"
            used[name] = (entry, f"{GUESS} these two frames are the odometry's")
        for topic in topics:
            if topic.name not in used and (entry_and_why := self.place(topic)) is not None:
                used[topic.name] = entry_and_why
        for topic in scans:
            entry = entry_of(topic, space)
            why = f"; {GUESS} the edge of the tags" if "size_m" in entry else ""
            why += f"; {GUESS} these fields, in m and rad, by their names" if topic.stated else ""
            used[topic.name] = entry, f"{topic_text(topic)}{why}"
        return used

    # -------------------------------------------------------------- controls
    def control(
        self, robot: str, topics: Sequence[TopicSummary], flat: bool
    ) -> tuple[TopicSummary | tuple[str, str] | None, str]:
        """Return the topic, or the frames, of a robot's controls, and their type."""
        estimated = [t for t in topics if not _has_word(t, TRUE)]
        odometries = [t for t in estimated if t.offers.twist and t.offers.pose and t.poses.frames]
        odometries.sort(key=lambda t: (not t.poses.moves, _has_word(t, LATER), t.name))
        velocity = "unicycle" if flat else "velocity_3d"

        def odometry(poses: Poses) -> str:
            return "odometry_2d" if flat and poses.flat else "odometry_3d"

        for topic in odometries[:1]:
            return topic, velocity if topic.turns and not topic.poses.moves else odometry(topic.poses)
        for pair, poses in self.found.pairs.items():
            whose = pair[1].split("/")[0] == robot if self.spaces else True
            if any(map(_has_frames, self.usable)) and _is_odometry(*pair) and whose:
                return pair, odometry(poses)
        for topic in (t for t in topics if t.offers.drive):
            return topic, "ackermann"
        for topic in sorted((t for t in topics if t.offers.twist), key=lambda t: ("cmd" in t.name, t.name)):
            return topic, velocity
        for topic in (t for t in estimated if t.offers.pose and not t.offers.noisy and t.poses.moves):
            if len(topic.poses.frames) >= LEAST_POSES and not _has_word(topic, WANTED):
                return topic, odometry(topic.poses)
        return None, ""

    def inertial(self, topics: Sequence[TopicSummary]) -> tuple[TopicSummary | None, str]:
        """Return the inertial unit that moves a robot of space without other controls: the fastest one."""
        units = [topic for topic in topics if {"rates", "force"} <= topic.first.keys()]
        best = max(units, key=lambda topic: (topic.rate_hz > 0, topic.rate_hz), default=None)
        return best, "" if best is None else "inertial"

    def of_control(self, topic: TopicSummary) -> str:
        """Return the reason for this control."""
        path = f"its path is {'flat' if topic.poses.frames and topic.poses.flat else 'not flat'}"
        if topic.offers.pose is not None and topic.poses.frames and not topic.poses.moves and topic.turns:
            return f"{topic_text(topic)}; {GUESS} its velocities, because its poses stand still"
        if topic.offers.pose is not None:
            return f"{topic_text(topic)}: {path}" + ("" if topic.offers.twist else f"; {GUESS} it is an odometry")
        if topic.offers.rates is not None:
            return f"{topic_text(topic)}; {GUESS} it moves the robot, as there is no odometry and no velocity"
        commanded = ", as commanded" if "cmd" in topic.name else ""
        return f"{topic_text(topic)}; {GUESS} these are velocities of the robot{commanded}"

    # -------------------------------------------------------------- fixes and truth
    def place(self, topic: TopicSummary) -> Entry | None:
        """Return what a topic of positions is, None if it is none or not to be used."""
        if topic.offers.globe is not None and topic.origin is not None:
            if _has_word(topic, TRUE):
                return {"type": "truth"}, f"{topic_text(topic)}; {GUESS} by its name: its positions only score"
            entry: Section = {"type": "fix", "origin": [float(v) for v in topic.origin]}
            if topic.poses.cov is None:
                why = f"{topic_text(topic)}; {GUESS} sigma_m, as the receiver has no covariance"
                return entry | {"sigma_m": SATELLITE_M}, why
            return entry, f"{topic_text(topic)}; the origin is the first fix"
        if topic.offers.pose is None or not topic.poses.frames:
            return None
        if _has_word(topic, TRUE):
            return {"type": "truth"}, f"{topic_text(topic)}; {GUESS} by its name"
        if topic.offers.twist is None and topic.offers.noisy and not _has_word(topic, WANTED):
            if topic.poses.cov is None:
                why = f"{topic_text(topic)}; {GUESS} positions in the map, and sigma_m, as they have no covariance"
                return {"type": "fix", "sigma_m": POSE_M}, why
            return {"type": "fix"}, f"{topic_text(topic)}; {GUESS} positions in the map, with their covariance"
        return None

    def why_not(self, topic: TopicSummary) -> str:
        """Return the reason against a topic."""
        if topic.error:
            return topic.error
        if topic.offers.transforms is not None:
            return "frames: the mounts of sensors are taken from them"
        if topic.offers.camera is not None:
            return "the numbers of a camera"
        if topic.offers.image is not None:
            return IMAGES_ADVICE
        if topic.offers.pose is not None or topic.offers.twist is not None:
            return "if it is a truth or a fix, set its type"
        return "no type of message that kalmark reads"

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
            if jumped is not None or (other and bare) or self.found.named(entry.get("topic", name)).unset:
                out.entries[name] = entry | {"time": "recorded"}, why + since
        if late is not None and jumped is None:
            why = f"the times of {late.name} run back by {late.back_s:.3g} s: such messages are left out"
            out.log.append(f"  on_error: skip  # {GUESS} {why}")


def _parts(topic: TopicSummary) -> list[str]:
    return topic.name.strip("/").split("/")


def _moves(topic: TopicSummary) -> bool:
    return topic.offers.twist is not None or topic.offers.drive is not None


def _has_word(topic: TopicSummary, words: Sequence[str]) -> bool:
    return any(word in topic.name.lower() for word in words)


def _is_odometry(parent: str, child: str) -> bool:
    return "odom" in parent and any(base in child for base in BASES)


def _has_frames(topic: TopicSummary) -> bool:
    return topic.offers.transforms is not None and "static" not in topic.name
