"""Cameras as sensors: they look along z, x right in the image, y down.  The lenses are in `cameras`."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, ClassVar, Literal

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.declare import NotNegative, Number, Positive, Within, declared, register
from kalmark.errors import EventError
from kalmark.geometry.frames3d import minus
from kalmark.models import cameras, landmark_views, lines, tags
from kalmark.models.landmark_views import Spatial, constant

__all__ = ["Omnidirectional", "PinHole", "PixelDepth", "Segments", "Stereo", "TagCorners"]

TELLING = 12.0  # least difference of the chi-squares of a tag's two poses for the first to be accepted
BORDER = 0.2  # of an image, in which the middle ends
FISHEYE = (400.0, -254.647909)  # 400 px at 90 degrees from the axis, in proportion to the angle
FISHEYE_BACK = (
    254.647909, 0.0, -0.00130899694, 0.0, -1.34575854e-09, 0.0, -1.97650363e-15, 0.0, -3.04801702e-21, 0.0,
    -4.74790438e-27, 0.0, -7.41305337e-33, 0.0, -1.15807555e-38, 0.0, -1.80940987e-44, 0.0, -2.82717051e-50,
)  # fmt: skip

PixelNoise = Annotated[Positive, "Noise of each pixel coordinate."]
ImageWidth = Annotated[Positive, "Width of the image."]
ImageHeight = Annotated[Positive, "Height of the image."]
Numbers = Annotated[tuple[float, ...], Within()]


class _Camera(Spatial):
    """Cameras: an image, a lens, the points in view."""

    columns: ClassVar[tuple[str, ...]] = ("u_px", "v_px")
    sigmas: ClassVar[tuple[str, ...]] = ("sigma_px",) * 2
    expected = landmark_views.camera
    sees_kinds: ClassVar[tuple[str, ...]] = ("point3", "inverse_depth", "anchored_homogeneous", "homogeneous")
    finds_depth = False

    width_px: float
    height_px: float

    @property
    def image(self) -> tuple[float, float]:
        """Width and height of the image, px."""
        return self.width_px, self.height_px

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, 3 or 4) appear in the image, borders included."""
        rays = np.ascontiguousarray(v[:, :3], dtype=np.float64)
        return cameras.is_in_view(self.code, rays, np.array(self.parameters), np.array(self.image, dtype=np.float64))

    def why_unseen(self, v: Array) -> str:
        """Return why what is at v (3 or 4,), out of view, does not appear in the image."""
        return "it is behind the camera" if v[2] <= 0 else "it is outside the image"

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the viewing rays (K, 3), unit vectors, of pixels y (K, 2), and their Jacobian (K, 3, 2)."""
        return cameras.back_project(self.code, np.ascontiguousarray(y), np.array(self.parameters))

    def rays(self, y: Array) -> Array:
        """Return the viewing rays (K, 3), unit vectors, of pixels y (K, 2)."""
        return _Camera.invert(self, y)[0]


@declared
class _PinHole(_Camera):
    """The intrinsics of a pin-hole camera."""

    fx_px: Annotated[Positive, "Focal length, across."] = 320.0
    fy_px: Annotated[Positive, "Focal length, down."] = 320.0
    cx_px: Annotated[Number, "Principal point, from the left."] = 320.0
    cy_px: Annotated[Number, "Principal point, from above."] = 240.0
    width_px: ImageWidth = 640
    height_px: ImageHeight = 480

    @cached_property
    def intrinsics(self) -> Array:
        """The focal lengths and the principal point (4,), px."""
        return np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px], dtype=np.float64)

    @property
    def parameters(self) -> Array:
        """The numbers (4,) of the compiled expectation: the intrinsics."""
        return self.intrinsics


@declared
class _Lens(_PinHole):
    """A pin-hole camera with a lens.

    `lens`: "radial" (coefficients of r^2, r^4, ...), "radtan" (k1, k2, p1, p2, k3), "equidistant" (k1 to k4, fish-eye),
    "tsai" (coefficients of r_d^2, r_d^4, ... that take the distortion off), "davison" (k), "fov" (w).
    """

    lens: Annotated[
        Literal["radial", "radtan", "equidistant", "tsai", "davison", "fov"],
        "Model of `distortion`: `radial` d1 r^2 + d2 r^4 + ..., `radtan` k1 k2 p1 p2 k3, `equidistant` k1 to k4,"
        " `tsai` c1 r_d^2 + c2 r_d^4 + ... to undistort, `davison` k of r_d = r / sqrt(1 + 2 k r^2), `fov` w in rad.",
    ] = "radial"
    distortion: Annotated[Numbers, "Coefficients of the lens; none for an ideal one."] = ()
    sigma_px: PixelNoise = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", tuple(float(d) for d in self.distortion))
        self.parameters  # noqa: B018 - a lens that folds the image over is refused here

    @property
    def code(self) -> int:
        """The code of the lens."""
        return cameras.LENSES[self.lens]

    @cached_property
    def parameters(self) -> Array:
        """The numbers (n,) of the lens as `cameras.project` takes them."""
        return cameras.lens_parameters(self.lens, self.intrinsics, self.distortion, size=self.image)


@register("sensor", "pinhole")
class PinHole(_Lens):
    """A camera that measures points: pixels u, v.

    [TB] pinHole.  `calibration` names a file of OpenCV, Kalibr, ROS or EuRoC instead: docs/cameras.md.

    >>> eye = km.Mount(km.sensors.PinHole(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))  # looks ahead
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye}))
    >>> slam.add_landmark(7, mean=(4.0, 0.0, 0.0), cov=0.01 * np.eye(3))
    >>> slam.expect("drone", "eye").e.round(1)
    array([[320., 240.]])
    """


@register("sensor", "pixel_depth")
class PixelDepth(_Lens):
    """A camera that measures the depth of its pixels along its axis (RGB-D): u, v and the inverse depth.

    Structured light and stereo measure a disparity, proportional to 1 / z: its noise is the same at any depth, that of
    the depth is sigma_rho z^2.  Khoshelham and Elberink 2012 (Kinect): 1.4e-3 / m.

    >>> eye = km.Mount(km.sensors.PixelDepth(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))  # looks ahead
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye}))
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[320.0, 240.0, 0.25]], ids=[7]))
    >>> slam.mean(7).round(2)
    array([4., 0., 0.])
    """

    sigma_rho_per_m: Annotated[Positive, "Noise of the inverse depth: that of a depth z is sigma_rho z^2."] = 0.003

    expected = landmark_views.pixel_depth
    columns = ("u_px", "v_px", "rho_per_m")
    sigmas = ("sigma_px", "sigma_px", "sigma_rho_per_m")
    finds_depth = True

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return unit rays with their inverse distances (K, 4) of y (K, 3), and their Jacobian (K, 4, 3)."""
        m, M_y = super().invert(np.array(y[:, :2]))
        V_y = np.zeros((len(y), 4, 3))
        V_y[:, :3, :2], V_y[:, 3, :2], V_y[:, 3, 2] = M_y, M_y[:, 2] * y[:, 2:], m[:, 2]
        return np.column_stack([m, m[:, 2] * y[:, 2]]), V_y

    def check(self, y: Array) -> None:
        """Refuse observations y (K, 3) behind the camera."""
        for i, row in enumerate(y):
            if row[2] < 0:
                raise EventError(f"observation {i}: rho_per_m is {row[2]}, expected at least 0")


@register("sensor", "omnidirectional")
class Omnidirectional(_Camera):
    """Scaramuzza's camera with a wide view that measures points: pixels u, v.

    `kalmark.models.cameras` explains the polynomials.  [TB] omniCam.

    >>> eye = km.Mount(km.sensors.Omnidirectional(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))  # looks ahead
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye}))
    >>> slam.add_landmark(7, mean=(4.0, 1.0, 0.5), cov=0.01 * np.eye(3))
    >>> slam.expect("drone", "eye").e.round(1)
    array([[577.9, 369. ]])
    """

    cx_px: Annotated[Number, "Centre of the image, from the left."] = 640.0
    cy_px: Annotated[Number, "Centre of the image, from above."] = 400.0
    c: Annotated[Number, "Affine correction [c d; e 1] of the image."] = 1.0
    d: Annotated[Number, "Affine correction."] = 0.0
    e: Annotated[Number, "Affine correction."] = 0.0
    projection: Annotated[
        Numbers, "Polynomial from the ray's elevation to the distance from the centre, lowest power first."
    ] = FISHEYE
    back_projection: Annotated[
        Numbers, "Polynomial from the distance from the centre to the ray's height, lowest power first."
    ] = FISHEYE_BACK
    width_px: ImageWidth = 1280
    height_px: ImageHeight = 800
    sigma_px: PixelNoise = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "projection", tuple(float(a) for a in self.projection))
        object.__setattr__(self, "back_projection", tuple(float(a) for a in self.back_projection))

    @property
    def code(self) -> int:
        """The code of the lens."""
        return cameras.OMNI

    @cached_property
    def parameters(self) -> Array:
        """The numbers (n,) of the lens as `cameras.project` takes them."""
        k = (self.cx_px, self.cy_px, self.c, self.d, self.e)
        return cameras.lens_parameters("omnidirectional", k, self.projection, self.back_projection)


@register("sensor", "stereo")
class Stereo(_PinHole):
    """A rectified pair of cameras that measures points: u, v in the left image and u, v in the right one.

    >>> eye = km.Mount(km.sensors.Stereo(baseline_m=0.2), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))  # looks ahead
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye}))
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[320.0, 240.0, 304.0, 240.0]], ids=[7]))
    >>> slam.mean(7).round(2)  # f baseline / disparity = 4 m
    array([4., 0., 0.])
    """

    baseline_m: Annotated[Positive, "Distance of the right camera from the left one, whose frame is the sensor's."] = (
        0.2
    )
    sigma_ul_px: Annotated[Positive, "Noise of the left u."] = 1.0
    sigma_vl_px: Annotated[Positive, "Noise of the left v."] = 1.0
    sigma_ur_px: Annotated[Positive, "Noise of the right u."] = 1.0
    sigma_vr_px: Annotated[Positive, "Noise of the right v."] = 1.0

    expected = landmark_views.stereo
    of_pair: ClassVar[bool] = True
    columns = ("ul_px", "vl_px", "ur_px", "vr_px")
    sigmas = ("sigma_ul_px", "sigma_vl_px", "sigma_ur_px", "sigma_vr_px")
    finds_depth = True

    @cached_property
    def parameters(self) -> Array:
        """The intrinsics and the baseline (5,)."""
        return np.append(self.intrinsics, self.baseline_m)

    def rays(self, y: Array) -> Array:
        """Return the viewing rays (K, 3), unit vectors, of pixels y (K, 2) of the left image."""
        return cameras.back_project_pinhole(np.ascontiguousarray(y), self.intrinsics, np.zeros(0))[0]

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return unit rays with their inverse distances (K, 4), and their Jacobian (K, 4, 4)."""
        return cameras.back_project_stereo(np.ascontiguousarray(y), self.intrinsics, self.baseline_m)

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, 3 or 4) appear in both images, borders included."""
        e, _ = self.expect(v)
        return cameras.in_image(e, v, self.image)

    def check(self, y: Array) -> None:
        """Refuse observations y (K, 4) of points behind the cameras, with a negative disparity."""
        for i, row in enumerate(y):
            if row[0] < row[2]:
                what = f"ul_px {row[0]:g} - ur_px {row[2]:g} is a disparity of {row[0] - row[2]:g} px"
                raise EventError(f"observation {i}: {what}, expected 0 or more: are left and right exchanged?")


@register("sensor", "segments")
class Segments(_PinHole):
    """A camera that measures line segments: pixels of both ends, which lie anywhere on the line.

    So only the distances of the measured ends from the expected line count.  [TB] Fig. 9: the innovation is two
    distances, `ortDst`.

    >>> eye = km.Mount(km.sensors.Segments(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))  # looks ahead
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye}))
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[100.0, 200.0, 500.0, 300.0]], ids=[7]))
    >>> slam.landmark_model(7).kind
    'anchored_homogeneous_line'
    """

    sigma_px: Annotated[Positive, "Noise of each pixel coordinate of an end."] = 1.0
    min_length_px: Annotated[NotNegative, "Shortest segment that counts as seen."] = 20.0

    expected = landmark_views.segment
    columns = ("u1_px", "v1_px", "u2_px", "v2_px")
    sees_kinds = (
        "pluecker_line", "anchored_pluecker_line", "inverse_depth_line", "anchored_homogeneous_line",
        "homogeneous_line",
    )  # fmt: skip

    def noise_from(self, y: Array, cov: Array) -> Array:
        """Return the noise (K, 2, 2) of the two distances, of pixels' covariances (K, 4, 4)."""
        return lines.segment_noise(np.ascontiguousarray(y), np.ascontiguousarray(cov))

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the viewing rays (K, 6) of both ends, and V_y (K, 6, 4)."""
        none, both = np.zeros(0), np.zeros((len(y), 6, 4))
        ends = (np.ascontiguousarray(y[:, i : i + 2]) for i in (0, 2))
        (a, A_y), (b, B_y) = (cameras.back_project_pinhole(end, self.intrinsics, none) for end in ends)
        both[:, :3, :2], both[:, 3:, 2:] = A_y, B_y
        return np.column_stack([a, b]), both

    def rays(self, y: Array) -> Array:
        """Return the viewing rays (K, 3), unit vectors, of pixels y (K, 2)."""
        return cameras.back_project_pinhole(np.ascontiguousarray(y), self.intrinsics, np.zeros(0))[0]

    def sees_segments(self, T: Array, p1: Array, p2: Array) -> tuple[Flags, Array]:
        """Return which segments from p1 to p2 (K, 3) of the world are seen from T, and their pixels in the image."""
        size = np.array(self.image, dtype=np.float64)
        a, b = np.ascontiguousarray(p1), np.ascontiguousarray(p2)
        return lines.visible_segment(T, a, b, self.intrinsics, size, self.min_length_px)

    def sample_segments(self, rng: np.random.Generator, count: int) -> Array:
        """Return segments (count, 4) in the middle of the image."""
        return rng.uniform(BORDER, 1.0 - BORDER, (count, 4)) * [*self.image, *self.image]

    def start_noise(self, y: Array) -> Array:
        """Return the noise (K, 4, 4) of the pixels themselves, which starts a line."""
        return constant((self.sigma_px**2,) * 4, len(y)).copy()

    def check(self, y: Array) -> None:
        """Refuse segments y (K, 4) whose ends coincide."""
        for i, row in enumerate(y):
            if row[0] == row[2] and row[1] == row[3]:
                raise EventError(f"observation {i}: both ends are at {row[:2].tolist()} px, expected a segment")


@register("sensor", "tag_corners")
class TagCorners(_Lens):
    """A camera that measures square tags of known size: pixels of their four corners.

    Corners in the tag's frame: (-s, -s), (s, -s), (s, s), (-s, s), s half the size.

    >>> eye = km.Mount(km.sensors.TagCorners(), at=(0, 0, 0, -0.5, 0.5, -0.5, 0.5))  # looks ahead
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye}))
    >>> corners = [300.0, 260.0, 340.0, 260.0, 340.0, 220.0, 300.0, 220.0]
    >>> report = slam.process(km.Scan(0.0, "drone", "eye", [[*corners, 0.5]], ids=[7]))
    >>> slam.mean(7)[:3].round(2)  # f size / 40 px = 4 m
    array([4., 0., 0.])
    """

    expected = landmark_views.tag_corners
    cov_size = 8
    sigmas = ("sigma_px",) * 8
    columns = (
        "u1_px", "v1_px", "u2_px", "v2_px", "u3_px", "v3_px", "u4_px", "v4_px", "size_m",
    )  # fmt: skip
    sees_kinds = ("tag",)
    finds_depth = True

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return the tags' poses (K, 7) in the camera, and V_y (K, 6, 8).

        NaN where no pose explains the corners, and where two do: the planar pose ambiguity of a small tag.
        """
        v, V_y, chi2 = self.both(y)
        v[~(chi2[:, 1] - chi2[:, 0] >= TELLING)] = np.nan
        return np.ascontiguousarray(v[:, 0]), V_y[:, 0]

    def both(self, y: Array) -> tuple[Array, Array, Array]:
        """Return the two poses (K, 2, 7) that fit y, the better first, V_y (K, 2, 6, 8), chi-squares (K, 2).

        The second chi-square is infinite where the covariance of the first pose includes the second: within one sigma,
        as of a tag that faces the camera.
        """
        corners, sizes = np.ascontiguousarray(y[:, :8]), np.ascontiguousarray(y[:, 8])
        par = np.array(self.parameters)
        rays = cameras.back_project(self.code, corners.reshape(-1, 2), par)[0].reshape(-1, 4, 3)
        v, V_y, cost = tags.tags_from_corners(self.code, corners, rays, sizes, par)
        chi2 = cost / self.sigma_px**2
        for k in np.flatnonzero(np.isfinite(cost).all(axis=1)):
            apart, V = minus(v[k, 1], v[k, 0]), self.sigma_px * V_y[k, 0]
            if apart @ np.linalg.solve(V @ V.T, apart) <= 1.0:
                chi2[k, 1] = np.inf
        return v, V_y, chi2

    def is_far(self, y: Array, z: Array) -> Flags:
        """Return which tags y (K, 9) have innovations z (K, 8) of half their size or more, or not finite."""
        sides = np.diff(y[:, [0, 1, 2, 3, 4, 5, 6, 7, 0, 1]].reshape(-1, 5, 2), axis=1)
        size = np.linalg.norm(sides, axis=2).mean(axis=1)
        near: Flags = np.sqrt(np.sum(z**2, axis=1) / 4) < 0.5 * size
        return ~near

    def poses(self, y: Array, R: Array) -> tuple[Array, Array]:
        """Return y (K, 9) with noise R (K, 8, 8) as poses (K, 7) with covariances (K, 6, 6); NaN where `invert` is."""
        v, V_y = self.invert(y)
        return v, V_y @ R @ V_y.swapaxes(1, 2)

    def check(self, y: Array) -> None:
        """Refuse tags y (K, 9) without a size."""
        for i, size in enumerate(y[:, 8].tolist()):
            if size <= 0:
                raise EventError(f"observation {i}: size_m is {size}, expected a positive length")
