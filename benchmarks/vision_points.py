"""One camera in `textured_room` without images: exact projections with white noise, by landmark and estimator.

python benchmarks/vision_points.py [SIGMA_PX] [SEEDS]     0.15 px and 3 seeds
Matches of points that the true images show, 60 a frame: what is wrong here is the filter, not the search.  Printed are
the RMS and the largest error of the position and the mean NEES of the pose, a dof, of all frames and seeds.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

import kalmark as km
from kalmark.arrays import Array
from kalmark.config import build_slam
from kalmark.events import Event
from kalmark.filter.kernels import one_thread
from kalmark.geometry.frames3d import from_frame_many, minus, to_frame_many
from kalmark.logs.log import Log
from kalmark.simulate import load_world, simulate
from kalmark.slam.warm_up_events import without_detectors

IN_VIEW, STARTS, MARGIN, APART = 60, 10, 13, 15  # landmarks in a frame, new ones, px to the border and between them
HIDDEN = 0.1  # relative difference of depths beyond which something is in front
SINGULAR = 1e12  # condition of a covariance, so much or more: no NEES
ESTIMATORS = {
    "invariant": km.estimators.Invariant(), "invariant, linearised once": km.estimators.Invariant(1),
    "ekf": km.estimators.Ekf(),
}  # fmt: skip
LANDMARKS = {"homogeneous": km.landmarks.Homogeneous(0.3, 0.3), "anchored": km.landmarks.AnchoredHomogeneous(0.3, 0.3)}


def matches(log: Log, sensor: km.sensors.PinHole, sigma_px: float, seed: int) -> Iterator[Event]:
    """Yield the events of a log of images, scans of points in the place of the images."""
    rng, places = np.random.default_rng(seed), dict[str, Array]()
    middle = (np.array(sensor.image) - 1.0) / 2.0
    for event in log.events:
        if not isinstance(event, km.Frame):
            yield event
            continue
        renderer, T = event.image.args[:2]  # type: ignore[union-attr]
        depth, e = renderer.render(T)[1], np.zeros((0, 2))
        if places:
            v = to_frame_many(T, np.array([*places.values()]))[0]
            e = sensor.expect(v)[0]
            u = np.rint(np.nan_to_num(e)).astype(np.int64)
            seen = (v[:, 2] > 0) & (np.abs(e - middle) < middle - MARGIN).all(axis=1)
            u[~seen] = 0
            seen &= np.abs(depth[u[:, 1], u[:, 0]] / v[:, 2] - 1.0) < HIDDEN
            places, e = {name: p for (name, p), there in zip(places.items(), seen, strict=True) if there}, e[seen]
        old = len(e)
        for u in rng.integers(MARGIN, np.array(sensor.image) - MARGIN, (200, 2)):
            if len(places) >= IN_VIEW or (old and len(places) >= old + STARTS):
                break
            if len(e) and np.linalg.norm(e - u, axis=1).min() < APART:
                continue
            ray = sensor.rays(u[None].astype(np.float64))
            place = from_frame_many(T, ray * (depth[u[1], u[0]] / ray[0, 2]))[0][0]
            places[f"{event.t_ns} {len(places)}"], e = place, np.concatenate([e, u[None]])
        y = e + sigma_px * rng.standard_normal(e.shape)
        yield km.Scan(t_ns=event.t_ns, robot=event.robot, sensor=event.sensor, y=y, ids=[*places])


def run(world: Any, sigma_px: float, seed: int, landmark: Any, estimator: Any) -> tuple[Array, Array]:
    """Return after each frame the error of the position [m] and the NEES of the pose (6), NaN while it is known."""
    log = simulate(world, seed=seed)
    (robot,) = without_detectors(build_slam(world.config(), log).robots.values())
    (sensor,) = robot.sensors
    mount = replace(robot.sensors[sensor], landmark=landmark)
    slam = km.Slam(replace(robot, sensors={sensor: mount}), estimator=estimator, map="dense")
    off, nees = [], []
    for event in matches(log, mount.sensor, sigma_px, seed):
        slam.process(event)
        if not isinstance(event, km.Scan):
            continue
        for name in set(slam.tracks.confirmed) - set(event.ids or ()):
            slam.remove(name)
        error = minus(slam.mean(robot.name)[:7], log.truth[robot.name].at([event.t_ns])[0][:7])
        P = slam.covariance(robot.name)[:6, :6]
        off.append(float(np.linalg.norm(error[:3])))
        nees.append(float(error @ np.linalg.solve(P, error)) if np.linalg.cond(P) < SINGULAR else np.nan)
    return np.array(off), np.array(nees)


def main(sigma_px: float, seeds: int) -> None:
    """Print a row a landmark and estimator."""
    world = load_world("textured_room", ["world.pixel_m=0.05", f"robots.robot.sensors.camera.sigma_px={sigma_px}"])
    print("| landmark | estimator | position, m, RMS | largest | NEES of the pose |\n|---|---|---|---|---|")
    for kind, landmark in LANDMARKS.items():
        for name, estimator in ESTIMATORS.items():
            found = [run(world, sigma_px, seed, landmark, estimator) for seed in range(seeds)]
            off, nees = np.array([one[0] for one in found]), np.array([one[1] for one in found])
            rms = np.sqrt(np.mean(off**2))
            print(f"| {kind} | {name} | {rms:.3f} | {off.max():.3f} | {np.nanmean(nees) / 6:.1f} |", flush=True)


if __name__ == "__main__":
    with one_thread():
        main(float(sys.argv[1]) if len(sys.argv) > 1 else 0.15, int(sys.argv[2]) if len(sys.argv) > 2 else 3)
