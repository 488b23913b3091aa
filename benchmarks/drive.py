"""A car with an inertial unit, a receiver and wheels, from a rest with an unknown heading: is it as sure as it may be?

    python benchmarks/drive.py [--runs 40] [--heading 30] [--estimator invariant] [--receiver 1.0]
        [--seen]

The unit is read at 100 Hz with the noise of a data sheet, the receiver at 5 Hz, the wheels at 20 Hz (.03 m/s).
Biases, the antenna's lever arm (.5 m an axis), the scale of the wheels (5 %), position (3 m) and heading of the start
are drawn by the sigmas that the filter is told.  The start is found at rest.  Printed: the mean NEES of attitude,
velocity, position and biases (15) at several times, and of attitude and biases of the force for themselves.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
from joblib import Parallel, delayed
from numpy.random import Generator, SeedSequence

import kalmark as km
from kalmark.filter import estimators
from kalmark.geometry.rotations import exp, left_jacobian, log, matrix, multiply

DT_S, REST_S, GRAVITY = 0.01, 10.0, np.array([0.0, 0.0, -9.81])
UNIT = km.motion.Inertial(
    gyroscope_noise_density_rad_per_sqrt_s=8.7e-5, gyroscope_random_walk_radps_per_sqrt_s=2e-5,
    accelerometer_noise_density_mps_per_sqrt_s=9.8e-4, accelerometer_random_walk_mps2_per_sqrt_s=2e-4,
)  # fmt: skip
SIGMA_W, SIGMA_F, ARM_M, SCALE, START_M = math.radians(0.2), 0.03, 0.5, 0.05, 3.0
TIMES_S = 30.0, 60.0, 180.0


def drive(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return true states (N + 1, 16) and true readings (N, 6) of a car on hilly ground, without biases."""
    t = DT_S * np.arange(round(seconds / DT_S) + 1)
    ramp = np.clip((t - REST_S) / 5, 0, 1) ** 2
    v, turn = ramp * (4 + 1.5 * np.sin(0.11 * t)), ramp * (0.15 + 0.25 * np.sin(0.07 * t) + 0.1 * np.sin(0.31 * t))
    yaw, pitch, roll = np.cumsum(turn) * DT_S, 0.05 * ramp * np.sin(0.2 * t), 0.03 * ramp * np.sin(0.17 * t + 1)
    q = [
        multiply(exp(np.array([0, 0, a])), multiply(exp(np.array([0, b, 0])), exp(np.array([c, 0, 0]))))
        for a, b, c in zip(yaw, pitch, roll, strict=True)
    ]
    states, u = [np.zeros(16)], np.zeros((len(t) - 1, 6))
    states[0][3:7] = q[0]
    for i in range(len(u)):
        Q, after = matrix(q[i]), matrix(q[i + 1])
        u[i, :3] = Q.T @ log(multiply(q[i + 1], q[i] * [-1, -1, -1, 1])) / DT_S
        gained = after[:, 0] * v[i + 1] - Q[:, 0] * v[i] - GRAVITY * DT_S
        u[i, 3:] = np.linalg.solve(left_jacobian(u[i, :3] * DT_S), Q.T @ gained) / DT_S
        states.append(UNIT.move(states[-1], u[i], DT_S)[0])
    return np.array(states), u


def turned(states: np.ndarray, yaw_rad: float, at: np.ndarray) -> np.ndarray:
    """Return states (N, 16) in a world that is turned about the vertical and shifted."""
    out, turn = states.copy(), np.array([0.0, 0, yaw_rad])
    Q = matrix(exp(turn))
    out[:, :3], out[:, 7:10] = states[:, :3] @ Q.T + at, states[:, 7:10] @ Q.T
    out[:, 3:7] = [multiply(exp(turn), q) for q in states[:, 3:7]]
    return out


def run(
    seed: SeedSequence, heading: float, estimator: str, receiver_m: float, seen: bool, states: np.ndarray, u: np.ndarray
) -> np.ndarray:  # fmt: skip
    """Return the NEES (times, 3) of the whole state, of the attitude and of the biases of the force."""
    rng = np.random.default_rng(seed)
    x = turned(states, rng.normal(0, heading), rng.normal(0, START_M, 3))
    walk = UNIT.densities[6:] * math.sqrt(DT_S)
    x[:, 10:] = rng.normal(0, np.repeat([SIGMA_W, SIGMA_F], 3)) + np.cumsum(rng.normal(0, walk, (len(x), 6)), axis=0)
    read = u + x[:-1, 10:] + rng.normal(0, UNIT.densities[:6] / math.sqrt(DT_S), u.shape)
    slam = started(read, heading, estimator, receiver_m, seen)
    arm, gain = np.array([0.5, 0.0, 1.0]) + rng.normal(0, ARM_M, 3), 1.0 + rng.normal(0, SCALE)
    t, found = DT_S * np.arange(len(u)), []
    for i in range(len(u)):
        slam.process(km.Control(t_s=t[i], robot="car", u=read[i]))
        readings(slam, rng, i, x[i], arm, gain, receiver_m)
        if i in [round(each / DT_S) for each in TIMES_S]:
            found.append(nees(slam, x[i]))
    return np.array(found)


def started(read: np.ndarray, heading: float, estimator: str, receiver_m: float, seen: bool = False) -> km.Slam:
    """Return the filter of a car whose readings (N, 6) begin at rest."""
    cov = np.zeros((15, 15))
    cov[:3, :3], cov[5, 5] = START_M**2 * np.eye(3), heading**2
    cov[9:, 9:] = np.diag(np.repeat([SIGMA_W, SIGMA_F], 3) ** 2)
    rest = km.motion.start_at_rest(UNIT, DT_S * np.arange(len(read)), read, np.eye(16)[6], cov)
    of_arm = np.diag([ARM_M**2] * 3 + [0.0] * 3)
    sensors = {
        "gps": km.Mount(km.sensors.Gps3D(sigma_m=receiver_m), at=(0.5, 0, 1, 0, 0, 0, 1), cov=of_arm),
        "wheels": km.Mount(km.sensors.Speed(sigma_mps=0.03, sigma_scale=SCALE), at=(0, 0, 0, 0, 0, 0, 1)),
    }
    until_ns = round(rest.until_s * 1e9)
    if seen:
        del sensors["gps"]
    robots = [km.Robot("car", UNIT, rest.start, sensors, rest.cov, rests_until_ns=until_ns)]
    if seen:
        eye = km.Mount(km.sensors.Position3D(receiver_m, receiver_m, receiver_m), at=np.eye(7)[6])
        robots.append(km.Robot("tower", km.motion.Odometry3D(), np.eye(7)[6], {"eye": eye}))
    return km.Slam(robots, estimator=getattr(estimators, estimator.capitalize())())


def readings(
    slam: km.Slam, rng: Generator, i: int, x: np.ndarray, arm: np.ndarray, gain: float, receiver_m: float
) -> None:  # fmt: skip
    """Let the filter read receiver and wheels, where they are due."""
    Q, t_s = matrix(x[3:7]), DT_S * i
    if i and i % 20 == 0:
        y, noise = x[:3] + Q @ arm, rng.normal(0, receiver_m, 3)
        if "tower" in slam.robots:
            slam.process(km.Scan(t_s=t_s, robot="tower", sensor="eye", y=(x[:3] + noise)[None], ids=["car"]))
        else:
            slam.process(km.Scan(t_s=t_s, robot="car", sensor="gps", y=(y + noise)[None]))
    if i and i % 5 == 0:
        y = [[(x[7:10] @ Q[:, 0]) / gain + rng.normal(0, 0.03)]]
        slam.process(km.Scan(t_s=t_s, robot="car", sensor="wheels", y=y))


def nees(slam: km.Slam, true: np.ndarray) -> tuple[float, float, float]:
    """Return the NEES of the whole state (15), of the attitude (3) and of the biases of the force (3)."""
    d, P = UNIT.space.minus(slam.mean("car"), true), slam.covariance("car")

    def of(part: slice) -> float:
        return float(d[part] @ np.linalg.solve(P[part, part], d[part]))

    return of(slice(15)), of(slice(3, 6)), of(slice(12, 15))


def main() -> None:
    """Print a row for each time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--heading", type=float, default=30.0, help="sigma at the start, deg")
    parser.add_argument("--estimator", default="invariant")
    parser.add_argument("--seen", action="store_true", help="of a tower whose pose is known, instead of a receiver")
    parser.add_argument("--receiver", type=float, default=1.0, help="its sigma, m")
    given = parser.parse_args()
    states, u = drive(TIMES_S[-1] + DT_S)
    heading, seeds = math.radians(given.heading), SeedSequence(0).spawn(given.runs)
    told = heading, given.estimator, given.receiver, given.seen
    scored = Parallel(n_jobs=1)(delayed(run)(s, *told, states, u) for s in seeds)
    mean, error = np.mean(scored, axis=0), np.std(scored, axis=0) / math.sqrt(given.runs)
    for t_s, row, sigma in zip(TIMES_S, mean, error, strict=True):
        parts = f"attitude {row[1]:.2f}, force {row[2]:.2f}"
        print(f"{given.estimator} {t_s:.0f} s: state {row[0]:.2f} +- {sigma[0]:.2f}, {parts}")


if __name__ == "__main__":
    main()
