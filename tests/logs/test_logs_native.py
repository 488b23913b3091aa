"""Native logs: what is written is read back exactly, and every bad row is named by file and line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalmark.errors import LogError
from kalmark.events import Control, Event, Fix, Scan, fixed_seconds, sort_events, sort_key
from kalmark.logs import Log, PositionTrack, Trajectory, open_log, write_native
from kalmark.logs.source import nanoseconds_of_text
from native_logs import GOOD, HEAD, native


def same(a: np.ndarray | None, b: np.ndarray | None, shape: tuple[int, ...]) -> bool:
    if a is None or b is None:
        return a is b
    return np.array_equal(np.broadcast_to(a, shape), np.broadcast_to(b, shape))


def equal(a: Event, b: Event) -> bool:
    if type(a) is not type(b) or (a.t_ns, a.robot) != (b.t_ns, b.robot):
        return False
    if isinstance(a, Scan):
        assert isinstance(b, Scan)
        count, size = a.y.shape
        ids = a.ids or (None,) * count
        return (
            (a.sensor, ids) == (b.sensor, b.ids)
            and np.array_equal(a.y, b.y)
            and same(a.cov, b.cov, (count, size, size))
        )
    if isinstance(a, Fix):
        return np.array_equal(a.y, b.y) and np.array_equal(a.cov, b.cov)
    return np.array_equal(a.u, b.u) and same(a.cov, b.cov, (len(a.u),) * 2)


def rich_log() -> Log:
    third = 1 / 3
    events: list[Event] = [
        Control(t_ns=1_600_000_000_123_456_789, robot="rover", u=(third, -1e-300)),
        Control(t_ns=1_600_000_000_123_456_790, robot="rover", u=(0.1, 0.2), cov=[[0.1, 0.01], [0.01, third]]),
        Control(t_ns=-5, robot="cart, blue", u=(1e-17, 2.0, np.pi)),
        Scan(t_ns=7, robot="rover", sensor="lidar", y=[[4.2, third], [5.0, 0.1]], ids=["tree", None]),
        Scan(t_ns=7, robot="rover", sensor="ranger", y=[[2.0]], ids=[3], cov=[[third]]),
        Scan(t_ns=8, robot="rover", sensor="lidar", y=[[1.0, 2.0], [3.0, 4.0]], cov=[[0.1, 0.02], [0.02, 0.3]]),
        Scan(t_ns=8, robot="cart, blue", sensor="eye", y=[[1.5, -2.5]], ids=[-4]),
        Fix(t_ns=9, robot="rover", y=(1.0, third), cov=[[2.0, 0.1], [0.1, third]]),
    ]
    times = np.array([1, 2, 1_600_000_000_000_000_001])
    return Log(
        name="rich",
        robots=("cart, blue", "rover"),
        events=sorted(events, key=sort_key),
        truth={"rover": Trajectory(times, np.arange(9.0).reshape(3, 3) / 7)},
        landmarks={"tree": np.array([third, 2.0]), 3: np.array([-1e-9, 4.0])},
        gps={"rover": PositionTrack(times, np.arange(6.0).reshape(3, 2) / 7, np.array([3.78, 0.5]))},
        control_columns={"rover": ("v_mps", "w_radps"), "cart, blue": ("dx_m", "dy_m", "dtheta_rad")},
        sensor_columns={
            ("rover", "lidar"): ("range_m", "bearing_rad"),
            ("rover", "ranger"): ("range_m",),
            ("cart, blue", "eye"): ("x_m", "y_m"),
        },
    )


def assert_same_log(a: Log, b: Log) -> None:
    assert len(a) == len(b) and all(equal(x, y) for x, y in zip(a, b, strict=True))
    assert a.truth.keys() == b.truth.keys() and a.gps.keys() == b.gps.keys()
    for robot, path in a.truth.items():
        assert np.array_equal(path.t_ns, b.truth[robot].t_ns) and np.array_equal(path.poses, b.truth[robot].poses)
    for robot, track in a.gps.items():
        assert np.array_equal(track.t_ns, b.gps[robot].t_ns) and np.array_equal(track.xy, b.gps[robot].xy)
        assert np.array_equal(track.antenna, b.gps[robot].antenna)
    assert a.landmarks.keys() == b.landmarks.keys()
    assert all(np.array_equal(position, b.landmarks[id_]) for id_, position in a.landmarks.items())
    assert a.control_columns == b.control_columns and a.sensor_columns == b.sensor_columns
    assert a.describes == b.describes


def test_a_log_comes_back_to_the_nanosecond_and_to_the_last_bit(tmp_path: Path) -> None:
    log = rich_log()
    again = open_log(write_native(log, tmp_path / "log"))
    assert again.format == "native"
    assert again.robots == log.robots
    assert_same_log(log, again)


def test_poses_in_space_and_landmarks_in_space_come_back(tmp_path: Path) -> None:
    pose = [1.0, 2.0, 3.0, 0.0, 0.6, 0.0, 0.8]
    log = Log(
        name="space",
        robots=("r",),
        events=[Fix(t_ns=1, robot="r", y=(1, 2, 3), cov=np.eye(3) / 3)],
        truth={"r": Trajectory(np.array([1]), np.array([pose]))},
        landmarks={"a": np.array([1.0, 2.0, 3.0]), 2: np.arange(6.0) / 7, "tag": np.array([1 / 7, *pose[1:]])},
        describes={
            "robots": {"r": {"motion": {"type": "odometry_3d", "sigma_x_m": 1e-5}}},
            "landmarks": {"type": "tag"},
        },
    )
    assert_same_log(log, open_log(write_native(log, tmp_path)))
    text = (tmp_path / "landmarks.csv").read_text().splitlines()
    assert text[0] == "id,x_m,y_m,z_m,qx,qy,qz,qw,x2_m,y2_m,z2_m"
    (tmp_path / "landmarks.csv").write_text("\n".join([text[0], "a,1,2,3,,,,,5,,"]))
    with pytest.raises(
        LogError, match=r"landmarks\.csv:2: x_m, y_m, z_m, x2_m, expected a point, both ends of a line or"
    ):
        open_log(tmp_path)


SPACE = {  # robots and sensors of space, each with the columns of its model
    "odometry": ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad"),
    "rates": ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps"),
    "impulses": ("dvx_mps", "dvy_mps", "dvz_mps", "dwx_radps", "dwy_radps", "dwz_radps"),
    "pinhole": ("u_px", "v_px"),
    "stereo": ("ul_px", "vl_px", "ur_px", "vr_px"),
    "radar": ("range_m", "azimuth_rad", "elevation_rad"),
    "depth": ("x_m", "y_m", "z_m"),
    "segments": ("u1_px", "v1_px", "u2_px", "v2_px"),
    "corners": ("u1_px", "v1_px", "u2_px", "v2_px", "u3_px", "v3_px", "u4_px", "v4_px", "size_m"),
    "tags": ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
}


def test_robots_and_sensors_of_space_come_back_side_by_side(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    robots, sensors = list(SPACE)[:3], list(SPACE)[3:]
    events: list[Event] = [
        Control(t_ns=1, robot=r, u=random.normal(size=6), cov=np.diag(random.random(6))) for r in robots
    ]
    for k, sensor in enumerate(sensors):
        y = random.random((2, len(SPACE[sensor])))
        if SPACE[sensor][-1] == "qw":
            y[:, -4:] /= np.linalg.norm(y[:, -4:], axis=1, keepdims=True)
        events.append(Scan(t_ns=k, robot="odometry", sensor=sensor, y=y, ids=[k, f"l{k}"]))
    log = Log(
        name="many",
        robots=tuple(robots),
        events=sorted(events, key=sort_key),
        control_columns={robot: SPACE[robot] for robot in robots},
        sensor_columns={("odometry", sensor): SPACE[sensor] for sensor in sensors},
    )
    again = open_log(write_native(log, tmp_path), robots=robots)
    assert_same_log(log, again)
    scans = (tmp_path / "scans.csv").read_text().splitlines()
    header, *rows = (line.split(",") for line in scans)
    swapped = [",".join(reversed(cells)) for cells in (header, *rows)]
    (tmp_path / "scans.csv").write_text("\n".join(swapped))
    assert_same_log(log, open_log(tmp_path, robots=robots))


times = st.integers(-(2**62), 2**62)


def test_a_tag_of_negative_size_is_refused(tmp_path: Path) -> None:
    row = "0.2,rover,cam,7," + ",".join("12345678") + ",-0.1"
    native(tmp_path, scans="t_s,robot,sensor,id," + ",".join(SPACE["corners"]) + "\n" + row)
    with pytest.raises(LogError, match=r"scans\.csv:2: size_m is -0\.1, expected a size of at least 0"):
        open_log(tmp_path)


finite = st.floats(-1e6, 1e6)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(times, finite, finite), min_size=1, max_size=20), st.data())
def test_any_controls_and_scans_come_back(
    tmp_path_factory: pytest.TempPathFactory, rows: list, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("native")
    events: list[Event] = [Control(t_ns=t, robot="r", u=(a, b)) for t, a, b in rows]
    for t in {t for t, _, _ in rows}:
        ids = data.draw(st.lists(st.one_of(st.integers(), st.sampled_from(["u1", "robot2"])), unique=True, max_size=4))
        y = data.draw(st.lists(st.tuples(finite.map(abs), st.floats(-6.0, 6.0)), min_size=len(ids), max_size=len(ids)))
        events.append(Scan(t_ns=t, robot="r", sensor="s", y=y, ids=ids))
    log = Log(
        name="any",
        robots=("r",),
        events=sorted(events, key=sort_key),
        control_columns={"r": ("v_mps", "w_radps")},
        sensor_columns={("r", "s"): ("range_m", "bearing_rad")},
    )
    again = open_log(write_native(log, folder))
    assert len(log) == len(again) and all(equal(a, b) for a, b in zip(log, again, strict=True))


@given(times)
def test_times_are_written_and_read_exactly(t_ns: int) -> None:
    assert nanoseconds_of_text(fixed_seconds(t_ns)) == t_ns


def test_times_are_read_exactly_in_every_notation() -> None:
    assert nanoseconds_of_text("1288971842.161") == 1_288_971_842_161_000_000
    assert nanoseconds_of_text("-0.5") == -500_000_000
    assert nanoseconds_of_text("1e-3") == nanoseconds_of_text(".001") == nanoseconds_of_text("+0.001") == 1_000_000
    assert nanoseconds_of_text("0.1234567894") == 123_456_789
    for text in ("", "nan", "inf", "1,5", "one", "1e300"):
        with pytest.raises(ValueError):
            nanoseconds_of_text(text)


def test_rows_of_one_robot_sensor_and_time_are_one_scan(tmp_path: Path) -> None:
    scan = next(event for event in open_log(native(tmp_path)) if isinstance(event, Scan))
    assert scan.ids == (7, None)
    assert scan.y.tolist() == [[4.2, 0.3], [3.1, -1.0]]
    assert scan.cov is None


def test_a_row_without_id_and_values_is_a_scan_that_saw_nothing(tmp_path: Path) -> None:
    log = open_log(native(tmp_path, scans=f"{HEAD}\n0.1,rover,lidar,,,\n{GOOD.replace('0.1', '0.2')}\n"))
    assert [len(event.y) for event in log if isinstance(event, Scan)] == [0, 1]
    assert log.sensor_columns == {("rover", "lidar"): ("range_m", "bearing_rad")}
    for rows in (f"{GOOD}\n0.1,rover,lidar,,,\n", f"0.1,rover,lidar,,,\n{GOOD}\n"):
        with pytest.raises(LogError, match=r"scans\.csv:3: an empty row and others in one scan"):
            open_log(native(tmp_path, scans=f"{HEAD}\n{rows}"))


def test_columns_may_come_in_any_order(tmp_path: Path) -> None:
    text = "id,bearing_rad,sensor,range_m,robot,t_s\n7,0.3,lidar,4.2,rover,0.2\n"
    log = open_log(native(tmp_path, scans=text, controls="w_radps,t_s,v_mps,robot\n0.02,0.1,0.5,rover\n"))
    assert log.sensor_columns == {("rover", "lidar"): ("range_m", "bearing_rad")}
    assert log.events[1].y.tolist() == [[4.2, 0.3]]
    assert log.events[0].u.tolist() == [0.5, 0.02]


def test_sensors_leave_each_others_columns_empty(tmp_path: Path) -> None:
    text = "t_s,robot,sensor,id,range_m,bearing_rad,u_px,v_px\n1,rover,lidar,1,4,0.3,,\n1,rover,eye,2,,,320,240\n"
    log = open_log(native(tmp_path, scans=text))
    assert log.sensor_columns == {("rover", "lidar"): ("range_m", "bearing_rad"), ("rover", "eye"): ("u_px", "v_px")}


def test_observations_may_bring_their_own_noise_as_sigmas_or_covariance(tmp_path: Path) -> None:
    head = "t_s,robot,sensor,id,range_m,bearing_rad"
    by_sigma = native(
        tmp_path, scans=f"{head},sigma_range_m,sigma_bearing_rad\n1,rover,s,1,4,0.3,0.5,0.1\n1,rover,s,2,4,0,1,1\n"
    )
    scan = open_log(by_sigma).events[-1]
    assert np.allclose(scan.cov, [np.diag([0.25, 0.01]), np.eye(2)])
    by_cov = native(tmp_path, scans=f"{head},cov_00,cov_01,cov_11\n1,rover,s,1,4,0.3,2,0.5,1\n2,rover,s,1,4,0.3,,,\n")
    first, second = open_log(by_cov).events[-2:]
    assert first.cov.tolist() == [[[2.0, 0.5], [0.5, 1.0]]]
    assert second.cov is None


def test_a_control_may_bring_its_own_noise_even_a_singular_one(tmp_path: Path) -> None:
    text = "t_s,robot,v_mps,w_radps,sigma_v_mps,sigma_w_radps\n1,rover,1,0,0.5,0\n2,rover,1,0,,\n"
    first, second = open_log(native(tmp_path, controls=text)).events[1:]
    assert first.cov.tolist() == [[0.25, 0.0], [0.0, 0.0]]
    assert second.cov is None


def test_fixes_name_their_covariance_by_axis_or_by_number(tmp_path: Path) -> None:
    for names in ("cov_xx,cov_xy,cov_yy", "cov_00,cov_01,cov_11"):
        text = f"t_s,robot,x_m,y_m,{names}\n1,rover,3,4,2,0.5,1\n"
        fix = open_log(native(tmp_path, fixes=text)).events[-1]
        assert isinstance(fix, Fix)
        assert fix.y.tolist() == [3, 4] and fix.cov.tolist() == [[2, 0.5], [0.5, 1]]


def test_writing_replaces_an_older_log_as_a_whole(tmp_path: Path) -> None:
    write_native(rich_log(), tmp_path)
    small = Log("small", ("r",), [Control(t_ns=1, robot="r", u=(1.0,))], control_columns={"r": ("v_mps",)})
    write_native(small, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["controls.csv"]


@pytest.mark.parametrize(
    ("events", "message"),
    [
        ([Scan(t_ns=1, robot="r", sensor="s", y=[[1.0]], ids=["7"])], "'7' would be read back as 7"),
        ([Scan(t_ns=1, robot="r", sensor="s", y=[[1.0]], ids=[" a"])], "without space"),
        ([Scan(t_ns=1, robot="r", sensor="s", y=[[1.0]])] * 2, "one at a time"),
        ([Scan(t_ns=1, robot="r", sensor="t", y=[[1.0]])], "expected the names"),
        ([Scan(t_ns=1, robot="r", sensor="s", y=[[1.0, 2.0]])], "its 2 numbers"),
        ([Scan(t_ns=1, robot="r", sensor="u", y=[[1.0, 2.0]])], "another order"),
        ([Fix(t_ns=1, robot="r", y=(1, 2), cov=[[1, 0.5], [0, 1]])], "not symmetric"),
    ],
)
def test_what_would_not_come_back_is_not_written(events: list[Event], message: str, tmp_path: Path) -> None:
    columns = {("r", "s"): ("range_m",), ("r", "u"): ("bearing_rad", "range_m")}
    with pytest.raises(LogError, match=message):
        write_native(Log("bad", ("r",), events, sensor_columns=columns), tmp_path / "log")
    assert not (tmp_path / "log").exists()


def test_events_are_put_in_order_as_a_sort_with_keys_does() -> None:
    random = np.random.default_rng(3)
    events: list[Event] = []
    for k in range(400):
        t_ns, robot = int(random.integers(0, 60)), str(random.choice(["a", "b"]))
        kind = k % 3
        if kind == 0:
            events.append(Control(t_ns=t_ns, robot=robot, u=[float(k)]))
        elif kind == 1:
            events.append(Scan(t_ns=t_ns, robot=robot, sensor=str(random.choice(["x", "y"])), y=[[float(k)]]))
        else:
            events.append(Fix(t_ns=t_ns, robot=robot, y=[float(k), 0.0], cov=np.eye(2)))
    assert [*map(id, sort_events(events))] == [*map(id, sorted(events, key=sort_key))] and sort_events([]) == []


def test_fitted_walls_are_read_beside_the_turns_of_wheels(tmp_path: Path) -> None:
    (tmp_path / "scans.csv").write_text(
        "t_s,robot,sensor,id,left_m,right_m,normal_deg,distance_cm\n1,r,laser,,2,-2,90,350\n"
    )
    (scan,) = open_log(tmp_path)
    assert isinstance(scan, Scan)
    np.testing.assert_allclose(scan.y, [[3.5, np.pi / 2, -2, 2]])


def test_a_sensor_with_other_columns_in_another_file_is_refused_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "scans.csv").write_text("t_s,robot,sensor,id,range_m,bearing_rad\n1,r,laser,,2,0.1\n")
    (tmp_path / "measurements.csv").write_text("t_s,robot,sensor,w_radps\n2,r,laser,0.1\n")
    with pytest.raises(
        LogError, match=r"measurements.csv:2: no column range_m, expected range_m, bearing_rad as r laser"
    ):
        open_log(tmp_path)


def test_quaternions_of_few_digits_are_poses_and_normalised(tmp_path: Path) -> None:
    """Of truth, of readings, of landmarks; farther from 1 than rounding they are refused, with file and line."""
    pose, heads = "1,2,0,0.0000,0.0000,0.7071,0.7072", "x_m,y_m,z_m,qx,qy,qz,qw"
    for file, head, begin in (
        ("truth", "t_s,robot", "1,r"),
        ("scans", "t_s,robot,sensor,id", "1,r,s,4"),
        ("landmarks", "id", "4"),
    ):
        (tmp_path / f"{file}.csv").write_text(f"{head},{heads}\n{begin},{pose}\n")
    log = open_log(tmp_path)
    q = np.array([0, 0, 0.7071, 0.7072]) / np.hypot(0.7071, 0.7072)
    for found in (log.truth["r"].poses[0], log.events[0].y[0], log.landmarks[4]):
        np.testing.assert_allclose(found[3:], q, atol=1e-15)
    (tmp_path / "scans.csv").write_text(f"t_s,robot,sensor,id,{heads}\n1,r,s,4,{pose}\n2,r,s,4,0,0,0,0,0,0,0.99\n")
    with pytest.raises(LogError, match=r"scans\.csv:3: quaternion has length 0\.99, expected 1 up to 0\.001"):
        open_log(tmp_path)
