"""The visual front end: patches found to a fraction of a pixel, warps, planted outliers, the same result twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam, open_run
from kalmark.geometry.frames3d import compose, from_euler_pose, from_frame_many, minus, to_frame_many
from kalmark.vision.appearance import predict_templates, take_view
from kalmark.vision.depth_images import inverse_depths, with_depths
from kalmark.vision.joint_expectation import Prospect
from kalmark.vision.pairs import with_pairs
from kalmark.vision.planes import Plane as Surroundings
from kalmark.vision.rendering import Rectangle, Renderer, texture
from kalmark.vision.selection import ImageSearch
from kalmark.vision.template_matching import Searcher, correlation

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


def wall(pixel_m: float = 0.004) -> Rectangle:
    """Return a wall of 4 m by 3 m, 2 m before a camera at the origin, which looks along z."""
    return Rectangle(
        pose(-2.0, -1.5, 2.0, 0, 0, 0), texture(4.0, 3.0, pixel_m, np.random.default_rng(3), 60.0), pixel_m
    )


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
    views = [[take_view(image, one, first, camera, 12)] for one in y]
    places = places_of(camera, first, y)
    facing = [Surroundings(view.rays[4]) for (view,) in views]
    looks = predict_templates(views, facing, places, then, camera, 6)
    true = pixels(camera, then, places)
    inside = looks.valid[((true > 25) & (true < np.array(now.shape[::-1]) - 25))[looks.valid].all(axis=1)]
    assert len(inside) > 12
    radius = 12.0 if large else 4.0
    e = true[inside] + rng.uniform(-radius / 2, radius / 2, (len(inside), 2))
    Z = np.tile(np.eye(2) * (radius / 3) ** 2, (len(inside), 1, 1))
    found, scores = Searcher(now, looks.templates, ACCEPT).in_ellipses(inside, e, Z, 9.0)
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
    found = ImageSearch(prospect, np.arange(20), Planted(true, wrong), 100).run(rng)
    assert sorted(np.flatnonzero(~found.matched).tolist()) == sorted(out)


def sides() -> list[Rectangle]:
    """Return the walls of a corner of a room."""
    return [
        wall(),
        Rectangle(pose(-2.0, -1.5, 2.0, 0, 90, 0), texture(3.0, 3.0, 0.004, np.random.default_rng(4), 60.0), 0.004),
        Rectangle(pose(-2.0, 0.9, 2.0, -90, 0, 0), texture(4.0, 3.0, 0.004, np.random.default_rng(6), 60.0), 0.004),
    ]  # fmt: skip


def room(frames: int) -> tuple[list[km.Frame], np.ndarray]:
    """Return images of a corner of a room on a way with curves, and the poses of the camera."""
    renderer, rng, T = Renderer(sides(), CAMERA), np.random.default_rng(1), []
    for k in range(frames):
        a = 0.05 * k
        T.append(pose(0.4 * np.sin(a), 0.15 * np.sin(2 * a), 0.2 * (1 - np.cos(a)), 2 * np.sin(a), -6 * np.sin(a), 0))
    images = [renderer.taken(one, rng, noise=1.0, blur_px=0.6)[0] for one in T]
    return [km.Frame(k / 30, "camera", "eye", image) for k, image in enumerate(images)], np.array(T)


def searching(seed: int = 0, others: dict[str, np.ndarray] | None = None, camera: Any = CAMERA) -> km.Slam:
    """Return a map seen by a `camera`, its sensor "eye", and by `others` like it on their mounts."""
    motion = km.motion.ConstantVelocity3D(sigma_v_mps_per_sqrt_s=0.5, sigma_w_radps_per_sqrt_s=0.5)
    start = np.array([0, 0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0])
    landmark = km.landmarks.Homogeneous(prior_rho_per_m=0.5, sigma_rho_per_m=0.25)
    detector = km.vision.ActiveSearch(in_view=30, seed=seed)
    mounts = {"eye": pose(0, 0, 0, 0, 0, 0)} | (others or {})
    sensors = {name: km.Mount(camera, at=at, landmark=landmark, detector=detector) for name, at in mounts.items()}
    robot = km.Robot("camera", motion, start, sensors, np.diag([0.0] * 6 + [0.3] * 6))
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
    picture = km.vision.overlay(one.state.sources["camera", "eye"], report, scale=2)
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


def test_patches_are_read_from_a_file_as_the_bytes_they_are(tmp_path: Path) -> None:
    slam = searching()
    for frame in room(12)[0]:
        slam.process(frame)
    slam.save(tmp_path / "map.kmk")
    looks, again = (each.state.sources["camera", "eye"].looks for each in (slam, km.Slam.load(tmp_path / "map.kmk")))
    assert again.keys() == looks.keys()
    for one, same in zip(looks.values(), again.values(), strict=True):
        assert (one.fitted, one.misfit) == (same.fitted, same.misfit)
        assert {view.patch.dtype for view in same.views} == {np.dtype(np.uint8)}
        assert all(np.array_equal(a.patch, b.patch) for a, b in zip(one.views, same.views, strict=True))


def test_a_landmark_whose_matches_slide_over_the_image_is_given_up_and_one_known_beforehand_is_not() -> None:
    for known in (False, True):
        slam = searching()
        frames, _ = room(40)
        for frame in frames[:-1]:
            slam.process(frame)
        looks = slam.state.sources["camera", "eye"].looks
        fits = [name for name, look in looks.items() if look.fitted >= 20 and not look.missed]
        assert max(looks[name].misfit for name in fits) < 2  # d2 a number measured
        looks[fits[0]].surveyed = known
        for _ in range(40):
            looks[fits[0]].fits(3.0, 0)
        report = slam.process(frames[-1])
        assert [name for name, reason in report.removed if "times their noise" in reason] == ([] if known else fits[:1])


def surveyed(frame: km.Frame, T: np.ndarray, cov: Any = None) -> tuple[km.Slam, dict[str, np.ndarray]]:
    """Return a map that knows corners of the wall, as in an image taken from T, and their pixels; it may start off."""
    image, stop = np.asarray(frame.image), (cv2.TERM_CRITERIA_COUNT, 20, 0)
    y = cv2.cornerSubPix(image, corners(image, 8).astype(np.float32), (4, 4), (-1, -1), stop).astype(np.float64)
    names = {f"corner {k}": one for k, one in enumerate(y)}
    motion = km.motion.ConstantVelocity3D(sigma_v_mps_per_sqrt_s=0.5, sigma_w_radps_per_sqrt_s=0.5)
    start = np.concatenate([pose(0.04, -0.03, 0.05, 1.0, -1.5, 0.8), np.zeros(6)])
    detector, landmark = km.vision.ActiveSearch(in_view=30, most=40), km.landmarks.Homogeneous(0.5, 0.25)
    mount = km.Mount(CAMERA, at=(0, 0, 0, 0, 0, 0, 1), landmark=landmark, detector=detector)
    spread = np.diag([0.04**2] * 3 + [np.radians(1.5) ** 2] * 3 + [0.3] * 6)
    slam = km.Slam(km.Robot("camera", motion, start, {"eye": mount}, spread), map="dense")
    for name, place in zip(names, places_of(CAMERA, T, y), strict=True):
        slam.add_landmark(name, place, cov)
    return slam, names


@pytest.mark.parametrize("cov", [None, 1e-6 * np.eye(3)])
def test_landmarks_known_beforehand_are_found_in_the_first_image_and_set_place_and_scale(
    cov: Any, tmp_path: Path
) -> None:
    frames, true = room(60)
    slam, known = surveyed(frames[0], true[0], cov)
    first = slam.process(frames[0])
    for o in first.observations:
        if o.landmark in known:
            assert np.abs(first.y[o.index] - known[o.landmark]).max() < 0.3
    assert sum(o.outcome == "associated" and o.landmark in known for o in first.observations) >= 6  # of 8
    slam.save(tmp_path / "map.kmk")
    off, nees, again = [], [], km.Slam.load(tmp_path / "map.kmk")
    for frame, T in zip(frames[1:], true[1:], strict=True):
        report = slam.process(frame)
        again.process(frame)
        assert sum(o.outcome == "associated" for o in report.observations) > 12
        error = minus(slam.mean("camera")[:7], T)
        off.append(error[:3])
        nees.append(error @ np.linalg.solve(slam.covariance("camera")[:6, :6], error))
    assert np.sqrt(np.mean(np.sum(np.square(off[10:]), axis=1))) < 0.01  # m; nothing aligned
    assert np.mean(nees) < 12  # 6 degrees of freedom
    assert set(known) <= set(slam.state.sources["camera", "eye"].looks)
    assert np.array_equal(slam.mean("camera"), again.mean("camera"))


def test_landmarks_known_beforehand_of_which_an_image_shows_nothing_are_not_guessed() -> None:
    frames, true = room(1)
    slam, known = surveyed(frames[0], true[0])
    before = slam.mean("camera")[:7]
    flat = np.random.default_rng(0).integers(118, 122, (240, 320)).astype(np.uint8)
    report = slam.process(km.Frame(0.0, "camera", "eye", flat))
    assert not report.observations
    assert np.array_equal(slam.mean("camera")[:7], before)
    assert known.keys() <= slam.state.sources["camera", "eye"].looks.keys()


def test_a_frame_whose_image_cannot_be_read_changes_nothing() -> None:
    slam = searching()
    frames, _ = room(1)
    slam.process(frames[0])
    before = slam.mean("camera")
    with pytest.raises(km.errors.EventError, match=r"the image is float64"):
        slam.process(km.Frame(1.0, "camera", "eye", lambda: np.zeros((240, 320))))
    assert slam.t_ns == 0
    assert np.array_equal(slam.mean("camera"), before)


def test_two_cameras_share_a_map_whose_landmarks_each_finds_by_its_own_patches_and_resume(tmp_path: Path) -> None:
    frames, true = room(24)
    side = pose(0.12, 0.0, 0.0, 0, 4, 0)
    renderer, rng = Renderer(sides(), CAMERA), np.random.default_rng(2)
    events = []
    for k, frame in enumerate(frames):
        image = renderer.taken(compose(true[k], side)[0], rng, noise=1.0, blur_px=0.6)[0]
        events += [frame, km.Frame(t_ns=frame.t_ns, robot="camera", sensor="side", image=image)]
    one = searching(others={"side": side})
    for k, event in enumerate(events):
        report = one.process(event)
        if k == 22:  # after an image of the one, before that of the other
            one.save(tmp_path / "map.kmk")
    assert sum(o.outcome == "associated" for o in report.observations) > 15
    names = {str(name).rsplit(" ", 1)[0] for name in one.landmarks().ids}
    assert names == {"camera.eye", "camera.side"}
    looks = {key: front_end.looks for key, front_end in one.state.sources.items()}
    assert set(looks["camera", "eye"]) | set(looks["camera", "side"]) == set(one.landmarks().ids)
    again = km.Slam.load(tmp_path / "map.kmk")
    for event in events[23:]:
        again.process(event)
    assert np.array_equal(one.mean("camera"), again.mean("camera"))
    assert np.array_equal(one.covariance("camera"), again.covariance("camera"))
    assert one.landmarks().ids == again.landmarks().ids


DEEP = km.sensors.PixelDepth(
    fx_px=250, fy_px=250, cx_px=159.5, cy_px=119.5, width_px=320, height_px=240, sigma_px=0.5, sigma_rho_per_m=0.003
)


def test_the_depth_of_a_pixel_counts_where_all_around_it_agree_and_what_is_expected_agrees() -> None:
    depth = np.full((20, 30), 2.0)
    depth[:, 15:] = 3.0  # an edge
    depth[5, 5] = 0.0  # a hole
    y = np.array([[10.2, 10.0], [14.4, 10.0], [20.0, 8.0], [6.0, 6.0], [0.0, 0.0], [29.0, 19.0]])
    rho = inverse_depths(depth, y, 0.003)
    np.testing.assert_allclose(rho, [0.5, np.nan, 1 / 3, np.nan, 0.5, 1 / 3])
    landmark = km.landmarks.Homogeneous(prior_rho_per_m=0.4, sigma_rho_per_m=0.2)
    e, variance = np.array([0.501, 0.4, 0.7]), np.full(3, 1e-5)
    out, R = with_depths(DEEP, landmark, y, rho, e, variance)
    z = DEEP.rays(y)[:, 2]
    np.testing.assert_allclose(
        out[:, 2], [0.5, 0.4, 0.7, 0.4 / z[3], 0.5, 1 / 3]
    )  # one at an edge, one not as expected
    np.testing.assert_allclose(np.sqrt(R[:, 2, 2]), [0.003, 1e3, 1e3, 0.2 / z[3], 0.003, 0.003])
    np.testing.assert_allclose(R[:, :2, :2], np.tile(0.25 * np.eye(2), (6, 1, 1)))
    bare = with_depths(DEEP, km.landmarks.Point3D(), y, rho, e, variance)[0]
    assert np.isnan(bare[:, 2]).tolist() == [False, False, False, True, False, False]  # it cannot start


def with_depth(frames: list[km.Frame], true: np.ndarray, holes: bool) -> list[km.Frame]:
    """Return the frames with depths beside them, noisy as a disparity is, with holes in half of the image or not."""
    renderer, rng, found = Renderer(sides(), CAMERA), np.random.default_rng(8), []
    for frame, T in zip(frames, true, strict=True):
        depth = renderer.render(T)[1].astype(np.float64)
        rho = 1.0 / depth + rng.normal(0.0, 0.003, depth.shape)
        there = np.isfinite(depth) & (rho > 0)
        if holes:
            there[:, :160] = False
        found.append(km.Frame(frame.t_s, "camera", "eye", frame.image, np.where(there, 1.0 / rho, 0.0)))
    return found


@pytest.mark.parametrize("holes", [False, True])
def test_a_camera_with_depths_knows_the_scale_also_where_half_of_the_image_has_none(holes: bool) -> None:
    frames, true = room(60)
    slam, off, nees = searching(camera=DEEP), [], []
    for frame, T in zip(with_depth(frames, true, holes), true, strict=True):
        slam.process(frame)
        error = minus(slam.mean("camera")[:7], T)
        off.append(error[:3])
        P = slam.covariance("camera")[:6, :6]
        if np.linalg.cond(P) < 1e12:
            nees.append(error @ np.linalg.solve(P, error))
    length = np.linalg.norm(np.diff(true[:, :3], axis=0), axis=1).sum()
    assert np.sqrt(np.mean(np.sum(np.square(off), axis=1))) < 0.01 * length  # in metres, nothing aligned
    assert np.mean(nees) < 12  # 6 degrees of freedom
    depths = slam.state.sources["camera", "eye"].prospect
    assert depths.belief.e.shape[1] == 3


def test_a_frame_whose_depths_are_of_another_size_changes_nothing() -> None:
    slam = searching(camera=DEEP)
    image = room(1)[0][0].image
    with pytest.raises(km.errors.EventError, match=r"the depths are \(120, 160\), expected \(240, 320\) as the image"):
        slam.process(km.Frame(0.0, "camera", "eye", image, np.ones((120, 160))))
    assert not slam.landmarks().ids
    slam.process(km.Frame(0.0, "camera", "eye", image))  # without depths: pixels alone
    assert slam.landmarks().ids


def test_the_shipped_configuration_of_depth_images_runs_the_layout_of_tum(tmp_path: Path) -> None:
    frames, true = room(30)
    lists: dict[str, str] = {"rgb": "", "depth": ""}
    for frame in with_depth(frames, true, holes=False):
        depth = np.rint(frame.depths() * 5000).astype(np.uint16)
        for kind, picture in (("rgb", frame.grey()), ("depth", depth)):
            file = tmp_path / kind / f"{frame.t_s:.6f}.png"
            file.parent.mkdir(exist_ok=True)
            assert cv2.imwrite(str(file), picture)
            lists[kind] += f"{frame.t_s:.6f} {kind}/{file.name}\n"
    for kind, rows in lists.items():
        (tmp_path / f"{kind}.txt").write_text(rows)
    (tmp_path / "calibration.yaml").write_text(
        "image_width: 320\nimage_height: 240\ncamera_matrix: {data: [250, 0, 159.5, 0, 250, 119.5, 0, 0, 1]}\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: {data: [0, 0, 0, 0, 0]}\n"
    )
    config, log = open_run("visual_depth", tmp_path)
    slam = build_slam(config, log)
    assert slam.robots["robot"].sensors["camera"].sensor.columns[2] == "rho_per_m"
    for event in log.events:
        slam.process(event)
    assert np.linalg.norm(minus(slam.mean("robot")[:7], true[-1])[:3]) < 0.01  # of .3 m, in metres


PAIR = km.sensors.Stereo(
    fx_px=250, fy_px=250, cx_px=159.5, cy_px=119.5, width_px=320, height_px=240, baseline_m=0.12,
    sigma_ul_px=0.5, sigma_vl_px=0.5, sigma_ur_px=0.5, sigma_vr_px=0.5,
)  # fmt: skip


def with_right(frames: list[km.Frame], true: np.ndarray, shown: bool = True) -> list[km.Frame]:
    """Return the frames with the image of a right camera, or one that shows nothing of what the left one does."""
    renderer, rng, found = Renderer(sides(), CAMERA), np.random.default_rng(8), []
    for frame, T in zip(frames, true, strict=True):
        right = renderer.taken(compose(T, pose(PAIR.baseline_m, 0, 0, 0, 0, 0))[0], rng, noise=1.0, blur_px=0.6)[0]
        right = right if shown else rng.integers(0, 256, right.shape).astype(np.uint8)
        found.append(km.Frame(frame.t_s, "camera", "eye", frame.image, right=right))
    return found


def test_the_right_image_of_a_pair_measures_disparities_and_what_it_does_not_show_counts_alone() -> None:
    frames, true = room(1)
    (frame,) = with_right(frames, true)
    image, right = frame.grey(), frame.right_grey()
    y = corners(image, 30)
    places = places_of(CAMERA, true[0], y)
    on_wall = np.abs(places[:, :2]).max(axis=1) < 0.85  # the floor begins lower
    y, true_e = y[on_wall], PAIR.expect(to_frame_many(true[0], places[on_wall])[0])[0]
    inside = true_e[:, 2] > 10
    y, true_e = y[inside], true_e[inside]
    k = len(y) // 2
    assert k > 4
    landmark = km.landmarks.Homogeneous(prior_rho_per_m=0.5, sigma_rho_per_m=0.25)
    e = true_e[:k] + np.array([0, 0, 2.0, 0])  # of the known ones the disparity is expected 2 px off
    Z = np.tile(np.diag([1.0, 1.0, 4.0, 1.0]), (k, 1, 1))
    out, R = with_pairs(PAIR, landmark, (image, right), y, e, Z, 6, ACCEPT)
    good = R[:, 2, 2] < 1.0
    assert good.mean() > 0.8
    assert np.median(np.abs(out - true_e)[good], axis=0).max() < 0.15
    assert np.abs(out - true_e)[good].max() < 1.0
    alone, R = with_pairs(PAIR, landmark, (image, None), y, e, Z, 6, ACCEPT)
    assert np.array_equal(alone[:, :2], y)
    assert (R[:k, 2, 2] == 1e6).all()
    ray, _ = PAIR.invert(alone[k:])
    assert ray[:, 3] == pytest.approx(0.5)  # the prior of the distance
    bare, _ = with_pairs(PAIR, km.landmarks.Point3D(), (image, None), y, e, Z, 6, ACCEPT)
    assert np.isnan(bare[:, 2]).tolist() == [False] * k + [True] * (len(y) - k)


def test_a_pair_knows_the_scale() -> None:
    frames, true = room(60)
    slam, off, nees, seen = searching(camera=PAIR), [], [], []
    for frame, T in zip(with_right(frames, true), true, strict=True):
        report = slam.process(frame)
        error = minus(slam.mean("camera")[:7], T)
        off.append(error[:3])
        seen.append(sum(o.outcome == "associated" for o in report.observations))
        P = slam.covariance("camera")[:6, :6]
        if np.linalg.cond(P) < 1e12:
            nees.append(error @ np.linalg.solve(P, error))
    length = np.linalg.norm(np.diff(true[:, :3], axis=0), axis=1).sum()
    assert np.mean(seen[1:]) > 20
    assert np.sqrt(np.mean(np.sum(np.square(off), axis=1))) < 0.01 * length  # in metres, nothing aligned
    assert np.mean(nees) < 12  # 6 degrees of freedom


def test_a_pair_whose_right_image_shows_nothing_is_one_camera() -> None:
    frames, true = room(8)
    slam = searching(camera=PAIR)
    for frame in with_right(frames, true, shown=False):
        report = slam.process(frame)
    assert sum(o.outcome == "associated" for o in report.observations) > 15
    with pytest.raises(
        km.errors.EventError, match=r"the right image is \(120, 160\), expected \(240, 320\) as the image"
    ):
        slam.process(km.Frame(9.0, "camera", "eye", frames[0].image, right=np.zeros((120, 160), np.uint8)))
