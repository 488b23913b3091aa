"""Bags: files that are cut, damaged, packed or split, and messages that are bad."""

from __future__ import annotations

import sqlite3
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from kalmark.errors import KalmarkError, LogError
from kalmark.events import Event
from kalmark.logs import open_log

pytest.importorskip("rosbags", reason="rosbags is not installed: no bag can be read")

from ros_bags import (
    KINDS,
    T0,
    TOPICS,
    Outgoing,
    bag_of,
    header_fields,
    odometry,
    pose,
    robot_among_posts,
    same,
    twist,
    write_bag,
)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the bags of the first seconds of the robot among posts, by kind."""
    folder, messages = tmp_path_factory.mktemp("bags"), robot_among_posts()[:600]
    return {kind: write_bag(folder, kind, messages) for kind in KINDS}


@cache
def events_of(path: Path) -> list[Event]:
    """Return the events of a bag, which is read once."""
    return list(open_log(path, topics=TOPICS).events)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_a_cut_bag_gets_one_line(kind: str, share: float, bags: dict[str, Path], tmp_path: Path) -> None:
    source = bags[kind] if bags[kind].is_file() else next(bags[kind].glob("*.[dm][bc]*"))
    cut = tmp_path / source.name
    content = source.read_bytes()
    cut.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(LogError, match=r"not a bag that can be read|no message|no topic|index") as error:
        open_log(cut, topics=TOPICS)
    assert "\n" not in str(error.value) and str(cut) in str(error.value)


def test_damaged_bags_get_one_line(bags: dict[str, Path], tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    for kind in KINDS:
        source = bags[kind] if bags[kind].is_file() else next(bags[kind].glob("*.[dm][bc]*"))
        content = np.frombuffer(source.read_bytes(), np.uint8)
        for n in range(12):
            odd = content.copy()
            odd[random.integers(0, len(odd), 1 + 40 * n)] = random.integers(0, 256, 1 + 40 * n)
            (tmp_path / source.name).write_bytes(odd.tobytes())
            try:
                open_log(tmp_path / source.name, topics=TOPICS, on_error="skip")
            except KalmarkError as error:
                assert "\n" not in str(error)


def field_at(content: bytes, name: bytes) -> int:
    return content.index(name + b"=") + len(name) + 1


def test_bags_that_can_be_mended_say_how(tmp_path: Path) -> None:
    whole = bag_of(tmp_path, [odometry(T0 + k, pose(k, 0, 0)) for k in range(3)], "ros1.bag").read_bytes()
    index, connections = field_at(whole, b"index_pos"), field_at(whole, b"conn_count")
    for said, content in {
        "an old version .*expected #ROSBAG V2.0: `rosbag fix": whole.replace(b"V2.0", b"V1.2", 1),
        "without an index, .*`rosbag reindex": whole[:index] + bytes(8) + whole[index + 8 :],
        "index of the bag is damaged, .*`rosbag reindex": whole[:connections] + bytes(4) + whole[connections + 4 :],
    }.items():
        (tmp_path / "odd.bag").write_bytes(content)
        with pytest.raises(LogError, match=said) as error:
            open_log(tmp_path / "odd.bag", topics=TOPICS)
        assert "\n" not in str(error.value)


def test_two_clocks_get_one_line(tmp_path: Path) -> None:
    messages = [odometry(10**9 * (1 + k), pose(0, 0, 0))._replace(t_ns=T0 + k) for k in range(2)]
    messages.append(Outgoing("/cmd_vel", "geometry_msgs/msg/Twist", T0, twist(1.0, 0.0)))
    path = bag_of(tmp_path, messages)
    topics = {"/odom": {"type": "truth", "robot": "b"}, "/cmd_vel": {"type": "unicycle"}}
    with pytest.raises(LogError, match="by its headers, /cmd_vel at 1700000000 s as recorded"):
        open_log(path, topics=topics)
    topics["/odom"]["time"] = "recorded"
    assert open_log(path, topics=topics).events[0].t_ns == T0


def test_bad_messages_are_refused_or_left_out(tmp_path: Path) -> None:
    messages = [odometry(T0 + k, pose(0, 0, 0)) for k in (0, 10, 20)]
    messages += [
        odometry(T0 + 15, pose(0, 0, 0)),
        odometry(T0 + 30, pose(np.nan, 0, 0)),
        odometry(T0 + 40, pose(1, 0, 0)),
    ]
    messages += [odometry(T0 + 50, {"position": {}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 0}})]
    messages = [message._replace(t_ns=T0 + 100 + n) for n, message in enumerate(messages)]
    path, topics = bag_of(tmp_path, messages), {"/odom": TOPICS["/odom"]}
    with pytest.raises(LogError, match=r"/odom at t=1700000000.000000015 s: time after 1700000000.000000020 s"):
        open_log(path, topics=topics)
    log = open_log(path, topics=topics, on_error="skip")
    assert len(log.events) == 3 and len(log.skipped) == 3
    assert "quaternion has length 0" in log.skipped[2] and "finite" in log.skipped[1]


def test_a_type_that_the_bag_does_not_define_gets_one_line(tmp_path: Path) -> None:
    """As older ROS 2 bags in sqlite3 are: without definitions, of which ROS's own are known."""
    header = header_fields(T0, "camera")
    path = bag_of(tmp_path, [Outgoing("/tags", "aruco_msgs/msg/MarkerArray", T0, {"header": header}),
                             odometry(T0, pose(0, 0, 0)), odometry(T0 + 9, pose(1, 0, 0))], "sqlite3")  # fmt: skip
    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        database.execute("delete from message_definitions")
    assert open_log(path, topics={"/odom": TOPICS["/odom"]}).events[0].u.tolist() == [1, 0, 0]
    with pytest.raises(LogError, match="/tags has messages of the type aruco_msgs/msg/MarkerArray, which the"):
        open_log(path, topics={"/tags": {"type": "scan"}})


# ------------------------------------------------------------------ packed and split
@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_a_ros_1_bag_with_packed_chunks_is_the_same_log(
    compression: str, bags: dict[str, Path], tmp_path: Path
) -> None:
    from rosbags.rosbag1 import Reader, Writer

    path = tmp_path / "packed.bag"
    writer = Writer(path)
    writer.set_compression(Writer.CompressionFormat[compression])
    with Reader(bags["ros1.bag"]) as reader, writer:
        kept = {c.id: writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, md5sum=c.digest)
                for c in reader.connections}  # fmt: skip
        for connection, t_ns, raw in reader.messages():
            writer.write(kept[connection.id], t_ns, raw)
    assert path.stat().st_size < 0.9 * bags["ros1.bag"].stat().st_size
    assert all(map(same, events_of(path), events_of(bags["ros1.bag"])))


def copied(source: Path, out: Path, mode: str, first: int = 0, last: int | None = None) -> Path:
    """Copy the messages of a ROS 2 bag from one number to another, packed by file or by message, or not."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer

    plugin = StoragePlugin.MCAP if source.name == "mcap" else StoragePlugin.SQLITE3
    writer = Writer(out, version=9, storage_plugin=plugin)
    if mode != "NONE":
        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with Reader(source) as reader, writer:
        kept = {c.id: writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, rihs01=c.digest)
                for c in reader.connections}  # fmt: skip
        for connection, t_ns, raw in list(reader.messages())[first:last]:
            writer.write(kept[connection.id], t_ns, raw)
    return out


PACKED = [("sqlite3", "FILE"), ("sqlite3", "MESSAGE"), ("mcap", "FILE"), ("mcap", "MESSAGE"), ("mcap", "STORAGE")]


@pytest.mark.parametrize(("kind", "mode"), PACKED)
def test_a_packed_ros_2_bag_is_the_same_log(kind: str, mode: str, bags: dict[str, Path], tmp_path: Path) -> None:
    path = copied(bags[kind], tmp_path / "packed", mode)
    assert all(map(same, events_of(path), events_of(bags[kind]))) and len(events_of(path))


@pytest.mark.parametrize("packed", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("chunks", [True, False])
def test_mcap_of_its_own_library_with_packed_chunks_or_none_is_the_same_log(
    packed: str, chunks: bool, bags: dict[str, Path], tmp_path: Path
) -> None:
    reader, writer = pytest.importorskip("mcap.reader"), pytest.importorskip("mcap.writer")
    path = tmp_path / "packed.mcap"
    (source,) = bags["mcap"].glob("*.mcap")
    with source.open("rb") as file, path.open("wb") as out:
        kept: dict[int, int] = {}
        to = writer.Writer(out, 4096, writer.CompressionType[packed], use_chunking=chunks)
        to.start("ros2", "a library")
        for schema, channel, message in reader.make_reader(file).iter_messages(log_time_order=False):
            if channel.id not in kept:
                number = to.register_schema(schema.name, schema.encoding, schema.data)
                kept[channel.id] = to.register_channel(channel.topic, channel.message_encoding, number)
            to.add_message(kept[channel.id], message.log_time, message.data, message.publish_time)
        to.finish()
    assert all(map(same, events_of(path), events_of(bags["mcap"]))) and len(events_of(path))


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_a_ros_2_bag_split_into_files_is_the_same_log(kind: str, bags: dict[str, Path], tmp_path: Path) -> None:
    """As `ros2 bag record` splits: several files, one metadata.yaml that lists them."""
    halves = [
        copied(bags[kind], tmp_path / f"half{k}", "NONE", *part) for k, part in enumerate(((0, 300), (300, None)))
    ]
    whole = tmp_path / "split"
    whole.mkdir()
    yaml, names = YAML(), []
    for half in halves:
        (file,) = (path for path in half.iterdir() if path.suffix in (".db3", ".mcap"))
        (whole / file.name).write_bytes(file.read_bytes())
        names.append(file.name)
    metadata = yaml.load(halves[0] / "metadata.yaml")
    metadata["rosbag2_bagfile_information"]["relative_file_paths"] = names
    yaml.dump(metadata, whole / "metadata.yaml")
    assert all(map(same, events_of(whole), events_of(bags[kind]))) and len(events_of(whole)) == len(
        events_of(bags[kind])
    )
