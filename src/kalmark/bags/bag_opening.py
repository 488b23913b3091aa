"""Open a ROS bag without ROS: ROS 1 (`.bag`, also packed as `.bag.bz2`), ROS 2 (a folder, `.mcap` or `.db3`).

The library rosbags reads the files; here its many errors become one line each.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, Self

from kalmark.errors import LogError
from kalmark.events import short_text
from kalmark.files import unpack_file
from kalmark.logs.source import reason_of, spelling_hint
from kalmark.logs.table import Refused

ENDINGS = (".bag", ".bag.bz2", ".mcap", ".db3")
METADATA = "metadata.yaml"  # of a ROS 2 bag, which is a folder
EXPECTED = "expected a whole bag: .bag, .bag.bz2, .mcap, .db3 or the folder of a ROS 2 bag"
REINDEX, RECOVER = "`rosbag reindex FILE` of ROS 1 writes it", "`mcap recover FILE -o NEW.mcap` writes it"
CURES = {
    "Bag version": "an old version of bags, expected #ROSBAG V2.0: `rosbag fix OLD.bag NEW.bag` of ROS 1 writes one",
    "is not indexed": f"a bag without an index, as of a recording that broke off, expected one: {REINDEX}",
    "index looks damaged": f"the index of the bag is damaged, expected a whole one: {REINDEX}",
    "encryption": "an encrypted bag, expected a plain one: `rosbag decrypt FILE` of ROS 1 writes it",
    "File end magic is invalid": f"the file ends early and has no index, expected one: {RECOVER}",
    "Unindexed MCAP messages": f"messages out of order and without an index, expected one: {RECOVER}",
}
"""Messages of kalmark for bags that can be repaired, by the messages of rosbags."""
UNDEFINED = "which the bag does not define, expected its .msg file, or the text of it, in log.definitions"
SECOND_NS = 1_000_000_000


class Messages(NamedTuple):
    """Type, as ROS 2 writes it, and number of the messages of one topic."""

    type: str
    number: int


class Received(NamedTuple):
    """One message: where it came from, the time (ns) at which it was recorded, and what is in it."""

    topic: str
    type: str
    recorded_ns: int
    message: Any


def find_bag(path: Path) -> Path | None:
    """Return the bag at a path: the file, the folder of a ROS 2 bag, or the only bag in a folder."""
    if path.is_file():
        return path if path.name.endswith(ENDINGS) else None
    if not path.is_dir() or (path / METADATA).is_file():
        return path if path.is_dir() else None
    inside = [child for child in sorted(path.iterdir()) if child.is_file() and child.name.endswith(ENDINGS)]
    return inside[0] if len(inside) == 1 else None


class Bag:
    """An open bag: `topics` by name, and their messages.  To be used in a `with` statement; raises LogError."""

    def __init__(self, path: Path, definitions: Mapping[str, str] | None = None) -> None:
        self.path, self._given = path, definitions or {}
        self.topics: dict[str, Messages] = {}
        self._open = ExitStack()
        self._reader: Any = None

    def __enter__(self) -> Self:
        """Open the bag.  Raises LogError if it cannot be read."""
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise LogError(f"{self.path}: a bag needs the library rosbags, `pip install 'kalmark[rosbags]'`") from None
        with ExitStack() as stack:
            path = self._unpacked(stack)
            try:
                # older ROS 2 bags do not define their types: then those of ROS itself are taken
                reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
                self._reader = stack.enter_context(reader)
                connections = list(self._reader.connections)
            except Exception as error:  # rosbags has no common error for damaged files
                raise self._damaged(error) from None
            self._define()
            for each in connections:
                count = self.topics[each.topic].number if each.topic in self.topics else 0
                self.topics[each.topic] = Messages(each.msgtype, count + each.msgcount)
            self._open = stack.pop_all()
        return self

    @property
    def definitions(self) -> Mapping[str, Any]:
        """The fields of types of messages, as the bag or the caller defines them."""
        return self._reader.typestore.fielddefs

    def _define(self) -> None:
        """Add the definitions that the caller gives of types which the bag does not define.  Raises LogError."""
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        known = self._reader.typestore
        for kind, given in self._given.items():
            path = PurePosixPath(kind)
            name = str(path if path.parent.name == "msg" else path.parent / "msg" / path.name)
            try:
                text = Path(given).read_text(encoding="utf-8") if given.strip().endswith(".msg") else given
                if "/" not in kind:
                    raise ValueError("expected a name PACKAGE/TYPE")
                made = get_types_from_msg(text, name)
            except Exception as error:  # rosbags has no common error of texts that are no definitions
                what = f"expected a .msg file or its text ({reason_of(error, 120)})"
                raise LogError(f"log option definitions: {kind} is {short_text(given)}, {what}") from None
            known.register({each: fields for each, fields in made.items() if each not in known.fielddefs})
        if self._given:  # what these are made of
            usual = get_typestore(Stores.LATEST).fielddefs
            known.register({each: fields for each, fields in usual.items() if each not in known.fielddefs})

    def __exit__(self, *_: object) -> None:
        """Close the bag."""
        self._open.close()

    def _unpacked(self, stack: ExitStack) -> Path:
        """Return the path of the bag, unpacked into a folder for the time being if it is packed."""
        if self.path.suffix != ".bz2":
            return self.path
        bag = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="kalmark-"))) / self.path.stem
        with bag.open("wb") as plain:
            plain.writelines(unpack_file(self.path, LogError))
        return bag

    def _damaged(self, error: Exception) -> LogError:
        if cure := next((cure for said, cure in CURES.items() if said in str(error)), ""):
            return LogError(f"{self.path}: {cure}")
        return LogError(f"{self.path}: not a bag that can be read ({reason_of(error).rstrip('.')}), {EXPECTED}")

    def find(self, name: str) -> str:
        """Return a topic's name as the bag has it, with or without its first slash.  Raises LogError."""
        same = [topic for topic in self.topics if topic.lstrip("/") == name.lstrip("/")]
        if name in self.topics or same:
            return name if name in self.topics else same[0]
        known = ", ".join(sorted(self.topics)) or "one of a bag that is not empty"
        raise LogError(f"{self.path}: no topic {short_text(name)}, expected {known}{spelling_hint(name, self.topics)}")

    def times(self) -> Iterator[tuple[str, int]]:
        """Yield topic and time (ns) of all messages as recorded, without reading them.  Raises LogError."""
        for connection, recorded_ns, _ in self._raw(self._reader.connections):
            yield connection.topic, int(recorded_ns)

    def messages(self, topics: Collection[str]) -> Iterator[Received]:
        """Yield the messages of these topics in the order in which they were recorded.  Raises LogError."""
        for connection, recorded_ns, raw in self._raw([c for c in self._reader.connections if c.topic in topics]):
            try:
                message = self._reader.deserialize(raw, connection.msgtype)
            except Exception as error:
                if connection.msgtype not in self._reader.typestore.fielddefs:
                    raise LogError(
                        f"{self.path}: topic {connection.topic} has messages of the type {connection.msgtype}, "
                        f"{UNDEFINED}"
                    ) from None
                raise LogError(
                    f"{self.path}: the message of {connection.topic} recorded at {recorded_ns} ns is no "
                    f"{connection.msgtype} ({reason_of(error, 120)})"
                ) from None
            yield Received(connection.topic, connection.msgtype, int(recorded_ns), message)

    def _raw(self, connections: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield connection, time (ns) and bytes of the messages of some connections."""
        incoming = self._reader.messages(connections=connections) if connections else iter(())
        while True:
            try:
                received = next(incoming)
            except StopIteration:
                return
            except Exception as error:  # a file that ends too early, or is damaged in the middle
                raise self._damaged(error) from None
            yield received


def header_time(message: Any) -> int:
    """Return the time (ns) in a message's header."""
    return int(message.header.stamp.sec) * SECOND_NS + int(message.header.stamp.nanosec)


def has_header(message: Any) -> bool:
    """Return whether a message carries a time of its own."""
    return hasattr(getattr(getattr(message, "header", None), "stamp", None), "nanosec")


def frame_id(message: Any) -> str:
    """Return the frame of a message; of markers that of the first."""
    if has_header(message):
        return str(getattr(message.header, "frame_id", ""))
    markers = getattr(message, "markers", ())
    return str(markers[0].header.frame_id) if markers else ""


@contextmanager
def refuse_undeclared_fields() -> Iterator[None]:
    """Raise Refused where a field is read that the bag's definition of a message does not have."""
    try:
        yield
    except AttributeError as error:
        kind = getattr(error.obj, "__msgtype__", None)
        if kind is None:
            raise
        raise Refused(f"{kind}, as the bag defines it, has no field {error.name!r}, expected it to have one") from None
