"""How often a loop is closed, and how often wrongly, when the robot comes back three landmark spacings off.

    python benchmarks/loop_closing.py [--runs 200] [--out out/loop_closing]

Landmarks on a 2 m grid, jittered by up to .7 m, without ids.  The robot maps them on a round trip (range and bearing,
.05 m and .5 deg, up to 12 within 7 m), leaves them, sees nothing on its way, and comes back with its position known to
6 m (root mean square) and its heading to 15 deg.  Ten scans later, a metre apart, its loop is

closed   if the pose is right to .5 m and within its own 99.9 % ellipsoid, and no pair since was wrong
wrong    if any pair since was wrong: an observation fused with another landmark than its own
open     otherwise: it has not been closed yet
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.association import Association
from kalmark.geometry.gaussian import gate

SPACING, REACH, MOST = 2.0, 7.0, 12
SIGHT, ODOMETRY = np.array([0.05, np.radians(0.5)]), np.array([0.02, 0.02, np.radians(0.3)])
BACK = np.array([4.24, 4.24, np.radians(15.0)])  # sigmas of the pose after the way back: 6 m in all
METHODS: dict[str, Association] = {
    "auto": km.association.Automatic(),
    "clique": km.association.Cliques(),
    "jcbb": km.association.JointCompatibility(),
    "nearest": km.association.NearestNeighbour(),
}


class Run:
    """One robot in one world."""

    def __init__(self, seed: int, method: Association) -> None:
        self.rng = np.random.default_rng(seed)
        grid = np.stack(np.meshgrid(np.arange(-8, 9), np.arange(-8, 9)), -1).reshape(-1, 2) * SPACING
        self.world = grid + self.rng.uniform(-0.7, 0.7, grid.shape)
        self.truth, self.t = np.array([0.0, -8.0, 0.0]), 0
        mount = km.Mount(km.sensors.RangeBearing(*SIGHT))
        robot = km.Robot("r", km.motion.Odometry2D(*ODOMETRY), self.truth, {"s": mount})
        self.slam = km.Slam([robot], method)
        self.real: dict[Any, int] = {}  # which landmark of the world each of the map is
        self.wrong = 0

    def step(self, u: np.ndarray, sigmas: np.ndarray) -> Counter[str]:
        """Move by u, told with these sigmas, and look about; return what became of the observations."""
        self.t += 1
        self.truth = km.geometry.compose(self.truth, u)[0]
        told = u + self.rng.normal(size=3) * sigmas
        self.slam.process(km.Control(self.t, "r", told, cov=np.diag(sigmas**2)))
        near = np.flatnonzero(np.linalg.norm(self.world - self.truth[:2], axis=1) < REACH)
        seen = self.rng.permutation(near)[:MOST]
        y = km.geometry.observe(self.truth, self.world[seen])[0] + self.rng.normal(size=(len(seen), 2)) * SIGHT
        y[:, 0] = np.abs(y[:, 0])
        outcomes = self.slam.process(km.Scan(self.t, "r", "s", y)).observations
        for o in outcomes:
            if o.landmark is not None and o.outcome in ("new", "tentative"):
                self.real.setdefault(o.landmark, int(seen[o.index]))
            self.wrong += o.outcome == "associated" and self.real.get(o.landmark) != seen[o.index]
        return Counter(o.outcome for o in outcomes)

    def take(self) -> str:
        """Map, leave, come back, look on ten scans; return what became of the loop."""
        for _ in range(50):
            self.step(np.array([1.0, 0.0, 2 * np.pi / 50]), ODOMETRY)
        self.mapped, self.wrong = self.wrong, 0
        self.step(np.zeros(3), BACK)
        for _ in range(9):
            self.step(np.array([1.0, 0.0, 2 * np.pi / 50]), ODOMETRY)
        error = self.slam.mean("r") - self.truth
        error[2] = (error[2] + np.pi) % (2 * np.pi) - np.pi
        honest = error @ np.linalg.solve(self.slam.covariance("r"), error) < gate(0.999, 3)
        if self.wrong:
            return "wrong"
        return "closed" if honest and np.linalg.norm(error[:2]) < 0.5 else "open"


def main() -> None:
    """Print the table, save it and draw it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--out", type=Path, default=Path("out/loop_closing"))
    arguments = parser.parse_args()
    table: dict[str, Any] = {}
    print("| association | closed | open | wrong | runs with a wrong pair while mapping |\n|---|---|---|---|---|")
    for name in arguments.methods:
        runs = [Run(seed, METHODS[name]) for seed in range(arguments.runs)]
        ends = Counter(run.take() for run in runs)
        shares = {end: 100 * ends[end] / len(runs) for end in ("closed", "open", "wrong")}
        table[name] = shares | {"mapping": 100 * sum(run.mapped > 0 for run in runs) / len(runs)}
        print(f"| {name} | " + " | ".join(f"{share:.1f} %" for share in table[name].values()) + " |", flush=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "loop_closing.json").write_text(json.dumps({"runs": arguments.runs, "per_cent": table}, indent=1))
    mpl.use("agg")
    figure, axes = plt.subplots(figsize=(6, 2.8), layout="constrained")
    left = np.zeros(len(table))
    for end, colour in (("closed", "tab:green"), ("open", "lightgrey"), ("wrong", "tab:red")):
        widths = np.array([row[end] for row in table.values()])
        axes.barh(list(table), widths, left=left, color=colour, label=end)
        left += widths
    axes.set(xlabel="runs, %")
    axes.invert_yaxis()
    figure.legend(loc="outside upper center", ncols=3, title="Loops closed from three landmark spacings off")
    figure.savefig(arguments.out / "loop_closing.png", dpi=120)


if __name__ == "__main__":
    main()
