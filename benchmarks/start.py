"""Cost of the first step: a new process that imports kalmark and takes one control and two scans.

    python benchmarks/start.py             # or, in turn with a commit or the folder of another checkout:
    python benchmarks/start.py be0e13e     # the cold first step of both, and their ratio

Twice for each kind of run, each in its own process: cold, with an empty cache of compiled code, and warm, with the one
the first has filled.  Wanted: warm below 1 s.  One thread, the interpreter's start included.
On a busy machine the processor's time is the one to compare.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from paired import HERE, checkout

PLANE = """
import kalmark as km
laser = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
slam = km.Slam([km.Robot("r", km.motion.Odometry2D(), sensors={"s": laser})], estimator=km.estimators.ESTIMATOR())
y = [[4.2, 0.3], [5.0, -0.4]]
slam.process(km.Control(0.0, "r", [0.1, 0.0, 0.0]))
slam.process(km.Scan(0.0, "r", "s", y, [1, 2]))
assert all(o.outcome == "associated" for o in slam.process(km.Scan(0.1, "r", "s", y, [1, 2])).observations)
"""
SPACE = """
import numpy as np
import kalmark as km
from kalmark.geometry.rotations import from_euler
at = np.concatenate([np.zeros(3), from_euler(np.radians([-90.0, 0.0, -90.0]))[0]])
camera = km.Mount(km.sensors.PinHole(), at, km.landmarks.AnchoredHomogeneous())
slam = km.Slam([km.Robot("r", km.motion.Odometry3D(), sensors={"s": camera})], estimator=km.estimators.ESTIMATOR())
y = [[300.0, 200.0], [350.0, 260.0], [280.0, 260.0]]
slam.process(km.Control(0.0, "r", [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
slam.process(km.Scan(0.0, "r", "s", y, [1, 2, 3]))
assert all(o.outcome == "associated" for o in slam.process(km.Scan(0.1, "r", "s", y, [1, 2, 3])).observations)
"""


def seconds(program: str, cache: str, place: Path = HERE) -> tuple[float, float]:
    """Return the wall and the processor time of a new process of a checkout, its compiled code in a folder."""
    one_thread = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    start, before = time.perf_counter(), os.times()
    subprocess.run(
        [sys.executable, "-c", program],
        check=True,
        env={**os.environ, **one_thread, "KALMARK_CACHE": cache, "PYTHONPATH": str(place / "src")},
    )
    after = os.times()
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - start, spent


def against(other: Path) -> None:
    """Print the wall time of a cold first step here and in another checkout, and their ratio."""
    for world, program in (("plane", PLANE), ("space, one camera", SPACE)):
        spent = []
        for place in (HERE, other):
            with tempfile.TemporaryDirectory() as cache:
                spent.append(seconds(program.replace("ESTIMATOR", "Invariant"), cache, place)[0])
        print(
            f"{world}, cold: {spent[0]:.1f} s here, {spent[1]:.1f} s there, ratio {spent[0] / spent[1]:.2f}", flush=True
        )


def main() -> None:
    """Measure and print the table.  `Ekf` after `Invariant` finds compiled what both share."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", nargs="?", help="a commit, or the folder of another checkout")
    if other := parser.parse_args().other:
        against(checkout(other))
        return
    print("wall / processor seconds\n\n| first step | cold | warm, best of 5 | files, MB |\n|---|---|---|---|")
    for world, program in (("plane", PLANE), ("space, one camera", SPACE)):
        with tempfile.TemporaryDirectory() as cache:
            for estimator in ("Invariant", "Ekf"):
                text = program.replace("ESTIMATOR", estimator)
                cold, warm = seconds(text, cache), min(seconds(text, cache) for _ in range(5))
                size = [f.stat().st_size for f in Path(cache).rglob("*") if f.is_file()]
                kept = f"{len(size)}, {sum(size) / 1e6:.1f}"
                times = f"{cold[0]:.0f} / {cold[1]:.0f} | {warm[0]:.2f} / {warm[1]:.2f}"
                print(f"| {world}, `{estimator}` | {times} | {kept} |", flush=True)


if __name__ == "__main__":
    main()
