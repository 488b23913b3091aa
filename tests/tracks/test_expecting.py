"""Expectations of landmarks against the textbook, values by hand: Z, Jacobians by differences, reasons out of view."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.filter.map import StochasticMap
from kalmark.geometry import SE2, SE3
from kalmark.report import Expectations
from kalmark.tracks.channel import Channel
from kalmark.tracks.expecting import expectations
from kalmark.tracks.track import Track, Tracks

POINT, HIGH, WALL = km.landmarks.Point2D(), km.landmarks.PointHeight2D(), km.landmarks.Wall2D()
POSE, MOUNT = np.array([2.0, -1.0, 0.5 * math.pi]), np.array([0.0, 0.5, 0.5 * math.pi])
"""The sensor is at (1.5, -1) and looks along -x."""
AHEAD, ASIDE = np.array([-1.5, -1.0]), np.array([-2.5, 2.0])  # 3 m ahead; 5 m off, 36.87 deg to the right
STEP = 1e-6


def random_covariance(size: int, seed: int) -> np.ndarray:
    A = 0.1 * np.random.default_rng(seed).normal(size=(size, size + 2))
    return A @ A.T


P_POSE, P_MOUNT, P_AHEAD = random_covariance(3, 1), random_covariance(3, 2), random_covariance(2, 3)


def observed(pose: np.ndarray, mount: np.ndarray, l: np.ndarray) -> np.ndarray:
    """Return range and bearing (2,) of a point l (2,) from a mount on a robot, written out."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] + c * mount[0] - s * mount[1], pose[1] + s * mount[0] + c * mount[1]
    bearing = math.remainder(math.atan2(l[1] - y, l[0] - x) - pose[2] - mount[2], 2.0 * math.pi)
    return np.array([math.hypot(l[0] - x, l[1] - y), bearing])


def derivative(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Return the Jacobian of a function by central differences."""
    return np.stack([(function(x + h) - function(x - h)) / (2 * STEP) for h in STEP * np.eye(len(x))], axis=1)


def map_of(*landmarks: tuple[Any, Any, Any, Any], mount: bool = False) -> tuple[StochasticMap, Tracks]:
    """Return a map of a robot on slot 0 and its tracks, with landmarks: name, model, mean, covariance (None: exactly).

    A mount that is estimated is on slot 1.
    """
    m, tracks = StochasticMap(), Tracks(["r"])
    tracks.enter_block("r", m.add(SE2, POSE, P_POSE), robot=True)
    if mount:
        tracks.enter_block("r.s", m.add(SE2, MOUNT, P_MOUNT))
    for name, model, mean, cov in landmarks:
        if cov is None:
            tracks.known.add(name, model, np.array(mean))
        else:
            tracks.enter(Track(name, model, m.add(model.space, mean, cov)))
    return m, tracks


def channel_of(sensor: Any = None, mount: int = -1, landmark: Any = POINT, at: np.ndarray = MOUNT) -> Channel:
    return Channel(sensor or km.sensors.RangeBearing(0.1, 0.02), at, mount, landmark, lambda dof: math.inf, [landmark])


def expected(m: StochasticMap, tracks: Tracks, channel: Channel, *args: Any, **keys: Any) -> Expectations:
    return expectations(m, tracks, channel, "r", "s", *args, **keys)


def test_the_expectation_its_covariance_and_jacobians_are_those_of_the_textbook() -> None:
    """Z = E_r P_r E_r' + E_l P_l E_l' + R."""
    found = expected(*map_of(("a", POINT, AHEAD, P_AHEAD), ("b", POINT, ASIDE, 2 * P_AHEAD)), channel_of())
    assert (found.names, found.kinds, found.why) == (("a", "b"), ("point", "point"), ("", ""))
    np.testing.assert_allclose(found.e, [[3.0, 0.0], [5.0, -math.atan2(3.0, 4.0)]], atol=1e-12)
    for k, (l, P_l) in enumerate(((AHEAD, P_AHEAD), (ASIDE, 2 * P_AHEAD))):
        E_r = derivative(lambda r, l=l: observed(r, MOUNT, l), POSE)
        E_l = derivative(lambda l: observed(POSE, MOUNT, l), l)
        np.testing.assert_allclose(found.E_r[k], E_r, atol=1e-8)
        np.testing.assert_allclose(found.E_s[k], derivative(lambda s, l=l: observed(POSE, s, l), MOUNT), atol=1e-8)
        np.testing.assert_allclose(found.E_l[k], E_l, atol=1e-8)
        right = E_r @ P_POSE @ E_r.T + E_l @ P_l @ E_l.T + np.diag([0.1, 0.02]) ** 2
        np.testing.assert_allclose(found.Z[k], right, rtol=1e-6)
    assert found.E_p.shape == (2, 2, 0)


@pytest.mark.parametrize("exactly", [False, True])
def test_a_mount_that_is_estimated_adds_its_covariance(exactly: bool) -> None:
    m, tracks = map_of(("a", POINT, AHEAD, None if exactly else P_AHEAD), mount=True)
    found = expected(m, tracks, channel_of(mount=1))
    E_r = derivative(lambda r: observed(r, MOUNT, AHEAD), POSE)
    E_s = derivative(lambda s: observed(POSE, s, AHEAD), MOUNT)
    E_l = derivative(lambda l: observed(POSE, MOUNT, l), AHEAD)
    right = E_r @ P_POSE @ E_r.T + E_s @ P_MOUNT @ E_s.T + np.diag([0.1, 0.02]) ** 2
    right += np.zeros((2, 2)) if exactly else E_l @ P_AHEAD @ E_l.T
    np.testing.assert_allclose(found.Z[0], right, rtol=1e-6)
    np.testing.assert_allclose(found.E_s[0], E_s, atol=1e-8)


def test_a_landmark_known_exactly_adds_no_covariance_whatever_its_kind() -> None:
    m, tracks = map_of(("high", HIGH, [*AHEAD, 7.0], None), ("a", POINT, AHEAD, None), ("b", POINT, ASIDE, P_AHEAD))
    found = expected(m, tracks, channel_of())
    assert found.names == ("b", "high", "a"), "those of the map first"
    np.testing.assert_allclose(found.e[1:], [[3.0, 0.0], [3.0, 0.0]], atol=1e-12)
    E_r = derivative(lambda r: observed(r, MOUNT, AHEAD), POSE)
    np.testing.assert_allclose(found.Z[1], E_r @ P_POSE @ E_r.T + np.diag([0.1, 0.02]) ** 2, rtol=1e-6)
    np.testing.assert_array_equal(found.Z[1], found.Z[2])


def test_noise_that_grows_with_the_range_is_that_of_the_expected_range() -> None:
    m, tracks = map_of(("a", POINT, AHEAD, P_AHEAD), ("b", POINT, ASIDE, P_AHEAD))
    Z = [expected(m, tracks, channel_of(km.sensors.RangeBearing(0.1, 0.02, sigma_range_rel=s))).Z for s in (0.0, 0.2)]
    np.testing.assert_allclose((Z[1] - Z[0])[:, 0, 0], [(0.2 * 3.0) ** 2, (0.2 * 5.0) ** 2], rtol=1e-9)
    np.testing.assert_allclose((Z[1] - Z[0])[:, 1], 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("limits", "why"),
    [
        ({"range_max_m": 4.0}, "it is 5 m away, farther than 4 m"),
        ({"fov_rad": 1.2}, "it is 36.9 deg off the axis of a field of view of 68.8 deg"),
        ({"range_max_m": 5.5, "fov_rad": 1.3}, ""),
    ],
)
def test_a_landmark_beyond_a_limit_is_out_of_view_with_the_reason(limits: dict[str, float], why: str) -> None:
    m, tracks = map_of(("a", POINT, AHEAD, P_AHEAD), ("b", POINT, ASIDE, P_AHEAD))
    channel = channel_of(km.sensors.RangeBearing(0.1, 0.02, **limits))
    found = expected(m, tracks, channel)
    assert (found.in_view.tolist(), found.why) == ([True, not why], ("", why))
    np.testing.assert_allclose(found.e[1], [5.0, -math.atan2(3.0, 4.0)], atol=1e-12)
    assert expected(m, tracks, channel, only_in_view=True).names == ("a", "b")[: 1 + (not why)]


def test_what_is_too_near_is_out_of_sight() -> None:
    channel = channel_of(km.sensors.RangeBearing(0.1, 0.02, range_min_m=4.0))
    assert expected(*map_of(("a", POINT, AHEAD, P_AHEAD)), channel).why == ("it is out of sight",)


def test_a_robot_and_a_kind_that_the_sensor_does_not_observe_have_no_expectation() -> None:
    m, tracks = map_of(("wall", WALL, [-1.5, 0.0, 0.0], random_covariance(3, 4)), ("a", POINT, AHEAD, P_AHEAD))
    found = expected(m, tracks, channel_of(), ["wall", "r", "a"])
    said = "a RangeBearing does not observe a wall", "a robot does not observe itself", ""
    assert (found.why, found.in_view.tolist()) == (said, [False, False, True])
    assert np.isnan(found.e[:2]).all() and np.isnan(found.Z[:2]).all() and np.isfinite(found.Z[2]).all()
    assert found.kinds == ("wall", "robot", "point")


def test_of_a_wall_the_part_of_its_segment_in_the_field_of_view_is_expected() -> None:
    """The sensor at (1.5, -1) looks along -x at the wall x = -1.5: to the right of it is +y, at 45 deg 3 m far."""
    m, tracks = map_of(("wall", WALL, [-1.5, -1.0, math.pi], 0.01 * np.eye(3)))
    tracks.confirmed["wall"].extent = np.array([-9.0, 1.0])  # along -y
    channel = channel_of(km.sensors.Wall(fov_rad=0.5 * math.pi), landmark=WALL)
    found = expected(m, tracks, channel)
    np.testing.assert_allclose(found.e[0, 0], 3.0, atol=1e-9)
    np.testing.assert_allclose(np.sort(np.abs(found.e[0, 2:])), [1.0, 3.0], atol=1e-9)
    tracks.confirmed["wall"].extent = np.array([3.5, 9.0])
    assert expected(m, tracks, channel).why == ("no part of its segment is in view",)


# ---------------------------------------------------------------------- in space
LEVEL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])  # z of the sensor is forward


def in_space(sensor: Any, model: Any, means: Any, sizes: tuple[float | None, ...] = ()) -> Expectations:
    """Return what a sensor at the origin, looking along z, expects of landmarks of a type."""
    m, tracks = StochasticMap(), Tracks(["r"])
    tracks.enter_block("r", m.add(SE3, LEVEL, random_covariance(6, 5)), robot=True)
    for k, mean in enumerate(np.array(means)):
        tracks.enter(Track(k, model, m.add(model.space, mean, 0.01 * np.eye(model.space.dof))))
        tracks.confirmed[k].size_m = sizes[k] if sizes else None
    return expected(m, tracks, channel_of(sensor, landmark=model, at=LEVEL))


def test_a_camera_says_whether_a_point_is_behind_it_or_outside_its_image() -> None:
    camera = km.sensors.PinHole(fx_px=300.0, fy_px=200.0, cx_px=320.0, cy_px=240.0)
    found = in_space(camera, km.landmarks.Point3D(), [[0.5, -0.4, 2.0], [0.5, -0.4, -2.0], [9.0, 0.0, 2.0]])
    assert found.why == ("", "it is behind the camera", "it is outside the image")
    np.testing.assert_allclose(found.e[0], [320.0 + 300.0 * 0.25, 240.0 - 200.0 * 0.2], atol=1e-9)


def test_the_corners_of_a_tag_are_expected_once_its_size_is_measured() -> None:
    tag, camera = [0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0], km.sensors.TagCorners(fx_px=300.0, fy_px=300.0)
    found = in_space(camera, km.landmarks.Tag(), [tag, tag], (None, 0.4))
    assert (found.in_view.tolist(), found.why) == ([False, True], ("its size has not been measured", ""))
    corners = found.e[1, :8].reshape(4, 2) - [320.0, 240.0]
    np.testing.assert_allclose(np.abs(corners), 300.0 * 0.2 / 2.0, atol=1e-9)
    assert found.e[1, 8] == 0.4


def test_of_the_pose_of_a_tag_the_expectation_is_the_pose_in_the_sensor_frame() -> None:
    half = math.sqrt(0.5)
    found = in_space(km.sensors.TagPose(), km.landmarks.Tag(), [[0.3, -0.2, 2.0, 0.0, half, 0.0, half]])
    np.testing.assert_allclose(found.e[0], [0.3, -0.2, 2.0, 0.0, half, 0.0, half], atol=1e-12)
    assert found.Z.shape == (1, 6, 6)


def test_the_map_is_the_same_afterwards() -> None:
    m, tracks = map_of(("a", POINT, AHEAD, P_AHEAD), ("b", POINT, ASIDE, P_AHEAD))
    x, P = m.x.copy(), m.P.copy()
    expected(m, tracks, channel_of())
    np.testing.assert_array_equal(m.x, x)
    np.testing.assert_array_equal(m.P, P)
