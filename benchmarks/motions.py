"""How consistent motions and sensors of the state are: runs of a shipped world each, scored against the truth.

    python benchmarks/motions.py [WORLD ...] [--runs 100] [--seed 0] [--noise 1] [--of 100]

The runs are those of `kalmark campaign WORLD --runs 100`.  Printed for each: the mean pose ANEES (3) and how many steps
are inside the 95 % band of so many runs; the ANEES of a state with more than a pose, by its degrees of freedom; at the
end of the runs the mean NEES of the constants of controls and sensors (radii, track, biases, scales, declination, path
loss, mounts) in the map, by their number, and how many runs are inside the 99.7 % bound; and by what factor the
constants are known better than before; and the standard error of the pose ANEES, of the means of the runs: the errors
of a run are correlated over time, so that many steps are outside the band together.  With `--estimator ekf` by the
textbook filter.

Two ways to see how much of a row is chance (docs/evaluation.md).  `--noise 0.1`: all sigmas of the robots a tenth.  The
draws are the same, and the filter, first order in the errors, is as good as exact: what it misses then is chance.
`--runs 400`: the row of the first `--of` runs; of all the pose ANEES, the steps in the band of each `--of` runs, and
how often so many drawn of all have 90 %.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed
from numpy.random import SeedSequence
from scipy.stats import chi2
from ways import pin

from kalmark.campaign.campaign import Anees, figures
from kalmark.campaign.scoring import Scores, score
from kalmark.config.building import build_slam
from kalmark.geometry.spaces import mount_space
from kalmark.models.protocols import parameter_covariance, self_calibrating
from kalmark.simulate import load_world
from kalmark.simulate.robots import simulation
from kalmark.slam.held_control import bias_name

WORLDS = (
    "differential_drive", "tricycle", "omnidirectional", "mecanum", "slipping_unicycle", "constant_velocity",
    "constant_turn_rate", "compass_and_gyro", "diver", "radar", "radar_in_space", "radio", "microphones", "lever_arm",
    "wheels_and_gyro", "scan_matching",
)  # fmt: skip
BOUND = 0.9973  # of three sigmas
WANTED, DRAWS = 0.9, 1000  # steps in the band, and how often runs are drawn of all


class Scored(NamedTuple):
    """One run: its scores, the NEES of the constants, their number, and how they improved."""

    scores: Scores
    constants: float
    count: int
    better: np.ndarray


def scaled(tree: Any, noise: float, path: str = "robots") -> Iterator[str]:
    """Yield the overrides that multiply all sigmas of a world's robots by `noise`."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from scaled(value, noise, f"{path}.{key}")
        elif key.startswith("sigma_"):
            yield f"{path}.{key}={noise * value!r}"


def run(name: str, seed: SeedSequence, estimator: str, noise: float) -> Scored:
    """Simulate, filter and score one run of a world."""
    pin()
    world = load_world(name, overrides(name, estimator, noise))
    simulated = simulation(world, seed)
    slam = build_slam(world.config(), simulated.log)
    scores = score(slam, simulated, world.times(), map_every=world.steps)
    (robot,) = slam.robots.values()
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # error, covariance and prior of each block
    if (model := self_calibrating(robot.motion)) is not None:
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
    return Scored(scores, value, len(better), better)


def overrides(name: str, estimator: str, noise: float) -> list[str]:
    """Return the overrides of a world for an estimator and all sigmas times `noise`."""
    robots = load_world(name).model_dump(exclude_none=True)["robots"] if noise != 1.0 else {}
    return [f"filter.estimator.type={estimator}", *scaled(robots, noise)]


def row(name: str, scored: list[Scored]) -> str:
    """Return the row of runs of a world."""
    scores, runs = [one.scores for one in scored], len(scored)
    pose, state, found = Anees("pose", scores), Anees("state", scores), figures(scores)
    line = f"{name:20s} pose {pose.average:5.2f}, in the band {pose.inside:5.1%}"
    if np.isfinite(state.average):
        line += f"; state {state.average / state.ideal:5.2f}"
    if scored[0].count:
        values = np.array([one.constants for one in scored])
        within = int(np.sum(values < chi2.ppf(BOUND, scored[0].count)))
        better = np.mean([one.better for one in scored], axis=0)
        line += f"; constants {np.mean(values) / scored[0].count:5.2f}, inside {within} of {runs}"
        line += f", known better by {', '.join(f'{factor:.1f}' for factor in better)}"
    return line + f"; diverged {found['diverged']}; pose +- {found['pose_anees_sigma']:.2f}"


def together(scored: list[Scored], of: int) -> str:
    """Return the pose ANEES of all runs, and what share of the steps is in the band, of each `of` and of many drawn."""
    scores, runs, rng = [one.scores for one in scored], len(scored), np.random.default_rng(0)
    pose, sigma = Anees("pose", scores), figures(scores)["pose_anees_sigma"]
    each = [Anees("pose", scores[i : i + of]).inside for i in range(0, runs - of + 1, of)]
    drawn = [rng.choice(runs, of, replace=False) for _ in range(DRAWS)]
    often = np.mean([Anees("pose", [scores[i] for i in few]).inside >= WANTED for few in drawn])
    shown = "/".join(f"{share:.0%}" for share in each)
    return (
        f"{runs} runs: pose {pose.average:.2f} +- {sigma:.2f}, in the band {pose.inside:.1%}; "
        f"in that of {of} {shown}; of {of} drawn {often:.0%} have {WANTED:.0%}"
    )


def report(name: str, runs: int, estimator: str, seed: int, noise: float, of: int) -> None:
    """Print the row of a world for its first `of` runs, and that of all."""
    scored = Parallel(n_jobs=2)(delayed(run)(name, s, estimator, noise) for s in SeedSequence(seed).spawn(runs))
    print(row(name, scored[:of]), flush=True)
    if runs > of:
        print(f"{name}, {together(scored, of)}", flush=True)


def main() -> None:
    """Print a row for each world."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="*", default=WORLDS)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--estimator", default="invariant")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--noise", type=float, default=1.0)
    parser.add_argument("--of", type=int, default=100)
    given = parser.parse_args()
    for name in given.worlds:
        report(name, given.runs, given.estimator, given.seed, given.noise, given.of)


if __name__ == "__main__":
    main()
