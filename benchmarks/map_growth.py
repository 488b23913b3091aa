"""Cost of a step as the map grows: whole lawn-mower missions up to 10,000 landmarks, one thread.

    make bench-growth      or      python benchmarks/map_growth.py [--sides 7 32 100] [--out out/map_growth]
    python benchmarks/map_growth.py --pace quick           # that mission alone, in the largest of the fields; or slow

A field of side x side landmarks, 2 m apart, is mowed in lanes 6 m apart by a robot that sees 4 m: a third of what it
sees in a lane it knows from the last one.  The quick robot moves .7 m a step instead of .2 m, in lanes 3 m apart, and
sees 3.2 m: half of what it sees is from the last lane.  Every event goes through `Slam.process`, every outcome is read.
Times are processor time of the thread, so that other work on the machine counts less; the ratios are the result.

ordinary    median step in a place that is known, 10 landmarks in view, after 2,000 steps there: as it comes, with what
            is still active of the way there, and after a full update, with the neighbourhood alone active
amortised   mean step of the whole mission, its compiled code loaded by a small one before
worst       the slowest steps of it
dense       steps of the dense map with as many landmarks, 10 in view; a mission from steps at half and all of the map
adverse     10 m a step over a map that is known, so that all in view is always old and inactive
memory      of the covariance, each landmark pair, measured at 4,000 and 12,000 landmarks and extrapolated
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import scipy
from field import ODOMETRY, SIGHT, STEP_M, Field, Step

import kalmark as km
from kalmark.filter import kernels
from kalmark.filter.compressed.compressed_map import CompressedMap

GIB = 2.0**30
QUICK = {"lane_m": 3.0, "reach_m": 3.2}
QUICK_STEP_M = 0.7
PACES: dict[str, tuple[dict[str, float], float]] = {"slow": ({}, STEP_M), "quick": (QUICK, QUICK_STEP_M)}


def take(slam: km.Slam, steps: Iterable[Step]) -> np.ndarray:
    """Take steps through the public door, reading every outcome; return the milliseconds of each."""
    spent = []
    for control, scan in steps:
        begin = time.thread_time_ns()
        slam.process(control)
        for observation in slam.process(scan).observations:
            assert observation.outcome in ("associated", "new"), observation
        spent.append((time.thread_time_ns() - begin) * 1e-6)
    return np.array(spent)


def mission(field: Field, step_m: float = STEP_M) -> tuple[dict[str, Any], km.Slam]:
    """Return the figures of a mission with the map that Slam chooses, and that map."""
    slam, steps = field.slam(), field.mission(step_m)
    gc.freeze()  # the log made beforehand is none of the collector's business
    wall = time.perf_counter()
    spent = take(slam, steps)
    row = {
        "landmarks": len(field.landmarks),
        "steps": len(spent),
        "seen": float(np.mean([len(scan.y) for _, scan in steps])),
        "map": type(slam.map).__name__,
        "mission_s": spent.sum() * 1e-3,
        "mission_wall_s": time.perf_counter() - wall,
        "amortised_ms": spent.mean(),
        "median_ms": float(np.median(spent)),
        "p99_ms": float(np.quantile(spent, 0.99)),
        "worst_ms": np.sort(spent)[-5:][::-1].tolist(),
        "position_error_m": float(np.linalg.norm(slam.mean("r")[:2] - field.truth[:2])),
    }
    return row, slam


def compressed(side: int) -> tuple[dict[str, Any], Field, km.Slam]:
    """Return the figures of the slow mission and of the place where it ended."""
    field = Field(side, side)
    row, slam = mission(field)
    row["ordinary_us"] = float(np.median(take(slam, field.circle(3000))[-1000:])) * 1e3
    row["settled_us"] = row["ordinary_us"]
    if isinstance(slam.map, CompressedMap):
        row["storage_GiB"] = slam.map.storage.nbytes / GIB
        row["active"] = slam.map.active.n
        slam.map.full_update()
        slam.map.finish()
        row["settled_us"] = float(np.median(take(slam, field.circle(3000))[-1000:])) * 1e3
    return row, field, slam


def dense_step_ms(field: Field, count: int) -> float:
    """Return the median step of a dense map of so many landmarks, known beforehand."""
    slam = field.slam("dense")
    near = np.argsort(np.linalg.norm(field.landmarks - field.truth[:2], axis=1))[:count]
    slam.map.x[:3] = field.truth
    for i in near.tolist():
        slam.add_landmark(i, field.landmarks[i], 0.01 * np.eye(2))
    return float(np.median(take(slam, field.circle(12 if count > 2000 else 300))[2:]))


def memory(count: int, numbers: str) -> dict[str, float]:
    """Return the bytes that the covariance of so many landmarks takes in this process."""

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    field = Field(4, 4)
    lidar = km.Mount(km.sensors.RangeBearing(*SIGHT))
    robot = km.Robot("r", km.motion.Odometry2D(*ODOMETRY), field.start, {"lidar": lidar})
    slam = km.Slam([robot], km.association.ByIdentity("off"), map="postponed", numbers=numbers)
    before = resident()
    for i in range(count):
        slam.add_landmark(i, np.array([i % 100, i // 100], dtype=float), 0.01 * np.eye(2))
    assert isinstance(slam.map, CompressedMap)
    slam.map.full_update()
    slam.map.finish()
    return {"resident": resident() - before, "storage": slam.map.storage.nbytes}


def memory_table() -> dict[str, Any]:
    """Measure each size in a process of its own; extrapolate bytes to 38,000 and 50,000 landmarks."""
    rows = {}
    for numbers, goal in (("float64", 38_000), ("float32", 50_000)):
        measured = {}
        for count in (4_000, 12_000):
            command = [sys.executable, __file__, "--memory", str(count), numbers]
            measured[count] = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        pairs = {count: count * (count + 1) / 2 for count in (*measured, goal)}
        each = {count: one["resident"] / pairs[count] for count, one in measured.items()}
        slope = (measured[12_000]["resident"] - measured[4_000]["resident"]) / (pairs[12_000] - pairs[4_000])
        total = measured[12_000]["resident"] + slope * (pairs[goal] - pairs[12_000])
        update = 16_000 * 2.0 * goal  # bytes a row that a full update may take: filter/compressed/storage.py
        rows[numbers] = {"bytes_per_pair": each, "landmarks": goal, "GiB": total / GIB, "update_GiB": update / GIB}
        said = ", ".join(f"{value:.2f} at {count:,}" for count, value in each.items())
        print(f"  {numbers}: bytes a pair {said}; {goal:,} landmarks take {total / GIB:.1f} GiB,", end=" ")
        print(f"a full update at most {update / GIB:.1f} more")
    return rows


def report(rows: list[dict[str, Any]], adverse: dict[str, float] | None) -> None:
    """Print the table."""
    print(
        "\n| landmarks | steps | mission | amortised | ordinary, updated | worst three | dense step | dense mission |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for r in rows:
        worst = " / ".join(f"{ms:.1f}" for ms in r["worst_ms"][:3])
        print(f"| {r['landmarks']:,} | {r['steps']:,} | {r['mission_s']:.1f} s | {r['amortised_ms']:.3f} ms", end=" ")
        print(f"| {r['ordinary_us']:.0f} us, {r['settled_us']:.0f} us | {worst} ms | {r['dense_ms']:.2f} ms", end=" ")
        print(f"| {r['dense_mission_s']:.1f} s = {r['dense_mission_s'] / r['mission_s']:.1f} x |")
    print()
    for r in rows:
        print(line("slow", r))
        print(line("quick", r["quick"]))
    most, least = rows[-1], rows[0]
    print(f"\nordinary, largest over smallest map: {most['ordinary_us'] / least['ordinary_us']:.2f},", end=" ")
    print(f"after a full update {most['settled_us'] / least['settled_us']:.2f}")
    if adverse:
        print(f"adverse: {adverse['mean_ms']:.1f} ms a step, worst {adverse['worst_ms']:.0f} ms;", end=" ")
        print(f"{adverse['mean_ms'] / rows[-1]['dense_ms']:.2f} times a dense step")


def line(pace: str, r: dict[str, Any]) -> str:
    """Return the figures of a mission in one line."""
    worst = " / ".join(f"{ms:.1f}" for ms in r["worst_ms"][:3])
    return (
        f"{pace}, {r['landmarks']:,} landmarks: {r['mission_s']:.1f} s, wall {r['mission_wall_s']:.1f} s; "
        f"a step median {r['median_ms']:.3f} ms, mean {r['amortised_ms']:.3f} ms, worst {worst} ms"
    )


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw cost against the number of landmarks."""
    n = [r["landmarks"] for r in rows]
    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    curves = {
        "dense": [r["dense_ms"] for r in rows],
        "compressed, worst of a mission": [r["worst_ms"][0] for r in rows],
        "compressed, amortised over a mission": [r["amortised_ms"] for r in rows],
        "compressed, ordinary": [r["ordinary_us"] * 1e-3 for r in rows],
    }
    for name, values in curves.items():
        axes.loglog(n, values, marker="o", label=name)
    axes.set(xlabel="landmarks in the map", ylabel="a step, ms")
    axes.grid(which="both", alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Measure, print, draw and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sides", type=int, nargs="+", default=[7, 32, 100], help="landmarks along a side")
    parser.add_argument("--out", type=Path, default=Path("out/map_growth"))
    parser.add_argument("--pace", choices=PACES, help="only these missions, in the largest field")
    parser.add_argument("--memory", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory:
        print(json.dumps(memory(int(options.memory[0]), options.memory[1])))
        return
    versions = {"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__}
    cpu = next(
        (r.split(":")[1].strip() for r in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in r), ""
    )
    print(f"{cpu}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; {versions}")
    rows: list[dict[str, Any]] = []
    adverse = None
    mpl.use("Agg")
    with kernels.one_thread():
        compressed(10)  # loads the compiled code
        if options.pace:
            lanes, step_m = PACES[options.pace]
            side = max(options.sides)
            print(line(options.pace, mission(Field(side, side, **lanes), step_m)[0]))
            return
        for side in options.sides:
            row, field, slam = compressed(side)
            if side == max(options.sides) and isinstance(slam.map, CompressedMap):
                spent = take(slam, field.rush(60))
                adverse = {"mean_ms": spent[10:].mean(), "worst_ms": spent.max()}
            del slam
            half, whole = (dense_step_ms(field, side * side // k) for k in (2, 1))
            row["dense_ms"], row["dense_mission_s"] = whole, row["steps"] * (4 * half + whole) / 6 * 1e-3
            print(line("slow", row), flush=True)
            row["quick"] = mission(Field(side, side, **QUICK), QUICK_STEP_M)[0]
            print(line("quick", row["quick"]), flush=True)
            rows.append(row)
    report(rows, adverse)
    print("\nmemory of the covariance:")
    options.out.mkdir(parents=True, exist_ok=True)
    saved = {"cpu": cpu, "versions": versions, "missions": rows, "adverse": adverse, "memory": memory_table()}
    (options.out / "map_growth.json").write_text(json.dumps(saved, indent=1))
    draw(rows, options.out / "map_growth.png")
    print(f"saved to {options.out}")


if __name__ == "__main__":
    main()
