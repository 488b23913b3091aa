"""Simulated cameras: points, segments and tags in their image, wrong by their pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.events import Scan
from kalmark.geometry import SE3
from kalmark.geometry.rotations import from_euler
from kalmark.logs.log import Log
from kalmark.simulate import World, simulate
from space_worlds import assert_sigma, scans, world

AHEAD = {"roll_deg": -90.0, "yaw_deg": -90.0}


def camera_world(sensor: dict[str, Any], **keys: Any) -> World:
    return world(robot={"sensors": {"s": {"mount": AHEAD} | sensor}}, **keys)


def in_camera(log: Log, scan: Scan, l: np.ndarray) -> np.ndarray:
    T = km.geometry.frames3d.compose(log.truth["r"].at(scan.t_ns), AHEAD_POSE)[0]
    return km.geometry.frames3d.to_frame_many(T, l)[0]


AHEAD_POSE = np.concatenate([np.zeros(3), from_euler(np.radians([-90.0, 0.0, -90.0]))[0]])


@pytest.mark.parametrize(
    ("section", "sensor"),
    [
        ({"type": "pinhole", "distortion": (-0.3, 0.1)}, km.sensors.PinHole(distortion=(-0.3, 0.1))),
        ({"type": "omnidirectional"}, km.sensors.Omnidirectional()),
        ({"type": "stereo"}, km.sensors.Stereo()),
    ],
    ids=["pinhole", "omnidirectional", "stereo"],
)
def test_cameras_see_what_is_in_their_image_and_are_wrong_by_their_pixels(section: dict[str, Any], sensor: Any) -> None:
    log = simulate(camera_world(section, steps=150), 3)
    z = []
    for s in scans(log):
        v = in_camera(log, s, np.array([log.landmarks[i] for i in s.ids]))
        assert sensor.sees(v).all()
        hidden = in_camera(log, s, np.array([l for i, l in log.landmarks.items() if i not in s.ids]))
        assert not sensor.sees(hidden).any()
        z.append(s.y - sensor.expect(v)[0])
    for column in np.concatenate(z).T:
        assert_sigma(column, 1.0)


def test_a_camera_of_segments_measures_both_ends_within_the_image() -> None:
    house = {"type": "house", "x_m": 3.0, "y_m": -2.5}
    still = {"type": "constant", "u": (0.0, 0.0, 0.0, 0.0, 0.0, 0.02)}
    robot = {"sensors": {"s": {"type": "segments", "mount": AHEAD}}, "route": still}
    log = simulate(world(world=house, robot=robot, steps=100), 3)
    lengths, across = [], []
    for s in scans(log):
        assert (s.y > -6).all() and (s.y < [646, 486, 646, 486]).all()
        lengths.append(np.hypot(s.y[:, 2] - s.y[:, 0], s.y[:, 3] - s.y[:, 1]))
        for i, y in zip(s.ids, s.y, strict=True):
            a, b = in_camera(log, s, log.landmarks[i].reshape(2, 3))
            k = np.array([[320, 0, 320], [0, 320, 240], [0, 0, 1.0]])
            line = np.linalg.inv(k).T @ np.cross(a, b)
            across += [(line @ [*end, 1.0]) / np.hypot(*line[:2]) for end in y.reshape(2, 2)]
    assert np.concatenate(lengths).min() > 20 - 6
    assert len({i for s in scans(log) for i in s.ids}) > 15
    assert_sigma(np.array(across), 1.0)


@pytest.mark.parametrize("kind", ["tag_corners", "tag_pose"])
def test_a_camera_sees_the_tags_that_face_it(kind: str) -> None:
    behind = {"x_m": 4.0, "y_m": 1.0, "roll_deg": -90.0, "yaw_deg": 90.0, "size_m": 0.5}  # its back
    tags = ({"x_m": 4.0, "roll_deg": -90.0, "yaw_deg": -90.0, "size_m": 0.5}, behind)
    still = {"type": "constant", "u": (0.0,) * 6}
    robot = {"sensors": {"s": {"type": kind, "mount": AHEAD}}, "route": still}
    log = simulate(world(world={"type": "list", "tags": tags}, robot=robot, steps=300), 3)
    y = np.concatenate([s.y for s in scans(log)])
    assert {i for s in scans(log) for i in s.ids} == {1} and len(y) == 300
    if kind == "tag_corners":
        half = 320 * 0.25 / 4
        corners = np.array(
            [320 - half, 240 - half, 320 + half, 240 - half, 320 + half, 240 + half, 320 - half, 240 + half]
        )
        np.testing.assert_allclose(y[:, 8], 0.5)
        for column in (y[:, :8] - corners).T:
            assert_sigma(column, 1.0)
    else:
        np.testing.assert_allclose(np.linalg.norm(y[:, 3:], axis=1), 1)
        d = np.array([SE3.minus(pose, np.array([0, 0, 4.0, 0, 0, 0, 1])) for pose in y])
        for column in d.T:
            assert_sigma(column, 0.02)
