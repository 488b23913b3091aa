"""Sensors that meet on one landmark: a camera begins landmarks of unknown depth, a radio tells how far they are.

    python benchmarks/depths.py [CASE ...] [--runs 100] [--seed 0] [--estimator invariant]

8 landmarks, 40 steps, the radio at every second one: 160 measurements of it in a run.  In the plane the radio measures
ranges of .1 m; in space it measures strengths of .1 dB (a range to 1.2 %) or 1 dB (to 12 %).  Printed for each case: of
the 160 how many are used, in the worst run and on average; the mean pose ANEES and how many steps are inside the 95 %
band of so many runs; the same of the landmarks, whose depth is known to a third at least.  Landmarks of a run share the
error of its pose, so that their band is that of one landmark a run.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.random import SeedSequence
from ways import pin

from kalmark.campaign.campaign import Anees
from kalmark.campaign.scoring import Scores, score
from kalmark.config.building import build_slam
from kalmark.events import Scan
from kalmark.simulate import World, load_world
from kalmark.simulate.robots import simulation

PRIOR = "prior_rho_per_m: 0.12, sigma_rho_per_m: 0.06"
IN_PLANE = """
world: {type: loop, count: 8, x_m: 3.0, radius_m: 9.0, angles: even}
robots:
  r:
    route: {type: constant, u: [0.15, 0.0, 0.02]}
    motion: {type: odometry_2d, sigma_x_m: 0.02, sigma_y_m: 0.02, sigma_theta_rad: 0.005}
    sensors:
      camera: {type: bearing, sigma_bearing_rad: 0.01, landmark: {type: inverse_depth, PRIOR}}
      radio: {type: range, sigma_range_m: 0.1}
    sensing: {radio: {every: 2}}
steps: 40
dt_s: 0.1
"""
IN_SPACE = """
world: {type: random_box, count: 8, min_m: [6, -3, -2], max_m: [14, 3, 2]}
robots:
  r:
    route: {type: constant, u: [0.05, 0.03, 0.02, 0.0, 0.0, 0.005]}
    motion: {type: odometry_3d, sigma_x_m: 0.005, sigma_y_m: 0.005, sigma_z_m: 0.005, sigma_rotation_rad: 0.001}
    sensors:
      camera: {type: pinhole, mount: {roll_deg: -90, yaw_deg: -90}, landmark: {type: KIND, PRIOR}}
      radio: {type: signal_strength, sigma_db: NOISE}
    sensing: {radio: {every: 2}}
steps: 40
dt_s: 0.1
"""
KINDS = ("inverse_depth", "anchored_homogeneous", "homogeneous")
WORLDS = {"bearing and range": IN_PLANE} | {
    f"pinhole {kind} {db} dB": IN_SPACE.replace("KIND", kind).replace("NOISE", str(db))
    for kind in KINDS
    for db in (0.1, 1.0)
}


class Scored(NamedTuple):
    """One run: measurements of the radio and how many were used, and its scores."""

    ranges: int
    used: int
    scores: Scores


def world_of(case: str, estimator: str) -> World:
    """Return the world of a case."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.yaml"
        path.write_text(WORLDS[case].replace("PRIOR", PRIOR))
        return load_world(str(path), [f"filter.estimator.type={estimator}"])


def run(world: World, seed: SeedSequence) -> Scored:
    """Simulate one run, and filter it twice: to count what is used, and to score."""
    simulated = simulation(world, seed)
    slam = build_slam(world.config(), simulated.log)
    reports = [(event, slam.process(event)) for event in simulated.log.events]
    of_radio = [r for event, r in reports if isinstance(event, Scan) and event.sensor == "radio"]
    outcomes = [o.outcome for report in of_radio for o in report.observations]
    scores = score(build_slam(world.config(), simulated.log), simulated, world.times(), map_every=1)
    return Scored(len(outcomes), outcomes.count("associated"), scores)


def in_band(name: str, scored: list[Scored]) -> str:
    """Return the average NEES of something over runs and steps, and how many steps are inside the band."""
    anees = Anees(name, [one.scores for one in scored])
    return f"{anees.average:5.2f} ({anees.ideal:.0f}), in the band {anees.inside:5.1%}"


def report(case: str, runs: int, seed: int, estimator: str) -> None:
    """Print the row of a case."""
    world = world_of(case, estimator)
    scored = [run(world, s) for s in SeedSequence(seed).spawn(runs)]
    used, ranges = [one.used for one in scored], np.mean([one.ranges for one in scored])
    print(
        f"{case}: used {min(used)} at least, {np.mean(used):.1f} on average of {ranges:.0f}; "
        f"pose {in_band('pose', scored)}; landmarks {in_band('landmarks', scored)}",
        flush=True,
    )


def main() -> None:
    """Print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=list(WORLDS))
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--estimator", default="invariant")
    given = parser.parse_args()
    pin()
    for case in given.cases:
        report(case, given.runs, given.seed, given.estimator)


if __name__ == "__main__":
    main()
