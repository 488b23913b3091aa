"""A robot that is carried away unnoticed: is it found by its landmarks, and when?  One that is not: does it stay?

    python benchmarks/carried.py                       # four fields, with ids and without, 20 seeds
    python benchmarks/carried.py --worlds dense --runs 5

A piece is cut out of a simulated log, after the robot has been round: its events stop at one place and go on at
another.  A line a case: runs, robots found (at the end within .5 m of where it is, after the map is moved onto the true
one), the median and the longest time until then from the first scan of three landmarks that were mapped before, false
alarms of the log without the cut, and maps with a landmark that is .5 m off, or twice.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

import kalmark as km
from kalmark.config import build_slam
from kalmark.events import Event
from kalmark.logs.log import Log
from kalmark.results.measures import rigid
from kalmark.simulate import load_world, simulate

LIDAR = "filter.robots.rover.sensors.lidar"
WORLDS = {  # and their keys
    "random_field": [],
    "sparse": ["world.count=25"],
    "dense": ["world.count=120"],
    "no limits stated": [f"{LIDAR}.range_min_m=0", f"{LIDAR}.range_max_m=.inf", f"{LIDAR}.fov_rad=6.2832"],
}
STEPS = 1200
FROM, TO, RIGHT_M = 0.6, 0.75, 0.5  # of the log is cut out
SEEN = 3  # landmarks that were mapped before, in a scan that shows where the robot is


def cut(log: Log) -> tuple[list[Event], int, int]:
    """Return the events without a piece, later ones at earlier times, and the first and the last time of that, ns."""
    times = np.array([event.t_ns for event in log.events])
    first, last = (int(times[int(len(times) * share)]) for share in (FROM, TO))
    events = [event for event in log.events if event.t_ns < first]
    for event in log.events:
        if event.t_ns > last and isinstance(event, km.Scan):
            t_ns = event.t_ns - last + first
            events.append(km.Scan(t_ns=t_ns, robot=event.robot, sensor=event.sensor, y=event.y, ids=event.ids))
        elif event.t_ns > last and isinstance(event, km.Control):
            events.append(km.Control(t_ns=event.t_ns - last + first, robot=event.robot, u=event.u))
    return events, first, last


def onto_truth(slam: km.Slam, places: np.ndarray) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray, np.ndarray]:
    """Return the motion of a map of N landmarks onto true places (M, 2), of which one each is (N,), and how far off.

    No place is that of two landmarks.
    """
    mapped = np.array(slam.landmarks().means)[:, :2]
    onto = rigid(mapped, places[cKDTree(places).query(mapped)[1]])
    far = cdist(onto(mapped), places)
    which = linear_sum_assignment(far)[1]
    return onto, which, far[np.arange(len(which)), which]


def carried_runs(keys: list[str], ids: bool, seed: int) -> tuple[bool, list[float], int, int]:
    """Return whether the robot was found, after how many s each time, false alarms without the cut, landmarks off."""
    said = load_world("random_field", [*keys, f"steps={STEPS}", f"ids={str(ids).lower()}"])
    log = simulate(said, seed=seed)
    places, truth = np.array([*log.landmarks.values()])[:, :2], next(iter(log.truth.values()))
    whole = km.record(build_slam(said.config(), log), log, progress=False)
    events, first, last = cut(log)
    slam = build_slam(said.config(), log)
    for event in (event for event in events if event.t_ns < first):
        slam.process(event)
    before, seen_ns, after = {*onto_truth(slam, places)[1].tolist()}, list[int](), list[float]()
    for event in (event for event in events if event.t_ns >= first):
        if isinstance(event, km.Scan) and not seen_ns:
            pose = truth.at(np.array([event.t_ns - first + last]))[0]
            seen = cKDTree(places).query(km.geometry.inv_observe(pose, event.y)[0])[1]
            seen_ns = [event.t_ns] if len({*seen.tolist()} & before) >= SEEN else []
        gaps = [gap for gap in slam.process(event).gaps if gap.kind == "elsewhere"]
        after += [(gap.end_ns - min(seen_ns, default=gap.end_ns)) * 1e-9 for gap in gaps]
    true = truth.at(np.array([events[-1].t_ns - first + last]))[0]
    onto, _, far = onto_truth(slam, places)
    off = np.linalg.norm(onto(slam.mean(next(iter(log.truth)))[None, :2])[0] - true[:2])
    return bool(off < RIGHT_M), after, len(whole.history.carried()), int((far > RIGHT_M).sum())


def main() -> None:
    """Print a line a world and kind of association."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--worlds", nargs="+", default=[*WORLDS])
    args = parser.parse_args()
    for world, ids in itertools.product(args.worlds, (True, False)):
        runs = [carried_runs(WORLDS[world], ids, seed) for seed in range(args.runs)]
        lasts = [after for _, times, _, _ in runs for after in times] or [np.nan]
        print(
            f"{world:16} {'ids' if ids else 'no ids':6} found {sum(found for found, *_ in runs)} of {len(runs)}, "
            f"after {np.median(lasts):.1f} s, at most {max(lasts):.1f} s; "
            f"false alarms {sum(alarms for _, _, alarms, _ in runs)}; "
            f"maps with a landmark off {sum(wrong > 0 for *_, wrong in runs)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
