"""Runs in space: error coordinates, the frame of the truth, the files of the folder."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.geometry import SE3
from kalmark.geometry.frames3d import compose
from kalmark.geometry.pose_frames import ORIGIN
from kalmark.geometry.rotations import exp, left_jacobian_inverse, log, multiply
from kalmark.geometry.spaces import RHO, VECTOR3, Space, retract
from kalmark.logs.log import poses_of_size
from kalmark.report import LandmarkTable
from kalmark.results.evaluate import landmark_figures, last_observed_from
from kalmark.results.landmark_table import MapLandmarks
from kalmark.results.measures import point_error, pose_error, rotation_error
from kalmark.results.record import record
from kalmark.results.recording import tum
from kalmark.results.run import Run
from kalmark.results.truth import Truth
from results_space import START, slam_for, spiral


@pytest.fixture(scope="module")
def run() -> Run:
    log = spiral()
    return record(slam_for(log), log, progress=False)


def turns(count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return rng.normal(size=(count, 3)) * 10.0 ** -rng.integers(0, 7, (count, 1))


def test_rotation_errors_for_many_poses_at_once_are_those_for_one() -> None:
    a, b = (np.array([exp(v) for v in turns(40)[i::2]]) for i in (0, 1))
    conjugate = a * [-1, -1, -1, 1]
    expected = [log(multiply(q, p)) for q, p in zip(b, conjugate, strict=True)]
    np.testing.assert_allclose(rotation_error(a, b), expected, atol=1e-12)
    np.testing.assert_allclose(rotation_error(a, -b), expected, atol=1e-12)
    short = turns(40) * 0.7
    d = np.random.default_rng(2).normal(size=(40, 3))
    expected = [left_jacobian_inverse(v) @ x for v, x in zip(short, d, strict=True)]
    np.testing.assert_allclose(point_error(np.zeros((40, 3)), d, short, "log"), expected, atol=1e-14)


def test_log_coordinates_undo_the_retraction_of_the_filter_in_space() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        mean, d = np.concatenate([rng.normal(size=3), exp(rng.normal(size=3))]), rng.uniform(-1.5, 1.5, 6)
        own, world = mean.copy(), mean.copy()
        retract(SE3.atoms, own, d, d[3:].copy())
        retract(SE3.atoms, world, d, np.zeros(0))
        np.testing.assert_allclose(pose_error(mean, own, "log"), d, atol=1e-9)
        np.testing.assert_allclose(pose_error(mean, world, "world"), d, atol=1e-9)


def test_a_consistent_run_in_space_says_so() -> None:
    nees = []
    for seed in range(8):
        log = spiral(steps=30, seed=seed)
        summary = record(slam_for(log), log, progress=False).evaluate()
        nees.append(summary["robots"]["rover"]["pose_nees"])
    assert 4.0 < np.mean(nees) < 9.0
    figures = summary["robots"]["rover"]
    assert summary["frame"] == "truth"
    assert figures["ate_m"] <= figures["ate_raw_m"] < 0.1
    assert figures["heading_rmse_deg"] < 2.0
    assert 0.8 < summary["nis_per_dof"] < 1.2
    assert summary["landmark_rmse_m"] <= summary["landmark_rmse_raw_m"] < 0.2
    assert summary["warnings"] == []


def test_a_run_in_space_that_starts_in_a_frame_of_its_own_has_the_same_errors(run: Run) -> None:
    log = spiral()
    there = compose(np.concatenate([[7.0, -3.0, 2.0], exp(np.array([0.5, -0.9, 1.2]))]), START)[0]
    elsewhere = record(slam_for(log, start=there), log, progress=False)
    a, b = elsewhere.evaluate(), run.evaluate()
    assert a["frame"] == "start"
    for key in ("ate_m", "ate_raw_m", "heading_rmse_deg", "pose_nees", "pose_nees_world"):
        assert a["robots"]["rover"][key] == pytest.approx(b["robots"]["rover"][key], rel=1e-6), key
    assert a["landmark_rmse_raw_m"] == pytest.approx(b["landmark_rmse_raw_m"], rel=1e-6)


def test_trajectories_of_space_are_the_poses_themselves(run: Run) -> None:
    rows = np.array([line.split() for line in tum(run.history, "rover").splitlines()[1:]], dtype=float)
    np.testing.assert_allclose(rows[:, 1:], run.history.mean, atol=1e-9)


def test_truth_of_the_plane_and_of_space_fit_each_other() -> None:
    flat = np.array([[1.0, -2.0, 2.5], [0.0, 0.0, -3.0]])
    lifted = poses_of_size(flat, 7)
    np.testing.assert_allclose(poses_of_size(lifted, 3), flat)
    assert lifted[:, 2].tolist() == [0.0, 0.0]


class InverseDepth:
    """A point on a ray from the origin at the inverse distance rho: (x, y, z, rho), with or without a point of it."""

    kind = "inverse_depth"
    space = Space("inverse_depth", (VECTOR3, RHO))

    def place(self, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p = l[:, :3] / l[:, 3:]
        P_l = np.concatenate([np.tile(np.eye(3), (len(l), 1, 1)), -p[:, :, None]], axis=2) / l[:, 3, None, None]
        return p, P_l


class Line:
    """A line by two points at the abscissas 1 and 2 of rays from the origin."""

    kind = "homogeneous_line"
    space = Space("homogeneous_line", (VECTOR3, VECTOR3))
    first_ends = (1.0, 2.0)
    extend = True

    def abscissas(self, T: np.ndarray, l: np.ndarray, rays: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def endpoints(self, l: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        scale = np.repeat(t, 3, axis=1)
        return (scale * l).reshape(-1, 2, 3), (scale[:, :, None] * np.eye(6)).reshape(-1, 2, 3, 6)


def pretended(models: list[Any], means: list[Any], covariances: list[Any]) -> Any:
    """Return what looks like a filter with such landmarks."""
    table = LandmarkTable(
        ids=list(range(len(models))),
        kinds=[model.kind for model in models],
        means=[np.array(mean) for mean in means],
        covariances=covariances,
        observations=[2] * len(models),
    )
    space = SimpleNamespace(motion=SimpleNamespace(space=SE3))
    ends = {2: np.array([2.0, 3.0])}
    return SimpleNamespace(
        landmarks=lambda exactly_known=True: table,
        landmark_model=models.__getitem__,
        segment_ends=ends.get,
        robots={"r": space},
        is_known=lambda name: False,
        classes=lambda name: {},
    )


def mixed() -> MapLandmarks:
    tag, point = km.landmarks.Tag(), km.landmarks.Point3D()
    means = [[1.0, 2.0, 3.0], [1.0, 1.0, 0.0, 0.5], [0, 0, 1.0, 1, 1, 1], [1.0, 0, 2, 0, 0, 0, 1], [1.0, 0, 0, 0.0]]
    covariances = [np.eye(n) * 0.01 for n in (3, 4, 6, 6, 4)]
    return MapLandmarks.of(pretended([point, InverseDepth(), Line(), tag, InverseDepth()], means, covariances))


def test_every_landmark_has_its_place_in_the_table_and_comes_back_from_it(tmp_path: Any) -> None:
    landmarks = mixed()
    text = landmarks.to_csv()
    header = text.splitlines()[0].split(",")
    assert header[:8] == ["id", "kind", "x_m", "y_m", "z_m", "x2_m", "y2_m", "z2_m"]
    assert {"qw", "cov_xx", "cov_xy", "cov_zz", "cov_xx2", "cov_z2z2", "cov_xrx", "cov_rzrz"} <= set(header)
    assert "cov_x2rx" not in header
    assert landmarks.means[1].tolist() == [2.0, 2.0, 0.0]
    assert landmarks.covariances[1][0, 0] == pytest.approx(0.04 + 0.01 * 16)
    assert landmarks.means[2].tolist() == [0, 0, 2, 3, 3, 3]
    assert not np.isfinite(landmarks.means[4]).any(), "a point at infinity has no place"
    (tmp_path / "landmarks.csv").write_text(text)
    back = MapLandmarks.read(tmp_path / "landmarks.csv")
    assert back.in_space
    assert (back.ids, back.kinds, back.to_csv()) == (landmarks.ids, landmarks.kinds, text)


def test_figures_of_others_stand_in_the_summary_under_their_name(run: Run) -> None:
    log = replace(spiral(steps=3), reference={"slamtb": {"ate_m": 0.25}})
    given = record(slam_for(log), log, progress=False)
    assert given.evaluate()["slamtb"] == {"ate_m": 0.25}
    assert "slamtb" not in run.evaluate()


def test_lines_are_judged_across_and_only_if_they_are_settled() -> None:
    P = np.eye(6) * 1e-4
    P[0, 0] = P[3, 3] = 1e6  # along the line
    places = [np.array([0.0, 0, 0, 1, 0, 0]), np.array([0.0, 5, 0, 1, 5, 0]), np.array([0.0, 0, 9, 1, 0, 9])]
    ids: list[Any] = [1, 2, 3]
    landmarks = MapLandmarks(
        ids, ["pluecker_line"] * 3, places, [P, P, P + np.diag([0, 4.0, 0, 0, 4, 0])], [2] * 3, True
    )
    shifts = {1: np.array([70.0, 0.03, 0.04]), 2: np.zeros(3), 3: np.ones(3)}
    true = {i: (l.reshape(2, 3) * [9, 1, 1] + shifts[i]).ravel() for i, l in zip(ids, places, strict=True)}
    truth = Truth(np.empty((0, 7)), true, offset=ORIGIN[7])
    eyes = np.tile([0.0, -5.0, 0.0], (3, 1))
    figures = landmark_figures(landmarks, truth, eyes)
    assert figures["lines_compared"] == 2
    assert figures["line_rmse_raw_m"] == pytest.approx(np.sqrt(0.05**2 / 2))
    assert landmark_figures(landmarks, Truth(np.empty((0, 7)), offset=ORIGIN[7]), eyes) == {}


def test_a_point_whose_depth_is_not_determined_from_where_it_was_observed_is_not_compared() -> None:
    kinds = ["point3", "inverse_depth", "inverse_depth", "inverse_depth"]
    covariances = [np.eye(3), 1e-4 * np.eye(3), np.diag([1e-4, 1e-4, 4.0]), 1e-4 * np.eye(3)]
    true = {k: np.array([k * 5.0, 0, 0]) for k in range(4)}
    ids: list[Any] = [0, 1, 2, 3]
    landmarks = MapLandmarks(ids, kinds, [l + 0.1 for l in true.values()], covariances, [2] * 4, True)
    truth = Truth(np.empty((0, 7)), true, offset=ORIGIN[7])
    eyes = np.zeros((4, 3))
    eyes[2, 0], eyes[3] = 5.0, np.nan  # five metres before it with a sigma of two, and never observed
    figures = landmark_figures(landmarks, truth, eyes)
    assert figures["landmarks_compared"] == 2
    assert figures["landmark_rmse_raw_m"] == pytest.approx(0.1 * np.sqrt(3))
    assert "line_rmse_raw_m" not in figures
    eyes[2:] = -20.0, 0.0, 0.0  # two metres are little at that distance
    figures = landmark_figures(landmarks, truth, eyes)
    assert figures["landmarks_compared"] == 4
    assert figures["landmark_rmse_raw_m"] == pytest.approx(0.1 * np.sqrt(3))


def test_a_landmark_was_last_observed_from_where_its_robot_was_then(run: Run) -> None:
    h, (name, *_) = run.history, run.landmarks.ids
    (step,) = {int(h.step[row]) for row in np.flatnonzero(h.fused & (h.landmark == str(name)))[-1:]}
    eyes = last_observed_from(h, [name, "nowhere"])
    np.testing.assert_array_equal(eyes, [h.poses[step, :3], [np.nan] * 3])
