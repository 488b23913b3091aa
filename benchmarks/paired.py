"""A step of this checkout against another one's, in turn within one run: a control and a scan through `Slam.process`.

    python benchmarks/paired.py be0e13e                 # a commit, checked out below out/, or a folder

Ten landmarks in view, known ids, of 50 and of 1,000 in the map.  A line each: the ratio of the medians (this one over
the other), pair by pair, then their median.  Each checkout compiles on its first run, which does not count.
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
SIZES, IN_VIEW, STEPS, PAIRS = (50, 1000), 10, 1500, 5


def step_us(count: int) -> float:
    """Return the median time of a step in a map of so many landmarks, in microseconds."""
    import kalmark as km

    points = np.random.default_rng(0).uniform(-20, 20, (count, 2))
    y = km.geometry.observe(np.zeros(3), points)[0]
    sensors = {"lidar": km.Mount(km.sensors.RangeBearing(0.1, 0.02))}
    slam = km.Slam([km.Robot("rover", motion=km.motion.Unicycle(), sensors=sensors)])
    slam.process(km.Control(0.0, "rover", (0.0, 0.0)))
    for i in range(0, count, IN_VIEW):
        ids = list(range(i, min(count, i + IN_VIEW)))
        slam.process(km.Scan(1e-3 * (i + 1), "rover", "lidar", y[ids], ids))
    spent, ids = [], list(range(IN_VIEW))
    for k in range(STEPS):
        t_s = 10.0 + 0.1 * k
        events = km.Control(t_s, "rover", (0.0, 0.0)), km.Scan(t_s, "rover", "lidar", y[ids], ids)
        begin = time.perf_counter_ns()
        for event in events:
            slam.process(event)
        spent.append(time.perf_counter_ns() - begin)
    return float(np.median(spent[STEPS // 10 :])) / 1e3


def measured(place: Path, count: int) -> float:
    """Return `step_us` of a checkout, in a process of its own."""
    environment = os.environ | {"PYTHONPATH": str(place / "src"), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).resolve()), "--step", str(count)]
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
    options = parser.parse_args()
    if options.step:
        print(step_us(options.step))
        return
    other = checkout(options.other)
    for count in SIZES:
        for place in (HERE, other):
            measured(place, count)
        ratios = [measured(HERE, count) / measured(other, count) for _ in range(PAIRS)]
        pairs = " ".join(f"{ratio:.2f}" for ratio in ratios)
        print(f"{count:>6} landmarks: {pairs}  median {np.median(ratios):.2f}", flush=True)


if __name__ == "__main__":
    main()
