"""Images of textured planes by a camera with any lens: exact poses, exact depth at any pixel.

A pixel's ray meets each plane at one point; the nearest one counts.  Its grey value is interpolated between the pixels
of the texture and between two halvings of it (Williams 1983), so that distant texture does not flicker.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from PIL import Image, ImageDraw

from kalmark.arrays import Array
from kalmark.compiled import compiled
from kalmark.geometry.rotations import matrix
from kalmark.vision.image_files import DEPTH_SCALE

Bytes = np.ndarray[Any, np.dtype[np.uint8]]
Floats = np.ndarray[Any, np.dtype[np.float32]]

SMALLEST = 4  # pixels of the last halving of a texture
LEVELS = 16  # of halvings
SKY = 128  # grey value where there is no plane
LARGEST_M, SHARE = 0.4, 0.05  # of the quadrangles of a texture: the largest, and the smallest as a share of it
OVER = 2  # pixels in which a pixel of a texture is drawn, along each side, so that edges are smooth


@dataclass(frozen=True, eq=False)
class Rectangle:
    """A rectangle with a texture (rows, columns): x along the columns, y along the rows, the first corner at `pose`.

    `pose` (7,) is that of its frame in the world; a pixel of the texture is `pixel_m` wide.  Both sides are visible.
    """

    pose: Array
    texture: Bytes
    pixel_m: float

    @property
    def size_m(self) -> Array:
        """Width and height (2,)."""
        rows, columns = self.texture.shape
        return np.array([columns, rows]) * self.pixel_m

    def corners(self) -> Array:
        """Return its corners in the world (4, 3)."""
        w, h = self.size_m
        R = matrix(np.ascontiguousarray(self.pose[3:]))
        return self.pose[:3] + np.array([[0, 0, 0], [w, 0, 0], [w, h, 0], [0, h, 0]]) @ R.T


class Renderer:
    """Images of planes by a camera of any lens (a `PinHole`, an `Omnidirectional`, the left one of a `Stereo` pair).

    The rays and the halved textures are made once.
    """

    def __init__(self, planes: Sequence[Rectangle], camera: Any) -> None:
        self.planes = planes
        width, height = camera.image
        self.shape = int(height), int(width)
        v, u = np.mgrid[: self.shape[0], : self.shape[1]]
        pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
        self.rays = camera.rays(pixels)
        self.focal_px = 1.0 / float(np.nanmedian(np.linalg.norm(np.diff(self.rays, axis=0), axis=1)))
        self.sizes = np.array([[*plane.size_m, plane.pixel_m] for plane in planes]).reshape(-1, 3)
        self.levels = np.zeros((len(planes), LEVELS, 3), np.int64)
        pyramids, at = [], 0
        for p, plane in enumerate(planes):
            for level, halved in enumerate(pyramid(plane.texture)):
                self.levels[p, level] = at, *halved.shape
                pyramids.append(halved.ravel())
                at += halved.size
        self.texels: Bytes = np.concatenate(pyramids) if pyramids else np.zeros(0, np.uint8)

    def render(self, T: Array) -> tuple[Floats, Floats]:
        """Return the image and the depth along the optical axis [m] (H, W) from the camera's pose T (7,).

        The depth is infinite where there is no plane.
        """
        image, depth = sample_planes(self.rays, self.seen_from(T), self.sizes, self.levels, self.texels, self.focal_px)
        return image.reshape(self.shape), depth.reshape(self.shape)

    def seen_from(self, T: Array) -> Array:
        """Return the axes x, y, z and the first corner of each plane in the camera's frame (P, 12)."""
        R_c, rows = matrix(np.ascontiguousarray(T[3:])), np.zeros((len(self.planes), 12))
        for row, plane in zip(rows, self.planes, strict=True):
            row[:9] = (R_c.T @ matrix(np.ascontiguousarray(plane.pose[3:]))).T.ravel()
            row[9:] = R_c.T @ (plane.pose[:3] - T[:3])
        return rows

    def taken(self, T: Array, rng: Generator, noise: float = 0.0, blur_px: float = 0.0) -> tuple[Bytes, Floats]:
        """Return the image in 8-bit grey values (H, W), blurred and with white noise, and the depth of `render`.

        `noise` is in grey values, `blur_px` the standard deviation of a Gaussian.
        """
        from scipy.ndimage import gaussian_filter

        image, depth = self.render(T)
        if blur_px:
            image = gaussian_filter(image, blur_px)
        if noise:
            image = image + noise * rng.standard_normal(image.shape, dtype=np.float32)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8), depth


def render(renderer: Renderer, T: Array, seed: int, noise: float, blur_px: float) -> Bytes:
    """Return the image (H, W) from the camera's pose T (7,), its noise by a seed."""
    return renderer.taken(T, np.random.default_rng(seed), noise, blur_px)[0]


def rendered_depth(renderer: Renderer, T: Array, seed: int = 0, sigma_rho: float = 0.0) -> Array:
    """Return the depth (H, W) in m from the camera's pose T (7,), to 1 / DEPTH_SCALE m as in files; 0: no plane.

    Its inverse has a noise of `sigma_rho` [1/m], by a seed.
    """
    depth = renderer.render(T)[1].astype(np.float64)
    if sigma_rho:
        rho = 1.0 / depth + np.random.default_rng(seed).normal(0.0, sigma_rho, depth.shape)
        depth = np.where(np.isfinite(depth) & (rho > 0), 1.0 / np.where(rho > 0, rho, 1.0), 0.0)
    return np.rint(np.where(np.isfinite(depth), depth, 0.0) * DEPTH_SCALE) / DEPTH_SCALE


def pyramid(texture: Bytes) -> list[Bytes]:
    """Return a texture (H, W) and its halvings (H / 2, W / 2), ..., down to a few pixels."""
    out = [texture]
    while min(out[-1].shape) >= 2 * SMALLEST and len(out) < LEVELS:
        rows, columns = (n // 2 * 2 for n in out[-1].shape)
        quarters = out[-1][:rows, :columns].reshape(rows // 2, 2, columns // 2, 2)
        out.append(np.rint(quarters.mean(axis=(1, 3))).astype(np.uint8))
    return out


@compiled
def sample_planes(
    rays: Array, planes: Array, sizes: Array, levels: Any, texels: Any, focal_px: float
) -> tuple[Any, Any]:  # fmt: skip
    """Return grey values (N,) and depths (N,) along unit rays (N, 3) of the camera.

    planes (P, 12): axes x, y and z of each in the camera's frame, and its first corner; sizes (P, 3): width, height,
    pixel [m]; levels (P, LEVELS, 3): where each halving begins in `texels`, rows and columns.
    """
    grey, depth = np.full(len(rays), np.float32(SKY)), np.full(len(rays), np.float32(np.inf))
    offset = np.empty(len(planes))
    for p in range(len(planes)):
        offset[p] = planes[p, 6] * planes[p, 9] + planes[p, 7] * planes[p, 10] + planes[p, 8] * planes[p, 11]
    for i in range(len(rays)):
        a, b, c = rays[i, 0], rays[i, 1], rays[i, 2]
        best, which, x, y, slope = np.inf, -1, 0.0, 0.0, 0.0
        for p in range(len(planes)):
            q = planes[p]
            towards = q[6] * a + q[7] * b + q[8] * c
            if not towards * offset[p] > 0.0:
                continue
            t = offset[p] / towards
            if t >= best:
                continue
            dx, dy, dz = t * a - q[9], t * b - q[10], t * c - q[11]
            s, r = q[0] * dx + q[1] * dy + q[2] * dz, q[3] * dx + q[4] * dy + q[5] * dz
            if 0.0 <= s <= sizes[p, 0] and 0.0 <= r <= sizes[p, 1]:
                best, which, x, y, slope = t, p, s, r, abs(towards)
        if which < 0:
            continue
        depth[i] = best * c
        pixel = sizes[which, 2]
        fine = max(0.0, math.log2(best / (focal_px * pixel * math.sqrt(max(slope, 1e-3)))))
        low = int(fine)
        while low > 0 and (low >= LEVELS or levels[which, low, 1] == 0):
            low -= 1
            fine = float(low)
        value = texel(levels[which, low], texels, x / pixel, y / pixel, low)
        if fine > low and low + 1 < LEVELS and levels[which, low + 1, 1] > 0:
            other = texel(levels[which, low + 1], texels, x / pixel, y / pixel, low + 1)
            value += (fine - low) * (other - value)
        grey[i] = value
    return grey, depth


@compiled
def texel(level: Any, texels: Any, x: float, y: float, halved: int) -> float:
    """Return the grey value at (x, y), in pixels of the full texture, of a halving: bilinear."""
    rows, columns = level[1], level[2]
    scale = 0.5**halved
    u = min(max(x * scale - 0.5, 0.0), columns - 1.0)
    v = min(max(y * scale - 0.5, 0.0), rows - 1.0)
    j, i = min(int(u), columns - 2), min(int(v), rows - 2)
    du, dv = u - j, v - i
    at = level[0] + i * columns + j
    top = texels[at] * (1.0 - du) + texels[at + 1] * du
    bottom = texels[at + columns] * (1.0 - du) + texels[at + columns + 1] * du
    return top * (1.0 - dv) + bottom * dv


def texture(width_m: float, height_m: float, pixel_m: float, rng: Generator, per_m2: float) -> Bytes:
    """Return a texture (H, W) of random quadrangles, 2 to 40 cm wide: corners for any distance."""
    columns, rows = (max(2 * SMALLEST, round(size / pixel_m)) for size in (width_m, height_m))
    picture = Image.new("L", (OVER * columns, OVER * rows), int(rng.integers(90, 170)))
    draw = ImageDraw.Draw(picture)
    count = max(4, round(per_m2 * width_m * height_m))
    sizes = OVER * np.sort(LARGEST_M * SHARE ** rng.uniform(size=count))[::-1] / pixel_m  # the large ones first
    middles = rng.uniform(0, picture.size, (count, 2))
    angles = np.sort(rng.uniform(0, 2 * math.pi, (count, 4)))
    greys = rng.integers(10, 246, count).tolist()
    corners = middles[:, None] + 0.5 * sizes[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=2)
    for quadrangle, grey in zip(corners.tolist(), greys, strict=True):
        draw.polygon([tuple(corner) for corner in quadrangle], fill=grey)
    return np.array(picture.reduce(OVER))
