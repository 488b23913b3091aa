"""Verdicts scored by the truth that they never see: the table "status by truth" over a folder of logs, or over worlds.

    python benchmarks/verdict_truth.py LOGS                    # every folder in LOGS with a mine.yaml
    python benchmarks/verdict_truth.py LOGS --only kidnap --csv rows.csv
    python benchmarks/verdict_truth.py --worlds random_field cloister --seeds 3
    python benchmarks/verdict_truth.py --worlds random_field --faults none "range scale 5 %" --seeds 2

A log of LOGS is a folder with a native log, its configuration `mine.yaml`, and `truth/` beside it, which has truth.csv
or landmarks.csv or both.  Each is filtered and judged as `kalmark run` does, without its truth (true poses, landmarks
and ids are removed even if they are in the log itself).  The truth scores map and path afterwards.

A run is right if all of this is so, after a rigid alignment of the landmarks (of the path without any; a map in the
frame of the truth, by a survey or fixes, is not aligned):

* the RMSE of the landmarks is within 3 of their median own sigma, or within 1 % of the extent of the true map;
* no true landmark is twice in the map, and nine of ten landmarks of the map are true ones (by their ids; without ids,
  nearer to a true one than half the way from that to the next true one);
* the last position of each robot is within 3 of its own sigmas, or within 1 % of that extent.

It counts as ok if the verdict on the map is "ok" and that on each robot too.  A line a log, then the table, then the
names of the logs that are wrong and ok.  Two processes; 1 to 20 s a log.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import redirect_stderr
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from diagnosis import FAULTS
from kalmark.arrays import Array
from kalmark.cli.run import judge
from kalmark.config import build_slam, config_dict, open_run
from kalmark.errors import KalmarkError
from kalmark.logs.formats import open_log
from kalmark.logs.log import Log
from kalmark.logs.progress import track
from kalmark.results.measures import Rigid, rigid, rmse
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.simulate import load_world, simulate

SIGMAS, LEAST = 3.0, 0.01  # own sigmas, or a share of the extent, within which a run is right
TRUE = 0.9  # of the landmarks in the map are true ones
ROUNDS = 10  # of alignment and matching
CONFIG, LOG_FILES, TRUTH_FILES = "mine.yaml", "*.csv", ("truth.csv", "landmarks.csv")
ROWS = ("right and ok", "right and doubtful or unchecked", "right and wrong", "wrong and named", "wrong and ok")
NAMED = ROWS.index("wrong and ok")


@dataclass(frozen=True)
class Case:
    """One log: of a folder, or of a shipped world with a fault."""

    name: str
    folder: Path | None = None
    world: str = ""
    fault: str = "none"
    seed: int = 0


@dataclass(frozen=True)
class Score:
    """A verdict and what the truth says: `row` of the table, the statuses, and what is wrong, "" if all is right."""

    name: str
    row: str
    map: str
    robots: str
    wrong: str
    causes: str


def cases(options: argparse.Namespace) -> Iterator[Case]:
    """Yield the logs that were asked for."""
    for path in sorted(options.logs.glob(f"**/{CONFIG}")) if options.logs else ():
        if options.only in path.parent.name:
            yield Case(path.parent.name, path.parent)
    for world in options.worlds:
        for fault in options.faults:
            yield from (Case(f"{world} {fault} {k}", None, world, fault, k) for k in range(options.seeds))


def opened(case: Case) -> tuple[Any, Log, Log]:
    """Return the configuration of a log, the log without its truth, and one with it."""
    if case.folder is None:
        _, plant, _, of_filter = FAULTS[case.fault]
        log = plant(simulate(load_world(case.world), case.seed), np.random.default_rng(case.seed))
        return load_world(case.world, of_filter).config(), log.without_truth(), log
    config, log = open_run(case.folder / CONFIG)
    with tempfile.TemporaryDirectory() as name:
        for path in (*case.folder.glob(LOG_FILES), *(case.folder / "truth" / file for file in TRUTH_FILES)):
            if path.is_file() and not (Path(name) / path.name).exists():
                os.symlink(path.resolve(), Path(name) / path.name)
        true = open_log(name, "native", on_error="skip")
    return config, log.without_truth(), true


def score(case: Case) -> Score:
    """Return the verdict on one log, without its truth, and what that says of it."""
    with redirect_stderr(open(os.devnull, "w")):
        try:
            config, log, true = opened(case)
            run = record(build_slam(config, log), log, progress=False, on_error="skip", config=config_dict(config))
            judge(run)
        except KalmarkError as error:
            return Score(case.name, "not run", "", "", str(error), "")
    verdict = run.summary["verdict"]
    robots = verdict.get("robots", {})
    wrong = "; ".join(wrongs(run.with_truth(true)))
    statuses = [verdict["map"], *robots.values()]
    ok = all(status == "ok" for status in statuses)
    row = ROWS[NAMED if ok else NAMED - 1] if wrong else ROWS[0 if ok else 2 if "wrong" in statuses else 1]
    causes = ", ".join(cause["name"] for cause in verdict["causes"] if not cause["harmless"])
    return Score(case.name, row, verdict["map"], ", ".join(f"{k} {v}" for k, v in robots.items()), wrong, causes)


def wrongs(run: Run) -> Iterator[str]:
    """Yield what of a run is not right by the truth, as it is defined above."""
    d, true = run.history.d, {str(k): v for k, v in run.truth.landmarks_in_map().items()}
    points = {name: place[:d] for name, place in true.items() if len(place) != 2 * d}
    places, P = run.landmarks.positions()
    onto, matched = alignment(run, places, points)
    extent = extent_of(run, points)
    if len(matched):
        there = np.array([points[name] for _, name in matched])
        mine = np.array([k for k, _ in matched])
        error, sigma = rmse(onto(places[mine]) - there), float(np.median(sigmas(P[mine, :d, :d])))
        if error > max(SIGMAS * sigma, LEAST * extent):
            yield f"landmarks {error:.3g} m off (own sigma {sigma:.2g} m)"
    free = [k for k, name in enumerate(run.landmarks.ids) if name not in run.landmarks.exact] if points else []
    doubled, strange = len(matched) - len({name for _, name in matched}), len(free) - len(matched)
    if doubled:
        yield f"{doubled} landmarks twice"
    if strange > (1.0 - TRUE) * max(len(free), 1):
        yield f"{strange} of {len(free)} landmarks are none"
    poses = run.truth.poses_in_map()
    for robot in run.history.robots:
        rows = np.flatnonzero((run.history.robot == robot) & np.isfinite(poses).all(axis=1))
        if not len(rows):
            continue
        last = rows[-1]
        off = float(np.linalg.norm(onto(run.history.poses[last : last + 1, :d])[0] - poses[last, :d]))
        sigma = float(sigmas(run.history.pose_covariances[last : last + 1, :d, :d])[0])
        if off > max(SIGMAS * sigma, LEAST * extent):
            yield f"{robot} {off:.3g} m off at the end (own sigma {sigma:.2g} m)"


def sigmas(P: Array) -> Array:
    """Return the root of the trace of covariances (K, d, d)."""
    return np.sqrt(np.trace(P, axis1=1, axis2=2))


def extent_of(run: Run, points: dict[str, Array]) -> float:
    """Return the RMS distance of the true landmarks from their middle, of the true path without any, m."""
    poses = run.truth.poses
    at = np.array([*points.values()]) if len(points) > 1 else poses[np.isfinite(poses).all(axis=1), : run.history.d]
    return rmse(at - at.mean(axis=0)) if len(at) else 0.0


def alignment(run: Run, places: Array, points: dict[str, Array]) -> tuple[Rigid, list[tuple[int, str]]]:
    """Return what takes the map onto the truth, and which landmark of the map is which true one.

    By ids where the log has them, else the nearest, from an alignment of the starts on.
    """
    d, poses = run.history.d, run.truth.poses_in_map()
    onto = Rigid(np.eye(d), np.zeros(d))
    known = [(k, str(name)) for k, name in enumerate(run.landmarks.ids) if str(name) in points]
    known = [(k, name) for k, name in known if run.landmarks.ids[k] not in run.landmarks.exact]
    if (run.history.id == "").all() and len(points) > 1:
        known = nearest(places, points, run)
        for _ in range(0 if run.truth.anchored else ROUNDS):
            if len(known) <= d:
                break
            onto = rigid(*pairs(places, points, known))
            known = nearest(onto(places), points, run)
    elif not run.truth.anchored and len(known) > d:
        onto = rigid(*pairs(places, points, known))
    elif not run.truth.anchored and not points:
        rows = np.isfinite(poses).all(axis=1)
        onto = rigid(run.history.poses[rows, :d], poses[rows, :d])
    return onto, known


def pairs(places: Array, points: dict[str, Array], known: list[tuple[int, str]]) -> tuple[Array, Array]:
    """Return the places of matched landmarks in the map and in truth."""
    return places[[k for k, _ in known]], np.array([points[name] for _, name in known])


def nearest(places: Array, points: dict[str, Array], run: Run) -> list[tuple[int, str]]:
    """Return the true landmark of each one of a map that is nearer to it than half the way to the next true one."""
    names, there = [*points], np.array([*points.values()])
    tree: Any = cKDTree(there)
    free = tree.query(there, k=2)[0][:, 1] / 2
    here = np.where(np.isfinite(places), places, np.inf)
    rows = [k for k in np.flatnonzero(np.isfinite(here).all(axis=1)) if run.landmarks.ids[k] not in run.landmarks.exact]
    far, which = tree.query(here[rows]) if rows else (np.zeros(0), np.zeros(0, dtype=np.int64))
    return [(int(k), names[i]) for k, i, m in zip(rows, which.tolist(), far, strict=True) if m < free[i]]


def main() -> None:
    """Print the lines and the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="?", metavar="LOGS", help="a folder of logs")
    parser.add_argument("--only", default="", help="logs with this in their names")
    parser.add_argument("--worlds", nargs="*", default=(), help="shipped worlds instead of a folder")
    parser.add_argument("--faults", nargs="*", default=("none",), help="of benchmarks/diagnosis.py (default: none)")
    parser.add_argument("--seeds", type=int, default=3, help="logs a world and fault (default: 3)")
    parser.add_argument("--csv", type=Path, help="a file for the lines")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    every = [*cases(options)]
    if not every:
        parser.error("no log: give a folder that has folders with a mine.yaml, or --worlds")
    found: list[Score] = []
    with get_context("spawn").Pool(min(options.processes, len(every))) as pool:
        for one in track(pool.imap_unordered(score, every), "logs", len(every), show=sys.stderr.isatty()):
            found.append(one)
            parts = (one.name, one.row, one.map, one.robots, one.wrong or "right", one.causes or "no cause")
            print(" | ".join(filter(None, parts)), flush=True)
    if options.csv:
        with options.csv.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(("log", "row", "map", "robots", "wrong", "causes"))
            writer.writerows((s.name, s.row, s.map, s.robots, s.wrong, s.causes) for s in found)
    print("\nstatus by truth")
    for row in (*ROWS, "not run"):
        print(f"{row:32s} {sum(one.row == row for one in found):4d}")
    bad = [one.name for one in found if one.row == ROWS[NAMED]]
    print(f"wrong and ok: {', '.join(bad) or 'none'}")


if __name__ == "__main__":
    main()
