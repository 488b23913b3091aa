"""Robust weights: Huber's and Student's, against their textbook form, and what they are for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import kalmark as km
from kalmark.arrays import Array
from kalmark.compiled import python_form
from kalmark.errors import ModelError
from kalmark.events import Scan
from kalmark.filter import corrections
from kalmark.geometry.gaussian import gate
from kalmark.logs.log import Log
from kalmark.simulate import load_world, simulate
from kalmark.tracks.channel import DEGREES, ObservationModel, huber_length

LASER = km.sensors.RangeBearing(0.1, 0.02)


def scene(seed: int = 0) -> tuple[km.Slam, Array, Array]:
    """Return a filter with five landmarks, their places, and a scan y (5, 2) of them of which one range is wrong."""
    rng = np.random.default_rng(seed)
    slam = km.Slam(
        [km.Robot("r", km.motion.Unicycle(), cov=np.diag([0.04, 0.04, 0.01]), sensors={"l": km.Mount(LASER)})]
    )
    places = rng.uniform(-5, 5, (5, 2))
    for k, place in enumerate(places):
        slam.add_landmark(k, place, 0.01 * np.eye(2))
    y = km.geometry.observe(np.array([0.1, -0.1, 0.05]), places)[0] + rng.normal(size=(5, 2)) * (0.1, 0.02)
    y[2, 0] += 3.0
    return slam, places, y


@pytest.mark.parametrize("student", [False, True])
def test_weights_are_those_of_iterated_least_squares_in_textbook_form(student: bool) -> None:
    slam, places, y = scene()
    model, slots = (
        ObservationModel(km.landmarks.Point2D(), LASER, np.zeros(3)),
        np.array([slam.slot(k) for k in range(5)]),
    )
    R, k = np.tile(np.diag([0.01, 0.0004]), (5, 1, 1)), DEGREES if student else huber_length(2)
    m, robot, mount, here = slam.map.marginal(slam.slot("r"), -1, slots)
    scan = robot, mount, here, 2, y, R, k
    found = corrections.robust_noise(model.model, m.whole, scan, student)
    np.testing.assert_allclose(
        python_form(corrections.robust_noise)(model.model, m.whole, scan, student), found, rtol=1e-9
    )
    # textbook: x is free with the prior P, each residual has a weight
    e, H_r, H_l = km.geometry.observe(np.zeros(3), places)
    H = np.zeros((10, 13))
    for i in range(5):
        H[2 * i : 2 * i + 2, :3], H[2 * i : 2 * i + 2, 3 + 2 * i : 5 + 2 * i] = H_r[i], H_l[i]
    z, P = (y - e).ravel(), slam.covariance("r", *range(5))
    z[1::2] = (z[1::2] + np.pi) % (2 * np.pi) - np.pi
    times = np.ones(5)
    for _ in range(100):
        N = np.kron(np.diag(times), R[0])
        r = (z - H @ (P @ H.T @ np.linalg.solve(H @ P @ H.T + N, z))).reshape(5, 2)
        d2 = np.einsum("ki,ij,kj->k", r, np.linalg.inv(R[0]), r)
        times = np.maximum(1.0, (k + d2) / (k + 2) if student else np.sqrt(d2) / k)
    np.testing.assert_allclose(found[:, 0, 0] / R[:, 0, 0], times, rtol=0.05)
    assert times[2] > (20 if student else 5)


def test_huber_counts_95_percent_of_right_observations_in_full() -> None:
    assert huber_length(2) ** 2 == pytest.approx(gate(0.95, 2))


def test_a_wrong_range_pulls_the_robot_little_where_outliers_count_less() -> None:
    off = {}
    for how in (None, "huber", "student"):
        slam, _, y = scene()
        robot = replace(slam.robots["r"], sensors={"l": km.Mount(LASER, robust=how)})
        other = km.Slam([robot], km.association.ByIdentity(gate="off"))
        for k in range(5):
            other.add_landmark(k, slam.mean(k), slam.covariance(k))
        report = other.process(km.Scan(0.0, "r", "l", y, [*range(5)]))
        off[how] = float(np.linalg.norm(other.mean("r")[:2] - (0.1, -0.1)))
        assert report.observations[2].outcome == "associated"
    assert off["student"] < off["huber"] < 0.5 * off[None]
    assert off["student"] < 0.15


def test_known_landmarks_and_compressed_maps_take_them_as_dense_ones_do() -> None:
    means = []
    for kind in ("dense", "postponed"):
        _, places, y = scene()
        robot = km.Robot("r", km.motion.Unicycle(), cov=np.diag([0.04, 0.04, 0.01]),
                         sensors={"l": km.Mount(LASER, robust="student")})  # fmt: skip
        slam = km.Slam([robot], map=kind)
        for k, place in enumerate(places):
            slam.add_landmark(k, place, None if k < 3 else 0.01 * np.eye(2))
        slam.process(km.Scan(0.0, "r", "l", y, [*range(5)]))
        means.append(slam.mean("r"))
    np.testing.assert_allclose(means[0], means[1], atol=1e-9)
    assert np.linalg.norm(means[0][:2] - (0.1, -0.1)) < 0.15


def spurious(log: Log, share: float, seed: int) -> Log:
    """Return a log with a share of its ranges anywhere, under their right ids; but not the first of a landmark."""
    rng, seen, events = np.random.default_rng(seed), set[object](), []
    for e in log.events:
        event = e
        if isinstance(event, Scan) and event.ids is not None and len(event.y):
            old = np.array([i in seen for i in event.ids])
            bad, y = old & (rng.random(len(old)) < share), event.y.copy()
            y[bad, 0] = rng.uniform(0.5, 12.0, bad.sum())
            seen |= {*event.ids}
            event = Scan(t_ns=event.t_ns, robot=event.robot, sensor=event.sensor, y=y, ids=event.ids)
        events.append(event)
    return replace(log, events=events)


def test_nees_with_3_percent_spurious_ranges() -> None:
    settings = ("world.count=40", "world.size_m=24", "steps=300", "robots.rover.start={x_m: 12, y_m: 12, theta_rad: 0}")
    nees: dict[str, list[float]] = {}
    for seed in range(4):
        bad = spurious(simulate(load_world("random_field", [*settings]), seed), 0.03, seed)
        for how in ("", "huber", "student"):
            key = f"robots.rover.sensors.lidar.robust={how}" if how else "filter.association.gate=off"
            config = load_world("random_field", [*settings, key]).config()
            run = km.record(km.config.build_slam(config, bad), bad, progress=False, pictures=False)
            nees.setdefault(how, []).append(run.evaluate()["robots"]["rover"]["pose_nees"])
    plain, huber, student = (float(np.mean(nees[how])) for how in ("", "huber", "student"))
    assert plain > 8.0
    assert 1.5 < student < 4.0 and 1.5 < huber < 4.0  # 3 of a consistent filter


def test_a_robust_sensor_is_described_saved_and_refused_where_it_is_none(tmp_path: Path) -> None:
    slam = km.Slam([km.Robot("r", km.motion.Unicycle(), sensors={"l": km.Mount(LASER, robust="huber")})])
    slam.save(tmp_path / "map.kmk")
    assert km.Slam.load(tmp_path / "map.kmk").robots["r"].sensors["l"].robust == "huber"
    with pytest.raises(ModelError, match="robust is 'tukey', expected one of huber, student"):
        km.Mount(LASER, robust="tukey")
    with pytest.raises(ModelError, match="a Heading measures its robot, expected None"):
        km.Mount(km.sensors.Heading(), robust="huber")
