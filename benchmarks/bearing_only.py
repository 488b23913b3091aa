"""How often is a landmark right that was started from bearings alone?  [S] 2.3.6; [T] 2.

    python benchmarks/bearing_only.py [--trials 300] [--out out/bearing_only]

A robot drives 60 steps of .25 m on an arc of 8.3 m radius (odometry sigma 1 cm, 1 cm, .3 deg a step) and measures the
bearing, sigma 1 deg, of one landmark anywhere around its start, at 5 to 20 m or at 20 to 80 m.  Three ways to start it:

* inverse depth: at first sight, `InverseDepth2D()` with its default prior;
* delayed: `Delayed()` with its defaults;
* naive: at first sight as a Cartesian point in the middle of the ranges, the depth's sigma a quarter of their spread
  (a fifth of the depth at least).

Consistent: at the end the truth lies inside the 99.9 % ellipse, of the point, or of direction and inverse depth while
it is one.  Near: the distance from the robot is right to 20 %.  Printed and saved: both in per cent of those started.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np

import kalmark as km
from kalmark.geometry import wrap
from kalmark.geometry.frames import compose
from kalmark.geometry.gaussian import gate

STEPS, U = 60, np.array([0.25, 0.0, 0.03])
NOISE, SIGMA = np.array([0.01, 0.01, np.radians(0.3)]), np.radians(1.0)
RANGES = ((5.0, 20.0), (20.0, 80.0))
WAYS = ("inverse depth", "delayed", "naive")


class Outcome(NamedTuple):
    """A trial: NEES of the landmark, its distance by the true one, and the kind it ended as; None if never started."""

    nees: float
    ratio: float
    kind: str


def trial(seed: int, way: str, reach: tuple[float, float]) -> Outcome | None:
    """Run one trial; the same seed sees the same landmark and the same noise, however it is started."""
    rng, pose = np.random.default_rng(seed), np.zeros(3)
    d, a = rng.uniform(*reach), rng.uniform(-np.pi, np.pi)
    truth = d * np.array([np.cos(a), np.sin(a)])
    mount = km.Mount(km.sensors.Bearing(SIGMA), initialization=km.Delayed() if way == "delayed" else None)
    slam = km.Slam([km.Robot("r", km.motion.Odometry2D(*NOISE), sensors={"eye": mount})])
    for k in range(STEPS):
        pose = compose(pose, U)[0]
        slam.process(km.Control(0.1 * k, "r", U + rng.normal(size=3) * NOISE))
        ray = truth - pose[:2]
        y = wrap(np.arctan2(ray[1], ray[0]) - pose[2] + rng.normal() * SIGMA)
        if way == "naive" and k == 0:
            slam.add_landmark(1, *naive(slam.mean("r"), y, reach), km.landmarks.Point2D())
        slam.process(km.Scan(0.1 * k, "r", "eye", [[y]], [1]))
    return judged(slam, truth, pose) if len(slam.landmarks()) else None


def naive(r: np.ndarray, y: float, reach: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return a point half way between the ranges, and a covariance along and across the ray."""
    depth, spread = sum(reach) / 2, max((reach[1] - reach[0]) / 4, sum(reach) / 10)
    E = km.geometry.rotation(r[2] + y)
    return r[:2] + depth * E[:, 0], E @ np.diag([spread**2, (depth * SIGMA) ** 2 + NOISE[0] ** 2]) @ E.T


def judged(slam: km.Slam, truth: np.ndarray, pose: np.ndarray) -> Outcome:
    """Judge the landmark: as a point, or by direction and inverse depth from where it is anchored."""
    kind: Any = slam.landmark_model(1)
    l, P = slam.mean(1), slam.covariance(1)
    p, e = l, truth - l[:2]
    if kind.kind != "point":
        d = float(np.hypot(*e))
        J = np.array([[e[1] / d**2, -e[0] / d**2, -1, 0], [e[0] / d**3, e[1] / d**3, 0, -1]])
        e, P = np.array([wrap(np.arctan2(e[1], e[0]) - l[2]), 1 / d - l[3]]), J @ P @ J.T
        p = kind.to_point(l[None])[0][0] if l[3] > 0 else np.full(2, np.inf)
    ratio = np.hypot(*(p - pose[:2])) / np.hypot(*(truth - pose[:2]))
    return Outcome(float(e @ np.linalg.solve(P, e)), float(ratio), kind.kind)


def main() -> None:
    """Print the table, save it and draw it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--out", type=Path, default=Path("out/bearing_only"))
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    print("| range m | started as | started % | consistent % | near % | NEES mean, median (2, 1.39) | points % |")
    print("|---|---|---|---|---|---|---|")
    for reach in RANGES:
        for way in WAYS:
            found = [o for o in (trial(seed, way, reach) for seed in range(options.trials)) if o is not None]
            nees, ratio = np.array([o.nees for o in found]), np.array([o.ratio for o in found])
            row = {
                "range_m": reach,
                "way": way,
                "trials": options.trials,
                "started": len(found),
                "consistent": float(np.mean(nees < gate(0.999, 2))) if found else None,
                "near": float(np.mean(np.abs(ratio - 1) < 0.2)) if found else None,
                "nees": nees.tolist(),
                "points": sum(o.kind == "point" for o in found),
            }
            rows.append(row)
            part = 100 / max(1, len(found))
            print(
                f"| {reach[0]:.0f} to {reach[1]:.0f} | {way} | {100 * len(found) / options.trials:.0f} | "
                f"{part * np.sum(nees < gate(0.999, 2)):.1f} | {part * np.sum(np.abs(ratio - 1) < 0.2):.1f} | "
                f"{np.mean(nees):.2f}, {np.median(nees):.2f} | {part * row['points']:.0f} |",
                flush=True,
            )
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "bearing_only.json").write_text(json.dumps(rows, indent=1))
    draw(rows, options.out / "bearing_only.png")


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw how NEES is distributed, against the chi-square distribution it should have."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from scipy.stats import chi2

    figure, axes = plt.subplots(1, len(RANGES), figsize=(10, 4), sharey=True, layout="constrained")
    x = np.geomspace(0.01, 1e4, 400)
    for axis, reach in zip(axes, RANGES, strict=True):
        axis.semilogx(x, chi2.cdf(x, 2), "k--", lw=1, label="consistent: chi-square, 2")
        for row, colour in zip([r for r in rows if r["range_m"] == reach], ("C0", "C2", "C3"), strict=True):
            label = f"{row['way']} ({row['started']} of {row['trials']} started)"
            axis.step(
                np.sort(row["nees"]), np.arange(1, row["started"] + 1) / row["started"], color=colour, label=label
            )
        axis.axvline(gate(0.999, 2), color="0.7", lw=1)
        axis.set(
            title=f"landmarks at {reach[0]:.0f} to {reach[1]:.0f} m", xlabel="NEES of the landmark", xlim=(0.01, 1e4)
        )
        axis.legend(loc="lower right", fontsize=8)
    axes[0].set_ylabel("part of the trials below")
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
