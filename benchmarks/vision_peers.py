"""Other programs that a user would take: visual odometry of OpenCV's parts, and SVO, on the frames that kalmark reads.

    python benchmarks/vision_peers.py visual/tum_fr1_xyz [--set log.fps=30 ...] [--svo PYTHON] [--every 1]

`klt`: corners (Shi-Tomasi) tracked by pyramidal Lucas-Kanade, forwards and back; a start from the essential matrix
(RANSAC) once the tracks have moved by 20 px; then each pose by PnP (RANSAC, refined), new points triangulated from
their first view once their rays differ by 2 deg.  It keeps no map: what leaves the view is forgotten.  OpenCV's
tutorials put these parts together so.  `svo`: SVO (Forster and others, 2014) of the package svo-cpp, in an interpreter
of its own that has it, on undistorted images; three times, as its threads make each run another.

Each line: RMSE of the positions after a similarity alignment to the truth, over the frames that were tracked; their
share; the scale of the first half of the path over that of the second; processor time of a frame on one core.  Reading
images is not timed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from kalmark.config import open_run
from kalmark.config.sections import model_of
from kalmark.events import Frame
from kalmark.geometry.frames3d import compose
from kalmark.geometry.named_poses import pose_of

CORNERS, SPACING_PX, LEAST = 300, 10, 12  # points that are tracked, the distance between them, inliers of a pose
MOVED_PX, ANGLE_RAD, REPROJECTED_PX = 20.0, np.radians(2.0), 2.0
LUCAS_KANADE = {"winSize": (15, 15), "maxLevel": 3}


class Sequence(NamedTuple):
    """Frames of one camera, the true positions (N, 3) of the camera, NaN where unknown, and the camera's model."""

    name: str
    images: list[Any]
    t_s: Any
    truth: Any
    camera: Any


def sequence(path: str, overrides: list[str], every: int) -> Sequence:
    """Return the frames of a configuration or of a log that describes its camera."""
    config, log = open_run(path, None, overrides)
    frames = [event for event in log if isinstance(event, Frame)][::every]
    (name, section), *_ = config.robots[next(iter(config.robots))].sensors.items()
    frames = [frame for frame in frames if frame.sensor == name]
    camera, mount = model_of(section), np.array(pose_of(section.mount))
    camera.invert(np.zeros((1, 2)))  # compiled before anything is timed
    t_ns = np.array([frame.t_ns for frame in frames])
    truth = np.full((len(frames), 3), np.nan)
    if log.truth:
        poses = next(iter(log.truth.values())).at(t_ns)
        truth = np.array([compose(pose, mount)[0][:3] if np.isfinite(pose).all() else pose[:3] for pose in poses])
    return Sequence(log.name, [frame.grey() for frame in frames], t_ns * 1e-9, truth, camera)


class Klt:
    """Visual odometry by tracked corners; `step` returns the camera's pose (3, 4), local to global, or None."""

    def __init__(self, camera: Any) -> None:
        self.camera, self.focal = camera, float(camera.fx_px)
        self.image: Any = None
        self.y = np.zeros((0, 2), np.float32)  # where the points are now
        self.rays = np.zeros((0, 3))  # first seen along these, from the camera `first` (n, 3, 4)
        self.first = np.zeros((0, 3, 4))
        self.points = np.zeros((0, 3))  # NaN until triangulated
        self.begun_at = np.zeros((0, 2))  # pixels of the first view
        self.pose: Any = None
        self.last = np.eye(3, 4)

    def step(self, image: Any) -> Any:
        """Take the next image (H, W)."""
        if self.image is not None and len(self.y):
            self.track(image)
        self.image = image
        if self.pose is None:
            self.start()
        else:
            self.locate()
        if self.pose is not None:
            self.last = self.pose
            self.triangulate()
        self.refill()
        return self.pose

    def keep(self, kept: Any) -> None:
        """Keep some of the points."""
        for name in ("y", "rays", "first", "points", "begun_at"):
            setattr(self, name, getattr(self, name)[kept])

    def track(self, image: Any) -> None:
        """Follow the points into the next image, and back."""
        y, found, _ = cv2.calcOpticalFlowPyrLK(self.image, image, self.y, None, **LUCAS_KANADE)
        back, there, _ = cv2.calcOpticalFlowPyrLK(image, self.image, y, None, **LUCAS_KANADE)
        inside = ((y >= 0) & (y < np.array(image.shape[::-1]))).all(axis=1)
        good = (found.ravel() == 1) & (there.ravel() == 1) & (np.linalg.norm(back - self.y, axis=1) < 0.5) & inside
        self.y = y
        self.keep(good)

    def plane(self) -> Any:
        """Return the points on the plane z = 1 (n, 2), without the lens."""
        rays = self.camera.invert(self.y.astype(np.float64))[0]
        return rays[:, :2] / rays[:, 2:]

    def start(self) -> None:
        """Begin, or begin again, once the points have moved enough, from the essential matrix."""
        moved = np.linalg.norm(self.y - self.begun_at, axis=1)
        if len(self.y) < LEAST or np.median(moved) < MOVED_PX:
            return
        a, b = self.rays[:, :2] / self.rays[:, 2:], self.plane()
        E, mask = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.999, 1.0 / self.focal)
        if E is None or E.shape != (3, 3):
            return
        count, R, t, mask = cv2.recoverPose(E, a, b, np.eye(3), mask=mask)
        if count < LEAST:
            return
        self.keep(mask.ravel() > 0)
        origin = self.last  # the camera where it was lost
        self.first = np.tile(origin, (len(self.y), 1, 1))
        relative = np.column_stack([R.T, -R.T @ t])
        self.pose = np.column_stack([origin[:, :3] @ relative[:, :3], origin[:, :3] @ relative[:, 3] + origin[:, 3]])

    def locate(self) -> None:
        """Find the pose by the triangulated points; without enough of them begin again."""
        known = np.flatnonzero(np.isfinite(self.points[:, 0]))
        found, inliers = False, None
        if len(known) >= LEAST:
            found, r, t, inliers = cv2.solvePnPRansac(
                self.points[known], self.plane()[known], np.eye(3), None, reprojectionError=REPROJECTED_PX / self.focal,
                iterationsCount=200, confidence=0.999, flags=cv2.SOLVEPNP_EPNP,
            )  # fmt: skip
        if not found or inliers is None or len(inliers) < LEAST:
            self.pose = None
            self.keep(np.zeros(len(self.y), bool))
            return
        rows = known[inliers.ravel()]
        r, t = cv2.solvePnPRefineLM(self.points[rows], self.plane()[rows], np.eye(3), None, r, t)
        R = cv2.Rodrigues(r)[0]
        self.pose = np.column_stack([R.T, (-R.T @ t).ravel()])
        self.keep(~np.isin(np.arange(len(self.y)), np.setdiff1d(known, rows)))

    def triangulate(self) -> None:
        """Place points whose rays differ enough, at the middle between their rays."""
        rays = np.column_stack([self.plane(), np.ones(len(self.y))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        now = rays @ self.pose[:, :3].T
        before = np.einsum("nij,nj->ni", self.first[:, :, :3], self.rays)
        cosine = np.clip(np.einsum("ni,ni->n", now, before), -1, 1)
        new = np.flatnonzero(np.isnan(self.points[:, 0]) & (np.arccos(cosine) > ANGLE_RAD))
        between = self.pose[:, 3] - self.first[new, :, 3]
        c, a, b = cosine[new], np.einsum("ni,ni->n", between, before[new]), np.einsum("ni,ni->n", between, now[new])
        s, t = (a - c * b) / (1 - c * c), (c * a - b) / (1 - c * c)
        good = (s > 0) & (t > 0)
        p = self.first[new, :, 3] + s[:, None] * before[new]
        q = self.pose[:, 3] + t[:, None] * now[new]
        good &= np.linalg.norm(p - q, axis=1) < REPROJECTED_PX / self.focal * np.minimum(s, t)
        self.points[new[good]] = 0.5 * (p + q)[good]

    def refill(self) -> None:
        """Add corners where there are no points."""
        begins = self.pose is None
        if begins and len(self.y) >= CORNERS // 3:
            return
        mask = np.full(self.image.shape, 255, np.uint8)
        for u, v in np.rint(self.y).astype(int).tolist():
            cv2.circle(mask, (u, v), SPACING_PX, 0, -1)
        new = cv2.goodFeaturesToTrack(self.image, CORNERS - len(self.y), 0.01, SPACING_PX, mask=mask)
        if len(self.y) >= CORNERS or new is None:
            return
        if begins and len(self.y):  # tracks of one start have one first view
            self.keep(np.zeros(len(self.y), bool))
        y = new.reshape(-1, 2)
        self.y = np.concatenate([self.y, y]).astype(np.float32)
        self.begun_at = np.concatenate([self.begun_at, y])
        self.rays = np.concatenate([self.rays, self.camera.invert(y.astype(np.float64))[0]])
        self.first = np.concatenate([self.first, np.tile(self.last, (len(y), 1, 1))])
        self.points = np.concatenate([self.points, np.full((len(y), 3), np.nan)])


def klt(given: Sequence) -> tuple[Any, float]:
    """Return positions (N, 3), NaN where not tracked, and the time of a frame [ms]."""
    cv2.setRNGSeed(0)
    odometry, begin = Klt(given.camera), time.process_time()
    poses = [odometry.step(image) for image in given.images]
    spent = time.process_time() - begin
    return np.array([np.full(3, np.nan) if pose is None else pose[:, 3] for pose in poses]), 1e3 * spent / len(poses)


SVO = """
import json, sys, time, numpy as np, svo_cpp
given = np.load(sys.argv[1])
k, images, t_s = given["k"], given["images"], given["t_s"]
svo_cpp.set_svo_config({"grid_size": 15, "init_min_disparity": 15.0, "quality_min_fts": 20, "max_fts": 200,
                        "init_min_tracked": 40, "init_min_inliers": 30})  # for small images
svo = svo_cpp.SVO(svo_cpp.PinholeCamera(float(images.shape[2]), float(images.shape[1]), *map(float, k)))
places, spent = [], 0.0
for image, t in zip(images, t_s):
    begin = time.process_time()
    if svo.stage() == svo_cpp.Stage.PAUSED:  # at first, and where its start failed
        svo.start()
    svo.addImage(np.ascontiguousarray(image), float(t))
    spent += time.process_time() - begin
    tracked = svo.stage() == svo_cpp.Stage.DEFAULT_FRAME
    T = svo.lastFrame().T_f_w.inverse() if tracked else None
    places.append(np.ravel(T.translation()).tolist() if tracked else [float("nan")] * 3)
print("RESULT" + json.dumps({"places": places, "ms": 1e3 * spent / len(images)}))
"""


def svo(given: Sequence, python: str) -> tuple[Any, float]:
    """Return positions (N, 3), NaN where not tracked, and the time of a frame [ms], of SVO."""
    camera = given.camera
    k = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px])
    height, width = given.images[0].shape
    v, u = np.mgrid[:height, :width]
    ideal = np.column_stack([(u.ravel() - k[2]) / k[0], (v.ravel() - k[3]) / k[1], np.ones(u.size)])
    maps = camera.expect(ideal)[0].astype(np.float32).reshape(height, width, 2)
    images = np.array([cv2.remap(image, maps, None, cv2.INTER_LINEAR) for image in given.images])
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder, "given.npz"), k=k, images=images, t_s=given.t_s - given.t_s[0])
        command = [python, "-c", SVO, str(Path(folder, "given.npz"))]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    line = next((line for line in done.stdout.splitlines() if line.startswith("RESULT")), None)
    if line is None:
        raise SystemExit(f"svo: {(done.stderr or done.stdout)[-500:]}")
    found = json.loads(line.removeprefix("RESULT"))
    return np.array(found["places"], dtype=np.float64), found["ms"]


def similarity(p: Any, q: Any) -> tuple[float, Any, Any]:
    """Return scale, rotation (3, 3) and shift (3,) that bring p (N, 3) nearest to q (N, 3).  Umeyama 1991."""
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    U, d, Vt = np.linalg.svd(b.T @ a)
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ S @ Vt
    scale = float(np.trace(np.diag(d) @ S) / np.sum(a * a))
    return scale, R, q.mean(axis=0) - scale * R @ p.mean(axis=0)


def scored(places: Any, truth: Any) -> str:
    """Return the figures of a path (N, 3) against the true one."""
    known, there = np.isfinite(truth[:, 0]), np.isfinite(places[:, 0])
    both = known & there
    if both.sum() < 3:
        return f"{'-':>9} {100 * there.mean():8.1f} {'-':>7}"
    scale, R, t = similarity(places[both], truth[both])
    error = np.sqrt(np.mean(np.sum((scale * places[both] @ R.T + t - truth[both]) ** 2, axis=1)))
    halves = np.array_split(np.flatnonzero(both), 2)
    drift = "-"
    if min(map(len, halves)) >= 3:
        first, second = (similarity(places[half], truth[half])[0] for half in halves)
        drift = f"{first / second:.3f}"
    return f"{100 * error:9.2f} {100 * there.mean():8.1f} {drift:>7}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--svo", metavar="PYTHON", help="an interpreter that has svo-cpp")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    found = sequence(given.log, given.overrides, given.every)
    print(f"{found.name}: {len(found.images)} frames\n{'':8} {'ATE cm':>9} {'frames %':>8} {'scale':>7} {'ms':>7}")
    ways = {"klt": klt} | {f"svo {n}": partial(svo, python=given.svo) for n in range(3 if given.svo else 0)}
    for name, way in ways.items():
        places, ms = way(found)
        print(f"{name:8} {scored(places, found.truth)} {ms:7.2f}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
