"""Spurious ranges under right ids: what gates and robust weights make of them.

    python benchmarks/outliers.py                # 20 runs
    python benchmarks/outliers.py --runs 5 --share .1

A robot wanders between 40 landmarks whose ids it knows; some ranges are anywhere: not those of first observations
(`later`), or these, too (`any`).  A line a way: mean pose NEES (3), path and landmark RMSE, and how many landmarks are
off by more than .5 m.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from kalmark.config import build_slam
from kalmark.events import Scan
from kalmark.logs.log import Log
from kalmark.results.record import record
from kalmark.simulate import load_world, simulate

FIELD = ("world.count=40", "world.size_m=24", "steps=500", "robots.rover.start={x_m: 12, y_m: 12, theta_rad: 0}")
REACH_M = 12.0
WAYS: dict[str, tuple[str, ...]] = {
    "all taken": ("filter.association={type: identity, gate: off}",),
    "default": (),
    "gate .9999": ("filter.association={type: identity, gate: 0.9999}",),
    "huber": ("robots.rover.sensors.lidar.robust=huber",),
    "student": ("robots.rover.sensors.lidar.robust=student",),
}


def spurious(log: Log, share: float, later: bool, rng: np.random.Generator) -> Log:
    """Return a log in which a share of the ranges is anywhere; `later`: not those of a landmark's first observation."""
    seen, events = set[object](), []
    for e in log.events:
        event = e
        if isinstance(event, Scan) and event.ids is not None and len(event.y):
            may = np.array([not later or i in seen for i in event.ids])
            bad, y = may & (rng.random(len(may)) < share), event.y.copy()
            y[bad, 0] = rng.uniform(0.5, REACH_M, bad.sum())
            seen |= {*event.ids}
            event = Scan(t_ns=event.t_ns, robot=event.robot, sensor=event.sensor, y=y, ids=event.ids)
        events.append(event)
    return replace(log, events=events)


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--share", type=float, default=0.03)
    options = parser.parse_args()
    cases = {"clean": (0.0, True), "later": (options.share, True), "any": (options.share, False)}
    for case, (share, later) in cases.items():
        for way, settings in WAYS.items():
            rows, far = [], 0
            for seed in range(options.runs):
                log = spurious(
                    simulate(load_world("random_field", [*FIELD]), seed), share, later, np.random.default_rng(seed)
                )
                config = load_world("random_field", [*FIELD, *settings]).config()
                run = record(build_slam(config, log), log, progress=False)
                figures = run.evaluate()
                rover, apart = figures["robots"]["rover"], np.array([log.landmarks[i] for i in run.landmarks.ids])
                far += int((np.linalg.norm(run.landmarks.positions()[0] - apart, axis=1) > 0.5).sum())
                rows.append((rover["pose_nees"], rover["ate_m"], figures["landmark_rmse_m"]))
            nees, path, landmarks = np.mean(rows, axis=0)
            print(f"{case:6s} {way:12s} {nees:8.2f} {path:7.3f} m {landmarks:7.3f} m {far:4d}", flush=True)


if __name__ == "__main__":
    main()
