"""Cost of one step, in ways that others take: one log, maps of 50 to 10,000 landmarks, ratios within one run.

    make bench-peers      or      python benchmarks/peers.py [--landmarks 50 100 200 1000 10000] [--out out/peers]

A field of landmarks, 2 m apart, is mowed in lanes by a robot that sees 4 m; then it drives round a circle of 3 m radius
in the last lane and sees the 10 nearest landmarks at each step, all of them known by their ids: these steps are timed,
the ways taking turns.  The map is made once by kalmark; the dense filters start from its mean and covariance, iSAM2
from its log in few large updates with kalmark's estimates as initial values.  Times are processor time on one core with
one thread.

A way whose step takes more than a second is dropped; so is a dense filter whose step would, its cost growing at least
with the square of the landmarks, and any whose covariance would have more than 4,000 landmarks.  A way that has spent
10 s takes no further steps.
"""

from __future__ import annotations

import argparse
import gc
import json
import subprocess
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from field import Field, Step
from ways import (
    Floor,
    Isam2,
    Known,
    Mrpt,
    Process,
    Textbook,
    TextbookFull,
    TextbookSparse,
    Way,
    conditions,
    in_turns,
    pin,
)

from kalmark.filter import kernels

SHAPES = {50: (10, 5), 100: (10, 10), 200: (20, 10), 1000: (40, 25), 10_000: (100, 100)}  # columns, rows
MAPPING_STEP_M, RADIUS_M, CIRCLE_STEP_M = 0.5, 3.0, 0.2
WARM_UP, MOST_S = 200, 10.0  # one round; seconds a way may take
OURS, ISAM2 = "kalmark, Slam.process", "GTSAM iSAM2, update and marginals"
WAYS: dict[str, Callable[[Known], Way]] = {
    OURS: Process,
    "kalmark, dense map": partial(Process, map_="dense"),
    "textbook, sparse products, NumPy": TextbookSparse,
    "textbook as printed, NumPy": Textbook,
    "textbook with (I - K H) P, NumPy": TextbookFull,
    ISAM2: Isam2,
    "MRPT kf-slam, number by number": partial(Mrpt, method="davison"),
    "MRPT kf-slam, its default": partial(Mrpt, method="naive"),
}
DENSE = set(WAYS) - {OURS, ISAM2}
MOST_DENSE = 4000  # landmarks that a dense covariance is made of: 10,000 take 3 GiB and an hour to map
DEMANDS = {100: 10, 1000: 20, 10_000: 3}  # times faster than iSAM2
Row = dict[str, Any]


def field_of(count: int) -> Field:
    """Return a field of so many landmarks."""
    return Field(*SHAPES.get(count, (max(1, round(count**0.5)), round(count / max(1, round(count**0.5))))))


def known_and_steps(count: int, steps: int, view: int) -> tuple[Known, list[Step], Field]:
    """Return a map made by mowing the field and the steps to be timed."""
    field = field_of(count)
    known = Known.by_mapping(field.start, field.mission(MAPPING_STEP_M) + field.back(MAPPING_STEP_M))
    inwards = -RADIUS_M if np.cos(field.truth[2]) > 0 else RADIUS_M  # the last lane is at the upper edge
    return known, field.circle(steps, CIRCLE_STEP_M, inwards, view), field


def ready(known: Known, probe: list[Step], before: dict[str, Row], count: int) -> tuple[dict[str, Way], dict[str, Row]]:
    """Return the ways that can take a step in a second, after two steps, and why the others are dropped."""
    ways, dropped = {}, {}
    for name, make in WAYS.items():
        last = before.get(name, {})
        least = last.get("step_s", 0.0) * (count / last.get("landmarks", count)) ** 2 if name in DENSE else 0.0
        if "missing" in last:
            dropped[name] = {"missing": last["missing"]}
        elif name in DENSE and not last and count > MOST_DENSE:
            dropped[name] = {"dropped": "not tried"}
        elif least > 1 or (name in DENSE and count > MOST_DENSE):
            dropped[name] = {"dropped": f"over {least:.1f} s a step", "step_s": least, "landmarks": count}
        else:
            begin = time.perf_counter()
            try:
                way = make(known)
            except (ImportError, OSError, subprocess.CalledProcessError) as error:
                dropped[name] = {"missing": f"not installed ({type(error).__name__})"}
                continue
            step_s = min(way.take(probe[:1])[0], way.take(probe[1:2])[0]) * 1e-6
            if step_s > 1:
                dropped[name] = {"dropped": f"{step_s:.1f} s a step", "step_s": step_s, "landmarks": count}
            else:
                ways[name] = way
            print(f"  {name}: ready after {time.perf_counter() - begin:.0f} s", flush=True)
    return ways, dropped


def measure(count: int, steps: int, before: dict[str, Row]) -> dict[str, Row]:
    """Return what a step costs in each way with so many landmarks."""
    begin = time.perf_counter()
    known, log, field = known_and_steps(count, steps + WARM_UP, 10)
    seen = [len(scan.y) for _, scan in known.log]
    print(
        f"\n{len(field.landmarks):,} landmarks, {type(known.slam.map).__name__}, {len(known.log):,} steps to map them"
        f" ({np.mean(seen):.1f} seen in each), {time.perf_counter() - begin:.0f} s",
        flush=True,
    )
    gc.freeze()  # the logs are none of the collector's business
    ways, rows = ready(known, log[:2], before, count)
    spent = in_turns(ways, log[2:], most_s=MOST_S)
    ours = float(np.median(timed(spent[OURS])))
    for name, values in ((name, timed(all_)) for name, all_ in spent.items()):
        rows[name] = {
            "landmarks": count,
            "steps": len(values),
            "median_us": float(np.median(values)),
            "mean_us": float(values.mean()),
            "p99_us": float(np.quantile(values, 0.99)),
            "ratio": float(np.median(values)) / ours,
            "step_s": float(np.median(values)) * 1e-6,
        }
        if len(values) == steps:  # it is where the robot is
            rows[name]["position_error_m"] = float(np.linalg.norm(ways[name].pose()[:2] - field.truth[:2]))
    table(rows)
    return rows


def medians(runs: list[dict[str, Row]]) -> dict[str, Row]:
    """Return the rows of the last run with the medians of the ratios of all."""
    for name, last in runs[-1].items():
        if "ratio" in last:
            last["ratio"] = float(np.median([run[name]["ratio"] for run in runs if "ratio" in run[name]]))
    return runs[-1]


def timed(spent: Any) -> Any:
    """Leave out the warm-up: a round less the two of the probe, or half of what a slow way has taken."""
    return spent[min(WARM_UP - 2, len(spent) // 2) :]


def table(rows: dict[str, Row]) -> None:
    """Print the rows of one map."""
    print(f"  {'':<36}{'times':>8}{'median us':>12}{'mean us':>12}{'99 % us':>12}{'steps':>7}   error")
    for name in WAYS:
        row = rows[name]
        if "median_us" not in row:
            print(f"  {name:<36}{row.get('missing') or 'dropped: ' + row['dropped']}")
            continue
        figures = f"{row['ratio']:>8.1f}{row['median_us']:>12.1f}{row['mean_us']:>12.1f}{row['p99_us']:>12.1f}"
        error = f"{row['position_error_m']:.2f} m" if "position_error_m" in row else ""
        print(f"  {name:<36}{figures}{row['steps']:>7}   {error}", flush=True)


def dense_floor(steps: int) -> Row:
    """Return a dense step at 1,000 landmarks with 6 observations over the bare update of its covariance."""
    known, log, _ = known_and_steps(1000, steps + WARM_UP, 6)
    spent = in_turns({"step": Process(known, "dense"), "floor": Floor(known)}, log)
    step, floor = (float(np.median(timed(spent[name]))) for name in ("step", "floor"))
    return {"step_us": step, "floor_us": floor, "ratio": step / floor}


def summary(found: dict[int, dict[str, Row]]) -> None:
    """Print all maps in one table, and what was wanted."""
    print(f"\n| times {OURS} (its median) | " + " | ".join(f"{count:,}" for count in found) + " |")
    print("|---|" + "---|" * len(found))
    for name in WAYS:
        cells = []
        for rows in found.values():
            row = rows[name]
            if "median_us" not in row:
                cells.append(row.get("missing") or f"dropped: {row['dropped']}")
            else:
                cells.append(f"{row['median_us']:.0f} us" if name == OURS else f"{row['ratio']:.1f}")
        print(f"| {name} | " + " | ".join(cells) + " |")
    print()
    for count, wanted in DEMANDS.items():
        ratio = found.get(count, {}).get(ISAM2, {}).get("ratio")
        if ratio:
            print(f"{count:,} landmarks: {ratio:.1f} times faster than iSAM2 with marginals, wanted {wanted}")


def draw(found: dict[int, dict[str, Row]], path: Path) -> None:
    """Draw the median step against the number of landmarks."""
    figure, axes = plt.subplots(figsize=(8.6, 4.8), layout="constrained")
    for name in WAYS:
        points = [(count, rows[name]["median_us"]) for count, rows in found.items() if "median_us" in rows[name]]
        if points:
            axes.loglog(*np.transpose(points), marker="o", linewidth=2.5 if name == OURS else 1.2, label=name)
    axes.set(xlabel="landmarks in the map", ylabel="median step, us", title="One step, 10 known landmarks in view")
    axes.grid(which="both", alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=120)


def main() -> None:
    """Measure, print, draw and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--landmarks", type=int, nargs="+", default=list(SHAPES))
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--runs", type=int, default=1, help="of each map: the summary has the medians of their ratios")
    parser.add_argument("--ways", nargs="+", default=[""], help="words of the ways to take besides Slam.process")
    parser.add_argument("--out", type=Path, default=Path("out/peers"))
    options = parser.parse_args()
    mpl.use("Agg")
    for name in [name for name in WAYS if name != OURS and not any(word in name for word in options.ways)]:
        del WAYS[name]
    core, found, before = pin(), {}, {}
    where = conditions()
    with kernels.one_thread():
        for count in sorted(options.landmarks):
            found[count] = medians([measure(count, options.steps, before) for _ in range(options.runs)])
            before |= found[count]
        summary(found)
        floor = dense_floor(options.steps)
    print("dense step, 1,000 landmarks, 6 observations:", end=" ")
    print(f"{floor['step_us']:.0f} us = {floor['ratio']:.2f} times the bare update of its covariance, wanted 1.6")
    options.out.mkdir(parents=True, exist_ok=True)
    saved = {**where, "core": core, "threads": 1, "landmarks": found, "dense_floor": floor}
    (options.out / "peers.json").write_text(json.dumps(saved, indent=1))
    draw(found, options.out / "peers.png")
    print(f"saved to {options.out}")


if __name__ == "__main__":
    main()
