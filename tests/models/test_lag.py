"""A sensor whose lag is in the map: its mount some time ago, compiled and in Python, against differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.arrays import Array
from kalmark.geometry.spaces import SE2, SE3, Space, mount_space
from kalmark.models.observe import PythonView, follow_twist, linearize, mount_ago, sensor_pose, view_of
from kalmark.models.protocols import parameter_covariance
from kalmark.models.state_view import twist_between

PLANE_PAST = np.array([0.05, 2.0, 0.3, 0.9, -0.1, 0.01, -0.05])
SPACE_PAST = np.array([0.05, 2.0, 0.3, -0.2, 0.9, 0.1, -0.4, -0.1, 0.02, 0.01, 0.0, 0.1, 0.2, 0.97])
SPACE_PAST[10:] /= np.linalg.norm(SPACE_PAST[10:])
CASES = [
    (km.sensors.RangeBearing(0.1), km.landmarks.Point2D(), SE2, PLANE_PAST),
    (km.sensors.RangeBearing(0.1, sigma_scale=0.1, sigma_bias_m=0.1), km.landmarks.Point2D(), SE2, PLANE_PAST),
    (km.sensors.Bearing(), km.landmarks.Point2D(), SE2, PLANE_PAST),
    (km.sensors.RangeBearing3D(), km.landmarks.Point3D(), SE3, SPACE_PAST),
]


@pytest.mark.parametrize(("sensor", "landmark", "pose", "past"), CASES, ids=lambda c: type(c).__name__)
def test_jacobians_in_the_head_are_those_of_differences(sensor: Any, landmark: Any, pose: Space, past: Array) -> None:
    rng, own = np.random.default_rng(2), np.zeros(0) if parameter_covariance(sensor) is None else sensor.parameters
    at = pose.plus(np.zeros(3) if pose is SE2 else np.eye(7)[6], rng.normal(0.0, 0.3, pose.dof))
    space = Space("head", (*pose.kinds, *mount_space(pose.size, 1 + len(own)).kinds))
    head = np.concatenate([at, at, [0.08], own])
    head = space.plus(head, rng.normal(0.0, 0.02, space.dof))
    l = rng.uniform(3.0, 8.0, (3, landmark.space.size))
    y = sensor.expect(landmark.seen_from(at, l)[0])[0]
    view = view_of(sensor, landmark, at, past=past)
    in_python = PythonView(sensor, landmark, at, np.array(sensor.angular), past=past)
    e, z, E_h, E_l = linearize(view, head, l, y)
    for one, other in zip((e, z, E_h, E_l), in_python.linearize(head, l, y), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    for j, d in enumerate(np.eye(space.dof) * 1e-6):
        ahead, behind = (linearize(view, space.plus(head, step), l, y)[0] for step in (d, -d))
        np.testing.assert_allclose((ahead - behind) / 2e-6, E_h[:, :, j], atol=1e-7)


@pytest.mark.parametrize(("pose", "past"), [(SE2, PLANE_PAST), (SE3, SPACE_PAST)], ids=["plane", "space"])
def test_a_mount_some_time_ago_is_the_one_that_the_twist_has_moved_since(pose: Space, past: Array) -> None:
    twist, here = past[1 : 1 + pose.dof], np.zeros(3) if pose is SE2 else np.eye(7)[6]
    s = pose.plus(here, np.linspace(0.1, 0.3, pose.dof))
    still = np.concatenate([[0.0], twist, here])  # where it is now
    B = mount_ago(s, 0.2, still)[0]
    moved = follow_twist(twist, 0.2)[0]
    np.testing.assert_allclose(sensor_pose(moved, B)[0], s, atol=1e-12)
    np.testing.assert_allclose(twist_between(here, moved, 0.2), twist, atol=1e-9)
