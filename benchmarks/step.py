"""Cost of one step: one control and one scan of 6 known landmarks, in a steady state.

    make bench      or      python benchmarks/step.py [--landmarks 50] [--steps 1000]

Four ways to take the same step of the same log, in turn within one run, one thread: `Slam.process` with every outcome
read; its bare compiled kernels; the textbook filter in NumPy; GTSAM's iSAM2 with the pose's marginal covariance (when
gtsam is installed).  The ratios are the result; the machine's microseconds are for orientation.

Then, on a circle in a field of known landmarks, 2 m apart: the dense step with 6 landmarks in view over the bare update
of its covariance, by turns of 20; and the step of the map that Slam chooses with 10 in view, by parts.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from field import ODOMETRY, SIGHT, Step, known_field, new_slam
from ways import Isam2, Known, Process, Textbook, Way, conditions, in_turns, pin

import kalmark as km
from kalmark.filter import corrections, kernels, prediction
from kalmark.filter.estimators import Invariant
from kalmark.geometry.frames import compose

SIGHTINGS, WARM_UP = 6, 101
SIDE, IN_VIEW = 32, 10  # a field of 1,024 landmarks
TURN = 20


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
        self.map, self.model = self.slam.map, self.slam.state.channels["r", "lidar"].models["point"].model
        self.index, self.N = self.map.index(0), np.diag(ODOMETRY**2)
        self.noise = np.tile(np.diag(SIGHT**2), (SIGHTINGS, 1, 1))

    def step(self, control: km.Control, scan: km.Scan) -> None:
        if control is self.first[0]:
            return
        m = self.map
        m.x[:3], F, G = compose(m.x[:3], control.u)
        kernels.predict(m.P, m.n, self.index, F, G @ self.N @ G.T)
        slots = np.array([self.slam.slot(i) for i in scan.ids or ()])
        seen = (0, -1, slots, 2, scan.y, self.noise, np.inf)
        corrections.invariant(self.model, m.whole, seen, (6, 1e-3))


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


def spent_us(call: Callable[..., Any], *arguments: Any) -> float:
    """Return the microseconds of processor time that a call takes."""
    begin = time.thread_time_ns()
    call(*arguments)
    return (time.thread_time_ns() - begin) * 1e-3


def dense_over_floor(steps: int) -> dict[str, float]:
    """Return the median step of a dense map and 6 observations, and that of the update of its covariance alone."""
    field, slam = known_field(SIDE, "dense")
    V = np.full((2 * SIGHTINGS, slam.map.n), 1e-9)
    taken, bare = [], []
    for _ in range(steps // TURN):
        for control, scan in field.circle(TURN, view=SIGHTINGS):
            taken.append(spent_us(slam.process, control) + spent_us(slam.process, scan))
        bare += [spent_us(kernels.downdate, slam.map.P, V) for _ in range(TURN)]
    step, floor = float(np.median(taken[TURN:])), float(np.median(bare))
    return {"landmarks": SIDE * SIDE, "step_us": step, "update_us": floor, "ratio": step / floor}


def parts(steps: int) -> dict[str, float]:
    """Return the medians of a control, a scan of 10 landmarks, and the compiled prediction and correction in them."""
    field, slam = known_field(SIDE, "auto")
    kernels_us: dict[str, list[float]] = {"prediction": [], "correction": []}

    def timed(name: str, kernel: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            begin = time.thread_time_ns()
            done = kernel(*arguments)
            kernels_us[name].append((time.thread_time_ns() - begin) * 1e-3)
            return done

        return run

    predict, correct, spent = prediction.predict, Invariant.compiled, []
    for control, scan in field.circle(2 * steps, view=IN_VIEW):
        if len(spent) == steps:  # of what is timed with its kernels nothing else counts
            prediction.predict = timed("prediction", predict)
            Invariant.compiled = staticmethod(timed("correction", correct))  # type: ignore[assignment]
        spent.append((spent_us(slam.process, control), spent_us(slam.process, scan)))
    prediction.predict = predict
    Invariant.compiled = staticmethod(correct)  # type: ignore[assignment]
    control_us, scan_us = np.median(spent[steps // 2 : steps], axis=0)
    found = {f"{name}_us": float(np.median(values)) for name, values in kernels_us.items()}
    return {"control_us": control_us, "scan_us": scan_us, **found}


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
        dense, chosen = dense_over_floor(options.steps // 3), parts(2 * options.steps)
    print(f"\n{dense['landmarks']:,} landmarks, dense, {SIGHTINGS} seen a step: {dense['step_us']:.0f} us,", end=" ")
    print(f"update {dense['update_us']:.0f} us, ratio {dense['ratio']:.2f}")
    kernels_us = chosen["prediction_us"] + chosen["correction_us"]
    print(f"the map that Slam chooses, {IN_VIEW} seen a step: control {chosen['control_us']:.1f} us,", end=" ")
    times = (chosen["control_us"] + chosen["scan_us"]) / kernels_us
    print(f"scan {chosen['scan_us']:.1f} us, {times:.2f} times", end=" ")
    print(f"their compiled prediction {chosen['prediction_us']:.1f} us and correction {chosen['correction_us']:.1f} us")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({**where, "landmarks": rows, "dense": dense, "parts": chosen}, indent=1))
    print(f"\nsaved to {options.out}")


if __name__ == "__main__":
    main()
