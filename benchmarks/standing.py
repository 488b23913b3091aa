"""Zero-velocity updates: runs of the world `stop_and_go`, with and without them.

    python benchmarks/standing.py [--runs 100]

Printed for the motion of the world, and for one with the velocity in its state that has no controls: the mean
pose ANEES (3) and how many steps are inside the 95 % band of so many runs; the mean sigmas of position and heading, and
the errors in them (RMS), at the end of stops; the sigma of the gyroscope's bias in the end; how many of the stops
were noticed, in windows, and how many windows were taken for a stop in which the robot moved faster than the slowest
motion that counts; and with updates the ANEES less that without, of the same runs, and the standard error of that.

The motion with the velocity in its state has white accelerations with the sigma of the world's ramps: in a ramp of 1 s
the velocity changes by one sigma.  While the robot drives or stands it does not change, so that the noise is too large
there and the ANEES below 3.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from joblib import Parallel, delayed
from numpy.random import SeedSequence
from ways import pin

import kalmark as km
from kalmark.campaign.scoring import robot_turn, state_error
from kalmark.config.building import build_robot
from kalmark.events import Control, Scan
from kalmark.results.measures import anees_interval
from kalmark.simulate import load_world
from kalmark.simulate.robots import simulation

COASTING = km.motion.ConstantVelocity(
    sigma_vx_mps_per_sqrt_s=0.5, sigma_vy_mps_per_sqrt_s=0.1, sigma_w_radps_per_sqrt_s=0.1
)
SLOWEST_MPS = km.sensors.ZeroVelocity2D().slowest_mps


class Scored(NamedTuple):
    """One run: pose NEES at each scan of the lidar, sigmas and errors at the end of stops (S, 3), windows, bias."""

    nees: np.ndarray
    sigmas: np.ndarray
    errors: np.ndarray
    noticed: int
    wrong: int
    bias: float


def run(seed: SeedSequence, coasting: bool, zero: bool) -> Scored:
    """Simulate, filter and score one run."""
    pin()
    world = load_world("stop_and_go")
    simulated = simulation(world, seed)
    (states,) = simulated.states.values()
    behind = round(1.0 / world.dt_s)  # steps of a window
    robot = build_robot(world.models(), "rover")
    sensors = {name: mount for name, mount in robot.sensors.items() if zero or name != "still"}
    start: Any = robot.start[:3]
    cov = np.diag([0.0, 0.0, 0.0, 0.25, 0.01, 0.01]) if coasting else robot.cov
    motion = COASTING if coasting else robot.motion
    slam = km.Slam(replace(robot, motion=motion, start=start, cov=cov, sensors=sensors))
    nees, sigmas, errors, noticed, wrong = [], [], [], 0, 0
    for event in simulated.log:
        if coasting and isinstance(event, Control):
            continue
        report = slam.process(event)
        k = round(event.t_s / world.dt_s)
        if report.standing is not None:
            moved = float(np.linalg.norm(states[k][:2] - states[max(0, k - behind)][:2]))
            noticed += moved < 1e-6
            wrong += moved > SLOWEST_MPS * behind * world.dt_s
        if isinstance(event, Scan) and event.sensor == "lidar":
            P = slam.covariance("rover")[:3, :3]
            mean = slam.mean("rover")[:3]
            d = state_error(mean, states[k][:3], robot_turn(mean, states[k]), slam.estimator.coordinates)
            nees.append(d @ np.linalg.solve(P, d))
            if k % 300 == 0:
                sigmas.append(np.sqrt(np.diag(P)))
                errors.append(state_error(mean, states[k][:3], 0.0, "world"))
    bias = float(np.sqrt(slam.covariance("rover.gyro")[-1, -1]))
    return Scored(np.array(nees), np.array(sigmas), np.array(errors), noticed, wrong, bias)


def report(coasting: bool, zero: bool, runs: int, before: np.ndarray | None = None) -> np.ndarray:
    """Print one row; return the mean NEES (runs,) of each run, which are compared with those `before`."""
    scored = Parallel(n_jobs=2)(delayed(run)(seed, coasting, zero) for seed in SeedSequence(0).spawn(runs))
    length = min(len(one.nees) for one in scored)
    nees = np.mean([one.nees[:length] for one in scored], axis=0)
    low, high = anees_interval(3, runs)
    inside = np.mean((nees > low) & (nees < high))
    sigmas, errors = (np.concatenate([getattr(one, key) for one in scored]) for key in ("sigmas", "errors"))
    s, e = np.mean(sigmas, axis=0), np.sqrt(np.mean(errors**2, axis=0))
    name = f"{'constant_velocity' if coasting else 'slipping_unicycle'}, {'with' if zero else 'without'}:"
    places = f"sigma {np.hypot(*s[:2]):.3f} m {s[2]:.4f} rad, error {np.hypot(*e[:2]):.3f} m {e[2]:.4f} rad"
    each = np.array([one.nees.mean() for one in scored])
    more = each - each if before is None else each - before
    print(
        f"{name:28s} pose {np.mean(nees):5.2f}, in the band {inside:5.1%}; {places}; "
        f"bias {np.mean([one.bias for one in scored]):.5f} rad/s; "
        f"stops {sum(one.noticed for one in scored) / (60 * runs):5.1%}, false {sum(one.wrong for one in scored)}; "
        f"ANEES more by {more.mean():+.2f} +- {more.std() / np.sqrt(runs):.2f}",
        flush=True,
    )
    return each


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100)
    given = parser.parse_args()
    for coasting in (False, True):
        report(coasting, True, given.runs, report(coasting, False, given.runs))


if __name__ == "__main__":
    main()
