"""The plane about a landmark, by which its patch is warped.  Molton, Davison and Reid 2004.

A patch is seldom on a plane that faces the camera.  If its content is beside its centre, the content then moves against
the centre as the camera moves round, as if the landmark moved, in each frame.  So the plane is estimated,

    N.(X - p) = 0,  N = m + B s,

m the direction in which p was first seen, B (3, 2) across it, s (2,) the slopes.  Where the patch appears at x from p,
slopes changed by ds move it by x_s ds.  The image of a match about its pixel is I(x) = g T(x) + o - T_x (x_s ds + t):
least squares over template and image give ds, beside gain g, offset o and shift t, all frames together those of most
parallax.  A depth image shows the plane at once: 1 / z = N.v of the rays v with z = 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.geometry.rotations import matrix
from kalmark.vision.depth_images import EDGE
from kalmark.vision.template_matching import LEAST_GAIN, fit_template

SIGMA_SLOPE = 1.0  # of the prior: 45 deg
STEEPEST = 2.0  # 63 deg
REPEATED = 10.0  # frames whose errors of interpolation are the same: what each one of them adds is so much less
LEAST_VARIANCE = 4.0  # of grey values about a template


@dataclass
class Plane:
    """A plane by the direction m (3,) it was first seen in, slopes (2,) and their information (2, 2)."""

    m: Array
    slopes: Array = field(default_factory=lambda: np.zeros(2))
    information: Array = field(default_factory=lambda: np.eye(2) / SIGMA_SLOPE**2)
    across: Array = field(init=False)  # B (3, 2): unit vectors at right angles to m and each other

    def __post_init__(self) -> None:
        a = np.cross(self.m, np.eye(3)[int(np.abs(self.m).argmin())])
        a /= np.sqrt(a @ a)
        self.across = np.column_stack([a, np.cross(self.m, a)])

    @property
    def normal(self) -> Array:
        """Return N (3,), not of unit length."""
        return self.m + self.across @ self.slopes

    def add(self, slopes: Array, information: Array) -> None:
        """Fuse other slopes (2,) with their information (2, 2)."""
        whole = self.information + information
        found = np.linalg.solve(whole, self.information @ self.slopes + information @ slopes)
        steep = float(np.sqrt(found @ found))
        self.slopes, self.information = np.asarray(found * (STEEPEST / max(steep, STEEPEST)), dtype=np.float64), whole


def plane_from_depths(depth: Array, y: Array, sensor: Any, T: Array, half: int, plane: Plane) -> None:
    """Fuse what the depth image (H, W) shows of the plane about the pixel y (2,), from T; nothing at an edge."""
    u, v = np.rint(y).astype(np.int64).tolist()
    window = depth[max(v - half, 0) : v + half + 1, max(u - half, 0) : u + half + 1].ravel()
    if len(window) != (2 * half + 1) ** 2 or not (window > 0).all():
        return
    offsets = np.arange(-half, half + 1.0)
    pixels = np.column_stack([np.tile(offsets + u, len(offsets)), np.repeat(offsets + v, len(offsets))])
    rays = sensor.rays(pixels)
    rays /= rays[:, 2:]
    N, *_ = np.linalg.lstsq(rays, 1.0 / window, rcond=None)
    sigma = sensor.sigma_rho_per_m
    if np.abs(rays @ N - 1.0 / window).max() > EDGE * sigma:
        return
    turn, B = matrix(T[3:]), plane.across
    along = float(turn @ N @ plane.m)
    if along > 0.0:
        C = B.T @ turn @ np.linalg.inv(rays.T @ rays) @ turn.T @ B * (sigma / along) ** 2
        plane.add(B.T @ turn @ N / along, np.linalg.inv(C))


def plane_from_match(image: Any, template: Any, y: Array, slopes: Array, rates: Array, plane: Plane) -> None:
    """Fuse what a match at y (2,) shows of the plane: a template (s, s) that holds with `slopes`, x_s = `rates`.

    rates (2, 2, 2): of x by each slope, as a matrix that multiplies x.
    """
    step, information = slopes_shown(image, template, y, rates)
    if np.isfinite(step).all():
        plane.add(slopes + step, information)


@compiled
def slopes_shown(image: Any, template: Any, y: Array, rates: Array) -> tuple[Array, Array]:
    """Return ds (2,) and its information (2, 2), NaN where the image (H, W) about y (2,) shows nothing."""
    found, inverse, rest = fit_template(image, template, y, rates)
    gain = found[0]
    if not gain > LEAST_GAIN:
        return np.full(2, np.nan), np.zeros((2, 2))
    variance = max(rest / ((template.shape[0] - 2) ** 2 - 6), LEAST_VARIANCE)
    return found[4:] / gain, np.linalg.inv(inverse[4:, 4:] * (REPEATED * variance / gain**2))
