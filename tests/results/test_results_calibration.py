"""What a run says of mounts that calibrate themselves: which directions were observed, which were not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam
from kalmark.events import Control, Event, Scan
from kalmark.geometry.frames3d import compose, move, plus, to_frame
from kalmark.results.filter_description import calibrated_mounts
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.run_page import report_html
from kalmark.results.self_calibration import Direction, directions, mount_rows
from kalmark.simulate import load_world, simulate
from results_space import FORWARD, MOUNT, NOISE, STEP_NS

ON_THE_FLOOR = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.05])
PRIOR = np.diag([0.05**2] * 3 + [0.02**2] * 3)
LEVEL = np.diag([0.003**2, 0.003**2, 0.0, 0.0, 0.0, 0.002**2])  # wheels neither climb nor tilt


def shares(found: list[Direction]) -> list[str]:
    return [str(each) for each in found]


def driven(sensor: Any, at: np.ndarray, weave: float) -> Run:
    """Return the run of a robot on a floor, on a circle or weaving about it, whose sensor sits elsewhere than given."""
    rng = np.random.default_rng(5)
    points, pose = rng.uniform([-6, -4, -1], [6, 9, 3], (50, 3)), np.array([0.0, 0, 0, 0, 0, 0, 1])
    truly, sigma = plus(at, np.array([0.03, -0.04, 0.05, 0.01, -0.02, 0.02])), np.sqrt(np.diagonal(LEVEL))
    events: list[Event] = []
    for k in range(1, 121):
        step = ON_THE_FLOOR * [1, 1, 1, 1, 1, 1 + weave * np.sin(k / 10)]
        pose = move(pose, step)[0]
        v = to_frame(compose(pose, truly)[0], points)[0]
        seen = np.flatnonzero(sensor.sees(v))
        e = sensor.expect(v[seen])[0]
        y = e + rng.normal(size=e.shape) * np.sqrt(np.diagonal(sensor.noise(e), axis1=1, axis2=2))
        events += [Control(t_ns=k * STEP_NS, robot="r", u=step + rng.normal(size=6) * sigma, cov=LEVEL)]
        events += [Scan(t_ns=k * STEP_NS, robot="r", sensor="eye", y=y, ids=seen.tolist())]
    robot = km.Robot("r", km.motion.Odometry3D(), sensors={"eye": km.Mount(sensor, at, cov=PRIOR)})
    return record(km.Slam([robot]), events, progress=False, pictures=False)


@pytest.fixture(scope="module")
def planar() -> Run:
    """Return the run of a camera on a robot that weaves about a circle on a floor."""
    return driven(km.sensors.PinHole(), FORWARD, weave=2.0)


def test_a_robot_on_the_floor_cannot_observe_the_height_of_its_camera_and_nothing_else(planar: Run) -> None:
    (mount,) = planar.history.mounts
    first, *others = directions(mount.prior, mount.covariance)
    assert str(first) == "z 1.00"
    assert (first.prior, first.unit) == (pytest.approx(0.05), "m")
    assert first.ratio == pytest.approx(1.0, abs=1e-6)
    assert len(others) == 5
    assert all(each.ratio < 0.3 for each in others)


def test_on_one_and_the_same_circle_a_turn_about_its_centre_is_not_observed_either() -> None:
    (mount,) = driven(km.sensors.RangeBearing3D(*NOISE), MOUNT, weave=0.0).history.mounts
    second = directions(mount.prior, mount.covariance)[1]
    assert second.ratio > 0.85  # not 1: the noise of the odometry is a little weave
    assert second.axes.keys() == {"x", "yaw"}  # the centre is 2 m to the left: a rad are 2 m ahead
    assert second.axes["yaw"] / second.axes["x"] == pytest.approx((1 / 0.02) ** 2 / (2 / 0.05) ** 2, rel=0.1)


def test_what_was_not_observed_is_warned_of_and_stands_in_every_report(planar: Run, tmp_path: Path) -> None:
    said = (
        "mount r.eye: its z (z 1.00) was not observed: sigma 5 cm of 5 cm; with this route and noise it stays as "
        "stated: measure it, or drive other turns and slopes"
    )
    summary = planar.evaluate()
    assert [line for line in summary["warnings"] if line.startswith("mount")] == [said]
    assert summary["mounts"]["r.eye"]["directions"][0]["ratio"] == pytest.approx(1.0, abs=1e-6)
    assert mount_rows(summary)[0] == ("r.eye", "z 1.00", "5 cm", "5 cm", "1.000")
    page = report_html(planar)
    assert said in page
    assert "<td>z 1.00</td>" in page
    loaded = Run.load(planar.save(tmp_path / "run"))
    assert loaded.evaluate()["mounts"] == summary["mounts"]
    saved = calibrated_mounts(loaded.final_slam())[0]  # the prior is in map.kmk, too
    np.testing.assert_array_equal(saved.prior, PRIOR)


def test_a_camera_that_flies_about_observes_its_whole_mount() -> None:
    world = load_world("self_calibration", ["steps=80"])
    log = simulate(world, seed=1)
    summary = record(build_slam(world.config(), log), log, progress=False, pictures=False).evaluate()
    ratios = [row["ratio"] for row in summary["mounts"]["beta.camera"]["directions"]]
    assert len(ratios) == 6
    assert max(ratios) < 0.5
    assert not any(line.startswith("mount") for line in summary["warnings"])


def test_a_robot_that_drives_straight_on_observes_which_way_its_sensor_looks_but_not_where_it_is() -> None:
    laser, rng = km.sensors.RangeBearing(sigma_range_m=0.05, sigma_bearing_rad=0.01), np.random.default_rng(2)
    mount, points = km.Mount(laser, (0.3, 0.1, 0.2), cov=np.diag([0.1, 0.1, 0.1]) ** 2), rng.uniform(-9, 9, (9, 2))
    slam = km.Slam([km.Robot("r", km.motion.Odometry2D(0.01, 0.0, 0.0), sensors={"laser": mount})])
    for k in range(1, 41):
        slam.process(Control(t_s=k, robot="r", u=(0.2, 0.0, 0.0)))
        seen = np.array([km.geometry.observe(np.array([0.3 + 0.2 * k, 0.1, 0.25]), p)[0] for p in points])
        slam.process(Scan(t_s=k, robot="r", sensor="laser", y=seen, ids=list(range(9))))
    (mounted,) = calibrated_mounts(slam)
    found = directions(mounted.prior, mounted.covariance, mounted.constants)
    assert [round(each.ratio, 6) for each in found[:2]] == [1.0, 1.0]
    assert {next(iter(each.axes)) for each in found[:2]} == {"x", "y"}
    assert str(found[2]).startswith("theta")
    assert found[2].ratio < 0.2
    assert (found[2].unit, found[2].prior) == ("deg", pytest.approx(np.degrees(0.1)))


def test_directions_are_named_by_the_axes_of_which_they_consist() -> None:
    prior = np.diag([0.1, 0.1, 0.1, 0.02, 0.02, 0.02]) ** 2
    low = np.array([0, 0, 0.1, 0, 0.02, 0]) / np.sqrt(2)  # z and pitch together, one prior sigma long
    posterior = 1e-4 * prior + np.outer(low, low)
    found = directions(prior, posterior)
    assert str(found[0]) == "z 0.50, pitch 0.50"
    assert found[0].ratio == pytest.approx(1.0, abs=1e-3)
    assert [each.ratio for each in found[1:]] == pytest.approx([0.01] * 5)


def test_axes_that_are_known_exactly_are_no_directions_and_correlated_ones_keep_their_names() -> None:
    prior: Any = np.diag([0.1, 0.2, 0.0, 0.02, 0.0, 0.02]) ** 2
    prior[0, 1] = prior[1, 0] = 0.5 * 0.1 * 0.2
    found = directions(prior, prior.copy())
    assert [each.ratio for each in found] == pytest.approx([1.0] * 4)
    halved = prior.copy()
    halved[3, 3] /= 16
    assert shares(directions(prior, halved)[-1:]) == ["roll 1.00"]
    assert directions(np.zeros((3, 3)), np.zeros((3, 3))) == []
