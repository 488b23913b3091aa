"""A step of this checkout against another one's, in turn within one run: a control and a scan through `Slam.process`.

    python benchmarks/paired.py be0e13e                 # a commit, checked out below out/, or a folder

Ten landmarks in view, the same from scan to scan, known ids, measured with noise by a robot that moves, of 50, 100 and
1,000 in the map; then the same with the covariances that users send with each control and scan.  A line each: the ratio
of the medians (this one over the other), pair by pair, then their median.  Each checkout compiles on its first run,
which does not count.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parents[1]
SIZES, IN_VIEW, STEPS, PAIRS = (50, 100, 1000), 10, 1500, 5
SIGHT, ODOMETRY, MOVE = (0.1, 0.02), (0.01, 0.01), (0.05, 0.02)


def step_us(count: int, with_cov: bool) -> float:
    """Return the median time of a step in a map of so many landmarks, in microseconds."""
    import kalmark as km

    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 20, (count, 2))
    motion, lidar = km.motion.Unicycle(*ODOMETRY), km.Mount(km.sensors.RangeBearing(*SIGHT))
    slam, pose = km.Slam([km.Robot("rover", motion=motion, sensors={"lidar": lidar})]), np.zeros(3)

    def scan(t_s: float, ids: list[int]) -> km.Scan:
        y = km.geometry.observe(pose, points[ids])[0] + rng.normal(size=(len(ids), 2)) * SIGHT
        y[:, 0] = np.abs(y[:, 0])
        return km.Scan(
            t_s, "rover", "lidar", y, ids, np.tile(np.diag(SIGHT) ** 2, (len(ids), 1, 1)) if with_cov else None
        )

    slam.process(km.Control(0.0, "rover", (0.0, 0.0)))
    for i in range(0, count, IN_VIEW):
        slam.process(scan(1e-3 * (i + 1), list(range(i, min(count, i + IN_VIEW)))))
    spent, ids, cov = [], list(range(IN_VIEW)), np.diag(ODOMETRY) ** 2 if with_cov else None
    for k in range(STEPS):
        t_s = 10.0 + 0.1 * k
        u = MOVE + rng.normal(size=2) * ODOMETRY
        control = km.Control(t_s, "rover", u, cov)
        pose = km.geometry.compose(pose, np.array([0.1 * MOVE[0], 0.0, 0.1 * MOVE[1]]))[0]
        events = control, scan(t_s + 0.1, ids)
        begin = time.thread_time_ns()
        for event in events:
            slam.process(event)
        spent.append(time.thread_time_ns() - begin)
    return float(np.median(spent[STEPS // 10 :])) / 1e3


def measured(place: Path, count: int, with_cov: bool) -> float:
    """Return `step_us` of a checkout, in a process of its own."""
    environment = os.environ | {"PYTHONPATH": str(place / "src"), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).resolve()), "--step", str(count), *["--cov"] * with_cov]
    return float(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)


def checkout(name: str) -> Path:
    """Return a folder with another checkout: that folder, or a commit checked out below out/."""
    folder = Path(name)
    if not folder.is_dir():
        folder = HERE / "out" / "checkouts" / name
        if not folder.is_dir():
            subprocess.run(["git", "worktree", "add", "--force", "--detach", str(folder), name], cwd=HERE, check=True)
    return folder.resolve()


def main() -> None:
    """Print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", nargs="?", help="a commit, or the folder of another checkout")
    parser.add_argument("--step", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--cov", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.step:
        print(step_us(options.step, options.cov))
        return
    other = checkout(options.other)
    for with_cov in (False, True):
        for count in SIZES:
            for place in (HERE, other):
                measured(place, count, with_cov)
            ratios = [measured(HERE, count, with_cov) / measured(other, count, with_cov) for _ in range(PAIRS)]
            pairs, how = " ".join(f"{ratio:.2f}" for ratio in ratios), " with cov" * with_cov
            print(f"{count:>6} landmarks{how}: {pairs}  median {np.median(ratios):.2f}", flush=True)


if __name__ == "__main__":
    main()
