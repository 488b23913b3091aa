"""How consistent mounts are that calibrate themselves: runs of one robot for each sensor, scored against the truth.

    python benchmarks/mounts.py [SENSOR ...] [--runs 50]

The mount is given with 5 cm and 1.5 deg a coordinate; it truly is elsewhere.  The robots of space turn by 70 deg in the
first four steps, that of `pinhole ahead` starts along its route.  Printed for each sensor: the mean pose
ANEES and how many steps are inside the 95 % band of so many runs; the mean NEES of the mount at the end and in how many
runs it is inside its 99.7 % bound; what of the mount is wrong then, and by what factor it is known better than before.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from joblib import Parallel, delayed
from numpy.random import SeedSequence
from scipy.stats import chi2
from ways import pin

from kalmark.campaign.campaign import Anees
from kalmark.campaign.scoring import Scores, score
from kalmark.config.building import build_slam
from kalmark.simulate import World, load_world
from kalmark.simulate.robots import simulation

IN_SPACE = """
world: {{type: random_box, count: 60, min_m: [-6, -6, -1], max_m: [6, 6, 4]}}
robots:
  r:
    start: {{x_m: 2.0, z_m: 1.0}}
    route:
      type: waypoints
      points_m: [[3, 3, 2.5], [-3, 3, 0], [-3, -3, 2.5], [3, -3, 0]]
      speed_mps: 1.0
      turn_radius_m: 0.3
    motion: {{type: odometry_3d, sigma_x_m: 0.003, sigma_y_m: 0.003, sigma_z_m: 0.003, sigma_rotation_rad: 0.001}}
    sensors: {{s: {{{sensor}, mount: {{{at}, sigma_position_m: 0.05, sigma_rotation_deg: 1.5}}}}}}
steps: 400
dt_s: 0.1
"""
IN_PLANE = """
world: {{type: random_field, count: 40, size_m: 16.0}}
robots:
  r:
    start: {{x_m: 8.0, y_m: 8.0}}
    route: {{type: wander, speed_mps: 1.0, turn_radius_m: 1.0}}
    motion: {{type: odometry_2d, sigma_x_m: 0.01, sigma_y_m: 0.01, sigma_theta_rad: 0.005}}
    sensors: {{s: {{{sensor}, mount: {{{at}, sigma_xy_m: 0.05, sigma_theta_rad: 0.026}}}}}}
steps: 400
dt_s: 0.2
"""
FORWARD = "x_m: 0.2, z_m: 0.3, roll_deg: -90, yaw_deg: -90"
AHEAD = "{x_m: 2.0, z_m: 1.0}", "{x_m: 2.0, z_m: 1.0, yaw_deg: 71.565, pitch_deg: -25.377}"  # towards (3, 3, 2.5)
WORLDS = {
    "stereo": IN_SPACE.format(sensor="type: stereo, baseline_m: 0.2", at=FORWARD),
    "pinhole": IN_SPACE.format(sensor="type: pinhole", at=FORWARD),
    "pinhole ahead": IN_SPACE.format(sensor="type: pinhole", at=FORWARD).replace(*AHEAD),
    "laser in space": IN_SPACE.format(
        sensor="type: range_bearing_3d, sigma_range_m: 0.03, sigma_azimuth_rad: 0.005, sigma_elevation_rad: 0.005,"
        " range_max_m: 8.0",
        at="x_m: 0.2, z_m: 0.3",
    ),
    "laser": IN_PLANE.format(
        sensor="type: range_bearing, sigma_range_m: 0.03, sigma_bearing_rad: 0.005", at="x_m: 0.3"
    ),
    "range": IN_PLANE.format(sensor="type: range, sigma_range_m: 0.1", at="x_m: 0.3"),
}
BOUND = 0.9973  # of three sigmas


class Scored(NamedTuple):
    """One run: its scores, the NEES of the mount at the end, its error and what it is known better by."""

    scores: Scores
    mount: float
    dof: int
    error: np.ndarray
    better: np.ndarray


def world_of(name: str) -> World:
    """Return the world of a sensor."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.yaml"
        path.write_text(WORLDS[name])
        return load_world(str(path))


def run(name: str, seed: SeedSequence) -> Scored:
    """Simulate, filter and score one run."""
    pin()
    world = world_of(name)
    simulated = simulation(world, seed)
    slam = build_slam(world.config(), simulated.log)
    scores = score(slam, simulated, world.times(), map_every=world.steps)
    dof = 3 if world.dimensions == 2 else 6
    before, after = slam.robots["r"].sensors["s"].cov, slam.covariance("r.s")[:dof, :dof]
    assert before is not None
    error = np.array([scores.series["mount_m"][0, -1], np.rad2deg(scores.series["mount_rad"][0, -1])])
    better = np.sqrt(np.diag(before)[:dof] / np.diag(after))
    return Scored(scores, float(scores.series["mount"][0, -1]), dof, error, better)


def report(name: str, runs: int) -> None:
    """Print the row of a sensor."""
    scored = Parallel(n_jobs=2)(delayed(run)(name, seed) for seed in SeedSequence(0).spawn(runs))
    pose, dof = Anees("pose", [one.scores for one in scored]), scored[0].dof
    mounts = np.array([one.mount for one in scored])
    within = int(np.sum(mounts < chi2.ppf(BOUND, dof)))
    metres, degrees = np.sqrt(np.mean([one.error**2 for one in scored], axis=0))
    better = ", ".join(f"{factor:.1f}" for factor in np.mean([one.better for one in scored], axis=0))
    print(
        f"{name:15s} pose {pose.average:5.2f} ({dof}), in the band {pose.inside:5.1%}; "
        f"mount {np.mean(mounts):5.2f}, inside {within} of {runs}, off {1e3 * metres:.1f} mm {degrees:.2f} deg, "
        f"known better by {better}; diverged {sum(one.scores.diverged for one in scored)}",
        flush=True,
    )


def main() -> None:
    """Print a row for each sensor."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sensors", nargs="*", default=list(WORLDS))
    parser.add_argument("--runs", type=int, default=50)
    given = parser.parse_args()
    for name in given.sensors:
        report(name, given.runs)


if __name__ == "__main__":
    main()
