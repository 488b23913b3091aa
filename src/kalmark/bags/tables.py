"""A whole log as messages of one bag, and back to the last bit: the tables of a native log as topics.

==========================  =========================================================================
`/kalmark/log`              std_msgs/String, JSON: name, robots, columns, what the log describes
`/kalmark/controls`         kalmark_msgs/Record, one a control
`/kalmark/scans`            kalmark_msgs/Record, one a scan, its rows one behind the other
`/kalmark/fixes`            kalmark_msgs/Record, one a fix
`/kalmark/truth`            kalmark_msgs/Record, one a true pose
`/kalmark/landmarks`        kalmark_msgs/Record, one a true landmark
`/kalmark/gps`              kalmark_msgs/Record, one a position that only scores; its antenna behind it
==========================  =========================================================================

Messages of ROS lose digits (a heading becomes a quaternion) and have no place for the noise of a scan: these carry the
numbers themselves.  `t_ns` is the time; the header's is for other readers.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from heapq import merge
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.bags.bag_opening import Bag, Received
from kalmark.bags.mcap_writer import RECORD, Outgoing, header_fields
from kalmark.errors import EventError, LogError
from kalmark.events import Control, Event, Fix, Raw, Scan, label_of_event, sort_key
from kalmark.logs.log import LandmarkPlaces, Log, PositionTrack, Trajectory
from kalmark.logs.native_writer import id_text, names_text
from kalmark.logs.source import Request, landmark_id, names_of_text
from kalmark.logs.table_columns import GPS as GPS_COLUMNS
from kalmark.logs.table_columns import POSE2, POSE3, POSITION

ROOT = "/kalmark/"
LOG = ROOT + "log"
CONTROLS, SCANS, FIXES, TRUTH, LANDMARKS, GPS = (
    ROOT + name for name in ("controls", "scans", "fixes", "truth", "landmarks", "gps")
)


def holds_log(bag: Bag) -> bool:
    """Return whether a bag has a log that kalmark wrote."""
    return LOG in bag.topics


# ------------------------------------------------------------------ to messages
def messages_of_log(log: Log) -> Iterator[Outgoing]:
    """Yield the messages that hold a log, in order of time."""
    begin = log.events[0].t_ns if log.events else 0
    about = {
        "name": log.name,
        "robots": list(log.robots),
        "control_columns": {robot: list(names) for robot, names in log.control_columns.items()},
        "sensor_columns": [[*key, list(names)] for key, names in log.sensor_columns.items()],
        "describes": log.describes,
    }
    yield Outgoing(LOG, "std_msgs/msg/String", begin, {"data": json.dumps(about, default=_plain)})
    for id_, place in log.landmarks.items():
        yield record_message(LANDMARKS, begin, "", values=place, ids=[id_text(id_)])
    streams = [
        (record_of_event(log, event) for event in log.events),
        *(pose_records(robot, path) for robot, path in log.truth.items()),
        *(fix_records(robot, track) for robot, track in log.gps.items()),
    ]
    yield from merge(*streams, key=lambda message: message.t_ns)


def _plain(value: Any) -> Any:
    """Return arrays, which JSON does not have, as lists of numbers."""
    return value.item() if isinstance(value, np.generic) else np.asarray(value).tolist()


def record_message(
    topic: str, t_ns: int, robot: str, values: Any, sensor: str = "", columns: Any = (), ids: Any = (), cov: Any = None,
    classes: Any = (), of: Any = (),
) -> Outgoing:  # fmt: skip
    """Return one kalmark_msgs/Record."""
    fields = {
        "header": header_fields(t_ns, robot),
        "t_ns": t_ns,
        "robot": robot,
        "sensor": sensor,
        "columns": list(columns),
    }
    fields |= {"ids": list(ids), "classes": list(classes), "of": list(of), "values": values}
    fields |= {"covariance": () if cov is None else cov}
    return Outgoing(topic, RECORD, t_ns, fields)


def record_of_event(log: Log, event: Event) -> Outgoing:
    """Return an event as a message.  Raises LogError for raw data."""
    if isinstance(event, Control):
        columns = log.control_columns.get(event.robot, ())
        return record_message(CONTROLS, event.t_ns, event.robot, event.u, columns=columns, cov=event.cov)
    if isinstance(event, Fix):
        columns = POSITION[: len(event.y)]
        return record_message(FIXES, event.t_ns, event.robot, event.y, columns=columns, cov=event.cov)
    if isinstance(event, Raw):
        raise LogError(f"{label_of_event(event)}: raw data, expected controls, scans and fixes")
    columns = log.sensor_columns.get((event.robot, event.sensor), ())
    ids = ["" if id_ is None else id_text(id_) for id_ in event.ids or ()]
    classes = [of or "" for of in event.classes or ()]
    of = [names_text(names) for names in event.of or ()]
    return record_message(SCANS, event.t_ns, event.robot, event.y, event.sensor, columns, ids, event.cov, classes, of)


def pose_records(robot: str, path: Trajectory) -> Iterator[Outgoing]:
    """Yield the true poses of one robot."""
    columns = POSE2 if path.poses.shape[1] == 3 else POSE3
    for t_ns, pose in zip(path.t_ns.tolist(), path.poses, strict=True):
        yield record_message(TRUTH, t_ns, robot, pose, columns=columns)


def fix_records(robot: str, track: PositionTrack) -> Iterator[Outgoing]:
    """Yield the positions of one robot that only score."""
    for t_ns, xy in zip(track.t_ns.tolist(), track.xy, strict=True):
        yield record_message(GPS, t_ns, robot, [*xy, *track.antenna], columns=GPS_COLUMNS)


# ------------------------------------------------------------------ and back
def read(bag: Bag, request: Request) -> Log:
    """Return the log that a bag of kalmark's holds.  Raises LogError."""
    events: list[Event] = []
    truth: dict[str, dict[int, Array]] = {}
    gps: dict[str, list[tuple[int, Array]]] = {}
    landmarks: LandmarkPlaces = {}
    about: dict[str, Any] = {}
    names = {LOG, CONTROLS, SCANS, FIXES, TRUTH, LANDMARKS, GPS}
    for received in bag.messages(names):
        topic, m = received.topic, received.message
        try:
            if topic == LOG:
                about = json.loads(m.data)
            elif topic == LANDMARKS:
                landmarks[landmark_id(m.ids[0])] = np.array(m.values)
            elif topic == TRUTH:
                truth.setdefault(m.robot, {})[int(m.t_ns)] = np.array(m.values)
            elif topic == GPS:
                gps.setdefault(m.robot, []).append((int(m.t_ns), np.array(m.values)))
            else:
                events.append(event_of_message(received))
        except (EventError, ValueError, IndexError, AttributeError) as error:
            request.refuse(f"{bag.path}: {topic} recorded at {received.recorded_ns} ns: {error}")
    try:
        return Log(
            name=about["name"], format="bag", path=bag.path, robots=tuple(about["robots"]),
            events=sorted(events, key=sort_key), skipped=request.skipped, landmarks=landmarks,
            truth={robot: Trajectory.of(p) for robot, p in truth.items()},
            gps={robot: PositionTrack.of(rows) for robot, rows in gps.items()},
            control_columns={robot: tuple(columns) for robot, columns in about["control_columns"].items()},
            sensor_columns={(robot, sensor): tuple(columns) for robot, sensor, columns in about["sensor_columns"]},
            describes=about["describes"],
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"{bag.path}: topic {LOG} is damaged ({error!r}), expected what kalmark wrote") from None


def event_of_message(received: Received) -> Event:
    """Return the event of a message.  Raises EventError, ValueError."""
    m, n = received.message, len(received.message.values)
    cov = np.array(m.covariance) if len(m.covariance) else None
    if received.topic == CONTROLS:
        return Control(t_ns=int(m.t_ns), robot=m.robot, u=m.values, cov=None if cov is None else cov.reshape(n, n))
    if received.topic == FIXES:
        return Fix(t_ns=int(m.t_ns), robot=m.robot, y=m.values, cov=None if cov is None else cov.reshape(n, n))
    size = len(m.columns)
    y = np.array(m.values).reshape(-1, size) if size and n else ()
    if cov is not None:
        cov = cov.reshape(size, size) if len(cov) == size * size and len(y) > 1 else cov.reshape(len(y), size, size)
    ids = [landmark_id(text) if text else None for text in m.ids] if len(m.ids) else None
    classes = [of or None for of in getattr(m, "classes", ())] or None  # an older file has none
    of = [names_of_text(text) for text in getattr(m, "of", ())] or None
    return Scan(t_ns=int(m.t_ns), robot=m.robot, sensor=m.sensor, y=y, ids=ids, cov=cov, classes=classes, of=of)
