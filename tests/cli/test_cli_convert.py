"""A log as MCAP and back to the last bit; a run as MCAP, read by another library."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import Kalmark, write_log
from kalmark.bags.mcap_writer import Types
from kalmark.bags.run_messages import export
from kalmark.config import build_slam, open_run
from kalmark.events import Control, Fix, Scan, sort_key
from kalmark.logs import Log, PositionTrack, Trajectory, open_log, write_native
from kalmark.results.record import record
from kalmark.results.run import Run
from ros_bags import same_logs

pytest.importorskip("rosbags", reason="rosbags is not installed: no bag can be written")
reader = pytest.importorskip("mcap.reader", reason="mcap is not installed: nothing else reads MCAP")


def there_and_back(log: Log, path: Path) -> Log:
    export(path, log)
    return open_log(path)


def counted(path: Path) -> Counter[str]:
    """Return how many messages each topic has, as the library mcap reads the file."""
    with path.open("rb") as stream:
        return Counter(channel.topic for _, channel, _ in reader.make_reader(stream).iter_messages())


def decoded(path: Path, topic: str) -> list[Any]:
    """Return the messages of a topic, found by the library mcap, with the definitions that the file brings."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    out = []
    with path.open("rb") as stream:
        for schema, _, message in reader.make_reader(stream).iter_messages(topics=[topic]):
            store = get_typestore(Stores.EMPTY)
            store.register(get_types_from_msg(schema.data.decode(), schema.name))
            out.append((message.log_time, store.deserialize_cdr(message.data, schema.name)))
    return out


def odd_log() -> Log:
    """Return a log with all that one can have: times before 0, ids of words, noise of its own, several sensors."""
    random = np.random.default_rng(3)
    events = [
        Control(t_ns=-5, robot="a b", u=[0.1, 1 / 3]),
        Scan(t_ns=-5, robot="a b", sensor="s/1", y=random.normal(size=(2, 2)), ids=[None, "word"]),
        Scan(t_ns=-5, robot="a b", sensor="t", y=random.normal(size=(3, 1))),
        Control(t_ns=0, robot="a b", u=random.normal(size=2), cov=np.diag([1e-300, 0.5])),
        Fix(t_ns=0, robot="a b", y=random.normal(size=2), cov=np.eye(2) / 3),
        Scan(t_ns=2**61, robot="a b", sensor="s/1"),
        Scan(t_ns=2**61 + 1, robot="a b", sensor="s/1", y=random.normal(size=(2, 2)), ids=[-7, 8],
             cov=[np.eye(2) / 7, np.eye(2) / 9]),
        Scan(t_ns=2**61 + 2, robot="a b", sensor="t", y=random.normal(size=(1, 1)), cov=[[[0.1]]]),
    ]  # fmt: skip
    return Log(
        name="odd", robots=("a b",), events=events,
        truth={"a b": Trajectory(np.array([-9, 0, 4]), random.normal(size=(3, 3)))},
        landmarks={"word": np.array([1 / 3, 2.0]), -7: np.array([0.1, 0.2])},
        gps={"a b": PositionTrack(np.array([0, 7]), random.normal(size=(2, 2)), np.array([0.1, 0.0]))},
        control_columns={"a b": ("v_mps", "w_radps")},
        sensor_columns={("a b", "s/1"): ("range_m", "bearing_rad"), ("a b", "t"): ("range_m",)},
        describes={"robots": {"a b": {"sensors": {"t": {"sigma_range_m": 1 / 3}}}}},
    )  # fmt: skip


def test_a_log_with_all_that_one_can_have_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    log = odd_log()
    back = there_and_back(log, tmp_path / "odd.mcap")
    assert same_logs(log, back) and back.name == "odd" and back.robots == ("a b",)
    assert back.gps["a b"].xy.tobytes() == log.gps["a b"].xy.tobytes()
    assert back.gps["a b"].antenna.tolist() == [0.1, 0.0]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("mrclam/MRCLAM_Dataset6", {"to_s": 30.0, "robots": [3]}),
        ("victoria_park", {"to_s": 30.0}),
        ("starry_night", {"to_s": 20.0}),
    ],
)
def test_real_logs_come_back_to_the_last_bit(name: str, options: dict[str, Any], data: Any, tmp_path: Path) -> None:
    log = open_log(data(name), **options)
    assert same_logs(log, there_and_back(log, tmp_path / "log.mcap"))


def test_a_log_comes_back_with_the_same_map(kalmark: Kalmark, tmp_path: Path) -> None:
    write_log(tmp_path / "native")
    assert kalmark("convert", "native", "there.mcap").status == 0
    assert kalmark("convert", "there.mcap", "back").status == 0
    for file in (tmp_path / "native").glob("*.csv"):
        assert (tmp_path / "back" / file.name).is_file()
    for log in ("native", "there.mcap", "back"):
        kind = f"log.format={'bag' if log == 'there.mcap' else 'native'}"
        assert kalmark("run", "native", "--log", log, "--set", kind, "--out", f"run_{log}").status == 0
    maps = {(tmp_path / f"run_{log}" / "landmarks.csv").read_bytes() for log in ("native", "there.mcap", "back")}
    assert len(maps) == 1
    assert kalmark("convert", "native", "there.mcap").status == 2


@pytest.mark.parametrize("options", [(), ("--parquet",)])
def test_increments_that_scans_cut_are_written_whole(
    options: tuple[str, ...], kalmark: Kalmark, tmp_path: Path
) -> None:
    events = [Control(0.5 * k, "cart", (0.2, 0.0, 0.1)) for k in range(1, 5)]
    seen = [Scan(0.3 * k, "cart", "eye", [[3.0, 1.0]], ids=[7]) for k in range(5)]
    columns = {
        "control_columns": {"cart": ("dx_m", "dy_m", "dtheta_rad")},
        "sensor_columns": {("cart", "eye"): ("x_m", "y_m")},
    }
    write_native(Log("cart", ("cart",), sorted([*events, *seen], key=sort_key), **columns), tmp_path / "log")
    robot = "{motion: {type: odometry_2d}, sensors: {eye: {type: position}}}"
    (tmp_path / "cart.yaml").write_text(f"log: {{path: log}}\nrobots: {{cart: {robot}}}\n")
    assert len(open_run(tmp_path / "cart.yaml")[1].events) > 9
    assert kalmark("convert", "cart.yaml", "out", *options).status == 0
    assert same_logs(open_log(tmp_path / "out"), open_log(tmp_path / "log"))


def test_another_library_reads_the_messages_of_a_run(kalmark: Kalmark, tmp_path: Path) -> None:
    write_log(tmp_path / "native")
    assert kalmark("run", "native", "--log", "native", "--out", "run").status == 0
    done = kalmark("convert", "run", "run.mcap")
    assert done.status == 0, done.err
    counts = counted(tmp_path / "run.mcap")
    log = open_log(tmp_path / "native")
    scans = sum(isinstance(event, Scan) for event in log.events)
    assert counts["/kalmark/scans"] == counts["/rover/odometry"] == counts["/tf"] == scans
    assert counts["/kalmark/controls"] == counts["/rover/velocity"] == len(log.events) - scans
    assert counts["/kalmark/landmarks"] == 3 and counts["/diagnostics"] == scans + 1 and counts["/rover/truth"] == 1
    run = record(*_built(tmp_path), progress=False)
    t_ns, last = decoded(tmp_path / "run.mcap", "/rover/odometry")[-1]
    pose, P = run.history.mean[-1], run.history.covariance[-1]
    assert t_ns == run.history.t_ns[-1] == last.header.stamp.sec * 10**9 + last.header.stamp.nanosec
    assert (last.pose.pose.position.x, last.pose.pose.position.y) == (pose[0], pose[1])
    np.testing.assert_array_equal(last.pose.covariance.reshape(6, 6)[np.ix_([0, 1, 5], [0, 1, 5])], P)
    (_, drawn) = decoded(tmp_path / "run.mcap", "/landmarks")[-1]
    ellipses = [m for m in drawn.markers if m.ns == "landmarks"]
    assert [m.text for m in drawn.markers if m.ns == "ids"] == ["1", "2", "3"]
    for marker, mean, cov in zip(ellipses, run.landmarks.means, run.landmarks.covariances, strict=True):
        assert (marker.pose.position.x, marker.pose.position.y) == tuple(mean)
        axes = 6 * np.sqrt(np.linalg.eigvalsh(cov))
        np.testing.assert_allclose([marker.scale.x, marker.scale.y], np.maximum(axes, 0.02), rtol=1e-9)
    (_, frames) = decoded(tmp_path / "run.mcap", "/tf_static")[0]
    assert [(t.header.frame_id, t.child_frame_id) for t in frames.transforms] == [("rover", "rover/lidar")]


def test_another_library_reads_frames_paths_and_diagnostics_of_a_run(kalmark: Kalmark, tmp_path: Path) -> None:
    write_log(tmp_path / "native")
    assert kalmark("run", "native", "--log", "native", "--out", "run").status == 0
    assert kalmark("convert", "run", "run.mcap").status == 0
    history = Run.load(tmp_path / "run").history
    told = [message for _, message in decoded(tmp_path / "run.mcap", "/diagnostics")]
    values = {pair.key: pair.value for pair in told[3].status[0].values}
    assert told[3].status[0].name == "kalmark/rover" and values["associated"] == "3"
    P = history.covariance[3]
    sigmas = [float(values[f"{name} sigma ({unit})"]) for name, unit in (("position", "m"), ("heading", "rad"))]
    np.testing.assert_allclose(sigmas, np.sqrt([np.linalg.eigvalsh(P[:2, :2])[-1], P[2, 2]]), rtol=1e-3)
    assert told[-1].status[0].name == "kalmark/run" and "landmarks" in {p.key for p in told[-1].status[0].values}
    frames = [message.transforms[0] for _, message in decoded(tmp_path / "run.mcap", "/tf")]
    assert {(frame.header.frame_id, frame.child_frame_id) for frame in frames} == {("map", "rover")}
    np.testing.assert_array_equal([frame.transform.translation.x for frame in frames], history.poses[:, 0])
    _, path = decoded(tmp_path / "run.mcap", "/rover/path")[-1]
    np.testing.assert_array_equal([each.pose.position.x for each in path.poses], history.poses[:, 0])


def test_a_run_without_scans_is_written_too(kalmark: Kalmark, tmp_path: Path) -> None:
    write_log(tmp_path / "native")
    (tmp_path / "native" / "scans.csv").unlink()
    assert kalmark("run", "native", "--log", "native", "--out", "run").status == 0
    assert kalmark("convert", "run", "run.mcap").status == 0
    counts = counted(tmp_path / "run.mcap")
    assert counts["/rover/odometry"] == counts["/tf"] == counts["/kalmark/controls"] == 20
    assert counts["/diagnostics"] == 21


def _built(tmp_path: Path) -> Any:
    config, log = open_run(tmp_path / "run" / "config.yaml")
    return build_slam(config, log), log


def test_messages_left_out_are_zero() -> None:
    made = Types().made("sensor_msgs/msg/LaserScan", {"ranges": [1.0, 2.0]})
    assert made.header.frame_id == "" and made.angle_min == 0 and made.ranges.tolist() == [1, 2]
