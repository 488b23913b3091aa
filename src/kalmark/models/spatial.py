"""Sensors of positions, in plane and space, of poses of tags and of walls; x is forward, y left, z up."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY
from typing import Annotated

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.declare import Limit, NotNegative, Positive, register
from kalmark.errors import EventError
from kalmark.events import unit_quaternion
from kalmark.models import landmark_views, walls
from kalmark.models.landmark_views import Cone, InPlane, InSpace, Spatial

__all__ = ["Position2D", "Position3D", "TagPose", "Wall"]


@register("sensor", "wall")
class Wall(Spatial):
    """Walls seen by a laser: distance of the line, direction of its normal, and what is seen of it.

    The ends of the segment, right and left, are abscissas from the foot of the perpendicular on.  Innovations and noise
    have two numbers: the ends are where the laser's view ends, not where the wall does.  docs/walls.md.

    >>> lidar = km.Mount(km.sensors.Wall())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar}))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[3.0, 0.0, -1.0, 2.0]], ids=["w"]))
    >>> slam.landmark_model("w").kind
    'wall'
    """

    sigma_distance_m: Annotated[Positive, "Noise of the distance of the line."] = 0.02
    sigma_normal_rad: Annotated[Positive, "Noise of the direction of its normal."] = 0.01
    _: KW_ONLY
    range_min_m: Annotated[NotNegative, "Nearest part of a wall that is measured."] = 0.0
    range_max_m: Annotated[Limit, "Farthest part of a wall that is measured."] = math.inf
    fov_rad: Annotated[Positive, "Field of view, centred forward."] = 2 * math.pi
    min_length_m: Annotated[NotNegative, "Shortest segment that counts as seen."] = 0.5

    world = "plane"
    expected = walls.wall
    cov_size = 2
    columns = ("distance_m", "normal_rad", "right_m", "left_m")
    sigmas = ("sigma_distance_m", "sigma_normal_rad")
    sees_kinds = ("wall",)

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the segments themselves (K, 4), and V_y (K, 4, 2)."""
        return y.copy(), np.tile(np.eye(4, 2), (len(y), 1, 1))

    def sees(self, v: Array) -> Flags:
        """Return (K,) that all lines are in view: a line has no end."""
        return np.ones(len(v), dtype=np.bool_)

    def sample_segments(self, rng: np.random.Generator, count: int) -> Array:
        """Return segments (count, 4) of walls within the range of the sensor."""
        distance = min(self.range_max_m, 10.0) / 4.0
        return np.array([[distance, 0.4 * k, -distance, distance] for k in range(count)])

    def sees_segments(self, T: Array, p1: Array, p2: Array) -> tuple[Flags, Array]:
        """Return which segments from p1 to p2 (K, 2) are seen from T, and their measurements (K, 4)."""
        limits = self.range_min_m, self.range_max_m, self.fov_rad / 2
        return walls.visible_wall(T, p1, p2, limits, self.min_length_m)

    def check(self, y: Array) -> None:
        """Refuse negative distances, and segments y (K, 4) whose right end is not to the right of the left one."""
        for i, row in enumerate(y):
            if row[0] < 0:
                raise EventError(f"observation {i}: distance_m is {row[0]}, expected at least 0")
            if not row[2] < row[3]:
                raise EventError(f"observation {i}: right_m is {row[2]}, expected less than left_m, {row[3]}")


class _Position(Cone):
    """Sensors of positions."""

    expected = landmark_views.components

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the points (K, d) and the identities (K, d, d)."""
        return y.copy(), np.tile(np.eye(y.shape[1]), (len(y), 1, 1))


@register("sensor", "position")
class Position2D(InPlane, _Position):
    """Position of a landmark (x, y) in the sensor's frame.

    [F]'s second measurement model.

    >>> camera = km.Mount(km.sensors.Position2D(), at=(0.0, 0.0, 1.5708))
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"camera": camera}))
    >>> report = slam.process(km.Scan(0.0, "rover", "camera", [[2.0, 0.0]], ids=["post"]))
    >>> slam.mean("post").round(3)  # to the left, as the sensor looks
    array([-0.,  2.])
    """

    sigma_x_m: Annotated[Positive, "Noise, forward."] = 0.1
    sigma_y_m: Annotated[Positive, "Noise, to the left."] = 0.1

    columns = ("x_m", "y_m")
    sigmas = ("sigma_x_m", "sigma_y_m")


@register("sensor", "position_3d")
class Position3D(InSpace, _Position):
    """Position of a landmark (x, y, z) in the sensor's frame; x is forward, z up: an RGB-D camera, a lidar.

    >>> camera = km.Mount(km.sensors.Position3D(), at=(0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0))
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"camera": camera}))
    >>> report = slam.process(km.Scan(0.0, "drone", "camera", [[2.0, 1.0, 0.2]], ids=["post"]))
    >>> slam.mean("post").round(3)
    array([2. , 1. , 0.7])
    """

    sigma_x_m: Annotated[Positive, "Noise, along x."] = 0.1
    sigma_y_m: Annotated[Positive, "Noise, along y."] = 0.1
    sigma_z_m: Annotated[Positive, "Noise, along z."] = 0.1

    columns = ("x_m", "y_m", "z_m")
    sigmas = ("sigma_x_m", "sigma_y_m", "sigma_z_m")


@register("sensor", "tag_pose")
class TagPose(Spatial):
    """The poses of square tags (x, y, z, qx, qy, qz, qw) in the sensor's frame.

    Innovations and noise have 6 numbers.

    >>> camera = km.Mount(km.sensors.TagPose())
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"camera": camera}))
    >>> report = slam.process(km.Scan(0.0, "drone", "camera", [[2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]], ids=[7]))
    >>> slam.mean(7).round(2), slam.landmark_model(7).kind
    (array([2., 0., 0., 0., 0., 0., 1.]), 'tag')
    """

    sigma_position_m: Annotated[Positive, "Noise of each coordinate."] = 0.02
    sigma_rotation_rad: Annotated[Positive, "Noise of the rotation about each axis."] = 0.02

    expected = landmark_views.tag_pose
    cov_size = 6
    columns = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    sigmas = (*3 * ("sigma_position_m",), *3 * ("sigma_rotation_rad",))
    sees_kinds = ("tag",)

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the poses themselves, their quaternions normalised, and the identity (K, 6, 6)."""
        L = np.hstack([y[:, :3], y[:, 3:] / np.linalg.norm(y[:, 3:], axis=1, keepdims=True)])
        return L, np.tile(np.eye(6), (len(y), 1, 1))

    def sees(self, v: Array) -> Flags:
        """Return (K,) that all tags are in view."""
        return np.ones(len(v), dtype=np.bool_)

    def check(self, y: Array) -> None:
        """Refuse poses y (K, 7) whose quaternion is not of length 1."""
        for i, row in enumerate(y):
            try:
                unit_quaternion(row[3:])
            except EventError as error:
                raise EventError(f"observation {i}: {error}") from None
