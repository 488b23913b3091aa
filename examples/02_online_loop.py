"""Online: kalmark inside a robot's loop.  The drive and the lidar here are simulated; yours go in their place.

python examples/02_online_loop.py
"""

import gc

import numpy as np

import kalmark as km

POSTS = {1: (4.0, 1.0), 2: (2.0, 3.0), 3: (-1.0, 2.0), 4: (0.0, -2.0)}
rng = np.random.default_rng(0)
truth = np.zeros(3)


def drive(v: float, w: float, dt: float) -> None:
    """Stand in for the wheels."""
    global truth  # noqa: PLW0603
    truth = km.motion.Unicycle().move(truth, np.array([v, w]) + rng.normal(size=2) * [0.05, 0.03], dt)[0]


def observations() -> tuple[list[np.ndarray], list[int]]:
    """Stand in for the lidar and its detector: range (m), bearing (rad) and identity of the posts within 5 m."""
    y, _, _ = km.geometry.observe(truth, np.array(list(POSTS.values())))
    seen = [(m + rng.normal(size=2) * [0.05, 0.01], i) for m, i in zip(y, POSTS, strict=True) if m[0] < 5]
    return [m for m, _ in seen], [i for _, i in seen]


rover = km.Robot(
    "rover",
    motion=km.motion.Unicycle(sigma_v_mps=0.05, sigma_w_radps=0.03),
    sensors={"lidar": km.Mount(km.sensors.RangeBearing(sigma_range_m=0.05, sigma_bearing_rad=0.01))},
)
slam = km.Slam([rover])
slam.warm_up()  # compiles and loads all that it will need: no event waits for that
gc.freeze()  # all that is loaded by now stays: no collection of garbage goes through it while the robot drives

for t in np.arange(0.0, 20.0, 0.1):
    v, w = 0.5, 0.3
    slam.process(km.Control(t_s=t, robot="rover", u=(v, w)))  # holds until the next one
    drive(v, w, 0.1)
    y, ids = observations()
    report = slam.process(km.Scan(t_s=t + 0.1, robot="rover", sensor="lidar", y=y, ids=ids))
    for observation in report.observations:
        if observation.outcome == "rejected":
            print(f"t={t:.1f} s: landmark {observation.landmark} rejected: {observation.reason}")

x, y_, heading = slam.mean("rover")
sigma = np.sqrt(np.diag(slam.covariance("rover")))
print(f"the rover is at x={x:.2f} y={y_:.2f} m, heading {np.degrees(heading):.0f} deg; sigmas {sigma.round(3)}")
print(f"it really is at {truth.round(2)}")
