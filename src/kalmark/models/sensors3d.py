"""Sensors of space that find points and poses: range and bearing, positions, tags.  Cameras are in `sensors_camera`.

They look along x: x is forward, y left, z up.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from kalmark.declare import Positive, register
from kalmark.errors import EventError
from kalmark.geometry.directions import inv_spherical_many
from kalmark.models import seen
from kalmark.models.sensors2d import Farthest, Nearest, constant, refuse_negative_ranges

__all__ = ["Position3D", "RangeBearing3D", "TagPose"]

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Cone = Annotated[Positive, "Field of view, a cone about the sensor's x axis."]


class Spatial:
    """What the sensors of space share: the compiled expectation `expected`, of the form `seen.EXPECT`."""

    world: ClassVar[str] = "space"
    expected: ClassVar[Any]
    columns: ClassVar[tuple[str, ...]]
    angular: ClassVar[tuple[bool, ...]]
    sees_kinds: ClassVar[tuple[str, ...]] = ("point3",)
    additive: ClassVar[bool] = True

    @property
    def lens_code(self) -> int:
        """The lens of a camera, 0 for other sensors."""
        return 0

    @property
    def code(self) -> int:
        """What `expected` is told of the sensor: its lens."""
        return self.lens_code

    @property
    def parameters(self) -> Array:
        """The numbers (n,) of the compiled expectation."""
        return np.zeros(0)

    def expect(self, v: Array, y: Array | None = None) -> tuple[Array, Array]:
        """Return the expected measurements (K, m) of views v (K, d), and E_v (K, p, d or the view's errors).

        `y` (K, m), what was measured, is needed where it tells what cannot be expected: a tag's size, a segment's ends.
        """
        y = np.zeros((len(v), len(self.columns))) if y is None else y
        angular = np.array(self.angular, dtype=np.bool_)
        v, y = np.ascontiguousarray(v, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64)
        e, _, E_v = type(self).expected(self.code, np.array(self.parameters), angular, v, y)
        return e, E_v


class _Cone(Spatial):
    """Range sensors: limits of sight about x."""

    range_min_m: float
    range_max_m: float
    fov_rad: float

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, 3) lie within the range limits and the cone of sight about x."""
        distance = np.linalg.norm(v, axis=1)
        off = np.arctan2(np.hypot(v[:, 1], v[:, 2]), v[:, 0])
        return (self.range_min_m <= distance) & (distance <= self.range_max_m) & (off <= self.fov_rad / 2)


@register("sensor", "range_bearing_3d")
class RangeBearing3D(_Cone):
    """Distance, azimuth and elevation of a landmark; x is forward, z up: a 3-D laser, a radar."""

    sigma_range_m: Annotated[Positive, "Noise of the range."] = 0.1
    sigma_azimuth_rad: Annotated[Positive, "Noise of the azimuth."] = 0.02
    sigma_elevation_rad: Annotated[Positive, "Noise of the elevation."] = 0.02
    range_min_m: Nearest = 0.0
    range_max_m: Farthest = math.inf
    fov_rad: Cone = 2 * math.pi

    expected: ClassVar[Any] = seen.range_bearing
    columns: ClassVar[tuple[str, ...]] = ("range_m", "azimuth_rad", "elevation_rad")
    angular: ClassVar[tuple[bool, ...]] = (False, True, True)

    def noise(self, y: Array) -> Array:
        """Return R (K, 3, 3)."""
        return constant((self.sigma_range_m**2, self.sigma_azimuth_rad**2, self.sigma_elevation_rad**2), len(y))

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return points v (K, 3) and V_y (K, 3, 3)."""
        return inv_spherical_many(np.ascontiguousarray(y))

    def check(self, y: Array) -> None:
        """Refuse negative ranges in y (K, 3)."""
        refuse_negative_ranges(y)


@register("sensor", "position_3d")
class Position3D(_Cone):
    """Position of a landmark (x, y, z) in the sensor's frame; x is forward, z up: an RGB-D camera, a lidar."""

    sigma_x_m: Annotated[Positive, "Noise, along x."] = 0.1
    sigma_y_m: Annotated[Positive, "Noise, along y."] = 0.1
    sigma_z_m: Annotated[Positive, "Noise, along z."] = 0.1
    range_min_m: Nearest = 0.0
    range_max_m: Farthest = math.inf
    fov_rad: Cone = 2 * math.pi

    expected: ClassVar[Any] = seen.position
    columns: ClassVar[tuple[str, ...]] = ("x_m", "y_m", "z_m")
    angular: ClassVar[tuple[bool, ...]] = (False, False, False)

    def noise(self, y: Array) -> Array:
        """Return R (K, 3, 3)."""
        return constant((self.sigma_x_m**2, self.sigma_y_m**2, self.sigma_z_m**2), len(y))

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the points (K, 3) and the identities (K, 3, 3)."""
        return y.copy(), np.tile(np.eye(3), (len(y), 1, 1))


@register("sensor", "tag_pose")
class TagPose(Spatial):
    """The poses of square tags (x, y, z, qx, qy, qz, qw) in the sensor's frame.

    Innovations and noise have 6 numbers.
    """

    sigma_position_m: Annotated[Positive, "Noise of each coordinate."] = 0.02
    sigma_rotation_rad: Annotated[Positive, "Noise of the rotation about each axis."] = 0.02

    expected: ClassVar[Any] = seen.tag_pose
    cov_size: ClassVar[int] = 6
    columns: ClassVar[tuple[str, ...]] = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    angular: ClassVar[tuple[bool, ...]] = (False,) * 7
    sees_kinds: ClassVar[tuple[str, ...]] = ("tag",)

    def noise(self, y: Array) -> Array:
        """Return R (K, 6, 6)."""
        return constant((self.sigma_position_m**2,) * 3 + (self.sigma_rotation_rad**2,) * 3, len(y))

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the poses themselves and the identity (K, 6, 6)."""
        return y.copy(), np.tile(np.eye(6), (len(y), 1, 1))

    def sees(self, v: Array) -> Flags:
        """Return (K,) that all tags are in view."""
        return np.ones(len(v), dtype=np.bool_)

    def check(self, y: Array) -> None:
        """Refuse poses y (K, 7) whose quaternion is not of norm 1."""
        for i, row in enumerate(y):
            if abs(np.linalg.norm(row[3:]) - 1) > 1e-6:
                raise EventError(f"observation {i}: the quaternion is {row[3:].tolist()}, expected one of length 1")
