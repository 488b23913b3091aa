"""The importers on small files made here: every bad row is named by file and line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.io

from kalmark.errors import LogError
from kalmark.events import Scan
from kalmark.logs import open_log

MRCLAM = {
    "Barcodes.dat": "# subject barcode\n 1 \t 5\n 2 \t 14\n 6 \t 72\n",
    "Landmark_Groundtruth.dat": "6 1.0 2.0 0.1 0.1\n",
    "Robot1_Odometry.dat": "# t v w\n10.000 \t 0.1 \t 0.2\n10.500 0.1 0.2\n",
    "Robot1_Measurement.dat": "10.1 72 2.5 0.1\n10.1 14 3.5 0.2\n10.2 99 1.0 0.0\n",
}


def mrclam(folder: Path, **changes: str) -> Path:
    for name, text in MRCLAM.items():
        (folder / name).write_text(changes.get(name.removesuffix(".dat"), text))
    return folder


def test_mrclam_maps_barcodes_to_subjects_and_robots(tmp_path: Path) -> None:
    log = open_log(mrclam(tmp_path))
    (scan,) = (event for event in log if isinstance(event, Scan))
    assert scan.ids == (6, "robot2") and scan.sensor == "camera"
    assert log.skipped == [f"{tmp_path / 'Robot1_Measurement.dat'}:3: 1 of barcode 99, which no subject carries"]


@pytest.mark.parametrize(
    ("file", "text", "line", "message"),
    [
        ("Robot1_Odometry", "1 0.1 0.2\n2 nan 0.2\n", 2, "v_mps is 'nan', expected a finite number"),
        ("Robot1_Odometry", "1 0.1 0.2\n2 0.1", 2, "2 numbers in the row, expected 3: t_s, v_mps, w_radps"),
        ("Robot1_Odometry", "1 0.1 fast\n", 1, "w_radps is 'fast'"),
        ("Robot1_Odometry", "1 0.1 0.2\n0.5 0.1 0.2\n", 2, "time 0.5 s after 1 s, expected times that never"),
        ("Robot1_Odometry", "", 1, "empty"),
        ("Robot1_Odometry", "# only a comment\n", 1, "no rows"),
        ("Robot1_Measurement", "1 72 -2.5 0.1\n", 1, "range_m is -2.5"),
        ("Robot1_Measurement", "1 72 2.5 0.1\n1 72 2.5 0.1\n", 2, "subject 6 twice at one time"),
        ("Barcodes", "1 5\n2\n", 2, "expected a subject and its barcode"),
        ("Landmark_Groundtruth", "6 one 2.0\n", 1, "expected subject, x, y"),
    ],
)
def test_a_bad_mrclam_row_is_named(file: str, text: str, line: int, message: str, tmp_path: Path) -> None:
    mrclam(tmp_path, **{file: text})
    with pytest.raises(LogError) as refused:
        open_log(tmp_path)
    assert str(refused.value).startswith(f"{tmp_path / file}.dat:{line}: ")
    assert message in str(refused.value)


def test_mrclam_reads_on_when_asked_to_skip(tmp_path: Path) -> None:
    log = open_log(mrclam(tmp_path, Robot1_Odometry="1 0.1 0.2\n0.5 0.1 0.2\n2 0 0\n3 x 0\n"), on_error="skip")
    assert [event.t_ns for event in log if not isinstance(event, Scan)] == [1_000_000_000, 2_000_000_000]
    assert len(log.skipped) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [({"bearing_shift_s": "late"}, "bearing_shift_s is 'late'"), ({"robot_sightings": 3}, "expected True or False")],
)
def test_mrclam_options_are_checked(options: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=message):
        open_log(mrclam(tmp_path), **options)


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("ODOMETRY 0 1 0\nSENSOR 1 2\n", 2, "'SENSOR 1 2', expected ODOMETRY r1 t r2 or SENSOR"),
        ("ODOMETRY 0 1\n", 1, "'ODOMETRY 0 1'"),
        ("ODOMETRY 0 1 nan\n", 1, "nan"),
        ("ODOMETRY 0 1 0\nSENSOR 1 2 0\nSENSOR 1 2 0\n", 3, "id 1 twice"),
        ("SENSOR 1 2 0\n", 1, "before the first step"),
        ("ODOMETRY 0 1 0\nODO 1 2 0\n", 2, "'ODO 1 2 0'"),
    ],
)
def test_a_bad_freiburg_row_is_named(text: str, line: int, message: str, tmp_path: Path) -> None:
    (tmp_path / "sensor_data.dat").write_text(text)
    with pytest.raises(LogError) as refused:
        open_log(tmp_path)
    assert str(refused.value).startswith(f"{tmp_path / 'sensor_data.dat'}:{line}: ")
    assert message in str(refused.value)


STEP = "STEP img 0 -1 0.1 1 0 1 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (STEP + "LANDMARK_C 1 2 0.9 1 0 1\n", 2),
        (STEP + "LANDMARK_C 1 2 0.9 1 2 1 7\n", 2),
        (STEP + "LANDMARK_C 1 nan 0.9 1 0 1 7\n", 2),
        (STEP + "LANDMARK_C 1 2 0.9 1 0 1 7\nLANDMARK_C 1 2 0.9 1 0 1 7\n", 3),
        ("STEP img 0 -1 0.1 1 0 1 0 0 0\n", 1),
        ("LANDMARK_C 1 2 0.9 1 0 1 7\n", 1),
    ],
)
def test_a_bad_dlr_row_is_named(text: str, line: int, tmp_path: Path) -> None:
    (tmp_path / "map.circles").write_text(text)
    with pytest.raises(LogError, match=rf"map\.circles:{line}: .*expected"):
        open_log(tmp_path)


def test_two_spurious_dlr_landmarks_may_share_a_scan(tmp_path: Path) -> None:
    (tmp_path / "map.circles").write_text(STEP + "LANDMARK_C 1 2 0.9 1 0 1 -1\n" * 2)
    assert open_log(tmp_path).events[1].ids == (None, None)


def woods(**changes: np.ndarray) -> dict[str, np.ndarray]:
    column = np.arange(3.0)[:, None]
    seen = np.tile([[0.0, 2.0]], (3, 1))
    zero = 0 * column
    truth = {"x_true": column, "y_true": zero, "th_true": zero, "true_valid": np.array([[1], [0], [1]], dtype=np.uint8)}
    return {"t": column / 10, "v": zero, "om": zero, "r": seen, "b": seen / 10, "l": np.eye(2), **truth, **changes}


def test_lost_in_the_woods_keeps_what_was_seen_and_what_is_valid(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "dataset2.mat", woods())
    log = open_log(tmp_path)
    assert [event.ids for event in log if isinstance(event, Scan)] == [(2,)] * 3
    assert log.truth["robot"].t_ns.tolist() == [0, 200_000_000]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"v": np.array([[0], [np.nan], [0]])}, "v row 2 is not finite"),
        ({"r": np.array([[0, 1], [0, -1], [0, 1.0]])}, "r row 2, column 2 is negative"),
        ({"t": np.array([[0], [0.2], [0.1]])}, "t row 3 is not after row 2"),
        ({"b": np.zeros((2, 2))}, "b has 2 rows, expected 3"),
    ],
)
def test_bad_values_in_a_matlab_file_are_named(changes: dict, message: str, tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "dataset2.mat", woods(**changes))
    with pytest.raises(LogError, match=message):
        open_log(tmp_path)


def test_a_negative_reach_is_refused(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "dataset2.mat", woods())
    with pytest.raises(LogError, match="r_max is -1, expected a positive number"):
        open_log(tmp_path, r_max=-1)


def victoria(folder: Path, table: np.ndarray) -> Path:
    (folder / "slsjf").mkdir()
    (folder / "DRS.txt").write_text("0.973\t0.5\t0.01\r\n0.998\t0.5\t0.01\r\n")
    scipy.io.savemat(folder / "slsjf" / "data_sensor_clean_clean.mat", {"data_sensor_clean_clean": table})
    return folder


def test_victoria_park_leaves_out_what_its_authors_ignore(tmp_path: Path) -> None:
    table = np.array([[21_950, 5, np.pi / 2, 0, 0, 1], [21_950, 6, 0, 0, 0, -1], [22_000, 5, np.pi, 0, 0, 1]])
    log = open_log(victoria(tmp_path, table))
    first, second = (event for event in log if isinstance(event, Scan))
    assert first.y.tolist() == [[5.0, 0.0]] and first.ids == (1,)
    assert second.t_ns == 22_000_000_000 and second.y[0, 1] == np.pi / 2
    assert log.events[0].t_ns == 21_940_000_000
    assert len(log.skipped) == 1 and "1 detections of poor quality" in log.skipped[0]
    assert log.gps == {}


@pytest.mark.parametrize(
    ("row", "message"),
    [([21_900, 5, 1, 0, 0, 2], "t row 2 is before row 1"), ([21_960, -5, 1, 0, 0, 2], "row 2 has range -5")],
)
def test_bad_victoria_park_rows_are_named(row: list[float], message: str, tmp_path: Path) -> None:
    table = np.array([[21_950, 5, 1, 0, 0, 1], row], dtype=float)
    with pytest.raises(LogError, match=message):
        open_log(victoria(tmp_path, table))


def test_victoria_park_without_its_detections_says_which_file_is_missing(tmp_path: Path) -> None:
    (tmp_path / "DRS.txt").write_text("0.973 0.5 0.01\n")
    with pytest.raises(LogError, match=r"data_sensor_clean_clean\.mat: no such file"):
        open_log(tmp_path)
    (tmp_path / "DRS.txt").unlink()
    (tmp_path / "victoria_park_ascii.zip").write_bytes(b"PK")
    with pytest.raises(LogError, match=r"victoria_park_ascii\.zip: .*expected a zip with DRS\.txt"):
        open_log(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0.5 1.0 2.0", r"LASER\.txt: 3 numbers, expected whole scans of a time and 361 ranges"),
        ("0.5 " + "1.0 " * 360 + "x", r"LASER\.txt: .*'x', expected numbers"),
        ("0.5 " + "1.0 " * 360 + "-2", r"LASER\.txt: scan 1 beam 361 has range -2\.0, expected at least 0"),
        ("0.5 " + "1.0 " * 361 + "0.4 " + "1.0 " * 361, r"LASER\.txt: times run backwards"),
    ],
)
def test_bad_laser_scans_of_victoria_park_are_named(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "DRS.txt").write_text("0.4 0.5 0.01\n")
    (tmp_path / "LASER.txt").write_text(text)
    with pytest.raises(LogError, match=message):
        open_log(tmp_path, detections="laser")
