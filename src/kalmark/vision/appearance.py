"""The appearance of a landmark from another pose: patches warped by the homography of their plane.

The landmark at p lies on a plane with normal N (`planes`).  A corner of a patch, seen along the unit ray m, is at
X = m (N.x)/(N.m) in the frame of the camera that took it, x = p in it.  From where the camera is now the four corners
appear at four pixels, which determine the homography, whatever the lens.  The centre of the patch is the landmark,
wherever the estimate has it by now: pixels count from where the centre appears.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.arrays import Array, Index
from kalmark.geometry.rotations import matrix
from kalmark.vision import opencv as cv2
from kalmark.vision.planes import Plane

MOST_SCALE = 2.0  # a patch is not enlarged or reduced by more
LEAST_COSINE = 0.5  # of the angle between the directions of view, then and now: 60 deg
ANOTHER_COSINE, ANOTHER_SCALE = 0.94, 1.4  # a view is taken where the best one differs by more: 20 deg
MOST_VIEWS = 4
DIFFERENCE, STEPS = 1e-3, np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # of slopes, for rates


@dataclass(frozen=True, eq=False)
class View:
    """A patch (2 q + 1, 2 q + 1) of an image taken from the pose T (7,); `rays` (5, 3) of its corners, its centre.

    `frame` is the number of the image.
    """

    patch: npt.NDArray[np.uint8]
    T: Array
    rays: Array
    frame: int = 0


class ExpectedAppearance(NamedTuple):
    """Expected appearance of K landmarks: `templates` (K, s, s), of which those `valid` (n,) hold.

    `likeness` (K, 2) is the cosine of the angle between the directions of view and the scale, of the best view of each.
    `rates` (K, 2, 2, 2): the slopes of the plane move what appears at x from the centre by rates x.
    """

    templates: Any
    valid: Index
    likeness: Array
    rates: Array


def patch_corners(y: Array, q: float) -> Array:
    """Return the corners of a patch about the pixel y (2,), clockwise from above left, and its centre: (5, 2)."""
    return y + q * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [0.0, 0.0]])


def take_view(image: Any, y: Array, T: Array, sensor: Any, q: int, frame: int = 0) -> View | None:
    """Return the view of what is at the pixel y (2,) of an image taken from T, None too near to its border."""
    height, width = image.shape
    if not (q <= y[0] <= width - 1 - q and q <= y[1] <= height - 1 - q):
        return None
    patch = cv2.getRectSubPix(image, (2 * q + 1, 2 * q + 1), (float(y[0]), float(y[1])))
    rays = sensor.rays(patch_corners(y, q))
    return View(patch, T.copy(), rays, frame) if np.isfinite(rays).all() else None


def best_views(views: list[list[View]], places: Array, T: Array) -> tuple[list[View | None], Array]:
    """Return for each landmark the view most like that from T, and cosine of the angle between and scale (K, 2)."""
    best: list[View | None] = []
    likeness = np.zeros((len(views), 2))
    for k, own in enumerate(views):
        chosen, score = None, -np.inf
        now = T[:3] - places[k]
        near = np.sqrt(now @ now)
        for view in own:
            then = view.T[:3] - places[k]
            far = np.sqrt(then @ then)
            cosine, scale = float(then @ now / max(far * near, 1e-12)), float(far / max(near, 1e-12))
            if cosine - 0.3 * abs(np.log(max(scale, 1e-6))) > score:
                chosen, score = view, cosine - 0.3 * abs(np.log(max(scale, 1e-6)))
                likeness[k] = cosine, scale
        best.append(chosen)
    return best, likeness


def predict_templates(
    views: list[list[View]], planes: list[Plane | None], places: Array, T: Array, sensor: Any, h: int
) -> ExpectedAppearance:  # fmt: skip
    """Return the expected templates of landmarks at `places` (K, 3) from T, of half width h."""
    best, likeness = best_views(views, places, T)
    templates, done = np.zeros((len(best), 2 * h + 1, 2 * h + 1), np.uint8), []
    rates = np.zeros((len(best), 2, 2, 2))
    valid = [
        k for k, view in enumerate(best)
        if view is not None and likeness[k, 0] > LEAST_COSINE and 1 / MOST_SCALE < likeness[k, 1] < MOST_SCALE
    ]  # fmt: skip
    if not valid:
        return ExpectedAppearance(templates, np.zeros(0, np.int64), likeness, rates)
    shown = [(view, plane) for view, plane in ((best[k], planes[k]) for k in valid) if view and plane]
    turns = np.array([matrix(view.T[3:]) for view, _ in shown])
    normals = np.array([plane.normal for _, plane in shown])[:, None] + DIFFERENCE * (
        STEPS @ np.array([plane.across for _, plane in shown]).transpose(0, 2, 1)
    )  # (n, 3, 3): of the plane, and of it with either slope changed
    c = np.array([view.T[:3] for view, _ in shown])
    rays = np.array([view.rays for view, _ in shown]) @ turns.transpose(0, 2, 1)
    along = normals @ rays.transpose(0, 2, 1)
    far = normals @ (places[valid] - c)[:, :, None]
    X = c[:, None, None] + rays[:, None] * (far / np.where(along > 0.0, along, np.nan))[..., None]
    seen = (X.reshape(-1, 3) - T[:3]) @ matrix(T[3:])
    pixels = sensor.expect(np.ascontiguousarray(seen))[0][:, :2].reshape(-1, 3, 5, 2)
    offsets = pixels[:, :, :4] - pixels[:, :, 4:]
    finite = np.isfinite(offsets).all(axis=(1, 2, 3))
    from_centre = offsets[finite, :1].transpose(0, 1, 3, 2)  # (n, 1, 2, 4)
    moved = (offsets[finite, 1:] - offsets[finite, :1]) / DIFFERENCE
    fitted = np.linalg.solve(from_centre @ from_centre.transpose(0, 1, 3, 2), from_centre @ moved)
    rates[np.array(valid)[finite]] = fitted.transpose(0, 1, 3, 2)
    for i, k in enumerate(valid):
        view = best[k]
        assert view is not None
        to = offsets[i, 0] + h
        if not finite[i]:
            continue
        size = view.patch.shape[0] - 1.0
        source = np.array([[0.0, 0.0], [size, 0.0], [size, size], [0.0, size]], dtype=np.float32)
        warp = cv2.getPerspectiveTransform(source, to.astype(np.float32))
        flags, border = cv2.INTER_LINEAR, cv2.BORDER_REPLICATE
        done.append(k)
        templates[k] = cv2.warpPerspective(view.patch, warp, (2 * h + 1, 2 * h + 1), flags=flags, borderMode=border)
    return ExpectedAppearance(templates, np.array(done, dtype=np.int64), likeness, rates)
