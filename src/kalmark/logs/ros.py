"""Messages of ROS 1 bags, plain or compressed as .bz2, through the library rosbags."""

from __future__ import annotations

import bz2
import shutil
import tempfile
from pathlib import Path
from typing import Any

from kalmark.errors import LogError

SECOND_NS = 1_000_000_000


def find_bag(folder: Path, name: str) -> Path | None:
    """Return the bag NAME.bag or NAME.bag.bz2 in a folder; a small text file in its place is a link to another."""
    for path in (folder / f"{name}.bag.bz2", folder / f"{name}.bag"):
        if path.is_file() and (path.suffix == ".bz2" or path.read_bytes()[:9] == b"#ROSBAG V"):
            return path
    link = folder / f"{name}.bag"
    if link.is_file() and link.stat().st_size < 256:
        target = folder / link.read_text(encoding="utf-8", errors="replace").strip()
        if target.parent.resolve() != folder.resolve():
            return find_bag(target.parent, target.name.removesuffix(".bag"))
    return None


def messages(path: Path) -> list[tuple[str, Any]]:
    """Return (topic, message) of everything in a bag, as recorded.  Raises LogError if it cannot be read."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
    except ImportError:
        raise LogError(f"{path}: a bag needs the library rosbags, `pip install 'kalmark[rosbags]'`") from None
    with tempfile.TemporaryDirectory(prefix="kalmark-") as aside:
        bag = path
        if path.suffix == ".bz2":
            bag = Path(aside) / path.stem
            try:
                with bz2.open(path) as packed, bag.open("wb") as plain:
                    shutil.copyfileobj(packed, plain)
            except (OSError, EOFError) as error:
                raise LogError(f"{path}: cannot be unpacked ({error}), expected a whole bag") from None
        try:
            with AnyReader([bag]) as reader:
                return [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages()]
        except AnyReaderError as error:
            raise LogError(f"{path}: {error}, expected a whole bag") from None


def stamp(message: Any) -> int:
    """Return the time (ns) in a message's header."""
    return int(message.header.stamp.sec) * SECOND_NS + int(message.header.stamp.nanosec)


def components(position: Any, rotation: Any) -> list[float]:
    """Return x y z qx qy qz qw of a position and a quaternion."""
    return [position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w]
