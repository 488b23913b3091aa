"""Tags: Jacobians against differences, the pose from four corners, and how far it is to be trusted."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from differences import agree, derivative, frames, rotation_vectors
from kalmark.geometry import frames3d, rotations
from kalmark.models import cameras, tags

Array = np.ndarray[Any, np.dtype[np.float64]]

SIZE = 0.16
CAMERAS = {
    "pin-hole": (cameras.RADIAL, cameras.lens_parameters("radial", (1500, 1501, 1025, 1030), size=(2048, 2048))),
    "radtan": (
        cameras.RADTAN,
        cameras.lens_parameters("radtan", (1502.4, 1500.6, 1025.7, 1030.5), (-0.1636, 0.0915, -1.86e-4, -2.03e-4)),
    ),
    "fisheye": (
        cameras.EQUIDISTANT,
        cameras.lens_parameters("equidistant", (470.3, 470.3, 620.7, 534.9), (-0.0177, -0.0028, 0.007, -0.0031)),
    ),
}


def tag_pose(lens: int, y: Array, size: float, par: Array, sigma_px: float) -> tuple[Array, Array, float, float]:
    """Find one tag from its corners y (8,): pose (7,) in the camera, covariance (6, 6), RMS px, ambiguity.

    The covariance is that of independent pixels, the RMS that of the distances of the corners.
    The ambiguity is the ratio of the RMS of both poses: 1, no telling which; 0, only one.
    """
    rows = np.ascontiguousarray(y, dtype=np.float64).reshape(1, 8)
    rays = cameras.back_project(lens, rows.reshape(-1, 2), par)[0].reshape(-1, 4, 3)
    v, V_y, cost = tags.tags_from_corners(lens, rows, rays, np.array([float(size)]), par)
    rms = np.sqrt(0.25 * cost[0])
    return v[0, 0], sigma_px**2 * V_y[0, 0] @ V_y[0, 0].T, float(rms[0]), float(rms[0] / rms[1])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(28)


def pose(position: Any, tilt_rad: float, about_rad: float = 0.0, roll_rad: float = 0.0) -> Array:
    """Return a tag that faces the camera, rolled, then tilted about an axis of the image; the normal goes away."""
    axis = np.array([math.cos(about_rad), math.sin(about_rad), 0])
    q = rotations.multiply(rotations.exp(tilt_rad * axis), rotations.exp(np.array([0, 0, roll_rad])))
    return np.concatenate([np.asarray(position, dtype=float), q])


def views(rng: np.random.Generator, tilts: tuple[float, float], count: int = 200) -> Array:
    """Draw tags in front of a camera, 0.4 to 2 m away."""
    z = rng.uniform(0.4, 2, count)
    x, y = rng.uniform(-0.5, 0.5, (2, count)) * z
    angles = rng.uniform(-np.pi, np.pi, (count, 2))
    tilt = rng.uniform(*tilts, count)
    return np.array([pose((x[i], y[i], z[i]), tilt[i], *angles[i]) for i in range(count)])


def seen(lens: int, v: Array, par: Array) -> Array:
    return tags.project_corners(lens, v[None], np.array([SIZE]), par)[0][0]


def test_a_tag_seen_from_a_frame_has_the_jacobians_of_its_differences(rng: np.random.Generator) -> None:
    T, l = frames(rng), frames(rng)[rng.permutation(200)]
    for i in range(200):
        v, V_T, V_l = tags.tag_seen_from(T[i], l[i : i + 1])
        agree(V_T[0], derivative(lambda x: tags.tag_seen_from(x, l[i : i + 1])[0][0], T[i], "frame", "frame"))
        agree(V_l[0], derivative(lambda x: tags.tag_seen_from(T[i], x[None])[0][0], l[i], "frame", "frame"))
        back, L_T, L_v = tags.tag_from_view(T[i], v)
        np.testing.assert_allclose(frames3d.minus(back[0], l[i]), 0, atol=1e-13)
        agree(L_T[0], derivative(lambda x: tags.tag_from_view(x, v)[0][0], T[i], "frame", "frame"))
        agree(L_v[0], derivative(lambda x: tags.tag_from_view(T[i], x[None])[0][0], v[0], "frame", "frame"))
        np.testing.assert_allclose(L_v[0] @ V_l[0], np.eye(6), atol=1e-12)


def test_moving_camera_and_tag_together_changes_nothing(rng: np.random.Generator) -> None:
    for T, l, g in zip(frames(rng, 50), frames(rng, 50), frames(rng, 50), strict=True):
        moved = tags.tag_seen_from(frames3d.compose(g, T)[0], frames3d.compose(g, l)[0][None])[0][0]
        np.testing.assert_allclose(frames3d.minus(moved, tags.tag_seen_from(T, l[None])[0][0]), 0, atol=1e-12)


@pytest.mark.parametrize("name", CAMERAS)
def test_corners_in_the_image_have_the_jacobians_of_their_differences(name: str, rng: np.random.Generator) -> None:
    lens, par = CAMERAS[name]
    v, size = views(rng, (0, 1.5)), rng.uniform(0.05, 0.3, 200)
    e, E_v = tags.project_corners(lens, v, size, par)
    for i in range(200):
        one = size[i : i + 1]
        numeric = derivative(lambda x: tags.project_corners(lens, x[None], one, par)[0][0], v[i], "frame", first=0.01)
        agree(E_v[i], numeric)
        p = frames3d.from_frame(v[i], tags.corners(size[i]))[0]
        np.testing.assert_allclose(e[i].reshape(4, 2), cameras.project(lens, p, par)[0], atol=1e-9)


def test_corners_go_round_as_apriltag_lists_them() -> None:
    np.testing.assert_array_equal(tags.corners(2.0), [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def test_the_residual_of_a_pose_has_the_jacobian_of_its_differences(rng: np.random.Generator) -> None:
    v, d = frames(rng), np.hstack([rng.normal(size=(200, 3)), rotation_vectors(rng) * 0.95])
    y = np.array([frames3d.plus(a, b) for a, b in zip(v, d, strict=True)])
    z, E_v = tags.pose_residual(y, v)
    np.testing.assert_allclose(z, d, atol=1e-12)
    for i in range(200):
        agree(-E_v[i], derivative(lambda x: tags.pose_residual(y[i : i + 1], x[None])[0][0], v[i], "frame"))
    np.testing.assert_allclose(tags.pose_residual(v, v)[0], 0, atol=1e-15)


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize(
    "tilts", [(0.3, 1.3), (0, 0.3), (0, 0), (1.8, 2.8)], ids=["slanted", "flat", "frontal", "back"]
)
def test_the_pose_is_found_from_perfect_corners(
    name: str, tilts: tuple[float, float], rng: np.random.Generator
) -> None:
    lens, par = CAMERAS[name]
    for v in views(rng, tilts, 60):
        found, cov, rms, ambiguity = tag_pose(lens, seen(lens, v, par), SIZE, par, 1.0)
        np.testing.assert_allclose(frames3d.minus(found, v), 0, atol=1e-9)
        assert rms < 1e-8 and ambiguity < 1e-6
        assert np.linalg.eigvalsh(cov).min() > 0


def test_a_tag_far_to_the_side_of_a_fisheye_is_found_too() -> None:
    par = cameras.lens_parameters("equidistant", (470, 470, 620, 535))
    v = np.concatenate([[0.8, -0.1, -0.05], rotations.exp(np.array([0.2, 1.6, 0.1]))])  # behind the plane of the lens
    found, _, rms, _ = tag_pose(cameras.EQUIDISTANT, seen(cameras.EQUIDISTANT, v, par), SIZE, par, 1.0)
    np.testing.assert_allclose(frames3d.minus(found, v), 0, atol=1e-9)
    assert rms < 1e-9


@pytest.mark.parametrize("name", CAMERAS)
def test_the_covariance_of_a_slanted_tag_is_consistent(name: str, rng: np.random.Generator) -> None:
    lens, par = CAMERAS[name]
    sigma, nees = 0.1, []
    for v in views(rng, (0.5, 1.0), 300):
        y = seen(lens, v, par) + sigma * rng.normal(size=8)
        found, cov, _, _ = tag_pose(lens, y, SIZE, par, sigma)
        error = frames3d.minus(v, found)
        nees.append(error @ np.linalg.solve(cov, error))
    low, high = chi2.ppf([0.005, 0.995], 6 * 300)
    assert low < sum(nees) < high


def test_a_small_tag_has_two_poses_and_the_better_one_is_kept(rng: np.random.Generator) -> None:
    lens, par = CAMERAS["fisheye"]
    v = pose((0.1, 0.1, 3), 0.5)
    ratios, better = [], 0
    for _ in range(100):
        y = seen(lens, v, par) + 0.3 * rng.normal(size=8)
        found, _, rms, ambiguity = tag_pose(lens, y, SIZE, par, 0.3)
        true = tags.refine_tag_pose(lens, y, SIZE, v, par)[2]
        assert rms <= math.sqrt(true / 4) * (1 + 1e-9)
        ratios.append(ambiguity)
        better += np.linalg.norm(frames3d.minus(found, v)[3:]) < 0.5
    assert 0 < np.median(ratios) < 1 and max(ratios) > 0.9  # 25 pixels across: sometimes no telling
    near = seen(lens, pose((0.02, 0.01, 0.4), 0.8), par) + 0.3 * rng.normal(size=8)
    assert tag_pose(lens, near, SIZE, par, 0.3)[3] < 0.2
    assert better > 60


def test_a_tag_that_faces_the_camera_is_clear_only_where_its_covariance_includes_the_mirror_image(
    rng: np.random.Generator,
) -> None:
    """Small tilts from afar: of what is taken for clear, the pose is one of its covariance."""
    sensor = km.sensors.TagCorners(fx_px=500.0, fy_px=500.0, cx_px=376.0, cy_px=240.0, sigma_px=0.5)
    for _ in range(200):
        v = pose((*rng.uniform(-0.5, 0.5, 2), rng.uniform(2, 6)), rng.uniform(0, 0.08), *rng.uniform(-np.pi, np.pi, 2))
        corners = tags.project_corners(sensor.code, v[None], np.array([2 * SIZE]), np.array(sensor.parameters))[0][0]
        poses, V_y, chi2_ = sensor.both(np.append(corners + 0.5 * rng.normal(size=8), 2 * SIZE)[None])
        apart, P = frames3d.minus(poses[0, 1], poses[0, 0]), 0.25 * V_y[0, 0] @ V_y[0, 0].T
        assert np.isinf(chi2_[0, 1]) == (apart @ np.linalg.solve(P, apart) <= 1.0)
    facing = tags.project_corners(sensor.code, pose((0, 0, 3), 0.0)[None], np.array([0.3]), np.array(sensor.parameters))
    assert np.isinf(sensor.both(np.append(facing[0][0], 0.3)[None])[2][0, 1])


@pytest.mark.parametrize(
    "y",
    [
        (100, 100, 200, 100, 150, 100, 100, 100),
        (100, 100, 200, 200, 200, 100, 100, 200),
        (100, 100, 200, 100, 120, 120, 100, 200),
        (100, 100, 200, 100, 200, 200, math.nan, 200),
    ],
    ids=["on a line", "crossed", "dented", "not a number"],
)
def test_corners_of_no_tag_give_no_pose(y: tuple[float, ...]) -> None:
    lens, par = CAMERAS["radtan"]
    for each in tag_pose(lens, np.array(y), SIZE, par, 1.0):
        assert np.isnan(each).all()
