"""The readings of inertial units and compasses in a first configuration, with their noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.bags.configured_topics import sensor_name
from kalmark.bags.first_sensors import mount_of
from kalmark.bags.first_start import EstimatedStart
from kalmark.bags.first_text import GUESS, Entry, topic_text, yaml_mapping, yaml_text
from kalmark.bags.inertial_messages import heading_of, heading_of_field
from kalmark.bags.messages import Measured
from kalmark.bags.survey import Survey, TopicSummary
from kalmark.bags.tf_mounts import LEVEL
from kalmark.bags.topics import Scans
from kalmark.geometry import rotations
from kalmark.geometry.named_poses import describe_pose
from kalmark.logs.log import Section

HEADING_S, HEADING_RAD = 1.0, 0.02
"""Headings are taken so often, and with a larger sigma: errors of a compass are correlated."""
NORTH_RAD, START_RAD, FIELD_RAD = 0.2, 0.1, 0.1
"""Sigmas: of where north is, of a declination by the first heading, of a heading by a magnetic field."""
STANDARD_GRAVITY, NOT_GRAVITY = 9.80665, 0.2  # m/s^2; a mean force farther off by this share is something else
GYRO_RADPS, BIAS = 0.005, {"sigma_bias_radps": 0.01, "sigma_bias_radps_per_sqrt_s": 0.0001}


def up_direction(topic: TopicSummary) -> Array | None:
    """Return the direction up (3,) in the frame of an inertial unit: that of its mean force where it turned least.

    By the quarter of the seconds of least rates: a robot that rests or goes straight on, whose mean acceleration is
    gravity's.  None if the mean is not of gravity's size.
    """
    sums = np.array([row for row in topic.each_second.values() if np.isfinite(row).all()]).reshape(-1, 8)
    if not len(sums):
        return None
    slow = sums[np.argsort(sums[:, 6] / sums[:, 7], kind="stable")[: max(1, len(sums) // 4)]]
    mean = slow[:, :3].sum(axis=0) / slow[:, 7].sum()
    size = float(np.linalg.norm(mean))
    return mean / size if abs(size / STANDARD_GRAVITY - 1) < NOT_GRAVITY else None


class Readings:
    """Decides which readings of inertial units and compasses are taken, for one robot, and how good they may be."""

    def __init__(
        self, found: Survey, control: Any, kind: str, space: bool, start: EstimatedStart | None, ahead: float
    ) -> None:
        self.found, self.control, self.kind, self.begin, self.ahead = found, control, kind, start, ahead
        self.space = space
        self.sensors: list[str] = []
        self.taken: set[str] = set()
        self.heading: float | None = None  # the first that was measured, and taken
        self.tilted: dict[str, Array] = {}  # mounts by frame that gravity shows, of units that are not level

    def entries(self, topics: Sequence[TopicSummary]) -> dict[str, Entry]:
        """Return the entries of the topics that are used, each with the reason."""
        used = {}
        for topic in sorted(topics, key=lambda each: each.offers.rates is None):  # compasses last
            if {"rates", "attitude"} & topic.first.keys() and (entry := self.unit(topic)) is not None:
                used[topic.name] = (entry | self.tilt(topic), topic_text(topic))
            elif "field" in topic.first and not self.space and self.heading is None:
                used[topic.name] = (self.compass(topic) | self.tilt(topic), topic_text(topic))
        return used

    def mount(self, topic: TopicSummary) -> Array | None:
        """Return the mount (7,) of a unit: by tf, or its rotation by gravity; None if neither has it."""
        known = mount_of(self.found, topic, self.control)
        if known is not None or topic.frame in self.tilted:
            return known if known is not None else self.tilted[topic.frame]
        up = up_direction(topic)
        if up is None or up[2] > LEVEL:
            return None
        turn, _ = rotations.from_euler(np.array([math.atan2(up[1], up[2]), math.asin(-up[0]), 0.0]))
        self.tilted[topic.frame] = np.append(np.zeros(3), turn)
        return self.tilted[topic.frame]

    def tilt(self, topic: TopicSummary) -> Section:
        """Return the comment of an entry on a mount by gravity."""
        if mount_of(self.found, topic, self.control) is not None or (mount := self.mount(topic)) is None:
            return {}
        turned = describe_pose(mount)
        return {"mount": {key: round(turned[key], 2) for key in ("roll_deg", "pitch_deg")}}

    def unused(self, topic: TopicSummary) -> str:
        """Return why a topic of an inertial unit or a compass is not used, "" if it is no such."""
        if topic.offers.rates is not None:
            return topic.error or "no rates, and no covariance of its orientation"
        if topic.offers.field is not None:
            return "headings by a magnetic field are for the plane, and for robots without another heading"
        return ""

    def unit(self, topic: TopicSummary) -> Section | None:
        """Return the entry of an inertial unit, None if nothing of it is taken; note its sensors."""
        entry: Section = {"type": "imu"}
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

    def gyro(self, topic: TopicSummary, rates: Measured) -> Section:
        """Return the comment of an entry on the rates; record their sensor."""
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

    def compass(self, topic: TopicSummary) -> Section:
        """Return the entry of a magnetic field; note its sensor."""
        name = self.named("compass", topic)
        self.compass_line(name, topic, topic.first["field"].v, FIELD_RAD)
        return {"type": "compass", "sensor": name, "every_s": HEADING_S}

    def compass_line(self, name: str, topic: TopicSummary, v: Array, sigma: float) -> None:
        """Note a sensor of headings, its declination such that its first heading is that of the start."""
        mount = self.mount(topic)
        R = np.eye(3) if mount is None else rotations.matrix(np.array(mount[3:]))
        heading = heading_of(v, np.eye(3) if self.space else R) if len(v) == 4 else heading_of_field(R @ v)
        self.heading = heading if self.heading is None else self.heading
        section: Section = {"type": "heading", "sigma_heading_rad": sigma}
        if self.begin is not None and self.begin.north:
            section |= {"declination_rad": 0.0, "sigma_declination_rad": NORTH_RAD}
            self.line(name, section, topic, f"{GUESS} its north is true north, or nearly")
            return
        ahead = heading_of(np.array([0.0, 0, 0, 1]), R.T) if self.space else 0.0  # of the sensor, at the start
        off = 0.0 if heading is None else math.remainder(self.ahead + ahead - heading, 2 * math.pi)
        section |= {"declination_rad": off, "sigma_declination_rad": START_RAD}
        self.line(name, section, topic, f"{GUESS} its first heading is that of the start")

    def start(self) -> str:
        """Return the line of the robot's start; without another source, the heading is that of the compass."""
        begin = self.begin
        assert begin is not None
        at, sigmas, why = begin.at, begin.sigmas, begin.why
        if not begin.known and self.heading is not None:
            at, sigmas = [*at[:2], self.heading], [sigmas[0], NORTH_RAD]
            why = f"{GUESS} its heading is that of its compass"
        keys = ("x_m", "y_m", "theta_rad", "sigma_xy_m", "sigma_theta_rad")
        return f"start: {yaml_mapping(dict(zip(keys, [*at, *sigmas], strict=True)))}  # {why}"

    def named(self, name: str, topic: TopicSummary) -> str:
        """Return the name of a sensor, with that of its topic if another has it."""
        name = f"{sensor_name(topic.name, Scans())}_{name}" if name in self.taken else name
        self.taken.add(name)
        return name

    def line(self, name: str, section: Section, topic: TopicSummary, why: str) -> None:
        """Note the line of a sensor; a mount that tf does not have is to be given where it counts."""
        if mount_of(self.found, topic, self.control) is not None:
            why = f"{why}; its mount is that of tf"
        elif self.mount(topic) is not None:
            why = f"{why}; {GUESS} its yaw in the robot, its roll and pitch are by gravity"
        else:
            why = f"{why}; {GUESS} its axes are those of the robot"
        self.sensors.append(f"{yaml_text(name)}: {yaml_mapping(section)}  # {why}")
