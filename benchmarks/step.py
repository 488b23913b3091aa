"""What one step costs: one control and one scan of 6 known landmarks, in a steady state.

    make bench      or      python benchmarks/step.py [--landmarks 50] [--steps 1000]

Four ways to take the same step of the same log, in turn within one run, one thread: `Slam.process` with every outcome
read; its bare compiled kernels; the textbook filter in NumPy; GTSAM's iSAM2 with the pose's marginal covariance (when
gtsam is installed).  The ratios are the result; the machine's microseconds are for orientation.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import kalmark as km
from kalmark.filter import corrections, kernels
from kalmark.filter.textbook import TextbookSlam
from kalmark.models.motion2d import increment

SIGHTINGS = 6
BLOCK = 25  # steps a way takes in its turn, so that each runs with its own data in the processor's cache
Q, R = np.diag([0.01, 0.02]) ** 2, np.diag([0.1, 0.02]) ** 2
Step = tuple[np.ndarray, np.ndarray, list[int]]


def simulate(count: int, steps: int) -> list[Step]:
    """Return controls, measurements and ids: all landmarks in the first step, then 6 random ones a step."""
    rng, truth = np.random.default_rng(0), np.zeros(3)
    world = rng.uniform(-10, 10, (count, 2))
    log = []
    for t in range(steps + 1):
        u = np.array([0.1, 0.0, 0.05])
        truth = km.geometry.compose(truth, u)[0]
        ids = np.arange(count) if t == 0 else rng.choice(count, SIGHTINGS, replace=False)
        y = km.geometry.observe(truth, world[ids])[0] + rng.normal(size=(len(ids), 2)) * [0.1, 0.02]
        y[:, 0] = np.abs(y[:, 0])
        log.append((u + rng.normal(size=3) * [0.01, 0, 0.02], y, ids.tolist()))
    return log


def new_slam() -> km.Slam:
    """Return the Slam that is timed."""
    lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    return km.Slam([km.Robot("r", km.motion.Odometry2D(0.01, 0.0, 0.02), sensors={"lidar": lidar})])


def by_process(log: list[Step]) -> Callable[[int], None]:
    """Take steps through the public door, reading every outcome; events are made beforehand, as a log has them."""
    slam = new_slam()
    events = [
        (km.Control(t, "r", u), km.Scan(t, "r", "lidar", y, ids)) for t, (u, y, ids) in enumerate(log)
    ]  # fmt: skip

    def step(t: int) -> None:
        control, scan = events[t]
        slam.process(control)
        for observation in slam.process(scan).observations:
            assert observation.outcome != "rejected"

    return step


def by_kernels(log: list[Step]) -> Callable[[int], None]:
    """Call the compiled kernels of the same step, everything about them prepared."""
    slam, first = new_slam(), log[0]
    slam.process(km.Control(0, "r", first[0]))
    slam.process(km.Scan(0, "r", "lidar", first[1], first[2]))
    m, look = slam.map, slam._views["r", "lidar"].looks["point"].view
    N, noise, index = np.diag([0.01, 0, 0.02]) ** 2, np.tile(R, (SIGHTINGS, 1, 1)), m.index(0)
    slots = [np.array([slam.slot(i) for i in ids]) for _, _, ids in log]

    def step(t: int) -> None:
        if t == 0:
            return
        u, y, _ = log[t]
        m.x[:3], F, G = increment(m.x[:3], u)
        kernels.predict(m.P, m.n, index, F, G @ N @ G.T)
        scan = (0, -1, slots[t], 2, y, noise, np.inf)
        corrections.compiled_invariant(look, (m.x, m.P, m.n, m.blocks, m.atoms, m.axes), scan, 6)

    return step


def by_textbook(log: list[Step]) -> Callable[[int], None]:
    """Run the guide's filter as printed, dense NumPy, landmark by landmark."""
    book, number = TextbookSlam(np.zeros(3), Q, R), {}

    def step(t: int) -> None:
        u, y, ids = log[t]
        book.predict(u[[0, 2]])
        for one, i in zip(y, ids, strict=True):
            if i in number:
                book.correct(number[i], one)
            else:
                number[i] = book.initialize(one)

    return step


def by_isam2(log: list[Step]) -> Callable[[int], None]:
    """Run GTSAM's iSAM2 on the same numbers: update, the pose's estimate and its marginal covariance."""
    import gtsam
    from gtsam.symbol_shorthand import L, X

    motion = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01, 1e-4, 0.02]))
    sight = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.02, 0.1]))  # bearing first
    isam, known = gtsam.ISAM2(), set()
    pose = gtsam.Pose2(0, 0, 0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(X(0), pose, gtsam.noiseModel.Constrained.All(3)))
    values.insert(X(0), pose)
    isam.update(graph, values)

    def step(t: int) -> None:
        nonlocal pose
        u, y, ids = log[t]
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        moved = gtsam.Pose2(*u)
        graph.add(gtsam.BetweenFactorPose2(X(t), X(t + 1), moved, motion))
        pose = pose.compose(moved)
        values.insert(X(t + 1), pose)
        for (r, b), i in zip(y, ids, strict=True):
            graph.add(gtsam.BearingRangeFactor2D(X(t + 1), L(i), gtsam.Rot2(b), r, sight))
            if i not in known:
                known.add(i)
                values.insert(L(i), pose.transformFrom(gtsam.Point2(r * np.cos(b), r * np.sin(b))))
        isam.update(graph, values)
        pose = isam.calculateEstimatePose2(X(t + 1))
        isam.marginalCovariance(X(t + 1))

    return step


def measure(count: int, steps: int) -> dict[str, np.ndarray]:
    """Return the microseconds of each step, the ways taking turns block by block; the first 100 steps are warm-up."""
    log = simulate(count, steps)
    ways: dict[str, Callable[[list[Step]], Callable[[int], None]]] = {
        "Slam.process": by_process,
        "compiled kernels": by_kernels,
        "textbook NumPy": by_textbook,
    }
    try:
        import gtsam  # noqa: F401

        ways["GTSAM iSAM2"] = by_isam2
    except ImportError:
        print("gtsam is not installed: iSAM2 is left out", file=sys.stderr)
    takers = {name: make(log) for name, make in ways.items()}
    spent: dict[str, list[float]] = {name: [] for name in ways}
    for block in range(0, len(log), BLOCK):
        for name, take in takers.items():
            for t in range(block, min(block + BLOCK, len(log))):
                start = time.perf_counter_ns()
                take(t)
                spent[name].append((time.perf_counter_ns() - start) * 1e-3)
    return {name: np.array(values[101:]) for name, values in spent.items()}


def table(spent: dict[str, np.ndarray], count: int) -> dict[str, Any]:
    """Print and return medians and ratios to `Slam.process`."""
    ours = np.median(spent["Slam.process"])
    kernel = np.median(spent["compiled kernels"])
    print(f"\n{count} landmarks, {SIGHTINGS} seen a step   median us   99 %   times Slam.process   times kernels")
    rows = {}
    for name, values in spent.items():
        median = float(np.median(values))
        rows[name] = {"median_us": median, "p99_us": float(np.quantile(values, 0.99)), "ratio": median / ours}
        print(f"  {name:<28}{median:>12.1f}{rows[name]['p99_us']:>9.0f}{median / ours:>17.2f}{median / kernel:>18.2f}")
    return rows


def main() -> None:
    """Measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--landmarks", type=int, nargs="+", default=[50])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=Path("out/bench_step.json"))
    options = parser.parse_args()
    with kernels.one_thread():
        rows = {str(n): table(measure(n, options.steps), n) for n in options.landmarks}
    versions = {"python": platform.python_version(), "numpy": np.__version__, "cpu": platform.processor()}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"versions": versions, "cores": os.cpu_count(), "landmarks": rows}, indent=1))
    print(f"\nsaved to {options.out}")


if __name__ == "__main__":
    main()
