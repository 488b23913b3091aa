"""The visual front end: patches found to a fraction of a pixel, warps, planted outliers, the same result twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.geometry.frames3d import from_euler_pose, from_frame_many, to_frame_many
from kalmark.simulate.rendering import Plane, Renderer, texture
from kalmark.tracks.prospect import Prospect
from kalmark.vision.appearance import predicted, taken
from kalmark.vision.matching import Searcher, correlation
from kalmark.vision.selection import Search

cv2 = pytest.importorskip("cv2", reason="needs OpenCV: pip install 'kalmark[opencv]'")

CAMERA = km.sensors.PinHole(fx_px=250, fy_px=250, cx_px=159.5, cy_px=119.5, width_px=320, height_px=240, sigma_px=0.5)
WIDE = km.sensors.PinHole(
    fx_px=200, fy_px=200, cx_px=158, cy_px=121, width_px=320, height_px=240, lens="radtan",
    distortion=(-0.28, 0.07, 0.0002, 2e-5, 0.0),
)  # fmt: skip
ACCEPT = 0.85
SAVED = (5, 40)  # frames: before the map has begun, and after


def pose(*numbers: float) -> np.ndarray:
    return from_euler_pose(np.array([*numbers[:3], *np.radians(numbers[3:])]))[0]


def wall(pixel_m: float = 0.004) -> Plane:
    """Return a wall of 4 m by 3 m, 2 m before a camera at the origin, which looks along z."""
    return Plane(pose(-2.0, -1.5, 2.0, 0, 0, 0), texture(4.0, 3.0, pixel_m, np.random.default_rng(3), 60.0), pixel_m)


def pixels(camera: Any, T: np.ndarray, places: np.ndarray) -> np.ndarray:
    return camera.expect(to_frame_many(T, np.ascontiguousarray(places))[0])[0]


def corners(image: np.ndarray, count: int) -> np.ndarray:
    found = cv2.goodFeaturesToTrack(image[30:-30, 30:-30], count, 0.2, 25)
    return found.reshape(-1, 2).astype(np.float64) + 30


def places_of(camera: Any, T: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return where the rays through pixels meet the wall."""
    rays = from_frame_many(T, camera.invert(y)[0])[0] - T[:3]
    return T[:3] + rays * ((2.0 - T[2]) / rays[:, 2])[:, None]


@pytest.mark.parametrize("camera", [CAMERA, WIDE])
@pytest.mark.parametrize("large", [False, True])
def test_a_patch_is_found_to_a_tenth_of_a_pixel_where_it_appears_from_elsewhere(camera: Any, large: bool) -> None:
    renderer, rng = Renderer([wall()], camera), np.random.default_rng(0)
    first, then = pose(0, 0, 0, 0, 0, 0), pose(0.15, -0.1, 0.1, 3, -4, 10)
    image = renderer.taken(first, rng, noise=1.0, blur_px=0.7)[0]
    now = renderer.taken(then, rng, noise=1.0, blur_px=0.7)[0]
    y = corners(image, 40)
    views = [[taken(cv2, image, one, first, camera, 12)] for one in y]
    places = places_of(camera, first, y)
    looks = predicted(cv2, views, places, then, camera, 6)
    true = pixels(camera, then, places)
    inside = looks.told[((true > 25) & (true < np.array(now.shape[::-1]) - 25))[looks.told].all(axis=1)]
    assert len(inside) > 12
    radius = 12.0 if large else 4.0
    e = true[inside] + rng.uniform(-radius / 2, radius / 2, (len(inside), 2))
    Z = np.tile(np.eye(2) * (radius / 3) ** 2, (len(inside), 1, 1))
    found, scores = Searcher(cv2, now, looks.templates, ACCEPT).in_ellipses(inside, e, Z, 9.0)
    good = scores >= ACCEPT
    off = np.linalg.norm(found - true[inside], axis=1)[good]
    assert good.mean() > 0.8
    assert np.median(off) < 0.1
    at = np.rint(true).astype(int).tolist()
    truth = [correlation(now, looks.templates[k], at[k][0], at[k][1], 1) for k in inside[good]]
    assert np.median(truth) > 0.9


def map_of_points(count: int, estimator: Any = None) -> km.Slam:
    """Return a map of points before a camera that may have turned, correlated by what has been observed of them."""
    motion = km.motion.ConstantVelocity3D(sigma_v_mps_per_sqrt_s=0.3, sigma_w_radps_per_sqrt_s=0.3)
    start = np.array([0, 0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0])
    mount = km.Mount(CAMERA, at=(0, 0, 0, 0, 0, 0, 1), landmark=km.landmarks.Point3D())
    robot = km.Robot("camera", motion, start, {"eye": mount}, np.diag([1e-4] * 3 + [1e-5] * 3 + [0.01] * 6))
    slam, rng = km.Slam(robot, estimator=estimator, map="dense"), np.random.default_rng(5)
    for k in range(count):
        at = np.array([rng.uniform(-0.9, 0.9), rng.uniform(-0.6, 0.6), rng.uniform(1.6, 2.4)])
        slam.add_landmark(k, at, 1e-4 * np.eye(3), km.landmarks.Point3D())
    slam.process(km.Scan(0.0, "camera", "eye", slam.expect("camera", "eye").e, ids=range(count)))
    slam.process(km.Scan(0.1, "camera", "eye"))  # time passes: the camera may have turned
    return slam


def prospect_of(slam: km.Slam) -> Prospect:
    return Prospect(slam.map, slam.tracks, slam.state.channels["camera", "eye"], "camera")


def test_a_prospect_is_what_is_expected_and_what_a_correction_would_make_of_it() -> None:
    slam = map_of_points(12, km.estimators.Ekf())
    prospect, expected = prospect_of(slam), slam.expect("camera", "eye")
    rows = np.arange(12)
    assert prospect.names == list(expected.names)
    assert np.allclose(prospect.belief.e, expected.e)
    assert np.allclose(prospect.innovations(prospect.belief, rows), expected.Z, rtol=1e-6)
    y = prospect.belief.e[3] + [1.0, -0.5]
    after = prospect.after(prospect.belief, [3], y[None])
    slam.process(km.Scan(0.1, "camera", "eye", [y], ids=[3]))
    then = slam.expect("camera", "eye")
    assert np.abs(after.e - then.e).max() < 0.02
    assert np.allclose(prospect.innovations(after, rows), then.Z, rtol=0.05, atol=0.02)


class Planted:
    """A search that finds every landmark where it is, but for outliers, which are found elsewhere in their ellipses."""

    accept = ACCEPT

    def __init__(self, true: np.ndarray, wrong: dict[int, np.ndarray]) -> None:
        self.true, self.wrong = true, wrong

    def in_ellipses(self, which: Any, e: Any, Z: Any, d2: float) -> tuple[np.ndarray, np.ndarray]:
        y = np.array([self.wrong.get(int(k), self.true[k]) for k in which]).reshape(-1, 2)
        z = y - e
        inside = np.einsum("ka,kab,kb->k", z, np.linalg.inv(Z), z) <= d2
        return y, np.where(inside, 1.0, 0.0)

    def in_discs(self, which: Any, e: Any, radius: Any) -> tuple[np.ndarray, np.ndarray]:
        y = np.array([self.wrong.get(int(k), self.true[k]) for k in which]).reshape(-1, 2)
        return y, np.where(np.linalg.norm(y - e, axis=1) <= radius, 1.0, 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_one_point_ransac_rejects_planted_outliers_and_keeps_the_rest(seed: int) -> None:
    slam, rng = map_of_points(20), np.random.default_rng(seed)
    prospect = prospect_of(slam)
    turned = np.concatenate([slam.mean("camera")[:3], pose(0, 0, 0, 0.6, -0.9, 1.0)[3:]])
    true = pixels(CAMERA, turned, prospect.places) + rng.normal(0, 0.2, (20, 2))
    out = rng.permutation(20)[:6].tolist()
    angles = np.pi / 3 * np.arange(6)
    wrong = {k: true[k] + 5 * np.array([np.cos(a), np.sin(a)]) for k, a in zip(out, angles, strict=True)}
    found = Search(prospect, np.arange(20), Planted(true, wrong), 100).run(rng)
    assert sorted(np.flatnonzero(~found.matched).tolist()) == sorted(out)


def room(frames: int) -> tuple[list[km.Frame], np.ndarray]:
    """Return images of a corner of a room on a way with curves, and the poses of the camera."""
    sides = [
        wall(), Plane(pose(-2.0, -1.5, 2.0, 0, 90, 0), texture(3.0, 3.0, 0.004, np.random.default_rng(4), 60.0), 0.004),
        Plane(pose(-2.0, 0.9, 2.0, -90, 0, 0), texture(4.0, 3.0, 0.004, np.random.default_rng(6), 60.0), 0.004),
    ]  # fmt: skip
    renderer, rng, T = Renderer(sides, CAMERA), np.random.default_rng(1), []
    for k in range(frames):
        a = 0.05 * k
        T.append(pose(0.4 * np.sin(a), 0.15 * np.sin(2 * a), 0.2 * (1 - np.cos(a)), 2 * np.sin(a), -6 * np.sin(a), 0))
    images = [renderer.taken(one, rng, noise=1.0, blur_px=0.6)[0] for one in T]
    return [km.Frame(k / 30, "camera", "eye", image) for k, image in enumerate(images)], np.array(T)


def searching(seed: int = 0) -> km.Slam:
    motion = km.motion.ConstantVelocity3D(sigma_v_mps_per_sqrt_s=0.5, sigma_w_radps_per_sqrt_s=0.5)
    start = np.array([0, 0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0])
    landmark = km.landmarks.Homogeneous(prior_rho_per_m=0.5, sigma_rho_per_m=0.25)
    detector = km.vision.ActiveSearch(in_view=30, seed=seed)
    mount = km.Mount(CAMERA, at=(0, 0, 0, 0, 0, 0, 1), landmark=landmark, detector=detector)
    robot = km.Robot("camera", motion, start, {"eye": mount}, np.diag([0.0] * 6 + [0.3] * 6))
    return km.Slam(robot, map="dense")


def test_a_camera_finds_its_way_in_a_rendered_room_twice_the_same_and_from_a_saved_map(tmp_path: Path) -> None:
    frames, true = room(90)
    one, way = searching(), []
    for k, frame in enumerate(frames):
        report = one.process(frame)
        way.append(one.mean("camera")[:3])
        if k in SAVED:
            one.save(tmp_path / f"{k}.kmk")
    assert sum(o.outcome == "associated" for o in report.observations) > 15
    picture = km.vision.overlay(one.state.front_ends["camera", "eye"], report, scale=2)
    assert picture.shape == (480, 640, 3)
    assert (picture[:, :, 1] > picture[:, :, 0].astype(int) + 50).sum() > 15 * 12  # green dots, yellow ellipses
    p, q = np.array(way) - np.mean(way, axis=0), true[:, :3] - true[:, :3].mean(axis=0)
    U, s, V = np.linalg.svd(q.T @ p)
    aligned = p @ (U @ V).T * (s.sum() / np.sum(p * p))
    length = np.linalg.norm(np.diff(true[:, :3], axis=0), axis=1).sum()
    assert np.sqrt(np.mean(np.sum((aligned - q) ** 2, axis=1))) < 0.02 * length
    other, loaded = searching(), {k: km.Slam.load(tmp_path / f"{k}.kmk") for k in SAVED}
    for k, frame in enumerate(frames):
        other.process(frame)
        for since, again in loaded.items():
            if k > since:
                again.process(frame)
    for same in (other, *loaded.values()):
        assert np.array_equal(one.mean("camera"), same.mean("camera"))
        assert np.array_equal(one.covariance("camera"), same.covariance("camera"))
        assert one.landmarks().ids == same.landmarks().ids


def test_a_frame_whose_image_cannot_be_read_changes_nothing() -> None:
    slam = searching()
    frames, _ = room(1)
    slam.process(frames[0])
    before = slam.mean("camera")
    with pytest.raises(km.errors.EventError, match=r"the image is float64"):
        slam.process(km.Frame(1.0, "camera", "eye", lambda: np.zeros((240, 320))))
    assert slam.t_ns == 0
    assert np.array_equal(slam.mean("camera"), before)
