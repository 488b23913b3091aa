"""How far a compressed map is from the dense one where a mount calibrates itself: two laps with both filters.

    python benchmarks/compressed_mount.py [--runs 20] [--seed 0]

A laser at .3 m and .1 m of a robot that goes twice round a circle of 20 m among 150 landmarks.  Printed for each
uncertainty of the mount: by how many sigmas of the dense filter the landmark that differs most is off, and the mount,
least and greatest of the runs; by what share a sigma of the robot, the mount or a landmark is smaller, at most.
"""

from __future__ import annotations

import argparse

import numpy as np
from ways import pin

import kalmark as km

KNOWN, USUAL, POOR = "known", "5 cm and 1.5 deg", "20 cm and 9 deg"
SIGMAS = {KNOWN: (0.0, 0.0), USUAL: (0.05, np.deg2rad(1.5)), POOR: (0.2, np.deg2rad(9.0))}  # m, rad
STEPS, DT_S, U = 500, 0.2, np.array([2.5, 0.125])  # two laps: m/s, rad/s


def run(seed: int, sigma_m: float, sigma_rad: float) -> tuple[float, float, float, int]:
    """Return by how many sigmas the worst landmark and the mount are off, what share a sigma is smaller, landmarks."""
    rng, at, motion = np.random.default_rng(seed), np.array([0.3, 0.1, 0.0]), km.motion.Unicycle(0.1, 0.02)
    angle, away = rng.uniform(0, 2 * np.pi, 150), rng.uniform(16, 24, 150)
    points = np.column_stack([away * np.cos(angle), away * np.sin(angle)])
    sigmas = np.array([sigma_m, sigma_m, sigma_rad])
    true, cov = at + sigmas * rng.normal(size=3), np.diag(sigmas**2) if sigma_m else None
    lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.01), at=at, cov=cov)
    r = np.array([20.0, 0.0, np.pi / 2])
    dense, compressed = (
        km.Slam([km.Robot("r", motion, r, {"lidar": lidar})], km.association.ByIdentity("off"), map=kind)
        for kind in ("dense", "postponed")
    )
    for k in range(STEPS):
        control = km.Control(DT_S * k, "r", U + rng.normal(0, [0.1, 0.02]))
        r = motion.move(r, U, DT_S)[0]
        y = km.geometry.observe(km.geometry.compose(r, true)[0], points)[0]
        near = np.flatnonzero((y[:, 0] < 6.0) & (y[:, 0] > 0.6))[:10]
        y = y[near] + rng.normal(size=(len(near), 2)) * [0.1, 0.01]
        for slam in (dense, compressed):
            slam.process(control)
            slam.process(km.Scan(DT_S * (k + 1), "r", "lidar", y, near))
    ids = dense.landmarks().ids
    off, smaller = [], []
    for name in [*ids, "r"] + ["r.lidar"] * bool(sigma_m):
        of_dense, own = (np.sqrt(np.diag(slam.covariance(name))) for slam in (dense, compressed))
        off.append(np.max(np.abs(dense.mean(name) - compressed.mean(name)) / of_dense))
        smaller.append(np.max(1 - own / of_dense))
    return max(off[: len(ids)]), off[-1] if sigma_m else 0.0, max(smaller), len(ids)


def main() -> None:
    """Print a row for each uncertainty of the mount."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    pin()
    for name, sigmas in SIGMAS.items():
        off, mount, smaller, count = np.array([run(given.seed + k, *sigmas) for k in range(given.runs)]).T
        print(
            f"mount {name}: worst of {count.min():.0f} landmarks or more off {off.min():.3f} to {off.max():.3f}", end=""
        )
        print(
            f", mount {mount.min():.3f} to {mount.max():.3f}, a sigma smaller by {100 * smaller.max():.2f} %",
            flush=True,
        )


if __name__ == "__main__":
    main()
