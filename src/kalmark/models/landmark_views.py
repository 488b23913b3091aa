"""The view of a landmark from a pose and the measurement of that view, each called by its address.

======================================  ===========================================  ==================
landmark                                view v (K, d)                                sensors
======================================  ===========================================  ==================
point of the plane                      the point in the sensor's frame, 2 or more   those of the plane
wall of the plane                       distance and direction of its normal, 2      walls
Euclidean point                         the point in the sensor's frame, 3           points, cameras
inverse depth, anchored, homogeneous    the ray rho (p - t) and rho, 4               cameras
tag                                     its pose in the sensor's frame, 7            tags
line                                    normal of the plane through it, 3            segments
======================================  ===========================================  ==================

A built-in landmark has a function `look` of the form LOOK, a built-in sensor one `expected` of the form EXPECT: the
filter compiles neither into itself and never those that nobody uses.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY
from functools import cached_property, lru_cache
from typing import Annotated, Any, ClassVar

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.compiled import by_address, compiled, signature_of
from kalmark.declare import Limit, NotNegative, Number, Positive, declared
from kalmark.errors import EventError
from kalmark.geometry.angles import wrap
from kalmark.models import cameras, landmarks3d, lines, tags

# of the sensor's pose T and landmarks l (K, n): views v (K, d), V_T (K, ., 3 or 6), V_l (K, ., n)
LOOK = signature_of("Tuple((f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1]))(f8[::1], f8[:, ::1])")
# of the sensor's code, parameters and angles, views v and measurements y (K, m): e (K, m), innovations z (K, p), E_v
EXPECT = signature_of("Tuple((f8[:, ::1], f8[:, ::1], f8[:, :, ::1]))(i8, f8[::1], b1[::1], f8[:, ::1], f8[:, ::1])")
# of the same, with what is expected: how the expectations change with the sensor's parameters, E_p (K, p, c)
VARY = signature_of("f8[:, :, ::1](i8, f8[::1], b1[::1], f8[:, ::1], f8[:, ::1])")
# of the numbers of a noise and of expected measurements (K, m): the noise R (K, p, p)
NOISE = signature_of("f8[:, :, ::1](f8[::1], f8[:, ::1])")
look, expect, vary, noise_of = by_address(LOOK), by_address(EXPECT), by_address(VARY), by_address(NOISE)


# ------------------------------------------------------------------ landmarks
@compiled
def inverse_depth(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the views (K, 4) of inverse-depth points l (K, 6), V_T (K, 4, 6), V_l (K, 4, 6)."""
    return with_distance(l, landmarks3d.inverse_depth_seen_from(T, l))


@compiled
def anchored(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the views (K, 4) of anchored points l (K, 7), V_T (K, 4, 6), V_l (K, 4, 7)."""
    return with_distance(l, landmarks3d.anchored_seen_from(T, l))


@compiled
def homogeneous(T: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the views (K, 4) of homogeneous points l (K, 4), V_T (K, 4, 6), V_l (K, 4, 4)."""
    return with_distance(l, landmarks3d.homogeneous_seen_from(T, l))


@compiled
def with_distance(l: Array, rays: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Return rays (K, 3), R_T, R_l with the inverse distances, which are the last numbers of l (K, n)."""
    ray, R_T, R_l = rays
    k, n = l.shape
    v, V_T, V_l = np.empty((k, 4)), np.zeros((k, 4, 6)), np.zeros((k, 4, n))
    v[:, :3], v[:, 3] = ray, l[:, n - 1]
    V_T[:, :3], V_l[:, :3], V_l[:, 3, n - 1] = R_T, R_l, 1.0
    return v, V_T, V_l


# ------------------------------------------------------------------ sensors
@compiled
def components(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return e, z (K, m), E_v (K, m, errors of a view) of m numbers of v (K, d), from number `code` on, plus `par`.

    v is a point, a twist or a pose; of a pose of space, that has 6 errors, only the position.
    """
    k, m = y.shape
    e, E_v = np.empty((k, m)), np.zeros((k, m, 6 if v.shape[1] == 7 else v.shape[1]))
    for i in range(k):
        for j in range(m):
            e[i, j], E_v[i, j, code + j] = v[i, code + j] + (par[j] if len(par) > 0 else 0.0), 1.0
    return e, residual(y, e, angular), E_v


@compiled
def camera(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return e, z (K, 2), E_v (K, 2, d) of the pixels of a camera, `code` its lens."""
    e, E_ray = cameras.project(code, v[:, :3].copy(), par)
    E_v = np.zeros((len(v), 2, v.shape[1]))  # a pixel does not depend on its ray's inverse distance
    E_v[:, :, :3] = E_ray
    return e, y - e, E_v


@compiled
def pixel_depth(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return e, z (K, 3), E_v (K, 3, d) of pixels of a camera, `code` its lens, with 1 / depth along its axis."""
    k, d = v.shape
    e, E_v = np.empty((k, 3)), np.zeros((k, 3, d))
    e[:, :2], _, E_v[:, :2] = camera(code, par, angular, v, y[:, :2].copy())
    for i in range(k):
        rho = v[i, 3] if d == 4 else 1.0  # v is (x, y, z), or a ray with its inverse distance
        e[i, 2], E_v[i, 2, 2] = rho / v[i, 2], -rho / (v[i, 2] * v[i, 2])
        if d == 4:
            E_v[i, 2, 3] = 1.0 / v[i, 2]
    return e, y - e, E_v


@compiled
def stereo(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return e, z (K, 4), E_v (K, 4, 3) of the pixels of a stereo pair."""
    e, E_v = cameras.project_stereo(v, par[:4], par[4])
    return e, y - e, E_v


@compiled
def segment(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return e (K, 4), z (K, 2), E_v (K, 2, d) of segments of lines: z are the distances of the measured ends."""
    return lines.segment_innovation(v, y, par)


@compiled
def tag_pose(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return e (K, 7), z (K, 6), E_v (K, 6, 6) of poses of tags."""
    z, E_v = tags.pose_residual(y, v)
    return v.copy(), z, E_v


@compiled
def tag_corners(code: int, par: Array, angular: Flags, v: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return e (K, 9), z (K, 8), E_v (K, 8, 6) of the corners of tags, `code` the lens; y (K, 9) has the sizes."""
    pixels, E_v = tags.project_corners(code, v, y[:, 8].copy(), par)
    e = y.copy()
    e[:, :8] = pixels
    return e, y[:, :8] - pixels, E_v


@compiled
def raise_views(v: Array, height: float) -> Array:
    """Return views v (K, 2 or 3) in space (K, 3), from a sensor `height` m above the plane; in space that is 0.

    A landmark without a height is in the plane.
    """
    k, d = v.shape
    p = np.empty((k, 3))
    for i in range(k):
        p[i, 0], p[i, 1], p[i, 2] = v[i, 0], v[i, 1], (v[i, 2] if d > 2 else 0.0) - height
    return p


@compiled
def length_of_view(
    v: Array, i: int, height: float, shift: float, nearest: float
) -> tuple[float, tuple[float, float, float]]:
    """Return the distance of view number i of v (K, 2 or 3) from a sensor, and its direction: 0 at no distance.

    The sensor is `height` m above the plane, a receiver of it `shift` m to the right; none is nearer than `nearest`.
    """
    x, y, z = v[i, 0], v[i, 1] + shift, (v[i, 2] if v.shape[1] > 2 else 0.0) - height
    r = math.sqrt(nearest * nearest + x * x + y * y + z * z)
    return r, ((x / r, y / r, z / r) if r > 0.0 else (0.0, 0.0, 0.0))


@compiled
def residual(y: Array, e: Array, angular: Flags) -> Array:
    """Return z = y - e (K, m), the angles among them wrapped.  [S] (26)."""
    z = y - e
    for j in range(len(angular)):
        if angular[j]:
            for i in range(len(z)):
                z[i, j] = wrap(z[i, j])
    return z


def refuse_negative_ranges(y: Array) -> None:
    """Refuse measurements y (K, m) whose first component, a range, is negative."""
    ranges = y[:, 0].tolist()
    least = min(ranges, default=0.0)
    if least < 0:
        raise EventError(f"observation {ranges.index(least)}: range is {least} m, expected at least 0")


# ---------------------------------------------------------------------- what the sensors share
@lru_cache(maxsize=256)
def constant(variances: tuple[float, ...], count: int) -> Array:
    """Return `count` diagonal covariances (count, m, m), to be copied."""
    return np.tile(np.diag(variances), (count, 1, 1))


class Sensing:
    """Base of all sensors: `columns`, and white noise whose `sigmas` are the parameters of these names.

    Where it depends on what is expected, the compiled `noisy`, of the form NOISE, has it of `noise_numbers`.
    """

    columns: ClassVar[tuple[str, ...]]
    sigmas: ClassVar[tuple[str, ...]]
    expected: ClassVar[Any]
    varied: ClassVar[Any] = None
    noisy: ClassVar[Any] = None
    world: ClassVar[str]
    sees_kinds: ClassVar[tuple[str, ...]]
    finds_depth: ClassVar[bool]
    cov_size: ClassVar[int]

    @property
    def angular(self) -> tuple[bool, ...]:
        """Flags of the components that are angles: those in rad."""
        return tuple(column.endswith("_rad") for column in self.columns)

    def noise(self, y: Array) -> Array:
        """Return the noise R (K, p, p) of the innovations of measurements y (K, m)."""
        return constant(self._variances, len(y)).copy()

    @cached_property
    def _variances(self) -> tuple[float, ...]:
        return tuple(vars(self)[name] ** 2 for name in self.sigmas)


class Expecting(Sensing):
    """A sensor whose expectation is `expected`, compiled, of the form `seen.EXPECT`."""

    @property
    def code(self) -> int:
        """The first argument of `expected`: the lens of a camera, 0 for other sensors."""
        return 0

    @property
    def parameters(self) -> Array:
        """The parameters (p,), which may be in the map."""
        return np.zeros(0)

    @property
    def constants(self) -> Array:
        """The numbers (n,) of the compiled expectation: the parameters, and what is never in the map."""
        return np.array(self.parameters)

    def expect(self, v: Array) -> tuple[Array, Array]:
        """Return the expected measurements (K, m) of views v (K, d), and E_v (K, p, d or the view's errors)."""
        return self._expected(v, np.zeros((len(v), len(self.columns))))

    def parameters_jacobian(self, v: Array) -> Array:
        """Return E_p (K, p, c): how the expected measurements of v (K, d) change with the c parameters."""
        e, angular = self.expect(v)[0], np.array(self.angular, dtype=np.bool_)
        return np.asarray(type(self).varied(self.code, self.constants, angular, np.ascontiguousarray(v), e))

    def _expected(self, v: Array, y: Array) -> tuple[Array, Array]:
        angular = np.array(self.angular, dtype=np.bool_)
        v, y = np.ascontiguousarray(v, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64)
        e, _, E_v = type(self).expected(self.code, self.constants, angular, v, y)
        return e, E_v


class Spatial(Expecting):
    """Base of sensors of space, and of walls."""

    world = "space"
    sees_kinds: ClassVar[tuple[str, ...]] = ("point3",)

    def expect(self, v: Array, y: Array | None = None) -> tuple[Array, Array]:
        """Return the expected measurements (K, m) of views v (K, d), and E_v (K, p, d or the view's errors).

        The measurements `y` (K, m) are needed where they contain what has no expectation: a tag's size, a segment's
        ends.
        """
        return self._expected(v, np.zeros((len(v), len(self.columns))) if y is None else y)


@declared
class Cone(Expecting):
    """Limits of sight about x, of points in three dimensions."""

    _: KW_ONLY
    range_min_m: Annotated[NotNegative, "Nearest landmark that is measured."] = 0.0
    range_max_m: Annotated[Limit, "Farthest landmark that is measured."] = math.inf
    fov_rad: Annotated[Positive, "Field of view: the full angle of a cone about the sensor's x axis."] = 2 * math.pi

    point_size: ClassVar[int] = 3  # numbers of a view that are the point

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, d), that begin with points, lie within the range limits and the cone about x."""
        v = v[:, : self.point_size]
        distance, off = np.linalg.norm(v, axis=1), np.arctan2(np.linalg.norm(v[:, 1:], axis=1), v[:, 0])
        inside: Flags = (self.range_min_m <= distance) & (distance <= self.range_max_m)
        return inside & (off <= self.fov_rad / 2)


class InPlane:
    """Sensors of the plane: a view begins with two numbers of a point."""

    world: ClassVar[str] = "plane"
    point_size: ClassVar[int] = 2


class InSpace:
    """Sensors of points of space."""

    world: ClassVar[str] = "space"
    sees_kinds: ClassVar[tuple[str, ...]] = ("point3",)


class Distancing(Expecting):
    """Sensors of distances in three dimensions, in either world; their constants end with their height."""

    @property
    def height(self) -> float:
        """The sensor's height above the plane of the map, m; in space, where its pose has it, 0."""
        return 0.0

    @property
    def constants(self) -> Array:
        """The parameters and the height (p + 1,)."""
        return np.append(self.parameters, self.height)

    def risen(self, v: Array) -> Array:
        """Return views v (K, 2 or 3) in space (K, 3), from the sensor's height."""
        return np.asarray(raise_views(np.ascontiguousarray(v, dtype=np.float64), self.height))


@declared
class Raised(Distancing):
    """Those on a robot of the plane, with landmarks at their own heights."""

    _: KW_ONLY
    height_m: Annotated[Number, "Of the sensor above the plane of the map."] = 0.0

    world = "plane"
    sees_kinds: ClassVar[tuple[str, ...]] = ("point", "point_height")

    @property
    def height(self) -> float:
        """The sensor's height above the plane of the map, m."""
        return self.height_m

    def level(self, slant: Array) -> Array:
        """Return the distances (K,) in the plane of landmarks at height 0 that are `slant` (K,) m away."""
        return np.sqrt(np.maximum(slant**2 - self.height_m**2, 0.0))
