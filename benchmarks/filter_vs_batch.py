"""How far the filters are from the optimum of the same data, on the real logs.

    KALMARK_DATA=... python benchmarks/filter_vs_batch.py [NAME ...] [--estimator invariant ekf]

One line a log and filter: raw position RMSE and pose NEES (mean over the robots, where there is a truth), the figures
of `kalmark.results.batch.compare_with_filter`, and the processor times of the filter and of the batch solution.
"""

from __future__ import annotations

import argparse
import time

from kalmark.config import build_slam, load_config, open_config_log
from kalmark.results.batch import compare_with_filter, solve_batch
from kalmark.results.record import record

CASES = {
    "lost_in_the_woods": ("lost_in_the_woods", ()),
    "lost_in_the_woods_3m": ("lost_in_the_woods", ("log.r_max=3.0",)),
    "lost_in_the_woods_1m": ("lost_in_the_woods", ("log.r_max=1.0",)),
    **{f"mrclam_{k}": ("mrclam", (f"log.robots=[{k}]",)) for k in range(1, 6)},
    "mrclam_all": ("mrclam", ("log.robots=[1, 2, 3, 4, 5]",)),
    "victoria_park_known": ("victoria_park_known", ()),
    "dlr": ("dlr", ()),
    "freiburg_course": ("freiburg_course", ()),
    "starry_night": ("starry_night", ()),
}
ROBOT = ["ate_raw_m", "pose_nees"]
COLUMNS = [*ROBOT, "sigma_ratio", "map_difference_m", "map_difference_sigma", "path_ratio", "path_difference_m"]
COLUMNS += ["chi2_per_dof", "iterations"]


def row(name: str, estimator: str) -> str:
    """Run one case and return its line."""
    config_name, overrides = CASES[name]
    config = load_config(config_name, [*overrides, f"estimator.type={estimator}"])
    log = open_config_log(config)
    start = time.process_time()
    run = record(build_slam(config, log), log, progress=False)
    filtered = time.process_time()
    batch = solve_batch(run, log)
    solved = time.process_time()
    robots = run.evaluate()["robots"].values()
    known = {c: [f[c] for f in robots if f.get(c) is not None] for c in ROBOT}
    figures = {c: sum(values) / len(values) if values else None for c, values in known.items()} | compare_with_filter(
        run, batch
    )
    cells = " ".join(f"{figures[c]:>20.4g}" if figures[c] is not None else f"{'-':>20}" for c in COLUMNS)
    return f"{name:<22} {estimator:<10} {cells} {filtered - start:>8.1f} {solved - filtered:>8.1f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=[*CASES], metavar="NAME", help=", ".join(CASES))
    parser.add_argument("--estimator", nargs="+", default=["invariant", "ekf"])
    given = parser.parse_args()
    print(f"{'log':<22} {'filter':<10} " + " ".join(f"{c:>20}" for c in COLUMNS) + f" {'filter_s':>8} {'batch_s':>8}")
    for name in given.names:
        for estimator in given.estimator:
            print(row(name, estimator), flush=True)


if __name__ == "__main__":
    main()
