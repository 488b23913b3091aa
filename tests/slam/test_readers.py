"""Sensors of the state through `Slam.process`: consistency, resuming, gates, turned worlds, refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from kalmark.arrays import Array
from kalmark.errors import EventError, MapError, ModelError
from kalmark.geometry.frames import compose, inverse
from kalmark.geometry.frames3d import compose as compose3

STEP_S = 0.1
ARM = np.array([0.5, -0.1, 0.0])
SCALE, BIAS = 1.05, 0.01


def robot(start: Any = (0.0, 0.0, 0.0)) -> km.Robot:
    sensors = {
        "gyro": km.Mount(km.sensors.Gyro2D(0.002, sigma_bias_radps=0.05)),
        "compass": km.Mount(km.sensors.Heading(0.05)),
        "wheels": km.Mount(km.sensors.Speed(0.02, sigma_scale=0.1), at=(0.0, 0.1, 0.0)),
        "matcher": km.Mount(km.sensors.Odometer2D(0.01, 0.005), at=(0.1, 0.0, 0.2)),
        "receiver": km.Mount(km.sensors.Gps2D(0.5), at=(0.3, 0.2, 0.0), cov=np.diag([0.04, 0.04, 0.0])),
    }
    return km.Robot("r", motion=km.motion.Unicycle(sigma_v_mps=0.1, sigma_w_radps=0.1), start=start, sensors=sensors)


def events(seed: int, steps: int = 150, start: Any = (0.0, 0.0, 0.0)) -> tuple[list[Any], Array]:
    """Return the events of one robot that really has what its sensors are uncertain of, and where it is in the end."""
    rng, x, u, found = np.random.default_rng(seed), np.array(start), np.array([1.0, 0.3]), []
    motion, at = km.motion.Unicycle(), np.array([0.1, 0.0, 0.2])
    found.append(km.Control(0.0, "r", u))
    for k in range(1, steps + 1):
        t_s, before, done = k * STEP_S, x, u + rng.normal(0, 0.1, 2)
        x = motion.move(x, done, STEP_S)[0]
        way = compose(inverse(compose(before, at)[0])[0], compose(x, at)[0])[0]
        speed = SCALE * (done[0] - 0.1 * done[1])
        found.append(km.Scan(t_s, "r", "compass", [[x[2] + rng.normal(0, 0.05)]]))
        found.append(km.Scan(t_s, "r", "gyro", [[done[1] + BIAS + rng.normal(0, 0.002)]]))
        found.append(km.Scan(t_s, "r", "matcher", [way + rng.normal(0, [0.01, 0.01, 0.005])]))
        antenna = compose(x, ARM)[0][:2] + rng.normal(0, 0.5, 2)
        found += [km.Scan(t_s, "r", "receiver", [antenna])] if k % 10 == 0 else []
        found.append(km.Scan(t_s, "r", "wheels", [[speed + rng.normal(0, 0.02)]]))
        u = np.array([1.0, 0.3 * np.sin(0.05 * k)])
        found.append(km.Control(t_s, "r", u))
    return found, x


def ran(log: list[Any], estimator: Any = None, start: Any = (0.0, 0.0, 0.0)) -> km.Slam:
    slam = km.Slam(robot(start), estimator=estimator)
    for event in log:
        slam.process(event)
    return slam


@pytest.mark.parametrize("estimator", [km.estimators.Invariant(), km.estimators.Ekf(), km.estimators.Fej()])
def test_poses_and_constants_are_as_wrong_as_the_filter_says(estimator: Any) -> None:
    nees, constants = [], []
    for seed in range(12):
        log, truth = events(seed)
        slam = ran(log, estimator)
        error = slam.robots["r"].motion.space.minus(slam.mean("r"), truth)
        nees.append(error @ np.linalg.solve(slam.covariance("r"), error))
        for name, i, value in (("gyro", 3, BIAS), ("wheels", 3, 1 / SCALE), ("receiver", 0, ARM[0])):
            mean, P = slam.mean(f"r.{name}"), slam.covariance(f"r.{name}")
            constants.append((mean[i] - value) ** 2 / P[i, i])
    assert 1.3 < np.mean(nees) < 5.6  # 99.7 % of the mean of 12 chi-squares of 3 are within 1.5 and 5.3
    assert 0.4 < np.mean(constants) < 1.9


@pytest.mark.parametrize("name", ["wheels", "matcher"])
def test_a_scale_is_not_pushed_by_the_noise_of_the_controls_that_its_readings_are_compared_with(name: str) -> None:
    """Controls of 1 m/s are read with a noise of .3: by their own speed, the scale would be pushed at every reading."""
    sensors = {
        "wheels": km.Mount(km.sensors.Speed(0.02, sigma_scale=0.1)),
        "matcher": km.Mount(km.sensors.Odometer2D(0.002, 0.005, sigma_scale=0.1)),
        "receiver": km.Mount(km.sensors.Gps2D(0.1)),
    }
    motion, u, off = km.motion.Unicycle(sigma_v_mps=0.3, sigma_w_radps=0.1), np.array([1.0, 0.3]), []
    way = motion.move(np.zeros(3), u, STEP_S)[0]
    for seed in range(10):
        rng, x = np.random.default_rng(seed), np.zeros(3)
        slam = km.Slam(km.Robot("r", motion, sensors={key: sensors[key] for key in (name, "receiver")}))
        for k in range(300):
            slam.process(km.Control(k * STEP_S, "r", u + rng.normal(0, [0.3, 0.1])))
            x, t_s = compose(x, way)[0], (k + 1) * STEP_S
            scaled = way * [SCALE, SCALE, 1.0] + rng.normal(0, [0.002, 0.002, 0.005])
            y = [SCALE + rng.normal(0, 0.02)] if name == "wheels" else scaled
            slam.process(km.Scan(t_s, "r", name, [y]))
            if k % 5 == 0:
                slam.process(km.Scan(t_s, "r", "receiver", [x[:2] + rng.normal(0, 0.1, 2)]))
        off.append((slam.mean(f"r.{name}")[3] - 1 / SCALE) / np.sqrt(slam.covariance(f"r.{name}")[3, 3]))
    assert abs(np.mean(off)) < 3 / np.sqrt(10)
    assert np.mean(np.square(off)) < 3.1, "99.9 % of means of ten chi-squares are below"


def test_a_run_that_is_resumed_ends_bit_for_bit_where_it_would_have(tmp_path: Path) -> None:
    log, _ = events(0, 40)
    whole = ran(log)
    first = ran(log[:107])
    first.save(tmp_path / "map.kmk")
    second = km.Slam.load(tmp_path / "map.kmk")
    for event in log[107:]:
        second.process(event)
    np.testing.assert_array_equal(second.mean("r"), whole.mean("r"))
    np.testing.assert_array_equal(second.covariance("r", "r.gyro"), whole.covariance("r", "r.gyro"))


def test_a_run_that_is_turned_and_shifted_gives_the_same_estimate_turned_and_shifted() -> None:
    moved = np.array([30.0, -20.0, 2.0])
    log, _ = events(3, 60)
    turned = []
    for event in log:
        y: Any = None if isinstance(event, km.Control) else event.y
        if isinstance(event, km.Scan) and event.sensor == "compass":
            y = y + moved[2]
        elif isinstance(event, km.Scan) and event.sensor == "receiver":
            y = compose(moved, np.append(y[0], 0.0))[0][None, :2]
        turned.append(event if y is None else km.Scan(t_ns=event.t_ns, robot="r", sensor=event.sensor, y=y))
    here, there = ran(log), ran(turned, start=tuple(moved))
    np.testing.assert_allclose(there.mean("r"), compose(moved, here.mean("r"))[0], atol=1e-9)
    np.testing.assert_allclose(there.mean("r.wheels"), here.mean("r.wheels"), atol=1e-10)


def test_a_reading_far_from_what_is_expected_is_rejected_and_changes_nothing() -> None:
    slam = ran(events(1, 20)[0])
    before, P = slam.mean("r"), slam.covariance("r")
    o = slam.process(km.Scan(2.0, "r", "receiver", [[60.0, 0.0]])).observations[0]
    assert (o.outcome, o.landmark) == ("rejected", "r")
    np.testing.assert_array_equal(slam.mean("r"), before)
    np.testing.assert_array_equal(slam.covariance("r"), P)


def test_the_first_reading_of_what_counts_from_the_last_one_is_ignored() -> None:
    slam = km.Slam(robot())
    o = slam.process(km.Scan(0.0, "r", "matcher", [[0.0, 0.0, 0.0]])).observations[0]
    assert (o.outcome, o.reason) == ("ignored", "the first reading: none to count from")
    assert slam.process(km.Scan(0.1, "r", "matcher", [[0.0, 0.0, 0.0]])).observations[0].outcome == "associated"


def test_what_is_no_reading_is_refused_with_one_line_and_changes_nothing() -> None:
    slam = ran(events(2, 10)[0])
    before = slam.mean("r")
    for y, ids, said in (
        ([[0.1], [0.2]], None, "y has 2 rows, expected one: a Gyro2D measures its robot"),
        ([[0.1]], [7], "id 7, expected none: 'gyro' measures its robot"),
        ([[0.1, 0.2]], None, "y has 2 columns, expected 1: w_radps"),
    ):
        with pytest.raises(EventError, match=r"scan at t=1\.5 s") as error:
            slam.process(km.Scan(1.5, "r", "gyro", y, ids))
        assert said in str(error.value)
        np.testing.assert_array_equal(slam.mean("r"), before)
    with pytest.raises(EventError, match="was read at that time already, expected one reading"):
        slam.process(km.Scan(1.0, "r", "gyro", [[0.1]]))


def test_velocities_in_the_state_are_measured_where_they_are() -> None:
    """A robot that coasts in space: a Doppler log and a gyroscope on a lever arm find its velocity and its rates."""
    sensors = {
        "log": km.Mount(km.sensors.BodyVelocity3D(0.01), at=(0.5, 0.2, -0.1, 0.0, 0.0, 0.0, 1.0)),
        "gyro": km.Mount(km.sensors.Gyro3D(0.001)),
    }
    cov = np.diag([*[1e-6] * 6, *[1.0] * 3, *[0.25] * 3])
    of = km.Robot("r", motion=km.motion.ConstantVelocity3D(), sensors=sensors, cov=cov)
    slam, w, v = km.Slam(of), np.array([0.1, -0.2, 0.3]), np.array([1.0, 0.5, -0.2])
    for k in range(10):
        slam.process(km.Scan(0.001 * k, "r", "gyro", [w]))
        slam.process(km.Scan(0.001 * k, "r", "log", [v + np.cross(w, [0.5, 0.2, -0.1])]))
    np.testing.assert_allclose(slam.mean("r")[7:], [*v, *w], atol=0.01)
    assert np.sqrt(np.diag(slam.covariance("r"))[6:]).max() < 0.02


def test_an_empty_reading_moves_the_robot_and_corrects_nothing() -> None:
    slam = ran(events(2, 10)[0])
    P = slam.covariance("r.gyro")
    for ids in (None, ()):
        assert slam.process(km.Scan(1.2, "r", "gyro", (), ids)).observations == ()
    np.testing.assert_array_equal(slam.covariance("r.gyro"), P)
    assert slam.process(km.Scan(1.3, "r", "gyro", [[0.1]])).observations[0].outcome == "associated"


def test_a_rate_of_the_state_needs_a_noise_of_each_reading() -> None:
    density = km.sensors.Gyro2D(0.0, sigma_rad_per_sqrt_s=0.01)
    km.Slam(km.Robot("r", motion=km.motion.Unicycle(), sensors={"gyro": km.Mount(density)}))
    with pytest.raises(ModelError, match="Gyro2D: the noise of one reading is 0, expected a positive number"):
        km.Slam(km.Robot("r", motion=km.motion.ConstantTurnRate(), sensors={"gyro": km.Mount(density)}))


@pytest.mark.parametrize(("plane", "start_m"), [(True, 3.0), (False, 3.0), (False, 0.1)])
def test_a_heading_is_found_with_an_exact_receiver_on_a_lever_arm_that_is_not_known(
    plane: bool, start_m: float
) -> None:
    """While it stands only the antenna's place is known; as it drives, the heading is found, off by 20 deg at first."""
    d, found = (2, []) if plane else (3, [])
    sigmas = np.array([*[start_m] * d, *([] if plane else [0.003] * 2), 0.35, *[0.5] * d])
    motion: Any = km.motion.Odometry2D(0.01, 0.01, 0.005) if plane else km.motion.Odometry3D(0.01, 0.01, 0.01, 0.005)
    gps: Any = (km.sensors.Gps2D if plane else km.sensors.Gps3D)(0.02)
    start, pose = (np.zeros(3), 3) if plane else (np.array([0.0, 0, 0, 0, 0, 0, 1]), 6)
    noise = np.array([0.01] * d + [0.005] * (pose - d))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        off = rng.normal(0, sigmas)
        x, at = motion.space.plus(start, off[:pose]), start.copy()
        at[:d] += off[pose:]
        arm_cov = np.zeros((pose, pose))
        arm_cov[:d, :d] = 0.25 * np.eye(d)
        mount = km.Mount(gps, at=start, cov=arm_cov)
        cov = np.diag(sigmas[:pose] ** 2)
        slam = km.Slam(km.Robot("r", motion=motion, start=start, cov=cov, sensors={"gps": mount}))
        for k in range(80):
            if k >= 20:  # it stood so far
                u = np.zeros(pose)
                u[0], u[-1] = min(0.1, 0.004 * (k - 19)), 0.02
                slam.process(km.Control(0.1 * k, "r", u))
                x = motion.move(x, u + rng.normal(0, noise), 0.1)[0]
            antenna = (compose if plane else compose3)(x, at)[0][:d]
            slam.process(km.Scan(0.1 * k, "r", "gps", [antenna + rng.normal(0, 0.02, d)]))
        e = np.append(motion.space.minus(slam.mean("r"), x), slam.mean("r.gps")[:d] - at[:d])
        rows = [*range(pose), *range(pose, pose + d)]
        found.append(e @ np.linalg.solve(slam.covariance("r", "r.gps")[np.ix_(rows, rows)], e))
    low, high = chi2.ppf([0.0005, 0.9995], len(sigmas) * len(found))
    assert low < sum(found) < (high if plane or start_m < 1 else 2 * high)  # what is left in space: docs/invariant.md


def test_heights_of_a_receiver_have_a_noise_of_their_own() -> None:
    """Horizontally and vertically as uncertain as single readings and the start, or a reading's own noise, say."""
    for own, sigmas in ((None, (0.02, 0.02, 0.3)), (np.diag([0.01, 0.04, 0.09])[None], (0.1, 0.2, 0.3))):
        receiver = km.Mount(km.sensors.Gps3D(0.02, sigma_z_m=0.3))
        start = np.array([0.0, 0, 0, 0, 0, 0, 1])
        slam = km.Slam(
            km.Robot(
                "r", km.motion.Odometry3D(), start, cov=np.diag([1.0] * 3 + [0.0] * 3), sensors={"receiver": receiver}
            )
        )
        slam.process(km.Scan(0.0, "r", "receiver", [[0.1, 0.2, 0.3]], cov=own))
        np.testing.assert_allclose(np.diag(slam.covariance("r"))[:3], 1 / (1 + 1 / np.square(sigmas)), rtol=1e-9)
    assert np.diag(km.sensors.Gps3D(0.02).noise(np.zeros((1, 3)))[0]).tolist() == [0.02**2] * 3


def test_what_measures_its_robot_expects_no_landmark() -> None:
    with pytest.raises(MapError, match="sensor 'gyro' of 'r' measures no landmarks, expected one of landmarks"):
        km.Slam(robot()).expect("r", "gyro")
