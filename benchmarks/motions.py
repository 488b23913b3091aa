"""How consistent motions and sensors of the state are: runs of a shipped world each, scored against the truth.

    python benchmarks/motions.py [WORLD ...] [--runs 100] [--seed 0]

The runs are those of `kalmark campaign WORLD --runs 100`.  Printed for each: the mean pose ANEES (3) and how many steps
are inside the 95 % band of so many runs; the ANEES of a state with more than a pose, by its degrees of freedom; at the
end of the runs the mean NEES of the constants of controls and sensors (radii, track, biases, scales, declination, path
loss, mounts) in the map, by their number, and how many runs are inside the 99.7 % bound; and by what factor the
constants are known better than before; and the standard error of the pose ANEES, of the means of the runs: the errors
of a run are correlated over time, so that many steps are outside the band together.  With `--estimator ekf` by the
textbook filter.
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
from kalmark.geometry.spaces import mount_space
from kalmark.models.protocols import calibrating, parameter_covariance
from kalmark.results.measures import anees_interval
from kalmark.simulate import load_world
from kalmark.simulate.robots import simulation
from kalmark.slam.motion import bias_name

WORLDS = (
    "differential_drive", "tricycle", "omnidirectional", "mecanum", "slipping_unicycle", "constant_velocity",
    "constant_turn_rate", "compass_and_gyro", "diver", "radar", "radar_in_space", "radio", "microphones", "lever_arm",
    "wheels_and_gyro",
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


def run(name: str, seed: SeedSequence, estimator: str) -> Scored:
    """Simulate, filter and score one run of a world."""
    pin()
    world = load_world(name, [f"filter.estimator.type={estimator}"])
    simulated = simulation(world, seed)
    slam = build_slam(world.config(), simulated.log)
    scores = score(slam, simulated, world.times(), map_every=world.steps)
    (robot,) = slam.robots.values()
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # error, covariance and prior of each block
    if (model := calibrating(robot.motion)) is not None:
        block = bias_name(robot.name)
        found.append(
            (slam.mean(block) - simulated.constants[robot.name], slam.covariance(block), model.calibration_cov)
        )
    for key, mount in robot.sensors.items():
        own, size = parameter_covariance(mount.sensor), len(mount.at) if len(mount.at) == 3 else 6
        if own is None and mount.cov is None:
            continue
        name, space = f"{robot.name}.{key}", mount_space(len(mount.at), 0 if own is None else len(own))
        truth = simulated.mounts[robot.name, key]
        if own is not None:
            truth = np.concatenate([truth, simulated.sensors[robot.name, key].parameters])
        d, P, prior = space.minus(slam.mean(name), truth), slam.covariance(name), np.zeros((space.dof, space.dof))
        prior[:size, :size] = 0.0 if mount.cov is None else mount.cov
        prior[size:, size:] = 0.0 if own is None else own
        open_ = np.diag(P) > 0
        pick = np.ix_(open_, open_)
        found.append((d[open_], P[pick], prior[pick]))
    value = sum(float(d @ np.linalg.solve(P, d)) for d, P, _ in found) if found else np.nan
    better = np.concatenate([np.sqrt(np.diag(C) / np.diag(P)) for _, P, C in found] or [np.zeros(0)])
    state = scores.series["state"][0] / scores.series["state_dof"][0]
    return Scored(scores.series["pose"][0], state, value, len(better), better, scores.diverged)


def report(name: str, runs: int, estimator: str, seed: int) -> None:
    """Print the row of a world."""
    scored = Parallel(n_jobs=2)(delayed(run)(name, s, estimator) for s in SeedSequence(seed).spawn(runs))
    pose = np.mean([one.pose for one in scored], axis=0)
    low, high = anees_interval(3 * load_world(name).dimensions - 3, runs)
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
    error = np.std([np.nanmean(one.pose) for one in scored]) / np.sqrt(runs)
    print(line + f"; diverged {sum(one.diverged for one in scored)}; pose +- {error:.2f}", flush=True)


def main() -> None:
    """Print a row for each world."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="*", default=WORLDS)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--estimator", default="invariant")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    for name in given.worlds:
        report(name, given.runs, given.estimator, given.seed)


if __name__ == "__main__":
    main()
