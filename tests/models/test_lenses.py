"""Lenses: every Jacobian against differences, pixels through rays and back, and what a lens does not show."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from differences import agree, derivative
from kalmark.errors import ModelError
from kalmark.models import cameras

Array = np.ndarray[Any, np.dtype[np.float64]]

SIZE = np.array([640.0, 480.0])
K = (320.0, 330.0, 310.0, 245.0)
OMNI_K = (644.0, 438.0, 1.001, 0.002, -0.003)
OMNI = (644.7, -341, -29.01, -57.7, 18.49, 5.415, 50.65, -56.14, 15.91, 0, 0)
OMNI_BACK = (447.3, 0, -0.001068, 1.184e-06, -1.856e-09)
CAMERAS: dict[str, tuple[str, tuple[float, ...], tuple[float, ...], Array]] = {  # name: lens, k, distortion, size
    "no distortion": ("radial", K, (), SIZE),
    "radial": ("radial", K, (-0.25, 0.08, -0.008), SIZE),
    "radtan": ("radtan", K, (-0.28, 0.07, 2e-4, -3e-4, 0.01), SIZE),
    "strongly tangential": ("radtan", K, (0.1, 0.05, 0.02, -0.03), SIZE),
    "time of flight": (
        "radtan",
        (210.689, 210.689, 106.708, 87.122),
        (0.3922043442726135, -4.427685737609863, 2.09e-15, 2.48e-16, 7.789391040802002),
        np.array([224.0, 171.0]),
    ),
    "long": (
        "radtan",
        (3291.8, 3288.7, 654.6, 511.8),
        (-0.091469, 4.182381, -0.001340, 0.004499, 0.0),
        np.array([1280.0, 1024.0]),
    ),
    "fisheye": (
        "equidistant",
        (465.609, 465.632, 622.637, 513.902),
        (-0.0229515, 0.01625, -0.00961832, 0.00176252),
        np.array([1280.0, 1024.0]),
    ),
    "wide fisheye": (
        "equidistant",
        (286.712, 286.784, 420.914, 396.892),
        (-0.006671324837952852, 0.03932977095246315, -0.03556782007217407, 0.005536118987947702),
        np.array([848.0, 800.0]),
    ),
    "ideal fisheye": ("equidistant", K, (), SIZE),
    "tsai": ("tsai", (525.06, 524.245, 308.649, 236.536), (-0.1035, 0.1735), SIZE),
    "tsai with a limit": ("tsai", K, (0.1, -0.02), SIZE),
    "davison": ("davison", (195.0, 195.0, 162.0, 125.0), (9e-6 * 195**2,), np.array([320.0, 240.0])),
    "davison, the other way": ("davison", K, (-0.05,), SIZE),
    "fov": ("fov", K, (0.9,), SIZE),
}
EXACT = [name for name, (lens, _, _, _) in CAMERAS.items() if lens != "radial"]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(18)


def camera(name: str) -> tuple[int, Array, Array]:
    lens, k, d, size = CAMERAS[name]
    return cameras.LENSES[lens], cameras.lens_parameters(lens, k, d, size=size), size


def pixels(rng: np.random.Generator, size: Array, centre: Array, count: int = 200) -> Array:
    """Draw pixels of an image, its corners, its centre and near that among them."""
    y = rng.uniform(0, size, (count, 2))
    y[:4] = [(0, 0), (size[0], 0), (0, size[1]), size]
    y[4] = centre
    y[5::8] = centre + rng.normal(size=(len(y[5::8]), 2)) * 10.0 ** -rng.integers(0, 12, (len(y[5::8]), 1))
    return y


@pytest.mark.parametrize("name", CAMERAS)
def test_a_lens_has_the_jacobians_of_its_differences(name: str, rng: np.random.Generator) -> None:
    lens, par, size = camera(name)
    y = pixels(rng, size, par[2:4])
    m, M_y = cameras.back_project(lens, y, par)
    np.testing.assert_allclose(np.linalg.norm(m, axis=1), 1, atol=1e-15)
    v = m * 10 ** rng.uniform(-3, 3, (len(y), 1))
    e, E_v = cameras.project(lens, v, par)
    for i in range(len(v)):
        step = 0.01 * np.linalg.norm(v[i])
        agree(E_v[i], derivative(lambda x: cameras.project(lens, x[None], par)[0][0], v[i], first=step))
        agree(M_y[i], derivative(lambda x: cameras.back_project(lens, x[None], par)[0][0], y[i], first=0.005 * size[0]))
    np.testing.assert_allclose(cameras.project(lens, 7 * v, par)[0], e, atol=1e-9)  # the length does not matter


@pytest.mark.parametrize("name", EXACT)
def test_pixels_come_back_through_their_rays_over_the_whole_image(name: str) -> None:
    lens, par, size = camera(name)
    u, v = np.meshgrid(np.linspace(0, size[0], 81), np.linspace(0, size[1], 61))
    y = np.stack([u.ravel(), v.ravel()], axis=1)
    m, M_y = cameras.back_project(lens, y, par)
    again, E_m = cameras.project(lens, m, par)
    np.testing.assert_allclose(again, y, atol=1e-10, rtol=0)
    np.testing.assert_allclose(E_m @ M_y, np.tile(np.eye(2), (len(y), 1, 1)), atol=1e-9)
    assert cameras.is_in_view(lens, m, par, size + 1e-9)[(y > 0).all(axis=1)].all()


def test_the_lenses_agree_where_one_is_a_case_of_the_other(rng: np.random.Generator) -> None:
    v = rng.uniform([-1, -0.75, 1], [1, 0.75, 1], (50, 3))
    radial = cameras.project(cameras.RADIAL, v, cameras.lens_parameters("radial", K, (-0.2, 0.05, 0.01), (), SIZE))
    radtan = cameras.project(cameras.RADTAN, v, cameras.lens_parameters("radtan", K, (-0.2, 0.05, 0, 0, 0.01)))
    existing = cameras.project_pinhole(v, np.array(K), np.array([-0.2, 0.05, 0.01]))
    for one, other, third in zip(radial, radtan, existing, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-10)
        np.testing.assert_array_equal(one, third)
    ideal = cameras.project(cameras.EQUIDISTANT, v, cameras.lens_parameters("equidistant", K))[0]
    angle = np.arctan2(np.hypot(v[:, 0], v[:, 1]), v[:, 2])
    np.testing.assert_allclose(np.hypot(*((ideal - K[2:]) / K[:2]).T), angle, atol=1e-12)


def test_davison_s_lens_is_that_of_monoslam() -> None:
    k, kd = (195.0, 195.0, 162.0, 125.0), 9e-6  # of pixels, SceneLib2
    par = cameras.lens_parameters("davison", k, (kd * 195**2,))
    for u, v in ((10.0, 20.0), (300.0, 200.0), (162.0, 125.0)):
        a, b = u - 162.0, v - 125.0
        straight = np.array([a, b]) / np.sqrt(1 - 2 * kd * (a * a + b * b)) / 195.0
        ray = cameras.back_project(cameras.DAVISON, np.array([[u, v]]), par)[0][0]
        np.testing.assert_allclose(ray[:2] / ray[2], straight, atol=1e-14)


@pytest.mark.parametrize("lens", ["davison", "fov"])
def test_a_lens_of_one_number_takes_one(lens: str) -> None:
    for wrong in ((), (0.1, 0.2), *(((-1.0,), (4.0,)) if lens == "fov" else ())):
        with pytest.raises(ModelError, match="one number"):
            cameras.lens_parameters(lens, K, wrong)


def test_the_pixels_are_those_of_the_formulas_written_out() -> None:
    k1, k2, p1, p2, k3 = -0.28, 0.07, 0.002, -0.003, 0.01
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    s = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * s + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * s + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    e, _ = cameras.project(
        cameras.RADTAN, np.array([[0.6, -0.4, 2]]), cameras.lens_parameters("radtan", K, (k1, k2, p1, p2, k3))
    )
    np.testing.assert_allclose(e[0], [K[2] + K[0] * xd[0], K[3] + K[1] * xd[1]], atol=1e-12)
    t, k = math.atan(math.hypot(x, y)), (-0.02, 0.016, -0.009, 0.0017)
    td = t * (1 + k[0] * t**2 + k[1] * t**4 + k[2] * t**6 + k[3] * t**8) / math.hypot(x, y)
    e, _ = cameras.project(
        cameras.EQUIDISTANT, np.array([[0.6, -0.4, 2]]), cameras.lens_parameters("equidistant", K, k)
    )
    np.testing.assert_allclose(e[0], [K[2] + K[0] * td * x, K[3] + K[1] * td * y], atol=1e-12)


def test_nothing_is_seen_behind_a_pin_hole_and_in_the_plane_through_it() -> None:
    v = np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.0], [0.1, 0.2, 1.0]])
    for name in ("no distortion", "radial", "radtan", "time of flight"):
        lens, par, size = camera(name)
        e, E_v = cameras.project(lens, v, par)
        assert np.isnan(e[:3]).all() and np.isnan(E_v[:3]).all() and np.isfinite(e[3]).all()
        np.testing.assert_array_equal(cameras.is_in_view(lens, v, par, size), [False, False, False, True])


def test_a_fisheye_sees_behind_its_plane_up_to_where_its_image_folds() -> None:
    angle = np.array([0.5, math.pi / 2, 1.7, 2.0, 3.0])
    v = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    par = cameras.lens_parameters("equidistant", (100, 100, 300, 300), (-0.1,))  # grows up to theta = sqrt(1 / 0.3)
    e, _ = cameras.project(cameras.EQUIDISTANT, v, par)
    np.testing.assert_allclose(e[:3, 0], 300 + 100 * angle[:3] * (1 - 0.1 * angle[:3] ** 2), atol=1e-11)
    assert np.isnan(e[3:]).all()
    np.testing.assert_array_equal(
        cameras.is_in_view(cameras.EQUIDISTANT, v, par, np.array([600.0, 600])), [1, 1, 1, 0, 0]
    )
    rays, _ = cameras.back_project(cameras.EQUIDISTANT, np.array([[300 + 121.0, 300], [300 + 122.0, 300]]), par)
    assert np.isfinite(rays[0]).all() and np.isnan(rays[1]).all()  # r_d reaches 1.217
    ahead, _ = cameras.project(cameras.EQUIDISTANT, np.array([[0.0, 0, 3]]), par)
    np.testing.assert_array_equal(ahead, [[300, 300]])


@pytest.mark.parametrize("lens", ["radial", "radtan"])
def test_points_that_fold_back_into_the_image_are_not_in_view(lens: str) -> None:
    d = (-0.3,) if lens == "radial" else (-0.3, 0, 0, 0)  # grows up to r = 1.054, r_d = 0.703
    par = cameras.lens_parameters(lens, (400, 400, 320, 240), d, () if lens == "radial" else None)
    v = np.array([[1.0, 0, 1], [1.1, 0, 1], [1.7, 0, 1]])
    folded, _ = cameras.project_pinhole(v, np.array([400.0, 400, 320, 240]), np.array([-0.3]))
    assert cameras.in_image(folded, v, SIZE).all()
    np.testing.assert_array_equal(cameras.is_in_view(cameras.LENSES[lens], v, par, SIZE), [True, False, False])
    assert np.isnan(cameras.project(cameras.LENSES[lens], v, par)[0][1:]).all()
    if lens == "radtan":
        rays, _ = cameras.back_project(cameras.RADTAN, np.array([[320 + 281.0, 240], [320 + 282.0, 240]]), par)
        assert np.isfinite(rays[0]).all() and np.isnan(rays[1]).all()


def test_borders_of_the_image_are_in_view() -> None:
    par = cameras.lens_parameters("radial", (100, 100, 50, 50), size=(100, 100))
    v = np.array([[-0.5, -0.5, 1], [0.5, 0.5, 1], [0.51, 0, 1], [0, -0.51, 1]])
    np.testing.assert_array_equal(cameras.is_in_view(cameras.RADIAL, v, par, np.array([100.0, 100])), [1, 1, 0, 0])


def test_the_omnidirectional_lens_is_that_of_scaramuzza(rng: np.random.Generator) -> None:
    par, size = cameras.lens_parameters("omnidirectional", OMNI_K, OMNI, OMNI_BACK), np.array([1280.0, 800.0])
    y = rng.uniform(0, size, (100, 2))
    centre, affine = np.array(OMNI_K[:2]), np.array([[1.0, OMNI_K[4]], [OMNI_K[3], OMNI_K[2]]])
    m, M_y = cameras.back_project(cameras.OMNI, y, par)
    flat = np.linalg.solve(affine, (y - centre).T).T
    height = np.polynomial.Polynomial(OMNI_BACK)(np.linalg.norm(flat, axis=1))
    rays = np.column_stack([flat, height])
    np.testing.assert_allclose(m, rays / np.linalg.norm(rays, axis=1)[:, None], atol=1e-14)
    e, E_m = cameras.project(cameras.OMNI, m, par)
    across = np.linalg.norm(m[:, :2], axis=1)
    radius = np.polynomial.Polynomial(OMNI)(np.arctan2(m[:, 2], across))
    np.testing.assert_allclose(e, centre + (radius / across)[:, None] * m[:, :2] @ affine.T, atol=1e-10)
    np.testing.assert_allclose(E_m @ M_y, np.tile(np.eye(2), (len(y), 1, 1)), atol=0.1)  # the two are fitted apart
    inside = (np.abs(e / size - 0.5) <= 0.5).all(axis=1)
    np.testing.assert_array_equal(cameras.is_in_view(cameras.OMNI, m, par, size), inside)
    assert not cameras.is_in_view(cameras.OMNI, np.array([[0.01, 0, -1.0]]), par, size)[0]


def test_a_lens_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ModelError, match=r"lens 'fisheye': expected one of radial, radtan, equidistant"):
        cameras.lens_parameters("fisheye", K)
    with pytest.raises(ModelError, match=r"distortion \[0\.1, 0\.2, 0\.3\]: radtan expects k1, k2, p1, p2"):
        cameras.lens_parameters("radtan", K, (0.1, 0.2, 0.3))
