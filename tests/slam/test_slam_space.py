"""Slam in space, end to end: cameras, budgets, depth that becomes clear, uncertain mounts, lines, tags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import MapError, ModelError
from kalmark.geometry import SE3
from kalmark.geometry.frames3d import compose, move
from kalmark.geometry.rotations import from_euler, multiply
from kalmark.geometry.spaces import MOUNTS
from kalmark.models.landmarks import BUILT_IN, LINES
from kalmark.models.motion import coast
from kalmark.models.pointwise import jacobian

FORWARD = from_euler(np.radians([-90.0, 0.0, -90.0]))[0]  # a camera that looks along the robot's x
AT = np.concatenate([[0.0, 0.0, 0.6], FORWARD])
ORIGIN = np.array([0.0, 0, 0, 0, 0, 0, 1])
U = np.array([0.08, 0, 0, 0, 0, 0.03])
SIGMA_M, SIGMA_RAD = 0.005, 0.001
SIGMAS = np.repeat([SIGMA_M, SIGMA_RAD], 3)
RING = np.array(
    [
        [r * np.cos(a), 2.7 + r * np.sin(a), z]
        for a in np.arange(0, 2 * np.pi, 0.25)
        for r, z in ((5.5, 0.0), (6.5, 1.3))
    ]
)  # around the circle that the robot drives
POINT = km.landmarks.Point3D()


def robot(sensor: Any, landmark: Any = None, *, motion: Any = None, **mount: Any) -> km.Robot:
    odometry = km.motion.Odometry3D(SIGMA_M, SIGMA_M, SIGMA_M, SIGMA_RAD)
    return km.Robot("r", motion or odometry, None, {"eye": km.Mount(sensor, AT, landmark, **mount)})


def drive(slam: km.Slam, steps: int, seed: int, at: np.ndarray = AT) -> tuple[np.ndarray, list[km.Report]]:
    """Drive a circle among the points; return the true pose and the reports."""
    rng, truth, reports = np.random.default_rng(seed), ORIGIN, []
    sensor: Any = slam.robots["r"].sensors["eye"].sensor
    for t in range(1, steps + 1):
        truth = move(truth, U)[0]
        slam.process(km.Control(t, "r", U + rng.normal(size=6) * SIGMAS))
        v = POINT.seen_from(compose(truth, at)[0], RING)[0]
        seen = np.flatnonzero(sensor.sees(v))
        y = sensor.expect(v[seen])[0] + rng.normal(size=(len(seen), len(sensor.columns)))
        reports.append(slam.process(km.Scan(t, "r", "eye", y, seen.tolist())))
    return truth, reports


def nees(slam: km.Slam, name: str, truth: np.ndarray, space: Any = SE3) -> float:
    d = space.minus(truth, slam.mean(name))
    return float(d @ np.linalg.solve(slam.covariance(name), d))


CAMERAS = [
    (km.sensors.Stereo(baseline_m=0.3), POINT),
    (km.sensors.Stereo(baseline_m=0.3), km.landmarks.InverseDepth3D()),
    (km.sensors.PinHole(distortion=(-0.2, 0.05)), km.landmarks.InverseDepth3D()),
    (km.sensors.PinHole(), km.landmarks.AnchoredHomogeneous()),
    (km.sensors.PinHole(), km.landmarks.Homogeneous()),
]


@pytest.mark.parametrize(("sensor", "landmark"), CAMERAS, ids=lambda m: type(m).__name__)
def test_a_camera_maps_what_it_sees_and_says_how_well(sensor: Any, landmark: Any) -> None:
    values = []
    for seed in range(6):
        slam = km.Slam([robot(sensor, landmark)])
        truth, _ = drive(slam, 60, seed)
        values.append(nees(slam, "r", truth))
        assert np.linalg.norm(slam.mean("r")[:3] - truth[:3]) < 0.25
    assert 1.0 < np.mean(values) < 13.0, values  # 6 degrees of freedom, 6 runs; the textbook filter is far above


def test_depth_that_has_become_clear_makes_a_euclidean_point_where_the_landmark_is() -> None:
    slam = km.Slam([robot(km.sensors.PinHole(), km.landmarks.InverseDepth3D())], reparametrize=0.1)
    drive(slam, 60, 0)
    clear = [l for l in slam.landmarks() if l.kind == "point3"]
    assert len(clear) > 5
    for landmark in clear:
        d = landmark.mean - RING[int(landmark.id)]
        assert d @ np.linalg.solve(landmark.covariance, d) < 25, landmark.id
    never = km.Slam([robot(km.sensors.PinHole(), km.landmarks.InverseDepth3D())], reparametrize=None)
    drive(never, 60, 0)
    assert set(never.landmarks().kinds) == {"inverse_depth"}


def test_a_budget_limits_corrections_and_starts_and_spreads_these_over_the_image() -> None:
    attention = km.Attention(updates=4, starts=1, first_starts=6, grid=(4, 3), margin_px=30)
    slam = km.Slam([robot(km.sensors.PinHole(), attention=attention)])
    _, reports = drive(slam, 20, 1)
    for i, report in enumerate(reports):
        counts = {o: sum(x.outcome == o for x in report.observations) for o in ("new", "associated")}
        assert counts["associated"] <= 4
        assert counts["new"] <= (6 if i == 0 else 1)
        for x in report.observations:
            if x.outcome == "new":
                u, v = report.y[x.index]
                assert 30 <= u <= 610 and 30 <= v <= 450
    first = [tuple((reports[0].y[x.index] // 160).astype(int)) for x in reports[0].observations if x.outcome == "new"]
    crowded = [tuple((y // 160).astype(int)) for y in reports[0].y]
    assert len(set(first)) == min(6, len(set(crowded)))
    told = [x.reason for x in reports[-1].observations if x.outcome == "ignored"]
    assert "not among the 4 of most information" in told


def test_a_landmark_that_is_not_found_where_it_should_be_is_given_up() -> None:
    slam = km.Slam([robot(km.sensors.PinHole(), attention=km.Attention(delete=True))])
    truth = move(ORIGIN, U)[0]
    seen = np.flatnonzero(km.sensors.PinHole().sees(POINT.seen_from(compose(truth, AT)[0], RING)[0]))
    slam.process(km.Scan(0, "r", "eye", [[320.0, 240.0]], ["ghost"]))
    removed: dict[Any, str] = {}
    for t in range(1, 30):
        slam.process(km.Control(t, "r", U * 0))
        v = POINT.seen_from(compose(slam.mean("r"), AT)[0], RING[seen])[0]
        y = km.sensors.PinHole().expect(v)[0]
        removed |= dict(slam.process(km.Scan(t, "r", "eye", y, seen.tolist())).removed)
    assert [*removed] == ["ghost"] and "found in" in removed["ghost"]
    assert "ghost" not in slam.landmarks().ids


def test_a_mount_in_the_map_calibrates_itself() -> None:
    error = np.array([0.02, -0.02, 0.03, 0.01, -0.015, 0.012])
    at = np.array([0.0, 0, 0.6, 0, 0, 0, 1])
    prior, noise = np.diag(np.repeat([0.05, 0.03], 3)) ** 2, np.array([0.03, 0.003, 0.003])
    lidar = km.sensors.RangeBearing3D(*noise, fov_rad=2.0)
    values = []
    for seed in range(5):
        eye = km.Mount(lidar, MOUNTS[7].plus(at, error), cov=prior)
        moving = km.Robot("r", km.motion.Odometry3D(SIGMA_M, SIGMA_M, SIGMA_M, SIGMA_RAD), None, {"eye": eye})
        slam = km.Slam([moving])
        rng, truth = np.random.default_rng(seed), ORIGIN
        for t in range(1, 100):
            u = np.array([0.08, 0, 0, 0.03 * np.sin(t / 5), 0.03 * np.cos(t / 7), 0.06])
            truth = move(truth, u)[0]
            slam.process(km.Control(t, "r", u + rng.normal(size=6) * SIGMAS))
            v = POINT.seen_from(compose(truth, at)[0], RING)[0]
            seen = np.flatnonzero(lidar.sees(v))
            y = lidar.expect(v[seen])[0] + rng.normal(size=(len(seen), 3)) * noise
            slam.process(km.Scan(t, "r", "eye", y, seen.tolist()))
        values.append(nees(slam, "r.eye", at, MOUNTS[7]))
        assert np.sqrt(np.diag(slam.covariance("r.eye"))[3:]).max() < 0.2 * 0.03
    assert np.mean(values) < 9, values
    with pytest.raises(km.KalmarkError, match="is a sensor's mount"):
        slam.remove("r.eye")


def test_lines_locate_the_robot_and_their_segments_grow() -> None:
    walls = np.array(
        [[[3, y, 0], [3, y, 2.5]] for y in (-2.0, -1, 0, 1, 2)] + [[[3, -2, z], [3, 2, z]] for z in (0.2, 2.3)]
    )
    for kind in BUILT_IN[-5:]:
        sensor = km.sensors.Segments()
        slam, rng, truth = km.Slam([robot(sensor, kind())]), np.random.default_rng(2), ORIGIN
        for t in range(1, 40):
            u = np.array([0.02, 0.04 * np.sin(t / 6), 0.02 * np.cos(t / 4), 0, 0, 0.01 * np.cos(t / 5)])
            truth = move(truth, u)[0]
            slam.process(km.Control(t, "r", u + rng.normal(size=6) * SIGMAS))
            there, y = sensor.sees_segments(compose(truth, AT)[0], walls[:, 0], walls[:, 1])
            ids = np.flatnonzero(there)
            slam.process(km.Scan(t, "r", "eye", y[ids] + rng.normal(size=(len(ids), 4)), ids.tolist()))
        assert nees(slam, "r", truth) < 30, kind.kind
        assert slam.landmarks().kinds == [kind.kind] * len(walls)
        ends, cov = slam.segment(5)
        assert ends.shape == (2, 3) and cov.shape == (2, 3, 3) and np.isfinite(ends).all()
        assert np.linalg.norm(slam.mean("r")[:3] - truth[:3]) < 0.1, kind.kind


def test_a_place_of_three_numbers_is_a_point_of_space_also_where_no_sensor_is() -> None:
    slam = km.Slam(km.Robot("r", km.motion.Odometry3D()))
    slam.add_landmark("mast", mean=(4.0, 1.0, 0.5), cov=0.01 * np.eye(3))
    slam.add_landmark("exact", mean=(2.0, 1.0, 0.0))
    assert slam.landmark_model("mast").kind == slam.landmark_model("exact").kind == "point3"
    np.testing.assert_allclose(slam.mean("mast"), (4.0, 1.0, 0.5))
    with pytest.raises(MapError, match="expected 3 finite"):
        slam.add_landmark("flat", mean=(4.0, 1.0))


@pytest.mark.parametrize("kind", LINES, ids=lambda kind: kind.__name__)
def test_a_line_s_place_has_its_own_covariance(kind: Any) -> None:
    model, rng = kind(), np.random.default_rng(7)
    slam = km.Slam([robot(km.sensors.Segments())], landmarks=model)
    l, A = rng.normal(size=model.space.size) + 0.5, rng.normal(size=(model.space.dof,) * 2)
    slam.add_landmark("wall", l, A @ A.T * 1e-4)

    def foot(error: np.ndarray) -> np.ndarray:
        """Return the point of the line nearest to its anchor, or to the origin, by two of its points."""
        moved = model.space.plus(l, error)
        (p, q), a = model.endpoints(moved[None], np.array([[0.0, 1.0]]))[0][0], moved[:3] * model.anchored
        return p - (p - a) @ (q - p) / ((q - p) @ (q - p)) * (q - p)

    where, P = slam.place("wall")
    np.testing.assert_allclose(where, foot(np.zeros(model.space.dof)), rtol=1e-9, atol=1e-12)
    J = jacobian(foot, np.zeros(model.space.dof))
    np.testing.assert_allclose(P, J @ slam.covariance("wall") @ J.T, rtol=1e-5, atol=1e-7 * np.abs(P).max())


@pytest.mark.parametrize("sensor", [km.sensors.TagPose(), km.sensors.TagCorners()], ids=lambda s: type(s).__name__)
def test_tags_locate_the_robot_by_their_corners_or_their_poses(sensor: Any) -> None:
    facing = multiply(FORWARD, from_euler(np.array([np.pi, 0.3, 0.2]))[0])
    tags = np.array([np.concatenate([[3, y, z], facing]) for y in (-1.0, 0, 1) for z in (0.2, 1.0)])
    slam, rng, truth = km.Slam([robot(sensor)]), np.random.default_rng(3), ORIGIN
    for t in range(1, 40):
        u = np.array([0.03, 0, 0.01, 0, 0, 0.01])
        truth = move(truth, u)[0]
        slam.process(km.Control(t, "r", u + rng.normal(size=6) * SIGMAS))
        v = km.landmarks.Tag().seen_from(compose(truth, AT)[0], tags)[0]
        if len(sensor.columns) == 9:
            size = np.column_stack([np.zeros((6, 8)), np.full(6, 0.3)])
            y = sensor.expect(v, size)[0] + np.column_stack([rng.normal(size=(6, 8)), np.zeros(6)])
        else:
            y = np.array([SE3.plus(x, rng.normal(size=6) * 0.02) for x in v])
        slam.process(km.Scan(t, "r", "eye", y, range(6)))
    assert nees(slam, "r", truth) < 30
    for i in range(6):
        assert nees(slam, i, tags[i]) < 35  # type: ignore[arg-type]


def test_a_robot_at_constant_velocity_coasts_from_scan_to_scan() -> None:
    motion = km.motion.ConstantVelocity3D(sigma_v_mps_per_sqrt_s=0.02, sigma_w_radps_per_sqrt_s=0.02)
    start = np.concatenate([ORIGIN, [0.5, 0, 0], [0, 0, 0.2]])
    lidar = km.Mount(km.sensors.RangeBearing3D())
    slam = km.Slam([km.Robot("r", motion, start, {"eye": lidar}, np.diag(np.repeat([1e-3, 0.1], 6)) ** 2)])
    rng, truth = np.random.default_rng(4), start
    for t in range(60):
        v = POINT.seen_from(truth[:7], RING)[0]
        y = lidar.sensor.expect(v)[0] + rng.normal(size=v.shape) * [0.1, 0.02, 0.02]
        slam.process(km.Scan(0.1 * t, "r", "eye", y, range(len(RING))))
        truth = coast(truth, np.append(rng.normal(size=3), rng.normal(size=3)) * 0.02 * np.sqrt(0.1), np.zeros(0), 0.1)[
            0
        ]
    assert slam.mean("r").shape == (13,) and slam.covariance("r").shape == (12, 12)
    assert np.linalg.norm(slam.mean("r")[7:10] - truth[7:10]) < 0.15
    slam.process(km.Control(6.0, "r", np.array([0.3, 0, 0, 0, 0, 0])))
    before = slam.mean("r")
    slam.process(km.Scan(7.0, "r", "eye"))
    np.testing.assert_allclose(slam.mean("r")[:3], before[:3] + before[7:10], atol=1e-9)


def test_what_a_camera_slam_knows_is_saved_and_resumes_bit_for_bit(tmp_path: Path) -> None:
    attention = km.Attention(updates=6, starts=2, delete=True, grid=(3, 2))
    mount = {"attention": attention, "cov": np.diag(np.full(6, 1e-4)), "association": km.association.ByIdentity(0.99)}
    maker = robot(km.sensors.PinHole(distortion=(-0.1, 0.02)), km.landmarks.InverseDepth3D(), **mount)
    slam = km.Slam([maker])
    drive(slam, 30, 5)
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    assert again.robots["r"].sensors["eye"].attention == attention
    for one in (slam, again):
        one.process(km.Control(31, "r", U))
        v = POINT.seen_from(compose(one.mean("r"), one.mean("r.eye"))[0], RING)[0]
        seen = np.flatnonzero(km.sensors.PinHole().sees(v))
        one.process(km.Scan(31, "r", "eye", km.sensors.PinHole().expect(v[seen])[0], seen.tolist()))
    np.testing.assert_array_equal(slam.map.x[: slam.map.x_n], again.map.x[: again.map.x_n])
    one, other = (np.tril(s.map.P[: s.map.n, : s.map.n]) for s in (slam, again))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: km.Slam([robot(km.sensors.RangeBearing3D(), km.landmarks.Homogeneous())]), "does not see a landmark"),
        (lambda: km.Slam([robot(km.sensors.PinHole(), km.landmarks.PlueckerLine())]), "does not see a landmark"),
        (lambda: km.sensors.PinHole(lens="wide"), "lens is 'wide', expected one of radial"),
        (lambda: km.sensors.PinHole(fx_px=0), "expected a positive number"),
        (lambda: km.sensors.PinHole(distortion=("a",)), "is ('a',), expected a list of finite numbers"),
        (lambda: km.Attention(updates=-1), "updates is -1"),
        (lambda: km.Attention(grid=(0, 3)), "expected 2 numbers, each a whole number of at least 1"),
        (lambda: robot(km.sensors.PinHole(), cov=np.eye(3)), "expected (6, 6)"),
    ],
)
def test_what_cannot_work_in_space_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ModelError) as refused:
        make()
    assert message in str(refused.value) and "\n" not in str(refused.value)
