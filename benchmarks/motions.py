"""How consistent each motion model is: runs of its own shipped world, scored against the truth.

    python benchmarks/motions.py [WORLD ...] [--runs 100]

The runs are those of `kalmark campaign WORLD --runs 100`.  Printed for each: the mean pose ANEES (3) and how many steps
are inside the 95 % band of so many runs; the ANEES of a state with more than a pose, by its degrees of freedom; at the
end of the runs the mean NEES of the constants of the controls (radii, track, biases, scales) in the map, by their
number, and how many runs are inside the 99.7 % bound; and by what factor the constants are known better than before.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import numpy as np
from joblib import Parallel, delayed
from numpy.random import SeedSequence
from scipy.stats import chi2
from ways import pin

from kalmark.campaign.scoring import score
from kalmark.config.building import build_slam
from kalmark.models.protocols import calibrating
from kalmark.results.measures import anees_interval
from kalmark.simulate import load_world
from kalmark.simulate.robots import simulation
from kalmark.slam.motion import bias_name

WORLDS = (
    "differential_drive", "tricycle", "omnidirectional", "mecanum", "slipping_unicycle", "constant_velocity",
    "constant_turn_rate",
)  # fmt: skip
BOUND = 0.9973  # of three sigmas


class Scored(NamedTuple):
    """One run: NEES of pose (steps,) and state (steps,) over its dof, NEES of the constants, and how they improved."""

    pose: np.ndarray
    state: np.ndarray
    constants: float
    count: int
    better: np.ndarray
    diverged: bool


def run(name: str, seed: SeedSequence) -> Scored:
    """Simulate, filter and score one run of a world."""
    pin()
    world = load_world(name)
    simulated = simulation(world, seed)
    slam = build_slam(world.config(), simulated.log)
    scores = score(slam, simulated, world.times(), map_every=world.steps)
    (robot,) = slam.robots.values()
    model, value, better = calibrating(robot.motion), np.nan, np.zeros(0)
    if model is not None:
        truth, block = simulated.constants[robot.name], bias_name(robot.name)
        d, P = slam.mean(block) - truth, slam.covariance(block)
        value, better = float(d @ np.linalg.solve(P, d)), np.sqrt(np.diag(model.calibration_cov) / np.diag(P))
    state = scores.series["state"][0] / scores.series["state_dof"][0]
    return Scored(scores.series["pose"][0], state, value, len(better), better, scores.diverged)


def report(name: str, runs: int) -> None:
    """Print the row of a world."""
    scored = Parallel(n_jobs=2)(delayed(run)(name, seed) for seed in SeedSequence(0).spawn(runs))
    pose = np.mean([one.pose for one in scored], axis=0)
    low, high = anees_interval(3, runs)
    known = np.isfinite(pose)
    inside = np.mean((pose[known] > low) & (pose[known] < high))
    line = f"{name:20s} pose {np.mean(pose[known]):5.2f}, in the band {inside:5.1%}"
    state = np.mean([one.state for one in scored], axis=0)
    if np.isfinite(state).any():
        line += f"; state {np.nanmean(state):5.2f}"
    if scored[0].count:
        values = np.array([one.constants for one in scored])
        within = int(np.sum(values < chi2.ppf(BOUND, scored[0].count)))
        better = np.mean([one.better for one in scored], axis=0)
        line += f"; constants {np.mean(values) / scored[0].count:5.2f}, inside {within} of {runs}"
        line += f", known better by {', '.join(f'{factor:.1f}' for factor in better)}"
    print(line + f"; diverged {sum(one.diverged for one in scored)}", flush=True)


def main() -> None:
    """Print a row for each world."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="*", default=WORLDS)
    parser.add_argument("--runs", type=int, default=100)
    given = parser.parse_args()
    for name in given.worlds:
        report(name, given.runs)


if __name__ == "__main__":
    main()
