"""Pose graphs of GTSAM's package through the filter: how far its last pose is from the batch optimum, time and memory.

    python benchmarks/pose_graphs.py [NAME ...]

`w100`, `w1000` and `w3500` are all and the first so many poses of Grisetti's simulated worlds (`w100.graph`,
`w10000.graph`), `sphere2500` is the sphere of Kaess (2,500 poses of space), all as `pip install gtsam` has them.  Each
is written as g2o and run as `kalmark run FILE.g2o` does, in a process of its own; GTSAM's Levenberg-Marquardt gives
the optimum.  Sigmas are those of the filter: the files state noise that is far larger than their errors.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from kalmark.config import build_slam, open_run
from kalmark.results.record import record

DATA = Path(gtsam.__file__).parent / "Data"
GRAPHS = {"w100": ("w100.graph", 100), "w1000": ("w10000.graph", 1000), "w3500": ("w10000.graph", 3500),
          "sphere2500": ("sphere2500.txt", 2500)}  # fmt: skip
G2O = (6, 7, 10, 8, 11, 9)  # where TORO has xx, xy, xt, yy, yt, tt


def written(name: str, path: Path) -> bool:
    """Write a graph as g2o; return whether it is in space."""
    file, poses = GRAPHS[name]
    if file.endswith(".txt"):
        graph, values = gtsam.readG2o(str(DATA / file), True)
        gtsam.writeG2o(graph, values, str(path))
        return True
    cells = (line.split() for line in (DATA / file).read_text().splitlines() if line.startswith("EDGE2"))
    edges = [c for c in cells if max(int(c[1]), int(c[2])) < poses]
    path.write_text("".join(" ".join(["EDGE_SE2", *c[1:6], *(c[i] for i in G2O)]) + "\n" for c in edges))
    return False


def optimum(path: Path, space: bool) -> tuple[int, Any]:
    """Return the number of edges and the last pose of the batch solution, from the poses of the odometry."""
    graph, _ = gtsam.readG2o(str(path), space)
    Pose, Prior = (gtsam.Pose3, gtsam.PriorFactorPose3) if space else (gtsam.Pose2, gtsam.PriorFactorPose2)
    steps, number = {}, graph.size()
    for factor in map(graph.at, range(number)):
        a, b = factor.keys()
        if abs(a - b) == 1:
            steps[max(a, b)] = factor.measured() if b > a else factor.measured().inverse()
    values, here = gtsam.Values(), Pose()
    values.insert(0, here)
    for k in sorted(steps):
        here = here.compose(steps[k])
        values.insert(k, here)
    graph.add(Prior(0, Pose(), gtsam.noiseModel.Isotropic.Sigma(6 if space else 3, 1e-6)))
    best = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return number, best.atPose3(k).translation() if space else best.atPose2(k).translation()


def report(name: str) -> None:
    """Print the row of a graph."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.g2o"
        space = written(name, path)
        edges, best = optimum(path, space)
        config, log = open_run(path)
        slam = build_slam(config, log)
        slam.warm_up()
        begin = time.perf_counter()
        run = record(slam, log, progress=False, pictures=False)
        took_s, d = time.perf_counter() - begin, len(best)
        off_m, left_out = (
            float(np.linalg.norm(slam.mean("robot")[:d] - best)),
            np.sum(run.history.outcome == "rejected"),
        )
        sigma_m = float(np.sqrt(np.trace(slam.covariance("robot")[:d, :d])))
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(f"{name} {len(run.history.poses)} poses, {edges} edges: off {off_m:.3g} m, sigma {sigma_m:.3g} m, "
              f"{left_out} left out, {took_s:.0f} s, {most:.2g} GB")  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=[*GRAPHS], choices=[[], *GRAPHS])
    for name in parser.parse_args().names:
        process = multiprocessing.get_context("spawn").Process(target=report, args=(name,))
        process.start()
        process.join()
