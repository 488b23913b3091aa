"""The guide's program as the estimator of runs and campaigns, and a copy of its file with a changed equation."""

from __future__ import annotations

import inspect
import json
import os
import pickle
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from command_line import Kalmark
from kalmark import declare
from kalmark.results.run import Run
from kalmark.simulate import load_world

WORLD = ("random_field", "--set", "steps=60")
LINE = "        self.x = self.x + K @ z  # (22)\n"


def by_own(name: str) -> tuple[str, ...]:
    return "--set", f"plugins=[{name}.py]", "--set", f"estimator={name}:Textbook"


def copy_of_the_program(path: Path, *, changed: bool = False) -> None:
    text = inspect.getsource(km.textbook)
    assert text.count(LINE) == 1
    path.write_text(text.replace(LINE, LINE.replace("K @ z", "0.5 * K @ z")) if changed else text)


def estimates(run: Run) -> np.ndarray:
    landmarks = *run.landmarks.means, *run.landmarks.covariances
    return np.concatenate([run.history.mean.ravel(), *map(np.ravel, landmarks)])


@pytest.fixture
def simulated(kalmark: Kalmark) -> Path:
    assert kalmark("simulate", *WORLD, "--out", "sim").status == 0
    return Path("sim/config.yaml")


def run_by(kalmark: Kalmark, config: Path, *estimator: str) -> Run:
    done = kalmark("run", config, *estimator, "--out", "run")
    assert done.status == 0, done.err
    return Run.load("run", trust=True)


def test_a_run_of_the_textbook_is_that_of_the_ekf_and_a_changed_copy_of_its_file_makes_another(
    kalmark: Kalmark, simulated: Path
) -> None:
    ekf = run_by(kalmark, simulated, "--set", "estimator=ekf")
    book = run_by(kalmark, simulated, "--set", "estimator=textbook")
    np.testing.assert_allclose(estimates(book), estimates(ekf), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(book.history.outcome, ekf.history.outcome)
    np.testing.assert_allclose(book.history.d2, ekf.history.d2, rtol=0, atol=1e-9)
    assert book.estimator == "textbook" and "rejected" in ekf.history.outcome
    assert book.evaluate()["robots"]["rover"]["pose_nees"] > 0

    copy_of_the_program(Path("mine.py"))
    own = run_by(kalmark, simulated, *by_own("mine"))
    np.testing.assert_array_equal(estimates(own), estimates(book))
    assert own.estimator == "mine:Textbook"


def test_a_changed_equation_changes_the_run(kalmark: Kalmark, simulated: Path) -> None:
    copy_of_the_program(Path("half.py"), changed=True)
    book, own = (run_by(kalmark, simulated, *how) for how in (("--set", "estimator=textbook"), by_own("half")))
    assert np.abs(own.history.mean[-1] - book.history.mean[-1])[:2].max() > 1e-3
    np.testing.assert_allclose(own.history.covariance[0], book.history.covariance[0])


def test_a_campaign_compares_the_textbook_and_a_changed_copy_with_the_ekf(kalmark: Kalmark) -> None:
    copy_of_the_program(Path("compared.py"), changed=True)
    Path("world.yaml").write_text(kalmark("worlds", "random_field").out + "plugins: [compared.py]\n")
    labels = ["ekf", "textbook", "compared:Textbook"]
    told = [word for label in labels for word in ("--estimator", label)]
    done = kalmark("campaign", "world.yaml", "--set", "steps=20", "--runs", 2, "--jobs", 1, *told, "--out", "mc")
    assert done.status == 0, done.err
    found = json.loads(Path("mc/summary.json").read_text())["estimators"]
    assert [*found] == labels
    ekf, book, own = (found[label]["pose_anees"] for label in labels)
    assert book == pytest.approx(ekf, abs=1e-9) and abs(own - ekf) > 1e-3


def test_a_worker_that_knows_no_class_of_the_user_yet_finds_it_by_its_file(
    kalmark: Kalmark, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy_of_the_program(Path("sent.py"))
    Path("world.yaml").write_text(kalmark("worlds", "random_field").out + "plugins: [sent.py]\n")
    section = load_world("world.yaml", ["filter.estimator=sent:Textbook"]).config().estimator
    sent = pickle.dumps(section)
    known = {name: models for name, models in declare._CLASSES["estimator"].items() if name != "sent:Textbook"}
    monkeypatch.setattr(declare, "_CLASSES", declare._CLASSES | {"estimator": known})
    assert dict(pickle.loads(sent)) == dict(section) and "sent:Textbook" in declare._CLASSES["estimator"]


def events_between_controls(steps: int) -> list[Any]:
    """Return controls of a second, each cut by a scan in its middle, and the scans of three points."""
    rng, truth, events = np.random.default_rng(3), np.zeros(3), []
    world = np.array([[3.0, 2.0], [4.0, -1.0], [6.0, 1.0]])
    for k in range(steps):
        events.append(km.Control(float(k), "r", [0.5, 0.1]))
        truth = km.geometry.move(truth, [0.25, 0.05], np.zeros(2))[0]
        y = km.geometry.observe(truth, world)[0] + rng.normal(size=(3, 2)) * [0.1, 0.02]
        events.append(km.Scan(k + 0.5, "r", "lidar", y, [1, 2, 3]))
        truth = km.geometry.move(truth, [0.25, 0.05], np.zeros(2))[0]
    return events


@pytest.mark.parametrize("kind", ["dense", "postponed"])
def test_errors_that_parts_of_a_control_share_and_its_constants_are_in_the_textbook_s_state(kind: str) -> None:
    motion = km.motion.Unicycle(0.05, 0.05, sigma_v_bias_mps=0.05, sigma_along_m_per_sqrt_s=0.02)
    found = []
    for estimator in (km.estimators.Ekf(), km.textbook.Textbook()):
        lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.02, scale=1.01), at=(0.2, 0.1, 0.3))
        slam = km.Slam(km.Robot("r", motion, sensors={"lidar": lidar}), estimator=estimator, map=kind)
        for event in events_between_controls(8):
            slam.process(event)
        names = ["r", "r bias", 1, 2, 3]
        found.append((np.concatenate([slam.mean(name) for name in names]), slam.covariance(*names)))
    np.testing.assert_allclose(found[1][0], found[0][0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(found[1][1], found[0][1], rtol=0, atol=1e-10)


def test_results_of_the_equations_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    robot = km.Robot("r", km.motion.Unicycle(0.05, 0.05), sensors={"lidar": lidar})
    slam = km.Slam(robot, estimator=km.textbook.Textbook(show=True))
    for event in events_between_controls(2):
        slam.process(event)
    told = capsys.readouterr().out
    assert told.index("x (9) =") < told.index("P_LL (35) =") < told.index("Z (20) =") < told.index("K (21) =")


@pytest.mark.parametrize(
    ("world", "said"),
    [
        ("two_robots", "robots are alpha, beta, expected one"),
        ("quick_turns", "robots.robot.motion is a Odometry3D of space, expected one of the plane"),
        ("compass_and_gyro", "robots.robot.sensors.compass is a Heading of heading_rad, expected one of range_m, bear"),
        ("ring_road", "association of robots.car.sensors.laser is Automatic, expected identity: known ids"),
    ],
)
def test_what_the_guide_has_not_is_refused_in_one_line(kalmark: Kalmark, world: str, said: str) -> None:
    small = ("--runs", 1, "--jobs", 1, "--set", "steps=2", "--estimator", "textbook")
    done = kalmark("campaign", world, *small, "--out", "mc")
    assert done.status == 2 and done.err.count("\n") == 1 and f"estimator textbook: {said}" in done.err


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"cov": np.eye(3) * 0.01}, "mount of robots.r.sensors.lidar is estimated with the map, expected no sigmas"),
        ({"landmark": km.landmarks.Polar2D()}, "landmarks of robots.r.sensors.lidar are polar, expected point"),
    ],
)
def test_mounts_and_landmarks_that_the_guide_has_not_are_refused(given: dict[str, Any], said: str) -> None:
    robot = km.Robot("r", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing(), **given)})
    with pytest.raises(km.KalmarkError, match=said):
        km.Slam(robot, estimator=km.textbook.Textbook())


def test_a_class_that_is_no_estimator_is_refused_with_its_name(kalmark: Kalmark, simulated: Path) -> None:
    copy_of_the_program(Path("named.py"))
    done = kalmark("run", simulated, "--set", "plugins=[named.py]", "--set", "estimator=named:TextbookSlam")
    assert done.status == 2 and done.err.count("\n") == 1
    assert "estimator: named:TextbookSlam cannot be made of the keys of its section" in done.err


def debugged(config: Path, *lines: str, estimator: str) -> list[Any]:
    """Return what a debugger prints for lines that begin with `p`, in a run that is not compiled."""
    script = "\n".join(["import kalmark as km", "from kalmark.filter import corrections", *lines, "quit", ""])
    command = [sys.executable, "-m", "pdb", "-m", "kalmark", "run", str(config), "--set", f"estimator={estimator}"]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, input=script, env=environment, capture_output=True, text=True, check=False)
    return [json.loads(value) for value in re.findall(r"^\(Pdb\) (\[.*\])$", done.stdout, re.M)]


def test_a_debugger_stops_in_a_correction_and_shows_innovation_its_covariance_and_gain(
    kalmark: Kalmark, simulated: Path
) -> None:
    compiled = run_by(kalmark, simulated, "--set", "estimator=ekf").history
    first = int(np.flatnonzero(np.isfinite(compiled.d2))[0])
    state, gain = ("break km.textbook.TextbookSlam.correct", "continue", "p self.x.tolist()"), "p self.K.tolist()"
    shown = ("p self.z.tolist()", "p self.Z.tolist()", gain, "p self.x.tolist()")
    x, z, Z, K, corrected = map(np.array, debugged(simulated, *state, "return", *shown, estimator="textbook"))
    np.testing.assert_allclose(z, compiled.z[first], rtol=0, atol=1e-12)
    np.testing.assert_allclose(Z, compiled.Z[first], rtol=1e-9)
    np.testing.assert_allclose(corrected, x + K @ z, rtol=0, atol=1e-12)

    shown = ("p v.tolist()", "p np.linalg.inv(M.T @ M).tolist()", "p (M.T @ M @ HP).T.tolist()")
    lines = ("import numpy as np", "break corrections.gain", "continue", *shown)
    z_fast, Z_fast, K_fast = map(np.array, debugged(simulated, *lines, estimator="ekf"))
    np.testing.assert_allclose(z_fast, z, rtol=0, atol=1e-12)
    np.testing.assert_allclose(Z_fast, Z, rtol=1e-9)
    np.testing.assert_allclose(K_fast, K, rtol=0, atol=1e-9)
