"""Cameras: every Jacobian against differences, rays back through pixels, and the fitted correction of the lens."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from differences import agree, derivative
from kalmark.errors import EventError, ModelError
from kalmark.models import cameras
from toolbox_functions import calibrate_pinhole

Array = np.ndarray[Any, np.dtype[np.float64]]

SIZE = (640.0, 480.0)
K = np.array([320.0, 330.0, 310.0, 245.0])
LENSES = [[], [0.2], [-0.3, 0.1], [-0.25, 0.08, -0.008], [0.05, -0.02, 0.01, 0.0]]
OMNI_K = np.array([668.0, 438.0, 1.001, 0.002, -0.003])
OMNI = np.array([644.7, -341, -29.01, -57.7, 18.49, 5.415, 50.65, -56.14, 15.91, 0, 0])
OMNI_BACK = np.array([447.3, 0, -0.001068, 1.184e-06, -1.856e-09])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(8)


def in_front(rng: np.random.Generator, count: int = 200) -> Array:
    """Draw points before the camera: any depth, on the axis and in the corners too."""
    v = rng.uniform(-1, 1, (count, 3)) * [1, 0.75, 0]
    v[::5, :2] *= 10.0 ** -rng.integers(1, 12, size=(count // 5, 1))
    v[7, :2] = 0
    v[:, 2] = 1
    return v * 10 ** rng.uniform(-3, 3, (count, 1))


def one(function: Any, *arguments: Any) -> Any:
    """Return a function of a single row, its value only."""
    return lambda x: function(x[None], *arguments)[0][0]


def project_omni(v: Array, a: Array = OMNI) -> tuple[Array, Array]:
    return cameras.project(cameras.OMNI, v, cameras.lens_parameters("omnidirectional", OMNI_K, a, OMNI_BACK))


def back_project_omni(y: Array) -> tuple[Array, Array]:
    return cameras.back_project(cameras.OMNI, y, cameras.lens_parameters("omnidirectional", OMNI_K, OMNI, OMNI_BACK))


@pytest.mark.parametrize("d", LENSES, ids=str)
def test_the_pin_hole_has_the_jacobians_of_its_differences(d: list[float], rng: np.random.Generator) -> None:
    lens, v = np.array(d), in_front(rng)
    e, E_v = cameras.project_pinhole(v, K, lens)
    E_k, E_d = calibrate_pinhole(v, K, lens)
    for i in range(len(v)):
        agree(E_v[i], derivative(one(cameras.project_pinhole, K, lens), v[i], first=0.02 * v[i, 2]))
        agree(E_k[i], derivative(lambda k: cameras.project_pinhole(v[i : i + 1], k, lens)[0][0], K))
        if d:
            agree(E_d[i], derivative(lambda x: cameras.project_pinhole(v[i : i + 1], K, x)[0][0], lens))
    np.testing.assert_allclose(cameras.project_pinhole(7 * v, K, lens)[0], e, atol=1e-9)  # the length does not matter


@pytest.mark.parametrize("d", LENSES, ids=str)
def test_back_projection_has_the_jacobians_of_its_differences(d: list[float], rng: np.random.Generator) -> None:
    c = cameras.fit_correction(d, K, SIZE)
    y = rng.uniform(0, SIZE, (200, 2))
    y[0] = K[2:]
    m, M_y = cameras.back_project_pinhole(y, K, c)
    np.testing.assert_allclose(np.linalg.norm(m, axis=1), 1, atol=1e-15)
    for i in range(len(y)):
        agree(M_y[i], derivative(one(cameras.back_project_pinhole, K, c), y[i], first=4.0))


@pytest.mark.parametrize("d", LENSES, ids=str)
def test_pixels_come_back_within_a_hundredth_over_the_whole_image(d: list[float]) -> None:
    c = cameras.fit_correction(d, K, SIZE)
    assert len(c) <= 14
    u, v = np.meshgrid(np.linspace(0, SIZE[0], 81), np.linspace(0, SIZE[1], 61))
    y = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, _ = cameras.back_project_pinhole(y, K, c)
    again, _ = cameras.project_pinhole(rays, K, np.array(d))
    assert np.hypot(*(again - y).T).max() < 0.01


def test_a_distortion_that_folds_inside_the_image_is_refused() -> None:
    assert cameras.valid_radius([-0.3]) == pytest.approx(np.sqrt(1 / 0.9))
    assert cameras.valid_radius([0.2]) == np.inf
    assert cameras.valid_radius([]) == np.inf
    with pytest.raises(ModelError, match=r"distortion \[-0.3\]: reaches radius 0\.7027"):
        cameras.fit_correction([-0.3], K, SIZE)
    to_corner = np.hypot(330 / 320, 245 / 330)  # of an image that shows this much of the plane z = 1
    with pytest.raises(ModelError, match=r"no correction of 20 coefficients within 0\.005 px"):
        cameras.fit_correction([-0.3], K * [to_corner / 0.7, to_corner / 0.7, 1, 1], SIZE)
    assert len(cameras.fit_correction([-0.3], K * [to_corner / 0.5, to_corner / 0.5, 1, 1], SIZE)) <= 10


def test_the_omnidirectional_camera_has_the_jacobians_of_its_differences(rng: np.random.Generator) -> None:
    v = rng.normal(size=(200, 3))
    v[::4, 2] = 1e-3 * rng.normal(size=50)  # across the edge between ahead and behind
    v[1::8, :2] *= 1e-2  # near the axis, on which the polynomial of this calibration leaves a radius of a pixel
    v[:, 2] = np.where(np.hypot(v[:, 0], v[:, 1]) < 0.1, abs(v[:, 2]) + 0.1, v[:, 2])
    e, E_v = project_omni(v)
    for i in range(len(v)):
        step = 0.1 * np.hypot(v[i, 0], v[i, 1])
        agree(E_v[i], derivative(one(project_omni), v[i], first=step))
    np.testing.assert_allclose(project_omni(7 * v)[0], e, atol=1e-9)


def test_the_omnidirectional_camera_is_regular_on_its_axis() -> None:
    a = np.array([np.pi / 2, -1.0]) * 300  # radius proportional to the angle from the axis
    axis = np.array([[0.0, 0, 2]])
    e, E_v = project_omni(axis, a)
    np.testing.assert_allclose(e[0], OMNI_K[:2], atol=1e-12)
    _, near = project_omni(np.array([[1e-6, -2e-6, 2.0]]), a)
    np.testing.assert_allclose(E_v, near, atol=1e-3)
    np.testing.assert_allclose(E_v[0, 0, 0], 150, atol=1e-9)


def test_omnidirectional_rays_have_the_jacobians_of_their_differences(rng: np.random.Generator) -> None:
    y = rng.uniform(0, (1280, 800), (200, 2))
    m, M_y = back_project_omni(y)
    np.testing.assert_allclose(np.linalg.norm(m, axis=1), 1, atol=1e-15)
    for i in range(len(y)):
        agree(M_y[i], derivative(one(back_project_omni), y[i], first=2.0))
    centre, M_centre = back_project_omni(OMNI_K[None, :2])
    np.testing.assert_array_equal(centre, [[0, 0, 1]])
    assert np.isfinite(M_centre).all()


def test_omnidirectional_pixels_come_back_to_the_calibrations_accuracy(rng: np.random.Generator) -> None:
    y = OMNI_K[:2] + rng.uniform(-350, 350, (200, 2))
    rays, _ = back_project_omni(y)
    again, _ = project_omni(rays)
    assert np.hypot(*(again - y).T).max() < 5  # the two polynomials are fitted separately, to a few pixels


def test_stereo_has_the_jacobians_of_its_differences_and_finds_the_point_again(rng: np.random.Generator) -> None:
    v = in_front(rng)
    e, E_v = cameras.project_stereo(v, K, 0.24)
    again, V_y = cameras.back_project_stereo(e, K, 0.24)
    np.testing.assert_allclose(again[:, :3] / again[:, 3:], v, rtol=1e-9, atol=1e-9 * abs(v).max())
    for i in range(len(v)):
        agree(E_v[i], derivative(one(cameras.project_stereo, K, 0.24), v[i], first=0.02 * v[i, 2]))
        agree(V_y[i], derivative(one(cameras.back_project_stereo, K, 0.24), e[i], first=1.0))


def test_a_pixel_is_in_the_image_with_its_borders_and_before_the_camera() -> None:
    e = np.array([[0.0, 0], [640, 480], [640.1, 3], [-0.1, 3], [9, 9]])
    v = np.array([[0.0, 0, 1]] * 4 + [[0.0, 0, -1]])
    assert cameras.in_image(e, v, SIZE).tolist() == [True, True, False, False, False]
    pair = np.array([[5.0, 5, -1, 5], [5, 5, 3, 5]])
    assert cameras.in_image(pair, v[:2], SIZE).tolist() == [False, True]


def test_a_negative_disparity_is_refused_with_both_pixels() -> None:
    robot = km.Robot("r", km.motion.Odometry3D(), sensors={"pair": km.Mount(km.sensors.Stereo())})
    what = r"scan at t=1 s: r.pair, observation 1: ul_px 10 - ur_px 12.5 is a disparity of -2.5 px, expected 0 or more"
    with pytest.raises(EventError, match=what):
        km.Slam(robot).process(km.Scan(1.0, "r", "pair", [[20, 10, 15, 10], [10, 10, 12.5, 10]], [1, 2]))
