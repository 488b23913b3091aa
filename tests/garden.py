"""A garden of six trees that a robot may map twice."""

from __future__ import annotations

import numpy as np

import kalmark as km

GARDEN = np.array([[4.0, 1.0], [6.0, -2.0], [5.0, 4.0], [8.0, 1.0], [9.0, -3.0], [3.0, -4.0]])


def slam_of(estimator: object = None, map_: str = "auto", **upkeep: float) -> km.Slam:
    sensor = km.sensors.RangeBearing(0.05, 0.01, range_max_m=12.0)
    cart = km.Robot("cart", km.motion.Odometry2D(), sensors={"lidar": km.Mount(sensor)})
    kept = km.Upkeep(hold_back=True, **upkeep)  # type: ignore[arg-type]
    return km.Slam([cart], km.association.GlobalAssignment(), estimator, map=map_, upkeep=kept)  # type: ignore[arg-type]


def look(slam: km.Slam, t: int, points: np.ndarray, seed: int = 0) -> km.Report:
    """See points from the origin, where the robot really stands."""
    rng = np.random.default_rng([seed, t])
    y = km.geometry.observe(np.zeros(3), points)[0] + rng.normal(size=(len(points), 2)) * [0.05, 0.01]
    return slam.process(km.Scan(t, "cart", "lidar", y))
