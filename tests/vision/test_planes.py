"""The planes of patches: what matches and depth images show of them; a slanted wall does not move its points."""

from __future__ import annotations

import numpy as np
import pytest

import kalmark as km
from kalmark.geometry.frames3d import from_euler_pose, from_frame_many, to_frame_many
from kalmark.vision.appearance import View, predict_templates, take_view
from kalmark.vision.features import Cells
from kalmark.vision.planes import Plane, plane_from_depths, plane_from_match
from kalmark.vision.rendering import Rectangle as Wall
from kalmark.vision.rendering import Renderer, texture
from kalmark.vision.template_matching import Searcher

cv2 = pytest.importorskip("cv2", reason="needs OpenCV: pip install 'kalmark[opencv]'")

CAMERA = km.sensors.PinHole(fx_px=250, fy_px=250, cx_px=159.5, cy_px=119.5, width_px=320, height_px=240)
DEPTHS = km.sensors.PixelDepth(
    fx_px=250, fy_px=250, cx_px=159.5, cy_px=119.5, width_px=320, height_px=240, sigma_rho_per_m=1e-3
)
SLANT = 50.0  # deg
NORMAL = np.array([np.sin(np.radians(SLANT)), 0.0, np.cos(np.radians(SLANT))])  # of the wall, away from the camera
MIDDLE = np.array([0.0, 0.0, 2.0])


def pose(*numbers: float) -> np.ndarray:
    return from_euler_pose(np.array([*numbers[:3], *np.radians(numbers[3:])]))[0]


def slanted() -> Wall:
    """Return a wall of 4 m by 3 m, its middle 2 m before the origin, turned about the vertical by SLANT."""
    at = pose(0, 0, 0, 0, SLANT, 0)
    at[:3] = MIDDLE + from_frame_many(at, np.array([[-2.0, -1.5, 0.0]]))[0][0]
    return Wall(at, texture(4.0, 3.0, 0.004, np.random.default_rng(3), 60.0), 0.004)


def off_deg(normals: np.ndarray) -> np.ndarray:
    unit = normals / np.linalg.norm(normals, axis=1)[:, None]
    return np.asarray(np.degrees(np.arccos(np.clip(unit @ NORMAL, -1.0, 1.0))))


def test_matches_show_a_slanted_wall_and_its_points_do_not_move_once_it_is_known() -> None:
    renderer, rng = Renderer([slanted()], CAMERA), np.random.default_rng(0)
    path = [pose(0.04 * k, 0.01 * k, 0, 0, -k, 0) for k in range(16)]
    images = [renderer.taken(T, rng, noise=1.0, blur_px=0.7)[0] for T in path]
    y = Cells(12, 6, 4.0).corners(images[0], np.zeros((0, 2)), 60, 14, 1, np.random.default_rng(1))
    views: list[list[View]] = [[view] for view in (take_view(images[0], one, path[0], CAMERA, 12) for one in y) if view]
    rays = CAMERA.rays(y)
    places = rays * (MIDDLE @ NORMAL / (rays @ NORMAL))[:, None]
    last = {}
    for learns in (False, True):
        planes = [Plane(view.rays[4]) for (view,) in views]
        for T, image in zip(path[1:], images[1:], strict=True):
            looks = predict_templates(views, [*planes], places, T, CAMERA, 6)
            e = CAMERA.expect(to_frame_many(T, places)[0])[0]
            some = looks.valid[np.isfinite(e[looks.valid]).all(axis=1)]
            found, scores = Searcher(image, looks.templates, 0.85).in_discs(some, e[some], np.full(len(some), 4.0))
            for k, at, score in zip(some.tolist(), found, scores, strict=True):
                if learns and score >= 0.85:
                    plane_from_match(image, looks.templates[k], at, planes[k].slopes, looks.rates[k], planes[k])
        good = scores >= 0.85
        last[learns] = np.median(np.linalg.norm(found - e[some], axis=1)[good]), good.sum()
        tilts = off_deg(np.array([planes[k].normal for k in some[good]]))
    assert last[True][1] > 20
    assert np.median(tilts) < 6.0
    assert last[True][0] < 0.2 < 0.4 * last[False][0]


def test_a_depth_image_shows_the_plane_with_the_noise_it_says_and_none_at_an_edge() -> None:
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    rays = np.column_stack([(u.ravel() - 159.5) / 250, (v.ravel() - 119.5) / 250, np.ones(u.size)])
    rho = (rays @ NORMAL / (MIDDLE @ NORMAL)).reshape(240, 320)
    T, y = pose(1, 2, 3, 20, -10, 30), np.array([140.0, 100.0])
    turned = from_frame_many(T, NORMAL[None])[0][0] - T[:3]
    m = from_frame_many(T, DEPTHS.rays(y[None]))[0][0] - T[:3]
    true = Plane(m).across.T @ turned / (m @ turned)
    d2 = []
    for seed in range(200):
        depth = 1.0 / (rho + np.random.default_rng(seed).normal(0.0, DEPTHS.sigma_rho_per_m, rho.shape))
        plane = Plane(m, information=1e-9 * np.eye(2))
        plane_from_depths(depth, y, DEPTHS, T, 6, plane)
        d2.append((plane.slopes - true) @ plane.information @ (plane.slopes - true))
    assert 1.6 < np.mean(d2) < 2.4
    depth[:, 143:] += 0.5
    at_edge = Plane(m)
    plane_from_depths(depth, y, DEPTHS, T, 6, at_edge)
    assert not at_edge.slopes.any()


def test_a_corner_is_in_the_middle_of_its_patch() -> None:
    image = np.full((100, 100), 50, np.uint8)
    image[52:, 47:] = 200
    (found,) = Cells(1, 6, 4.0).corners(image, np.zeros((0, 2)), 1, 14, 1, np.random.default_rng(2))
    assert np.abs(found - [46.5, 51.5]).max() <= 1.5


def test_a_plane_is_not_steeper_than_a_camera_can_see() -> None:
    plane = Plane(np.array([0.0, 0.6, 0.8]))
    plane.add(np.array([9.0, 0.0]), 100.0 * np.eye(2))
    assert np.linalg.norm(plane.slopes) == pytest.approx(2.0)
    np.testing.assert_allclose(plane.normal @ plane.m, 1.0)
