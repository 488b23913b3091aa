"""A camera with an inertial unit, 90 images of EuRoC's V1_01: errors against its truth and against a better one.

python benchmarks/vision_inertial.py [SEEDS]     a row a seed, then the worst of them; 5 seeds
python benchmarks/vision_inertial.py shifts      one seed, the stamps of the images shifted by -10 to 10 ms
python benchmarks/vision_inertial.py points      exact projections of points in the place of the images, white noise of
                                                 .16 px; with the densities of the data sheet, and with those in use
The orientations of this truth are not accurate, as OpenVINS's page on data sets says, which has them optimised anew
from positions and readings.  `smoothed` does the same: a graph of the unit's readings over the whole flight and of the
truth's positions, to 1 mm; images have no part in it.  The densities are three (rate) and ten times (force) those of
the data sheet, as the drone shakes, and the direction of the gravity is fitted.  Heading and place, which nothing
observes, are aligned in the first image.  Its covariance is added to that of the filter.  Needs gtsam.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from inertial import UNIT, table
from scipy.spatial.transform import Rotation

import kalmark as km
from kalmark.arrays import Array
from kalmark.config import build_slam, open_run
from kalmark.filter.kernels import one_thread
from kalmark.geometry.frames3d import compose, from_frame_many, to_frame_many
from kalmark.slam.warm_up_events import without_detectors
from vision import similarity

CAMERA, SHIFTS_MS, NOISE_PX, NEAR_M, FAR_M = "cam0", (-10, -5, -2.5, 0, 2.5, 5, 10), 0.16, 0.5, 20.0
FROM_S, SCALES, POSITION_M, TILT = 2.0, (3.0, 10.0), 1e-3, 3e-3  # of the graph; rad of the differences for the gravity
NAMES = ("position_m", "attitude_deg", "velocity_mps", "scale_percent", "nees")
SHEET = [
    f"robots.each.motion.{key}={UNIT.__dict__[key]}"
    for key in ("gyroscope_noise_density_rad_per_sqrt_s", "accelerometer_noise_density_mps_per_sqrt_s")
]


class States(NamedTuple):
    """Positions (N, 3), orientations, velocities (N, 3), and covariances of the poses (N, 6, 6)."""

    p: Array
    q: Rotation
    v: Array
    P: Array


def graph(tilt: tuple[float, float]) -> tuple[float, Any, Any, Array]:
    """Return cost, values and factors of the graph, and the times of its states, s; `tilt` turns the gravity."""
    t, truth = table("gt_V1_01_easy.csv")
    at, u = table("mav0/imu0/data.csv.gz")
    truth, t, at = truth[t >= FROM_S], t[t >= FROM_S], at - 0.5 * float(np.median(np.diff(at)))
    sigmas, eye = UNIT.densities, np.eye(3)
    unit = gtsam.PreintegrationCombinedParams.MakeSharedU(UNIT.gravity_mps2)
    unit.n_gravity = Rotation.from_rotvec([*tilt, 0.0]).apply([0.0, 0.0, -UNIT.gravity_mps2])
    unit.setGyroscopeCovariance(eye * (SCALES[0] * sigmas[0]) ** 2)
    unit.setAccelerometerCovariance(eye * (SCALES[1] * sigmas[3]) ** 2)
    unit.setIntegrationCovariance(eye * 1e-10)
    unit.setBiasOmegaCovariance(eye * sigmas[6] ** 2)
    unit.setBiasAccCovariance(eye * sigmas[9] ** 2)
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    bias = gtsam.imuBias.ConstantBias(truth[0, 13:16], truth[0, 10:13])
    factors.add(gtsam.PriorFactorConstantBias(B(0), bias, gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.2, 0.02], 3))))
    for k, state in enumerate(truth):
        values.insert(X(k), gtsam.Pose3(gtsam.Rot3.Quaternion(*state[3:7]), state[:3]))
        values.insert(V(k), state[7:10])
        values.insert(B(k), bias)
        factors.add(gtsam.GPSFactor(X(k), state[:3], gtsam.noiseModel.Isotropic.Sigma(3, POSITION_M)))
    for k in range(len(t) - 1):
        step = gtsam.PreintegratedCombinedMeasurements(unit, bias)
        inside = np.arange(np.searchsorted(at, t[k], "right") - 1, np.searchsorted(at, t[k + 1]))
        ends = np.append(np.maximum(at[inside], t[k]), t[k + 1])
        for i, dt in zip(inside, np.diff(ends), strict=True):
            if dt > 1e-9:
                step.integrateMeasurement(u[i, 3:], u[i, :3], dt)
        factors.add(gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), step))
    values = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    return 2.0 * factors.error(values), values, factors, t


def smoothed(t_s: Array) -> States:
    """Return the states at times (N,) of the truth, s since its first one, in a world whose z is up."""
    h, at = TILT, np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1]]) * TILT
    c = [graph((a, b))[0] for a, b in at]
    g = np.array([c[1] - c[2], c[3] - c[4]]) / (2 * h)
    H = np.diag([c[1] + c[2] - 2 * c[0], c[3] + c[4] - 2 * c[0]]) / h**2
    H[0, 1] = H[1, 0] = (c[5] - c[1] - c[3] + c[0]) / h**2
    tilt = -np.linalg.solve(H, g)
    _, values, factors, t = graph((tilt[0], tilt[1]))
    rows = [int(np.abs(t - one).argmin()) for one in t_s]
    assert np.abs(t[rows] - t_s).max() < 1e-3
    poses, marginals = [values.atPose3(X(k)) for k in rows], gtsam.Marginals(factors, values)
    q = Rotation.from_matrix([pose.rotation().matrix() for pose in poses])
    p = np.array([pose.translation() for pose in poses])
    order, back = [3, 4, 5, 0, 1, 2], Rotation.from_rotvec([*tilt, 0.0]).inv()
    turned = [np.kron(np.eye(2), one) for one in q.as_matrix()]
    P = [M @ marginals.marginalCovariance(X(k))[np.ix_(order, order)] @ M.T for k, M in zip(rows, turned, strict=True)]
    v = np.array([values.atVector(V(k)) for k in rows])
    return States(p[0] + back.apply(p - p[0]), back * q, back.apply(v), np.array(P))


def aligned(states: States, start: Array) -> States:
    """Return states shifted and turned about the vertical so that the first is at the place and heading of a start."""
    turn = Rotation.from_rotvec([0.0, 0.0, (Rotation.from_quat(start[3:7]) * states.q[0].inv()).as_rotvec()[2]])
    return States(start[:3] + turn.apply(states.p - states.p[0]), turn * states.q, turn.apply(states.v), states.P)


def errors(x: Array, P: Array, true: States) -> dict[str, float]:
    """Return the RMS errors of states x (N, 16), the scale of their path and the NEES of their poses a dof."""
    turn = (Rotation.from_quat(x[:, 3:7]) * true.q.inv()).as_rotvec()
    e = np.concatenate([x[:, :3] - true.p, turn, x[:, 7:10] - true.v], axis=1)
    rms = [float(np.sqrt(np.mean(np.sum(part**2, axis=1)))) for part in np.split(e, 3, axis=1)]
    pose, S = e[1:, :6], (P + true.P)[1:]  # the first place is known exactly
    nees = float(np.mean(np.einsum("ka,kab,kb->k", pose, np.linalg.inv(S), pose))) / 6
    scale = 100 * abs(similarity(x[:, :3], true.p)[1] - 1)
    return dict(zip(NAMES, (rms[0], float(np.degrees(rms[1])), rms[2], scale, nees), strict=True))


def run(seed: int, shift_ms: float = 0.0) -> tuple[Array, Array, float]:
    """Return the states (N, 16) after each image, covariances of the poses, and the NIS of all matches, a number."""
    config, log = open_run("visual_inertial", None, [f"robots.each.sensors.{CAMERA}.detector.seed={seed}"])
    slam, name, x, P, d2 = build_slam(config, log), log.robots[0], [], [], []
    first, back_ns = min(event.t_ns for event in log.events), round(1e6 * shift_ms)
    times = [e.t_ns if isinstance(e, km.Frame) or e.t_ns == first else max(e.t_ns - back_ns, first) for e in log.events]
    events = [replace(event, t_ns=t) for event, t in zip(log.events, times, strict=True)]
    for event in sorted(events, key=lambda e: (e.t_ns, isinstance(e, km.Frame))):
        report = slam.process(event)
        if isinstance(event, km.Frame):
            x.append(slam.mean(name))
            P.append(slam.covariance(name)[:6, :6])
            d2 += [o.d2 for o in report.observations if o.outcome == "associated" and o.d2 is not None]
    return np.array(x), np.array(P), float(np.mean(d2)) / 2


def points(true: States, options: list[str]) -> dict[str, float]:
    """Return the errors of a run on projections of the points that a run on images found, along `true` states."""
    config, log = open_run("visual_inertial", None, options)
    name, found, known = log.robots[0], [], {}
    slam = build_slam(config, log)
    for event in log.events:
        report = slam.process(event)
        if isinstance(event, km.Frame):
            found.append(
                {o.landmark: report.y[o.index] for o in report.observations if o.outcome in ("new", "associated")}
            )
            known |= dict(zip((marks := slam.landmarks()).ids, marks.means, strict=True))
    (robot,) = without_detectors(build_slam(config, log).robots.values())
    slam, rng = km.Slam(robot, estimator=slam.estimator, map="dense"), np.random.default_rng(0)
    mount, true = robot.sensors[CAMERA], aligned(true, slam.mean(name))
    poses = [compose(np.append(p, q.as_quat()), np.array(mount.at))[0] for p, q in zip(true.p, true.q, strict=True)]
    places: dict[Any, Array] = {}
    for T, matches in zip(poses, found, strict=True):
        for key in matches.keys() & known.keys() - places.keys():
            ray, l = mount.sensor.rays(matches[key][None])[0], known[key]
            far = np.clip(to_frame_many(T, (l[:3] / max(l[3], 1e-3))[None])[0][0, 2], NEAR_M, FAR_M)
            places[key] = from_frame_many(T, (ray * far / ray[2])[None])[0][0]
    x, P, k = [], [], 0
    for event in log.events:
        if not isinstance(event, km.Frame):
            slam.process(event)
            continue
        ids = [key for key in found[k] if key in places]
        e = mount.sensor.expect(to_frame_many(poses[k], np.array([places[key] for key in ids]))[0])[0]
        y = e + NOISE_PX * rng.standard_normal(e.shape)
        slam.process(km.Scan(t_ns=event.t_ns, robot=name, sensor=CAMERA, y=y, ids=ids))
        for gone in set(slam.tracks.confirmed) - set(ids):
            slam.remove(gone)
        x.append(slam.mean(name))
        P.append(slam.covariance(name)[:6, :6])
        k += 1
    return errors(np.array(x), np.array(P), true)


def main(what: str) -> None:
    """Print what is asked for."""
    log = open_run("visual_inertial", None, [])[1]
    images = np.array([event.t_ns for event in log.events if isinstance(event, km.Frame)])
    truth = log.truth[log.robots[0]]
    v = np.gradient((T := truth.at(images))[:, :3], images * 1e-9, axis=0)
    said = States(T[:, :3], Rotation.from_quat(T[:, 3:7]), v, np.zeros((len(T), 6, 6)))
    true = smoothed((images - truth.t_ns[0]) * 1e-9)
    off = np.degrees((said.q * aligned(true, T[0]).q.inv()).magnitude())
    print(f"orientations of the truth less smoothed ones: RMS {np.sqrt(np.mean(off**2)):.2f} deg")
    if what == "points":
        for words, options in (("data sheet", SHEET), ("in use", [])):
            print(f"{words}: " + ", ".join(f"{key} {value:.3g}" for key, value in points(true, options).items()))
        return
    if what == "shifts":
        for shift in SHIFTS_MS:
            x, P, nis = run(0, shift)
            found = errors(x, P, aligned(true, x[0]))
            print(f"{shift} ms: NIS {nis:.3f}, " + ", ".join(f"{key} {value:.3g}" for key, value in found.items()))
        return
    rows: dict[str, list[dict[str, float]]] = {"euroc": [], "smoothed": []}
    for seed in range(int(what)):
        x, P, _ = run(seed)
        for name, states in (("euroc", said), ("smoothed", aligned(true, x[0]))):
            rows[name].append(errors(x, P, states))
            print(f"seed {seed}, {name}: " + ", ".join(f"{key} {value:.4g}" for key, value in rows[name][-1].items()))
    print("| against | position, m | attitude, deg | velocity, m/s | scale, % | NEES / 6 |\n|---|---|---|---|---|---|")
    for name, found in rows.items():
        worst = [max(row[key] for row in found) for key in NAMES]
        print(f"| {name} | " + "{:.3f} | {:.2f} | {:.3f} | {:.1f} | {:.1f} |".format(*worst))


if __name__ == "__main__":
    with one_thread():
        main(sys.argv[1] if len(sys.argv) > 1 else "5")
