"""The sensors of [S] Table 2 on one robot's way round: what each is worth, and whether the filter knows it.

A robot drives 200 steps of .1 m on a circle among 24 landmarks, once with each of `km.presets`.  Printed: the mean NEES
of the pose over all steps of ten runs (3 is consistent), and the position's error at the end.
"""

from __future__ import annotations

import numpy as np

import kalmark as km
from kalmark.geometry import V_inverse, wrap
from kalmark.geometry.frames import compose

RUNS, STEPS, U = 10, 200, np.array([0.1, 0.0, 0.05])
NOISE = np.array([0.01, 0.01, np.radians(0.3)])  # of one step: forward, left, heading
LANDMARKS = np.array([(4.0 * np.cos(a), 2.0 + 4.0 * np.sin(a)) for a in np.arange(24) * np.pi / 12])


def run(preset: km.presets.Preset, seed: int) -> tuple[float, float]:
    """Return the mean NEES of the pose, and the error of the last position in m."""
    rng, pose, sensor, nees = np.random.default_rng(seed), np.zeros(3), preset.sensor, []
    slam = km.Slam([km.Robot("r", km.motion.Odometry2D(*NOISE), sensors={"s": km.Mount(sensor)})])
    for k in range(STEPS):
        pose = compose(pose, U)[0]
        slam.process(km.Control(0.1 * k, "r", U + rng.normal(size=3) * NOISE))
        v = km.geometry.to_frame(pose, LANDMARKS)[0]
        seen = np.flatnonzero(sensor.sees(v))
        e = sensor.expect(v[seen])[0]
        y = e + np.sqrt(np.diagonal(sensor.noise(e), axis1=1, axis2=2)) * rng.normal(size=e.shape)
        slam.process(km.Scan(0.1 * k, "r", "s", np.where(sensor.angular, wrap(y), y), seen.tolist()))
        d = np.append(pose[:2] - slam.mean("r")[:2], wrap(pose[2] - slam.mean("r")[2]))
        d[:2] = V_inverse(d[2]) @ d[:2]  # in the coordinates of the invariant filter
        nees.append(float(d @ np.linalg.solve(slam.covariance("r"), d)))
    return float(np.mean(nees)), float(np.hypot(*(pose - slam.mean("r"))[:2]))


print("sensor    ANEES (3)   error at the end, m")
for name, preset in km.presets.ALL.items():
    results = np.array([run(preset, seed) for seed in range(RUNS)])
    print(f"{name:9s} {results[:, 0].mean():7.2f} {results[:, 1].mean():13.3f}")
