"""Landmarks in view that a scan did not measure: kept within bounds, and drawn as predicted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.config.building import build_slam
from kalmark.results import unmeasured
from kalmark.results.plot_scan import draw_sensor
from kalmark.results.run import Run
from kalmark.results.scene import IN_VIEW, images
from kalmark.simulate import load_world, simulate
from space_worlds import world as space_world

CAMERA: dict[str, Any] = {"type": "pinhole", "mount": {"roll_deg": -90.0, "yaw_deg": -90.0}}


@pytest.fixture(scope="module")
def run() -> Run:
    """Return a run of a laser that misses many of the landmarks in view."""
    world = load_world("laser", ["steps=40", "max_per_scan=4"])
    log = simulate(world, 1)
    return km.record(build_slam(world.config(), log), log, progress=False)


def test_what_is_in_view_is_either_measured_or_kept(run: Run, tmp_path: Path) -> None:
    history = run.history
    assert len(history.unmeasured_step) > 20
    measured = set(zip(history.step.tolist(), history.landmark.tolist(), strict=True))
    kept = list(zip(history.unmeasured_step.tolist(), history.unmeasured_landmark.tolist(), strict=True))
    assert len(set(kept)) == len(kept)
    assert measured.isdisjoint(kept)
    assert np.linalg.eigvalsh(history.unmeasured_Z).min() > 0
    loaded = Run.load(run.save(tmp_path)).history
    for name in ("step", "sensor", "landmark", "kind", "e", "Z"):
        np.testing.assert_array_equal(getattr(loaded, f"unmeasured_{name}"), getattr(history, f"unmeasured_{name}"))
    assert loaded.sensors == history.sensors
    assert (tmp_path / "sensor_robot_laser.png").stat().st_size > 10_000


def test_no_more_is_kept_than_the_bounds_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unmeasured, "SCANS", 5)
    monkeypatch.setattr(unmeasured, "LANDMARKS", 2)
    world = load_world("laser", ["steps=30", "max_per_scan=4"])
    log = simulate(world, 1)
    history = km.record(build_slam(world.config(), log), log, progress=False).history
    steps, counts = np.unique(history.unmeasured_step, return_counts=True)
    assert 3 <= len(steps) <= 5
    assert counts.max() == 2


def test_a_laser_is_drawn_in_its_measurement_space(run: Run) -> None:
    last = int(run.history.unmeasured_step[-1])
    figure = draw_sensor(run, "robot", "laser", last)
    axes = figure.axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("bearing (deg)", "range (m)")
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["measured", r"expected, $3\sigma$, used", rf"expected, $3\sigma$, {IN_VIEW}"]
    missed = run.history.unmeasured_step == last
    assert f"{missed.sum()} {IN_VIEW}" in figure.get_suptitle()
    names = {text.get_text() for text in axes.texts}
    assert names >= set(run.history.unmeasured_landmark[missed].tolist())


def test_positions_of_a_receiver_are_drawn_as_in_the_map() -> None:
    world = load_world("lever_arm", ["steps=10"])
    log = simulate(world, 1)
    run = km.record(build_slam(world.config(), log), log, progress=False)
    step = int(run.history.step[run.history.of_own][-1])
    axes = draw_sensor(run, "robot", "receiver", step).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.xaxis_inverted()) == ("x (m)", "y (m)", False)
    y = run.history.y[run.history.step == step][0, :2]
    np.testing.assert_array_equal(np.column_stack(axes.lines[0].get_data())[0], y)


def test_a_camera_shows_what_it_did_not_measure() -> None:
    world = space_world(robot={"sensors": {"lidar": {"type": "range_bearing_3d"}, "eye": CAMERA}}, steps=30)
    log = simulate(world, 2)
    log.events[:] = [
        km.Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=e.y[1:], ids=e.ids[1:])
        if isinstance(e, km.Scan) and e.sensor == "eye" and e.ids is not None and len(e.ids) > 1
        else e
        for e in log.events
    ]
    run = km.record(build_slam(world.config(), log), log, progress=False)
    camera = run.history.cameras[0]
    step = int(run.history.unmeasured_step[run.history.unmeasured_sensor == "eye"][-1])
    (image,) = images(run.history, camera, step)
    missed = [s for s in image.observations if s.outcome == IN_VIEW]
    assert missed
    for observation in missed:
        assert observation.measured.shape == (0, 2)
        assert np.isfinite(observation.expected).all()
        assert np.isfinite(observation.Z).all()
    assert "predicted only" in str([t.get_text() for t in draw_sensor(run, "r", "eye", step).legends[0].get_texts()])


def test_an_expectation_across_180_degrees_is_drawn_beside_its_measurement() -> None:
    robot = km.Robot("robot", km.motion.Unicycle(), sensors={"laser": km.Mount(km.sensors.RangeBearing())})
    bearings = np.pi - 0.01, -np.pi + 0.01
    scans = [
        km.Scan(t_ns=k * 10**8, robot="robot", sensor="laser", y=[[2.0, bearing]], ids=[1])
        for k, bearing in enumerate(bearings)
    ]
    run = km.record(km.Slam([robot]), km.Log("behind", ("robot",), scans), progress=False)
    axes = draw_sensor(run, "robot", "laser", 1).axes[0]
    measured, expected = (float(np.asarray(line.get_xdata())[0]) for line in axes.lines[:2])
    assert measured == pytest.approx(np.degrees(bearings[1]))
    assert expected == pytest.approx(measured - np.degrees(0.02), abs=0.1)
