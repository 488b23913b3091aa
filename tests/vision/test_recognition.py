"""A place seen again: descriptors of patches and corners, the pose they agree on, a camera covered and moved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam
from kalmark.geometry.frames3d import from_euler_pose, from_frame_many, minus
from kalmark.simulate import load_world, simulate
from kalmark.vision.appearance import View, take_view
from kalmark.vision.recognition import LEAST, REACH, describe_corners, describe_views, pairs, recognize_place
from kalmark.vision.rendering import Rectangle, Renderer, texture

cv2 = pytest.importorskip("cv2", reason="needs OpenCV: pip install 'kalmark[opencv]'")

CAMERA = km.sensors.PinHole(
    fx_px=200, fy_px=200, cx_px=158, cy_px=121, width_px=320, height_px=240, lens="radtan",
    distortion=(-0.28, 0.07, 0.0002, 2e-5, 0.0),
)  # fmt: skip
MAPPED, COVERED, AGAIN = 45, 8, 12  # frames: mapped, black, and where the camera is put then


def pose(*numbers: float) -> np.ndarray:
    return from_euler_pose(np.array([*numbers[:3], *np.radians(numbers[3:])]))[0]


def scene() -> Renderer:
    """Return a wall 2 m before a camera at the origin that looks along z, and a board before it."""
    rng = np.random.default_rng(3)
    wall = Rectangle(pose(-2.0, -1.5, 2.0, 0, 0, 0), texture(4.0, 3.0, 0.004, rng, 60.0), 0.004)
    board = Rectangle(pose(-0.6, -0.4, 1.5, 5, 0, 0), texture(0.7, 0.7, 0.004, rng, 200.0), 0.004)
    return Renderer([wall, board], CAMERA)


def known(renderer: Renderer, T: np.ndarray, count: int, camera: Any = CAMERA) -> tuple[list[list[View]], np.ndarray]:
    """Return the views of some corners of what is seen from T, and where they are."""
    image, depth = renderer.taken(T, np.random.default_rng(0), noise=1.0, blur_px=0.6)
    y = cv2.goodFeaturesToTrack(image[20:-20, 20:-20], count, 0.05, 12).reshape(-1, 2).astype(float) + 20
    rays = camera.rays(y)
    z = depth[tuple(np.rint(y).astype(int).T[::-1])]
    views = [take_view(image, one, T, camera, REACH) for one in y]
    assert all(view is not None for view in views)
    return [[view] for view in views if view], from_frame_many(T, rays * (z / rays[:, 2])[:, None])[0]


@pytest.mark.parametrize("then", [(0.2, -0.1, 0.1, 4, -6, 15), (-0.1, 0.1, 0.6, 0, 5, -40), (0, 0, 0, 0, 0, 170)])
def test_a_sensor_recognises_where_it_is_from_elsewhere(then: tuple[float, ...]) -> None:
    renderer, first, now = scene(), pose(0, 0, 0, 0, 0, 0), pose(*then)
    views, places = known(renderer, first, 60)
    image = renderer.taken(now, np.random.default_rng(1), noise=1.0, blur_px=0.6)[0]
    found = recognize_place(image, views, places, CAMERA)
    assert found is not None
    T, cov, which = found
    assert len(set(which.tolist())) >= LEAST
    error = minus(T, now)
    assert np.linalg.norm(error[:3]) < 0.08
    assert np.degrees(np.linalg.norm(error[3:])) < 3.0
    assert error @ np.linalg.solve(cov, error) < 12.6  # 95 %


def test_a_camera_with_a_wide_view_recognises_where_it_is_too() -> None:
    camera, first = km.sensors.Omnidirectional(), pose(0, 0, 1.0, 0, 0, 0)
    rng = np.random.default_rng(3)
    wall = Rectangle(pose(-2.0, -1.5, 2.0, 0, 0, 0), texture(4.0, 3.0, 0.004, rng, 60.0), 0.004)
    renderer = Renderer([wall], camera)
    views, places = known(renderer, first, 60, camera)
    now = pose(0.05, -0.05, 1.0, 0, 2, 10)
    found = recognize_place(renderer.taken(now, rng, noise=1.0)[0], views, places, camera)
    assert found is not None
    assert np.linalg.norm(minus(found[0], now)[:3]) < 0.08


def test_another_place_is_not_recognised() -> None:
    views, places = known(scene(), pose(0, 0, 0, 0, 0, 0), 60)
    other = Rectangle(pose(-2.0, -1.5, 2.0, 0, 0, 0), texture(4.0, 3.0, 0.004, np.random.default_rng(8), 60.0), 0.004)
    image = Renderer([other], CAMERA).taken(pose(0, 0, 0, 0, 0, 0), np.random.default_rng(1))[0]
    assert recognize_place(image, views, places, CAMERA) is None
    assert recognize_place(np.zeros_like(image), views, places, CAMERA) is None
    assert recognize_place(image, [], np.zeros((0, 3)), CAMERA) is None


def test_pairs_are_of_the_same_corner_and_of_each_landmark_one() -> None:
    renderer, T = scene(), pose(0, 0, 0, 0, 0, 0)
    views, places = known(renderer, T, 40)
    orb = cv2.ORB_create(600, nlevels=1, edgeThreshold=REACH + 1, patchSize=2 * REACH + 1)
    bits, owner = describe_views(orb, [[*own, *own] for own in views])
    assert sorted(owner.tolist()) == sorted([*range(len(views))] * 2)
    seen, y = describe_corners(orb, renderer.taken(T, np.random.default_rng(5), noise=1.0, blur_px=0.6)[0])
    landmark, corner = pairs(bits, owner, seen)
    assert len(set(landmark.tolist())) == len(landmark) > max(LEAST, 20)
    true = CAMERA.expect(places)[0]
    off = np.linalg.norm(y[corner] - true[landmark], axis=1)
    assert np.mean(off < 3.0) > 0.9


def covered(slam: km.Slam, log: Any) -> tuple[list[float], list[km.Report]]:
    """Let a camera map a room, cover it, and put it elsewhere; return the errors of its position then, and reports."""
    (robot,), frames = log.robots, [e for e in log.events if isinstance(e, km.Frame)]
    off, reports, k = [], [], -1
    for event in log.events:
        if not isinstance(event, km.Frame):
            slam.process(event)
            continue
        k += 1
        at = frames[k if k < MAPPED + COVERED else AGAIN + k - MAPPED - COVERED]
        image, depth = at.grey(), at.depths()
        if MAPPED <= k < MAPPED + COVERED:
            image, depth = np.zeros_like(image), np.zeros(image.shape)
        reports.append(slam.process(replace(event, image=image, depth=depth)))
        if k >= MAPPED + COVERED:
            off.append(float(np.linalg.norm(slam.mean(robot)[:3] - log.truth[robot].at([at.t_ns])[0][:3])))
    return off, reports


def test_a_camera_that_was_covered_and_moved_finds_its_place_again(tmp_path: Path) -> None:
    world = load_world("textured_room_depth", ["steps=64"])
    log = simulate(world, seed=0)
    slam = build_slam(world.config(), log)
    off, reports = covered(slam, log)
    assert max(off) < 0.05
    assert not any(report.removed for report in reports[MAPPED : MAPPED + COVERED])  # a black image says nothing
    matched = [o.outcome for o in reports[MAPPED + COVERED].observations].count("associated")
    assert matched > 40


def test_a_landmark_without_a_pixel_has_no_depth() -> None:
    from kalmark.vision.depth_images import inverse_depths

    assert inverse_depths(np.ones((20, 20)), np.zeros((0, 2)), 0.01).shape == (0,)


def test_a_camera_that_has_drifted_finds_the_landmarks_of_a_place_seen_again() -> None:
    """It goes along a wall and back; what it saw first has been moved meanwhile, as if the rest had drifted."""
    world = load_world("textured_room_depth", ["steps=64", "robots.robot.sensors.camera.mount.roll_deg=90"])
    log = simulate(world, seed=0)
    motion = km.motion.ConstantVelocity3D(sigma_v_mps_per_sqrt_s=1.0, sigma_w_radps_per_sqrt_s=1.0)
    slam = km.Slam(replace(build_slam(world.config(), log).robots["robot"], motion=motion))
    frames = [event for event in log.events if isinstance(event, km.Frame)]
    shift = np.array([0.15, 0.0, 0.05])
    for frame in frames:
        slam.process(frame)
    front_end = slam.state.sources["robot", "camera"]
    old = {name for name, look in front_end.looks.items() if look.fitted >= 10 and look.seen < 34}
    for name in old:
        slot = slam.state.tracks.slots[name]
        mean = slam.state.map.mean(slot)
        mean[:3] += shift * mean[3]
        slam.state.map.set_predicted(slot, mean)
    for k, frame in enumerate(reversed(frames[-57:])):
        report = slam.process(replace(frame, t_ns=frames[-1].t_ns + (k + 1) * 50_000_000))
        found = {o.landmark for o in report.observations if o.outcome == "associated"}
        if k >= 50:  # they are in view since about 40
            assert len(found & old) > 15
            assert len(found - old) > 40  # what the camera saw lately is corrected with it
            error = slam.mean("robot")[:3] - log.truth["robot"].at([frame.t_ns])[0][:3]
            assert np.linalg.norm(error - shift) < 0.06
