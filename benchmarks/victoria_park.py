"""Victoria Park from its raw laser, and with known trees, by both calibrations of the steering.

    KALMARK_DATA=... python benchmarks/victoria_park.py [--only laser] [--steering ascii] [--set a.b=v ...]

A line each: median distance of the aligned path from the GPS, RMS of those within 10 m and their share; landmarks; of
the 299 trees of the known association, how many the map has; duplicates in per cent; and how many times faster than
real time on one core, CPU time, reading and detection included.

The GPS only scores.  A landmark belongs to the tree that was seen where the landmark was seen: in the same scan, within
half a metre in the laser's frame, three times at least, most often of all trees.  That needs no common frame of two
maps, which differ by a metre here and there.  Every landmark of a tree but one is a duplicate; their share is that of
the landmarks that belong to trees.  "by place": the same of landmarks within 2 m of a tree of the map with known trees,
the maps aligned by the trees they share.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np
from scipy.spatial import cKDTree

from kalmark.cli.run import run_log
from kalmark.config import load_config, open_config_log
from kalmark.events import Scan
from kalmark.filter.kernels import one_thread
from kalmark.results.measures import rigid
from kalmark.results.run import Run

NEAR_M, SIGHTINGS = 0.5, 3
PLACE_M = 2.0
BARE = ["log.detections=rfs", "robots.each.sensors.laser.detector=null"]
CASES: dict[str, tuple[str, list[str]]] = {
    "known": ("victoria_park_known", []),
    "laser": ("victoria_park", []),
    "laser, 1 beam": ("victoria_park", ["robots.each.sensors.laser.detector.beams=1"]),
    "rfs": ("victoria_park", BARE),
}


def points(y: np.ndarray) -> np.ndarray:
    """Return where measurements (K, 2 or more) of range and bearing are, in the laser's frame."""
    return np.stack([y[:, 0] * np.cos(y[:, 1]), y[:, 0] * np.sin(y[:, 1])], axis=1)


def trees_by_scan() -> dict[int, tuple[np.ndarray, list[int]]]:
    """Return what the known association saw, and which trees those were, by milliseconds."""
    log = open_config_log(load_config("victoria_park_known"))
    return {round(e.t_ns / 1e6): (points(e.y), list(e.ids or ())) for e in log if isinstance(e, Scan)}


def tree_of_landmark(run: Run, known: dict[int, tuple[np.ndarray, list[int]]]) -> dict[str, int]:
    """Return which tree each landmark of the map is, by what was seen in one place of one scan."""
    history, votes = run.history, dict[str, Counter[int]]()
    kept = {str(i) for i in run.landmarks.ids}
    rows = np.flatnonzero(np.isin(history.outcome, ("associated", "new")))
    p = points(history.y[rows])
    for row, here in zip(rows, p, strict=True):
        name = str(history.landmark[row])
        there = known.get(round(int(history.t_ns[history.step[row]]) / 1e6))
        if there is None or name not in kept:
            continue
        gaps = np.linalg.norm(there[0] - here, axis=1)
        if gaps.min() < NEAR_M:
            votes.setdefault(name, Counter())[there[1][int(np.argmin(gaps))]] += 1
    best = {name: count.most_common(1)[0] for name, count in votes.items()}
    return {name: tree for name, (tree, count) in best.items() if count >= SIGHTINGS}


def duplicates(trees: list[int]) -> float:
    """Return the share of landmarks that are a tree which another one is already, in per cent."""
    return 100.0 * (len(trees) - len(set(trees))) / max(len(trees), 1)


def trees_by_place(run: Run, of: dict[str, int], known: Run) -> list[int]:
    """Return the trees within 2 m of a landmark, the maps aligned by the trees they share."""
    there = {int(i): m[:2] for i, m in zip(known.landmarks.ids, known.landmarks.means, strict=True)}
    here = {str(i): m[:2] for i, m in zip(run.landmarks.ids, run.landmarks.means, strict=True)}
    shared = {name: tree for name, tree in of.items() if tree in there}
    aligned = rigid(np.array([here[n] for n in shared]), np.array([there[t] for t in shared.values()]))
    gaps, nearest = cKDTree([*there.values()]).query(aligned(np.array([*here.values()])))
    return np.array([*there])[nearest[gaps < PLACE_M]].tolist()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=list(CASES))
    parser.add_argument("--steering", nargs="+", default=["ascii", "mat"])
    parser.add_argument("--set", nargs="+", default=[])
    asked, known = parser.parse_args(), trees_by_scan()
    surveyed = run_log("victoria_park_known", progress=False)
    titles = ("median m", "RMS 10 m", "in 10 m", "NIS", "landmarks", "trees", "dupl. %", "by place", "x real")
    print(f"{'detections':<18}{'steering':<10}" + "".join(f"{t:>11}" for t in titles))
    for name in asked.only:
        for steering in asked.steering:
            config, overrides = CASES[name]
            overrides = [*overrides, f"log.steering={steering}"]
            if name == "known" and steering == "mat":
                overrides.append("robots.each.motion.sigma_steering_rad=0.02")
            with one_thread():
                start = time.process_time()
                run = run_log(config, overrides=[*overrides, *asked.set], progress=False)
                cpu_s = time.process_time() - start
            summary = run.evaluate()
            figures = next(iter(summary["robots"].values()))
            trees = tree_of_landmark(run, known)
            log_s = float(run.history.t_ns[-1] - run.history.t_ns[0]) * 1e-9
            cells = (
                f"{figures['fix_median_m']:.2f}", f"{figures['fix_rms_10m']:.2f}", f"{figures['fix_within_10m']:.1%}",
                f"{summary['nis_per_dof']:.2f}", f"{summary['landmarks']}", f"{len(set(trees.values()))}",
                f"{duplicates([*trees.values()]):.1f}", f"{duplicates(trees_by_place(run, trees, surveyed)):.1f}",
                f"{log_s / cpu_s:.0f}",
            )  # fmt: skip
            print(f"{name:<18}{steering:<10}" + "".join(f"{c:>11}" for c in cells), flush=True)


if __name__ == "__main__":
    main()
