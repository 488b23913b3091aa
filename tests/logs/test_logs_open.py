"""`open_log`: formats are recognised, robots and times selected; trajectories interpolated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalmark.config import open_run
from kalmark.errors import LogError
from kalmark.events import Control, Scan
from kalmark.logs import Trajectory, open_log
from kalmark.logs.source import records_of

CONTROLS = "t_s,robot,v_mps,w_radps\n" + "".join(f"{t},{r},1,0\n" for t in range(5, 10) for r in ("a", "b"))
SCANS = "t_s,robot,sensor,id,range_m,bearing_rad\n6,a,s,1,4,0\n6,a,s,b,5,0\n7,a,s,b,5,0\n7,b,s,1,5,0\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "controls.csv").write_text(CONTROLS)
    (tmp_path / "scans.csv").write_text(SCANS)
    return tmp_path


def test_a_native_log_is_recognised_by_its_folder_or_a_file_in_it(folder: Path) -> None:
    assert open_log(folder).robots == open_log(folder / "controls.csv").robots == ("a", "b")
    assert open_log(str(folder), "native").format == "native"


def test_events_come_in_the_one_order(folder: Path) -> None:
    log = open_log(folder)
    assert [(e.t_ns, type(e).__name__, e.robot) for e in log][2:5] == [
        (6_000_000_000, "Control", "a"),
        (6_000_000_000, "Control", "b"),
        (6_000_000_000, "Scan", "a"),
    ]


def test_robots_that_were_not_asked_for_are_left_out_with_their_observations(folder: Path) -> None:
    log = open_log(folder, robots=["a"])
    assert log.robots == ("a",) and {event.robot for event in log} == {"a"}
    assert [scan.ids for scan in log if isinstance(scan, Scan)] == [(1,)]
    assert log.skipped == [f"{folder}: 2 observations of b, which was not asked for"]
    assert [records_of(line) for line in log.skipped] == [2]
    assert list(log.sensor_columns) == [("a", "s")]


def test_times_are_selected_from_the_first_event_on(folder: Path) -> None:
    log = open_log(folder, from_s=1, to_s=2.5)
    assert {event.t_ns for event in log} == {6_000_000_000, 7_000_000_000}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"robots": ["c"]}, "no robot 'c', expected one of a, b"),
        ({"from_s": 100}, "no event from 100 to None s, expected times within 0 to 4"),
        ({"from_s": float("nan")}, "from_s is nan"),
        ({"to_s": -1}, "to_s is -1"),
        ({"bearing_shift_s": 0.1}, "'bearing_shift_s' is unknown to native, expected origin"),
        ({"on_error": "ignore"}, "on_error is 'ignore', expected one of raise, skip"),
        ({"format": "nativ"}, "expected one of native, carmen, .*did you mean 'native'"),
        ({"format": "mrclam"}, "not a log of format mrclam, expected a folder with Barcodes.dat"),
    ],
)
def test_a_wrong_argument_says_what_was_expected(folder: Path, arguments: dict, message: str) -> None:
    with pytest.raises(LogError, match=message):
        open_log(folder, **arguments)


def test_an_unknown_folder_lists_the_formats_and_the_logs_below_it(folder: Path, tmp_path: Path) -> None:
    above = tmp_path / "above"
    above.mkdir()
    with pytest.raises(LogError, match=r"no known log format, expected one of native: .*; dlr: .*; mrclam: "):
        open_log(above)
    folder_below = above / "one"
    folder_below.mkdir()
    (folder_below / "controls.csv").write_text(CONTROLS)
    with pytest.raises(LogError, match="it holds the logs one"):
        open_log(above)


def test_a_log_that_is_nowhere_says_where_it_was_looked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KALMARK_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("KALMARK_ORACLE", str(tmp_path / "oracle"))
    monkeypatch.setenv("KALMARK_CACHE", str(tmp_path / "cache"))
    with pytest.raises(LogError) as missing:
        open_log("dlr")
    for place in (Path.cwd(), tmp_path / "data", tmp_path / "oracle", tmp_path / "cache"):
        assert str(place / "dlr") in str(missing.value)
    assert "kalmark data fetch dlr" in str(missing.value)


def test_a_relative_path_is_found_in_the_data_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("KALMARK_DATA", str(folder.parent))
    assert len(open_log(folder.name)) == 13


SECOND = 1_000_000_000
PATH = Trajectory(np.array([0, 1, 2, 5]) * SECOND, np.array([[0, 0, 3.0], [1, 2, -3.0], [2, 2, -3.0], [5, 2, 0.0]]))


def test_poses_are_interpolated_along_the_shorter_arc() -> None:
    x, y, theta = PATH.at(SECOND // 2, max_gap_s=1.0)
    assert (x, y) == (0.5, 1.0)
    assert abs(abs(theta) - np.pi) < 1e-12


def test_poses_are_nan_outside_and_inside_a_gap_but_not_at_its_ends() -> None:
    poses = PATH.at(np.array([-1, 0, 2, 3, 5, 6]) * SECOND, max_gap_s=1.0)
    assert np.isnan(poses[[0, 3, 5]]).all()
    assert np.array_equal(poses[[1, 2, 4]], PATH.poses[[0, 2, 3]])
    assert np.isfinite(PATH.at(3 * SECOND, max_gap_s=3.0)).all()


@given(st.floats(-3, 3), st.floats(0.01, 0.99), st.booleans())
def test_quaternions_turn_steadily_about_one_axis(angle: float, a: float, flip: bool) -> None:
    axis = np.array([0.6, 0.0, 0.8])

    def pose(turn: float) -> np.ndarray:
        return np.concatenate([[0, 0, 0], np.sin(turn / 2) * axis, [np.cos(turn / 2)]])

    end = pose(angle)
    end[3:] *= -1 if flip else 1
    path = Trajectory(np.array([0, SECOND]), np.array([pose(0), end]))
    got = path.at(round(a * SECOND), max_gap_s=1.0)
    want = pose(angle * round(a * SECOND) / SECOND)
    assert min(abs(got[3:] - want[3:]).max(), abs(got[3:] + want[3:]).max()) < 1e-7


@pytest.mark.parametrize(
    ("t_ns", "poses", "message"),
    [
        ([1, 1], [[0, 0, 0], [0, 0, 0]], "expected increasing times"),
        ([1], [[0, 0]], r"expected \(N,\) and \(N, 3\|7\)"),
        ([], np.empty((0, 3)), "expected"),
        ([1], [[0, 0, np.nan]], "not finite"),
    ],
)
def test_a_trajectory_that_is_none_is_refused(t_ns: list[int], poses: list[list[float]], message: str) -> None:
    with pytest.raises(LogError, match=message):
        Trajectory(np.array(t_ns), np.array(poses))


def folder_of(path: Path) -> Path:
    """Write a log with controls and scans of two robots, and return its folder."""
    (path / "controls.csv").write_text("t_s,robot,v_mps,w_radps\n0,a,1,10\n0,b,1,10\n2,a,1,20\n")
    (path / "scans.csv").write_text(
        "t_s,robot,sensor,id,range_m,bearing_rad,cov_00,cov_01,cov_11\n"
        "1,a,laser,1,2000,0.5,100,0.2,0.01\n1,b,laser,1,2000,0.5,100,0.2,0.01\n1,a,sonar,1,3000,0.25,100,0.2,0.01\n"
    )
    return path


def test_factors_and_shifts_correct_columns_and_times_of_robots_and_sensors(tmp_path: Path) -> None:
    path = folder_of(tmp_path)
    factors = {"range_m": 1e-3, "a": {"w_radps": 0.1, "laser": {"bearing_rad": -1.0}}}
    log = open_log(path, factors=factors, shift_s={"laser": 0.25, "b": {"laser": 0.5}})
    scans = {(e.robot, e.sensor): e for e in log if isinstance(e, Scan)}
    np.testing.assert_allclose(scans["a", "laser"].y, [[2.0, -0.5]])
    np.testing.assert_allclose(scans["b", "laser"].y, [[2.0, 0.5]])
    np.testing.assert_allclose(scans["a", "sonar"].y, [[3.0, 0.25]])
    assert scans["a", "laser"].cov is not None
    np.testing.assert_allclose(scans["a", "laser"].cov[..., 0, :], [[1e-4, -2e-4]])
    assert [scans[key].t_s for key in (("a", "laser"), ("b", "laser"), ("a", "sonar"))] == [1.25, 1.75, 1.0]
    controls = [(e.robot, *e.u) for e in log if isinstance(e, Control)]
    assert controls == [("a", 1.0, 1.0), ("b", 1.0, 10.0), ("a", 1.0, 2.0)]
    assert open_log(path, factors={"t_s": 1e-3}).events[-1].t_ns == 2_000_000


@pytest.mark.parametrize(
    ("option", "told"),
    [
        ({"factors": {"bearing_deg": 2.0}}, "factors.bearing_deg is of nothing in this log.*bearing_rad"),
        ({"factors": {"c": {"range_m": 2.0}}}, "factors.c.range_m is of nothing"),
        ({"factors": {"range_m": 0.0}}, "expected factors that are not zero"),
        ({"shift_s": {"lasr": 2.0}}, "shift_s.lasr is of nothing in this log.*did you mean 'laser'"),
        ({"shift_s": {"laser": "soon"}}, "shift_s.laser is 'soon', expected a finite number"),
    ],
)
def test_a_correction_of_nothing_is_refused(tmp_path: Path, option: dict[str, Any], told: str) -> None:
    with pytest.raises(LogError, match=told):
        open_log(folder_of(tmp_path), **option)


def test_an_override_for_one_robot_is_laid_over_each_of_the_file(tmp_path: Path) -> None:
    folder_of(tmp_path)
    config = tmp_path / "run.yaml"
    sensor = "{type: range_bearing, sigma_range_m: 5}"
    config.write_text(f"log: {{path: .}}\nrobots: {{each: {{sensors: {{laser: {sensor}, sonar: {sensor}}}}}}}\n")
    made, _ = open_run(config, None, ["robots.b.sensors.laser.sigma_range_m=7", "robots.b.gaps=ignore"])
    assert made.robots["b"].sensors["laser"].sigma_range_m == 7  # type: ignore[union-attr]
    assert made.robots["b"].sensors["sonar"] == made.robots["each"].sensors["sonar"]
    assert made.robots["each"].sensors["laser"].sigma_range_m == 5  # type: ignore[union-attr]
