"""A field of landmarks and a robot that mows it: the log that benchmarks of large maps share."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

import kalmark as km
from kalmark.filter.compressed.compressed_map import CompressedMap

SPACING_M, LANE_M, STEP_M, REACH_M, VIEW = 2.0, 6.0, 0.2, 4.0, 10
ODOMETRY, SIGHT = np.array([0.01, 0.0, 0.02]), np.array([0.1, 0.02])
Step = tuple[km.Control, km.Scan]


class Field:
    """A field of landmarks, 2 m apart, and a robot's true pose in it; makes the events of its way."""

    def __init__(self, columns: int, rows: int, lane_m: float = LANE_M, reach_m: float = REACH_M) -> None:
        self.rng, self.columns, self.rows = np.random.default_rng(0), columns, rows
        self.lane_m, self.reach_m = lane_m, reach_m
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
        corners = (grid.reshape(-1, 2) + 0.5) * SPACING_M
        self.landmarks = corners + self.rng.uniform(-0.5, 0.5, corners.shape)
        self.tree, self.t = cKDTree(self.landmarks), 0
        self.truth = self.start = np.array([0.0, lane_m / 2, 0.0])

    def step(self, u: Any, most: int | None = None) -> Step:
        """Move by u and look around: at all landmarks in reach or at the nearest ones."""
        self.truth, self.t = km.geometry.compose(self.truth, np.array(u, dtype=float))[0], self.t + 1
        p = self.truth[:2]
        near = self.tree.query(p, most)[1] if most else self.tree.query_ball_point(p, self.reach_m)
        ids = sorted(int(i) for i in near)
        y = km.geometry.observe(self.truth, self.landmarks[ids])[0] if ids else np.zeros((0, 2))
        y = y + self.rng.normal(size=y.shape) * SIGHT
        y[:, 0] = np.abs(y[:, 0])
        control = km.Control(self.t, "r", np.array(u) + self.rng.normal(size=3) * ODOMETRY)
        return control, km.Scan(self.t, "r", "lidar", y, ids)

    def mission(self, step_m: float = STEP_M) -> list[Step]:
        """Return lanes to and fro, joined by half circles."""
        length, half = self.columns * SPACING_M, np.pi * self.lane_m / 2
        lanes, turn = int(np.ceil(self.rows * SPACING_M / self.lane_m)), int(np.ceil(half / step_m))
        steps = []
        for lane in range(lanes):
            steps += [self.step((step_m, 0, 0)) for _ in range(int(length / step_m))]
            bend = (half / turn, 0, (-1) ** lane * np.pi / turn)
            steps += [self.step(bend) for _ in range(turn if lane < lanes - 1 else 0)]
        return steps

    def back(self, step_m: float = STEP_M) -> list[Step]:
        """Return a turn on the spot and the way back to the middle of the lane."""
        about = [self.step((0, 0, np.pi / 4)) for _ in range(4)]
        return about + [self.step((step_m, 0, 0)) for _ in range(int(self.columns * SPACING_M / 2 / step_m))]

    def circle(self, count: int, step_m: float = 0.1, radius_m: float = 1.0, view: int = VIEW) -> list[Step]:
        """Return steps round a circle, anticlockwise or, with a negative radius, clockwise."""
        return [self.step((step_m, 0, step_m / radius_m), view) for _ in range(count)]

    def rush(self, count: int) -> list[Step]:
        """Return steps so long that what is in view is never what was, to and fro through a square field."""
        steps, heading, side = [], 0.0, self.columns * SPACING_M
        for _ in range(count):
            p = self.truth[:2] + 10 * np.array([np.cos(self.truth[2]), np.sin(self.truth[2])])
            heading = 2.0 if (p < self.reach_m).any() or (p > side - self.reach_m).any() else 0.0
            steps.append(self.step((0.0 if heading else 10.0, 0, heading), VIEW))
        return steps

    def slam(self, map_: str = "auto") -> km.Slam:
        """Return the Slam of a robot at the start."""
        return new_slam(self.start, map_)


def new_slam(start: Any, map_: str = "auto", association: km.association.Association | None = None) -> km.Slam:
    """Return the Slam that is timed, by default told every id."""
    lidar = km.Mount(km.sensors.RangeBearing(*SIGHT))
    robot = km.Robot("r", km.motion.Odometry2D(*ODOMETRY), start, {"lidar": lidar})
    return km.Slam([robot], association or km.association.ByIdentity("off"), map=map_)


def known_field(side: int, map_: str) -> tuple[Field, km.Slam]:
    """Return a square field and a Slam that knows all its landmarks."""
    field = Field(side, side)
    slam = field.slam(map_)
    for i, landmark in enumerate(field.landmarks):
        slam.add_landmark(i, landmark, 0.01 * np.eye(2))
    if isinstance(slam.map, CompressedMap):
        slam.map.full_update()
        slam.map.finish()
    else:
        while slam.map.prepare():  # the larger buffer, which else comes bit by bit with the first hundred steps
            pass
    return field, slam
