"""Landmarks and their views from a pose: Euclidean and polar points, points of unknown depth, tags, lines.

A landmark of a kind that has a prior can be started by a sensor that does not measure all of it: the prior is that
of the rest.  The views from a sensor are in `landmarks2d`, `landmarks3d`, `lines` and `tags`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from kalmark.arrays import Array
from kalmark.declare import NotNegative, Number, built_in, declared, register
from kalmark.geometry import spaces
from kalmark.geometry.directions import unit_many
from kalmark.geometry.spaces import SE3, Space
from kalmark.models import landmark_views, landmarks2d, landmarks3d, lines, tags, walls

__all__ = [
    "BUILT_IN", "LINES", "AnchoredHomogeneous", "AnchoredHomogeneousLine", "AnchoredPlueckerLine", "AsPoint",
    "Homogeneous", "HomogeneousLine", "InverseDepth2D", "InverseDepth3D", "InverseDepthLine", "PlueckerLine", "Point2D",
    "Point3D", "PointHeight2D", "PointSignature2D", "Polar2D", "Tag", "Wall2D",
]  # fmt: skip

TINY_M = 1e-12

PriorDepth = Annotated[Number, "Inverse distance expected where the sensor measures none."]
DepthSigma = Annotated[NotNegative, "Standard deviation of that."]


class _Landmark:
    """Base of the landmarks: the compiled view `look`, of the form `seen.LOOK`, and the landmark of a view `of`."""

    kind: ClassVar[str]
    space: ClassVar[Space]
    look: ClassVar[Any]
    of: ClassVar[Any]

    def seen_from(self, T: Array, l: Array) -> tuple[Array, Array, Array]:
        """Return the view v (K, d), V_T (K, ., 3 or 6), V_l (K, ., n), in error coordinates."""
        return self.look(T, np.ascontiguousarray(l))

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return landmarks l (K, n) that look like v (K, d), L_T (K, ., 3 or 6), L_v (K, ., d)."""
        return self.of(T, np.ascontiguousarray(v))


@register("landmark", "point")
class Point2D(_Landmark):
    """A Euclidean point (x, y) of the plane.

    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle()))
    >>> slam.add_landmark("tree", mean=(4.0, 1.0), cov=0.01 * np.eye(2))
    >>> slam.mean("tree"), slam.landmark_model("tree").kind
    (array([4., 1.]), 'point')
    """

    kind = "point"
    space = spaces.POINT2
    look = staticmethod(landmarks2d.point_seen_from)
    of = staticmethod(landmarks2d.point_from_view)


@register("landmark", "point_signature")
class PointSignature2D(Point2D):
    """A Euclidean point of the plane with a signature (x, y, s).

    [T]'s landmark, d = 3N + 3.

    >>> own = km.Mount(km.sensors.RangeBearingSignature())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"own": own}))
    >>> report = slam.process(km.Scan(0.0, "rover", "own", [[4.0, 0.0, 7.5]], ids=["tree"]))
    >>> slam.landmark_model("tree").kind, slam.mean("tree").round(2)
    ('point_signature', array([4. , 0. , 7.5]))
    """

    kind = "point_signature"
    space = Space("point_signature", (spaces.VECTOR, spaces.SCALAR))


@register("landmark", "point_height")
class PointHeight2D(Point2D):
    """A surveyed point (x, y, z) at a height above the plane, in which the robot stays.

    Sensors of distances measure the way through space; others see its place in the plane.

    >>> own = km.Mount(km.sensors.Range())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"own": own}))
    >>> slam.add_landmark("beacon", mean=(4.0, 0.0, 3.0), cov=0.01 * np.eye(3), landmark=km.landmarks.PointHeight2D())
    >>> slam.expect("rover", "own").e.round(2)
    array([[5.]])
    """

    kind = "point_height"
    space = Space("point_height", (spaces.VECTOR, spaces.SCALAR))


@register("landmark", "polar")
class Polar2D(_Landmark):
    """A point of the plane by anchor, direction and distance (4 numbers), for ranges with poor bearings.

    The errors are along an arc.  [S] 2.3.5.

    >>> own = km.Mount(km.sensors.RangeBearing(), landmark=km.landmarks.Polar2D())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"own": own}))
    >>> report = slam.process(km.Scan(0.0, "rover", "own", [[4.0, 0.5]], ids=[7]))
    >>> slam.mean(7).round(2)  # anchor, direction, distance
    array([0. , 0. , 0.5, 4. ])
    """

    kind = "polar"
    space = Space("polar", (spaces.VECTOR, spaces.HEADING, spaces.SCALAR))
    look = staticmethod(landmarks2d.polar_seen_from)
    of = staticmethod(landmarks2d.polar_from_view)

    def to_point(self, l: Array) -> tuple[Array, Array]:
        """Return the Euclidean points p (K, 2) and P_l (K, 2, 4)."""
        return landmarks2d.polar_to_point(np.ascontiguousarray(l))

    place = to_point

    def linearity(self, T: Array, l: Array, sigmas: Array) -> Array:
        """Return how far the arc of a sigma leaves its tangent, in sigmas of the distance (K,); `sigmas` (K, 4)."""
        return np.asarray(0.5 * l[:, 3] * sigmas[:, 2] ** 2 / np.maximum(sigmas[:, 3], TINY_M))


@register("landmark", "wall")
class Wall2D(_Landmark):
    """A wall of the plane: a line with the segment that has been observed of it (3 numbers).

    A point on the line and the direction of its normal.  docs/walls.md.

    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle()))
    >>> slam.add_landmark("wall", mean=(4.0, 0.0, np.pi), cov=0.01 * np.eye(3), landmark=km.landmarks.Wall2D())
    >>> slam.landmark_model("wall").kind, slam.mean("wall").round(2)
    ('wall', array([4.  , 0.  , 3.14]))
    """

    join_m: Annotated[
        NotNegative, "Segments of one line with a gap of at most this are of one wall; a door is wider."
    ] = 0.3
    extend: Annotated[bool, "The segment kept of the wall grows with what is seen of it."] = True

    kind = "wall"
    space = Space("wall", (spaces.VECTOR, spaces.HEADING))
    first_ends: ClassVar[tuple[float, float]] = (0.0, 0.0)
    look = staticmethod(walls.wall_seen_from)
    of = staticmethod(walls.wall_from_view)

    def endpoints(self, l: Array, t: Array) -> tuple[Array, Array]:
        """Return the points (K, 2, 2) at abscissas t (K, 2), and P_l (K, 2, 2, 3)."""
        return walls.wall_endpoints(l, t)

    def abscissas(self, T: Array, l: Array, v: Array) -> Array:
        """Return the abscissas (K, 2), in order, of the ends of segments v (K, 4) seen from T."""
        return walls.wall_abscissas(T, l, v)

    def difference(self, a: Array, b: Array, t: float) -> tuple[Array, Array, Array]:
        """Return the angle and the distance (2,) of the wall b from a, both (3,), at the abscissa t, Z_a, Z_b."""
        return walls.wall_difference(a, b, t)


@register("landmark", "point")
class Point3D(_Landmark):
    """A Euclidean point (x, y, z) of space.

    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D()))
    >>> slam.add_landmark("tree", mean=(4.0, 1.0, 0.5), cov=0.01 * np.eye(3))
    >>> slam.mean("tree"), slam.landmark_model("tree").kind
    (array([4. , 1. , 0.5]), 'point3')
    """

    kind = "point3"
    space = spaces.POINT3
    look = staticmethod(landmarks3d.point_seen_from)
    of = staticmethod(landmarks3d.point_from_view)

    def complete(self, v: Array, V_y: Array, depth: bool) -> tuple[Array, Array, None]:
        """Return points (K, 3) for what a sensor found: points, or rays (K, 4) with their inverse distances."""
        if v.shape[1] == 3:
            return v, V_y, None
        p, P_v = landmarks3d.homogeneous_to_point(v)
        return p, P_v @ V_y, None

    def to_point(self, l: Array) -> tuple[Array, Array]:
        """Return the points themselves (K, 3) and the identity."""
        return np.array(l), np.tile(np.eye(3), (len(l), 1, 1))


@declared
class _Depth(_Landmark):
    """A point whose depth no measurement need determine: inverse distance rho, `prior_rho_per_m` +- `sigma_rho_per_m`.

    The prior is that of the first observation, by a sensor that measures a ray.
    """

    prior_rho_per_m: PriorDepth = 0.01
    sigma_rho_per_m: DepthSigma = 0.5

    point: ClassVar[Any]
    look_at_point: ClassVar[Any]  # what `look` is to a sensor that finds depth

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return l (K, n) on rays at inverse distances v (K, d + 1), L_T (K, n, 6 or 3), L_v (K, n, d + 1)."""
        l, L_T, L_ray, L_rho = self.of(T, np.ascontiguousarray(v[:, :-1]), v[:, -1].copy())
        return l, L_T, np.concatenate([L_ray, L_rho], axis=2)

    def complete(self, v: Array, V_y: Array, depth: bool) -> tuple[Array, Array, Array]:
        """Return rays with inverse distances (K, d + 1), V_y and the covariance of what was not measured."""
        d = 2 if self.space.world == "plane" else 3
        N = np.zeros((len(v), d + 1, d + 1))
        if v.shape[1] == d + 1:
            return v, V_y, N
        ray, rho = v, np.full(len(v), self.prior_rho_per_m)
        W_v = np.zeros((len(v), d + 1, d))
        W_v[:, :d] = np.eye(d)
        if depth:
            ray, W_v[:, :3] = unit_many(np.ascontiguousarray(v))
            rho = 1.0 / np.linalg.norm(v, axis=1)
            W_v[:, 3] = -ray * rho[:, None] ** 2
        else:
            N[:, d, d] = self.sigma_rho_per_m**2
        return np.column_stack([ray, rho]), W_v @ V_y, N

    def to_point(self, l: Array) -> tuple[Array, Array]:
        """Return the Euclidean points p (K, d) and P_l (K, d, n)."""
        return self.point(np.ascontiguousarray(l))

    place = to_point


class _BecomesPoint(_Depth):
    """A point of unknown depth that becomes a Euclidean one once that is as linear, by its compiled `index`."""

    index: ClassVar[Any]

    def linearity(self, T: Array, l: Array, sigmas: Array) -> Array:
        """Return the linearity indices (K,) of landmarks l (K, n) seen from T; `sigmas` (K, n)."""
        return self.index(T, l, sigmas[:, -1].copy())


@register("landmark", "inverse_depth")
class InverseDepth2D(_BecomesPoint):
    """A point of the plane by anchor, direction and inverse distance (4 numbers).

    The nearest landmark at d m is in the prior if prior_rho_per_m + 2 sigma_rho_per_m is 1 / d.  [S] 2.3.6, (48).  The
    default prior is [S] (47), rho in [0, 1 / d_min] with d_min = 1 m, as a Gaussian with both ends at two sigmas.

    >>> eye = km.Mount(km.sensors.Bearing(), landmark=km.landmarks.InverseDepth2D())
    >>> slam = km.Slam(km.Robot("rover", km.motion.Unicycle(), sensors={"eye": eye}))
    >>> report = slam.process(km.Scan(0.0, "rover", "eye", [[0.0]], ids=[7]))
    >>> place, P = slam.place(7)
    >>> place.round(1), np.sqrt(np.diag(P)).round(2)  # the depth is hardly known
    (array([2., 0.]), array([1.  , 0.04]))
    """

    prior_rho_per_m: PriorDepth = 0.5
    sigma_rho_per_m: DepthSigma = 0.25

    kind = "inverse_depth_2d"
    space = Space("inverse_depth_2d", (spaces.VECTOR, spaces.HEADING, spaces.RHO))
    look = staticmethod(landmarks2d.inverse_depth_seen_from)
    of = staticmethod(landmarks2d.inverse_depth_from_view)
    point = staticmethod(landmarks2d.inverse_depth_to_point)
    look_at_point = staticmethod(landmarks2d.inverse_depth_as_point)
    index = staticmethod(landmarks2d.inverse_depth_linearity)


@register("landmark", "inverse_depth")
class InverseDepth3D(_BecomesPoint):
    """A point of space by anchor, direction and inverse distance (6 numbers).

    [TB] idpPnt; Civera, Davison, Montiel 2008.

    >>> eye = km.Mount(km.sensors.PinHole(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))  # looks ahead
    >>> robot = km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye})
    >>> slam = km.Slam(robot, landmarks=km.landmarks.InverseDepth3D())
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[330.0, 240.0]], ids=[7]))
    >>> slam.landmark_model(7).kind, slam.mean(7).size
    ('inverse_depth', 6)
    """

    kind = "inverse_depth"
    space = Space("inverse_depth", (spaces.ANCHOR, spaces.DIRECTION, spaces.RHO))
    look = staticmethod(landmark_views.inverse_depth)
    of = staticmethod(landmarks3d.inverse_depth_from_view)
    point = staticmethod(landmarks3d.inverse_depth_to_point)
    look_at_point = staticmethod(landmarks3d.inverse_depth_as_point)
    index = staticmethod(landmarks3d.inverse_depth_linearity)


@register("landmark", "anchored_homogeneous")
class AnchoredHomogeneous(_BecomesPoint):
    """A point of space by anchor, ray and inverse distance (7 numbers).

    [TB] ahmPnt; Sola 2012.

    >>> eye = km.Mount(km.sensors.PinHole(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))  # looks ahead
    >>> robot = km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye})
    >>> slam = km.Slam(robot, landmarks=km.landmarks.AnchoredHomogeneous())
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[330.0, 240.0]], ids=[7]))
    >>> slam.landmark_model(7).kind, slam.mean(7).size
    ('anchored_homogeneous', 7)
    """

    kind = "anchored_homogeneous"
    space = Space("anchored_homogeneous", (spaces.ANCHOR, spaces.VECTOR3, spaces.RHO))
    look = staticmethod(landmark_views.anchored)
    of = staticmethod(landmarks3d.anchored_from_view)
    point = staticmethod(landmarks3d.anchored_to_point)
    look_at_point = staticmethod(landmarks3d.anchored_as_point)
    index = staticmethod(landmarks3d.anchored_linearity)


@register("landmark", "homogeneous")
class Homogeneous(_Depth):
    """A homogeneous point of space (4 numbers).

    (h, rho) is at h / rho.  [TB] hmgPnt.

    >>> eye = km.Mount(km.sensors.PinHole(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))  # looks ahead
    >>> robot = km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye})
    >>> slam = km.Slam(robot, landmarks=km.landmarks.Homogeneous())
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[330.0, 240.0]], ids=[7]))
    >>> slam.landmark_model(7).kind, slam.mean(7).size
    ('homogeneous', 4)
    """

    kind = "homogeneous"
    space = Space("homogeneous", (spaces.HOMOGENEOUS,))
    look = staticmethod(landmark_views.homogeneous)
    of = staticmethod(landmarks3d.homogeneous_from_view)
    point = staticmethod(landmarks3d.homogeneous_to_point)
    look_at_point = staticmethod(landmarks3d.homogeneous_as_point)


@dataclass(frozen=True)
class AsPoint:
    """A point of unknown depth for a sensor that measures depth: its Euclidean point.

    >>> eye = km.Mount(km.sensors.PixelDepth(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))
    >>> robot = km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye})
    >>> slam = km.Slam(robot, landmarks=km.landmarks.InverseDepth3D())
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[320.0, 240.0, 0.25]], ids=[7]))
    >>> slam.landmark_model(7).kind
    'inverse_depth'
    """

    ray: Any

    @property
    def kind(self) -> str:
        """That of the point of unknown depth."""
        return self.ray.kind

    @property
    def space(self) -> Space:
        """That of the point of unknown depth."""
        return self.ray.space

    @property
    def look(self) -> Any:
        """The compiled view of a built-in one."""
        return self.ray.look_at_point

    def seen_from(self, T: Array, l: Array) -> tuple[Array, Array, Array]:
        """Return the points v (K, d) in the frame T, V_T (K, d, 3 or 6), V_l (K, d, n)."""
        p, P_l = self.ray.to_point(l)
        v, V_T, V_p = (Point2D() if p.shape[1] == 2 else Point3D()).seen_from(T, p)
        return v, V_T, V_p @ P_l

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return what the point of unknown depth does."""
        return self.ray.from_view(T, v)


@register("landmark", "tag")
class Tag(_Landmark):
    """A square tag: its pose.

    l = (x, y, z, qx, qy, qz, qw), the tag in its plane z = 0.  Its size is part of the measurement.

    >>> eye = km.Mount(km.sensors.TagCorners(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye}))
    >>> y = [300.0, 260.0, 340.0, 260.0, 340.0, 220.0, 300.0, 220.0, 0.5]
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [y], ids=[7]))
    >>> slam.landmark_model(7).kind, slam.mean(7).size
    ('tag', 7)
    """

    kind = "tag"
    space = SE3
    look = staticmethod(tags.tag_seen_from)
    of = staticmethod(tags.tag_from_view)

    def to_point(self, l: Array) -> tuple[Array, Array]:
        """Return the centres (K, 3) and their Jacobian (K, 3, 6)."""
        return np.array(l[:, :3]), np.tile(np.eye(3, 6), (len(l), 1, 1))


@declared
class _Line(_Landmark):
    """Base of the lines: they start on the plane of two viewing rays, the rest is a prior (K, 2).

    With `extend`, the segment kept beside a line grows with what is seen of it; before, and without, it is what its
    first sight and the prior make it.  A segment whose ends are uncertain by more than `switch_px` follows the measured
    one instead (Pluecker kinds).  [TB] extPolicy, extSwitch.
    """

    extend: Annotated[bool, "The segment kept beside the line grows with what is seen of it."] = True
    switch_px: Annotated[
        NotNegative, "Pluecker kinds: a segment whose ends are less certain than this follows the measured one instead."
    ] = 10.0

    first_ends: ClassVar[tuple[float, float]]
    anchored: ClassVar[bool] = True  # the first three numbers are the anchor

    def complete(self, v: Array, V_y: Array, depth: bool) -> tuple[Array, Array, Array]:
        """Return both rays and the prior's mean (K, 8), V_y (K, 8, .) and the prior's covariance (K, 8, 8)."""
        mean, sigma = self._prior()
        W_y, N = np.zeros((len(v), 8, V_y.shape[2])), np.zeros((len(v), 8, 8))
        W_y[:, :6] = V_y
        N[:, 6, 6], N[:, 7, 7] = np.square(sigma)
        return np.column_stack([v, np.tile(mean, (len(v), 1))]), W_y, N

    def _prior(self) -> tuple[tuple[float, float], tuple[float, float]]:
        raise NotImplementedError

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return l (K, n) of rays and prior v (K, 8), L_T (K, n, 6), L_v (K, n, 8)."""
        l, L_T, L_rays, L_prior = self.of(T, np.ascontiguousarray(v[:, :6]), np.ascontiguousarray(v[:, 6:]))
        return l, L_T, np.concatenate([L_rays, L_prior], axis=2)

    def endpoints(self, l: Array, t: Array) -> tuple[Array, Array]:
        """Return the points (K, 2, 3) at abscissas t (K, 2), and P_l (K, 2, 3, n)."""
        raise NotImplementedError

    def abscissas(self, T: Array, l: Array, rays: Array) -> Array:
        """Return where (K, 2) on the lines two viewing rays (K, 6) from T pass nearest."""
        p, _ = self.endpoints(l, np.tile([0.0, 1.0], (len(l), 1)))
        return lines.abscissas(T, p, np.ascontiguousarray(rays))

    def place(self, l: Array) -> tuple[Array, Array]:
        """Return the points (K, 3) of the lines nearest to their anchors, or to the origin, and P_l (K, 3, n)."""
        p, P_l = self.endpoints(l, np.tile([0.0, 1.0], (len(l), 1)))
        a = l[:, :3] if self.anchored else np.zeros((len(l), 3))
        A_l = np.eye(3, P_l.shape[3]) * self.anchored
        d, D_l = p[:, 1] - p[:, 0], P_l[:, 1] - P_l[:, 0]
        w, W_l = p[:, 0] - a, P_l[:, 0] - A_l
        d2 = np.sum(d * d, axis=1)
        s = np.sum(w * d, axis=1) / d2  # p = a + w - s d
        S_l = np.einsum("ki,kij->kj", d, W_l) + np.einsum("ki,kij->kj", w - 2 * s[:, None] * d, D_l)
        S_l /= d2[:, None]
        return a + w - s[:, None] * d, P_l[:, 0] - s[:, None, None] * D_l - d[:, :, None] * S_l[:, None]


@declared
class _DirectionPrior(_Line):
    """Lines whose direction in the plane of sight is a prior, beta = (`prior_beta_1`, 0) +- sigmas.  [TB] plkLin."""

    prior_beta_1: Annotated[
        Number, "Direction expected in the plane of sight, which one image does not determine: first component."
    ] = 0.1
    prior_beta_2: Annotated[Number, "Second component."] = 0.0
    sigma_beta_1: Annotated[NotNegative, "Standard deviation of the first component."] = 0.25
    sigma_beta_2: Annotated[NotNegative, "Standard deviation of the second component."] = 1.0

    first_ends = lines.PLUECKER_ABSCISSAS_M
    ends: ClassVar[Any]

    def _prior(self) -> tuple[tuple[float, float], tuple[float, float]]:
        return (self.prior_beta_1, self.prior_beta_2), (self.sigma_beta_1, self.sigma_beta_2)

    def endpoints(self, l: Array, t: Array) -> tuple[Array, Array]:
        """Return the points (K, 2, 3) at abscissas t (K, 2), and P_l (K, 2, 3, n)."""
        return self.ends(np.ascontiguousarray(l), np.ascontiguousarray(t))


@declared
class _DepthsPrior(_Line):
    """Lines through two points of unknown depth, of the type `end`."""

    prior_rho_per_m: Annotated[Number, "Inverse distance expected of both ends."] = 0.1
    sigma_rho_per_m: Annotated[NotNegative, "Standard deviation of each."] = 0.5

    first_ends = lines.POINT_ABSCISSAS
    end: ClassVar[type[_Depth]]

    def _prior(self) -> tuple[tuple[float, float], tuple[float, float]]:
        return (self.prior_rho_per_m,) * 2, (self.sigma_rho_per_m,) * 2

    def of(self, T: Array, rays: Array, rho: Array) -> lines.New:
        """Return lines l (K, n) through the ends on `rays` (K, 6) of T at rho (K, 2), L_T, L_rays and L_rho."""
        a, b = (self.end.of(T, rays[:, 3 * i : 3 * i + 3].copy(), rho[:, i].copy()) for i in range(2))
        return lines.stacked_views(a, b, 3 * self.anchored)

    def endpoints(self, l: Array, t: Array) -> tuple[Array, Array]:
        """Return the points (K, 2, 3) at abscissas t (K, 2), and P_l (K, 2, 3, n)."""
        shared = 3 * self.anchored
        a, b = map(self.end.point, lines.end_states(np.ascontiguousarray(l), shared))
        return lines.points_between(a, b, np.ascontiguousarray(t), shared)


@register("landmark", "pluecker_line")
class PlueckerLine(_DirectionPrior):
    """A line by moment and direction (6 numbers).

    [TB] plkLin.

    >>> eye = km.Mount(km.sensors.Segments(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))
    >>> robot = km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye})
    >>> slam = km.Slam(robot, landmarks=km.landmarks.PlueckerLine())
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[100.0, 200.0, 500.0, 300.0]], ids=[7]))
    >>> slam.landmark_model(7).kind, slam.mean(7).size
    ('pluecker_line', 6)
    """

    kind = "pluecker_line"
    space = Space("pluecker_line", (spaces.PLUECKER,))
    look = staticmethod(lines.pluecker_seen_from)
    of = staticmethod(lines.pluecker_from_view)
    ends = staticmethod(lines.pluecker_endpoints)
    anchored = False


@register("landmark", "anchored_pluecker_line")
class AnchoredPlueckerLine(_DirectionPrior):
    """A line by anchor, moment about it and direction (9 numbers).

    [TB] aplLin.

    >>> eye = km.Mount(km.sensors.Segments(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))
    >>> robot = km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye})
    >>> slam = km.Slam(robot, landmarks=km.landmarks.AnchoredPlueckerLine())
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[100.0, 200.0, 500.0, 300.0]], ids=[7]))
    >>> slam.landmark_model(7).kind, slam.mean(7).size
    ('anchored_pluecker_line', 9)
    """

    kind = "anchored_pluecker_line"
    space = Space("anchored_pluecker_line", (spaces.VECTOR3, spaces.VECTOR3, spaces.VECTOR3))
    look = staticmethod(lines.anchored_pluecker_seen_from)
    of = staticmethod(lines.anchored_pluecker_from_view)
    ends = staticmethod(lines.anchored_pluecker_endpoints)


@register("landmark", "inverse_depth_line")
class InverseDepthLine(_DepthsPrior):
    """A line by anchor and azimuth, elevation and inverse distance of two points (9 numbers).

    [TB] idpLin.

    >>> eye = km.Mount(km.sensors.Segments(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))
    >>> robot = km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye})
    >>> slam = km.Slam(robot, landmarks=km.landmarks.InverseDepthLine())
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[100.0, 200.0, 500.0, 300.0]], ids=[7]))
    >>> slam.landmark_model(7).kind, slam.mean(7).size
    ('inverse_depth_line', 9)
    """

    kind = "inverse_depth_line"
    space = Space("inverse_depth_line", (spaces.ANCHOR, *2 * (spaces.DIRECTION, spaces.RHO)))
    look = staticmethod(lines.inverse_depth_line_seen_from)
    end = InverseDepth3D


@register("landmark", "anchored_homogeneous_line")
class AnchoredHomogeneousLine(_DepthsPrior):
    """A line by anchor and ray and inverse distance of two points (11 numbers).

    [TB] ahmLin.

    >>> eye = km.Mount(km.sensors.Segments(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))
    >>> robot = km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye})
    >>> slam = km.Slam(robot, landmarks=km.landmarks.AnchoredHomogeneousLine())
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[100.0, 200.0, 500.0, 300.0]], ids=[7]))
    >>> slam.landmark_model(7).kind, slam.mean(7).size
    ('anchored_homogeneous_line', 11)
    """

    kind = "anchored_homogeneous_line"
    space = Space("anchored_homogeneous_line", (spaces.ANCHOR, *2 * (spaces.VECTOR3, spaces.RHO)))
    look = staticmethod(lines.anchored_homogeneous_line_seen_from)
    end = AnchoredHomogeneous


@register("landmark", "homogeneous_line")
class HomogeneousLine(_DepthsPrior):
    """A line by two homogeneous points (8 numbers).

    [TB] hmgLin.

    >>> eye = km.Mount(km.sensors.Segments(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))
    >>> robot = km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye})
    >>> slam = km.Slam(robot, landmarks=km.landmarks.HomogeneousLine())
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[100.0, 200.0, 500.0, 300.0]], ids=[7]))
    >>> slam.landmark_model(7).kind, slam.mean(7).size
    ('homogeneous_line', 8)
    """

    kind = "homogeneous_line"
    space = Space("homogeneous_line", (spaces.HOMOGENEOUS, spaces.HOMOGENEOUS))
    look = staticmethod(lines.homogeneous_line_seen_from)
    end = Homogeneous
    anchored = False


BUILT_IN = built_in("landmark")
"""All kinds of landmarks of kalmark."""
LINES = tuple(kind for kind in BUILT_IN if issubclass(kind, _Line))
"""Those that are lines in space."""
