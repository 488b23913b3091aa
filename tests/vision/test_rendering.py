"""Rendered images of textured planes: corners where the camera model has them, exact depth, repeatable textures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam
from kalmark.errors import ConfigError
from kalmark.events import Frame
from kalmark.geometry import frames3d
from kalmark.geometry.frames3d import from_euler_pose, from_frame_many, to_frame_many
from kalmark.logs import write_native
from kalmark.models import cameras
from kalmark.simulate import load_world, simulate
from kalmark.vision.rendering import SKY, Rectangle, Renderer, texture
from kalmark.vision.textured_layouts import TexturedPlanes, TexturedRoom

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
    plane = Rectangle(pose(0.0, 0.0, 0.0, 0, 0, 0), 40 + 160 * board, 0.0025)  # 1.2 m wide
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
    planes = TexturedRoom(panels=5, pixel_m=0.02).textured(rng)
    T = pose(3.0, 2.0, 1.4, -95, 3, -70)
    image, depth = Renderer(planes, camera).taken(T, rng)
    y = np.column_stack([rng.integers(0, n, 300) for n in (320, 240)])
    rays = cameras.back_project(camera.code, y.astype(np.float64), np.array(camera.parameters))[0]
    for (u, v), ray in zip(y, rays, strict=True):
        nearest = np.inf
        for plane in planes:
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
    (found,) = TexturedPlanes(planes=(plane,), pixel_m=0.01).textured(np.random.default_rng(0))
    assert found.corners().mean(axis=0) == pytest.approx([2.0, 1.0, 0.5])
    assert found.size_m == pytest.approx([1.5, 0.5])
    assert np.ptp(found.corners(), axis=0) == pytest.approx([0.0, 1.5, 0.5], abs=1e-12)
    assert found.corners()[0] == pytest.approx([2.0, 1.75, 0.75])  # seen from the west: left is north, above first


def test_textures_and_noise_are_those_of_the_seed_and_noise_has_its_sigma() -> None:
    drawn = [texture(1.0, 0.5, 0.005, np.random.default_rng(seed), 60.0) for seed in (1, 1, 2)]
    assert (drawn[0] == drawn[1]).all()
    assert (drawn[0] != drawn[2]).any()
    plane = Rectangle(pose(-5, -5, 2, 0, 0, 0), np.full((100, 100), 100, np.uint8), 0.1)
    image, depth = Renderer([plane], CAMERAS["ideal"]).taken(pose(0, 0, 0, 0, 0, 0), np.random.default_rng(0), noise=3)
    assert (depth == 2).all()
    assert image.std() == pytest.approx(3, rel=0.03)
    assert image.mean() == pytest.approx(100, abs=0.1)


ROOM = ["world.pixel_m=0.02", "steps=12", "robots.robot.sensing.camera.depth=true"]


def test_a_simulated_camera_gives_images_of_its_true_poses_from_the_start_on(tmp_path: Path) -> None:
    world = load_world("textured_room", ROOM)
    log, again, other = simulate(world, 3), simulate(world, 3), simulate(world, 4)
    frames = [event for event in log if isinstance(event, Frame)]
    assert [f.t_ns for f in frames] == [0, *world.times()]
    pictures = [f.pixels() for f in frames]
    for others, same in ((again, True), (other, False)):
        assert (pictures[5] == [e for e in others if isinstance(e, Frame)][5].pixels()).all() == same
    assert (pictures[5] == frames[5].pixels()).all()  # however often it is asked
    camera = build_slam(world.config(), log).state.robots["robot"].sensors["camera"]
    truth = [frames3d.compose(log.truth["robot"].at(f.t_ns), np.array(camera.at))[0] for f in frames]
    y = np.array([[60.0, 150.0], [200.0, 130.0], [300.0, 200.0]])
    depths = frames[0].depths()
    assert depths is not None
    z = depths[y[:, 1].astype(int), y[:, 0].astype(int)]
    rays = cameras.back_project(camera.sensor.code, y, np.array(camera.sensor.parameters))[0]
    points = from_frame_many(truth[0], rays * (z / rays[:, 2])[:, None])[0]
    found = pixels(camera.sensor, truth[-1], points)  # of the first image's points, where the last one has them
    assert np.abs(found - y).max() > 3
    patches = [pictures[0][v - 6 : v + 7, u - 6 : u + 7].astype(float).ravel() for u, v in y.astype(int)]
    moved = [pictures[-1][v - 6 : v + 7, u - 6 : u + 7].astype(float).ravel() for u, v in np.rint(found).astype(int)]
    assert np.median([np.corrcoef(a, b)[0, 1] for a, b in zip(patches, moved, strict=True)]) > 0.8
    folder = write_native(log, tmp_path / "room")
    back = [event for event in km.open_log(folder) if isinstance(event, Frame)]
    assert all((a.pixels() == b.pixels()).all() for a, b in zip(back, frames, strict=True))
    assert np.array_equal(np.rint(back[0].depths() * 5000), np.rint(depths * 5000))


def test_images_want_a_world_of_textures_and_a_camera() -> None:
    room = "world={type: random_box}"
    wanted = "expected images only in a world of one of these types: textured_planes or textured_room"
    with pytest.raises(ConfigError, match=wanted):
        load_world("textured_room", [room])
    laser = "robots.robot.sensors.camera={type: range_bearing_3d, mount: {roll_deg: -90}}"
    kinds = "pinhole or pixel_depth or stereo or omnidirectional"
    with pytest.raises(ConfigError, match=f"expected images of {kinds}, not of 'camera', a range_bearing_3d"):
        load_world("textured_room", [laser])
