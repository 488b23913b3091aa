"""Every shipped real log through this checkout and another one: are the outcomes the same, observation by observation?

    KALMARK_DATA=... KALMARK_ORACLE=... python benchmarks/outcomes.py be0e13e      # a commit, or a folder

A line a log: observations, how many have another outcome or another landmark, the largest relative difference of d2,
and the figure of the summary that differs most.  `--only WORD` takes the logs whose names have the word.  Runs of the
same commits that are there already, below `--out`, are not repeated.  A log that has not run says why; if none has, the
exit status is 1.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from paired import checkout

HERE = Path(__file__).resolve().parents[1]
RECORDINGS = ("a3_hmgPnt_odo", "a_idpPnt_odo_small", "b2_idpPnt_constVel_small", "c_hmgLin_small", "c_idpLin_small",
              "c_plkLin_small", "e_omni_ahmPnt", "g_outliers_small")  # fmt: skip
HIDDEN = ("--set", "log.ids=hidden", "--set")
RUNS: dict[str, tuple[str, ...]] = {
    "lost_in_the_woods": ("lost_in_the_woods",),
    "lost_in_the_woods_1m": ("lost_in_the_woods", "--set", "log.r_max=1.0"),
    "lost_in_the_woods_bearing": ("lost_in_the_woods_bearing",),
    "lost_in_the_woods_jcbb": ("lost_in_the_woods", *HIDDEN, "association.type=jcbb"),
    **{name: (name,) for name in ("plaza", "dlr", "dlr_unknown", "freiburg_course", "victoria_park", "starry_night",
                                  "victoria_park_known", "kitti")},
    **{f"mrclam_{k}": ("mrclam", "--set", f"log.robots=[{k}]") for k in (1, 3, 5)},
    "mrclam_3_auto": ("mrclam", "--set", "log.robots=[3]", *HIDDEN, "association.type=auto"),
    "mrclam_3_jpda": ("mrclam", "--set", "log.robots=[3]", *HIDDEN, "association.type=jpda", "--set", "map.type=dense"),
    "mrclam_all": ("mrclam", "--set", "log.robots=[1, 2, 3, 4, 5]"),
    **{f"tagslam_{k}": ("tagslam", "--log", f"tagslam_test/test_{k}") for k in (1, 8, 13, 15, 21)},
    **{f"slamtb_{name}": ("slamtb", "--log", f"{name}.json.gz") for name in RECORDINGS},
}  # fmt: skip
TIMES = ("_us", "us_", "wall", "compile", "real_time")  # parts of the names of figures that are times


def run(place: Path, name: str, out: Path) -> str:
    """Run a log through a checkout unless that is done; return why there is no run, or nothing."""
    if (out / "summary.json").exists():
        return ""
    environment = os.environ | {"PYTHONPATH": str(place / "src"), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "kalmark", "run", *RUNS[name], "--out", str(out)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if (out / "summary.json").exists():
        return ""
    return next(reversed(done.stderr.splitlines()), f"exit status {done.returncode}")


def commit_of(place: Path) -> str:
    """Return the commit that is checked out in a folder, with a mark if files of it were changed."""
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    return subprocess.run(command, cwd=place, capture_output=True, text=True, check=True).stdout.strip()


def rows(folder: Path) -> list[dict[str, str]]:
    """Return the observations of a run, as its file has them."""
    with (folder / "associations.csv").open() as file:
        return list(csv.DictReader(file))


def numbers(summary: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield the figures of a summary by their names, times left out."""
    for key, value in summary.items():
        if isinstance(value, dict):
            yield from numbers(value, f"{prefix}{key}.")
        elif isinstance(value, int | float) and not isinstance(value, bool) and not any(t in key for t in TIMES):
            yield prefix + key, float(value)


def compared(mine: Path, other: Path) -> tuple[int, int, str]:
    """Return the observations of two runs of one log, how many differ, and the line about them."""
    pairs = list(zip(rows(mine), rows(other), strict=False))
    differ = sum(any(a[k] != b[k] for k in ("index", "outcome", "landmark")) for a, b in pairs)
    d2 = [(float(a["d2"]), float(b["d2"])) for a, b in pairs if a["d2"] and b["d2"]]
    worst = max((abs(a - b) / (1 + abs(b)) for a, b in d2), default=0.0)
    ours, theirs = (dict(numbers(json.loads((each / "summary.json").read_text()))) for each in (mine, other))
    off = {key: abs(ours[key] - theirs[key]) / (1e-12 + abs(theirs[key])) for key in ours.keys() & theirs.keys()}
    key = max(off, key=lambda each: off[each])
    figure = f"{key} {ours[key]:.6g}, was {theirs[key]:.6g}" if off[key] > 1e-9 else "no figure differs"
    return len(pairs), differ, f"{len(pairs):>7} observations, {differ} differ, d2 {worst:.0e}; {figure}"


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", help="a commit, or the folder of another checkout")
    parser.add_argument("--only", default="", metavar="WORD")
    parser.add_argument("--out", type=Path, default=Path("out/outcomes"))
    options = parser.parse_args()
    places, total, different = (HERE, checkout(options.other)), 0, 0
    commits = [commit_of(place) for place in places]
    for name in (name for name in RUNS if options.only in name):
        mine, other = folders = [options.out / commit / name for commit in commits]
        with ThreadPoolExecutor(2) as both:
            failures = list(filter(None, both.map(run, places, (name, name), folders)))
        if failures:
            line = f"has not run in both: {failures[0]}"
        else:
            count, differ, line = compared(mine, other)
            total, different = total + count, different + differ
        print(f"{name:<28}{line}", flush=True)
    if not total:
        sys.exit("no log was compared")
    print(f"all logs: {total} observations, {different} differ")


if __name__ == "__main__":
    main()
