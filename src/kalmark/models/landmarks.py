"""Landmarks, and how they look from a pose: Euclidean and polar points, points of unknown depth, tags, lines.

A landmark of a kind that has a prior can be started by a sensor that does not see all of it: the prior says what is
expected of the rest.  How they look from a sensor is in `landmarks2d`, `landmarks3d`, `lines` and `tags`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from kalmark.geometry.directions import unit_many
from kalmark.geometry.spaces import (
    ANCHOR,
    DIRECTION,
    HEADING,
    HOMOGENEOUS,
    PLUECKER,
    POINT2,
    POINT3,
    RHO,
    SCALAR,
    SE3,
    VECTOR,
    VECTOR3,
    Space,
)
from kalmark.models import landmarks2d, landmarks3d, lines, seen, segments, tags
from kalmark.models.parameters import check_parameters

Array = npt.NDArray[np.float64]

TINY_M = 1e-12


@dataclass(frozen=True)
class Point2D:
    """A point (x, y) in metres."""

    kind: ClassVar[str] = "point"
    space: ClassVar[Space] = POINT2
    look: ClassVar[Any] = staticmethod(landmarks2d.point_seen_from)

    def seen_from(self, T: Array, l: Array) -> tuple[Array, Array, Array]:
        """Return v (K, d), V_T (K, d, 3), V_l (K, d, d)."""
        return landmarks2d.point_seen_from(T, np.ascontiguousarray(l))

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return l (K, d), L_T (K, d, 3), L_v (K, d, d)."""
        return landmarks2d.point_from_view(T, np.ascontiguousarray(v))


@dataclass(frozen=True)
class PointSignature2D(Point2D):
    """A point with a signature, (x, y, s): [T]'s landmark, d = 3N + 3."""

    kind: ClassVar[str] = "point_signature"
    space: ClassVar[Space] = Space("point_signature", (VECTOR, SCALAR))


@dataclass(frozen=True)
class Polar2D:
    """Anchor, direction alpha and distance (4), for ranges with poor bearings: an arc of errors.  [S] 2.3.5."""

    kind: ClassVar[str] = "polar"
    space: ClassVar[Space] = Space("polar", (VECTOR, HEADING, SCALAR))
    look: ClassVar[Any] = staticmethod(landmarks2d.polar_seen_from)

    def seen_from(self, T: Array, l: Array) -> tuple[Array, Array, Array]:
        """Return v (K, 2), V_T (K, 2, 3), V_l (K, 2, 4)."""
        return landmarks2d.polar_seen_from(T, np.ascontiguousarray(l))

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return l (K, 4), L_T (K, 4, 3), L_v (K, 4, 2)."""
        return landmarks2d.polar_from_view(T, np.ascontiguousarray(v))

    def to_point(self, l: Array) -> tuple[Array, Array]:
        """Return the Euclidean points p (K, 2) and P_l (K, 2, 4)."""
        return landmarks2d.polar_to_point(np.ascontiguousarray(l))

    def linearity(self, T: Array, l: Array, sigmas: Array) -> Array:
        """Return how far the arc of a sigma leaves its tangent, in sigmas of the distance (K,); `sigmas` (K, 4)."""
        return np.asarray(0.5 * l[:, 3] * sigmas[:, 2] ** 2 / np.maximum(sigmas[:, 3], TINY_M))


class _Spatial:
    """What the landmarks of space share: the compiled view `look`, of the form `seen.LOOK`."""

    look: ClassVar[Any]

    def seen_from(self, T: Array, l: Array) -> tuple[Array, Array, Array]:
        """Return the view v (K, d), V_T (K, ., 6), V_l (K, ., n), in error coordinates."""
        return self.look(T, np.ascontiguousarray(l))


@dataclass(frozen=True)
class Point3D(_Spatial):
    """A point (x, y, z) in metres."""

    kind: ClassVar[str] = "point3"
    space: ClassVar[Space] = POINT3
    look: ClassVar[Any] = staticmethod(landmarks3d.point_seen_from)

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return l (K, 3), L_T (K, 3, 6), L_v (K, 3, 3)."""
        return landmarks3d.point_from_view(T, np.ascontiguousarray(v))

    def complete(self, v: Array, V_y: Array, depth: bool) -> tuple[Array, Array, None]:
        """Return points (K, 3) for what a sensor found: points, or rays (K, 4) with their inverse distances."""
        if v.shape[1] == 3:
            return v, V_y, None
        p, P_v = landmarks3d.homogeneous_to_point(v)
        return p, P_v @ V_y, None

    def to_point(self, l: Array) -> tuple[Array, Array]:
        """Return the points themselves (K, 3) and the identity."""
        return np.array(l), np.tile(np.eye(3), (len(l), 1, 1))


class _Prior:
    """What the kinds with a prior share."""

    def __post_init__(self) -> None:
        check_parameters(self)


@dataclass(frozen=True)
class _Depth(_Prior, _Spatial):
    """A point whose depth no measurement need tell: inverse distance rho, `prior_rho_per_m` +- `sigma_rho_per_m`.

    The prior is that of the first sight, by a sensor that sees a ray.
    """

    prior_rho_per_m: float = 0.01
    sigma_rho_per_m: float = 0.5

    space: ClassVar[Space]
    _from_view: ClassVar[Any]
    _to_point: ClassVar[Any]

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return l (K, n) on rays at inverse distances v (K, d + 1), L_T (K, n, 6 or 3), L_v (K, n, d + 1)."""
        l, L_T, L_ray, L_rho = type(self)._from_view(T, np.ascontiguousarray(v[:, :-1]), v[:, -1].copy())
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
        p, P_l = type(self)._to_point(np.ascontiguousarray(l))
        return p, P_l


@dataclass(frozen=True)
class InverseDepth2D(_Depth):
    """Anchor, direction alpha and inverse depth rho (4), for sensors of bearings.  [S] 2.3.6, (48).

    The default prior is [S] (47), rho in [0, 1 / d_min] with d_min = 1 m, as a Gaussian with both ends at two sigmas.
    """

    prior_rho_per_m: float = 0.5
    sigma_rho_per_m: float = 0.25

    kind: ClassVar[str] = "inverse_depth_2d"
    space: ClassVar[Space] = Space("inverse_depth_2d", (VECTOR, HEADING, RHO))
    look: ClassVar[Any] = staticmethod(landmarks2d.inverse_depth_seen_from)
    _from_view = landmarks2d.inverse_depth_from_view
    _to_point = landmarks2d.inverse_depth_to_point

    def linearity(self, T: Array, l: Array, sigmas: Array) -> Array:
        """Return the linearity indices (K,) seen from T; `sigmas` (K, n)."""
        return landmarks2d.inverse_depth_linearity(T, l, sigmas[:, -1].copy())


@dataclass(frozen=True)
class InverseDepth3D(_Depth):
    """Anchor, azimuth and elevation of the ray, inverse depth (6).  [TB] idpPnt; Civera, Davison, Montiel 2008."""

    kind: ClassVar[str] = "inverse_depth"
    space: ClassVar[Space] = Space("inverse_depth", (ANCHOR, DIRECTION, RHO))
    look: ClassVar[Any] = staticmethod(seen.inverse_depth)
    _from_view = landmarks3d.inverse_depth_from_view
    _to_point = landmarks3d.inverse_depth_to_point

    def linearity(self, T: Array, l: Array, sigmas: Array) -> Array:
        """Return the linearity indices (K,) seen from T; `sigmas` (K, n)."""
        return landmarks3d.inverse_depth_linearity(T, l, sigmas[:, -1].copy())


@dataclass(frozen=True)
class AnchoredHomogeneous(_Depth):
    """Anchor, ray and inverse depth (7).  [TB] ahmPnt; Sola 2012."""

    kind: ClassVar[str] = "anchored_homogeneous"
    space: ClassVar[Space] = Space("anchored_homogeneous", (ANCHOR, VECTOR3, RHO))
    look: ClassVar[Any] = staticmethod(seen.anchored)
    _from_view = landmarks3d.anchored_from_view
    _to_point = landmarks3d.anchored_to_point

    def linearity(self, T: Array, l: Array, sigmas: Array) -> Array:
        """Return the linearity indices (K,) seen from T; `sigmas` (K, n)."""
        return landmarks3d.anchored_linearity(T, l, sigmas[:, -1].copy())


@dataclass(frozen=True)
class Homogeneous(_Depth):
    """The homogeneous point (h, rho), at h / rho (4).  [TB] hmgPnt."""

    kind: ClassVar[str] = "homogeneous"
    space: ClassVar[Space] = Space("homogeneous", (HOMOGENEOUS,))
    look: ClassVar[Any] = staticmethod(seen.homogeneous)
    _from_view = landmarks3d.homogeneous_from_view
    _to_point = landmarks3d.homogeneous_to_point


@dataclass(frozen=True)
class Tag(_Spatial):
    """A square tag: its pose (x, y, z, qx, qy, qz, qw), the tag in its plane z = 0.  Its size is the scan's to tell."""

    kind: ClassVar[str] = "tag"
    space: ClassVar[Space] = SE3
    look: ClassVar[Any] = staticmethod(tags.tag_seen_from)

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return poses l (K, 7), L_T (K, 6, 6), L_v (K, 6, 6)."""
        return tags.tag_from_view(T, np.ascontiguousarray(v))

    def to_point(self, l: Array) -> tuple[Array, Array]:
        """Return the centres (K, 3) and their Jacobian (K, 3, 6)."""
        return np.array(l[:, :3]), np.tile(np.eye(3, 6), (len(l), 1, 1))


@dataclass(frozen=True)
class _Line(_Prior, _Spatial):
    """What the lines share: they start on the plane of two viewing rays, the rest is a prior (K, 2).

    With `extend`, the segment kept beside a line grows with what is seen of it; before, and without, it is what its
    first sight and the prior make it.  A segment whose ends are uncertain by more than `switch_px` follows the measured
    one instead (Pluecker kinds).  [TB] extPolicy, extSwitch.
    """

    extend: bool = True
    switch_px: float = 10.0

    name: ClassVar[str]
    first_ends: ClassVar[tuple[float, float]]

    def complete(self, v: Array, V_y: Array, depth: bool) -> tuple[Array, Array, Array]:
        """Return both rays and the prior's mean (K, 8), V_y (K, 8, .) and the prior's covariance (K, 8, 8)."""
        k = len(v)
        mean, sigma = self._prior()
        W_y, N = np.zeros((k, 8, V_y.shape[2])), np.zeros((k, 8, 8))
        W_y[:, :6] = V_y
        N[:, 6, 6], N[:, 7, 7] = np.square(sigma)
        return np.column_stack([v, np.tile(mean, (k, 1))]), W_y, N

    def _prior(self) -> tuple[tuple[float, float], tuple[float, float]]:
        raise NotImplementedError

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return l (K, n) of rays and prior v (K, 8), L_T (K, n, 6), L_v (K, n, 8)."""
        run = getattr(lines, f"{self.name}_from_view")
        l, L_T, L_rays, L_prior = run(T, np.ascontiguousarray(v[:, :6]), np.ascontiguousarray(v[:, 6:]))
        return l, L_T, np.concatenate([L_rays, L_prior], axis=2)

    def endpoints(self, l: Array, t: Array) -> tuple[Array, Array]:
        """Return the points (K, 2, 3) at abscissas t (K, 2), and P_l (K, 2, 3, n)."""
        p, P_l = getattr(segments, f"{self.name}_endpoints")(np.ascontiguousarray(l), np.ascontiguousarray(t))
        return p, P_l

    def abscissas(self, T: Array, l: Array, rays: Array) -> Array:
        """Return where (K, 2) on the lines two viewing rays (K, 6) from T pass nearest."""
        t: Array = getattr(segments, f"{self.name}_abscissas")(T, np.ascontiguousarray(l), np.ascontiguousarray(rays))
        return t


@dataclass(frozen=True)
class _DirectionPrior(_Line):
    """Lines whose direction in the plane of sight is a prior, beta = (`prior_beta_1`, 0) +- sigmas.  [TB] plkLin."""

    prior_beta_1: float = 0.1
    prior_beta_2: float = 0.0
    sigma_beta_1: float = 0.25
    sigma_beta_2: float = 1.0

    first_ends: ClassVar[tuple[float, float]] = segments.PLUECKER_ABSCISSAS_M

    def _prior(self) -> tuple[tuple[float, float], tuple[float, float]]:
        return (self.prior_beta_1, self.prior_beta_2), (self.sigma_beta_1, self.sigma_beta_2)


@dataclass(frozen=True)
class _DepthsPrior(_Line):
    """Lines through two points of unknown depth."""

    prior_rho_per_m: float = 0.1
    sigma_rho_per_m: float = 0.5

    first_ends: ClassVar[tuple[float, float]] = segments.POINT_ABSCISSAS

    def _prior(self) -> tuple[tuple[float, float], tuple[float, float]]:
        return (self.prior_rho_per_m,) * 2, (self.sigma_rho_per_m,) * 2


@dataclass(frozen=True)
class PlueckerLine(_DirectionPrior):
    """Moment and direction (n, v), 6.  [TB] plkLin."""

    kind: ClassVar[str] = "pluecker_line"
    space: ClassVar[Space] = Space("pluecker_line", (PLUECKER,))
    look: ClassVar[Any] = staticmethod(lines.pluecker_seen_from)
    name: ClassVar[str] = "pluecker"


@dataclass(frozen=True)
class AnchoredPlueckerLine(_DirectionPrior):
    """Anchor, moment about it and direction (9).  [TB] aplLin."""

    kind: ClassVar[str] = "anchored_pluecker_line"
    space: ClassVar[Space] = Space("anchored_pluecker_line", (VECTOR3, VECTOR3, VECTOR3))
    look: ClassVar[Any] = staticmethod(lines.anchored_pluecker_seen_from)
    name: ClassVar[str] = "anchored_pluecker"


@dataclass(frozen=True)
class InverseDepthLine(_DepthsPrior):
    """Anchor and two inverse-depth rays (9).  [TB] idpLin."""

    kind: ClassVar[str] = "inverse_depth_line"
    space: ClassVar[Space] = Space("inverse_depth_line", (ANCHOR, DIRECTION, RHO, DIRECTION, RHO))
    look: ClassVar[Any] = staticmethod(lines.inverse_depth_line_seen_from)
    name: ClassVar[str] = "inverse_depth_line"


@dataclass(frozen=True)
class AnchoredHomogeneousLine(_DepthsPrior):
    """Anchor and two rays with inverse depths (11).  [TB] ahmLin."""

    kind: ClassVar[str] = "anchored_homogeneous_line"
    space: ClassVar[Space] = Space("anchored_homogeneous_line", (ANCHOR, VECTOR3, RHO, VECTOR3, RHO))
    look: ClassVar[Any] = staticmethod(lines.anchored_homogeneous_line_seen_from)
    name: ClassVar[str] = "anchored_homogeneous_line"


@dataclass(frozen=True)
class HomogeneousLine(_DepthsPrior):
    """Two homogeneous points (8).  [TB] hmgLin."""

    kind: ClassVar[str] = "homogeneous_line"
    space: ClassVar[Space] = Space("homogeneous_line", (HOMOGENEOUS, HOMOGENEOUS))
    look: ClassVar[Any] = staticmethod(lines.homogeneous_line_seen_from)
    name: ClassVar[str] = "homogeneous_line"


POINTS = (Point3D, InverseDepth3D, AnchoredHomogeneous, Homogeneous)
LINES = (PlueckerLine, AnchoredPlueckerLine, InverseDepthLine, AnchoredHomogeneousLine, HomogeneousLine)
BUILT_IN = (Point2D, PointSignature2D, Polar2D, InverseDepth2D, *POINTS, Tag, *LINES)
