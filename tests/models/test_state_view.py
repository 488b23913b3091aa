"""Sensors of the state: every Jacobian of the seam against differences, compiled and in Python."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.declare import built_in, parameters
from kalmark.geometry.spaces import SE2, SE3, Space, mount_space
from kalmark.models.observe import linearize
from kalmark.models.protocols import TWIST, world_of
from kalmark.models.state_sensors import StateSensor
from kalmark.models.state_view import PythonStateView, state_view_of, swift_of

SENSORS = [cls for cls in built_in("sensor") if issubclass(cls, StateSensor)]
CASES = [(cls, world) for cls in SENSORS for world in ("plane", "space") if world_of(cls) in ("", world)]


def with_sigmas(cls: Any) -> Any:
    """Return a sensor with odd constants that are all in the map."""
    rng, names = np.random.default_rng(1), {p.name for p in parameters(cls)}
    given = {name: float(rng.uniform(0.8, 1.2)) for name, _, _ in cls.constants}
    given |= {"scale": 1.1} if "scale" in names else {}
    return cls(**given, **{name: 0.1 for name in names if name.startswith("sigma_")})


def drawn(space: Space, rng: np.random.Generator) -> Any:
    origin = np.zeros(space.size)
    if space.world == "space" or "mount in" in space.name:
        origin[6] = 1.0
    return space.plus(origin, rng.normal(0, 0.4, space.dof))


def _nothing(sensor: Any, world: str) -> Any:
    """Return the view of a robot that stands at the origin."""
    if sensor.views == TWIST or world == "plane":
        return np.zeros((1, 3 if world == "plane" else 6))
    return np.array([[0.0, 0, 0, 0, 0, 0, 1]])


@pytest.mark.parametrize(("cls", "world"), CASES, ids=lambda c: getattr(c, "__name__", c))
def test_jacobians_in_every_argument_are_those_of_differences(cls: Any, world: str) -> None:
    rng, pose = np.random.default_rng(3), SE2 if world == "plane" else SE3
    sensor = with_sigmas(cls)
    motion: Any = km.motion.Unicycle() if world == "plane" else km.motion.Odometry3D()
    at = drawn(mount_space(pose.size), rng)
    views = [
        state_view_of(sensor, motion, at),
        PythonStateView(sensor, swift_of(sensor, motion), at, np.array(sensor.angular)),
    ]
    own = len(sensor.parameters)
    head_space = Space("head", (*pose.kinds, *mount_space(pose.size, own).kinds))
    for _ in range(5):
        head = np.concatenate([drawn(pose, rng), at, sensor.parameters])
        l = drawn(pose, rng) if sensor.views != "pose" else np.zeros(0)
        y = np.append(
            sensor.expect(
                np.zeros((1, 6 if sensor.views == TWIST and world == "space" else 3))
                if sensor.views == TWIST or world == "plane"
                else np.array([[0, 0, 0, 0, 0, 0, 1.0]])
            )[0][0],
            0.7,
        )[None]
        results = [linearize(view, head, l[None], y) for view in views]
        for compiled, plain in zip(*results, strict=True):
            np.testing.assert_allclose(compiled, plain, atol=1e-12)
        e, z, E_h, E_l = results[0]
        assert e.shape == y.shape
        assert E_h.shape == (1, z.shape[1], head_space.dof)
        for space, x, J, which in ((head_space, head, E_h, 0), (pose, l, E_l, 1)):
            if len(x) == 0:
                assert J.shape[2] == 0
                continue
            for j in range(space.dof):
                d = np.zeros(space.dof)
                d[j] = 1e-5
                ends = [space.plus(x, s * d) for s in (1, -1)]
                zs = [linearize(views[0], *((end, l[None]) if which == 0 else (head, end[None])), y)[1] for end in ends]
                np.testing.assert_allclose(J[0, :, j], (zs[1] - zs[0])[0] / 2e-5, atol=2e-7, rtol=1e-6)
