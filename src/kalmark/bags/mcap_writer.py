"""Write messages of ROS 2 with the definitions of their types into one MCAP file: for Foxglove, RViz, `ros2 bag`."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from kalmark.bags.bag_opening import SECOND_NS
from kalmark.errors import LogError

RECORD = "kalmark_msgs/msg/Record"
RECORD_FIELDS = """\
std_msgs/Header header
int64 t_ns
string robot
string sensor
string[] columns
string[] ids
string[] classes
string[] of
float64[] values
float64[] covariance
"""
LATEST_S = 2**31 - 1  # a header's seconds are int32

MessageFields = dict[str, Any]  # of a message, by name


class Outgoing(NamedTuple):
    """One message to write: its topic, its type, the time (ns) under which it is recorded, and its fields."""

    topic: str
    type: str
    t_ns: int
    fields: MessageFields


class Types:
    """The types of messages, made from nested dictionaries of their fields; what is left out is 0 or empty."""

    def __init__(self, store: Any = None) -> None:
        try:
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError:
            raise LogError("an MCAP file needs the library rosbags, `pip install 'kalmark[rosbags]'`") from None
        self.store: Any = get_typestore(Stores.ROS2_HUMBLE) if store is None else store
        self.store.register(get_types_from_msg(RECORD_FIELDS, RECORD))

    def made(self, kind: str, fields: MessageFields) -> Any:
        """Return a message of a type."""
        _, described = self.store.fielddefs[kind]
        return self.store.types[kind](**{name: self._value(one, fields.get(name)) for name, one in described})

    def _value(self, description: Any, value: Any) -> Any:
        import numpy as np

        node, detail = description
        match node.name:
            case "BASE":
                if value is None:
                    return "" if detail[0] == "string" else detail[0] == "bool" and False
                return value
            case "NAME":
                return value if value is not None and not isinstance(value, dict) else self.made(detail, value or {})
        (inner, kind), size = detail[0], detail[1]
        if inner.name == "BASE" and kind[0] != "string":
            numbers = np.zeros(size if node.name == "ARRAY" else 0) if value is None else np.asarray(value)
            return np.ascontiguousarray(numbers.reshape(-1), dtype=np.dtype(kind[0].replace("byte", "uint8")))
        return [self._value(detail[0], each) for each in value or ()]


def header_fields(t_ns: int, frame: str = "") -> MessageFields:
    """Return the fields of a std_msgs/Header; a time that it cannot hold is the nearest that it can."""
    return {"stamp": time_fields(t_ns), "frame_id": frame}


def time_fields(t_ns: int) -> dict[str, int]:
    """Return the fields of a builtin_interfaces/Time."""
    sec, nanosec = divmod(t_ns, SECOND_NS)
    return {"sec": max(-LATEST_S - 1, min(sec, LATEST_S)), "nanosec": nanosec}


def write_mcap(path: Path, messages: Iterable[Outgoing]) -> dict[str, int]:
    """Write messages into one MCAP file, which is written completely or not; return their number by topic.

    They should come in order of time.  A time before 0, which a recorder cannot have, is recorded as 0.
    """
    types = Types()  # refuses where the library is missing
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    path.parent.mkdir(parents=True, exist_ok=True)
    counts: dict[str, int] = {}
    with tempfile.TemporaryDirectory(prefix=".kalmark-", dir=path.parent) as aside:
        folder = Path(aside) / path.stem
        writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            open_topics: dict[str, Any] = {}
            for topic, kind, t_ns, fields in messages:
                if topic not in open_topics:
                    open_topics[topic] = writer.add_connection(topic, kind, typestore=types.store)
                raw = types.store.serialize_cdr(types.made(kind, fields), kind)
                writer.write(open_topics[topic], max(t_ns, 0), raw)
                counts[topic] = counts.get(topic, 0) + 1
        (folder / f"{folder.name}.mcap").replace(path)
    return counts
