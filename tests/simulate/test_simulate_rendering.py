"""Rendered images of textured planes: corners where the camera model has them, exact depth, repeatable textures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.geometry.frames3d import from_euler_pose, from_frame_many, to_frame_many
from kalmark.models import cameras
from kalmark.simulate.layouts import TexturedPlanes, TexturedRoom
from kalmark.simulate.rendering import SKY, Plane, Renderer, texture

SIZE = {"width_px": 320, "height_px": 240}
K = {"fx_px": 250.0, "fy_px": 255.0, "cx_px": 158.0, "cy_px": 121.0}
CAMERAS = {
    "ideal": km.sensors.PinHole(**K, **SIZE),
    "radtan": km.sensors.PinHole(**K, **SIZE, lens="radtan", distortion=(-0.28, 0.07, 0.0002, 2e-5, 0.0)),
    "equidistant": km.sensors.PinHole(**K, **SIZE, lens="equidistant", distortion=(-0.01, 0.02, 0.0, 0.0)),
    "davison": km.sensors.PinHole(**K, **SIZE, lens="davison", distortion=(0.3,)),
    "omnidirectional": km.sensors.Omnidirectional(),
}


def pose(*numbers: float) -> np.ndarray:
    return from_euler_pose(np.array([*numbers[:3], *np.radians(numbers[3:])]))[0]


def pixels(camera: Any, T: np.ndarray, points: np.ndarray) -> np.ndarray:
    v = to_frame_many(T, np.ascontiguousarray(points))[0]
    return cameras.project(camera.code, v, np.array(camera.parameters))[0]


@pytest.mark.parametrize("name", CAMERAS)
def test_a_corner_on_a_plane_lies_where_the_camera_model_has_it(name: str) -> None:
    import cv2

    camera, checks = CAMERAS[name], 12
    board = np.kron(np.indices((checks, checks)).sum(axis=0) % 2, np.ones((40, 40))).astype(np.uint8)
    plane = Plane(pose(0.0, 0.0, 0.0, 0, 0, 0), 40 + 160 * board, 0.0025)  # 1.2 m wide
    inner = 0.1 * np.indices((checks + 1, checks + 1))[::-1, 1:-1, 1:-1].reshape(2, -1).T
    points = from_frame_many(plane.pose, np.column_stack([inner, np.zeros(len(inner))]))[0]
    T = pose(0.55, 0.7, -0.6, 14, -11, 25)
    image = Renderer([plane], camera).taken(T, np.random.default_rng(0), blur_px=0.7)[0]
    e = pixels(camera, T, points)
    e = e[((e > 12) & (e < np.array(image.shape[::-1]) - 12)).all(axis=1)]
    found = e.astype(np.float32)[:, None].copy()
    cv2.cornerSubPix(image, found, (4, 4), (-1, -1), (cv2.TERM_CRITERIA_EPS, 40, 1e-3))
    off = np.linalg.norm(found[:, 0] - e, axis=1)
    assert len(e) > 20
    assert np.median(off) < 0.05
    assert np.abs((found[:, 0] - e).mean(axis=0)).max() < 0.05  # no shift of the image


def test_depth_is_that_of_the_nearest_plane_and_exact_at_any_pixel() -> None:
    camera, rng = CAMERAS["radtan"], np.random.default_rng(3)
    scenery = TexturedRoom(panels=5, pixel_m=0.02).scenery(rng)
    T = pose(3.0, 2.0, 1.4, -95, 3, -70)
    image, depth = Renderer(scenery.planes, camera).taken(T, rng)
    y = np.column_stack([rng.integers(0, n, 300) for n in (320, 240)])
    rays = cameras.back_project(camera.code, y.astype(np.float64), np.array(camera.parameters))[0]
    for (u, v), ray in zip(y, rays, strict=True):
        nearest = np.inf
        for plane in scenery.planes:
            ends = to_frame_many(plane.pose, from_frame_many(T, np.array([np.zeros(3), ray]))[0])[0]
            t = ends[0, 2] / (ends[0, 2] - ends[1, 2])
            x = ends[0] + t * (ends[1] - ends[0])
            if t > 0 and (x[:2] >= 0).all() and (x[:2] <= plane.size_m).all():
                nearest = min(nearest, t * ray[2])
        assert depth[v, u] == pytest.approx(nearest, rel=1e-6)
        assert np.isfinite(nearest) or image[v, u] == SKY
    back = pixels(camera, T, from_frame_many(T, rays * (depth[y[:, 1], y[:, 0]] / rays[:, 2])[:, None])[0])
    assert np.abs(back - y)[np.isfinite(depth[y[:, 1], y[:, 0]])].max() < 1e-3


def test_planes_of_a_world_have_their_middles_and_sizes_where_it_says() -> None:
    plane = {"x_m": 2.0, "y_m": 1.0, "z_m": 0.5, "roll_deg": -90.0, "yaw_deg": -90.0, "width_m": 1.5, "height_m": 0.5}
    (found,) = TexturedPlanes(planes=(plane,), pixel_m=0.01).scenery(np.random.default_rng(0)).planes
    assert found.corners().mean(axis=0) == pytest.approx([2.0, 1.0, 0.5])
    assert found.size_m == pytest.approx([1.5, 0.5])
    assert np.ptp(found.corners(), axis=0) == pytest.approx([0.0, 1.5, 0.5], abs=1e-12)
    assert found.corners()[0] == pytest.approx([2.0, 1.75, 0.75])  # seen from the west: left is north, above first


def test_textures_and_noise_are_those_of_the_seed_and_noise_has_its_sigma() -> None:
    drawn = [texture(1.0, 0.5, 0.005, np.random.default_rng(seed), 60.0) for seed in (1, 1, 2)]
    assert (drawn[0] == drawn[1]).all()
    assert (drawn[0] != drawn[2]).any()
    plane = Plane(pose(-5, -5, 2, 0, 0, 0), np.full((100, 100), 100, np.uint8), 0.1)
    image, depth = Renderer([plane], CAMERAS["ideal"]).taken(pose(0, 0, 0, 0, 0, 0), np.random.default_rng(0), noise=3)
    assert (depth == 2).all()
    assert image.std() == pytest.approx(3, rel=0.03)
    assert image.mean() == pytest.approx(100, abs=0.1)
