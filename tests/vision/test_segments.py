"""Lines in images: segments that can be of a line, profiles, a rendered scene of known edges, images of a camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import kalmark as km
from kalmark.config import open_run
from kalmark.errors import ConfigError
from kalmark.geometry.frames3d import from_euler_pose
from kalmark.vision.overlay import MATCH
from kalmark.vision.rendering import Rectangle, Renderer
from kalmark.vision.segments import REACH_PX, LineFrontEnd, assign_pairs, compatible_segments, profiles
from kalmark.vision.straight import Straightened

cv2 = pytest.importorskip("cv2", reason="needs OpenCV: pip install 'kalmark[opencv]'")

CAMERA = km.sensors.Segments(
    fx_px=250, fy_px=250, cx_px=159.5, cy_px=119.5, width_px=320, height_px=240, sigma_px=0.5
)  # fmt: skip
PIXEL_M, FRAMES = 0.004, 60
START_M, SPEED_MPS = np.array([-0.5, -0.35, 0.0]), np.array([0.32, 0.24, 0.0])  # oblique: no edge lies along it
BOXES = {2.0: [(-1.2, -0.8, -0.4, 0.1), (0.3, -0.5, 1.3, 0.5)], 3.0: [(-0.5, 0.3, 0.4, 1.0), (1.2, -1.3, 2.0, 1.2)]}
"""Dark rectangles (x from, y from, x to, y to) in m, on two planes before the camera by their depth, m."""


def boxes() -> list[Rectangle]:
    """Return the planes: only the rectangles of the near one are there, all of the far one."""
    planes = []
    for depth, some in BOXES.items():
        if depth == max(BOXES):
            far = np.full((1500, 2000), 190, np.uint8)
            for x0, y0, x1, y1 in some:
                rows, columns = (slice(round((a + o) / PIXEL_M), round((b + o) / PIXEL_M))
                                 for a, b, o in ((y0, y1, 3.0), (x0, x1, 4.0)))  # fmt: skip
                far[rows, columns] = 90
            planes.append(Rectangle(np.array([-4.0, -3.0, depth, 0, 0, 0, 1.0]), far, PIXEL_M))
            continue
        for x0, y0, x1, y1 in some:
            near = np.full((round((y1 - y0) / PIXEL_M), round((x1 - x0) / PIXEL_M)), 60, np.uint8)
            planes.append(Rectangle(np.array([x0, y0, depth, 0, 0, 0, 1.0]), near, PIXEL_M))
    return planes


def edges() -> np.ndarray:
    """Return both ends (N, 2, 3) of all edges."""
    found = []
    for depth, some in BOXES.items():
        for x0, y0, x1, y1 in some:
            corners = np.array([[x0, y0, depth], [x1, y0, depth], [x1, y1, depth], [x0, y1, depth]])
            found += [corners[[k, (k + 1) % 4]] for k in range(4)]
    return np.array(found)


def frames(first: int = 0) -> list[km.Frame]:
    """Return what the camera takes as it moves across the scene."""
    renderer, rng = Renderer(boxes(), CAMERA), np.random.default_rng(1)
    found = []
    for k in range(FRAMES):
        t_s = 0.05 * k
        T = np.array([*(START_M + t_s * SPEED_MPS), 0, 0, 0, 1.0])
        image = renderer.taken(T, rng, noise=1.0, blur_px=0.6)[0]
        found.append(km.Frame(t_s, "hand", "eye", image))
    return found[first:]


def new_slam(landmark: Any) -> km.Slam:
    mount = km.Mount(CAMERA, at=(0, 0, 0, 0, 0, 0, 1), landmark=landmark, detector=km.vision.LineSearch())
    motion = km.motion.ConstantVelocity3D(sigma_v_mps_per_sqrt_s=0.02, sigma_w_radps_per_sqrt_s=0.02)
    start = np.array([*START_M, 0, 0, 0, 1.0, *SPEED_MPS, 0, 0, 0])
    cov = np.diag([0.0] * 6 + [1e-4] * 3 + [1e-5] * 3)
    return km.Slam(km.Robot("hand", motion, start, {"eye": mount}, cov), estimator=km.estimators.Ekf(), map="dense")


def looks(slam: km.Slam) -> LineFrontEnd:
    front_end = slam.state.sources["hand", "eye"]
    assert isinstance(front_end, LineFrontEnd)
    return front_end


KINDS = {
    "anchored_homogeneous": km.landmarks.AnchoredHomogeneousLine(prior_rho_per_m=0.4, sigma_rho_per_m=0.2),
    "anchored_pluecker": km.landmarks.AnchoredPlueckerLine(prior_beta_1=0.4, sigma_beta_1=0.2, sigma_beta_2=0.2),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_edges_of_rendered_rectangles_are_mapped_where_they_are(kind: str) -> None:
    slam, matched = new_slam(KINDS[kind]), []
    for frame in frames():
        report = slam.process(frame)
        matched.append(sum(o.outcome == "associated" for o in report.observations))
    assert np.mean(matched[5:]) > 8
    error = slam.mean("hand")[:3] - START_M - 0.05 * (FRAMES - 1) * SPEED_MPS
    assert np.linalg.norm(error) < 0.03
    P = slam.covariance("hand")[:3, :3]
    assert error @ np.linalg.solve(P, error) < 16.3  # 99.9 %
    lines = {l.id: l for l in slam.landmarks()}
    known = [name for name, look in looks(slam).looks.items() if look.fitted >= 30]
    assert len(known) >= 8
    squares = []
    for name in known:
        track, line = slam.tracks.confirmed[name], lines[name]
        p, P_l = track.model.endpoints(np.array(line.mean)[None], np.array([track.extent]))
        edge = min(edges(), key=lambda edge: off_line(p[0], edge))
        assert off_line(p[0], edge) < 0.2
        across = np.linalg.svd((edge[1] - edge[0])[None])[2][1:]
        for end in range(2):
            r, J = across @ (p[0, end] - edge[0]), across @ P_l[0, end]
            squares.append(r @ np.linalg.solve(J @ np.array(line.covariance) @ J.T, r))
    assert 0.5 < np.mean(squares) < 3.0  # of 2: both distances of each end from its edge
    assert max(squares) < 13.8  # 99.9 %


def off_line(points: np.ndarray, edge: np.ndarray) -> float:
    """Return how far the farther one of two points is from the line of an edge."""
    along = (edge[1] - edge[0]) / np.linalg.norm(edge[1] - edge[0])
    r = points - edge[0]
    return float(np.linalg.norm(r - (r @ along)[:, None] * along, axis=1).max())


def test_a_saved_map_with_lines_goes_on_as_if_it_had_not_been_interrupted(tmp_path: Path) -> None:
    slam = new_slam(KINDS["anchored_homogeneous"])
    for frame in frames()[:30]:
        slam.process(frame)
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    for frame in frames(30):
        one, other = slam.process(frame), again.process(frame)
        assert one.observations == other.observations
    assert np.array_equal(slam.mean("hand"), again.mean("hand"))


def test_a_segment_can_be_of_a_line_if_it_lies_along_it_the_same_way_round() -> None:
    e, Z = np.array([[100.0, 100.0, 200.0, 100.0]]), np.array([4.0 * np.eye(2)])
    segments = np.array([
        [120.0, 102.0, 190.0, 101.0],  # along it
        [190.0, 101.0, 120.0, 102.0],  # the other way round: the dark side is the other one
        [120.0, 109.0, 190.0, 109.0],  # 4.5 sigmas beside it
        [210.0, 100.0, 300.0, 100.0],  # behind its end
        [150.0, 97.0, 160.0, 103.0],  # across
        [180.0, 100.0, 400.0, 103.0],  # farther out the line is known less well
    ])  # fmt: skip
    may, length = compatible_segments(e, Z, segments, 1.0)
    assert may.tolist() == [[True, False, False, False, False, False]]
    assert length[0, 0] == pytest.approx(70.0)
    wide, _ = compatible_segments(e, 25.0 * Z, segments, 1.0)
    assert wide[0].tolist() == [True, False, True, False, False, False]


def test_distances_of_a_segment_have_the_covariance_of_its_own_ends() -> None:
    """Against the covariance of d(s) = (1 - s) d_1 + s d_2, written out for one segment on the border of the gate."""
    e, Z = np.array([[0.0, 0.0, 100.0, 0.0]]), np.array([[[5.0, 1.5], [1.5, 3.0]]])
    A = np.array([[1.0, 0.0], [-0.2, 1.2]])  # s = 0 and 1.2
    Z_s = A @ (Z[0] - np.eye(2)) @ A.T + np.eye(2)
    direction = np.array([1.0, 1.5])
    to_gate = np.sqrt(9.2103 / (direction @ np.linalg.solve(Z_s, direction)))
    for factor, inside in ((0.999, True), (1.001, False)):
        d = factor * to_gate * direction
        may, _ = compatible_segments(e, Z, np.array([[0.0, d[0], 120.0, d[1]]]), 1.0)
        assert may[0, 0] == inside


def test_a_profile_is_that_across_the_segment_from_its_dark_side() -> None:
    image = np.full((60, 80), 50, np.uint8)
    image[30:] = 200
    across = profiles(image, np.array([[10.0, 29.5, 70.0, 29.5], [70.0, 29.5, 10.0, 29.5]]))
    assert across.shape == (2, 2 * REACH_PX + 1)
    assert across[0] @ across[1] == pytest.approx(-1.0)
    assert (across[0, :REACH_PX] < 0).all()
    assert np.linalg.norm(across, axis=1) == pytest.approx(1.0)


def test_pairs_are_taken_best_first_and_each_once() -> None:
    worth = np.array([[5.0, 9.0, 0.0], [0.0, 8.0, 0.0], [1.0, 0.0, 0.0]])
    assert assign_pairs(worth).tolist() == [1, -1, 0]
    assert assign_pairs(np.zeros((2, 0))).tolist() == [-1, -1]


def test_a_line_of_the_world_is_straight_in_a_straightened_image() -> None:
    bent = km.sensors.PinHole(
        fx_px=200, fy_px=200, cx_px=158, cy_px=121, width_px=320, height_px=240, lens="radtan",
        distortion=(-0.28, 0.07, 0.0002, 2e-5, 0.0),
    )  # fmt: skip
    ideal = km.sensors.Segments(fx_px=200, fy_px=200, cx_px=158, cy_px=121, width_px=320, height_px=240)
    T = from_euler_pose(np.array([0.3, -0.2, 0.0, 0.05, -0.04, 0.1]))[0]
    image = Renderer(boxes(), bent).taken(T, np.random.default_rng(0))[0]
    straight = Straightened(bent, ideal.intrinsics, ideal.image).of(km.Frame(0.0, "hand", "eye", image))
    wanted = Renderer(boxes(), ideal).taken(T, np.random.default_rng(0))[0]
    inside = (slice(20, -20), slice(20, -20))
    off = np.abs(straight[inside].astype(float) - wanted[inside])
    assert np.median(off) < 1.0
    assert (off > 25).mean() < 0.02


IMAGES = """
log: {{path: {path}, fps: 20}}
robots:
  each:
    motion: {{type: constant_velocity_3d, sigma_v_mps_per_sqrt_s: 1.0, sigma_w_radps_per_sqrt_s: 2.0}}
    sensors:
      camera: {{fx_px: 251, distortion: [0.1], mount: {{x_m: 0.5}}, detector: {{type: active_search}}}}
      lines: {{type: segments, images: {camera}, detector: {{type: line_search}}, landmark: {{type: homogeneous_line}}}}
"""


def written(folder: Path, camera: str, more: str = "") -> Path:
    for k, frame in enumerate(frames()[:3]):
        cv2.imwrite(str(folder / f"{k}.png"), frame.grey())
    (folder / "run.yaml").write_text(IMAGES.format(path=folder, camera=camera) + more)
    return folder / "run.yaml"


def test_a_sensor_takes_the_images_of_a_camera_with_its_intrinsics_and_mount(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, log = open_run(written(tmp_path, "camera"))
    (robot,) = log.robots
    camera, lines = (config.robots[robot].sensors[name] for name in ("camera", "lines"))
    assert (lines.fx_px, lines.width_px, lines.mount.x_m) == (251, 320, 0.5)
    assert lines.fy_px == camera.fy_px
    assert [frame.sensor for frame in log.events] == ["camera", "lines"] * 3
    assert log.events[1].grey().shape == log.events[0].grey().shape
    assert not np.array_equal(log.events[1].grey(), log.events[0].grey())  # it is straightened
    decode = Mock(side_effect=cv2.imdecode)
    monkeypatch.setattr(cv2, "imdecode", decode)
    for frame in log.events:
        frame.grey()
    assert decode.call_count == 2  # each once for both; the first one above


@pytest.mark.parametrize(
    ("camera", "more", "wanted"),
    [
        ("[camera]", "", "run.yaml:8:.*images: got .*expected"),
        ("camera", "      again: {type: segments, images: lines}", "run.yaml:9:.*images: got 'lines', .* camera$"),
        ("camera", "      far: {type: position_3d, images: camera}", "run.yaml:9:.* expected one for pinhole or"),
    ],
)  # fmt: skip
def test_images_that_cannot_be_taken_are_refused_in_one_line(
    tmp_path: Path, camera: str, more: str, wanted: str
) -> None:
    with pytest.raises(ConfigError, match=wanted) as told:
        open_run(written(tmp_path, camera, more))
    assert "\n" not in str(told.value)


def test_images_of_no_camera_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"run.yaml:8:.*sensors.lines.images: got 'camra', .* camera.*camera"):
        open_run(written(tmp_path, "camra"))


def test_a_new_line_keeps_apart_from_those_expected() -> None:
    slam = new_slam(KINDS["anchored_homogeneous"])
    for frame in frames()[:20]:
        report = slam.process(frame)
        y = report.y
        for k, o in enumerate(report.observations):
            if o.outcome == "new":
                others = np.delete(np.arange(len(y)), k)
                middle = y[k].reshape(2, 2).mean(axis=0)
                gaps = [near(middle, y[j]) for j in others]
                assert min(gaps, default=9.0) > 3.0


def near(point: np.ndarray, segment: np.ndarray) -> float:
    a, b = segment.reshape(2, 2)
    s = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return float(np.linalg.norm(point - a - s * (b - a)))


def test_the_overlay_shows_lines_as_expected_and_as_measured() -> None:
    slam = new_slam(KINDS["anchored_homogeneous"])
    for frame in frames()[:10]:
        report = slam.process(frame)
    picture = km.vision.overlay(looks(slam), report, scale=2)
    assert picture.shape == (480, 640, 3)
    green = (picture == MATCH).all(axis=2)
    o = next(o for o in report.observations if o.outcome == "associated")
    u, v = (2 * report.y[o.index].reshape(2, 2).mean(axis=0)).round().astype(int)
    assert green[v - 2 : v + 3, u - 2 : u + 3].any()
