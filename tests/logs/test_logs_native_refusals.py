"""Native logs that are wrong: refused with file, line, value and expectation, or left out and listed."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

import kalmark as km
from kalmark.errors import LogError
from kalmark.events import Scan
from kalmark.logs import open_log
from kalmark.logs.source import records_of, spelling_hint
from kalmark.logs.table_columns import in_unit_of
from native_logs import GOOD, HEAD, SCANS, native

BAD_ROWS = {
    "a value that is NaN": (f"{HEAD}\n{GOOD}\n0.2,rover,lidar,7,nan,0.3\n", 3, "range_m is 'nan'", "finite"),
    "an infinite value": (f"{HEAD}\n{GOOD}\n0.2,rover,lidar,7,4,inf\n", 3, "bearing_rad is 'inf'", "finite"),
    "text for a number": (f"{HEAD}\n{GOOD}\n0.2,rover,lidar,7,four,0.3\n", 3, "range_m is 'four'", "number"),
    "an empty cell": (f"{HEAD}\n{GOOD}\n0.2,rover,lidar,7,,0.3\n", 3, "range_m is ''", "finite number"),
    "a bad time": (f"{HEAD}\n{GOOD}\nsoon,rover,lidar,7,4,0.3\n", 3, "t_s is 'soon'", "seconds"),
    "too few cells": (f"{HEAD}\n{GOOD}\n0.2,rover,li", 3, "3 cells", "expected 6"),
    "too many cells": (f"{HEAD}\n{GOOD}\n0.2,rover,lidar,7,4,0.3,9\n", 3, "7 cells", "expected 6"),
    "a negative range": (f"{HEAD}\n{GOOD}\n0.2,rover,lidar,7,-4.2,0.3\n", 3, "range_m is -4.2", "at least 0"),
    "a landmark twice in a scan": (
        f"{HEAD}\n{GOOD}\n0.1,rover,lidar,7,4,0\n",
        3,
        "id 7",
        "expected each landmark once",
    ),
    "time running backwards": (
        f"{HEAD}\n{GOOD}\n0.05,rover,lidar,7,4,0\n",
        3,
        "0.05 s after 0.1 s",
        "never run backwards",
    ),
    "no robot": (f"{HEAD}\n0.1,,lidar,7,4,0\n", 2, "robot is empty", "a name"),
    "no sensor": (f"{HEAD}\n0.1,rover,,7,4,0\n", 2, "sensor is empty", "a name"),
    "a missing column": ("t_s,robot,sensor,range_m\n0.1,r,s,4\n", 1, "no column id", "t_s, robot, sensor, id"),
    "a column twice": (f"{HEAD},range_m\n{GOOD},4\n", 1, "'range_m' appears 2 times", "expected"),
    "a column in two units": (
        f"{HEAD},range_mm\n{GOOD},4\n",
        1,
        "range_m and range_mm are both range_m",
        "scans.csv and measurements.csv may have one each",
    ),
    "a header and nothing else": (f"{HEAD}\n", 1, "no rows", "at least one"),
    "an empty file": ("", 1, "empty", "expected"),
    "blanks only": ("\n \n", 1, "empty", "expected"),
    "a quote left open": (f'{HEAD}\n0.1,"rover,lidar,7,4.2,0.3\n', 2, "end of data", "comma separated"),
    "half a noise": (f"{HEAD},sigma_range_m,sigma_bearing_rad\n{GOOD},0.1,\n", 2, "sigma_range_m", "sigma_bearing_rad"),
    "noise that is negative": (f"{HEAD},sigma_range_m,sigma_bearing_rad\n{GOOD},0.1,-1\n", 2, "-1.0", "at least 0"),
    "noise of zero": (
        f"{HEAD},sigma_range_m,sigma_bearing_rad\n{GOOD},0.1,0\n",
        2,
        "eigenvalue 0",
        "positive definite",
    ),
    "noise that is indefinite": (
        f"{HEAD},cov_00,cov_01,cov_11\n{GOOD},1,2,1\n",
        2,
        "eigenvalue -1",
        "positive definite",
    ),
    "noise with a wrong name": (f"{HEAD},cov_00,cov_01,cov_22\n{GOOD},1,0,1\n", 2, "cov_22", "cov_00, cov_01, cov_11"),
    "noise for one of two": (
        f"{HEAD},cov_00,cov_01,cov_11\n{GOOD},1,0,1\n0.1,rover,lidar,8,4,0,,,\n",
        3,
        "own noise",
        "all",
    ),
}


@pytest.mark.parametrize("what", BAD_ROWS)
def test_a_bad_row_is_refused_with_file_line_value_and_expectation(what: str, tmp_path: Path) -> None:
    text, line, value, expected = BAD_ROWS[what]
    native(tmp_path, scans=text)
    with pytest.raises(LogError) as refused:
        open_log(tmp_path)
    message = str(refused.value)
    assert message.startswith(f"{tmp_path / 'scans.csv'}:{line}: ")
    assert value in message and expected in message
    assert "\n" not in message


WITHOUT_UNIT = {
    ("scans", "range_m", "range"): "range_m, in metres",
    ("scans", "range_m", "range_ft"): "range_m, in metres",
    ("scans", "range_m", "Range [m]"): "range_m, in metres",
    ("scans", "bearing_rad", "bearing"): "bearing_rad, in radians",
    ("scans", "bearing_rad", "bearing_degrees"): "bearing_rad, in radians",
    ("scans", "t_s", "t_min"): "t_s, in seconds",
    ("scans", "robot", "Robot"): "robot",
    ("controls", "v_mps", "v"): "v_mps, in m/s",
    ("controls", "w_radps", "w_rpm"): "w_radps, in rad/s",
    ("controls", "w_radps", "w_deg_s"): "w_radps, in rad/s; did you mean 'w_degps'?",
    ("controls", "v_mps", "v_km_h"): "v_mps, in m/s; did you mean 'v_kmh'?",
    ("controls", "v_mps", "v_m_s"): "v_mps, in m/s",
    ("truth", "x_m", "x"): "x_m, in metres",
    ("truth", "theta_rad", "theta_degree"): "theta_rad, in radians",
    ("landmarks", "y_m", "y"): "y_m, in metres",
}
"""By file, column and what stands for it: what is expected."""


@pytest.mark.parametrize(("file", "column", "given"), WITHOUT_UNIT)
def test_a_column_in_another_unit_or_in_none_is_refused_with_the_one_expected(
    file: str, column: str, given: str, tmp_path: Path
) -> None:
    truth, landmarks = "t_s,robot,x_m,y_m,theta_rad\n0.1,rover,1,2,0\n", "id,x_m,y_m\n7,1,2\n"
    native(tmp_path, truth=truth, landmarks=landmarks)
    path = tmp_path / f"{file}.csv"
    path.write_text(path.read_text().replace(column, given, 1))
    with pytest.raises(LogError) as refused:
        open_log(tmp_path)
    assert str(refused.value) == (
        f"{path}:1: column {given!r} is unknown, expected {WITHOUT_UNIT[file, column, given]}"
    )


@pytest.mark.parametrize(
    ("word", "meant"),
    {"time_ms": "t_ms", "timestamp_ns": "t_ns", "velocity_mps": "v_mps", "vel_km_h": "v_kmh", "robto": "robot"}.items(),
)
def test_a_hint_at_a_column_has_the_unit_of_the_word(word: str, meant: str) -> None:
    assert spelling_hint(word, ("t_s", "robot", "v_mps", "w_radps")) == f"; did you mean {meant!r}?"
    assert spelling_hint("omega_degps", ("t_s", "v_mps")) == ""


@pytest.mark.parametrize("word", ["time", "timestamp", "Stamp"])
def test_a_time_without_a_unit_is_refused_with_a_hint_at_the_column(word: str, tmp_path: Path) -> None:
    path = native(tmp_path, scans=SCANS.replace("t_s", word, 1)) / "scans.csv"
    with pytest.raises(LogError) as refused:
        open_log(tmp_path)
    expected = "t_s, robot, sensor, id; did you mean 't_s'?"
    assert str(refused.value) == f"{path}:1: column {word!r} is unknown, expected {expected}"


@pytest.mark.parametrize(
    ("word", "column", "meant"),
    [
        ("omega", "w_radps", "w_radps"), ("omega_degps", "w_radps", "w_degps"), ("speed", "v_mps", "v_mps"),
        ("distance_cm", "range_m", "range_cm"), ("type", "t_s", ""), ("weight", "w_radps", ""), ("yaw", "y_m", ""),
    ],
)  # fmt: skip
def test_a_word_of_the_field_means_its_column_and_no_other_does(word: str, column: str, meant: str) -> None:
    assert in_unit_of(word, column) == meant


def test_columns_of_ones_own_sensor_are_read_whatever_they_are_called(tmp_path: Path) -> None:
    log = open_log(native(tmp_path, scans="t_s,robot,sensor,id,flight_ms,sine\n0.2,rover,sonar,7,25,0.3\n"))
    assert log.sensor_columns == {("rover", "sonar"): ("flight_ms", "sine")}


@pytest.mark.parametrize(("separator", "name"), [("\t", "tabs"), ("|", "'|'"), (" ", "blanks")])
def test_a_file_separated_by_something_else_than_commas_is_told_so(separator: str, name: str, tmp_path: Path) -> None:
    native(tmp_path, scans=SCANS.replace(",", separator))
    with pytest.raises(LogError) as refused:
        open_log(tmp_path)
    assert str(refused.value) == (
        f"{tmp_path / 'scans.csv'}:1: the cells seem to be separated by {name}, expected commas or semicolons"
    )


def test_two_letters_that_changed_places_in_a_short_name_are_a_misspelt_robot(tmp_path: Path) -> None:
    controls = "t_s,robot,v_mps,w_radps\n0.1,bob,1,0\n0.2,bbo,1,0\n"
    scans = "t_s,robot,sensor,id,range_m,bearing_rad\n0.1,bob,lidar,7,4,0\n"
    with pytest.raises(LogError, match=r"controls.csv:3: robot 'bbo' is in no other file .*, expected 'bob'"):
        open_log(native(tmp_path, controls=controls, scans=scans))


@pytest.mark.parametrize(("name", "line"), [("controls.csv", 3), ("scans.csv", 3)])
def test_a_robot_that_is_named_in_one_file_alone_is_refused_however_it_is_called(
    name: str, line: int, tmp_path: Path
) -> None:
    controls = "t_s,robot,v_mps,w_radps\n0.1,rover,1,0\n0.2,rover,1,0\n"
    scans = "t_s,robot,sensor,id,range_m,bearing_rad\n0.1,rover,lidar,7,4,0\n0.2,rover,lidar,7,4,0\n"
    native(tmp_path, controls=controls, scans=scans)
    lines = (tmp_path / name).read_text().splitlines()
    lines[line - 1] = lines[line - 1].replace("rover", "jackal")
    (tmp_path / name).write_text("\n".join(lines) + "\n")
    told = f"{name}:{line}: robot 'jackal' is in no other file of the log, expected 'rover'; if both are robots, ask"
    with pytest.raises(LogError, match=re.escape(told)):
        open_log(tmp_path)
    assert open_log(tmp_path, robots=["rover", "jackal"]).robots == ("rover", "jackal")
    assert open_log(tmp_path, on_error="skip").robots == ("rover",)
    (tmp_path / "controls.csv").write_text(controls.replace("rover", "jackal"))
    (tmp_path / "scans.csv").write_text(scans)
    with pytest.raises(LogError, match=r"controls.csv:2: robot 'jackal' is in no other file"):
        open_log(tmp_path)
    (tmp_path / "controls.csv").unlink()
    assert open_log(tmp_path).robots == ("rover",)


def test_robots_in_one_file_alone_are_their_own_if_numbered_seen_true_or_asked_for(tmp_path: Path) -> None:
    def controls(*robots: str) -> str:
        return "t_s,robot,v_mps,w_radps\n" + "".join(f"0.1,{robot},1,0\n" for robot in robots)

    def scans(id_: str) -> str:
        return f"t_s,robot,sensor,id,range_m,bearing_rad\n0.1,rover_a,lidar,{id_},4,0\n"

    native(tmp_path, controls=controls("rover_a", "rover_b"), scans=scans("7"))
    with pytest.raises(LogError, match=r"controls.csv:3: robot 'rover_b' is in no other file .*, expected 'rover_a'"):
        open_log(tmp_path)
    assert open_log(tmp_path, robots=["rover_a", "rover_b"]).robots == ("rover_a", "rover_b")
    log = open_log(tmp_path, on_error="skip")
    assert (log.robots, len(log.skipped)) == (("rover_a",), 1)
    native(tmp_path, controls=controls("rover_a", "rover_b"), scans=scans("rover_b"))
    assert open_log(tmp_path).robots == ("rover_a", "rover_b")
    native(
        tmp_path,
        controls=controls("rover_a", "rovers"),
        scans=scans("7"),
        truth="t_s,robot,x_m,y_m,theta_rad\n0,rovers,1,2,0\n",
    )
    assert open_log(tmp_path).robots == ("rover_a", "rovers")
    (tmp_path / "truth.csv").unlink()
    native(tmp_path, controls=controls("rover_1", "rover_2"), scans=scans("7").replace("rover_a", "rover_1"))
    assert open_log(tmp_path).robots == ("rover_1", "rover_2")


OTHER_FILES = {
    "controls.csv": ("t_s,robot,v_mps,w_radps\n0.1,r,nan,0\n", 2, "v_mps is 'nan'"),
    "controls.csv without values": ("t_s,robot,v_mps,w_radps\n0.1,r,,\n", 2, "no value in the row"),
    "controls.csv with negative noise": ("t_s,robot,v_mps,cov_00\n0.1,r,1,-1\n", 2, "positive semidefinite"),
    "fixes.csv": ("t_s,robot,x_m,y_m,cov_xx,cov_xy,cov_yy\n0.1,r,1,2,1,0,\n", 2, "cov_xx, cov_xy"),
    "fixes.csv without noise": ("t_s,robot,x_m,y_m\n0.1,r,1,2\n", 1, "no column of noise"),
    "fixes.csv with an empty noise": ("t_s,robot,x_m,y_m,sigma_x_m,sigma_y_m\n0.1,r,1,2,,\n", 2, "no noise"),
    "truth.csv": ("t_s,robot,x_m,y_m,theta_rad\n0.1,r,1,2,x\n", 2, "theta_rad is 'x'"),
    "truth.csv with a time twice": ("t_s,robot,x_m,y_m,theta_rad\n1,r,1,2,0\n1,r,1,2,0\n", 3, "increasing times"),
    "truth.csv with half a pose": ("t_s,robot,x_m,y_m\n1,r,1,2\n", 1, "theta_rad"),
    "truth.csv with a bad quaternion": (
        "t_s,robot,x_m,y_m,z_m,qx,qy,qz,qw\n1,r,0,0,0,0,0,0,2\n",
        2,
        "quaternion has length 2",
    ),
    "landmarks.csv": ("id,x_m,y_m\n1,2,3\n1,4,5\n", 3, "already"),
    "landmarks.csv without id": ("id,x_m,y_m\n,2,3\n", 2, "id is empty"),
    "landmarks.csv with a typo": ("id,x_m,y_n\n1,2,3\n", 1, "did you mean 'y_m'"),
    "gps.csv": ("t_s,robot,x_m,y_m,antenna_x_m,antenna_y_m\n1,r,0,0,1,1\n2,r,0,0,1,2\n", 3, "antenna"),
}


@pytest.mark.parametrize("what", OTHER_FILES)
def test_every_other_file_is_checked_too(what: str, tmp_path: Path) -> None:
    text, line, value = OTHER_FILES[what]
    name = what.split(" ", maxsplit=1)[0]
    native(tmp_path, **{name.removesuffix(".csv"): text})
    with pytest.raises(LogError) as refused:
        open_log(tmp_path)
    assert str(refused.value).startswith(f"{tmp_path / name}:{line}: ")
    assert value in str(refused.value)


def test_a_file_cut_anywhere_inside_a_row_is_refused(tmp_path: Path) -> None:
    whole = SCANS.rstrip("\n")
    row = whole.rindex("\n") + 1
    for end in range(row + 1, row + whole[row:].rindex(",") + 1):
        native(tmp_path, scans=whole[:end])
        with pytest.raises(LogError, match=r"scans\.csv:3: "):
            open_log(tmp_path)


def test_with_skip_a_bad_row_is_left_out_of_its_scan_and_listed(tmp_path: Path) -> None:
    text = f"{HEAD}\n{GOOD}\n0.2,rover,lidar,7,nan,0.3\n0.2,rover,lidar,8,4,0.3\n0.3,rover,lidar,8,-4,0.3\n"
    log = open_log(native(tmp_path, scans=text), on_error="skip")
    scans = [event for event in log if isinstance(event, Scan)]
    assert [(scan.t_ns, scan.ids) for scan in scans] == [(100_000_000, (7,)), (200_000_000, (8,))]
    assert "scans.csv:3: range_m is 'nan'" in log.skipped[0]
    assert "scans.csv:5: range_m is -4, expected a range of at least 0" in log.skipped[1]
    assert [records_of(line) for line in log.skipped] == [1, 1]


def test_a_byte_that_is_not_text_is_refused(tmp_path: Path) -> None:
    native(tmp_path)
    (tmp_path / "scans.csv").write_bytes(HEAD.encode() + b"\n\xff\xfe")
    with pytest.raises(LogError, match="not text"):
        open_log(tmp_path)


def test_a_file_whose_name_is_nearly_one_of_a_log_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "log"
    folder.mkdir()
    (folder / "controls.csv").write_text("t_s,robot,v_mps,w_radps\n0,rover,1,0\n")
    (folder / "scan.csv").write_text(f"{HEAD}\n{GOOD}\n")
    (folder / "notes.csv").write_text("anything\n")
    with pytest.raises(LogError, match=r"scan\.csv: a file of this name is not read, expected scans\.csv"):
        open_log(folder)
    (folder / "scan.csv").rename(folder / "scans.csv")
    assert len(open_log(folder).events) == 2


@pytest.mark.parametrize("kind", ["a folder", "a pipe", "a link to itself"])
def test_a_table_that_is_no_file_is_refused_with_one_line(kind: str, tmp_path: Path) -> None:
    scans = (native(tmp_path) / "scans.csv").resolve()
    scans.unlink(missing_ok=True)
    if kind == "a folder":
        scans.mkdir()
    elif kind == "a pipe":
        os.mkfifo(scans)
    else:
        scans.symlink_to(scans)
    with pytest.raises(LogError, match=r"scans.csv: not a file, expected a table"):
        open_log(scans.parent)


@pytest.mark.parametrize(
    ("column", "angles", "message"),
    [
        (
            "bearing_rad",
            "90 -45 10 3",
            "bearing_rad: 3 of 4 numbers are beyond 2 pi, expected radians; degrees are the col",
        ),
        (
            "bearing_deg",
            "3.14 -3.13 1 0",
            "bearing_deg: all 4 numbers are within pi and reach it, expected degrees; radia",
        ),
    ],
)
def test_directions_that_contradict_the_unit_of_their_column_are_refused(
    column: str, angles: str, message: str, tmp_path: Path
) -> None:
    rows = [f"0.{n},rover,lidar,{n},4,{angle}\n" for n, angle in enumerate(angles.split())]
    text = f"t_s,robot,sensor,id,range_m,{column}\n{''.join(rows)}"
    with pytest.raises(LogError, match=rf"scans\.csv:1: {message}"):
        open_log(native(tmp_path, scans=text))
    assert len(open_log(native(tmp_path, scans=text.replace("90", "0.9").replace("3.1", "31").replace("-45", "1"))))


def test_a_column_of_a_user_s_sensor_may_begin_like_one_of_kalmark(tmp_path: Path) -> None:
    text = "t_s,robot,sensor,id,bearing_px\n0.1,rover,line,7,320\n"
    with pytest.raises(LogError, match="column 'bearing_px' is unknown, expected bearing_rad"):
        open_log(native(tmp_path, scans=text))

    @km.register("sensor", "line_camera_of_a_test")
    class LineCamera:
        """A line camera."""

        columns = ("bearing_px",)

    log = open_log(native(tmp_path, scans=text))
    assert log.sensor_columns[("rover", "line")] == LineCamera.columns
