"""Sensors of the state on real logs and in the hall: biases and lever arms found, faults named all the same.

    KALMARK_DATA=... python benchmarks/real_state_sensors.py [woods] [hall] [park] [--runs 5]

* `woods`: Lost in the Woods with a gyroscope of .1 deg/s bias, its readings made from the true headings of the log: the
  bias that the filter finds, with the usual gate and with a wide one.
* `hall`: the hall of `benchmarks/hall.py`, whose right wheel is 1 % larger than its odometry assumes, with a compass of
  unknown declination: in how many runs the diagnosis names the odometry first, and does without a fault.
* `park`: Victoria Park with its GPS as a sensor of the state: antenna's lever arm, from where its data set has it; how
  many fixes are left out; NIS per number and correlation of successive innovations of the others; and the centroids of
  the map by the fixes of the first and of the second half, which have nothing but laser and wheels in common.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import hall
import numpy as np
from scipy.stats import chi2

import kalmark as km
from kalmark.config import build_slam, open_run
from kalmark.datasets.victoria_park import ANTENNA, ROBOT
from kalmark.diagnosis.verdict import diagnose
from kalmark.events import Event, sort_key
from kalmark.filter.kernels import one_thread
from kalmark.geometry.angles import wrap
from kalmark.logs.log import Log
from kalmark.results.record import record

BIAS_RADPS, GYRO_RADPS = np.radians(0.1), 0.005
USUAL, WIDE = 0.9999, 1.0 - 1e-13  # shares of good readings that pass the gate
DECLINATION_RAD, COMPASS_RAD = 0.1, 0.05
ODOMETRY = ("odometry", "wheel", "controls")  # words in the names of causes that are the odometry's
FIX_S = 5.0  # between fixes of the park: they are made five times a second, and their errors last
RECEIVER = "{type: gps, sigma_m: 0.7, sigma_bias_m: 2.0, sigma_bias_m_per_sqrt_s: 0.2, pass_share: 0.999, " \
           "mount: {x_m: 2.0, y_m: 0.0, sigma_xy_m: 2.0}}"  # fmt: skip
HEADING_RAD = 0.63  # of the car at first, by the data set's notes, and its sigma
SIGMA_START_M, SIGMA_START_RAD = 5.0, 0.3


def readings(log: Log, sensor: str, columns: tuple[str, ...], extra: Iterable[Event]) -> Log:
    """Return a log with the readings of another sensor of its one robot."""
    of = {**log.sensor_columns, (log.robots[0], sensor): columns}
    return replace(log, events=sorted([*log.events, *extra], key=sort_key), sensor_columns=of)


def woods() -> None:
    """Print what bias is found in Lost in the Woods, by the usual gate and by a wide one."""
    without = record(*woods_run(0.5, used=False)[:2], progress=False).evaluate()["robots"]["robot"]["ate_raw_m"]
    for gate, share in (("usual", USUAL), ("wide", WIDE)):
        slam, log, count = woods_run(share)
        run = record(slam, log, progress=False)
        position = run.evaluate()["robots"]["robot"]["ate_raw_m"]
        left_out = int(np.sum((run.history.sensor == "gyro") & (run.history.outcome == "rejected")))
        mean, sigma = slam.mean("robot.gyro")[3], np.sqrt(slam.covariance("robot.gyro")[-1, -1])
        off, bias, s = abs(mean - BIAS_RADPS) / sigma, np.degrees(mean), np.degrees(sigma)
        print(
            f"woods, {gate} gate: bias {bias:.4f} deg/s, sigma {s:.4f} deg/s, true {np.degrees(BIAS_RADPS):.4f}, "
            f"off {off:.1f} sigmas; left out {left_out} of {count}; "
            f"position raw {without:.3f} m without, {position:.3f} m with",
            flush=True,
        )


def woods_run(share: float, used: bool = True) -> tuple[km.Slam, Log, int]:
    """Return a filter for Lost in the Woods and the log, with readings of a gyroscope if `used`, and how many."""
    numbers = f"sigma_radps: {GYRO_RADPS}, sigma_bias_radps: 0.01, pass_share: {share}"
    config, log = open_run("lost_in_the_woods", None, [f"robots.each.sensors.gyro={{type: gyro, {numbers}}}"])
    (name,), rng, extra = log.robots, np.random.default_rng(0), []
    truth = log.truth[name]
    for (before, a), (now, b) in pairwise(zip(truth.t_ns.tolist(), truth.poses[:, 2], strict=True)):
        w = wrap(b - a) / ((now - before) * 1e-9) + BIAS_RADPS + rng.normal(0.0, GYRO_RADPS)
        extra.append(km.Scan(t_ns=now, robot=name, sensor="gyro", y=[[w]]))
    asked = readings(log, "gyro", ("w_radps",), extra if used else ())
    return build_slam(config, asked), asked, len(extra)


def compass_in_hall(runs: int) -> None:
    """Print how often the diagnosis names the odometry."""
    compass = km.Mount(km.sensors.Heading(COMPASS_RAD, sigma_declination_rad=0.3))
    for bad in (True, False):
        counts = {False: 0, True: 0}
        off = []
        for seed in range(runs):
            log = hall.hall(seed, bad_wheel=bad)
            rng, truth = np.random.default_rng(seed), log.truth["rover"]
            times = zip(truth.t_ns.tolist()[5::5], truth.poses[5::5, 2], strict=True)
            extra = [
                km.Scan(t_ns=t, robot="rover", sensor="compass",
                        y=[[wrap(theta - DECLINATION_RAD + rng.normal(0.0, COMPASS_RAD))]])
                for t, theta in times
            ]  # fmt: skip
            for with_it in (False, True):
                asked = readings(log, "compass", ("heading_rad",), extra) if with_it else log
                slam = hall.slam_of(log)
                if with_it:
                    rover = slam.robots["rover"]
                    rover = replace(rover, sensors={**rover.sensors, "compass": compass})
                    slam = km.Slam([rover], km.association.Automatic())
                run = record(slam, asked, progress=False)
                causes = diagnose(run).causes
                counts[with_it] += bool(causes) and any(word in causes[0].name for word in ODOMETRY)
            final = run.final_slam()
            sigma = np.sqrt(final.covariance("rover.compass")[-1, -1])
            off.append((final.mean("rover.compass")[3] - DECLINATION_RAD) / sigma)
        rms = np.sqrt(np.mean(np.square(off)))
        print(
            f"hall, wheel {'+1 %' if bad else 'true'}: odometry named first {counts[False]} of {runs} without, "
            f"{counts[True]} of {runs} with a compass; declination off by {rms:.2f} sigmas",
            flush=True,
        )


def park() -> None:
    """Print the lever arm, and how the fixes fit."""
    overrides = [f"robots.each.sensors.receiver={RECEIVER}", "robots.each.start={x_m: 0.0, y_m: 0.0}"]
    config, log = open_run("victoria_park_known", None, overrides)
    gps, fixes, last = log.gps[ROBOT], [], -np.inf
    for t, xy in zip(gps.t_ns.tolist(), gps.xy, strict=True):
        if t - last >= FIX_S * 1e9:
            fixes.append(km.Scan(t_ns=t, robot=ROBOT, sensor="receiver", y=[xy]))
            last = t
    c, s = np.cos(HEADING_RAD), np.sin(HEADING_RAD)
    middle = len(fixes) // 2
    slams = []
    for some in (fixes, fixes[:middle], fixes[middle:]):
        asked = readings(log, "receiver", ("x_m", "y_m"), some)
        rover = build_slam(config, asked).robots[ROBOT]
        first = fixes[0].y[0] - np.array([[c, -s], [s, c]]) @ [2.0, 0.0]
        cov = np.diag([SIGMA_START_M**2, SIGMA_START_M**2, SIGMA_START_RAD**2])
        rover = replace(rover, start=(*first, HEADING_RAD), cov=cov)
        slam, whole = km.Slam([rover], build_slam(config, asked).association), len(some) == len(fixes)
        z, left_out = [], 0
        for event in asked:
            report = slam.process(event)
            if whole and isinstance(event, km.Scan) and event.sensor == "receiver":
                if report.observations[0].outcome == "associated":
                    z.append(report.z[0] / np.sqrt(np.diag(report.Z[0])))
                else:
                    left_out += 1
        slams.append(slam)
        if whole:
            white = np.array(z)
            mean, P = slam.mean(f"{ROBOT}.receiver")[:2], slam.covariance(f"{ROBOT}.receiver")[:2, :2]
            d = mean - ANTENNA
            correlation = np.mean(white[1:] * white[:-1]) / np.mean(white**2)
            d2, arm = d @ np.linalg.solve(P, d), f"{mean[0]:.2f} {mean[1]:.2f} m, sigma {np.sqrt(P[0, 0]):.2f} m"
            print(
                f"park: arm {arm}, given {ANTENNA[0]} {ANTENNA[1]} m, d2 {d2:.1f} of {chi2.ppf(0.9973, 2):.1f}; "
                f"left out {left_out} of {len(fixes)}; NIS {np.mean(white**2):.2f}, "
                f"correlation {correlation:.2f} of {2 / np.sqrt(white.size):.2f}",
                flush=True,
            )
    centres = []
    for slam in slams[1:]:
        names = sorted(set(slams[1].landmarks().ids) & set(slams[2].landmarks().ids), key=str)[::10]
        A = np.tile(np.eye(2), len(names)) / len(names)
        p = np.array([slam.mean(name) for name in names])
        centres.append((p.mean(axis=0), A @ slam.covariance(*names) @ A.T))
    d, P = centres[0][0] - centres[1][0], centres[0][1] + centres[1][1]
    print(
        f"park: centroids by the halves {np.hypot(*d):.2f} m apart, sigma {np.sqrt(np.trace(P)):.2f} m, "
        f"d2 {d @ np.linalg.solve(P, d):.2f} of {chi2.ppf(0.9973, 2):.1f}",
        flush=True,
    )


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=("woods", "hall", "park"))
    parser.add_argument("--runs", type=int, default=5, help="of the hall")
    given = parser.parse_args()
    with one_thread():
        if "woods" in given.parts:
            woods()
        if "hall" in given.parts:
            compass_in_hall(given.runs)
        if "park" in given.parts:
            park()


if __name__ == "__main__":
    main()
