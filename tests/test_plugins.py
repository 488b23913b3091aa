"""Plug-ins: a package of a user's adds a format, models and a verb; the core works without kalmark's own."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

import kalmark as km

OWN = '''
from pathlib import Path
from typing import Annotated

import kalmark as km
from kalmark.declare import Positive
from kalmark.logs.source import Format, Request, one_robot


@km.register("motion", "tram")
class Tram(km.motion.Unicycle):
    """Motion of a tram."""


def find(path: Path) -> Path | None:
    return path if path.suffix == ".tram" else None


def read(path: Path, request: Request, step_s: Annotated[Positive, "Time of a step."] = 1.0) -> km.Log:
    speeds = map(float, path.read_text().split())
    events = [km.Control(t_s=k * step_s, robot="tram", u=(v, 0.0)) for k, v in enumerate(speeds)]
    return one_robot("tram", path, request, "tram", events, ("v_mps", "w_radps"), {})


TRAM = Format("tram", "a file that ends in .tram", find, read)


def last_stop(log: Path) -> None:
    """Print the time of the last event of a log."""
    print(km.open_log(log).events[-1].t_ns)


def how_to_get(path: Path) -> str:
    return "wait for the next tram" if path.suffix == ".tram" else ""
'''
KEY = '''"""Stop at which the tram waits."""


def complete(tree):
    for sensor in tree.values["robots"]["each"]["sensors"].values():
        sensor.setdefault("sigma_range_m", 0.25)


def with_events(config, log):
    for name, sensor in config.robots["each"].sensors.items():
        if sensor.stop != "Main Square":
            raise config.error(("robots", "each", "sensors", name, "stop"), f"got {sensor.stop!r}, expected a stop")
    return log
'''
TICKETS = '''"""The table `tickets.csv` of native logs: t_s, robot, sensor, stops."""
from dataclasses import dataclass

from kalmark.events import Raw, fixed_seconds
from kalmark.logs.table import read_table


@dataclass(frozen=True, eq=False, kw_only=True)
class Ticket(Raw):
    stops: int


def read(path, request, note):
    def make(row):
        note(row)
        return Ticket(t_ns=row.t_ns, robot=row.robot, sensor=row.sensor, stops=int(row.text("stops")))

    return read_table(path, ("t_s", "robot", "sensor", "stops")).made(request, make, by_sensor=True)


def rows(log, folder):
    for e in log.events:
        if isinstance(e, Ticket):
            yield {"t_s": fixed_seconds(e.t_ns), "robot": e.robot, "sensor": e.sensor, "stops": e.stops}


def refuse_free(config, key, robot, log):
    if any(isinstance(e, Ticket) and not e.stops for e in log.events):
        raise config.error(("robots", key, "sensors"), "got a ticket of no stop, expected one of some")


def fits(kind):
    return kind == "range_bearing"


def values(given, folder, kind):
    return {"sigma_range_m": float((folder / given).read_text())}
'''
POINTS = """[kalmark.formats]
tram = trams:TRAM
broken = trams:NOTHING

[kalmark.models]
trams = trams

[kalmark.verbs]
last-stop = trams:last_stop

[kalmark.keys]
stop = stops

[kalmark.names]
Tram = trams:Tram
logs.TRAM = trams:TRAM

[kalmark.data]
trams = trams:how_to_get

[kalmark.tables]
tickets.csv = tickets

[kalmark.checks]
tickets = tickets:refuse_free

[kalmark.sheets]
fares = tickets
"""
AGAIN = "; expected it installed: pip install --force-reinstall --no-deps kalmark"
OUTSIDE = ("kalmark.bags", "kalmark.datasets", "kalmark.diagnosis", "kalmark.viewer", "kalmark.vision")
WITHOUT = f"""
import sys

class NotThere:
    def find_spec(self, name, path=None, target=None):
        if name in {OUTSIDE}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, NotThere())
"""
CORE = """
import kalmark as km
from kalmark.cli import main

assert main(["simulate", "cloister", "--out", "log", "--seed", "1", "--set", "steps=40"]) == 0
assert main(["run", "log/config.yaml", "--out", "run"]) == 0
assert main(["convert", "log", "copy"]) == 0
slam = km.Slam.load("run/map.kmk")
assert len(slam.landmarks()) > 5
assert len(km.open_log("copy").events) == len(km.open_log("log").events)
"""


def python(code: str, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=folder, check=False
    )


@pytest.fixture
def trams(tmp_path: Path) -> Path:
    """Return a folder with an installed package, as pip leaves one."""
    (tmp_path / "trams.py").write_text(OWN)
    (tmp_path / "stops.py").write_text(KEY)
    (tmp_path / "tickets.py").write_text(TICKETS)
    (tmp_path / "trams-1.dist-info").mkdir()
    (tmp_path / "trams-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: trams\nVersion: 1\n")
    (tmp_path / "trams-1.dist-info" / "entry_points.txt").write_text(POINTS)
    (tmp_path / "day.tram").write_text("1.0 2.0 1.5")
    return tmp_path


def test_a_package_adds_a_format_with_its_options_a_model_a_verb_and_names(
    trams: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (trams / "day.yaml").write_text("log: {path: day.tram, step_s: 2}\nrobots: {each: {motion: {type: tram}}}\n")
    code = """
import kalmark as km
from kalmark.cli import main
from kalmark.config import build_slam, open_run
from kalmark.logs import TRAM

config, log = open_run("day.yaml")
robot = build_slam(config, log).robots["tram"]
print(log.format, log.events[-1].t_ns, type(robot.motion) is km.Tram)
main(["last-stop", "day.tram"])
for options in ({"step_s": -1}, {"steps": 1}):
    try:
        km.open_log("day.tram", **options)
    except km.KalmarkError as error:
        print(error)
try:
    km.open_log("day.tram", "broken")
except km.KalmarkError as error:
    print(error)
try:
    km.open_log("night.tram")
except km.KalmarkError as error:
    print(TRAM.name, str(error).partition("; ")[2])
"""
    monkeypatch.setenv("KALMARK_DATA", str(trams))
    done = python(code, trams)
    assert done.stdout.splitlines() == [
        "tram 4000000000 True",
        "2000000000",
        "log option step_s is -1, expected a positive number",
        "log option 'steps' is unknown to tram, expected step_s; did you mean 'step_s'?",
        "log format is 'broken': 'broken' of trams:NOTHING cannot be loaded: module 'trams' has no attribute 'NOTHING'",
        "tram wait for the next tram",
    ], done.stderr


def test_a_package_adds_a_key_of_sensors(trams: Path) -> None:
    sensor = "{type: range_bearing, stop: %s}"
    tram = f"log: {{path: day.tram}}\nrobots: {{each: {{motion: {{type: tram}}, sensors: {{laser: {sensor}}}}}}}\n"
    (trams / "day.yaml").write_text(tram % "Main Square")
    (trams / "wrong.yaml").write_text(tram % "Station")
    code = """
from kalmark import KalmarkError
from kalmark.config import documentation, open_run

print(open_run("day.yaml")[0].robots["each"].sensors["laser"].sigma_range_m)
print("| `stop` | Stop at which the tram waits. |" in documentation.page())
try:
    open_run("wrong.yaml")
except KalmarkError as error:
    print(error)
"""
    done = python(code, trams)
    assert done.returncode == 0, done.stderr
    sigma, documented, wrong = done.stdout.splitlines()
    assert (sigma, documented) == ("0.25", "True")
    assert wrong.endswith("wrong.yaml:2:84: robots.each.sensors.laser.stop: got 'Station', expected a stop")


def test_a_package_adds_a_table_of_native_logs_a_check_of_its_raw_data_and_a_file_of_parameters(trams: Path) -> None:
    (trams / "log").mkdir()
    (trams / "log" / "controls.csv").write_text("t_s,robot,v_mps,w_radps\n0,r,1,0\n")
    (trams / "log" / "tickets.csv").write_text("t_s,robot,sensor,stops\n1,r,gate,2\n2,r,gate,0\n")
    (trams / "fares.txt").write_text("0.5")
    gate = "{type: range_bearing, fares: fares.txt}"
    (trams / "log.yaml").write_text(f"log: {{path: log}}\nrobots: {{each: {{sensors: {{gate: {gate}}}}}}}\n")
    code = """
from kalmark import KalmarkError
from kalmark.config import build_slam, open_run
from kalmark.logs import open_log, write_native

config, log = open_run("log.yaml")
print(config.robots["each"].sensors["gate"].sigma_range_m)
write_native(log, "copy")
print([event.stops for event in open_log("copy").events[1:]])
try:
    build_slam(config, log)
except KalmarkError as error:
    print(error)
"""
    done = python(code, trams)
    sigma, stops, refused = done.stdout.splitlines()
    assert (sigma, stops) == ("0.5", "[2, 0]"), done.stderr
    assert refused.endswith("robots.each.sensors: got a ticket of no stop, expected one of some")


def test_the_core_simulates_runs_saves_and_reloads_without_the_plug_ins(tmp_path: Path) -> None:
    done = python(WITHOUT + CORE, tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["landmarks"] > 5
    assert "verdict" not in summary
    warned = [line for line in done.stderr.splitlines() if "no verdict" in line]
    assert len(warned) == 1
    assert "'diagnose' of kalmark.diagnosis.verdict:diagnose cannot be loaded" in warned[0]


def test_what_needs_a_part_that_is_missing_names_it_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "camera.yaml").write_text(
        "robots: {r: {motion: {type: odometry_3d}, sensors: {eye: {type: pinhole, detector: {type: active_search}}}}}\n"
    )
    (tmp_path / "tags.yaml").write_text(
        "robots: {r: {motion: {type: odometry_3d}, sensors: {eye: {type: tag_corners, detector: {type: tags}}}}}\n"
    )
    (tmp_path / "lens.yaml").write_text(
        "robots: {r: {motion: {type: odometry_3d}, sensors: {eye: {type: pinhole, calibration: lens.yaml}}}}\n"
    )
    code = """
import sys
from pathlib import Path
import kalmark as km
from kalmark.cli import main
from kalmark.config import load_config
from kalmark.logs import Log, write_native
import numpy as np

images = Log("film", ("r",), [km.Frame(t_s=0.0, robot="r", sensor="eye", image=np.zeros((2, 2), np.uint8))])
Path("film").mkdir()
Path("film/frames.csv").write_text("t_s,robot,sensor,image\\n0,r,eye,0.png\\n")
Path("log").mkdir()
Path("log/controls.csv").write_text("t_s,robot,v_mps,w_radps\\n0,r,1,0\\n")
for call in (
    lambda: km.open_log(".", "mrclam"),
    lambda: km.open_log("camera.yaml"),
    lambda: load_config("camera.yaml"),
    lambda: load_config("tags.yaml"),
    lambda: km.diagnose,
    lambda: km.detect.Tags,
    lambda: km.open_log("dlr"),
    lambda: load_config("lens.yaml"),
    lambda: km.open_log("film"),
    lambda: write_native(images, "copy"),
):
    try:
        call()
    except (km.KalmarkError, AttributeError) as error:
        print(error)
main(["convert", "log", "log.mcap"])
print([main([verb, "x", "--option", "1"]) for verb in ("bag", "data", "diagnose", "tune")])
"""
    monkeypatch.delenv("KALMARK_DATA", raising=False)
    done = python(WITHOUT + code, tmp_path)
    mrclam, unknown, detector, tags, name, tags_name, dlr, lens, film, copy, statuses = done.stdout.splitlines()
    assert statuses == "[2, 2, 2, 2]"
    assert mrclam.startswith("log format is 'mrclam': 'mrclam' of kalmark.datasets.mrclam:MRCLAM cannot be loaded: ")
    assert f"'bag' of kalmark.bags.importer:BAG cannot be loaded: No module named 'kalmark.bags'{AGAIN}" in unknown
    assert "robots.r.sensors.eye.detector: got {'type': 'active_search'}, expected" in detector
    assert "'vision' of kalmark.vision cannot be loaded" in detector
    assert "robots.r.sensors.eye.detector: got {'type': 'tags'}, expected" in tags
    assert tags_name.startswith("'detect.Tags' of kalmark.vision.apriltags:Tags cannot be loaded")
    assert dlr.startswith("log 'dlr' not found, expected it at ")
    assert "downloads it" not in dlr
    assert lens.startswith("'calibration' of kalmark.vision.calibration_key cannot be loaded")
    assert film == copy
    assert film.startswith("'frames.csv' of kalmark.vision.frames_table cannot be loaded: No module named")
    assert name.startswith("'diagnose' of kalmark.diagnosis.verdict:diagnose cannot be loaded")
    assert "kalmark: 'mcap' of kalmark.bags.run_messages:export cannot be loaded" in done.stderr
    tune = "kalmark: 'tune' of kalmark.diagnosis.tune_verb:tune cannot be loaded: No module named 'kalmark.diagnosis'"
    assert done.stderr.splitlines()[-1] == tune + AGAIN


def test_the_filter_imports_no_kind_of_raw_data() -> None:
    """It takes `Raw`: images are of the detectors and sources that search them."""
    root = Path(km.__file__).parent
    for package in ("association", "filter", "management", "slam", "tracks"):
        for file in (root / package).rglob("*.py"):
            nodes = [node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.ImportFrom)]
            assert "Frame" not in {alias.name for node in nodes for alias in node.names}, file
