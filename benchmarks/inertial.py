"""An inertial unit and a camera along EuRoC's trajectory V1_01, with simulated readings and points; and at rest.

    python benchmarks/inertial.py path [--runs 20] [--sensor stereo] [--estimator invariant]
    python benchmarks/inertial.py recorded [--runs 2] [--scale 10] [--held] [--tilted] [--estimator invariant]
    python benchmarks/inertial.py truth
    python benchmarks/inertial.py gauge [--runs 100] [--estimator invariant]
    python benchmarks/inertial.py still [--minutes 5] [--estimator invariant]

`path`: the unit reads at 200 Hz, the camera sees at 20 Hz.  Noise and biases are those of EuRoC's data sheet, the start
is known to 1 deg of roll and pitch, 0.01 rad/s and 0.05 m/s^2.  Printed: the position error as a share of the
path, RMS over the runs, and the ANEES of attitude, position and state, with the share of scans in the 95 % band.

`recorded`: the same with EuRoC's own readings and a start that is found at rest; the points are simulated still.  The
densities of the data sheet are multiplied by `--scale`, as the drone shakes.  A reading counts for the interval around
its time, and the truth is turned so that the mean of its accelerations less those that were read points down; `--held`
and `--tilted` leave this out.

`truth`: by how much its turns in 1, 5 and 20 s differ from the integral of the rates that were read, a spline in
quarter steps; what the gyroscope's noise is in that time; and what is left in either half of the flight after a delay,
scales, wrong axes and a bias of the gyroscope that are fitted to the other half.  Then what its positions say, which
are measured: of each 10 s, what the forces that were read leave of them, integrated twice with the orientations of the
truth or with the rates that were read, where start, velocity, tilt and a constant bias of the force are fitted; and by
how much the biases of the force in the truth change in 20 s.

`gauge`: 10 s of it, from 20 s on, with an unknown start, 20 deg and 1 m.  `still`: one run at rest.  Both print how the
information about the directions that nothing observes, shifts and turns about the gravity, compares with that of the
start: the eigenvalues of N' P^-1 N relative to those of the start, N the directions, P the covariance of robot and map.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from numpy.random import Generator, SeedSequence
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from ways import pin

import kalmark as km
from kalmark.geometry.rotations import exp, left_jacobian, log, matrix, multiply, skew
from kalmark.results.measures import anees_interval, path_m

FOLDER = "visual/euroc_v101_micro"
RATE_HZ, EVERY, ROOM_M = 200, 10, 1.5
POINTS, FEW = 150, 30  # of a room: of the trajectory as a whole, and where the information is asked for
UNIT = km.motion.Inertial(1.6968e-4, 1.9393e-5, 2.0e-3, 3.0e-3)
G = np.array([0.0, 0.0, -UNIT.gravity_mps2])
SIGMA_W, SIGMA_A, SIGMA_TILT = 0.01, 0.05, math.radians(1.0)  # of biases and of roll and pitch at the start
TRUTH_M = 0.002  # of the truth's positions: it moves by as much while the unit is at rest
SIGMA_YAW, SIGMA_M, SIGMA_V = math.radians(20.0), 1.0, 1e-3  # of a start of which nothing is known
CAMERA = np.array([-0.0216, -0.0647, 0.0098, *Rotation.from_matrix(
    [[0.0148655, -0.9998809, 0.0041403], [0.9995572, 0.0149672, 0.0257155], [-0.0257744, 0.0037562, 0.9996607]]
).as_quat()])  # fmt: skip
IMAGE = {"fx_px": 458.0, "fy_px": 457.0, "cx_px": 367.0, "cy_px": 248.0, "width_px": 752, "height_px": 480}
SENSORS: dict[str, tuple[Any, Any]] = {  # and the landmarks that each starts
    "stereo": (km.sensors.Stereo(baseline_m=0.11, **IMAGE), km.landmarks.Point3D()),
    "pinhole": (km.sensors.PinHole(**IMAGE), km.landmarks.AnchoredHomogeneous()),
    "spherical": (km.sensors.RangeBearing3D(0.05, 0.003, 0.003, range_max_m=4.0), km.landmarks.Point3D()),
}
ESTIMATORS: dict[str, Any] = {
    "invariant": km.estimators.Invariant(),
    "ekf": km.estimators.Ekf(),
    "fej": km.estimators.Fej(),
}


class Flight:
    """True states (N + 1, 16) at the times of the readings, and the exact readings (N, 6) that lead along them."""

    def __init__(self, states: np.ndarray, readings: np.ndarray) -> None:
        self.states, self.readings = states, readings


def table(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (N,) of a table of EuRoC's, s from the first one on, and its numbers (N, m)."""
    path = Path(os.environ.get("KALMARK_DATA", "../shared/data")) / FOLDER / name
    with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as file:
        rows = list(csv.reader(file))[1:]
    t_ns = np.array([int(row[0]) for row in rows])
    return (t_ns - t_ns[0]) * 1e-9, np.array([[float(cell) for cell in row[1:]] for row in rows])


def euroc(seconds: float | None = None) -> Flight:
    """Return the flight whose velocity and orientation are those of EuRoC's truth, by splines."""
    t, rows = table("gt_V1_01_easy.csv")
    way, turn = CubicSpline(t, rows[:, :3]), RotationSpline(t, Rotation.from_quat(rows[:, [4, 5, 6, 3]]))
    at = np.arange(0.0, min(t[-1], seconds or math.inf), 1.0 / RATE_HZ)
    return flown(np.concatenate([way(at[0]), turn(at[0]).as_quat()]), way(at, 1), turn(at).as_quat())


def flown(start: np.ndarray, v: np.ndarray, q: np.ndarray) -> Flight:
    """Return the flight from a pose (7,) with the velocities v (N, 3) and the orientations q (N, 4), held readings."""
    dt, readings, states = 1.0 / RATE_HZ, [], [np.concatenate([start, v[0], np.zeros(6)])]
    for k in range(len(v) - 1):
        w = log(multiply(q[k] * [-1, -1, -1, 1], q[k + 1]))
        f = np.linalg.solve(matrix(q[k]) @ left_jacobian(w), (v[k + 1] - v[k]) / dt - G)
        readings.append(np.concatenate([w / dt, f]))
        states.append(UNIT.move(states[-1], readings[-1], dt)[0])
    return Flight(np.array(states), np.array(readings))


def standing(seconds: float) -> Flight:
    """Return the flight of a unit that stands tilted."""
    q = np.tile(exp(np.array([0.1, -0.2, 0.3])), (round(seconds * RATE_HZ), 1))
    return flown(np.concatenate([[0.0, 0.0, 1.0], q[0]]), np.zeros((len(q), 3)), q)


def read(flight: Flight, rng: Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return what the unit reads (N, 6), and its true biases (N + 1, 6)."""
    dt, n = 1.0 / RATE_HZ, len(flight.readings)
    noise, walk = UNIT.densities[:6], UNIT.densities[6:]
    first = rng.normal(0.0, np.repeat([SIGMA_W, SIGMA_A], 3))
    biases = first + np.vstack([np.zeros(6), np.cumsum(rng.normal(0.0, walk * math.sqrt(dt), (n, 6)), axis=0)])
    return flight.readings + biases[:-1] + rng.normal(0.0, noise / math.sqrt(dt), (n, 6)), biases


def points(states: np.ndarray, count: int, rng: Generator) -> np.ndarray:
    """Return points (count, 3) on the walls of a room around a flight."""
    low, high = states[:, :3].min(axis=0) - ROOM_M, states[:, :3].max(axis=0) + ROOM_M
    p, rows, axis = rng.uniform(low, high, (count, 3)), np.arange(count), rng.integers(3, size=count)
    p[rows, axis] = np.where(rng.uniform(size=count) < 0.5, low[axis], high[axis])
    return p


def start_sigmas(lost: bool) -> np.ndarray:
    """Return the sigmas (15,) of a start, one of which next to nothing is known or one with a known place and yaw."""
    pose = [SIGMA_M * lost] * 3 + [SIGMA_TILT] * 2 + [SIGMA_YAW * lost]
    return np.array(pose + [SIGMA_V] * 3 + [SIGMA_W] * 3 + [SIGMA_A] * 3)


class Run:
    """One run: the filter, the truth, and what the camera sees."""

    def __init__(self, flight: Flight, sensor: str, estimator: str, seed: SeedSequence, lost: bool = False) -> None:
        self.rng, self.flight = np.random.default_rng(seed), flight
        self.u, self.biases = read(flight, self.rng)
        self.points = points(flight.states, FEW if lost else POINTS, self.rng)
        self.sensor, landmark = SENSORS[sensor]
        self.at = CAMERA if sensor != "spherical" else np.array([0.0, 0, 0, 0, 0, 0, 1])
        truth, sigmas = flight.states[0], start_sigmas(lost)
        error = self.rng.normal(0.0, sigmas[:9])
        start = UNIT.space.rotated(truth, error[3:6])  # the velocity is known in the frame of the robot, turned with it
        start[:3], start[7:10] = truth[:3] + error[:3], start[7:10] + error[6:]
        A = np.eye(UNIT.space.dof)
        A[6:9, 3:6] = UNIT.space.generator(start)[6:9]
        self.prior = A @ np.diag(np.square(sigmas)) @ A.T
        self.lead_ns = 0
        mount = km.Mount(self.sensor, at=self.at)
        robot = km.Robot("unit", UNIT, start, {"camera": mount}, cov=self.prior)
        self.slam = km.Slam([robot], estimator=ESTIMATORS[estimator], landmarks=landmark)

    def scans(self) -> Any:
        """Yield the number of each reading that a scan follows, after the filter has taken both."""
        dt_ns = 1_000_000_000 // RATE_HZ
        for k, u in enumerate(self.u):
            self.slam.process(km.Control(t_ns=k * dt_ns - self.lead_ns, robot="unit", u=u))
            n = k if self.lead_ns or k == 0 else k + 1  # the last reading whose interval has begun
            if n % EVERY == 0:
                y, ids = self.seen(self.flight.states[n, :7])
                self.slam.process(km.Scan(t_ns=n * dt_ns, robot="unit", sensor="camera", y=y, ids=ids))
                yield n

    def seen(self, pose: np.ndarray) -> tuple[np.ndarray, list[int]]:
        """Return noisy measurements (K, m) of the points in view, and their numbers."""
        T = km.geometry.frames3d.compose(pose, self.at)[0]
        v = km.landmarks.Point3D().seen_from(T, self.points)[0]
        inside = np.flatnonzero(self.sensor.sees(v))
        e = self.sensor.expect(v[inside])[0] if len(inside) else np.zeros((0, len(self.sensor.columns)))
        noise = self.sensor.noise(e) if len(e) else np.zeros((0, e.shape[1], e.shape[1]))
        y = e + np.array([self.rng.multivariate_normal(np.zeros(len(N)), N) for N in noise]).reshape(e.shape)
        return y, inside.tolist()

    def error(self, n: int) -> np.ndarray:
        """Return the invariant error (15,) of the estimate after reading n, in the coordinates of its covariance."""
        mean, truth = self.slam.mean("unit"), np.concatenate([self.flight.states[n, :10], self.biases[n]])
        if self.slam.estimator.coordinates == "world":
            return UNIT.space.minus(truth, mean)
        turn = log(multiply(truth[3:7], mean[3:7] * [-1, -1, -1, 1]))
        back = np.linalg.inv(left_jacobian(turn))
        return np.concatenate(
            [back @ (truth[:3] - mean[:3]), turn, back @ (truth[7:10] - mean[7:10]), truth[10:] - mean[10:]]
        )

    def gauge(self) -> np.ndarray:
        """Return the information (4, 4) about shifts and turns about the gravity, of the robot and the map."""
        names = ["unit", *self.slam.landmarks().ids]
        N = self.directions(names)
        return N.T @ np.linalg.solve(self.slam.covariance(*names), N)

    def directions(self, names: list[Any]) -> np.ndarray:
        """Return how the errors (n, 4) of these blocks move in a shift of the world and a turn about its vertical."""
        parts = []
        for name in names:
            space = UNIT.space if name == "unit" else km.landmarks.Point3D().space
            parts.append(np.column_stack([np.eye(space.dof, 3), space.generator(self.slam.mean(name))[:, 2]]))
        return np.concatenate(parts)


class Recorded(Run):
    """A run with the readings of EuRoC's unit, from rest: at the true place and heading, known to 2 mm and .5 deg."""

    def __init__(self, sensor: str, estimator: str, seed: SeedSequence, scale: float, held: bool, tilted: bool) -> None:
        t, rows = table("gt_V1_01_easy.csv")
        self.flight, self.rng, self.at = euroc(), np.random.default_rng(seed), CAMERA
        at = np.arange(len(self.flight.states)) / RATE_HZ
        self.flight.states[:, :3] = CubicSpline(t, rows[:, :3])(at)  # without the drift of an integral
        self.lead_ns = 0 if held else 500_000_000 // RATE_HZ
        self.biases = np.column_stack([np.interp(at, t, column) for column in rows[:, 10:].T])
        self.u = table("mav0/imu0/data.csv.gz")[1][: len(at) - 1]
        if not tilted:
            turn = self.tilt()
            self.flight.states = np.array([UNIT.space.rotated(state, turn) for state in self.flight.states])
        self.points = points(self.flight.states, POINTS, self.rng)
        self.sensor, landmark = SENSORS[sensor]
        unit = km.motion.Inertial(*(scale * UNIT.densities[[0, 6, 3, 9]]))
        sigmas = np.repeat([TRUTH_M, 0.0, 0.0, 0.1, 0.1], 3)
        sigmas[5] = math.radians(0.5)
        start = np.concatenate([self.flight.states[0, :7], np.zeros(9)])
        rest = km.motion.start_at_rest(unit, at[:-1] - self.lead_ns * 1e-9, self.u, start, np.diag(sigmas**2))
        until_ns = round(rest.until_s * 1e9)
        mount = km.Mount(self.sensor, at=self.at)
        robot = km.Robot("unit", unit, rest.start, {"camera": mount}, cov=rest.cov, rests_until_ns=until_ns)
        self.slam = km.Slam([robot], estimator=ESTIMATORS[estimator], landmarks=landmark)

    def tilt(self) -> np.ndarray:
        """Return the turn (3,) of the truth after which the gravity that was read points down."""
        states, middle = self.flight.states, (self.u[1:] + self.u[:-1]) / 2
        f = Rotation.from_quat(states[1:-1, 3:7]).apply(middle[:, 3:] - self.biases[1:-1, 3:])
        g = np.mean((states[2:, 7:10] - states[:-2, 7:10]) * RATE_HZ / 2 - f, axis=0)
        down = np.array([0.0, 0.0, -1.0])
        axis = np.cross(g, down)
        turn: np.ndarray = axis * math.asin(np.linalg.norm(axis) / np.linalg.norm(g)) / np.linalg.norm(axis)
        return turn


def turns() -> None:
    """Print by how much the turns of the truth differ from those read, and what of it a gyroscope explains."""
    t, rows = table("gt_V1_01_easy.csv")
    at, u = table("mav0/imu0/data.csv.gz")
    q, fine = Rotation.from_quat(rows[:, [4, 5, 6, 3]]), 4 * RATE_HZ // 20
    biases = np.column_stack([np.interp(at, t, column) for column in rows[:, 10:13].T])
    rates = CubicSpline(at, u[:, :3] - biases)
    dt = (t[1:] - t[:-1]) / fine
    odd = q[:-1].inv() * q[1:]  # the turn of the truth between two of its rows, less that of the unit
    read, w = Rotation.identity(len(dt)), np.zeros((len(dt), 3))
    for k in range(fine):
        now = rates(t[:-1] + (k + 0.5) * dt)
        read, w = read * Rotation.from_rotvec(now * dt[:, None]), w + now * dt[:, None]
    R = q[:-1].as_matrix()
    off = added(R @ (read.inv() * odd).as_rotvec()[:, :, None])[:, :, 0]
    delay, bias = (rates(t[1:]) - rates(t[:-1]))[:, :, None], np.eye(3) * fine * dt[:, None, None]
    scales_and_axes = np.einsum("ij,nk->nijk", np.eye(3), w).reshape(len(w), 3, 9)
    causes = added(R @ np.concatenate([delay, scales_and_axes, bias], axis=2))
    begin, words = 120, []  # under way
    for seconds in (1, 5, 20):
        d, X = (each[begin + 20 * seconds :] - each[begin : -20 * seconds] for each in (off, causes))
        halves = slice(0, len(d) // 2), slice(len(d) // 2, len(d))
        left = [
            d[b] - X[b] @ np.linalg.lstsq(X[a].reshape(-1, X.shape[2]), d[a].ravel())[0]
            for a, b in (halves, halves[::-1])
        ]
        noise = UNIT.densities[0] * math.sqrt(seconds)
        rms, fitted = (1e3 * np.sqrt(np.mean(each**2)) for each in (d, np.concatenate(left)))
        words.append(f"in {seconds} s {rms:.2f} mrad, of noise {1e3 * noise:.2f}, fitted {fitted:.2f}")
    print("truth: turns off, RMS an axis, " + "; ".join(words))


def twice(at: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the integral of the integral of y (N, ...) over the times (N,)."""
    for _ in range(2):
        y = cumulative_trapezoid(y, at, axis=0, initial=0.0)
    return y


def left_of_places(at: np.ndarray, R: np.ndarray, f: np.ndarray, s: np.ndarray, p: np.ndarray) -> float:
    """Return the mean square, m^2, that forces f (N, 3) at orientations R (N, 3, 3) leave of places p (n, 3) at s."""
    F = np.einsum("nij,nj->ni", R, f)
    fitted = np.concatenate([-np.array([skew(each) for each in F]), R], axis=2)  # a tilt, a bias
    fitted, moved = CubicSpline(at, twice(at, fitted))(s), CubicSpline(at, twice(at, F + G))(s)
    ways = np.tile(np.eye(3), (len(s), 1, 1))
    A = np.concatenate([ways, s[:, None, None] * ways, fitted], axis=2).reshape(-1, 12)
    y = (p - moved).ravel()
    return float(np.mean((y - A @ np.linalg.lstsq(A, y)[0]) ** 2))


def places(seconds: float = 10.0) -> None:
    """Print what of the truth's positions is left with the truth's orientations and with those of the unit."""
    t, rows = table("gt_V1_01_easy.csv")
    at, u = table("mav0/imu0/data.csv.gz")
    at, n = at[at <= t[-1]], round(seconds * RATE_HZ)
    rates, forces = (np.column_stack([np.interp(at, t, bias) for bias in rows[:, k : k + 3].T]) for k in (10, 13))
    w, raw = u[: len(at), :3] - rates, u[: len(at), 3:]
    q = RotationSpline(t, Rotation.from_quat(rows[:, [4, 5, 6, 3]]))(at)
    steps = Rotation.from_rotvec((w[1:] + w[:-1]) / 2 * np.diff(at)[:, None])
    left = []
    for a in range(6 * RATE_HZ, len(at) - n, n):  # under way
        here, within = slice(a, a + n + 1), (t >= at[a]) & (t <= at[a + n])
        unit = [q[a]]
        for step in steps[a : a + n]:
            unit.append(unit[-1] * step)
        truth, turned = q[here].as_matrix(), Rotation.concatenate(unit).as_matrix()
        pairs = (truth, raw - forces), (truth, raw), (turned, raw)
        seen = t[within] - at[a], rows[within, :3]
        left.append([left_of_places(at[here] - at[a], R, f[here], *seen) for R, f in pairs])
    own, truths, units = 1e3 * np.sqrt(np.mean(left, axis=0))
    better = sum(unit < truth for _, truth, unit in left)
    d = rows[20 * 20 :, 13:] - rows[: -20 * 20, 13:]
    change, walk = np.sqrt(np.mean(d**2)), UNIT.densities[9] * math.sqrt(20)
    print(
        f"truth: positions of {seconds:.0f} s, RMS left, with its turns and biases {own:.1f} mm, with its turns and a"
        f" constant bias {truths:.1f}, with those of the unit and a constant bias {units:.1f}, less in {better} of"
        f" {len(left)}; its biases of the force change in 20 s by {1e3 * change:.0f} mm/s^2, of a walk {1e3 * walk:.0f}"
    )


def added(steps: np.ndarray) -> np.ndarray:
    """Return the sums of the first 0 to N of N steps."""
    return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])


def path(seed: SeedSequence, given: argparse.Namespace) -> tuple[np.ndarray, float]:
    """Return of each scan the position error and the NEES of attitude, position and state (scans, 4), and the path."""
    pin()
    if given.what == "recorded":
        run: Run = Recorded(given.sensor, given.estimator, seed, given.scale, given.held, given.tilted)
    else:
        run = Run(euroc(given.seconds), given.sensor, given.estimator, seed)
    flight, found = run.flight, []
    for n in run.scans():
        d, P = run.error(n), run.slam.covariance("unit")
        parts = [slice(3, 6), slice(0, 3), slice(0, 15)]
        nees = [d[p] @ np.linalg.pinv(P[p, p]) @ d[p] for p in parts]
        found.append([np.linalg.norm(run.slam.mean("unit")[:3] - flight.states[n, :3]), *nees])
    return np.array(found), path_m(flight.states[:, :3])


def paths(given: argparse.Namespace) -> None:
    """Print the errors and the ANEES of the runs along EuRoC's trajectory."""
    jobs = [delayed(path)(seed, given) for seed in SeedSequence(0).spawn(given.runs)]
    runs = Parallel(n_jobs=2)(jobs)
    each, length = np.array([found for found, _ in runs])[:, 1:], runs[0][1]
    error = np.sqrt(np.mean(each[:, :, 0] ** 2, axis=1))
    rms, worst = np.sqrt(np.mean(error**2)), error.max()
    words = [f"RMS {rms:.4f} m, {100 * rms / length:.3f} % of {length:.1f} m, worst {100 * worst / length:.3f} %"]
    for i, (name, dof) in enumerate((("attitude", 3), ("position", 3), ("state", 15)), 1):
        mean, (low, high) = each[:, :, i].mean(axis=0), anees_interval(dof, given.runs)
        inside = np.mean((mean > low) & (mean < high))
        words.append(f"{name} ANEES ({dof}) {mean.mean():.2f}, in the band {inside:.1%}")
    print(f"{given.what} {given.sensor} {given.estimator}: " + "; ".join(words))


def gauged(flight: Flight, estimator: str, seed: SeedSequence, every: int) -> np.ndarray:
    """Return the largest and smallest eigenvalues (scans, 2) of the information about shifts and turns.

    Relative to that of the start; of every so manieth scan, the first one included.
    """
    pin()
    run, values = Run(flight, "spherical", estimator, seed, lost=True), []
    N = run.directions(["unit"])
    first = N.T @ np.linalg.solve(run.prior, N)
    root = np.linalg.inv(np.linalg.cholesky(first))
    for i, _ in enumerate(run.scans()):
        if i % every == 0:
            values.append(np.linalg.eigvalsh(root @ run.gauge() @ root.T)[[-1, 0]])
    return np.array(values)


def gauges(given: argparse.Namespace) -> None:
    """Print the information of short runs about what is unobservable."""
    flight = euroc(given.seconds or 30.0)
    flight = Flight(flight.states[4000:], flight.readings[4000:])  # under way
    jobs = [delayed(gauged)(flight, given.estimator, s, 20) for s in SeedSequence(1).spawn(given.runs)]
    runs = np.array(Parallel(n_jobs=2)(jobs))
    grown = np.sum(runs[:, :, 0].max(axis=1) > 1.0 + 1e-6)
    most = f"most information {runs.max():.9f}"
    print(f"gauge {given.estimator}: {most}, more than that of the start by 1e-6 in {grown} of {given.runs} runs")


def still(given: argparse.Namespace) -> None:
    """Print the information of a run at rest about what is unobservable."""
    values = gauged(standing(60.0 * given.minutes), given.estimator, SeedSequence(2), 100)
    print(f"still {given.estimator}: least information {values.min():.9f}, most {values.max():.9f}")


def main() -> None:
    """Print the row of one question."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["path", "recorded", "truth", "gauge", "still"])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--sensor", choices=[*SENSORS], default="stereo")
    parser.add_argument("--estimator", choices=[*ESTIMATORS], default="invariant")
    parser.add_argument("--scale", type=float, default=10.0)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seconds", type=float, help="not the whole trajectory, but its beginning")
    parser.add_argument("--held", action="store_true", help="a reading counts from its time on")
    parser.add_argument("--tilted", action="store_true", help="the truth as it is")
    given = parser.parse_args()
    if given.what == "truth":
        turns()
        places()
        return
    {"path": paths, "recorded": paths, "gauge": gauges, "still": still}[given.what](given)


if __name__ == "__main__":
    main()
