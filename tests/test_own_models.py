"""A user's models, one of each kind and all together: from Python over a run folder to the command line and back."""

from __future__ import annotations

import copy
import csv
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark import declare
from kalmark.campaign.replay import replay_of
from kalmark.config import load_config
from kalmark.geometry import compose, wrap
from kalmark.logs import FORMATS, open_log
from kalmark.results.run import Run
from kalmark.results.scene import Scene

CONFIG = """
plugins: [my_models.py]
log: {path: day.signs, format: signs}
robots:
  each:
    motion: {type: tracks, gauge_m: 0.4}
    sensors: {eye: {type: sign_reader, sigma_range_m: 0.12, mount: {x_m: 0.2}}}
landmarks: {type: sign, arm_m: 0.7}
association: {type: by_number, unread: 99}
estimator: {type: cautious, factor: 1.5}
"""
HERE = Path(__file__).parent
SIGNS = {1: (3.0, 1.0, 2.0), 2: (5.0, -2.0, 1.0), 3: (1.0, 4.0, -1.5)}
FILES = ("landmarks.csv", "associations.csv", "trajectory_crawler.tum")


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Import the user's file as a program of his does."""
    shutil.copy(HERE / "own_models.py", tmp_path / "my_models.py")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(declare, "_CLASSES", copy.deepcopy(declare._CLASSES))
    yield import_module("my_models")
    del sys.modules["my_models"], FORMATS["signs"]


def write_log(path: Path, own: Any) -> None:
    """Write what the robot reads of the signs on a quarter of a circle, and of one sign without a number."""
    rng, u, tracks, sign = np.random.default_rng(1), [0.4, 0.5], own.Tracks(gauge_m=0.4), own.Sign()
    eye = own.SignReader()
    rows: list[list[Any]] = [[0.0, *u]]
    r = np.zeros(3)
    for k in range(1, 13):
        r, _, _ = tracks.move(r, np.array(u), 0.5)
        v, _, _ = sign.seen_from(compose(r, np.array([0.2, 0.0, 0.0]))[0], np.array([*SIGNS.values()]))
        y = eye.expect(v)[0] + rng.normal(size=(len(v), 3)) * [0.1, 0.02, 0.02]
        y[:, 1:] = wrap(y[:, 1:])
        rows += [[0.5 * k, name, *one] for name, one in zip(SIGNS, y.tolist(), strict=True)]
        rows.append([0.5 * k, 99, 2.0, 0.0, 0.0])
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def slam_of(own: Any) -> km.Slam:
    """Return a filter of the user's models alone, each with another parameter than its default."""
    eye = km.Mount(own.SignReader(sigma_range_m=0.12), at=(0.2, 0, 0))
    crawler = km.Robot("crawler", own.Tracks(gauge_m=0.4), sensors={"eye": eye})
    return km.Slam([crawler], own.ByNumber(unread=99), own.Cautious(factor=1.5), own.Sign(arm_m=0.7))


def models(slam: km.Slam) -> list[Any]:
    robot = slam.robots["crawler"]
    return [robot.motion, robot.sensors["eye"].sensor, slam.state.settings.landmarks, slam.association, slam.estimator]


def kalmark(*arguments: str | Path, folder: Path) -> str:
    """Run the command line in a process of its own, which knows nothing of the user's file but what it is told."""
    code = "import sys; from kalmark.cli import main; sys.exit(main())"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(km.__file__).parents[1]), str(folder)])}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_models_of_a_user_go_from_python_to_the_command_line_and_back(own: Any, tmp_path: Path) -> None:
    write_log(tmp_path / "day.signs", own)
    slam = slam_of(own)
    run = km.record(slam, open_log(tmp_path / "day.signs"), progress=False)
    assert slam.landmarks().ids == [*SIGNS]
    saved = run.save(tmp_path / "first")

    # the landmarks are written and drawn where they are: at their boards
    expected = {i: compose(np.array(post), np.array([0.7, 0, 0]))[0][:2] for i, post in SIGNS.items()}
    drawn, loaded = Scene.of(Run.load(saved)), Run.load(saved).landmarks
    for k, name in enumerate(SIGNS):
        p, P = slam.place(name)
        assert np.linalg.norm(p - expected[name]) < 0.3 < np.linalg.norm(p - slam.mean(name)[:2])
        np.testing.assert_array_equal(loaded.means[k], p)
        np.testing.assert_allclose(loaded.covariances[k], P, rtol=1e-12)
        np.testing.assert_array_equal(drawn.shapes.means[k], p)

    # the configuration and the map make the same filter again
    (tmp_path / "mine.yaml").write_text(CONFIG)
    assert models(km.Slam.from_config(tmp_path / "mine.yaml")) == models(slam)
    config = load_config(saved / "config.yaml")
    assert config.plugins == (str(tmp_path / "my_models.py"),)
    assert (config.log.format, config.log.path) == ("signs", str(tmp_path / "day.signs"))
    assert models(km.Slam.from_config(saved / "config.yaml")) == models(slam)
    restored = km.Slam.load(saved / "map.kmk")
    assert models(restored) == models(slam)
    np.testing.assert_array_equal(restored.covariance("crawler", *SIGNS), slam.covariance("crawler", *SIGNS))

    # the command line makes the same run of it, in a process that has only the configuration
    kalmark("run", "first/config.yaml", "--out", "second", folder=tmp_path)
    for name in FILES:
        assert (tmp_path / "second" / name).read_text() == (saved / name).read_text(), name
    assert "associated 1" in kalmark("explain", "second", "--scan", "3", "--trust", folder=tmp_path)
    for what, refused in (  # what only does points
        ("batch solution", lambda: Run.load(tmp_path / "second", trust=True).evaluate(batch=True)),
        ("day, to be replayed", lambda: replay_of(config, open_log(tmp_path / "day.signs"), progress=False)),
    ):
        with pytest.raises(km.KalmarkError, match=f"{what}: landmark 1 is a sign, expected points"):
            refused()
    again = load_config(tmp_path / "second" / "config.yaml")
    assert (again.plugins, again.robots, again.landmarks) == (config.plugins, config.robots, config.landmarks)


def test_a_verb_of_a_user_reads_the_run_of_his_models(own: Any, tmp_path: Path) -> None:
    write_log(tmp_path / "day.signs", own)
    slam = slam_of(own)
    km.record(slam, open_log(tmp_path / "day.signs"), progress=False).save(tmp_path / "run")
    (tmp_path / "own-1.dist-info").mkdir()
    (tmp_path / "own-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: own\nVersion: 1\n")
    (tmp_path / "own-1.dist-info" / "entry_points.txt").write_text("[kalmark.verbs]\nwhere = my_models:where\n")
    told = [line.split() for line in kalmark("where", "run", folder=tmp_path).splitlines()]
    np.testing.assert_allclose(np.array(told, float)[:, 1:], [slam.place(name)[0] for name in SIGNS], atol=1e-3)


def test_a_range_in_space_is_a_sensor_of_one_line() -> None:
    beacon = km.pointwise(np.linalg.norm, [[0.05**2]], columns=("range_m",))
    cov = np.diag([0.5, 0.5, 0.5, 0.02, 0.02, 0.1]) ** 2
    drone = km.Robot("drone", km.motion.Odometry3D(0.05, 0.02), sensors={"radio": km.Mount(beacon)}, cov=cov)
    slam, rng = km.Slam(drone, landmarks=km.landmarks.Point3D()), np.random.default_rng(0)
    beacons, truth = rng.uniform(-10.0, 10.0, (8, 3)), np.array([0.4, -0.3, 0.2])
    for i, place in enumerate(beacons):
        slam.add_landmark(i, place)
    for k in range(20):
        truth = truth + np.array([0.1, 0.0, 0.0])
        slam.process(km.Control(0.1 * k, "drone", (0.1, 0.0, 0.0, 0.0, 0.0, 0.0)))
        y = np.linalg.norm(beacons - truth, axis=1)[:, None] + 0.05 * rng.normal(size=(8, 1))
        slam.process(km.Scan(0.1 * k, "drone", "radio", y, ids=range(8)))
    d, P = slam.mean("drone")[:3] - truth, slam.covariance("drone")[:3, :3]
    assert d @ np.linalg.solve(P, d) < 14.2 and np.sqrt(np.diag(P)).max() < 0.04  # .997 of chi-square
