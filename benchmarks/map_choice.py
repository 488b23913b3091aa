"""When a compressed map costs less than a dense one: the mean step of both, and whether `auto` takes the cheaper.

    python benchmarks/map_choice.py [--sides 10 14 20 32] [--steps 400]

A field of side x side landmarks, all known, ten observed a step: the nearest ones of a robot that drives in a circle
(local), or any of the map (wide).  Processor time of one thread, the first half of the steps left out.  A line each:
the step of the compressed map over that of the dense one, and that of `auto`; the ratios are the result.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator

import numpy as np
from field import ODOMETRY, SIGHT, Field, Step, known_field

import kalmark as km
from kalmark.filter import kernels
from kalmark.filter.compressed.compressed_map import CompressedMap

SEEN = 10
MOVE = np.array([0.05, 0.0, 0.02])


def wide_steps(field: Field, steps: int) -> Iterator[Step]:
    """Yield steps that observe any ten landmarks."""
    rng, truth = np.random.default_rng(1), np.array(field.slam("dense").mean("r"))
    for k in range(1, steps + 1):
        truth = km.geometry.compose(truth, MOVE)[0]
        ids = rng.choice(len(field.landmarks), SEEN, replace=False)
        y = km.geometry.observe(truth, field.landmarks[ids])[0] + rng.normal(size=(SEEN, 2)) * SIGHT
        y[:, 0] = np.abs(y[:, 0])
        control = km.Control(float(k), "r", MOVE + rng.normal(size=3) * ODOMETRY)
        yield control, km.Scan(float(k), "r", "lidar", y, ids.tolist())


def mean_step_us(side: int, kind: str, wide: bool, steps: int) -> tuple[float, bool]:
    """Return the mean microseconds of a step, and whether the map is compressed in the end."""
    (field, slam), spent = known_field(side, kind), []
    for control, scan in wide_steps(field, steps) if wide else field.circle(steps, view=SEEN):
        begin = time.thread_time_ns()
        slam.process(control)
        slam.process(scan)
        spent.append(time.thread_time_ns() - begin)
    return float(np.mean(spent[steps // 2 :])) * 1e-3, isinstance(slam.map, CompressedMap)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sides", type=int, nargs="+", default=[10, 14, 20, 32])
    parser.add_argument("--steps", type=int, default=400)
    options = parser.parse_args()
    with kernels.one_thread():
        for side in options.sides:
            for wide in (False, True):
                (dense, _), (compressed, _) = (
                    mean_step_us(side, k, wide, options.steps) for k in ("dense", "postponed")
                )
                auto, is_compressed = mean_step_us(side, "auto", wide, options.steps)
                scans, kind = "wide" if wide else "local", "compressed" if is_compressed else "dense"
                ratios = f"{compressed / dense:.2f} {auto / dense:.2f}"
                print(f"{side * side} {scans}: {ratios}  dense {dense:.0f} us; auto is {kind}", flush=True)


if __name__ == "__main__":
    main()
