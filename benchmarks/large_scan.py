"""Cost of a scan of thousands of landmarks: all new, then known by their ids.

    python benchmarks/large_scan.py [--landmarks 3000] [--map postponed] [--estimator invariant]

The corrections fuse such a scan in parts.  The time is a scan's, the least of two of known landmarks; memory is the
largest resident set.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from storm import ESTIMATORS, MAPS
from tables import most_mb

import kalmark as km

SIGMA = np.array([0.05, 0.01])  # m, rad


def main() -> None:
    """Hand three scans of all landmarks to a filter, and print a line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--landmarks", type=int, default=3000)
    parser.add_argument("--map", choices=MAPS, default="postponed")
    parser.add_argument("--estimator", choices=ESTIMATORS, default="invariant")
    asked = parser.parse_args()
    rng, count = np.random.default_rng(0), asked.landmarks
    y = np.column_stack([100.0 * np.sqrt(rng.uniform(1e-4, 1.0, count)), rng.uniform(-np.pi, np.pi, count)])
    robot = km.Robot("rover", km.motion.Odometry2D(0.01, 0.01, 0.005), sensors={"eye": km.Mount(
        km.sensors.RangeBearing(*SIGMA))})  # fmt: skip
    slam, took = km.Slam([robot], estimator=ESTIMATORS[asked.estimator](), map=asked.map), []
    slam.warm_up()
    for t_s in (1.0, 2.0, 3.0):
        seen = np.maximum(y + rng.normal(size=y.shape) * SIGMA, [0.01, -np.inf])
        scan = km.Scan(t_s, "rover", "eye", seen, range(count))
        begin = time.perf_counter()
        slam.process(scan)
        took.append(time.perf_counter() - begin)
    print(f"{count} landmarks: {took[0]:.2f} s new, {min(took[1:]):.2f} s known, {most_mb():.0f} MB")


if __name__ == "__main__":
    main()
