"""What one step costs: one control and one scan of 6 known landmarks, in a steady state.

    make bench      or      python benchmarks/step.py [--landmarks 50] [--steps 1000]

Four ways to take the same step of the same log, in turn within one run, one thread: `Slam.process` with every outcome
read; its bare compiled kernels; the textbook filter in NumPy; GTSAM's iSAM2 with the pose's marginal covariance (when
gtsam is installed).  The ratios are the result; the machine's microseconds are for orientation.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from field import ODOMETRY, SIGHT, Step, new_slam
from ways import Isam2, Known, Process, Textbook, Way, conditions, in_turns, pin

import kalmark as km
from kalmark.filter import corrections, kernels
from kalmark.models.motion2d import increment

SIGHTINGS, WARM_UP = 6, 101


def simulate(count: int, steps: int) -> list[Step]:
    """Return the steps of a log: all landmarks in the first, then 6 random ones a step."""
    rng, truth = np.random.default_rng(0), np.zeros(3)
    world = rng.uniform(-10, 10, (count, 2))
    log = []
    for t in range(steps + 1):
        u = np.array([0.1, 0.0, 0.05])
        truth = km.geometry.compose(truth, u)[0]
        ids = np.arange(count) if t == 0 else rng.choice(count, SIGHTINGS, replace=False)
        y = km.geometry.observe(truth, world[ids])[0] + rng.normal(size=(len(ids), 2)) * SIGHT
        y[:, 0] = np.abs(y[:, 0])
        control = km.Control(t, "r", u + rng.normal(size=3) * ODOMETRY)
        log.append((control, km.Scan(t, "r", "lidar", y, ids.tolist())))
    return log


class Kernels(Way):
    """The compiled kernels of the same step, everything about them prepared; a dense map."""

    def __init__(self, first: Step) -> None:
        self.slam = new_slam(np.zeros(3), "dense")
        self.first = first
        for event in first:
            self.slam.process(event)
        self.map, self.look = self.slam.map, self.slam._views["r", "lidar"].looks["point"].view
        self.index, self.N = self.map.index(0), np.diag(ODOMETRY**2)
        self.noise = np.tile(np.diag(SIGHT**2), (SIGHTINGS, 1, 1))

    def step(self, control: km.Control, scan: km.Scan) -> None:
        if control is self.first[0]:
            return
        m = self.map
        m.x[:3], F, G = increment(m.x[:3], control.u)
        kernels.predict(m.P, m.n, self.index, F, G @ self.N @ G.T)
        slots = np.array([self.slam.slot(i) for i in scan.ids or ()])
        seen = (0, -1, slots, 2, scan.y, self.noise, np.inf)
        corrections.compiled_invariant(self.look, (m.x, m.P, m.n, m.blocks, m.atoms, m.axes), seen, (6, 1e-3))


class Isam2Pose(Isam2):
    """iSAM2 with the marginal covariance of the pose alone."""

    def marginals(self, keys: list[int]) -> None:
        self.isam.marginalCovariance(self.key(self.t))


def measure(count: int, steps: int) -> dict[str, np.ndarray]:
    """Return the microseconds of each step; the first 100 are warm-up."""
    log = simulate(count, steps)

    def nothing() -> Known:
        return Known(np.zeros(3), new_slam(np.zeros(3)))

    ways: dict[str, Way] = {
        "Slam.process": Process(nothing()),
        "compiled kernels": Kernels(log[0]),
        "textbook NumPy": Textbook(nothing()),
    }
    try:
        ways["GTSAM iSAM2"] = Isam2Pose(nothing())
    except ImportError:
        print("gtsam is not installed: iSAM2 is left out")
    return {name: values[WARM_UP:] for name, values in in_turns(ways, log).items()}


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
    pin()
    where = conditions()
    with kernels.one_thread():
        rows = {str(n): table(measure(n, options.steps), n) for n in options.landmarks}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({**where, "landmarks": rows}, indent=1))
    print(f"\nsaved to {options.out}")


if __name__ == "__main__":
    main()
