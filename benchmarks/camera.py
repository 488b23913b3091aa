"""One camera, 40 points of unknown depth: a control and a scan through `Slam.process`, every outcome read, one thread.

Beside it the Matlab toolbox's figure: 49 ms a frame of its default scenario (up to 72 points, CPU time in Octave,
recorded on another machine), so that the ratio is for orientation.
"""

from __future__ import annotations

import time

import numpy as np

import kalmark as km
from kalmark.filter.kernels import one_thread
from kalmark.geometry.rotations import from_euler

POINTS, STEPS, TOOLBOX_S = 40, 300, 0.049


def step_s(landmark: object) -> float:
    """Return the median time of a step with all points in the image."""
    camera = km.sensors.PinHole()
    at = np.concatenate([np.zeros(3), from_euler(np.radians([-90.0, 0.0, -90.0]))[0]])
    rng = np.random.default_rng(0)
    rays = np.column_stack([rng.uniform(-0.8, 0.8, POINTS), rng.uniform(-0.6, 0.6, POINTS), np.ones(POINTS)])
    points = rays * rng.uniform(5, 20, (POINTS, 1))
    robot = km.Robot("r", km.motion.Odometry3D(), sensors={"camera": km.Mount(camera, at, landmark)})  # type: ignore[arg-type]
    slam, times = km.Slam([robot], reparametrize=None), []
    for t in range(STEPS):
        y = camera.expect(points)[0] + rng.normal(size=(POINTS, 2))
        start = time.perf_counter()
        slam.process(km.Control(t, "r", rng.normal(size=6) * 1e-3))
        report = slam.process(km.Scan(t, "r", "camera", y, range(POINTS)))
        fused = sum(seen.outcome == "associated" for seen in report.observations)
        times.append(time.perf_counter() - start)
        assert t == 0 or fused > 0.9 * POINTS
    return float(np.median(times))


if __name__ == "__main__":
    print(f"| {POINTS} points, one camera | ms a step | toolbox's default scenario over it |\n|---|---|---|")
    with one_thread():
        for kind in (km.landmarks.AnchoredHomogeneous(), km.landmarks.InverseDepth3D(), km.landmarks.Homogeneous()):
            took = step_s(kind)
            print(f"| {kind.kind} | {1e3 * took:.2f} | {TOOLBOX_S / took:.0f} |")
