"""Readings of the own robot in a bag, of inertial units and compasses: of its sensors, or controls."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.bags.inertial_messages import GRAVITY, GYRO, HEADING, INCLINATION, heading_of, heading_of_field, means
from kalmark.bags.messages import Message, Reads
from kalmark.bags.topics import Compass, Imu, Sparse, Topic
from kalmark.errors import LogError
from kalmark.events import Control, Event, Scan, fixed_seconds
from kalmark.geometry import rotations
from kalmark.logs.log import Names, SensorKey
from kalmark.logs.table import Refused


class TopicMessage(NamedTuple):
    """One message at its time, by the name of the entry of the configuration that asks for it."""

    name: str
    topic: Topic
    offer: Message
    message: Any
    t_ns: int


@dataclass
class Gathered:
    """Result of messages: events, the columns of sensors (robot, name), and numbers of left-out ones by reason."""

    events: list[Event] = field(default_factory=list)
    sensor_columns: dict[SensorKey, Names] = field(default_factory=dict)
    left_out: Counter[tuple[str, str]] = field(default_factory=Counter)

    def is_next(self, m: TopicMessage, before_ns: int | None, what: str) -> bool:
        """Return whether a time follows the one before; one that is the same is counted.  Raises Refused."""
        if before_ns is None or m.t_ns > before_ns:
            return True
        if m.t_ns < before_ns:
            raise Refused(f"time after {fixed_seconds(before_ns)} s, expected times that never run backwards")
        self.left_out[m.name, f"{what} at the time of the one before"] += 1
        return False


class OwnReadings:
    """Takes the readings of a robot's own sensors.

    `level` is that of `Mounts`.
    """

    def __init__(self, out: Gathered, level: Mapping[str, tuple[Array, bool]], in_space: Callable[[str], bool]) -> None:
        self.out, self.level, self.in_space = out, level, in_space
        self.rates: dict[SensorKey, dict[int, Array]] = {}
        self.read_ns: dict[SensorKey, int] = {}

    def take(self, m: TopicMessage, topic: Sparse) -> None:
        """Take what an inertial unit or a compass measured of its robot, of what is sparse only now and then."""
        for sensor, columns, y in self.said(m, topic):
            key, often = (topic.robot, sensor), columns in GYRO.values()
            if often and isinstance(topic, Imu) and topic.at == "controls":
                self.rates.setdefault(key, {})[m.t_ns] = y
            elif often or key not in self.read_ns or m.t_ns - self.read_ns[key] >= topic.every_s * 1e9:
                self.reading(m, sensor, columns, y)

    def said(self, m: TopicMessage, topic: Sparse) -> Iterator[tuple[str, Names, Any]]:
        """Yield the readings of a message, in the plane made level: sensor, columns and numbers."""
        R = self.level.get(m.name, (np.eye(3), False))[0]
        if isinstance(topic, Compass) and (b := self.measured(m, "field", m.offer.field)) is not None:
            heading = heading_of_field(R @ b)
            if heading is None:
                self.out.left_out[m.name, "fields that are steep"] += 1
            else:
                yield topic.sensors(m.name)[0], HEADING, [heading]
        if not isinstance(topic, Imu):
            return
        if topic.gyro and (w := self.measured(m, "rates", m.offer.rates)) is not None:
            space = self.in_space(topic.robot)
            yield topic.gyro, GYRO[space], w if space else (R @ w)[2:]
        q = self.measured(m, "an orientation", m.offer.attitude) if topic.heading or topic.inclination else None
        if topic.heading and q is not None:
            yield topic.heading, HEADING, [heading_of(q, R)]
        if topic.inclination and q is not None:
            yield topic.inclination, INCLINATION, rotations.to_euler(np.ascontiguousarray(q))[0][:2]
        if topic.gravity and (a := self.measured(m, "accelerations", m.offer.force)) is not None:
            yield topic.gravity, GRAVITY, a

    def measured(self, m: TopicMessage, what: str, read: Reads) -> Array | None:
        """Return the measurement that is read from a message; without one count it and return None."""
        found = None if read is None else read(m.message)
        if found is None:
            self.out.left_out[m.name, f"messages without {what}"] += 1
            return None
        if not np.isfinite(found.v).all():
            raise Refused(f"{what} {found.v.tolist()}, expected finite numbers")
        return found.v

    def reading(self, m: TopicMessage, sensor: str, columns: Names, y: Any) -> None:
        """Take a reading of a sensor of the robot itself: one at a time."""
        robot, t_ns = m.topic.robot, m.t_ns
        if self.read_ns.get((robot, sensor)) == t_ns:
            self.out.left_out[m.name, f"readings of {sensor} at the time of the one before"] += 1
            return
        self.read_ns[robot, sensor] = t_ns
        self.out.sensor_columns.setdefault((robot, sensor), columns)
        self.out.events.append(Scan(t_ns=t_ns, robot=robot, sensor=sensor, y=[[*map(float, y)]]))

    def averaged(self, where: Any) -> None:
        """Add the means of rates from one control of the robot to the next.  Raises LogError if it has none."""
        for (robot, sensor), rates in self.rates.items():
            ends = sorted({e.t_ns for e in self.out.events if isinstance(e, Control) and e.robot == robot})
            if not ends:
                raise LogError(
                    f"{where}: {sensor} of {robot!r} has `at: controls`, expected controls of this robot, or `at: "
                    "messages`"
                )
            t_ns = np.array(sorted(rates))
            found = means(t_ns, np.array([rates[t] for t in t_ns.tolist()]), ends)
            self.out.sensor_columns[robot, sensor] = GYRO[self.in_space(robot)]
            self.out.events += [Scan(t_ns=t, robot=robot, sensor=sensor, y=w[None]) for t, w in found]

    def inertial(self, m: TopicMessage) -> None:
        """Take rates and specific forces, held from now on; times must increase."""
        robot, w = m.topic.robot, self.measured(m, "rates", m.offer.rates)
        a = self.measured(m, "accelerations", m.offer.force)
        if w is not None and a is not None and self.out.is_next(m, self.read_ns.get((robot, "")), "readings"):
            self.read_ns[robot, ""] = m.t_ns
            self.out.events.append(Control(t_ns=m.t_ns, robot=robot, u=np.concatenate([w, a])))
