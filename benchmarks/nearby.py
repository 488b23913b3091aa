"""What it costs not to be told which landmark was seen: nearest neighbour over known ids, on large maps.

    python benchmarks/nearby.py [--sides 32 100]

A surveyed field of side x side landmarks, 2 m apart; the robot sees the ten nearest at every step.  Median times of a
control and a scan through `Slam.process`, every outcome read, one thread; the ratio is the result.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import kalmark as km
from kalmark.filter.kernels import one_thread
from kalmark.slam.association import Association

STEPS, WARM_UP, SEEN = 400, 100, 10


def step_s(side: int, association: Association) -> tuple[float, int]:
    """Return the median seconds of a step, and how many landmarks were taken for others."""
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2) * 2.0
    points, truth = grid + rng.uniform(-0.5, 0.5, grid.shape), np.array([side, side, 0.0])
    mount, motion = km.Mount(km.sensors.RangeBearing(0.05, 0.01)), km.motion.Odometry2D(0.005, 0.005, 0.002)
    slam = km.Slam([km.Robot("r", motion, start=truth, sensors={"lidar": mount})], association)
    for i, point in enumerate(points):
        slam.add_landmark(i, point + rng.normal(size=2) * 0.1, 0.01 * np.eye(2))
    known = isinstance(association, km.association.ByIdentity)
    times, wrong = [], 0
    for t in range(STEPS):
        u = np.array([0.1, 0.0, 0.05 * np.sin(t / 40)])
        truth = km.geometry.compose(truth, u)[0]
        ids = np.argsort(np.linalg.norm(points - truth[:2], axis=1))[:SEEN].tolist()
        y = km.geometry.observe(truth, points[ids])[0] + rng.normal(size=(SEEN, 2)) * [0.05, 0.01]
        start = time.perf_counter()
        slam.process(km.Control(t, "r", u + rng.normal(size=3) * [0.005, 0.005, 0.002]))
        seen = slam.process(km.Scan(t, "r", "lidar", y, ids if known else None)).observations
        wrong += sum(o.outcome == "associated" and o.landmark != i for o, i in zip(seen, ids, strict=True))
        times.append(time.perf_counter() - start)
    return float(np.median(times[WARM_UP:])), wrong


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sides", type=int, nargs="+", default=[32, 100])
    print("| landmarks | known, us | nearest, us | ratio | wrong |\n|---|---|---|---|---|")
    for side in parser.parse_args().sides:
        known, nearest = (step_s(side, a) for a in (km.association.ByIdentity(), km.association.NearestNeighbour()))
        ratio, wrong = nearest[0] / known[0], f"{nearest[1]} of {STEPS * SEEN}"
        print(f"| {side * side} | {1e6 * known[0]:.0f} | {1e6 * nearest[0]:.0f} | {ratio:.2f} | {wrong} |")


if __name__ == "__main__":
    with one_thread():
        main()
