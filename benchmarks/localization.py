"""A known map: what a step costs with 4,000 landmarks and with 10, and how often a robot finds itself in a hall.

    python benchmarks/localization.py steps               # microseconds and memory, with ids and without
    python benchmarks/localization.py hall --runs 100     # the hall of benchmarks/hall.py, started anywhere

`steps` drives two robots through the same events: around both are the same ten landmarks, one map has 3,990 more
beyond them.  `hall` starts a robot at a random time of its drive, with a pose that may be anywhere in the hall and
turned in any way; found is a pose within 0.5 m and 0.1 rad of the truth within 10 s that stays there, wrong is one that
the filter is sure of elsewhere.
"""

from __future__ import annotations

import argparse
import math
import time
import tracemalloc

import numpy as np
from hall import MOTIONS, REACH_M, SIGMA_BEARING_RAD, SIGMA_RANGE_M, hall

import kalmark as km
from kalmark.arrays import Array
from kalmark.geometry.angles import wrap

FEW, MANY, STEPS = 10, 4_000, 600
NEAR_M, NEAR_RAD, WITHIN_S = 0.5, 0.1, 10.0


def known(count: int) -> Array:
    """Return the places (N, 2) of landmarks: ten on a circle about the robot's, the others beyond on a grid."""
    around = 2 * math.pi * np.arange(FEW) / FEW
    side = math.ceil(math.sqrt(MANY))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) * 4.0 + 20.0
    return np.concatenate([6.0 * np.stack([np.cos(around), np.sin(around)], axis=1), grid])[:count]


def located(count: int, ids: bool) -> tuple[km.Slam, int]:
    """Return a filter with so many known landmarks, and the bytes that it has taken."""
    laser = km.Mount(km.sensors.RangeBearing(0.05, 0.01, range_max_m=12.0))
    rover = km.Robot("rover", km.motion.Unicycle(0.05, 0.02), (3.0, 0.0, math.pi / 2), {"laser": laser})
    tracemalloc.start()
    association = km.association.ByIdentity() if ids else km.association.Automatic()
    slam = km.Slam([rover], association)
    for i, place in enumerate(known(count)):
        slam.add_landmark(i, place)
    slam.expect("rover", "laser", in_view=True)  # the tree
    taken, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return slam, taken


def steps(ids: bool) -> None:
    """Print what a step costs with few and with many known landmarks."""
    located(FEW, ids)  # what the first one alone needs is loaded
    slams, rng = {count: located(count, ids) for count in (FEW, MANY)}, np.random.default_rng(0)
    pose, spent = np.array([3.0, 0.0, math.pi / 2]), {count: list[float]() for count in slams}
    for k in range(STEPS):
        u = np.array([0.9, 0.3])
        pose = km.motion.Unicycle().move(pose, u, 0.1)[0]
        y = km.geometry.observe(pose, known(FEW))[0] + rng.normal(size=(FEW, 2)) * (0.05, 0.01)
        names = range(FEW) if ids else None
        events = [
            km.Control(t_s=0.1 * k, robot="rover", u=u + rng.normal(size=2) * (0.05, 0.02)),
            km.Scan(t_s=0.1 * k + 0.1, robot="rover", sensor="laser", y=y, ids=names),
        ]
        for count in sorted(slams, reverse=bool(k % 2)):
            begin = time.perf_counter_ns()
            for event in events:
                slams[count][0].process(event)
            spent[count].append((time.perf_counter_ns() - begin) * 1e-3)
    how = "ids" if ids else "auto"
    median = {count: float(np.median(spent[count][STEPS // 6 :])) for count in slams}
    for count, (slam, taken) in slams.items():
        rows = sum(len(slam.map.rows(slot)) for slot in slam.tracks.slots.values())
        print(
            f"{how} known {count}: {median[count]:.0f} us a step, {taken / 1e6:.2f} MB, {rows} rows of P in use",
            flush=True,
        )
    print(f"{how} ratio {median[MANY] / median[FEW]:.2f}", flush=True)


def started(seed: int) -> tuple[str, float]:
    """Return "found", "wrong" or "not found" of a start anywhere in the hall, and after how many seconds."""
    log, rng = hall(seed, bad_wheel=False), np.random.default_rng([seed, 1])
    truth, first = log.truth["rover"], rng.uniform(0.0, 150.0)
    laser = km.Mount(km.sensors.RangeBearing(SIGMA_RANGE_M, SIGMA_BEARING_RAD, range_max_m=REACH_M))
    cov = np.diag([24.0**2 / 12, 16.0**2 / 12, math.pi**2 / 3])
    rover = km.Robot("rover", MOTIONS[False], (0.0, 0.0, 0.0), {"laser": laser}, cov=cov)
    slam = km.Slam([rover], km.association.Automatic())
    for name, place in log.landmarks.items():
        slam.add_landmark(name, place)
    after = math.inf
    for event in log.events:
        t_s = event.t_ns * 1e-9 - first
        if t_s < 0 or t_s > WITHIN_S:
            continue
        slam.process(event)
        if slam.covariance("rover")[2, 2] < 0.3**2:
            true = truth.poses[np.searchsorted(truth.t_ns, event.t_ns)]
            off = slam.mean("rover") - true
            if np.linalg.norm(off[:2]) > NEAR_M or abs(wrap(off[2])) > NEAR_RAD:
                return "wrong", t_s
            after = min(after, t_s)
    return ("found", after) if after <= WITHIN_S else ("not found", WITHIN_S)


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("steps", "hall"))
    parser.add_argument("--runs", type=int, default=100)
    options = parser.parse_args()
    if options.what == "steps":
        steps(True)
        steps(False)
        return
    results = [started(seed) for seed in range(options.runs)]
    counts = {what: sum(result == what for result, _ in results) for what in ("found", "wrong", "not found")}
    after = [t_s for result, t_s in results if result == "found"]
    said = f"wrong {counts['wrong']}, not found {counts['not found']}"
    when = f"after {np.median(after):.1f} s, at most {max(after):.1f} s"
    print(f"start: found {counts['found']} of {options.runs}, {said}, {when}")


if __name__ == "__main__":
    main()
