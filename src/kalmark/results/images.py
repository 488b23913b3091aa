"""What a camera measured and what was expected of it, scan by scan, as points of its images.

The columns of a camera's measurements say what they are: `u_px, v_px` is a point; `u1_px, v1_px, u2_px, v2_px` are the
ends of a segment, four of them the corners of a tag; `ul_px, vl_px, ur_px, vr_px` is a point in a left and a right
image.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from kalmark.results.history import Array, Camera, History, Ints
from kalmark.results.landmarks import EUCLIDEAN

COLUMN = re.compile(r"([uv])([lr]?)(\d*)_px")
COLOURS = {  # by whether the landmark is Euclidean, then whether it was used
    (True, True): ("#0aa5b5", "Euclidean, used"),
    (True, False): ("#1f3fd0", "Euclidean, predicted only"),
    (False, True): ("#d81b1b", "not Euclidean, used"),
    (False, False): ("#c218c2", "not Euclidean, predicted only"),
}
SIDES = {"": "", "l": "left", "r": "right"}


class Sighting(NamedTuple):
    """One observation in one image: its name, what became of it, what was measured and what was expected.

    `measured` and `expected` (V, 2) are pixels, one row a point; without an expectation the latter is NaN.  `Z` (2, 2)
    is the covariance of the innovation of a single point, NaN of what has several.
    """

    name: str
    outcome: str
    euclidean: bool
    measured: Array
    expected: Array
    Z: Array


class Image(NamedTuple):
    """One image of a scan: "left", "right" or "" for the only one, and all that was seen in it."""

    side: str
    sightings: list[Sighting]


def images(history: History, camera: Camera, step: int) -> list[Image]:
    """Return the images of the scan that a camera made at a step."""
    found = [Image(SIDES[side], []) for side in _points(camera)]
    for row in np.flatnonzero(history.step == step):
        y, e, z, Z = history.y[row], history.e[row], history.z[row], history.Z[row]
        whole = np.isfinite(z).sum() == np.isfinite(y).sum()
        name, outcome = str(history.landmark[row]) or str(history.id[row]), str(history.outcome[row])
        for image, at in zip(found, _points(camera).values(), strict=True):
            Z_at = Z[np.ix_(at[0], at[0])] if whole and len(at) == 1 else np.full((2, 2), np.nan)
            euclidean = str(history.kind[row]) in EUCLIDEAN
            image.sightings.append(Sighting(name, outcome, euclidean, y[at], e[at], Z_at))
    return found


def colour_of(sighting: Sighting) -> tuple[str, str]:
    """Return the colour of an expectation and what it means."""
    return COLOURS[sighting.euclidean, sighting.outcome == "associated"]


def steps_of(history: History, camera: Camera) -> Ints:
    """Return the steps at which a camera saw something."""
    mine = (history.sensor == camera.sensor) & (history.robot[history.step] == camera.robot)
    return np.unique(history.step[mine])


def _points(camera: Camera) -> dict[str, Ints]:
    """Return the columns (V, 2) of u and v of the points in each image."""
    found: dict[str, dict[str, dict[str, int]]] = {}
    for k, name in enumerate(camera.columns):
        match = COLUMN.fullmatch(name)
        if match is not None:
            axis, side, number = match.groups()
            found.setdefault(side, {}).setdefault(number, {})[axis] = k
    # a stereo pair without the right image's v has it from the left one: the pair is rectified
    left = found.get("l", {}).get("", {})
    return {
        side: np.array([[at["u"], at.get("v", left.get("v", 0))] for at in points.values()], dtype=np.int64)
        for side, points in found.items()
    }


def trimmed(a: Array, b: Array, size: tuple[float, float]) -> Array | None:
    """Return the part (2, 2) of the straight line through two pixels that lies in an image, None if there is none."""
    d = b - a
    if not (np.isfinite(d).all() and d.any()):
        return None
    first, last = -np.inf, np.inf
    for k in (0, 1):
        if d[k] == 0:
            if not 0 <= a[k] <= size[k]:
                return None
            continue
        near, far = sorted((-a[k] / d[k], (size[k] - a[k]) / d[k]))
        first, last = max(first, near), min(last, far)
    return np.array([a + first * d, a + last * d]) if first < last else None
