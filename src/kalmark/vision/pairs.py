"""The second image of a rectified pair: where it shows what was found in the first one, a measurement (ul, vl, ur, vr).

The surroundings of a pixel of the left image are searched along its row of the right one by the same correlation: a
landmark where the filter expects it by then, a new one over all disparities of its prior, and from there back again.  A
landmark that is not found so counts by its left pixel alone: its disparity is as expected with a sigma of `UNKNOWN`;
that of a new landmark is the prior of its type.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.vision import opencv as cv2
from kalmark.vision.depth_images import DepthPrior
from kalmark.vision.selection import GATE
from kalmark.vision.template_matching import Searcher

UNKNOWN = 1e3  # px
BACK_PX = 1.0  # the way back from the right image must end so near to where it began
SIGMAS = 3.0  # of the prior of the inverse distance that are searched
WIDEST = 0.25  # of the width of the image: disparities that are searched for a landmark without a prior


def patches(image: Any, y: Array, half: int) -> Any:
    """Return the patches about the pixels y (n, 2) of an image, (n, 2 half + 1, 2 half + 1)."""
    side = 2 * half + 1
    found = [cv2.getRectSubPix(image, (side, side), (float(u), float(v))) for u, v in y]
    return np.array(found, dtype=np.uint8).reshape(-1, side, side)


def with_pairs(
    sensor: Any, landmark: Any, images: tuple[Any, Any | None], y: Array, e: Array, Z: Array, half: int,
    accept: float,
) -> tuple[Array, Array]:  # fmt: skip
    """Return measurements (n, 4) of left pixels y (n, 2), NaN where none is possible, and their noise (n, 4, 4).

    The first of them are of landmarks that are expected at e (k, 4), with covariances Z (k, 4, 4) of the innovations;
    the rest are new `landmark`s.
    """
    k, scale, prior = len(e), sensor.fx_px * sensor.baseline_m, isinstance(landmark, DepthPrior)
    middle, sigma = np.full(len(y), np.nan), np.full(len(y), np.nan)
    middle[:k], sigma[:k] = e[:, 0] - e[:, 2], np.sqrt(Z[:, 0, 0] - 2.0 * Z[:, 0, 2] + Z[:, 2, 2])
    z = np.maximum(sensor.rays(y[k:])[:, 2], 1e-6)  # the prior is of the distance, not along the axis
    most = np.full(len(z), WIDEST * sensor.width_px)
    if prior:
        most = scale * (landmark.prior_rho_per_m + SIGMAS * landmark.sigma_rho_per_m) / z
    middle[k:], sigma[k:] = most / 2, most / 2 / np.sqrt(GATE)
    right, found = np.full((len(y), 2), np.nan), np.zeros(len(y), np.bool_)
    if images[1] is not None and len(y):
        right, found = match_pair((images[0], images[1]), y, middle, sigma, sensor.sigma_vr_px, k, half, accept)
    out = np.column_stack([y, np.where(found[:, None], right, y)])
    R = np.array(sensor.noise(out), dtype=np.float64)
    off = np.flatnonzero(~found)
    known, new = off[off < k], off[off >= k]
    out[known, 2] -= np.maximum(middle[known], 0.0)
    R[known, 2, 2] = R[known, 3, 3] = UNKNOWN**2
    if prior:
        out[new, 2] -= scale * landmark.prior_rho_per_m / z[new - k]
        R[new, 2, 2] += np.square(scale * landmark.sigma_rho_per_m / z[new - k])
        R[new, 3, 3] = 3.0 * R[new, 1, 1]  # a start takes the mean of both rows, here of one measurement
    else:
        out[new] = np.nan
    return out, R


def match_pair(
    images: tuple[Any, Any], y: Array, middle: Array, sigma: Array, sigma_v: float, k: int, half: int,
    accept: float,
) -> tuple[Array, Flags]:  # fmt: skip
    """Return the pixels (n, 2) of the right image that match pixels y (n, 2) of the left one, and which match (n,).

    The disparity is searched within three `sigma` (n,) of its `middle` (n,); of all but the first k there and back.
    """
    which, shift = np.arange(len(y)), np.column_stack([middle, np.zeros(len(y))])
    Z = np.zeros((len(y), 2, 2))
    Z[:, 0, 0], Z[:, 1, 1] = np.square(sigma), 2.0 * sigma_v**2
    searcher = Searcher(images[1], patches(images[0], y, half), accept)
    right, scores = searcher.in_ellipses(which, y - shift, Z, GATE)
    found = (scores >= accept) & (right[:, 0] <= y[:, 0])
    new = np.flatnonzero(found & (which >= k))
    searcher = Searcher(images[0], patches(images[1], right[new], half), accept)
    back, scores = searcher.in_ellipses(np.arange(len(new)), right[new] + shift[new], Z[new], GATE)
    found[new] = (scores >= accept) & (np.abs(back - y[new]).max(axis=1, initial=0.0) < BACK_PX)
    return right, found
