"""Bearings alone, in the plane: inverse depths started at first sight, and what becomes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import ModelError
from kalmark.geometry import wrap
from kalmark.geometry.frames import compose
from kalmark.geometry.gaussian import gate
from kalmark.models.observe import expectation, inverse_expectation, linearize, linearize_chain, view_of
from kalmark.models.pointwise import jacobian

DEG = np.pi / 180
EYE = km.sensors.Bearing(1 * DEG)
INVERSE = km.landmarks.InverseDepth2D()
SE2_ANGLES, ANGLES = (False, False, True), (False, False, True, False)


def close(analytic: np.ndarray, numeric: np.ndarray) -> None:
    np.testing.assert_allclose(analytic, numeric, rtol=1e-6, atol=1e-6 * (1 + np.abs(numeric).max()))


def drawn(rng: np.random.Generator, i: int) -> np.ndarray:
    """Draw an inverse depth (1, 4), some at infinity and some beyond it."""
    return np.array([[*rng.normal(size=2) * 5, rng.uniform(-3, 3), [0.0, -0.02, 0.1, rng.uniform(0, 1)][i % 4]]])


def test_an_inverse_depth_of_the_plane_has_the_jacobians_of_its_differences() -> None:
    rng = np.random.default_rng(0)
    for i in range(200):
        r, mount, l = rng.normal(size=3) * [20, 20, 3], rng.normal(size=3), drawn(rng, i)
        if np.linalg.norm(INVERSE.seen_from(compose(r, mount)[0], l)[0]) < 0.3:
            continue  # next to the landmark differences are no derivatives
        e, E_r, E_s, E_l = expectation(r, mount, EYE, INVERSE, l)
        close(E_r[0], jacobian(lambda x: expectation(x, mount, EYE, INVERSE, l)[0][0], r, (True,)))
        close(E_s[0], jacobian(lambda x: expectation(r, x, EYE, INVERSE, l)[0][0], mount, (True,)))
        close(E_l[0], jacobian(lambda x: expectation(r, mount, EYE, INVERSE, x[None])[0][0], l[0], (True,)))
        view = view_of(EYE, INVERSE, mount)
        for one, other in zip(linearize(view, r, l, e + 0.1), linearize_chain(view, r, l, e + 0.1), strict=True):
            np.testing.assert_array_equal(one, other)
        y = rng.uniform(-3, 3, (1, 1))
        _, L_r, L_s, L_y, _ = inverse_expectation(r, mount, EYE, INVERSE, y)
        close(L_r[0], jacobian(lambda x: inverse_expectation(x, mount, EYE, INVERSE, y)[0][0], r, ANGLES))
        close(L_s[0], jacobian(lambda x: inverse_expectation(r, x, EYE, INVERSE, y)[0][0], mount, ANGLES))
        close(L_y[0], jacobian(lambda x: inverse_expectation(r, mount, EYE, INVERSE, x[None])[0][0], y[0], ANGLES))
        if l[0, 3]:
            close(INVERSE.to_point(l)[1][0], jacobian(lambda x: INVERSE.to_point(x[None])[0][0], l[0], (False, False)))


def test_a_bearing_starts_an_inverse_depth_whose_prior_reaches_from_the_nearest_to_infinity() -> None:
    r, mount, y = np.array([1.0, -2.0, 0.7]), np.array([0.2, 0.1, -0.3]), np.array([[0.4]])
    l, *_, prior = inverse_expectation(r, mount, EYE, INVERSE, y)
    T = compose(r, mount)[0]
    np.testing.assert_allclose(l[0], [T[0], T[1], T[2] + 0.4, 0.5], atol=1e-12)
    np.testing.assert_allclose(prior[0], np.diag([0, 0, 0, 0.25**2]), atol=1e-15)
    np.testing.assert_allclose(expectation(r, mount, EYE, INVERSE, l)[0], y, atol=1e-12)


@pytest.mark.parametrize(
    "sensor", [km.sensors.RangeBearing(), km.sensors.Position2D(), km.sensors.Range()], ids=lambda s: type(s).__name__
)
def test_a_sensor_of_ranges_refuses_landmarks_of_unknown_scale(sensor: Any) -> None:
    with pytest.raises(ModelError, match="does not see the rays to landmarks of unknown depth"):
        km.Slam([rover(sensor)], landmarks=INVERSE)


# ---------------------------------------------------------------------- whole runs
def rover(sensor: Any = EYE, landmark: Any = None, **more: Any) -> km.Robot:
    mount = km.Mount(sensor, at=(0.2, 0.1, 0.3), landmark=landmark)
    return km.Robot("r", km.motion.Odometry2D(0.01, 0.01, 0.2 * DEG), sensors={"eye": mount}, **more)


def drive(
    seed: int, steps: int = 60, points: Any = ((6.0, 3.0), (9.0, -4.0), (-3.0, 5.0)), start: Any = (0.0, 0.0, 0.0)
) -> tuple[list[Any], np.ndarray]:
    """Return the events of a robot on an arc that sees all points, and its true path."""
    rng, pose, events, path = np.random.default_rng(seed), np.array(start), [], []
    for k in range(steps):
        u = np.array([0.25, 0.0, 0.03])
        pose = compose(pose, u)[0]
        events.append(km.Control(0.1 * k, "r", u + rng.normal(size=3) * [0.01, 0.01, 0.2 * DEG]))
        v = km.geometry.to_frame(compose(pose, np.array([0.2, 0.1, 0.3]))[0], np.array(points))[0]
        y = wrap(np.arctan2(v[:, 1], v[:, 0]) + rng.normal(size=len(v)) * 1 * DEG)
        events.append(km.Scan(0.1 * k, "r", "eye", y[:, None], list(range(1, len(v) + 1))))
        path.append(pose)
    return events, np.array(path)


def run(events: list[Any], slam: km.Slam) -> km.Slam:
    for event in events:
        slam.process(event)
    return slam


def test_pose_and_points_are_consistent_over_seeds() -> None:
    """The last pose, NEES of 3, and each landmark of those near enough to have become points, NEES of 2."""
    pose, points, count = 0.0, 0.0, 0
    truth = np.array([(6.0, 3.0), (9.0, -4.0), (-3.0, 5.0)])
    for seed in range(40):
        events, path = drive(seed)
        slam = run(events, km.Slam([rover()]))
        e = np.append(path[-1][:2] - slam.mean("r")[:2], wrap(path[-1][2] - slam.mean("r")[2]))
        e[:2] = km.geometry.V_inverse(e[2]) @ e[:2]
        pose += float(e @ np.linalg.solve(slam.covariance("r"), e)) / 40
        for i in (1, 2, 3):
            assert slam.landmark_model(i).kind == "point"  # type: ignore[union-attr]
            d = truth[i - 1] - slam.mean(i)
            points += float(d @ np.linalg.solve(slam.covariance(i), d))
            count += 1
    assert 2.0 < pose < 4.1, "40 runs: chi-square of 120 degrees of freedom by 40, 99.9 %"
    assert 1.5 < points / count < 2.6


def test_a_far_landmark_keeps_its_inverse_depth_and_is_right() -> None:
    inside = 0
    for seed in range(30):
        far = np.array([60.0, 40.0])
        events, _ = drive(seed, 30, (far,))
        slam = run(events, km.Slam([rover()]))
        assert slam.landmark_model(1) == INVERSE
        a, P = slam.mean(1), slam.covariance(1)[2:, 2:]
        ray = far - a[:2]
        e = np.array([wrap(np.arctan2(ray[1], ray[0]) - a[2]), 1 / np.hypot(*ray) - a[3]])
        inside += e @ np.linalg.solve(P, e) < gate(0.99, 2)
    assert inside >= 28


def test_turning_the_world_turns_the_estimate() -> None:
    start, turn = np.array([3.0, -2.0, 0.5]), 1.1
    events, _ = drive(3, 25)
    here = run(events, km.Slam([rover(start=start, cov=np.diag([0.1, 0.1, 0.2]) ** 2)]))
    space = here.robots["r"].motion.space
    there = run(events, km.Slam([rover(start=space.rotated(start, turn), cov=np.diag([0.1, 0.1, 0.2]) ** 2)]))
    for name in ("r", 1, 2, 3):
        model = space if name == "r" else here.landmark_model(name).space  # type: ignore[union-attr]
        d = model.minus(model.rotated(here.mean(name), turn), there.mean(name))
        np.testing.assert_allclose(d, 0, atol=1e-7)


def test_an_unknown_start_leaves_the_map_relative_to_the_robot_as_it_was() -> None:
    events, _ = drive(4, 25)
    sure = run(events, km.Slam([rover()]))
    lost = run(events, km.Slam([rover(cov=np.diag([0.5, 0.5, 20 * DEG]) ** 2)]))
    for i in (1, 2, 3):
        a, b = (km.geometry.to_frame(s.mean("r"), place(s, i)[None])[0] for s in (sure, lost))
        np.testing.assert_allclose(a, b, atol=1e-7)


def place(slam: km.Slam, i: int) -> np.ndarray:
    kind: Any = slam.landmark_model(i)
    mean = slam.mean(i)
    return mean if len(mean) == 2 else kind.to_point(mean[None])[0][0]


def test_the_postponed_map_equals_the_dense_one() -> None:
    events, _ = drive(5, 40, ((6.0, 3.0), (9.0, -4.0), (-3.0, 5.0), (70.0, 20.0)))
    dense, postponed = (run(events, km.Slam([rover()], map=m)) for m in ("dense", "postponed"))
    names = ("r", *dense.landmarks().ids)
    for name in names:
        np.testing.assert_allclose(postponed.mean(name), dense.mean(name), atol=1e-8)
    np.testing.assert_allclose(postponed.covariance(*names), dense.covariance(*names), atol=1e-9)


def test_a_map_saved_in_the_middle_resumes_bit_for_bit(tmp_path: Path) -> None:
    events, _ = drive(6, 20)
    straight = run(events[:21], km.Slam([rover()]))
    straight.save(tmp_path / "map.kmk")
    resumed = km.Slam.load(tmp_path / "map.kmk")
    for slam in (straight, resumed):
        run(events[21:], slam)
    names = ("r", *straight.landmarks().ids)
    assert [straight.mean(n).tobytes() for n in names] == [resumed.mean(n).tobytes() for n in names]
    assert straight.covariance(*names).tobytes() == resumed.covariance(*names).tobytes()


def test_a_surveyed_point_is_a_point_for_a_sensor_of_bearings() -> None:
    slam = km.Slam([rover()])
    slam.add_landmark(1, (5.0, 0.0), 0.01 * np.eye(2))
    assert slam.landmark_model(1) == km.landmarks.Point2D()
    (seen,) = slam.process(km.Scan(0, "r", "eye", [[-0.3]], [1])).observations
    assert seen.outcome == "associated"


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_lighthouses_lead_a_boat_whose_steps_are_longer_than_the_nearest_distance_of_the_prior(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles, motion = rng.uniform(-np.pi, np.pi, 12), km.motion.Odometry2D(0.1, 0.05, 0.01)
    lights = rng.uniform(100.0, 400.0, (12, 1)) * np.column_stack([np.cos(angles), np.sin(angles)])
    boat, pose = km.Slam(km.Robot("boat", motion, sensors={"eye": km.Mount(EYE)})), np.zeros(3)
    for k in range(240):
        u = np.array([4.0, 0.0, 0.08])  # m, m, rad: rounds of 50 m
        pose = compose(pose, u)[0]
        boat.process(km.Control(float(k), "boat", u + rng.normal(size=3) * [0.1, 0.05, 0.01]))
        bearings = km.geometry.observe(pose, lights)[0][:, 1:]
        report = boat.process(km.Scan(float(k), "boat", "eye", bearings + rng.normal(size=(12, 1)) * DEG, range(12)))
        assert not any(o.outcome == "rejected" for o in report.observations)
    off = motion.space.pose.minus(boat.mean("boat")[:3], pose)
    assert off @ np.linalg.solve(boat.covariance("boat")[:3, :3], off) < gate(0.999, 3)
    assert np.linalg.norm(off[:2]) < 3.0
