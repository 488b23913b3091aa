"""Landmarks known exactly: outside the map, and yet as good as in it with a covariance of zero."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import MapError
from kalmark.geometry.frames import compose

LASER = km.sensors.RangeBearing(0.1, 0.02, range_max_m=9.0)
AT = np.array([0.3, 0.1, 0.2])
NO_COV = np.zeros((2, 2))
ESTIMATORS = [km.estimators.Ekf(), km.estimators.Invariant(), km.estimators.Fej()]
POSTS = np.random.default_rng(1).uniform(-8, 8, (25, 2))


def slam_of(estimator: Any = None, sensor: Any = LASER, **keys: Any) -> km.Slam:
    mount = km.Mount(sensor, at=AT, cov=keys.pop("mount_cov", None))
    motion, cov = keys.pop("motion", km.motion.Unicycle(0.1, 0.05)), np.diag([0.3, 0.3, 0.1]) ** 2
    rover = km.Robot("rover", motion, (0, 0, 0), {"laser": mount}, cov=keys.pop("cov", cov))
    return km.Slam([rover], estimator=estimator or km.estimators.Invariant(), **keys)


def drive(slam: km.Slam, steps: int = 30, ids: bool = True, posts: Any = POSTS, seed: int = 5) -> list[km.Report]:
    """Drive a circle among posts that are observed with noise; return the reports of the scans."""
    rng, pose, reports = np.random.default_rng(seed), np.array([0.3, -0.2, 0.1]), []
    for k in range(steps):
        u = np.array([0.8, 0.3])
        slam.process(km.Control(t_s=0.1 * k, robot="rover", u=u + rng.normal(size=2) * (0.1, 0.05)))
        pose = km.motion.Unicycle().move(pose, u, 0.1)[0]
        y = km.geometry.observe(compose(pose, AT)[0], posts)[0]
        near = np.flatnonzero(y[:, 0] < 6.0)
        y = y[near] + rng.normal(size=(len(near), 2)) * (0.1, 0.02)
        names = near.tolist() if ids else None
        reports.append(slam.process(km.Scan(t_s=0.1 * k + 0.1, robot="rover", sensor="laser", y=y, ids=names)))
    return reports


def both(**keys: Any) -> tuple[km.Slam, km.Slam]:
    """Return two filters: the posts are outside the map of one, and in that of the other with the covariance zero."""
    outside, inside = slam_of(**keys), slam_of(**keys)
    for i, post in enumerate(POSTS):
        outside.add_landmark(i, post)
        inside.add_landmark(i, post, NO_COV)
    return outside, inside


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__)
def test_as_in_the_map_with_covariance_zero(estimator: Any) -> None:
    outside, inside = both(estimator=estimator)
    assert outside.map.n == 3
    for one, other in zip(drive(outside), drive(inside), strict=True):
        assert [o[1:4] for o in one.observations] == [o[1:4] for o in other.observations]
        for key in ("e", "z", "Z"):
            np.testing.assert_allclose(getattr(one, key), getattr(other, key), atol=1e-9)
    np.testing.assert_allclose(outside.mean("rover"), inside.mean("rover"), atol=1e-9)
    np.testing.assert_allclose(outside.covariance("rover"), inside.covariance("rover"), atol=1e-9)
    assert {row.id: row.observations for row in outside.landmarks()} == {
        row.id: row.observations for row in inside.landmarks()
    }


@pytest.mark.usefixtures("never_found")  # the first scan may place the robot, which starts elsewhere
@pytest.mark.parametrize(
    "association", [km.association.NearestNeighbour(), km.association.GlobalAssignment(),
                    km.association.JointCompatibility(), km.association.Automatic()],
    ids=lambda a: type(a).__name__,
)  # fmt: skip
def test_found_without_ids_as_in_the_map(association: Any) -> None:
    outside, inside = both(association=association)
    used = total = 0
    for one, other in zip(drive(outside, ids=False), drive(inside, ids=False), strict=True):
        names = [o.landmark for o in one.observations if o.outcome == "associated"]
        assert names == [o.landmark for o in other.observations if o.outcome == "associated"]
        used, total = used + len(names), total + len(one.observations)
    assert used > 0.7 * total
    np.testing.assert_allclose(outside.mean("rover"), inside.mean("rover"), atol=1e-9)
    np.testing.assert_allclose(outside.covariance("rover"), inside.covariance("rover"), atol=1e-9)
    assert len(outside.tracks.confirmed) == 0


def test_with_a_mount_in_the_map_and_a_sensor_in_python() -> None:
    own = km.pointwise(lambda v: [np.hypot(v[0], v[1]), np.arctan2(v[1], v[0])], np.diag([0.01, 0.0004]),
                       inverse=lambda y: [y[0] * np.cos(y[1]), y[0] * np.sin(y[1])], angular=(False, True),
                       columns=("range_m", "bearing_rad"))  # fmt: skip
    for keys in ({"mount_cov": np.eye(3) * 1e-3}, {"sensor": own}, {"map": "postponed"}):
        outside, inside = both(**keys)
        drive(outside, 8)
        drive(inside, 8)
        np.testing.assert_allclose(outside.mean("rover"), inside.mean("rover"), atol=1e-9)
        np.testing.assert_allclose(outside.covariance("rover"), inside.covariance("rover"), atol=1e-9)


@pytest.mark.parametrize("ids", [True, False])
def test_known_and_unknown_in_one_run(ids: bool) -> None:
    slam = slam_of(association=km.association.ByIdentity() if ids else km.association.Automatic())
    for i in range(0, 25, 2):
        slam.add_landmark(i, POSTS[i])
    drive(slam, 60, ids)
    assert len(slam.tracks.known) == 13
    mapped = slam.landmarks(exactly_known=False)
    assert len(mapped) >= 6
    for row in mapped:
        gaps = np.linalg.norm(POSTS - row.mean, axis=1)
        assert gaps.argmin() % 2 == 1
        assert gaps.min() < 4 * np.sqrt(np.trace(row.covariance)) + 0.05
    known = [row for row in slam.landmarks() if slam.is_known(row.id)]
    assert all((row.mean == POSTS[row.id]).all() and not row.covariance.any() for row in known)
    error = slam.covariance("rover", 0, mapped.ids[0])
    assert error.shape == (7, 7)
    assert not error[3:5].any()
    np.testing.assert_array_equal(error[5:, 5:], slam.covariance(mapped.ids[0]))


def test_expectations_of_known_landmarks() -> None:
    for keys in ({}, {"mount_cov": np.eye(3) * 1e-3}):
        outside, inside = both(**keys)
        drive(outside, 3)
        drive(inside, 3)
        one, other = outside.expect("rover", "laser"), inside.expect("rover", "laser")
        assert (one.names, one.why) == (other.names, other.why)
        for key in ("e", "Z", "E_r", "E_s", "E_l"):
            np.testing.assert_allclose(getattr(one, key), getattr(other, key), atol=1e-9)
        in_view = outside.expect("rover", "laser", in_view=True)
        assert in_view.names == tuple(name for name, seen in zip(one.names, one.in_view, strict=True) if seen)


def test_saved_and_loaded(tmp_path: Path) -> None:
    slam = slam_of(association=km.association.Automatic())
    for i, post in enumerate(POSTS[:20]):
        slam.add_landmark(f"p{i}", post)
    drive(slam, 10, ids=False)
    slam.save(tmp_path / "map.kmk")
    loaded = km.Slam.load(tmp_path / "map.kmk")
    loaded.save(tmp_path / "again.kmk")
    assert (tmp_path / "map.kmk").read_bytes() == (tmp_path / "again.kmk").read_bytes()
    assert [row.observations for row in loaded.landmarks()] == [row.observations for row in slam.landmarks()]
    y = slam.expect("rover", "laser", in_view=True).e
    for one in (slam, loaded):
        one.process(km.Scan(t_s=2.0, robot="rover", sensor="laser", y=y))
    np.testing.assert_array_equal(slam.mean("rover"), loaded.mean("rover"))


def test_names_removal_and_refusals() -> None:
    slam = slam_of()
    for i, post in enumerate(POSTS):
        slam.add_landmark(i, post)
    with pytest.raises(MapError, match="7 is in the map already"):
        slam.add_landmark(7, (0, 0))
    with pytest.raises(MapError, match="is not in the map"):
        slam.slot(7)
    assert slam.landmark_model(7) == km.landmarks.Point2D()
    np.testing.assert_array_equal(slam.place(7)[0], POSTS[7])
    slam.remove(7)
    slam.remove(24)
    assert not slam.is_known(7)
    assert [slam.mean(i).tolist() for i in (6, 8, 23)] == POSTS[[6, 8, 23]].tolist()
    assert len(slam.landmarks()) == 23
    slam.add_landmark(7, (1.0, 1.0), 0.01 * np.eye(2))
    assert slam.slot(7) >= 0


def anywhere(**keys: Any) -> km.Slam:
    """Return a filter of a robot that may be anywhere in the known map."""
    slam = slam_of(cov=np.diag([10.0, 10.0, 3.0]) ** 2, **keys)
    for i, post in enumerate(POSTS):
        slam.add_landmark(i, post)
    return slam


@pytest.mark.parametrize("motion", [km.motion.Unicycle(0.1, 0.05), km.motion.ConstantVelocity()])
@pytest.mark.parametrize("ids", [True, False])
def test_a_start_anywhere_is_found(ids: bool, motion: Any) -> None:
    slam = anywhere(association=km.association.Automatic(), motion=motion)
    rng, pose = np.random.default_rng(2), np.array([3.0, -2.0, 2.8])
    y = km.geometry.observe(compose(pose, AT)[0], POSTS)[0]
    near = np.flatnonzero(y[:, 0] < 6.0)
    y = y[near] + rng.normal(size=(len(near), 2)) * (0.05, 0.01)
    report = slam.process(km.Scan(t_s=0.1, robot="rover", sensor="laser", y=y, ids=near.tolist() if ids else None))
    assert [o.landmark for o in report.observations] == near.tolist()
    off, P = slam.mean("rover")[:3] - pose, slam.covariance("rover")[:3, :3]
    assert off @ np.linalg.solve(P, off) < 16
    assert np.sqrt(np.diag(P)).max() < 0.2


def test_a_start_anywhere_is_found_by_bearings_with_ids() -> None:
    mount = km.Mount(km.sensors.Bearing(0.01), at=AT)
    cov = np.diag([10.0, 10.0, 3.0]) ** 2
    slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), start=(0, 0, 0), cov=cov, sensors={"camera": mount}))
    for i, post in enumerate(POSTS):
        slam.add_landmark(i, post)
    rng, pose = np.random.default_rng(2), np.array([3.0, -2.0, 2.8])
    y = km.geometry.observe(compose(pose, AT)[0], POSTS)[0]
    near = np.flatnonzero(y[:, 0] < 6.0)
    y = y[near, 1:] + 0.01 * rng.normal(size=(len(near), 1))
    two = slam.process(km.Scan(t_s=0.1, robot="rover", sensor="camera", y=y[:2], ids=near[:2].tolist()))
    assert {o.outcome for o in two.observations} == {"deferred"}
    report = slam.process(km.Scan(t_s=0.2, robot="rover", sensor="camera", y=y, ids=near.tolist()))
    assert {o.outcome for o in report.observations} == {"associated"}
    off, P = slam.mean("rover") - pose, slam.covariance("rover")
    assert off @ np.linalg.solve(P, off) < 16
    assert np.sqrt(np.diag(P)).max() < 0.2


def test_a_start_that_a_scan_does_not_determine_waits() -> None:
    slam = anywhere(association=km.association.Automatic())
    report = slam.process(km.Scan(t_s=0.1, robot="rover", sensor="laser", y=[[3.0, 0.1], [2.0, 1.0]]))
    assert {o.outcome for o in report.observations} == {"deferred"}
    assert report.observations[0].reason == "its scan has 2 observations, a start needs 3"
    grid = slam_of(cov=np.diag([10.0, 10.0, 3.0]) ** 2, association=km.association.Automatic())
    places = [(2.0 * i, 2.0 * j) for i in range(6) for j in range(6)]
    for i, post in enumerate(places):
        grid.add_landmark(i, post)
    y = km.geometry.observe(np.array([4.3, 4.1, 0.3]), np.array(places))[0]
    report = grid.process(km.Scan(t_s=0.1, robot="rover", sensor="laser", y=y[y[:, 0] < 3.5]))
    assert "from another pose" in report.observations[0].reason
    assert len(grid.landmarks(exactly_known=False)) == 0
    assert grid.covariance("rover")[2, 2] == pytest.approx(9.0)
