"""Cost of unknown ids on large maps: nearest neighbour over known ids.

    python benchmarks/nearby.py [--sides 32 100]

The field of side x side landmarks of `map_growth.py`, mowed once with ids and once without; then steps round a circle
in a place that is known, ten landmarks in view.  Processor time of one thread, every outcome read; the ratios are the
result.  Duplicates are looked for, as always where there are no ids.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from field import Field, Step, new_slam

import kalmark as km
from kalmark.events import Id
from kalmark.filter.kernels import one_thread

CIRCLE, MEASURED = 3000, 1000


class Cost(NamedTuple):
    """Milliseconds of a step of a mission (mean) and round a circle (median), and what was taken for what."""

    mission_ms: float
    circle_ms: float
    landmarks: int
    wrong: int
    of: int


def take(slam: km.Slam, steps: Iterable[Step], known: bool, true: dict[Id, int]) -> tuple[np.ndarray, int]:
    """Take steps; return the milliseconds of each, and how many observations were taken for another landmark's."""
    spent, wrong = [], 0
    for control, with_ids in steps:
        scan = with_ids if known else km.Scan(t_ns=with_ids.t_ns, robot="r", sensor="lidar", y=with_ids.y)
        begin = time.thread_time_ns()
        slam.process(control)
        seen = slam.process(scan).observations
        spent.append((time.thread_time_ns() - begin) * 1e-6)
        for o, i in zip(seen, with_ids.ids or (), strict=True):
            if o.outcome == "new" and o.landmark is not None:
                true[o.landmark] = int(i)  # type: ignore[arg-type]
            wrong += o.outcome == "associated" and true[o.landmark] != i  # type: ignore[index]
    return np.array(spent), wrong


def cost(side: int, known: bool) -> Cost:
    """Mow a field and circle in it."""
    field, true = Field(side, side), dict[Id, int]()
    slam = new_slam(
        field.start, "auto", km.association.ByIdentity("off") if known else km.association.NearestNeighbour()
    )
    mission = field.mission()
    gc.freeze()
    spent, wrong = take(slam, mission, known, true)
    circle, more = take(slam, field.circle(CIRCLE), known, true)
    observations = sum(len(scan.y) for _, scan in mission) + CIRCLE * 10
    median = float(np.median(circle[-MEASURED:]))
    return Cost(float(spent.mean()), median, len(slam.landmarks()), wrong + more, observations)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sides", type=int, nargs="+", default=[32, 100])
    sides = parser.parse_args().sides
    for known in (True, False):
        cost(9, known)  # loads the compiled code
    print("| landmarks | mission, ms a step: known, nearest | ratio | in a known place, us | ratio | mapped | wrong |")
    print("|---|---|---|---|---|---|---|")
    for side in sides:
        a, b = cost(side, True), cost(side, False)
        print(f"| {side**2:,} | {a.mission_ms:.3f}, {b.mission_ms:.3f} | {b.mission_ms / a.mission_ms:.2f}", end=" ")
        print(f"| {1e3 * a.circle_ms:.0f}, {1e3 * b.circle_ms:.0f} | {b.circle_ms / a.circle_ms:.2f}", end=" ")
        print(f"| {b.landmarks:,} | {b.wrong:,} of {b.of:,} |", flush=True)


if __name__ == "__main__":
    with one_thread():
        main()
