"""The content of a bag: topics, types, rates, gaps and frames; the source of a first configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.bags.bag_opening import UNDEFINED, Bag, frame_id, has_header, header_time, refuse_undeclared_fields
from kalmark.bags.fields import landmark_fields, offers
from kalmark.bags.messages import MESSAGES, Measured, Message
from kalmark.bags.tables import holds_log
from kalmark.bags.tf_frames import Frames
from kalmark.bags.topics import Scans
from kalmark.geometry import rotations
from kalmark.logs.log import Names
from kalmark.logs.table import Refused

GAP = 5.0  # an interval longer than so many usual ones is a gap
FLAT_M, FLAT_RAD = 0.05, 0.05  # height and tilt of a path of the plane vary by less
STILL = 1e-3  # m, m/s, rad/s: what moves by less stands still


@dataclass
class Poses:
    """The poses that a topic or a pair of frames has; the covariance of the first, None if one is none in x and y."""

    t_ns: list[int] = field(default_factory=list)
    frames: list[Array] = field(default_factory=list)
    cov: Array | None = None

    def take(self, t_ns: int, pose: Measured) -> None:
        """Take one more pose, unless it is not later than the last; without a rotation it is not turned."""
        if not self.t_ns:
            self.cov = pose.cov
        if pose.cov is None or not positive(pose.cov[:2, :2]):
            self.cov = None
        if not self.t_ns or t_ns > self.t_ns[-1]:
            self.t_ns.append(t_ns)
            self.frames.append(np.where(np.isnan(pose.v), [0.0] * 6 + [1.0], pose.v))

    @property
    def flat(self) -> bool:
        """True if the path is one of the plane: of one height, and never tilted."""
        frames = np.array(self.frames)
        x, y = frames[:, 3], frames[:, 4]
        tilt = 2 * np.arcsin(np.minimum(np.hypot(x, y), 1.0))
        return bool(np.ptp(frames[:, 2]) < FLAT_M and tilt.max() < FLAT_RAD)

    @property
    def moves(self) -> bool:
        """True if the poses differ."""
        return bool(self.frames) and bool(np.ptp(np.array(self.frames), axis=0).max() > STILL)


@dataclass
class TopicSummary:
    """One topic: its messages, their median rate (Hz), the longest gap (s) and when it began (s), their frames.

    `gaps` counts the intervals of more than five usual ones.  `header` is true if its messages have a time of their
    own, which is `offset_s` behind that of the recorder in the first of them, and runs backwards by `back_s` at most;
    `unset`: that it has a place for one, and zeros in it.  `offers` is what can be read from its messages, by their
    type or by the fields `stated`, which their definition shows.  `turns` is true if a velocity in them is not 0.
    """

    name: str
    type: str
    count: int
    what: str = ""
    offers: Message = field(default_factory=lambda: Message(""))
    rate_hz: float = float("nan")
    gaps: int = 0
    longest_s: float = float("nan")
    longest_at_s: float = float("nan")
    frame: str = ""
    child: str = ""
    header: bool = False
    offset_s: float = 0.0
    back_s: float = 0.0
    error: str = ""
    poses: Poses = field(default_factory=Poses)
    columns: Names = ()
    fields: Names = ()
    stated: dict[str, str] = field(default_factory=dict)
    named: bool = False
    unset: bool = False
    turns: bool = False
    latest_ns: int = 0
    origin: Array | None = None
    camera: dict[str, Any] | None = None
    first: dict[str, Measured] = field(default_factory=dict)
    """Of an inertial unit or a compass the first rates, attitude, force and field."""
    each_second: dict[int, Array] = field(default_factory=dict)
    """Of an inertial unit the sums (8,) over each second of its force, its rates, their magnitude, and their number."""

    @property
    def frames(self) -> str:
        """Its frames in words."""
        return f"{self.child} in {self.frame}" if self.child else self.frame


@dataclass
class Survey:
    """Content of a bag; `start_s` is the time of its first message as recorded, `pairs` the poses of moving frames."""

    path: Path
    start_s: float
    length_s: float
    topics: list[TopicSummary]
    frames: Frames
    pairs: dict[tuple[str, str], Poses]
    holds_log: bool
    definitions: Mapping[str, str] = field(default_factory=dict)

    def named(self, name: str) -> TopicSummary:
        """Return the topic of a name."""
        return next(topic for topic in self.topics if topic.name == name)


def survey(path: Path, definitions: Mapping[str, str] | None = None) -> Survey:
    """Return the content of a bag; `definitions` are those of types that it does not define.  Raises LogError."""
    with Bag(path, definitions) as bag:
        summaries = {name: _summary(bag, name) for name in sorted(bag.topics)}
        begin, end = _rates(bag, summaries)
        frames, pairs = Frames(), dict[tuple[str, str], Poses]()
        known = {name for name, summary in summaries.items() if summary.what}
        for received in bag.messages(known):
            summary, m = summaries[received.topic], received.message
            own = has_header(m)
            t_ns = header_time(m) if own else received.recorded_ns
            if own and not summary.frame:
                summary.frame, summary.child = frame_id(m), getattr(m, "child_frame_id", "")
            if own and t_ns == 0:
                summary.unset, t_ns = not summary.header, received.recorded_ns
            elif own:
                if not summary.header:
                    summary.header, summary.offset_s = True, (received.recorded_ns - t_ns) * 1e-9
                summary.unset = False
                summary.back_s = max(summary.back_s, (summary.latest_ns - t_ns) * 1e-9)
                summary.latest_ns = max(summary.latest_ns, t_ns)
            try:
                with refuse_undeclared_fields():
                    _look(summary, m, t_ns)
                    transforms = summary.offers.transforms(m) if summary.offers.transforms is not None else []
                frames.take(transforms)
                for at, parent, child, frame in transforms:
                    pairs.setdefault((parent, child), Poses()).take(at, Measured(frame))
            except Refused as refused:
                summary.error = summary.error or str(refused)
        moving = {pair: poses for pair, poses in pairs.items() if pair in frames.moving}
        return Survey(
            path, begin, end - begin, [*summaries.values()], frames, moving, holds_log(bag), definitions or {}
        )


def _summary(bag: Bag, name: str) -> TopicSummary:
    kind, count = bag.topics[name]
    known = offers(kind, bag.definitions) or Message("")
    if kind not in bag.definitions:
        return TopicSummary(name, kind, count, error=f"of a type {UNDEFINED}")
    stated = {} if kind in MESSAGES else landmark_fields(kind, bag.definitions)
    return TopicSummary(name, kind, count, known.what, known, stated=stated)


def _rates(bag: Bag, summaries: dict[str, TopicSummary]) -> tuple[float, float]:
    """Note the rates and gaps of all topics, by the recorder's clock; return when the bag begins and ends (s)."""
    times: dict[str, list[int]] = {}
    for name, recorded_ns in bag.times():
        times.setdefault(name, []).append(recorded_ns)
    if not times:
        return 0.0, 0.0
    begin = min(min(each) for each in times.values())
    for name, each in times.items():
        summary, steps = summaries[name], np.diff(np.sort(each)) * 1e-9
        summary.count = len(each)
        if len(steps):
            usual, worst = float(np.median(steps)), int(np.argmax(steps))
            summary.rate_hz = 1 / usual if usual > 0 else float("nan")
            summary.gaps = int((steps > GAP * usual).sum()) if usual > 0 else 0
            summary.longest_s, summary.longest_at_s = float(steps[worst]), (sorted(each)[worst] - begin) * 1e-9
    return begin * 1e-9, max(max(each) for each in times.values()) * 1e-9


def _look(summary: TopicSummary, m: Any, t_ns: int) -> None:
    """Note of a message what a first configuration needs."""
    offers = summary.offers
    if offers.pose is not None:
        summary.poses.take(t_ns, offers.pose(m))
    if offers.twist is not None and not summary.turns:
        summary.turns = bool(np.abs(offers.twist(m).v).max() > STILL)
    if offers.globe is not None:
        place = offers.globe(m)
        if place is not None and np.isfinite(place.v[:2]).all():
            lla = np.where(np.isfinite(place.v), place.v, 0.0)
            summary.origin = lla if summary.origin is None else summary.origin
            cov = None if place.cov is None else np.pad(place.cov, (0, 3))
            summary.poses.take(t_ns, Measured(np.append(lla, [0.0, 0, 0, 1]), cov))
    if offers.camera is not None and summary.camera is None:
        summary.camera = offers.camera(m)
    for name in ("rates", "attitude", "force", "field"):
        read = getattr(offers, name)
        told = None if read is None or name in summary.first else read(m)
        if told is not None and np.isfinite(told.v).all():
            summary.first[name] = told
    force, rates = (None if read is None else read(m) for read in (offers.force, offers.rates))
    if force is not None and rates is not None:
        row = np.array([*force.v, *rates.v, np.linalg.norm(rates.v), 1.0])
        summary.each_second[t_ns // 10**9] = summary.each_second.get(t_ns // 10**9, np.zeros(8)) + row
    if hasattr(m, "fields"):
        summary.fields = tuple(each.name for each in m.fields)
    elif offers.seen is not None and not (summary.columns and summary.named):
        seen = offers.seen(m, Scans(size_m=1.0))
        summary.columns = summary.columns or seen.columns
        summary.named = summary.named or any(id_ is not None for id_ in seen.ids)
    summary.frame = summary.frame or frame_id(m)


def positive(cov: Array) -> bool:
    """Return whether a covariance (n, n) is positive definite."""
    return bool(np.isfinite(cov).all() and np.linalg.eigvalsh(cov)[0] > 0)


def yaw(frame: Array) -> float:
    """Return the heading (rad) of a frame (7,)."""
    return float(rotations.to_euler(np.array(frame[3:]))[0][2])
