"""Positions on the globe in native logs: one tangent plane for readings, fixes, truth and known maps."""

from pathlib import Path

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam, open_run
from kalmark.errors import ConfigError, LogError
from kalmark.logs import open_log
from ros_bags import ORIGIN, geodetic

PLACES = np.array([[0.0, 0.0, 0.0], [120.0, -35.0, 4.0], [-900.0, 2500.0, -7.0]])


def rows(header: str, *cells: str) -> str:
    return "\n".join([header, *cells, ""])


def on_globe(p: np.ndarray, height: bool = False) -> str:
    return ",".join(repr(float(value)) for value in geodetic(p)[: 3 if height else 2])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A log whose receiver, fixes, truth and landmarks are on the globe."""
    readings = [f"{t},car,gps,{on_globe(p)},0.5,0.5" for t, p in enumerate(PLACES)]
    (tmp_path / "measurements.csv").write_text(rows("t_s,robot,sensor,lat_deg,lon_deg,sigma_x_m,sigma_y_m", *readings))
    fixes = [f"{t},car,{on_globe(p, height=True)},1,1,2" for t, p in enumerate(PLACES)]
    header = "t_s,robot,lat_deg,lon_deg,height_m,sigma_x_m,sigma_y_m,sigma_z_m"
    (tmp_path / "fixes.csv").write_text(rows(header, *fixes))
    truth = [f"{t},car,{on_globe(p)},0.1" for t, p in enumerate(PLACES)]
    (tmp_path / "truth.csv").write_text(rows("t_s,robot,lat_deg,lon_deg,theta_rad", *truth))
    (tmp_path / "landmarks.csv").write_text(rows("id,lat_deg,lon_deg", f"7,{on_globe(PLACES[1])}"))
    return tmp_path


def test_positions_on_the_globe_are_metres_of_one_origin(folder: Path) -> None:
    log = open_log(folder, origin=ORIGIN)
    scans = np.array([event.y[0] for event in log if isinstance(event, km.Scan)])
    np.testing.assert_allclose(scans, PLACES[:, :2], atol=5e-3)  # without their height: that of the origin
    np.testing.assert_allclose([event.y for event in log if isinstance(event, km.Fix)], PLACES, atol=1e-6)
    np.testing.assert_allclose(log.truth["car"].poses[:, :2], PLACES[:, :2], atol=5e-3)
    np.testing.assert_allclose(log.landmarks[7], PLACES[1, :2], atol=1e-3)
    assert log.sensor_columns["car", "gps"] == ("x_m", "y_m")
    np.testing.assert_array_equal(log.origin, ORIGIN)


def test_the_origin_is_the_first_position_unless_it_is_given(folder: Path) -> None:
    log = open_log(folder)
    assert log.origin is not None
    np.testing.assert_allclose(log.origin, geodetic(PLACES[0]), atol=1e-9)


def test_a_known_map_counts_from_the_origin_of_the_log(tmp_path: Path) -> None:
    (tmp_path / "survey.csv").write_text(rows("id,lat_deg,lon_deg", f"7,{on_globe(PLACES[1])}"))
    (tmp_path / "controls.csv").write_text(rows("t_s,robot,v_mps,w_radps", "0,car,1,0"))
    config = tmp_path / "config.yaml"
    config.write_text("log: {path: ., origin: %s}\nmap: {known: survey.csv}\n" % [*map(float, ORIGIN)])
    slam = build_slam(*open_run(config))
    np.testing.assert_allclose(slam.mean(7), PLACES[1, :2], atol=1e-3)
    config.write_text("log: {path: .}\nmap: {known: survey.csv}\n")
    with pytest.raises(ConfigError, match=r"the log has no origin on the globe, expected log\.origin"):
        build_slam(*open_run(config))


@pytest.mark.parametrize(
    ("header", "row", "message"),
    [
        (
            "lat_deg,lon_deg",
            "95,11",
            r"measurements.csv:2: latitude and longitude are \[95.0, 11.0\], expected degrees",
        ),
        ("lat_deg,lon_deg", "nan,11", r"measurements.csv:2: lat_deg is 'nan', expected a finite number"),
        ("lat_deg,lon_deg", "48,", r"measurements.csv:2: lon_deg is '', expected a finite number"),
        ("lat_deg,height_m", "48,11", r"measurements.csv:1: no column lon_deg, expected lat_deg, lon_deg"),
        ("lon_deg,x_m", "48,11", r"measurements.csv:1: no column lat_deg"),
        (
            "lat_deg,lon_deg,x_m",
            "48,11,3",
            r"measurements.csv:1: columns lat_deg and x_m, expected one of them in a file: scans",
        ),
    ],
)
def test_what_is_no_position_on_the_globe_is_refused(tmp_path: Path, header: str, row: str, message: str) -> None:
    (tmp_path / "measurements.csv").write_text(rows(f"t_s,robot,sensor,{header}", f"0,car,gps,{row}"))
    with pytest.raises(LogError, match=message):
        open_log(tmp_path)


def test_a_height_of_a_robot_in_the_plane_is_refused_with_what_to_leave_out(tmp_path: Path) -> None:
    (tmp_path / "measurements.csv").write_text(rows("t_s,robot,sensor,lat_deg,lon_deg,height_m", "0,car,gps,48,11,500"))
    config = tmp_path / "config.yaml"
    config.write_text("log: {path: .}\nrobots: {car: {sensors: {gps: {type: gps}}}}\n")
    with pytest.raises(LogError, match="expected x_m, y_m of its type gps; leave z_m out, on the globe height_m"):
        build_slam(*open_run(config))


@pytest.mark.parametrize("origin", [[91, 0, 0], [1], "here", [1, float("nan"), 0], 3])
def test_an_origin_that_is_none_is_refused(folder: Path, origin: object) -> None:
    with pytest.raises(LogError, match=r"log option origin is .*, expected .latitude_deg, longitude_deg, height_m."):
        open_log(folder, origin=origin)
