"""A hall with 24 pillars and a recorder that stops for a while: is the map right, and is it said where it is not?

    python benchmarks/hall.py                     # gaps of 0 to 16 s, 20 seeds, both wheels, both kinds of controls
    python benchmarks/hall.py --gaps 4 --runs 5 --action ignore
    python benchmarks/hall.py --rows --gaps 4 8 --verdict

A differential-drive robot drives round a hall of 24 x 16 m by its own odometry, increments or velocities at 10 Hz.  Its
laser observes pillars within 8 m, without ids, at 5 Hz, and 3 % of its observations are of nothing.  The right wheel is
1 % larger than its odometry assumes.  A recorder that stops loses scans and controls; the last velocity is then held
too long.  A line a case: runs with a map that has every pillar once and nothing else, runs with a wrong map and a
warning about it, runs with a wrong map and none, and runs with a right map and a warning.

With --rows the pillars stand in rows, 3 m by 2.5 m apart and up to .3 m off, and the laser observes those within 5 m: a
scan looks alike in many places.  The recorder stops in the first round, where it begins again nothing is mapped yet.
With --verdict a warning is a verdict that is not "ok".
"""

from __future__ import annotations

import argparse
import itertools
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

import kalmark as km
from kalmark.arrays import Array
from kalmark.diagnosis.verdict import diagnose
from kalmark.geometry.angles import wrap
from kalmark.logs.log import Log, Trajectory
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.truth import Truth

LONG_M, WIDE_M, PILLARS, APART_M = 24.0, 16.0, 24, 2.5
ROUND_M = (-8, -4), (8, -4), (8, 4), (-8, 4)  # corners of its way, missed by up to 2 m
REACH_M, SPURIOUS = 8.0, 0.03
ROWS, IN_ROWS_M, OFF_M, NEAR_M = (6, 4), (3.0, 2.5), 0.3, 5.0  # how far apart pillars in rows are, off, and observed
SPEED_MPS, TURN_RADPS, TRACK_M, DT_S = 0.8, 0.8, 0.5, 0.1
LASTS_S, SCANNED = 180, 2  # controls to a scan
SIGMA_RANGE_M, SIGMA_BEARING_RAD, SIGMA_WHEEL_MPS = 0.03, 0.01, 0.02
LATE_S, EARLY_S = (60.0, 90.0), (15.0, 30.0)  # when the recorder stops
GAPS_S = (0, 2, 4, 8, 16)
RIGHT_M = 0.5  # a landmark of the map this near to a pillar is that pillar
ALARM = "map"  # a warning with this word is about it

MOTIONS = {
    False: km.motion.Odometry2D(0.004, 0.001, 0.008),
    True: km.motion.Unicycle(0.04, 0.08),
}


def pillars(rng: np.random.Generator) -> Array:
    """Return the places (24, 2) of the pillars."""
    places: list[Array] = []
    while len(places) < PILLARS:
        place = rng.uniform((-LONG_M / 2, -WIDE_M / 2), (LONG_M / 2, WIDE_M / 2))
        if all(np.linalg.norm(place - other) > APART_M for other in places):
            places.append(place)
    return np.array(places)


def in_rows(rng: np.random.Generator) -> Array:
    """Return the places (24, 2) of pillars in rows."""
    at = np.stack(np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in ROWS)), axis=-1).reshape(-1, 2)
    return np.asarray(at * IN_ROWS_M + rng.uniform(-OFF_M, OFF_M, at.shape))


def way(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the true poses (N + 1, 3) and the speeds and turn rates (N, 2) between them of a drive about the hall."""
    pose, poses, controls, turns = np.array([-8.0, -4.0, 0.0]), [], [], itertools.cycle(ROUND_M)
    goal = pose[:2]
    for _ in range(round(LASTS_S / DT_S)):
        while np.linalg.norm(goal - pose[:2]) < 1.0:
            goal = np.array(next(turns)) + rng.uniform(-2.0, 2.0, 2)
        ahead = wrap(np.arctan2(*(goal - pose[:2])[::-1]) - pose[2])
        controls.append((SPEED_MPS * max(0.2, np.cos(ahead)), np.clip(1.5 * ahead, -TURN_RADPS, TURN_RADPS)))
        poses.append(pose)
        pose = km.motion.Unicycle().move(pose, np.array(controls[-1]), DT_S)[0]
    return np.array([*poses, pose]), np.array(controls)


def hall(seed: int, gap_s: float = 0.0, bad_wheel: bool = True, held: bool = False, rows: bool = False) -> Log:
    """Return the log of a drive; `held` has velocities instead of increments."""
    rng = np.random.default_rng(seed)
    places, (poses, controls) = in_rows(rng) if rows else pillars(rng), way(rng)
    reach_m = NEAR_M if rows else REACH_M
    begin = int(rng.uniform(*(EARLY_S if rows else LATE_S)) / DT_S)
    lost = range(begin, begin + round(gap_s / DT_S))
    events: list[km.Control | km.Scan] = []
    for k, (v, w) in enumerate(controls):
        now, then = round(k * DT_S * 1e9), round((k + 1) * DT_S * 1e9)
        left, right = v - w * TRACK_M / 2, v + w * TRACK_M / 2
        left, right = np.array([left, right / (1.01 if bad_wheel else 1.0)]) + rng.normal(size=2) * SIGMA_WHEEL_MPS
        told = np.array([(left + right) / 2, (right - left) / TRACK_M])
        if held and k not in lost:
            events.append(km.Control(t_ns=now, robot="rover", u=told))
        if not held:
            step = km.motion.Unicycle().move(np.zeros(3), told, DT_S)[0]
            if k not in lost:
                events.append(km.Control(t_ns=then, robot="rover", u=step))
        y = sight(poses[k + 1], places, rng, reach_m)
        if k % SCANNED == SCANNED - 1 and k not in lost:
            events.append(km.Scan(t_ns=then, robot="rover", sensor="laser", y=y))
    times = np.round(np.arange(len(poses)) * DT_S * 1e9).astype(np.int64)
    return Log(
        "hall", ("rover",), sorted(events, key=km.events.sort_key), truth={"rover": Trajectory(times, poses)},
        landmarks=dict(enumerate(places)), control_columns={"rover": MOTIONS[held].columns},
        sensor_columns={("rover", "laser"): km.sensors.RangeBearing.columns},
    )  # fmt: skip


def sight(pose: Array, places: Array, rng: np.random.Generator, reach_m: float) -> Array:
    """Return ranges and bearings (K, 2) of the pillars in reach, some of which are of nothing."""
    y = km.geometry.observe(pose, places)[0] + rng.normal(size=(len(places), 2)) * (SIGMA_RANGE_M, SIGMA_BEARING_RAD)
    y = y[y[:, 0] < reach_m]
    spurious = np.column_stack([rng.uniform(0.5, reach_m, len(y)), rng.uniform(-np.pi, np.pi, len(y))])
    return np.where(rng.random(len(y))[:, None] < SPURIOUS, spurious, y)


def slam_of(log: Log, held: bool = False, gaps: str = "widen", **of_slam: Any) -> km.Slam:
    """Return the filter for a log; `of_slam` are further arguments of it."""
    laser = km.Mount(km.sensors.RangeBearing(SIGMA_RANGE_M, SIGMA_BEARING_RAD, range_max_m=REACH_M))
    start = log.truth["rover"].poses[0]
    rover = km.Robot("rover", MOTIONS[held], start, {"laser": laser}, gaps=gaps)
    return km.Slam([rover], km.association.Automatic(), **of_slam)


def mapped(log: Log, held: bool = False, gaps: str = "widen", repeats: str = "off", **of_slam: Any) -> Run:
    """Return the run of a log through the filter."""
    slam = slam_of(log, held, gaps, upkeep=km.Upkeep(repeats=repeats), **of_slam)
    return record(slam, log, progress=False)


def right(run: Run, log: Log) -> bool:
    """Return whether a map has every pillar once, where it is, and nothing else."""
    apart = cdist(run.landmarks.positions()[0], np.array(list(log.landmarks.values())))
    rows, columns = linear_sum_assignment(apart)
    return apart.shape == (PILLARS, PILLARS) and bool((apart[rows, columns] < RIGHT_M).all())


def alarmed(run: Run, verdict: bool = False) -> bool:
    """Return whether a run warns about its map, without the truth, or whether the `verdict` on it does."""
    if verdict:
        return diagnose(run).map != "ok"
    blind = replace(run, truth=Truth(np.full_like(run.truth.poses, np.nan)))
    return any(ALARM in line for line in blind.evaluate()["warnings"])


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaps", type=float, nargs="*", default=(0, 2, 4, 8, 16), help="seconds")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--action", default="widen")
    parser.add_argument("--rows", action="store_true")
    parser.add_argument("--verdict", action="store_true")
    options = parser.parse_args()
    print("controls    wheel  gap s   right  wrong, said  wrong, not said  right, alarm")
    total = Counter[tuple[bool, bool]]()
    for held, bad, gap_s in itertools.product((False, True), (False, True), options.gaps):
        counts = Counter[tuple[bool, bool]]()
        for seed in range(options.runs):
            log = hall(seed, gap_s, bad, held, options.rows)
            run = mapped(log, held, options.action)
            counts[right(run, log), alarmed(run, options.verdict)] += 1
        total += counts
        good = counts[True, True] + counts[True, False]
        which = f"{'velocities' if held else 'increments'}  {'+1 %' if bad else 'true':>5}  {gap_s:>5g}"
        print(
            f"{which}  {good:>6}  {counts[False, True]:>11}  {counts[False, False]:>15}  {counts[True, True]:>12}",
            flush=True,
        )
    good, silent = total[True, True] + total[True, False], total[False, False]
    print(f"total  {good}  {total.total()}  {silent}  {total[True, True]}")


if __name__ == "__main__":
    main()
