"""Sensors of the state: every Jacobian of the seam against differences, compiled and in Python."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.arrays import Array
from kalmark.declare import built_in, parameters
from kalmark.geometry.spaces import SE2, SE3, Space, mount_space
from kalmark.models.observe import PythonView, linearize, view_of
from kalmark.models.protocols import POSE, TWIST, world_of
from kalmark.models.state_sensors import StateSensor
from kalmark.models.state_view import sees_state

SENSORS = [cls for cls in built_in("sensor") if issubclass(cls, StateSensor)]
PLANE, SPACE, COASTING = km.motion.Unicycle(), km.motion.Odometry3D(), km.motion.ConstantVelocity3D()
UNIT = km.motion.Inertial()
CASES = [
    (cls, motion)
    for cls in SENSORS
    for motion in (PLANE, SPACE, COASTING, UNIT)
    if world_of(cls) in ("", motion.space.world) and (motion not in (COASTING, UNIT) or cls.views == TWIST)
]


def with_sigmas(cls: Any) -> Any:
    """Return a sensor with odd constants that are all in the map."""
    rng, names = np.random.default_rng(1), {p.name for p in parameters(cls)}
    given = {name: float(rng.uniform(0.8, 1.2)) for name, _, _ in cls.constants}
    given |= {"scale": 1.1} if "scale" in names else {}
    return cls(**given, **{name: 0.1 for name in names if name.startswith("sigma_")})


def drawn(space: Space, rng: np.random.Generator) -> Array:
    origin = np.zeros(space.size)
    if space.world == "space" or "mount in" in space.name:
        origin[6] = 1.0
    return space.plus(origin, rng.normal(0, 0.4, space.dof))


def at_origin(sensor: Any, plane: bool) -> Array:
    """Return the view of a robot that stands at the origin."""
    if sensor.views == TWIST or plane:
        return np.zeros((1, 3 if plane else 6))
    return np.array([[0.0, 0, 0, 0, 0, 0, 1]])


@pytest.mark.parametrize(("cls", "motion"), CASES, ids=lambda c: getattr(c, "__name__", type(c).__name__))
def test_jacobians_in_every_argument_are_those_of_differences(cls: Any, motion: Any) -> None:
    rng, plane = np.random.default_rng(3), motion is PLANE
    pose, sensor = (SE2 if plane else SE3), with_sigmas(cls)
    at, own = drawn(mount_space(pose.size), rng), len(sensor.parameters)
    view, in_python = view_of(sensor, None, at, motion), PythonView(sensor, None, at, np.array(sensor.angular), motion)
    head_space = Space("head", (*pose.kinds, *mount_space(pose.size, own).kinds))
    block = motion.space if sees_state(sensor, motion) else pose
    for _ in range(5):
        head = np.concatenate([drawn(pose, rng), at, sensor.parameters])
        l = drawn(block, rng) if sensor.views != POSE else np.zeros(0)
        told = np.append(0.7, rng.normal(0, 1, 6) if motion is UNIT and sees_state(sensor, motion) else [])
        y = np.append(sensor.expect(at_origin(sensor, plane))[0][0], told)[None]
        e, z, E_h, E_l = linearize(view, head, l[None], y)
        assert e.shape == y.shape
        if not hasattr(sensor, "cov_size"):  # in Python an innovation is y - e
            for compiled, plain in zip((e, z, E_h, E_l), linearize(in_python, head, l[None], y), strict=True):
                np.testing.assert_allclose(compiled, plain, atol=1e-12)
        of_head = differences(head_space, head, lambda x, l=l, y=y: linearize(view, x, l[None], y)[1][0])
        np.testing.assert_allclose(E_h[0], of_head, atol=2e-7, rtol=1e-6)
        if sensor.views == POSE:
            assert E_l.shape == (1, len(z[0]), 0)
            continue
        of_block = differences(block, l, lambda x, head=head, y=y: linearize(view, head, x[None], y)[1][0])
        np.testing.assert_allclose(E_l[0], of_block, atol=2e-7, rtol=1e-6)


def differences(space: Space, x: Array, innovation: Any) -> Array:
    """Return how the expectation, less an innovation, changes with the errors of x."""
    steps = 1e-5 * np.eye(space.dof)
    return np.stack([(innovation(space.plus(x, -d)) - innovation(space.plus(x, d))) / 2e-5 for d in steps], axis=1)
