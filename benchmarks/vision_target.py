"""One camera that begins before a known target: its poses against those that PnP of the target gives in each image.

python benchmarks/vision_target.py [SEEDS]            MonoSLAM's sequence, `monoslam`: a row a seed, the worst of them
python benchmarks/vision_target.py batch [SEEDS]      the same against a batch solution; its variations with seed 0

The target is found as a dark quadrangle in a bright frame, its corners as the intersections of lines fitted to its
sides, the pose by PnP of a plane (Collins and Bartoli 2014).  That has two solutions; seen from the front both fit
nearly as well, so the one nearer to the filter's counts.  What such a pose is worth is its scatter: the camera moves
smoothly, so the position must be near the mean of those of the frames before and after.  Where the middle of the target
is in the camera's frame does not depend on the tilt, and is known far better.

The batch solution (bundle adjustment, Triggs and others 2000; GTSAM) has the poses of every 8th frame and the points
of the map.  It fits the filter's matches of points and the corners of the target, whose places alone are held.  The
matches of the filter with the corners are not in it, nor its start, motion and prior of depths.  It says nothing of
errors in what both have: matches, lens, intrinsics and the size of the target.  Residuals of the corners are printed
under the batch solution; under one from which the corners of every other frame were withheld, in those frames; under
PnP of the same image, and under the mean of PnP's poses in the images before and after, each moved by the motion of
the filter between the two frames.  Another solution has free intrinsics, with the lens and the size of the target.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import gtsam
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
EVERY, SIGMA_PX, HUBER = 8, 0.3, 3.0  # of the batch solution: frames, noise of matches and corners, sigmas
LEAST_SEEN, LEAST_PARALLAX, LEAST_M = 6, 1e-3, 0.05  # of a point: frames, least eigenvalue of its information, depth
FOCAL, CORNERS_PX = (0.99, 1.01), 0.05  # variations: factors of the focal length, noise of the corners
FREE = np.array(
    [30.0, 30.0, 1e-6, 30.0, 30.0, 0.1, 0.1, 1e-6, 1e-6]
)  # sigmas of free focal lengths, skew, centre, lens
FREE_M = 2e-3  # and of free corners in the plane of the target
FITTED = (  # what a solution with free intrinsics found, as a lens that the filter has: to .1 px
    "lens=equidistant", "distortion=[-0.01431, -0.03021, 0.02168, -0.00087]",
    "fx_px=194.1", "fy_px=194.16", "cx_px=161.58", "cy_px=124.78",
)  # fmt: skip


class View(NamedTuple):
    """A frame: the filter's pose (7,), its matches (2,) [px], how many were of known landmarks, the corners (4, 2)."""

    T: Array
    matches: dict[Any, Array]
    associated: int
    corners: Array | None


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


def corners(image: Any, camera: PinHole) -> Array | None:
    """Return the pixels (4, 2) of the target's corners, none where it is not found."""
    q = quadrangle(image)
    if q is None:
        return None
    lines = [side(image, camera, a, b) for a, b in pairwise([*q, q[0]])]
    x = [np.linalg.solve([n, m], [c, d]) for (n, c), (m, d) in pairwise([lines[-1], *lines])]
    return camera.expect(np.column_stack([x, np.ones(4)]))[0]


def plane(camera: PinHole, y: Array) -> Array:
    """Return the points (K, 2) on the plane z = 1 that are seen at the pixels y (K, 2)."""
    rays = camera.rays(y)
    return rays[:, :2] / rays[:, 2:]


def poses(y: Array | None, camera: PinHole) -> list[Array]:
    """Return the poses (7,), at most two, from which the target's corners are seen at y (4, 2)."""
    if y is None:
        return []
    _, turns, shifts, errors = cv2.solvePnPGeneric(
        CORNERS, plane(camera, y)[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    found = []
    for turn, shift, error in zip(turns, shifts, errors, strict=True):
        back = Rotation.from_rotvec(turn.ravel()).inv()
        if error[0] * camera.fx_px < FITS_PX:
            found.append(np.append(-back.apply(shift.ravel()), back.as_quat()))
    return found


def nearest(found: list[Array], T: Array) -> Array | None:
    """Return the pose of these whose rotation is nearest to that of T (7,)."""
    return min(found, key=lambda p: angle(p[3:], T[3:]), default=None)


def seen(camera: PinHole, T: Array) -> Array:
    """Return the pixels (4, 2) of the target's corners from the pose T (7,)."""
    return camera.expect(Rotation.from_quat(T[3:]).inv().apply(CORNERS - T[:3]))[0]


def angle(q: Array, p: Array) -> float:
    """Return the angle between two rotations (4,), deg."""
    return float(np.degrees((Rotation.from_quat(q).inv() * Rotation.from_quat(p)).magnitude()))


def views(seed: int, *camera: str) -> tuple[PinHole, list[View]]:
    """Run the filter, with other options of its camera; return this and what each frame gave."""
    options = [f"robots.each.sensors.camera.{option}" for option in (f"detector.seed={seed}", *camera)]
    config, log = open_run("monoslam", None, options)
    slam = build_slam(config, log)
    (channel,) = slam.state.channels.values()
    made = []
    for frame in log.events:
        image = frame.grey()  # type: ignore[union-attr]
        report = slam.process(frame)
        matched = [o for o in report.observations if o.outcome in ("new", "associated")]
        made.append(
            View(
                T=slam.mean(frame.robot)[:7].copy(),
                matches={o.landmark: report.y[o.index].copy() for o in matched},
                associated=sum(o.outcome == "associated" for o in matched),
                corners=corners(image, channel.sensor),
            )
        )
    return channel.sensor, made


def run(seed: int) -> dict[str, float]:
    """Return the figures of one run."""
    camera, frames = views(seed)
    rows, path = [], []
    for view in frames:
        near, T = nearest(poses(view.corners, camera), view.T), view.T
        path.append(np.full(3, np.nan) if near is None else near[:3])
        if near is not None:
            middle = Rotation.from_quat(near[3:]).inv().apply(near[:3]) - Rotation.from_quat(T[3:]).inv().apply(T[:3])
            px = apart(seen(camera, near), seen(camera, T))
            rows.append([np.linalg.norm(near[:3] - T[:3]), angle(near[3:], T[3:]), np.linalg.norm(middle), px])
    p = np.array(path)
    scatter = np.linalg.norm(p[1:-1] - (p[:-2] + p[2:]) / 2, axis=1) / np.sqrt(1.5)  # of the noise of one
    off, turned, middle, px = np.median(rows, axis=0)
    least = min(view.associated for view in frames[1:])  # the first image has the target alone
    return {
        "position_m": off, "angle_deg": turned, "middle_m": middle, "corners_px": px,
        "scatter_m": float(np.nanmedian(scatter)), "frames": len(rows), "of": len(path), "matched_least": least,
    }  # fmt: skip


def apart(y: Array, x: Array) -> float:
    """Return the RMS over points of the distance between pixels (K, 2)."""
    return float(np.sqrt(np.mean(np.sum((y - x) ** 2, axis=1))))


def place(T: Array, rays: Array) -> Array | None:
    """Return the point (3,) nearest to these rays (K, 3) of cameras at T (K, 7), none where they leave it open."""
    turn, p = Rotation.from_quat(T[:, 3:]), T[:, :3]
    r = turn.apply(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    across = np.eye(3) - r[:, :, None] * r[:, None, :]
    if len(T) < LEAST_SEEN or np.linalg.eigvalsh(across.sum(axis=0))[0] < LEAST_PARALLAX:
        return None
    x = np.linalg.solve(across.sum(axis=0), np.einsum("kij,kj->i", across, p))
    return x if turn.inv().apply(x - p)[:, 2].min() > LEAST_M else None


def solve(
    some: list[View], camera: PinHole, corners_px: float = SIGMA_PX, free: bool = False
) -> tuple[Array, dict[str, float]]:
    """Return the poses (N, 7) of these views that fit matches and corners best, these with that noise, and numbers.

    With `free` intrinsics, these and the size of the target are fitted with them: the centre, both focal lengths, and
    what is wrong with the lens, as a polynomial in the square and the fourth power of the radius.
    """
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    X, L, C = (gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L, gtsam.symbol_shorthand.C)
    f = np.array([camera.fx_px, camera.fy_px])
    lens, own = gtsam.Cal3_S2(*f, 0.0, 0.0, 0.0), gtsam.Cal3DS2(*f, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # made straight
    K = gtsam.symbol("K", 0)
    if free:
        start.insert(K, own)
        graph.add(gtsam.PriorFactorCal3DS2(K, own, gtsam.noiseModel.Diagonal.Sigmas(FREE)))
    robust = gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
    of_point, of_corner = (
        gtsam.noiseModel.Robust.Create(robust, gtsam.noiseModel.Isotropic.Sigma(2, px)) for px in (SIGMA_PX, corners_px)
    )

    def add(pose: int, point: int, y: Array, noise: gtsam.noiseModel.Base) -> None:
        straight = plane(camera, y[None])[0] * f
        if free:
            graph.add(gtsam.GeneralSFMFactor2Cal3DS2(straight, noise, pose, point, K))
        else:
            graph.add(gtsam.GenericProjectionFactorCal3_S2(straight, noise, pose, point, lens))

    for k, view in enumerate(some):
        start.insert(X(k), gtsam.Pose3(gtsam.Rot3(Rotation.from_quat(view.T[3:]).as_matrix()), view.T[:3]))
        if view.corners is not None and poses(view.corners, camera):  # else it is no view of the target
            for c, y in enumerate(view.corners):
                add(X(k), C(c), y, of_corner)
    for c, corner in enumerate(CORNERS):
        start.insert(C(c), corner)
        sigmas = np.array([FREE_M, FREE_M, 1e-7]) if free else np.full(3, 1e-7)
        graph.add(gtsam.PriorFactorPoint3(C(c), corner, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    points = sorted({n for view in some for n in view.matches if not str(n).startswith("target")}, key=str)
    for n, name in enumerate(points):
        by = [k for k, view in enumerate(some) if name in view.matches]
        y = np.array([some[k].matches[name] for k in by])
        x = place(np.array([some[k].T for k in by]), camera.rays(y))
        if x is not None:
            start.insert(L(n), x)
            for k, match in zip(by, y, strict=True):
                add(X(k), L(n), match, of_point)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    found = [solved.atPose3(X(k)) for k in range(len(some))]
    T = np.array([np.append(T.translation(), Rotation.from_matrix(T.rotation().matrix()).as_quat()) for T in found])
    left = {"chi2": 2.0 * graph.error(solved)}
    if free:
        numbers, at = solved.atCal3DS2(K).vector(), np.array([solved.atPoint3(C(c)) for c in range(len(CORNERS))])
        left |= dict(zip(("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2"), numbers[[0, 1, 3, 4, 5, 6]], strict=True))
        left["cx_px"], left["cy_px"] = left["cx_px"] + camera.cx_px, left["cy_px"] + camera.cy_px
        left |= dict(zip(("width_mm", "height_mm"), 1e3 * np.ptp(at[:, :2], axis=0), strict=True))
    return T, left


def carry(T: Array, a: Array, b: Array) -> Array:
    """Return the pose T (7,) moved as a camera that goes from a (7,) to b (7,)."""
    at, back = Rotation.from_quat(T[3:]), Rotation.from_quat(a[3:]).inv()
    return np.append(T[:3] + at.apply(back.apply(b[:3] - a[:3])), (at * back * Rotation.from_quat(b[3:])).as_quat())


def against_batch(camera: PinHole, frames: list[View], corners_px: float = SIGMA_PX) -> dict[str, float]:
    """Return medians of filter, batch solution and PnP against each other: m, deg; of the corners' residuals, px."""
    pnp = [nearest(poses(view.corners, camera), view.T) for view in frames]
    at = range(EVERY, len(frames) - 1, EVERY)
    some = [frames[k] for k in at]
    halves = [
        solve(
            [view._replace(corners=None) if k % 2 == half else view for k, view in enumerate(some)], camera, corners_px
        )[0]
        for half in (0, 1)
    ]
    rows = []
    for j, (k, T) in enumerate(zip(at, solve(some, camera, corners_px)[0], strict=True)):
        y, one, before, after = frames[k].corners, pnp[k], pnp[k - 1], pnp[k + 1]
        if y is None or one is None or before is None or after is None:
            continue
        carried = [carry(p, frames[j].T, frames[k].T) for p, j in ((before, k - 1), (after, k + 1))]
        turn = Rotation.from_quat([p[3:] for p in carried]).mean().as_quat()
        between = np.append(np.mean([p[:3] for p in carried], axis=0), turn)
        pairs = ((frames[k].T, one), (frames[k].T, T), (T, one))
        off = [value for a, b in pairs for value in (np.linalg.norm(a[:3] - b[:3]), angle(a[3:], b[3:]))]
        rows.append([*off, *(apart(seen(camera, p), y) for p in (T, halves[j % 2][j], one, between))])
    names = (f"{pair}_{unit}" for pair in ("filter_pnp", "filter_batch", "batch_pnp") for unit in ("m", "deg"))
    px = ("corners_batch_px", "corners_withheld_px", "corners_pnp_px", "corners_neighbours_px")
    return dict(zip((*names, *px), map(float, np.median(rows, axis=0)), strict=True)) | {"frames": len(rows)}


def against_free(camera: PinHole, frames: list[View]) -> dict[str, float]:
    """Return medians of the filter against a batch solution with free intrinsics, m, deg, and what this found.

    `chi2_of_fixed` is its chi-square as a share of that with the intrinsics as they are.
    """
    some = [frames[k] for k in range(EVERY, len(frames) - 1, EVERY)]
    T, left = solve(some, camera, free=True)
    off = [(np.linalg.norm(view.T[:3] - t[:3]), angle(view.T[3:], t[3:])) for view, t in zip(some, T, strict=True)]
    m, deg = map(float, np.median(off, axis=0))
    share = left.pop("chi2") / solve(some, camera)[1]["chi2"]
    return {"filter_batch_m": m, "filter_batch_deg": deg, "chi2_of_fixed": share, **left}


def show(name: str, row: dict[str, float]) -> None:
    """Print a row."""
    print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in row.items()), flush=True)


def main_batch(seeds: int) -> None:
    """Print filter, batch solution and PnP against each other: each seed, their medians, and variations."""
    rows, free = [], []
    for seed in range(seeds):
        camera, frames = views(seed)
        rows.append(against_batch(camera, frames))
        show(f"batch, seed {seed}", rows[-1])
        free.append(against_free(camera, frames))
        show(f"free, seed {seed}", free[-1])
        for scale in FOCAL if seed == 0 else ():
            other = replace(camera, fx_px=scale * camera.fx_px, fy_px=scale * camera.fy_px)
            show(f"batch, seed 0, focal length times {scale}", against_batch(other, frames))
        if seed == 0:
            show(f"batch, seed 0, corners of {CORNERS_PX} px", against_batch(camera, frames, CORNERS_PX))
            show("batch, seed 0, fitted lens", against_batch(*views(seed, *FITTED)))
    for name, some in (("batch", rows), ("free", free)):
        show(f"{name}, median", {key: float(np.median([row[key] for row in some])) for key in some[0]})


def main(seeds: int) -> None:
    """Print the figures of each seed and the worst of them."""
    rows = []
    for seed in range(seeds):
        rows.append(run(seed))
        show(f"seed {seed}", rows[-1])
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
        words = sys.argv[1:]
        if words[:1] == ["batch"]:
            main_batch(int(words[1]) if len(words) > 1 else 3)
        else:
            main(int(words[0]) if words else 5)
