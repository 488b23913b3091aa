"""Tune real logs by their first half: NIS per degree of freedom on the second, and what it does to map and path.

    KALMARK_DATA=... python benchmarks/tuning.py
    KALMARK_DATA=... python benchmarks/tuning.py --only mrclam --aim map

A line a log: NIS per degree of freedom of both halves before and after, the gain in log-likelihood on the second half,
and of the whole log the pose NEES (3 is consistent), the aligned path and the aligned landmarks, before and after.
"""

from __future__ import annotations

import argparse

from kalmark.cli.run import run_log
from kalmark.diagnosis.tune import AIMS, Tuning, tune
from kalmark.diagnosis.tuned_file import cells
from kalmark.results.run import Run

LOGS = {
    "lost_in_the_woods": ("lost_in_the_woods",),
    "mrclam_3": ("mrclam", "log.robots=[3]"),
}


def truth(run: Run) -> str:
    """Return the pose NEES, and the RMSE of the path and of the landmarks."""
    summary = run.evaluate()
    robot = next(iter(summary["robots"].values()))
    return f"{robot['pose_nees']:.3g} {robot['ate_m']:.3f} {summary['landmark_rmse_m']:.3f}"


def line(name: str, aim: str, tuning: Tuning, before: Run, after: Run) -> str:
    """Return the line of a log."""
    (first, second), (first_after, second_after) = tuning.before, tuning.after
    gain = second_after.likelihood - second.likelihood
    both = f"NIS {first.nis:.3f} {second.nis:.3f} -> {first_after.nis:.3f} {second_after.nis:.3f} gain {gain:+.0f}"
    return f"{name} {aim}: {both} truth {truth(before)} -> {truth(after)} sigma factor {tuning.sigma_factor:.2f}"


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="")
    parser.add_argument("--aim", choices=AIMS, action="append")
    options = parser.parse_args()
    for name, (config, *overrides) in LOGS.items():
        for aim in options.aim or AIMS if options.only in name else ():
            tuning = tune(config, overrides=overrides, aim=aim)
            for change in tuning.changes:
                print("   ", *cells(change))
            new = [f"{change.key}={change.after}" for change in tuning.changes if change.changed]
            runs = [run_log(config, overrides=[*overrides, *more], progress=False) for more in ((), new)]
            print(line(name, aim, tuning, *runs), flush=True)


if __name__ == "__main__":
    main()
