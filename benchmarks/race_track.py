"""A race track with the faults of real cars: cones that are missing or mapped twice, the error of the path, the time.

    python benchmarks/race_track.py [--runs 20] [--fault slipping]

Every run has the filter that the world `race_track` ships with, but for a lag of 0 +- 0.1 s that it estimates; the
faults are put into its log.  The truth only scores.  The path is that of the filter while it runs; that of the batch
solution has all poses by all that the filter used, with its lag.  The time of a scan is that of the controls before it,
too.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

import kalmark as km
from kalmark.batch.data import replay_events
from kalmark.batch.solver import optimum
from kalmark.config import build_slam
from kalmark.diagnosis.batch_search import apply_calibration
from kalmark.errors import KalmarkError
from kalmark.events import Event
from kalmark.results.batch import batch_input
from kalmark.results.measures import rigid, rmse
from kalmark.simulate import load_world, simulate

LATE_S, SPIN_S, FOR_S = 0.06, 55.0, 2.0  # a spin begins in the second lap, while no cone is detected
SAME_M = 1.0  # a cone is where the map has one within this, after alignment
LAG = "robots.car.sensors.lidar.lag_s", "robots.car.sensors.lidar.sigma_lag_s"
CLEAN = (f"{LAG[0]}=0", f"{LAG[1]}=0", f"filter.{LAG[0]}=0", f"filter.{LAG[1]}=0.1")  # the filter estimates a lag


class Result(NamedTuple):
    """A run: cones missing and mapped twice, RMSE of its path and of the batch solution's, its end, m, ms a scan."""

    missing: int
    twice: int
    path_m: float
    batch_m: float
    end_m: float
    median_ms: float
    worst_ms: float


def slipping(log: km.Log) -> list[Event]:
    """Return a log whose wheels turn 15 % too fast in corners."""
    u = np.array([1.15, 1.0])
    return [replace(e, u=e.u * u) if isinstance(e, km.Control) and abs(e.u[1]) > 0.4 else e for e in log]


def spun(log: km.Log) -> list[Event]:
    """Return a log in which the car turns by 2 rad more than its controls show, and detects nothing meanwhile."""
    out = []
    for e in log:
        during = SPIN_S <= e.t_s < SPIN_S + FOR_S
        if isinstance(e, km.Control) and during:
            out.append(replace(e, u=e.u * [0.6, 1.0] - [0.0, 1.0]))
        elif not during:
            out.append(e)
    return out


FAULTS: dict[str, tuple[tuple[str, ...], Callable[[km.Log], list[Event]]]] = {
    "clean": ((), lambda log: log.events),
    "60 ms late": ((f"robots.car.sensing.lidar.late_s={LATE_S}",), lambda log: log.events),
    "slipping": ((), slipping),
    "spun": ((), spun),
    "no classes": (("robots.car.sensors.lidar.classes=null",), lambda log: log.events),
}


def run(fault: str, seed: int) -> Result:
    """Return the scores of a run with a fault."""
    over, change = FAULTS[fault]
    world = load_world("race_track", [*CLEAN, *over])
    log = simulate(world, seed)
    changed, truth = replace(log, events=change(log), truth={}, landmarks={}), log.truth["car"]
    slam = build_slam(world.config(), log)
    slam.warm_up()
    made = km.record(slam, changed, progress=False)
    here = np.column_stack([np.interp(made.history.t_ns, truth.t_ns, truth.poses[:, i]) for i in range(2)])
    path, batch_m = made.history.poses[:, :2] - here, math.nan
    with suppress(KalmarkError):  # a cone may be seen too little where the car is not yet found
        batch = optimum(replay_events(apply_calibration(made, batch_input(made)), changed))
        batch_m = rmse(batch.poses[:, :2] - here)
    ms, end_m = made.history.step_us * 1e-3, float(np.linalg.norm(path[-1]))
    cones = np.array([*log.landmarks.values()])
    table: Any = slam.landmarks()
    mapped = np.array([mean[:2] for mean in table.means])
    tree = cKDTree(cones)
    mapped = rigid(mapped, cones[tree.query(mapped)[1]])(mapped)
    near = tree.query(mapped)[1]
    missing = int((cKDTree(mapped).query(cones)[0] > SAME_M).sum())
    twice = len(mapped) - len({*near.tolist()})
    return Result(missing, twice, rmse(path), batch_m, end_m, float(np.nanmedian(ms)), float(np.nanmax(ms[10:])))


def main() -> None:
    """Print a row a fault: how many runs have each cone once, the medians and the worst."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--fault", choices=FAULTS)
    args = parser.parse_args()
    run("clean", 0)  # compiles
    print(
        "fault        cones once  missing  twice   path m (worst)  batch m (worst)   end m (worst)   ms a scan (worst)"
    )
    for fault in [args.fault] if args.fault else FAULTS:
        found = [run(fault, seed) for seed in range(args.runs)]
        rows = np.array(found)
        once = int(((rows[:, 0] == 0) & (rows[:, 1] == 0)).sum())
        median, worst = np.nanmedian(rows, axis=0), np.nanmax(rows, axis=0)
        metres = "".join(f"{median[k]:9.2f} ({worst[k]:.2f})" for k in (2, 3, 4))
        print(
            f"{fault:12} {once:4} of {len(found):2} {worst[0]:8.0f} {worst[1]:6.0f}{metres}"
            f"{median[5]:9.2f} ({worst[6]:.1f})",
            flush=True,
        )


if __name__ == "__main__":
    main()
