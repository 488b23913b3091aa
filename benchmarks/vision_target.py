"""One camera that begins before a known target: its poses against those that PnP of the target gives in each image.

python benchmarks/vision_target.py [SEEDS]     MonoSLAM's sequence, `monoslam`: a row a seed, then the worst of them

The target is found as a dark quadrangle in a bright frame, its corners as the intersections of lines fitted to its
sides, the pose by PnP of a plane (Collins and Bartoli 2014).  That has two solutions; seen from the front both fit
nearly as well, so the one nearer to the filter's counts.  What such a pose is worth is its scatter: the camera moves
smoothly, so the position must be near the mean of those of the frames before and after.  Where the middle of the target
is in the camera's frame does not depend on the tilt, and is known far better.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from kalmark.arrays import Array
from kalmark.config import build_slam, open_run
from kalmark.filter.kernels import one_thread
from kalmark.models.sensors import PinHole

# of the drawing that was printed, with its line: 209.7 mm by 147.6 mm
CORNERS = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]) * (0.10486, 0.07381, 0.0)
LEVELS = range(60, 121, 15)  # grey values below which the target may be
LEAST_PX2, MOST_PX2, SIDES = 250, 12_000, (1.15, 1.8)
OFF_PX = 3.5  # a side is looked for so far from the contour
FITS_PX = 0.5  # RMS of the corners of a pose that is used


def quadrangle(image: Any) -> Array | None:
    """Return the corners (4, 2) of the dark quadrangle in a bright frame, to a pixel; clockwise from above left."""
    best: tuple[float, Array] | None = None
    for level in LEVELS:
        contours, _ = cv2.findContours((image < level).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            if not LEAST_PX2 < cv2.contourArea(contour) < MOST_PX2:
                continue
            found = cv2.approxPolyDP(contour, 0.04 * cv2.arcLength(contour, True), True)
            if len(found) != 4 or not cv2.isContourConvex(found):
                continue
            q = found[:, 0].astype(np.float64)
            middle = q.mean(axis=0)
            q = q[np.argsort(np.arctan2(q[:, 1] - middle[1], q[:, 0] - middle[0]))]
            width, height = np.linalg.norm(np.diff(q, axis=0, append=q[:1]), axis=1).reshape(2, 2).mean(axis=0)
            if not SIDES[0] < width / height < SIDES[1]:
                continue
            inside, frame = (np.zeros(image.shape, np.uint8) for _ in range(2))
            for mask, grown, value in ((inside, 0.8, 1), (frame, 1.22, 1), (frame, 1.1, 0)):
                cv2.fillConvexPoly(mask, np.rint(middle + (q - middle) * grown).astype(np.int32), value)
            contrast = float(np.percentile(image[frame > 0], 15) - np.percentile(image[inside > 0], 95))
            if contrast > 30.0 and (best is None or contrast > best[0]):
                best = contrast, q
    return None if best is None else best[1]


def side(image: Any, camera: PinHole, a: Array, b: Array) -> tuple[Array, float]:
    """Return n (2,), c of the line n x = c on the plane z = 1 that is the side of a target from pixel a to b."""
    along = (b - a) / np.linalg.norm(b - a)
    across, off = np.array([-along[1], along[0]]), np.arange(-OFF_PX, OFF_PX + 0.1, 0.25)
    at = a + np.linspace(0.12, 0.88, max(12, int(np.linalg.norm(b - a))))[:, None] * (b - a)
    there = (at[:, None] + off[:, None] * across).astype(np.float32)
    grey = cv2.remap(image.astype(np.float32), there[..., 0], there[..., 1], cv2.INTER_LINEAR)
    slope, middles = np.abs(np.diff(grey, axis=1)), (off[1:] + off[:-1]) / 2
    top = middles[slope.argmax(axis=1)]
    weight = slope * (np.abs(middles - top[:, None]) < 1.6)
    rays = camera.rays(at + ((weight * middles).sum(axis=1) / weight.sum(axis=1))[:, None] * across)
    x = (rays[:, :2] / rays[:, 2:])[np.abs(top) < OFF_PX - 0.5]
    for _ in range(3):
        n = np.linalg.svd(x - x.mean(axis=0))[2][1]
        left = np.abs((x - x.mean(axis=0)) @ n)
        good = left < 2.5 * max(1.4826 * float(np.median(left)), 1e-4)
        if good.all() or good.sum() < 8:
            break
        x = x[good]
    return n, float(n @ x.mean(axis=0))


def poses(image: Any, camera: PinHole) -> list[Array]:
    """Return the poses (7,) from which an image may show the target, at most two, none where it is not found."""
    q = quadrangle(image)
    if q is None:
        return []
    lines = [side(image, camera, a, b) for a, b in pairwise([*q, q[0]])]
    x = [np.linalg.solve([n, m], [c, d]) for (n, c), (m, d) in pairwise([lines[-1], *lines])]
    _, turns, shifts, errors = cv2.solvePnPGeneric(
        CORNERS, np.array(x)[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    found = []
    for turn, shift, error in zip(turns, shifts, errors, strict=True):
        back = Rotation.from_rotvec(turn.ravel()).inv()
        if error[0] * camera.fx_px < FITS_PX:
            found.append(np.append(-back.apply(shift.ravel()), back.as_quat()))
    return found


def seen(camera: PinHole, T: Array) -> Array:
    """Return the pixels (4, 2) of the target's corners from the pose T (7,)."""
    return camera.expect(Rotation.from_quat(T[3:]).inv().apply(CORNERS - T[:3]))[0]


def angle(q: Array, p: Array) -> float:
    """Return the angle between two rotations (4,), deg."""
    return float(np.degrees((Rotation.from_quat(q).inv() * Rotation.from_quat(p)).magnitude()))


def run(seed: int) -> dict[str, float]:
    """Return the figures of one run."""
    config, log = open_run("monoslam", None, [f"robots.each.sensors.camera.detector.seed={seed}"])
    slam = build_slam(config, log)
    (channel,) = slam.state.channels.values()
    rows, least, path = [], np.inf, []
    for frame in log.events:
        image = frame.grey()  # type: ignore[union-attr]
        report = slam.process(frame)
        T = slam.mean(frame.robot)[:7]
        if path:  # the first image has the target alone
            least = min(least, sum(o.outcome == "associated" for o in report.observations))
        found = poses(image, channel.sensor)
        path.append(np.full(3, np.nan))
        if found:
            near = min(found, key=lambda p: angle(p[3:], T[3:]))
            path[-1] = near[:3]
            middle = Rotation.from_quat(near[3:]).inv().apply(near[:3]) - Rotation.from_quat(T[3:]).inv().apply(T[:3])
            moved = seen(channel.sensor, near) - seen(channel.sensor, T)
            px = np.sqrt(np.mean(np.sum(moved**2, axis=1)))
            rows.append([np.linalg.norm(near[:3] - T[:3]), angle(near[3:], T[3:]), np.linalg.norm(middle), px])
    p = np.array(path)
    scatter = np.linalg.norm(p[1:-1] - (p[:-2] + p[2:]) / 2, axis=1) / np.sqrt(1.5)  # of the noise of one
    off, turned, middle, px = np.median(rows, axis=0)
    return {
        "position_m": off, "angle_deg": turned, "middle_m": middle, "corners_px": px,
        "scatter_m": float(np.nanmedian(scatter)), "frames": len(rows), "of": len(path), "matched_least": least,
    }  # fmt: skip


def main(seeds: int) -> None:
    """Print the figures of each seed and the worst of them."""
    rows = []
    for seed in range(seeds):
        rows.append(run(seed))
        print(f"seed {seed}: " + ", ".join(f"{key} {value:.4g}" for key, value in rows[-1].items()), flush=True)
    worst = {key: max(row[key] for row in rows) for key in rows[0]}
    print(
        "| sequence | position, m | angle, deg | middle, m | corners, px | PnP's scatter, m | frames | least matched |"
    )
    print("|---|---|---|---|---|---|---|---|")
    line = "| target | {position_m:.3f} | {angle_deg:.2f} | {middle_m:.4f} | {corners_px:.2f} | {scatter_m:.3f} | "
    least = min(row["matched_least"] for row in rows)
    print((line + "{frames:.0f} of {of:.0f} | {least:.0f} |").format(**worst, least=least))


if __name__ == "__main__":
    with one_thread():
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
