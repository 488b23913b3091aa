"""How far the desk video ends from its start, by a batch solution of its images; and the filter's path against that.

python benchmarks/vision_return.py [SEEDS]

Features (SIFT) of every 10th image and of the last one are paired with those of all others: clearly nearer than the
next feature, within a pixel of an essential matrix.  Poses and points are fitted to them (bundle adjustment, Triggs and
others 2000; GTSAM).  Intrinsics and lens are the filter's, its matches are not used.  The fit starts at the filter's
path, bent so that it ends where it began.  The distance of two cameras fixes the scale.  Printed are, as shares of the
path: the end off the start of filter and batch solution, the difference of the two ends after an alignment of the
scale, and the RMS of the two paths aligned by similarity.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from itertools import combinations
from typing import Any

import cv2
import gtsam
import numpy as np
from scipy.spatial.transform import Rotation
from vision_target import HUBER, place

from kalmark.arrays import Array
from kalmark.config import build_slam, open_run
from kalmark.filter.kernels import one_thread
from kalmark.models.sensors import PinHole
from vision import SEQUENCES, similarity

EVERY, FEATURES, CLEARER, LEAST = 10, 2000, 0.7, 20  # images, features, ratio to the next one, pairs of two images
SIGMA_PX, OFF_PX = 0.4, 3.0  # noise of a feature; off by more in a first solution: left out of the second one


def filtered(seed: int) -> tuple[PinHole, Array, dict[int, Any]]:
    """Return the camera, the filter's poses (N, 7), and the images that are kept, by their numbers."""
    config, log = open_run("visual", None, [*SEQUENCES["desk"], f"robots.each.sensors.camera.detector.seed={seed}"])
    slam = build_slam(config, log)
    (channel,) = slam.state.channels.values()
    path, images = [], {}
    for k, frame in enumerate(log.events):
        image = frame.grey()  # type: ignore[union-attr]
        slam.process(frame)
        path.append(slam.mean(frame.robot)[:7].copy())
        if k % EVERY == 0 or k == len(log.events) - 1:
            images[k] = image
    return channel.sensor, np.array(path), images


def tracks(camera: PinHole, images: list[Any]) -> list[dict[int, Array]]:
    """Return of each feature that several images show the points (2,) on the plane z = 1, by the image's number."""
    sift, matcher, focal = cv2.SIFT_create(FEATURES), cv2.BFMatcher(), camera.fx_px
    points, described = [], []
    for image in images:
        found, bits = sift.detectAndCompute(image, None)
        rays = camera.rays(np.array([one.pt for one in found]))
        points.append(rays[:, :2] / rays[:, 2:])
        described.append(bits)
    of: dict[tuple[int, int], tuple[int, int]] = {}

    def root(a: tuple[int, int]) -> tuple[int, int]:
        while of.setdefault(a, a) != a:
            a = of[a]
        return a

    for i, j in combinations(range(len(images)), 2):
        near = matcher.knnMatch(described[i], described[j], k=2)
        both = np.array([(a.queryIdx, a.trainIdx) for a, b in near if a.distance < CLEARER * b.distance]).reshape(-1, 2)
        if len(both) < LEAST:
            continue
        a, b = points[i][both[:, 0]], points[j][both[:, 1]]
        _, good = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.9999, 1.0 / focal)
        if good is not None and good.sum() >= LEAST:
            for m, n in both[good.ravel() > 0].tolist():
                of[root((i, m))] = root((j, n))
    groups: dict[tuple[int, int], list[tuple[int, int]]] = defaultdict(list)
    for a in list(of):
        groups[root(a)].append(a)
    return [
        {i: points[i][m] for i, m in group}
        for group in groups.values()
        if len({i for i, _ in group}) == len(group)  # else two features of one image were taken for the same
    ]


def solve(seen: list[dict[int, Array]], T: Array, focal: float) -> tuple[Array, list[dict[int, Array]]]:
    """Return the poses (N, 7) that fit these tracks best, from T (N, 7) on, and the tracks without what is far off."""
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    X, L = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    lens, robust = gtsam.Cal3_S2(focal, focal, 0.0, 0.0, 0.0), gtsam.noiseModel.mEstimator.Huber.Create(HUBER)
    noise = gtsam.noiseModel.Robust.Create(robust, gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_PX))
    for k, pose in enumerate(T):
        start.insert(X(k), gtsam.Pose3(gtsam.Rot3(Rotation.from_quat(pose[3:]).as_matrix()), pose[:3]))
    graph.add(gtsam.PriorFactorPose3(X(0), start.atPose3(X(0)), gtsam.noiseModel.Isotropic.Sigma(6, 1e-7)))
    far = int(np.linalg.norm(T[:, :3] - T[0, :3], axis=1).argmax())
    apart = float(np.linalg.norm(T[far, :3] - T[0, :3]))
    graph.add(gtsam.RangeFactorPose3(X(0), X(far), apart, gtsam.noiseModel.Isotropic.Sigma(1, apart / 10)))
    used = []
    for track in seen:
        at = list(track)
        y = np.array([track[k] for k in at])
        x = place(T[at], np.column_stack([y, np.ones(len(y))]))
        if x is not None:
            start.insert(L(len(used)), x)
            for k, point in track.items():
                graph.add(gtsam.GenericProjectionFactorCal3_S2(focal * point, noise, X(k), L(len(used)), lens))
            used.append(track)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    poses = [solved.atPose3(X(k)) for k in range(len(T))]
    fitted = []
    for n, track in enumerate(used):
        off = [poses[k].transformTo(solved.atPoint3(L(n))) for k in track]
        left = [focal * float(np.linalg.norm(o[:2] / o[2] - y)) for o, y in zip(off, track.values(), strict=True)]
        near = {k: y for (k, y), px in zip(track.items(), left, strict=True) if px < OFF_PX}
        fitted += [near] if near else []
    print(f"  {len(used)} points, {sum(map(len, fitted))} observations")
    turns = (Rotation.from_matrix(pose.rotation().matrix()).as_quat() for pose in poses)
    return np.array([np.append(p.translation(), turn) for p, turn in zip(poses, turns, strict=True)]), fitted


def run(seed: int) -> dict[str, float]:
    """Return the figures of one run, shares of the path."""
    camera, path, images = filtered(seed)
    T = path[[*images]]
    seen = tracks(camera, [*images.values()])
    bent = T.copy()
    bent[:, :3] -= np.linspace(0.0, 1.0, len(T))[:, None] * (T[-1, :3] - T[0, :3])
    first, good = solve(seen, bent, camera.fx_px)
    batch = solve(good, first, camera.fx_px)[0][:, :3]
    p, length = T[:, :3], float(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1).sum())
    rms, scale = similarity(batch, p)
    ends = p[-1] - p[0], scale * (batch[-1] - batch[0])
    filter_end, batch_end, difference = (float(np.linalg.norm(end)) / length for end in (*ends, ends[0] - ends[1]))
    return {"filter": filter_end, "batch": batch_end, "difference": difference, "rms": rms / length}


def main(seeds: int) -> None:
    """Print the figures of each seed and the largest."""
    rows = []
    for seed in range(seeds):
        rows.append(run(seed))
        print(f"seed {seed}: " + ", ".join(f"{key} {100 * value:.2f} %" for key, value in rows[-1].items()), flush=True)
    worst = {key: 100 * max(row[key] for row in rows) for key in rows[0]}
    print("| video | end off the start, filter | batch solution | one against the other | RMS of the paths |")
    print("|---|---|---|---|---|")
    print("| desk | {filter:.1f} % | {batch:.1f} % | {difference:.2f} % | {rms:.2f} % |".format(**worst))


if __name__ == "__main__":
    with one_thread():
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
