"""A place seen again: landmarks recognised by descriptors, whatever the filter expects, and the pose they agree on.

The patches of all landmarks that have proven themselves, and corners of the image at three sizes, are described by ORB
(Rublee and others 2011).  A pair is taken where each is the other's nearest, and clearly nearer than the next landmark.
One pose must explain many of the pairs (PnP with RANSAC); by chance hardly two pairs agree with one found by four.
A camera that was lost is put there.  One that has drifted takes the pairs as matches, which correct the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.geometry.frames3d import to_frame_many
from kalmark.geometry.rotations import from_matrix
from kalmark.vision import opencv as cv2
from kalmark.vision.appearance import View
from kalmark.vision.joint_expectation import PIXEL, Prospect
from kalmark.vision.template_matching import Searcher

SIZES = (1.0, 0.7, 0.5)  # of the image, in which corners are described
CORNERS, APART_PX, QUALITY = 600, 5, 0.01
REACH = 12  # half width of what is described, px
MARGIN = 20  # about each patch: what describes it reaches beyond it
NEAREST, CLEARER = 70, 0.85  # bits of 256 that may differ, and those of the next landmark that it must stay below
LEAST = 10  # pairs that agree with a pose
OFF_PX, TRIES, SURE = 3.0, 300, 0.999
NEAR_PX = 5.0  # from where that pose shows a landmark, within which it is matched
POSITION, TURN_RAD = 0.05, 0.03  # sigmas of the pose: a share of the median depth, and an angle


class Recognised(NamedTuple):
    """The pose T (7,) of a sensor, its covariance (6, 6), and the landmarks `which` (n,) that agree with it."""

    T: Array
    cov: Array
    which: Index


def match_expected(
    image: Any, views: Sequence[Sequence[View]], old: Index, prospect: Prospect, searcher: Searcher
) -> tuple[Index, Array] | None:
    """Return landmarks (n,) of a prospect and the pixels (n, 2) where an image shows them; None if that is ambiguous.

    `old` (k,) are the landmarks of these views.
    """
    found = recognize_place(image, views, prospect.places[old], prospect.sensor)
    if found is None:
        return None
    rows = old[found.which]
    e = prospect.sensor.expect(to_frame_many(found.T, prospect.places[rows])[0])[0][:, :PIXEL]
    y, scores = searcher.in_discs(rows, e, np.full(len(rows), NEAR_PX))
    good = scores >= searcher.accept
    return (rows[good], y[good]) if good.sum() >= LEAST else None


def recognize_place(image: Any, views: Sequence[Sequence[View]], places: Array, sensor: Any) -> Recognised | None:
    """Return the pose from which an image (H, W) of landmarks at `places` (K, 3) was taken; None if it is ambiguous."""
    orb = cv2.ORB_create(CORNERS, nlevels=1, edgeThreshold=REACH + 1, patchSize=2 * REACH + 1)
    known, owner = describe_views(orb, views)
    seen, y = describe_corners(orb, image)
    landmark, corner = pairs(known, owner, seen)
    rays = sensor.rays(y[corner]) if len(corner) else np.zeros((0, 3))
    ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.1)
    if ahead.sum() < LEAST:
        return None
    landmark, rays = landmark[ahead], rays[ahead]
    places = np.ascontiguousarray(places[landmark])
    u, v = image.shape[1] / 2.0, image.shape[0] / 2.0
    pixel_rad = float(np.linalg.norm(np.diff(sensor.rays(np.array([[u, v], [u + 1.0, v]])), axis=0)))
    flat = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
    found, turn, t, inliers = cv2.solvePnPRansac(
        places, flat, np.eye(3), None, iterationsCount=TRIES, reprojectionError=OFF_PX * pixel_rad, confidence=SURE,
        flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    if not found or inliers is None or len(inliers) < LEAST:
        return None
    R = cv2.Rodrigues(turn)[0].T
    at = -R @ t.ravel()
    agree = inliers.ravel()
    depth = float(np.median(((places[agree] - at) @ R)[:, 2]))
    cov = np.diag([(POSITION * depth) ** 2] * 3 + [TURN_RAD**2] * 3)
    return Recognised(np.concatenate([at, from_matrix(np.ascontiguousarray(R))]), cov, landmark[agree])


def describe_views(orb: Any, views: Sequence[Sequence[View]]) -> tuple[Any, Index]:
    """Return the bits (N, 256) that describe all views, and the number (N,) of the landmark of each."""
    bits, owner = [np.zeros((0, 256), np.float32)], list[int]()
    for k, patch in ((k, view.patch) for k, own in enumerate(views) for view in own):
        wide = cv2.copyMakeBorder(patch, MARGIN, MARGIN, MARGIN, MARGIN, cv2.BORDER_REPLICATE)
        some, _ = describe_pixels(orb, wide, np.array([[wide.shape[1] // 2, wide.shape[0] // 2]]))
        bits.append(some)
        owner += [k] * len(some)
    return np.concatenate(bits), np.array(owner, dtype=np.int64)


def describe_corners(orb: Any, image: Any) -> tuple[Any, Array]:
    """Return the bits (M, 256) that describe the corners of an image, and their pixels (M, 2)."""
    bits, pixels = [np.zeros((0, 256), np.float32)], [np.zeros((0, 2))]
    for size in SIZES:
        small = image if size == 1.0 else cv2.resize(image, None, fx=size, fy=size, interpolation=cv2.INTER_AREA)
        corners = cv2.goodFeaturesToTrack(small, CORNERS, QUALITY, APART_PX)
        y = np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2).astype(np.float64)
        some, which = describe_pixels(orb, small, y)
        bits.append(some)
        pixels.append((y[which] + 0.5) / size - 0.5)
    return np.concatenate(bits), np.concatenate(pixels)


def describe_pixels(orb: Any, image: Any, y: Array) -> tuple[Any, Index]:
    """Return the bits (M, 256) that describe what is about the pixels y (N, 2), and which of them they are of (M,).

    It is turned as the grey values lie: from the pixel towards their centre of mass.
    """
    offset = np.arange(-REACH, REACH + 1)
    disc = offset[:, None] ** 2 + offset**2 <= REACH**2
    at = np.rint(y).astype(np.int64)
    inside = np.flatnonzero(((at > REACH) & (at < np.array(image.shape[::-1]) - REACH - 1)).all(axis=1))
    at = at[inside]
    grey = image[at[:, 1, None, None] + offset[:, None], at[:, 0, None, None] + offset] * disc
    angle = np.degrees(np.arctan2((grey * offset[:, None]).sum(axis=(1, 2)), (grey * offset).sum(axis=(1, 2)))) % 360.0
    points = [
        cv2.KeyPoint(float(u), float(v), 2.0 * REACH + 1.0, float(turn), 0.0, 0, int(k))
        for (u, v), turn, k in zip(y[inside], angle, inside, strict=True)
    ]
    points, bytes_ = orb.compute(image, points)
    if bytes_ is None or not len(points):
        return np.zeros((0, 256), np.float32), np.zeros(0, np.int64)
    return np.unpackbits(bytes_, axis=1).astype(np.float32), np.array([p.class_id for p in points], dtype=np.int64)


def pairs(known: Any, owner: Index, seen: Any) -> tuple[Index, Index]:
    """Return numbers of landmarks and of corners that are each other's nearest, clearly nearer than the next landmark.

    `known` (N, 256) are bits that describe the landmarks `owner` (N,), `seen` (M, 256) those of the corners.
    """
    none = np.zeros(0, np.int64)
    if not len(known) or not len(seen):
        return none, none
    apart = seen.sum(axis=1)[:, None] + known.sum(axis=1) - 2.0 * (seen @ known.T)
    nearest = apart.argmin(axis=1)
    least, mine = apart[np.arange(len(seen)), nearest], owner[nearest]
    others = np.where(owner == mine[:, None], np.inf, apart).min(axis=1)
    clear = (least <= NEAREST) & (least <= CLEARER * others)
    best: dict[int, int] = {}
    for k in np.flatnonzero(clear).tolist():
        before = best.get(int(mine[k]))
        if before is None or least[k] < least[before]:
            best[int(mine[k])] = k
    return np.array([*best], dtype=np.int64), np.array([*best.values()], dtype=np.int64)
