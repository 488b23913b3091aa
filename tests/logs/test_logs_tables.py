"""Tables of other kinds: semicolons, other units, Parquet, and tables in memory, with the checks of CSV."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import KalmarkError, LogError
from kalmark.events import Scan
from kalmark.logs import Log, log_from, open_log, stream_log, write_native
from kalmark.logs.progress import track
from native_logs import CONTROLS, SCANS, native

FRAMES: dict[str, Any] = {
    "controls": {"t_s": [0.1, 0.2], "robot": "rover", "v_mps": np.array([0.5, 0.5]), "w_radps": 0.02},
    "scans": {"t_s": [0.2, 0.2], "robot": ["rover"] * 2, "sensor": "lidar", "id": [7, None],
              "range_m": [4.2, 3.1], "bearing_rad": np.array([0.3, -1.0])},
}  # fmt: skip


def same(a: Log, b: Log) -> bool:
    """Return whether two logs have the same events to the last bit."""
    return len(a) == len(b) and all(
        type(x) is type(y) and x.t_ns == y.t_ns and x.robot == y.robot
        and (x.y if isinstance(x, Scan) else x.u).tobytes() == (y.y if isinstance(y, Scan) else y.u).tobytes()
        and getattr(x, "ids", ()) == getattr(y, "ids", ())
        for x, y in zip(a, b, strict=True)
    )  # fmt: skip


# ------------------------------------------------------------------ CSV
def semicolons(text: str) -> str:
    return text.replace(",", ";").replace(".", ",")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_semicolons_decimal_commas_and_byte_order_marks_are_read(encoding: str, tmp_path: Path) -> None:
    plain = open_log(native(tmp_path))
    for name, text in (("controls", CONTROLS), ("scans", SCANS)):
        (tmp_path / f"{name}.csv").write_text(semicolons(text), encoding=encoding)
    assert same(plain, open_log(tmp_path))


@pytest.mark.parametrize("value", ["1.234,5", "1,234,5", "4,2e", "nan"])
def test_a_number_with_points_and_commas_is_refused(value: str, tmp_path: Path) -> None:
    native(tmp_path, scans=semicolons(SCANS).replace("4,2", value, 1))
    with pytest.raises(LogError, match=f"scans.csv:2: range_m is '{value}', expected a finite number"):
        open_log(tmp_path)


def test_a_decimal_comma_in_a_file_of_commas_is_a_cell_too_many(tmp_path: Path) -> None:
    native(tmp_path, scans=SCANS.replace("4.2", "4,2"))
    with pytest.raises(LogError, match=r"scans.csv:2: 7 cells, expected 6"):
        open_log(tmp_path)


UNITS = {
    ("controls", "v_mps", "v_kmh"): 3.6, ("controls", "w_radps", "w_degps"): np.degrees(1),
    ("scans", "range_m", "range_mm"): 1e3, ("scans", "range_m", "range_cm"): 1e2,
    ("scans", "range_m", "range_km"): 1e-3, ("scans", "bearing_rad", "bearing_deg"): np.degrees(1),
    ("scans", "t_s", "t_ms"): 1e3, ("controls", "t_s", "t_us"): 1e6, ("controls", "t_s", "t_ns"): 1e9,
}  # fmt: skip


@pytest.mark.parametrize(("file", "column", "given"), UNITS)
def test_a_column_in_another_unit_that_its_name_states_is_converted(
    file: str, column: str, given: str, tmp_path: Path
) -> None:
    plain = open_log(native(tmp_path))
    path, factor = tmp_path / f"{file}.csv", UNITS[file, column, given]
    head, *rows = [line.split(",") for line in path.read_text().replace(" ", "").splitlines()]
    k = head.index(column)
    head[k] = given
    for row in rows:
        row[k] = f"{round(float(row[k]) * factor, 9):.9g}"
    path.write_text("\n".join(",".join(row) for row in [head, *rows]) + "\n")
    log = open_log(tmp_path)
    assert [event.t_ns for event in log] == [event.t_ns for event in plain]
    for a, b in zip(plain, log, strict=True):
        np.testing.assert_allclose(*(e.y if isinstance(e, Scan) else e.u for e in (a, b)), rtol=1e-8)
    assert log.control_columns == plain.control_columns and log.sensor_columns == plain.sensor_columns


def test_an_inertial_unit_may_be_in_the_units_of_its_data_sheet(tmp_path: Path) -> None:
    head = "t_s,robot,wx_dps,wy_dps,wz_dps,ax_g,ay_mg,az_g\n"
    log = open_log(native(tmp_path, controls=f"{head}0,rover,0,90,0,0.5,20,1\n"))
    (control,) = (event for event in log if not isinstance(event, Scan))
    np.testing.assert_allclose(control.u, [0, np.pi / 2, 0, 4.903325, 0.196133, 9.80665], rtol=1e-12)
    assert log.control_columns["rover"][3:] == ("ax_mps2", "ay_mps2", "az_mps2")


def test_noise_in_another_unit_is_converted_too_and_messages_name_the_column_as_it_is(tmp_path: Path) -> None:
    head = "t_ms,robot,sensor,id,range_mm,bearing_deg,sigma_range_mm,sigma_bearing_deg\n"
    log = open_log(native(tmp_path, scans=f"{head}200.25,rover,lidar,7,4200,90,10,1\n"))
    scan = next(event for event in log if isinstance(event, Scan))
    assert scan.t_ns == 200_250_000
    np.testing.assert_allclose(scan.y, [[4.2, np.pi / 2]])
    np.testing.assert_allclose(scan.cov, [np.diag([1e-4, np.radians(1) ** 2])])
    for row, said in (
        ("200,rover,lidar,7,-1,90,10,1", "scans.csv:2: range_mm is -1, expected a range of at least 0"),
        ("200,rover,lidar,7,1e13,90,10,1", "range_mm is '1e13', expected at most"),
        ("200,rover,lidar,7,x,90,10,1", "range_mm is 'x', expected a finite number"),
        ("x,rover,lidar,7,1,90,10,1", "t_ms is 'x', expected a finite number"),
        ("200,rover,lidar,7,1,90,10,1\n100,rover,lidar,7,1,90,10,1", "scans.csv:3: time 100 ms after 200 ms of rover"),
    ):
        native(tmp_path, scans=f"{head}{row}\n")
        with pytest.raises(LogError, match=said):
            open_log(tmp_path)
    native(tmp_path, scans="t_s,robot,sensor,id,range_m,range_mm,bearing_rad\n1,rover,lidar,7,1,1,1\n")
    with pytest.raises(LogError, match="columns range_m and range_mm are both range_m"):
        open_log(tmp_path)


# ------------------------------------------------------------------ Parquet
def test_a_log_as_parquet_is_the_same_to_the_last_bit(tmp_path: Path) -> None:
    log = open_log(native(tmp_path))
    folder = write_native(log, tmp_path / "parquet", parquet=True)
    assert sorted(file.name for file in folder.iterdir()) == ["controls.parquet", "scans.parquet"]
    assert same(log, open_log(folder)) and same(log, open_log(folder / "scans.parquet"))
    (folder / "scans.csv").write_text(SCANS)
    with pytest.raises(LogError, match=r"scans.parquet: beside scans.csv, expected one of them"):
        open_log(folder)


@pytest.mark.parametrize("content", [b"", b"PAR1", b"PAR1" + bytes(100) + b"PAR1", b"t_s,robot\n"])
def test_what_is_no_parquet_gets_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "scans.parquet").write_bytes(content)
    with pytest.raises(LogError, match=r"scans\.parquet: not a file of Parquet that can be read") as error:
        open_log(tmp_path)
    assert "\n" not in str(error.value)


def test_damaged_parquet_gets_one_line(tmp_path: Path) -> None:
    folder = write_native(open_log(native(tmp_path)), tmp_path / "parquet", parquet=True)
    random, file = np.random.default_rng(0), folder / "scans.parquet"
    content = np.frombuffer(file.read_bytes(), np.uint8)
    for n in range(200):
        odd = content.copy()
        odd[random.integers(0, len(odd), 1 + n % 9)] = random.integers(0, 256, 1 + n % 9)
        file.write_bytes(odd.tobytes())
        try:
            open_log(folder, on_error="skip")
        except KalmarkError as error:
            assert "\n" not in str(error)


# ------------------------------------------------------------------ in memory
def test_tables_in_memory_are_the_log_of_the_files(tmp_path: Path) -> None:
    log = open_log(native(tmp_path))
    assert same(log, log_from(**FRAMES)) and km.log_from is log_from
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    frames = {name: pandas.DataFrame(table) for name, table in FRAMES.items()}
    assert frames["scans"]["id"].dtype == float  # as pandas makes them beside an empty cell
    assert same(log, log_from(**frames))
    read = {name: pandas.read_csv(tmp_path / f"{name}.csv", skipinitialspace=True) for name in FRAMES}
    assert same(log, log_from(**read))
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    assert same(log, log_from(**{name: pyarrow.Table.from_pandas(frame) for name, frame in frames.items()}))


def test_tables_in_memory_run_and_select_as_files_do() -> None:
    log = log_from(**FRAMES, describes={"robots": {"rover": {}}}, name="mine", ids="hidden", from_s=0.05)
    assert log.name == "mine" and log.path is None and [type(e).__name__ for e in log] == ["Control", "Scan"]
    assert log.events[-1].ids == (None, None) and log.describes
    rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    run = km.record(km.Slam([rover]), log_from(**FRAMES), progress=False)
    assert run.evaluate()["observations"] == 2


@pytest.mark.parametrize(
    ("table", "changed", "said"),
    [
        ("scans", {"range_m": [4.2, -1.0]}, "scans row 2: range_m is -1.0, expected a range of at least 0"),
        ("scans", {"range_m": [np.inf, 1.0]}, "scans row 1: range_m is 'inf', expected a finite number"),
        ("scans", {"range_m": [np.nan, 1.0]}, "scans row 2: range_m is 1.0, expected an empty cell as in"),
        ("scans", {"range_m": [True, 1.0]}, "scans row 1: range_m is 'True', expected a finite number"),
        ("scans", {"range_m": [10**400, 1.0]}, "scans row 1: range_m is .*expected a finite number"),
        ("scans", {"id": [7, 7]}, "scans row 2: id 7 is in this scan already"),
        ("scans", {"t_s": [0.2, 0.1]}, "scans row 2: time 0.1 s after 0.2 s of rover"),
        ("scans", {"range_m": [1.0]}, "scans: column 'range_m' has 1 values, expected 2 as 't_s' has"),
        ("scans", {"range": [1.0, 2.0]}, "scans: column 'range' is unknown, expected range_m, in metres"),
        ("controls", {"v_mps": ["a", 1]}, "controls row 1: v_mps is 'a', expected a finite number"),
        ("controls", {3: [1, 2]}, "controls: got columns .*expected a frame or a mapping with named columns"),
    ],
)
def test_a_bad_table_in_memory_is_named_by_its_row(table: str, changed: Any, said: str) -> None:
    with pytest.raises(LogError, match=said) as error:
        log_from(**FRAMES | {table: FRAMES[table] | changed})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("table", [5, "scans", [1, 2], {}, {"t_s": []}, np.zeros((2, 2)), None])
def test_what_is_no_table_gets_one_line(table: Any) -> None:
    with pytest.raises(LogError, match="expected"):
        log_from(scans=table)


def test_tables_in_other_units_are_converted_too() -> None:
    scans = {k: v for k, v in FRAMES["scans"].items() if k not in ("range_m", "t_s")}
    log = log_from(controls=FRAMES["controls"], scans=scans | {"range_mm": [4200, 3100], "t_ns": [200_000_000] * 2})
    np.testing.assert_allclose(log.events[-1].y[:, 0], [4.2, 3.1])
    assert log.events[-1].t_ns == 200_000_000


# ------------------------------------------------------------------ large ones
MANY = """
import sys
from pathlib import Path
from kalmark.logs import stream_log

def peak() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

folder, rows = Path(sys.argv[1]), int(sys.argv[2])
with (folder / "controls.csv").open("w") as file:
    file.write("t_s,robot,v_mps,w_radps\\n")
    file.writelines(f"{k},rover,0.123456789,0.987654321\\n" for k in range(rows))
with (folder / "scans.csv").open("w") as file:
    file.write("t_s,robot,sensor,id,range_m,bearing_rad\\n")
    file.writelines(f"{k // 2},rover,lidar,{k % 2},1,1\\n" for k in range(rows))
events = stream_log(folder)
next(events)
before = peak()
print(1 + sum(1 for _ in events), peak() - before)
"""


def test_the_events_of_a_long_log_are_read_one_by_one_in_little_memory(tmp_path: Path) -> None:
    if not Path("/proc/self/status").is_file():
        pytest.skip("only Linux tells how much memory was used")
    done = subprocess.run([sys.executable, "-c", MANY, tmp_path, "60000"], capture_output=True, text=True, check=True)
    count, grown_kb = map(int, done.stdout.split())
    assert count == 90_000 and grown_kb < 8000  # kept, they would have 30 MB


def test_events_read_one_by_one_are_those_of_the_log(tmp_path: Path) -> None:
    controls = "t_s,robot,v_mps,w_radps\n" + "".join(f"{t},{r},1,0\n" for t in range(4) for r in ("b", "a"))
    scans = "t_s,robot,sensor,id,range_m,bearing_rad\n" + "".join(
        f"{t / 2},{r},{s},{i},4,0\n" for t in range(6) for i in (1, 2) for r in ("b", "a") for s in ("t", "s")
    )
    fixes = "t_s,robot,x_m,y_m,sigma_x_m,sigma_y_m\n2,a,1,2,1,1\n"
    measurements = "t_s,robot,sensor,heading_rad\n1,a,compass,0.1\n1,b,compass,0.1\n"
    native(tmp_path, controls=controls, scans=scans, fixes=fixes, measurements=measurements)
    log, events = open_log(tmp_path), list(stream_log(tmp_path))
    assert list(map(str, log.events)) == list(map(str, events)) and len(events) == 8 + 24 + 1 + 2
    assert {event.robot for event in stream_log(tmp_path, robots="a")} == {"a"}
    folder = write_native(log, tmp_path / "parquet", parquet=True)
    assert list(map(str, stream_log(folder))) == list(map(str, open_log(folder)))


def test_rows_that_are_not_in_the_order_of_time_cannot_be_read_one_by_one(tmp_path: Path) -> None:
    controls = "t_s,robot,v_mps,w_radps\n1,a,1,0\n2,a,1,0\n1,b,1,0\n"
    (tmp_path / "controls.csv").write_text(controls)
    assert len(open_log(tmp_path)) == 3
    with pytest.raises(LogError, match=r"controls.csv: an event at 1.0+ s after one at 2.0+ s, expected rows in the"):
        list(stream_log(tmp_path))
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(LogError, match="not a log of format native"):
        stream_log(tmp_path / "a.txt")


def test_the_bar_of_a_long_file_tells_how_much_of_it_is_read(capsys: pytest.CaptureFixture[str]) -> None:
    at = iter(range(0, 1000, 10))
    assert list(track(range(5), "controls.csv", 1000, delay_s=-1, at=lambda: next(at))) == [0, 1, 2, 3, 4]
    assert "controls.csv" in capsys.readouterr().err
