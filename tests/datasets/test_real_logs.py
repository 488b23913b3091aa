"""The importers on the real data: every count that the sets are known for, and every trap."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from kalmark.errors import LogError
from kalmark.events import Control, Scan, sort_key
from kalmark.logs import Log, open_log, write_native

Data = Callable[[str], Path]


@cache
def opened(path: Path, **options: object) -> Log:
    """Open a log once for all tests here, which only read it."""
    return open_log(path, **options)


def controls(log: Log, robot: str | None = None) -> list[Control]:
    return [event for event in log if isinstance(event, Control) and robot in (None, event.robot)]


def scans(log: Log, robot: str | None = None) -> list[Scan]:
    return [event for event in log if isinstance(event, Scan) and robot in (None, event.robot)]


def observations(log: Log, robot: str | None = None) -> Counter:
    return Counter(id_ for scan in scans(log, robot) for id_ in scan.ids)


def dead_reckoning(log: Log) -> np.ndarray:
    """Chain increments from (0, 0, 0); the pose after each."""
    x, y, theta, path = 0.0, 0.0, 0.0, []
    for dx, dy, turn in (control.u for control in controls(log)):
        x, y = x + dx * math.cos(theta) - dy * math.sin(theta), y + dx * math.sin(theta) + dy * math.cos(theta)
        theta += turn
        path.append((x, y, theta))
    return np.array(path)


D6 = {  # odometry rows, observations of landmarks, of robots, of nobody, truth rows
    1: (61_785, 1_534, 407, 1, 49_241),
    2: (65_005, 3_239, 792, 0, 59_705),
    3: (61_158, 4_348, 1_277, 2, 56_977),
    4: (52_916, 2_023, 373, 3, 61_714),
    5: (60_567, 4_239, 1_139, 0, 57_467),
}


@pytest.mark.parametrize("n", D6)
def test_mrclam_6_has_its_counts(n: int, data: Data) -> None:
    odometry, landmarks, robots, nobody, truth = D6[n]
    log = opened(data("mrclam/MRCLAM_Dataset6"), robots=n)
    assert log.format == "mrclam" and log.robots == (f"robot{n}",)
    assert len(controls(log)) == odometry
    assert sum(observations(log).values()) == landmarks
    assert set(observations(log)) == set(log.landmarks) == set(range(6, 21))
    assert len(log.truth[f"robot{n}"]) == truth
    dropped = {"robot": 0, "barcode": 0}
    for line in log.skipped:
        count, _, what = line.split(": ", 1)[1].split(" ")[:3]
        dropped["barcode" if what == "barcode" else "robot"] += int(count)
    assert dropped == {"robot": robots, "barcode": nobody}


def test_mrclam_robots_that_sight_each_other_are_named(data: Data) -> None:
    log = opened(data("mrclam/MRCLAM_Dataset6"), robots=(4, 1))
    seen = observations(log, "robot4")
    assert seen["robot1"] > 0 and not {"robot2", "robot3", "robot5"} & set(seen)
    assert log.robots == ("robot1", "robot4")
    assert [sort_key(event) for event in log] == sorted(sort_key(event) for event in log)
    alone = opened(data("mrclam/MRCLAM_Dataset9"), robots=5, robot_sightings=False)
    assert all(isinstance(id_, int) for id_ in observations(alone))
    assert any("robot_sightings is false" in line for line in alone.skipped)


def test_mrclam_stamps_are_exact_and_measurements_can_be_shifted(data: Data) -> None:
    folder = data("mrclam/MRCLAM_Dataset6")
    plain, shifted = opened(folder, robots=4), opened(folder, robots=4, bearing_shift_s=-0.05)
    stamps = [scan.t_ns for scan in scans(plain)]
    assert all(t_ns % 1_000_000 == 0 for t_ns in stamps)
    assert [scan.t_ns for scan in scans(shifted)] == [t_ns - 50_000_000 for t_ns in stamps]
    assert [c.t_ns for c in controls(shifted)] == [c.t_ns for c in controls(plain)]


def test_mrclam_truth_has_the_gap_of_robot_4_and_ends_early_for_robot_1(data: Data) -> None:
    log = opened(data("mrclam/MRCLAM_Dataset6"), robots=(4, 1))
    gap = np.diff(log.truth["robot4"].t_ns)
    where = int(gap.argmax())
    assert 1.9e9 < gap[where] < 2.1e9
    assert np.isnan(log.truth["robot4"].at(log.truth["robot4"].t_ns[where] + gap[where] // 2)).all()
    last = controls(log, "robot1")[-1].t_ns
    assert 127e9 < last - log.truth["robot1"].t_ns[-1] < 129e9
    assert np.isnan(log.truth["robot1"].at(last)).all()


def test_mrclam_residuals_against_truth_are_those_of_the_set(data: Data) -> None:
    log = opened(data("mrclam/MRCLAM_Dataset6"), robots=2)
    errors = []
    for scan in scans(log):
        pose = log.truth["robot2"].at(scan.t_ns)
        for id_, (range_m, bearing) in zip(scan.ids, scan.y, strict=True):
            dx, dy = log.landmarks[id_] - pose[:2]
            turn = math.remainder(bearing - math.atan2(dy, dx) + pose[2], 2 * math.pi)
            errors.append((range_m - math.hypot(dx, dy), turn))
    range_error, bearing_error = np.nanmedian(errors, axis=0)
    assert abs(range_error - 0.031) < 0.002
    assert abs(bearing_error - 0.0033) < 0.0005


def test_mrclam_9_names_the_line_whose_time_runs_backwards(data: Data) -> None:
    folder = data("mrclam/MRCLAM_Dataset9")
    for n in range(1, 5):
        with pytest.raises(LogError, match=rf"Robot{n}_Odometry\.dat:6: time [\d.]+ s after [\d.]+ s, expected times"):
            opened(folder, robots=n)
    assert opened(folder, robots=5).robots == ("robot5",)


def test_mrclam_9_can_be_read_without_its_bad_rows(data: Data) -> None:
    log = opened(data("mrclam/MRCLAM_Dataset9"), on_error="skip")
    counts = {1: 10_193, 2: 9_099, 3: 9_253, 4: 4_510, 5: 10_102}
    unknown = {1: 1, 5: 1}
    for n, count in counts.items():
        assert sum(observations(log, f"robot{n}").values()) == count - unknown.get(n, 0)
    assert sum("run backwards" in line for line in log.skipped) == 4
    assert [line.split(": ")[1] for line in log.skipped if "barcode" in line] == [
        "1 of barcode 52, which no subject carries"
    ] * 2
    assert len(log.landmarks) == 15 and log.truth == {}


def test_mrclam_8_has_no_odometry_and_says_so(data: Data) -> None:
    folder = data("mrclam/MRCLAM_Dataset8")
    with pytest.raises(LogError, match=r"Robot1_Odometry\.dat: no such file, expected the odometry of robot1"):
        open_log(folder)
    log = opened(folder, on_error="skip")
    assert controls(log) == [] and len(log.landmarks) == 14
    by_robot = [605, 894, 1_973, 819, 1_294]
    listed = [line.split(": ")[1] for line in log.skipped if "barcode 61" in line]
    assert listed == [f"{count} of barcode 61, which no subject carries" for count in by_robot]
    total = sum(observations(log).values()) + sum(
        int(line.split(": ")[1].split()[0]) for line in log.skipped if "barcode" in line
    )
    assert total == 14_129 + 19_880 + 23_634 + 12_264 + 24_032


def test_mrclam_refuses_a_robot_it_does_not_have(data: Data) -> None:
    with pytest.raises(LogError, match="no robot 'robot7', expected one of robot1, robot2"):
        opened(data("mrclam/MRCLAM_Dataset6"), robots=7)
    with pytest.raises(LogError, match="it holds the logs MRCLAM_Dataset6, MRCLAM_Dataset8, MRCLAM_Dataset9"):
        opened(data("mrclam"))


def test_lost_in_the_woods_has_its_counts(data: Data) -> None:
    log = opened(data("lost_in_the_woods"))
    assert log.format == "lost_in_the_woods"
    assert len(controls(log)) == 12_609 and sum(observations(log).values()) == 61_086
    assert set(log.landmarks) == set(range(1, 18))
    seen = [scan for scan in scans(log) if len(scan.y)]
    assert all((scan.y[:, 0] > 0).all() for scan in seen)
    assert len(scans(log)) == 12_609 and 0.005 < 1 - len(seen) / 12_609 < 0.007
    assert controls(log)[-1].t_ns == 1_260_800_000_000
    assert 0.973 < len(log.truth["robot"]) / 12_609 < 0.975
    near = opened(data("lost_in_the_woods/dataset2.mat"), r_max=1.0)
    assert max(scan.y[:, 0].max() for scan in scans(near) if len(scan.y)) <= 1.0
    assert len(controls(near)) == 12_609


def test_lost_in_the_woods_fits_its_truth_with_the_laser_ahead(data: Data) -> None:
    log = opened(data("lost_in_the_woods"))
    errors = []
    for scan in scans(log)[::10]:
        x, y, theta = log.truth["robot"].at(scan.t_ns)
        x, y = x + 0.219 * math.cos(theta), y + 0.219 * math.sin(theta)
        for id_, (range_m, bearing) in zip(scan.ids, scan.y, strict=True):
            dx, dy = log.landmarks[id_] - (x, y)
            turn = math.remainder(bearing - math.atan2(dy, dx) + theta, 2 * math.pi)
            errors.append((range_m - math.hypot(dx, dy), turn))
    assert np.allclose(np.nanstd(errors, axis=0), [0.0329, 0.0257], atol=0.001)


def test_freiburg_has_its_counts_and_its_odometry(data: Data) -> None:
    log = opened(data("freiburg_course"))
    assert log.format == "freiburg_course"
    assert len(controls(log)) == 331
    assert sum(observations(log).values()) + len(log.skipped) == 1_212
    assert log.skipped == [f"{log.path}:1541: range is -0.035065641258, expected a range of at least 0"]
    assert len(log.landmarks) == 9
    assert np.allclose(dead_reckoning(log)[-1], (5.06, 4.89, -4.72), atol=0.01)
    assert controls(log)[0].t_ns == scans(log)[0].t_ns == 1_000_000_000


def test_freiburg_residuals_are_small_in_the_beginning(data: Data) -> None:
    log = opened(data("freiburg_course/sensor_data.dat"))
    path, errors = dead_reckoning(log), []
    for scan in scans(log):
        x, y, theta = path[scan.t_ns // 1_000_000_000 - 1]
        for id_, (range_m, bearing) in zip(scan.ids, scan.y, strict=True):
            dx, dy = log.landmarks[id_] - (x, y)
            turn = math.remainder(bearing - math.atan2(dy, dx) + theta, 2 * math.pi)
            errors.append((range_m - math.hypot(dx, dy), turn))
    assert np.allclose(np.std(errors[:50], axis=0), [0.100, 0.049], atol=0.002)


@pytest.mark.parametrize(("steering", "rows"), [("ascii", 61_763), ("mat", 61_945)])
def test_victoria_park_has_its_counts(steering: str, rows: int, data: Data) -> None:
    log = opened(data("victoria_park"), steering=steering)
    assert log.format == "victoria_park"
    assert len(controls(log)) == rows
    assert sum(observations(log).values()) == 46_860 and len(scans(log)) == 7_122 and len(observations(log)) == 299
    assert len(log.gps["car"]) == 4_466 and log.gps["car"].antenna.tolist() == [3.78, 0.5]
    assert np.allclose(log.gps["car"].xy[0], (-67.649, -41.714), atol=1e-3)
    assert controls(log)[0].t_ns == 21_940_000_000
    assert np.all(np.abs(np.concatenate([scan.y[:, 1] for scan in scans(log)])) <= np.pi / 2)


def test_victoria_park_clocks_agree(data: Data) -> None:
    ascii_, mat = (controls(opened(data("victoria_park"), steering=name)) for name in ("ascii", "mat"))
    assert [c.t_ns for c in ascii_] == [c.t_ns for c in mat[: len(ascii_)]]
    speed = np.array([a.u[0] - b.u[0] for a, b in zip(ascii_, mat, strict=False)])
    steering = np.array([a.u[1] - b.u[1] for a, b in zip(ascii_, mat, strict=False)])
    assert np.abs(speed).max() < 1e-3
    assert abs(steering.std() - 0.010) < 0.001


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"detections": "slsj"}, "expected one of slsjf, rfs, laser; did you mean 'slsjf'"),
        ({"steering": 3}, "steering is 3, expected one of ascii, mat"),
        ({"stering": "mat"}, "'stering' is unknown to victoria_park, expected .*did you mean 'steering'"),
    ],
)
def test_victoria_park_names_what_is_available(options: dict, message: str, data: Data) -> None:
    with pytest.raises(LogError, match=message):
        opened(data("victoria_park"), **options)


def test_victoria_park_has_the_beams_and_the_trees_of_another_program(data: Data) -> None:
    raw = [e for e in opened(data("victoria_park"), detections="laser") if isinstance(e, Scan)]
    assert len(raw) == 7230
    assert raw[0].t_ns == 21_819_000_000  # .852 s on the clock of the ascii files
    assert raw[0].y.shape == (361, 2)
    assert (raw[0].y[[0, 180], 1] == [-np.pi / 2, 0.0]).all()
    assert np.mean([np.mean(scan.y[:, 0] > 80) for scan in raw]) == pytest.approx(0.83, abs=0.005)
    log = opened(data("victoria_park"), detections="rfs")
    rfs = [e for e in log if isinstance(e, Scan)]
    assert sum(len(scan.y) for scan in rfs) == 52_974
    assert log.sensor_columns["car", "laser"] == ("range_m", "bearing_rad", "signature")
    assert rfs[0].t_ns == raw[0].t_ns


def test_dlr_has_its_counts(data: Data) -> None:
    log = opened(data("dlr/map.circles"))
    seen = observations(log)
    assert log.format == "dlr"
    assert len(controls(log)) == 3_297 and sum(seen.values()) == 14_745
    assert seen[None] == 436 and len(seen) - 1 == 576
    path = dead_reckoning(log)
    assert abs(np.hypot(*np.diff(path[:, :2], axis=0, prepend=0).T).sum() - 505) < 1
    assert abs(np.mean([control.u[0] for control in controls(log)]) - 0.152) < 0.001


def test_dlr_is_turned_into_x_forward_y_left(data: Data) -> None:
    log = opened(data("dlr"))
    x, y, theta = dead_reckoning(log)[-1]
    assert np.allclose((-y, -x, -theta), (-13.40, -9.88, 42.15), atol=0.01)
    first, scan = controls(log)[0], scans(log)[0]
    assert np.allclose(first.u, [0.15647, -0.00088, -0.01153])
    xx, xy, yy, xp, yp, pp = (
        0.000016397281, -0.000000002137, 0.000014026487, 0.000021731727, -0.000000042656, 0.000261252446,
    )  # fmt: skip
    assert np.allclose(first.cov, [[yy, xy, yp], [xy, xx, xp], [yp, xp, pp]], rtol=0, atol=1e-18)
    assert np.allclose(scan.y[0], [3.10353, 0.249545])
    assert np.allclose(scan.cov[0], [[0.00376213, 0.000162376], [0.000162376, 0.0017211]], rtol=0, atol=1e-15)
    assert scan.t_ns == first.t_ns == 1_000_000_000


def test_dlr_landmarks_seen_again_are_where_the_step_says(data: Data) -> None:
    log = opened(data("dlr"))
    before: dict = {}
    errors = []
    by_time = {scan.t_ns: scan for scan in scans(log)}
    for control in controls(log):
        dx, dy, turn = control.u
        scan = by_time.get(control.t_ns)
        now = {} if scan is None else dict(zip(scan.ids, scan.y, strict=True))
        c, s = math.cos(turn), math.sin(turn)
        for id_ in (before.keys() & now.keys()) - {None}:
            x, y = before[id_] - (dx, dy)
            errors.append(np.hypot(c * x + s * y - now[id_][0], -s * x + c * y - now[id_][1]))
        before = now
    assert np.median(errors) < 0.03


@pytest.mark.parametrize("name", ["lost_in_the_woods", "dlr", "freiburg_course", "victoria_park"])
def test_every_log_can_be_converted_to_a_native_one(name: str, data: Data, tmp_path: Path) -> None:
    log = opened(data(name), to_s=100.0)
    again = open_log(write_native(log, tmp_path))
    assert len(again) == len(log)
    for a, b in zip(log, again, strict=True):
        assert type(a) is type(b) and a.t_ns == b.t_ns
        assert np.array_equal(a.u if isinstance(a, Control) else a.y, b.u if isinstance(b, Control) else b.y)
    assert again.landmarks.keys() == log.landmarks.keys() and again.gps.keys() == log.gps.keys()


def test_truncated_files_are_refused_by_file_and_line(data: Data, tmp_path: Path) -> None:
    for name, end in (("dlr/map.circles", 5_000), ("freiburg_course/sensor_data.dat", 1_000)):
        copy = tmp_path / name.split("/")[1]
        copy.write_bytes(data(name).read_bytes()[:end].rstrip(b"0123456789."))
        with pytest.raises(LogError, match=rf"{copy.name}:\d+: .*expected"):
            open_log(copy)
    for n, name in enumerate(("lost_in_the_woods/dataset2.mat", "victoria_park/slsjf/data_sensor_clean_clean.mat")):
        folder = tmp_path / str(n)
        target = folder if n == 0 else folder / "slsjf"
        target.mkdir(parents=True)
        (target / name.split("/")[-1]).write_bytes(data(name).read_bytes()[:100_000])
        if n == 1:
            (folder / "aa3_dr.mat").write_bytes(data("victoria_park/aa3_dr.mat").read_bytes())
        with pytest.raises(LogError, match="expected"):
            opened(folder, **({"steering": "mat"} if n else {}))
