"""One camera on a robot that coasts: by how much its scale is off, and by how much the filter says that it may be.

    python benchmarks/coasting_scale.py [--runs 20] [--set robots.robot.motion.sigma_v_mps=0.001 ...]

World `thick_cloister_constant_velocity`.  Printed at some times: how far along the line from the start the estimate is
off, as a share of the distance, on average and its sigma; what 3 N (sigma_v / v)^2 gives after N impulses; and the NEES
of the position (3).  docs/bearing_only.md.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.random import SeedSequence

import kalmark as km
from kalmark.config.building import build_slam
from kalmark.simulate import load_world
from kalmark.simulate.robots import simulation

TIMES_S = 2.2, 4.2, 6.2, 10.2, 20.2, 40.0
START, SPEED_MPS = np.array([0.0, -5.0, 0.0]), 0.8


def run(seed: SeedSequence, over: list[str]) -> list[tuple[float, float, float]]:
    """Return, at each time, the share by which the way from the start is off, its sigma, and the position's NEES."""
    world = load_world("thick_cloister_constant_velocity", over)
    sim = simulation(world, seed)
    slam, found = build_slam(world.config(), sim.log), []
    true = dict(zip(sim.log.truth["robot"].t_ns.tolist(), sim.log.truth["robot"].poses[:, :3], strict=True))
    for event in sim.log:
        slam.process(event)
        if isinstance(event, km.Scan) and any(abs(event.t_ns * 1e-9 - t_s) < 1e-6 for t_s in TIMES_S):
            p, P, way = slam.mean("robot")[:3], slam.covariance("robot")[:3, :3], true[event.t_ns] - START
            d, far = p - true[event.t_ns], float(np.linalg.norm(way))
            u = way / far
            found.append((float(u @ d) / far, float(np.sqrt(u @ P @ u)) / far, float(d @ np.linalg.solve(P, d))))
    return found


def main() -> None:
    """Print a row for each time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    sigma = next(
        (float(each.split("=")[1]) for each in given.set if each.startswith("robots.robot.motion.sigma_v_mps=")), 0.01
    )
    off = np.array([run(seed, given.set) for seed in SeedSequence(0).spawn(given.runs)])
    for k, t_s in enumerate(TIMES_S):
        mean, told, nees = off[:, k].mean(axis=0)
        predicted = 3 * t_s / 0.1 * (sigma / SPEED_MPS) ** 2
        print(f"{t_s:.1f} s: scale {mean:+.2%}, sigma {told:.2%}, predicted -{predicted:.2%}, position NEES {nees:.2f}")


if __name__ == "__main__":
    main()
