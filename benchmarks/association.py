"""Which association pairs wrongly: scans at a pose that is known to some decimetres and degrees.

    python benchmarks/association.py [--scans 60]

Landmarks on a 2 m grid, jittered by up to .7 m, known to .05 m each; a sensor of positions, sigma .08 m, that sees 8 of
them within 7 m, each with probability .15 not in the map.  Printed for each pose error and association: wrong pairs in
per cent of all that should be made, scans with at least one in per cent, right pairs in per cent, and the milliseconds
of a scan.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import kalmark as km
from kalmark.association import Association

POSES = ((0.2, 3.0), (0.4, 5.0), (1.0, 15.0))  # sigma of the position on each axis, m, and of the heading, deg
SIGHTINGS, UNMAPPED, REACH = 8, 0.15, 7.0
METHODS: dict[str, Association] = {
    "nearest": km.association.NearestNeighbour(),
    "global": km.association.GlobalAssignment(),
    "jcbb": km.association.JointCompatibility(),
    "clique": km.association.Cliques(),
    "sample": km.association.Sampled(),
    "auto": km.association.Automatic(),
}


def scene(
    rng: np.random.Generator, sigmas: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[int]]:
    """Return the estimated pose, the map (L, 2), what is seen (8, 2) and of which landmark, -1 if it is not mapped."""
    grid = np.stack(np.meshgrid(np.arange(-6, 7), np.arange(-6, 7)), -1).reshape(-1, 2) * 2.0
    points = grid + rng.uniform(-0.7, 0.7, grid.shape)
    position, heading = sigmas[0], np.radians(sigmas[1])
    truth = rng.normal(size=3) * [position, position, heading]  # the estimate is the origin
    near = np.flatnonzero(np.linalg.norm(points - truth[:2], axis=1) < REACH)
    seen = rng.choice(near, SIGHTINGS, replace=False)
    mapped = rng.uniform(size=SIGHTINGS) >= UNMAPPED
    y = km.geometry.to_frame(truth, points[seen])[0] + rng.normal(size=(SIGHTINGS, 2)) * 0.08
    known = points + rng.normal(size=points.shape) * 0.05
    known[seen[~mapped]] = np.nan
    return np.zeros(3), known, y, np.where(mapped, seen, -1).tolist()


def trial(method: Association, sigmas: tuple[float, float], scans: int) -> tuple[float, float, float, float]:
    """Return wrong pairs, scans with any, and right pairs, in per cent, and milliseconds of a scan."""
    wrong = bad = pairs = right = 0
    spent = []
    for seed in range(scans):
        start, points, y, seen = scene(np.random.default_rng(seed), sigmas)
        position, heading = sigmas[0], np.radians(sigmas[1])
        mount = km.Mount(km.sensors.Position2D(0.08))
        cov = np.diag([position, position, heading]) ** 2
        robot = km.Robot("r", km.motion.Odometry2D(), start=start, cov=cov, sensors={"s": mount})
        slam = km.Slam([robot], method, map="dense")
        for i, point in enumerate(points):
            if np.isfinite(point).all():
                slam.add_landmark(i, point, 0.05**2 * np.eye(2))
        begin = time.perf_counter()
        report = slam.process(km.Scan(1, "r", "s", y))
        spent.append(time.perf_counter() - begin)
        made = [o.landmark if o.outcome == "associated" else -1 for o in report.observations]
        errors = sum(name not in (-1, i) for name, i in zip(made, seen, strict=True))
        wrong, bad, pairs = wrong + errors, bad + (errors > 0), pairs + sum(i >= 0 for i in seen)
        right += sum(name == i >= 0 for name, i in zip(made, seen, strict=True))
    return 100 * wrong / pairs, 100 * bad / scans, 100 * right / pairs, 1e3 * float(np.median(spent))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=60)
    scans = parser.parse_args().scans
    print("| pose sigma | " + " | ".join(METHODS) + " |\n|---|" + "---|" * len(METHODS))
    for sigmas in POSES:
        cells = (trial(method, sigmas, scans) for method in METHODS.values())
        row = " | ".join(f"{wrong:.1f} / {bad:.0f}, {right:.0f} ({ms:.1f} ms)" for wrong, bad, right, ms in cells)
        print(f"| {sigmas[0]} m, {sigmas[1]:.0f} deg | {row} |")


if __name__ == "__main__":
    main()
