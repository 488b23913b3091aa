"""Figures of the shipped configurations on the real logs, known association.

    KALMARK_DATA=... python benchmarks/real_logs.py [--estimator invariant ekf]

A line each: raw and aligned position and landmark RMSE (m), pose NEES, NIS per degree of freedom, and where
GPS is the only truth, its median and the share of fixes within 10 m.  `kalmark run CONFIG --set ...` gives each alone.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from kalmark.cli.run import run_log
from kalmark.filter.kernels import one_thread

CASES: dict[str, tuple[str, list[str]]] = {
    "lost_in_the_woods": ("lost_in_the_woods", []),
    "lost_in_the_woods 1 m": ("lost_in_the_woods", ["log.r_max=1.0"]),
    **{f"mrclam robot {k}": ("mrclam", [f"log.robots=[{k}]"]) for k in range(1, 6)},
    "mrclam all in one": ("mrclam", ["log.robots=[1, 2, 3, 4, 5]"]),
    "victoria_park_known": ("victoria_park_known", []),
    "dlr": ("dlr", []),
    "freiburg_course": ("freiburg_course", []),
}
COLUMNS = ("ate_raw_m", "ate_m", "landmark_rmse_raw_m", "landmark_rmse_m", "pose_nees", "nis_per_dof", "fix_median_m",
           "fix_within_10m")  # fmt: skip


def figures(summary: dict[str, Any]) -> list[float]:
    """Return the columns of one run, robots averaged."""
    robots = list(summary["robots"].values())
    found = [[r[c] for r in robots if r.get(c) is not None] or [summary.get(c)] for c in COLUMNS]
    return [float(np.mean(v)) if v[0] is not None else float("nan") for v in found]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--estimator", nargs="+", default=["invariant", "ekf"])
    print(f"{'log':<24}{'filter':<12}" + "".join(f"{c:>21}" for c in COLUMNS))
    with one_thread():
        for estimator in parser.parse_args().estimator:
            alone = []
            for name, (config, overrides) in CASES.items():
                run = run_log(config, overrides=[*overrides, f"estimator.type={estimator}"], progress=False)
                row = figures(run.evaluate())
                alone += [row] if "robot" in name else []
                print(f"{name:<24}{estimator:<12}" + "".join(f"{v:>21.4g}" for v in row), flush=True)
            print(
                f"{'mrclam, mean of five':<24}{estimator:<12}" + "".join(f"{v:>21.4g}" for v in np.mean(alone, axis=0))
            )


if __name__ == "__main__":
    main()
