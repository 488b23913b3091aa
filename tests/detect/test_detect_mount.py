"""Detectors where they serve: on a mount, in a configuration, in a saved map, on a picture, on images."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import kalmark as km
from kalmark.cli.run import run_log
from kalmark.config.building import build_robot
from kalmark.config.reading import load_config
from kalmark.geometry.rotations import matrix
from kalmark.results.recording import config_yaml
from kalmark.slam.description import describe
from laser_worlds import ANGLES, SIGMA_M, LaserWorld

Data = Callable[[str], Path]

TREES = np.array([[8.0, 3.0, 0.3, 1], [12.0, -4.0, 0.2, 1], [6.0, -5.0, 0.45, 1], [15.0, 1.0, 0.4, 1]])


def raw_scan(t_s: float, random: np.random.Generator, x_m: float = 0.0) -> km.Scan:
    moved = TREES - [x_m, 0, 0, 0]
    r, _ = LaserWorld(circles=moved).scan(ANGLES, SIGMA_M, random)
    return km.Scan(t_s=t_s, robot="rover", sensor="laser", y=np.column_stack([r, ANGLES]))


def rover(detector: object) -> km.Slam:
    mount = km.Mount(km.sensors.RangeBearingSignature(), detector=detector)
    robot = km.Robot("rover", motion=km.motion.Unicycle(), sensors={"laser": mount})
    return km.Slam([robot], association=km.association.NearestNeighbour())


def test_a_robot_maps_trees_with_their_radii_from_raw_scans() -> None:
    slam, random = rover(km.detect.Trunks(range_max_m=80, signature=True)), np.random.default_rng(2)
    slam.process(km.Control(t_s=0.0, robot="rover", u=(0.5, 0.0)))
    for k in range(20):
        slam.process(raw_scan(0.2 * k, random, 0.1 * k))
    found = np.array([slam.mean(i) for i in slam.landmarks().ids])
    found = found[np.argsort(found[:, 2])]
    assert found.shape == (4, 3)
    assert np.allclose(found, TREES[np.argsort(TREES[:, 2]), :3], atol=0.1)
    assert np.linalg.norm(slam.mean("rover")[:2] - [1.9, 0]) < 0.05


def test_a_detector_is_saved_with_the_map_and_goes_on_from_there(tmp_path: Path) -> None:
    slam = rover(km.detect.Trunks(range_max_m=80, signature=True))
    for k in range(4):
        slam.process(raw_scan(0.2 * k, np.random.default_rng(k)))
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    for one in (slam, again):
        one.process(raw_scan(1.0, np.random.default_rng(9)))
    assert np.array_equal(slam.mean("rover"), again.mean("rover"))
    assert slam.landmarks().ids == again.landmarks().ids


def test_a_users_own_detector_must_be_given_again(tmp_path: Path) -> None:
    slam = rover(lambda scan: km.detect.Trunks(range_max_m=80, signature=True)(scan))  # noqa: PLW0108 - another class
    slam.process(raw_scan(0.0, np.random.default_rng(1)))
    slam.save(tmp_path / "map.kmk")
    with pytest.raises(km.KalmarkError, match="give the robots to load"):
        km.Slam.load(tmp_path / "map.kmk")


def test_a_raw_scan_of_the_wrong_shape_changes_nothing() -> None:
    slam = rover(km.detect.Trunks(range_max_m=80, signature=True))
    with pytest.raises(km.KalmarkError, match=r"scan at t=1 s: y has 1 columns, expected beams: range_m, bearing_rad"):
        slam.process(km.Scan(t_s=1.0, robot="rover", sensor="laser", y=np.ones((5, 1))))
    assert slam.t_ns is None


def test_the_configuration_gives_the_radius_to_a_sensor_that_takes_it(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(
        "robots: {each: {sensors: {a: {type: range_bearing, detector: {type: trunks, beams: 3}},"
        " b: {type: range_bearing_signature, detector: {type: corners}}}}}\n"
    )
    mounts = build_robot(load_config(path), "robot").sensors
    assert mounts["a"].detector == km.detect.Trunks(beams=3, signature=False)
    assert mounts["b"].detector == km.detect.Corners(signature=True)


class WallSeen:
    """The distance and the direction of a wall."""

    columns: ClassVar[tuple[str, ...]] = ("distance_m", "normal_rad")
    angular: ClassVar[tuple[bool, ...]] = (False, True)
    world: ClassVar[str] = "plane"

    def expect(self, v: Any) -> Any: ...
    def noise(self, y: Any) -> Any: ...


def test_detectors_of_walls_and_tags_are_recorded_and_read_again(tmp_path: Path) -> None:
    seen = km.register("sensor", "wall_seen")(WallSeen)()
    path = tmp_path / "config.yaml"
    walls = km.Mount(seen, detector=km.detect.Walls(split_m=0.3, signature=False))
    tags = km.Mount(km.sensors.TagCorners(), detector=km.detect.Tags("25h9"))
    for given, motion in ((walls, km.motion.Unicycle()), (tags, km.motion.Odometry3D())):
        path.write_text(config_yaml(describe(km.Slam(km.Robot("r", motion, sensors={"s": given})))))
        found = build_robot(load_config(path), "r").sensors["s"]
        assert type(found.sensor) is type(given.sensor)
        assert found.detector == given.detector


@pytest.mark.parametrize(
    ("sensor", "expected"),
    [
        ("range_bearing, detector: {type: walls}", "'walls', expected one of corners, reflectors, trunks"),
        ("bearing, detector: {type: trunks}", "expected nothing: no detector finds what this sensor measures"),
    ],
)
def test_a_detector_of_something_else_than_the_sensor_measures_is_refused(
    sensor: str, expected: str, tmp_path: Path
) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(f"robots: {{each: {{sensors: {{s: {{type: {sensor}}}}}}}}}")
    with pytest.raises(km.errors.ConfigError, match=expected):
        load_config(path)


def test_victoria_park_from_raw_scans_goes_the_way_of_the_known_trees(data: Data) -> None:
    path, minute = data("victoria_park"), ["log.to_s=60"]
    raw = run_log("victoria_park", path, overrides=minute, progress=False)
    known = run_log("victoria_park_known", path, overrides=minute, progress=False)
    there = raw.history.poses[-1] - known.history.poses[-1]
    assert np.linalg.norm(there[:2]) < 1.0
    assert abs(there[2]) < math.radians(2)
    assert len(raw.landmarks) > 15
    assert np.sum(raw.history.outcome == "associated") > 10 * len(raw.landmarks)


def test_a_scan_and_what_was_found_in_it_is_drawn(tmp_path: Path) -> None:
    world = LaserWorld(TREES, np.array([[20.0, -15.0, 20.0, 15.0]]))
    r, light = world.scan(ANGLES, SIGMA_M, np.random.default_rng(4))
    for detector in (km.detect.Trunks(range_max_m=80), km.detect.Walls(range_max_m=80)):
        ax = km.detect.draw_scan(r, ANGLES, detector.detect(r, ANGLES, light), range_max_m=80)
        assert len(ax.lines) > 3
        ax.figure.savefig(tmp_path / "scan.png")


def test_tags_are_found_where_the_sensor_expects_them_in_an_image() -> None:
    cv2 = pytest.importorskip("cv2", reason="needs OpenCV: pip install 'kalmark[opencv]'")
    camera = km.sensors.TagCorners(fx_px=500, fy_px=500, cx_px=320, cy_px=240, width_px=640, height_px=480)
    q = np.array([0.97, 0.1, -0.12, 0.05])  # the tag faces the camera: turned about x by almost 180 deg
    tag = np.array([0.1, -0.05, 1.2, *(q / np.linalg.norm(q))])
    wanted = expected_corners(tag, 0.3)
    image = rendered(cv2, wanted, 7)
    y, ids = km.detect.Tags(size_m=0.3).detect(image)
    assert ids == [7]
    assert np.abs(y[0, :8] - wanted).max() < 0.7
    assert y[0, 8] == 0.3
    found = camera.both(y)[0][0, 0]
    assert np.allclose(found[:3], tag[:3], atol=0.02)


def test_a_frame_is_what_its_image_as_a_scan_is_and_is_read_when_it_is_needed() -> None:
    cv2 = pytest.importorskip("cv2", reason="needs OpenCV: pip install 'kalmark[opencv]'")
    camera = km.sensors.TagCorners(fx_px=500, fy_px=500, cx_px=320, cy_px=240, width_px=640, height_px=480)
    q = np.array([0.97, 0.1, -0.12, 0.05])
    image = rendered(cv2, expected_corners(np.array([0.1, -0.05, 1.2, *(q / np.linalg.norm(q))]), 0.3), 7)
    mount = km.Mount(camera, detector=km.detect.Tags(size_m=0.3))
    robot = km.Robot("r", km.motion.Odometry3D(), sensors={"camera": mount, "blind": km.Mount(camera)})
    one, other, reads = km.Slam(robot), km.Slam(robot), iter([image])
    seen = one.process(km.Scan(1.0, "r", "camera", image))
    frames = [km.Frame(1.0, "r", "camera", lambda: next(reads))]
    run = km.record(other, frames, progress=False, pictures=False)
    assert [o[1:] for o in seen.observations] == [(7, "new", 7, None, "", ())]
    assert np.array_equal(one.mean(7), other.mean(7))
    assert run.history.stepped == "scan"
    assert run.history.landmark.tolist() == ["7"]
    with pytest.raises(km.errors.EventError, match="frame at t=2 s: 'blind' has no detector for a frame"):
        other.process(km.Frame(2.0, "r", "blind", image))
    with pytest.raises(km.errors.EventError, match=r"t=2 s: the image is float64 \(480, 640\), expected bytes"):
        other.process(km.Frame(2.0, "r", "camera", lambda: image * 1.0))
    assert other.t_ns == 1_000_000_000


def test_a_frame_is_grey_by_the_weights_of_its_colours() -> None:
    colours = np.random.default_rng(1).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    frame = km.Frame(0.0, "r", "camera", colours, lambda: np.ones((40, 60), np.uint16))
    grey = colours @ np.array([0.114, 0.587, 0.299])
    assert np.abs(frame.grey() - grey).max() <= 0.51
    assert frame.depths().dtype == np.float64


def expected_corners(tag: np.ndarray, size_m: float) -> np.ndarray:
    s = size_m / 2
    p = tag[:3] + np.array([[-s, -s, 0], [s, -s, 0], [s, s, 0], [-s, s, 0]]) @ matrix(tag[3:]).T
    return (p[:, :2] / p[:, 2:] * 500 + [320, 240]).ravel()


def rendered(cv2: Any, corners: np.ndarray, number: int) -> np.ndarray:
    """Return an image of a tag as it is printed, x to the right and y up, warped to these corners."""
    side = 400
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    print_ = cv2.aruco.generateImageMarker(family, number, side)
    at = np.array([[0, side], [side, side], [side, 0], [0, 0]], dtype=np.float32) - 0.5
    warp = cv2.getPerspectiveTransform(at, corners.reshape(4, 2).astype(np.float32))
    image = np.full((480, 640), 255, np.uint8)
    return cv2.warpPerspective(print_, warp, (640, 480), image, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)


@pytest.mark.parametrize("count", [1, 2])
def test_a_scan_of_one_or_two_returns_shows_nothing_and_is_no_error(count: int) -> None:
    slam = rover(km.detect.Trunks(range_max_m=80, signature=True))
    raw = raw_scan(0.0, np.random.default_rng(1))
    report = slam.process(km.Scan(t_s=0.0, robot="rover", sensor="laser", y=raw.y[:count]))
    assert report.observations == ()
    assert slam.t_ns == 0
