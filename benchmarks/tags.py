"""How well the filter's map, and the batch solution's, explain the corners of TagSLAM's tags.

    KALMARK_DATA=... python benchmarks/tags.py [TEST ...] [--set KEY=VALUE ...]

One line a test, shipped configuration.  `filter`: RMS of the corners' distances from where the filter has them just
after each scan.  `past path`: the filter's path as it was then, with the map and the mounts it ended with, which early
poses do not know.  `batch`: bundle adjustment of the same observations.  `raw`: position RMSE against TagSLAM's own
batch result, which is fitted to these detections.  `s`: processor time of the filter.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from kalmark.config import build_slam, open_run
from kalmark.errors import KalmarkError
from kalmark.results.record import record

TESTS = (1, 2, 8, 13, 21, 22)
HEADER = (
    "test",
    "tags",
    "sightings",
    "deferred",
    "filter px",
    "past path px",
    "batch px",
    "raw m",
    "NEES",
    "NIS/dof",
    "s",
)


def row(test: int, overrides: list[str]) -> tuple[Any, ...]:
    """Run one test and return its figures."""
    config, log = open_run("tagslam", f"tagslam_test/test_{test}", overrides)
    slam, start = build_slam(config, log), time.process_time()
    run = record(slam, log, progress=False)
    spent, figures = time.process_time() - start, run.evaluate()
    rig, batch = figures["robots"]["rig"], {}
    try:
        batch = run.evaluate(batch=True)["batch"]
    except KalmarkError as error:
        print(f"test {test}: {error}")
    if run.stopped:
        print(f"test {test} stopped: {run.stopped}")
    counts = figures["landmarks"], figures["associated"] + figures["new"], figures["deferred"]
    pixels = figures["corner_rms_px"], batch.get("filter_rms_px"), batch.get("rms_px")
    return test, *counts, *pixels, rig.get("ate_raw_m"), rig.get("pose_nees"), figures["nis_per_dof"], spent


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tests", nargs="*", type=int, default=TESTS)
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE")
    given = parser.parse_args()
    print("".join(f"{name:>13}" for name in HEADER), flush=True)
    for test in given.tests:
        cells = ["-" if c is None else c if isinstance(c, int) else f"{c:.3g}" for c in row(test, given.overrides)]
        print("".join(f"{cell:>13}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
