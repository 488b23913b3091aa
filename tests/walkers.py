"""A field in which somebody walks about: what a robot sees of it, and what each landmark of its map really is."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

import kalmark as km
from kalmark.arrays import Array, Flags
from kalmark.events import Event, Scan
from kalmark.logs.log import Log, Trajectory

DT_S, SPEED_MPS, TURN_RADPS = 0.2, 1.0, 0.5
ODOMETRY, SIGHT = np.array([0.005, 0.005, 0.005]), np.array([0.05, 0.01])
WALKS_MPS, WALKS_S, STANDS_S = 1.2, 2.0, 1.0
HIDES_M = 0.15  # half the width of what hides others
WALKER = -1


@dataclass(frozen=True)
class Field:
    """`count` trees in a square that a robot wanders about; those in view are seen with `p_detect`.

    With `walks` somebody walks about in it, and stands at times; with `hides` a tree hides what is behind it.
    """

    count: int = 40
    side_m: float = 24.0
    fov_rad: float = math.pi
    range_m: float = 8.0
    stated: bool = True
    p_detect: float = 0.9
    hides: bool = False
    walks: bool = False

    @property
    def sensor(self) -> km.sensors.RangeBearing:
        """What the filter is told of the sensor."""
        limits = {"fov_rad": self.fov_rad, "range_max_m": self.range_m} if self.stated else {}
        return km.sensors.RangeBearing(*SIGHT.tolist(), **limits)

    def slam(self, association: object = None, upkeep: km.Upkeep | None = None) -> km.Slam:
        """Return a filter that starts at the robot."""
        mount = km.Mount(self.sensor, upkeep=upkeep)
        robot = km.Robot("r", km.motion.Odometry2D(*ODOMETRY.tolist()), self.start, {"lidar": mount})
        return km.Slam([robot], association or km.association.GlobalAssignment())  # type: ignore[arg-type]

    @property
    def start(self) -> Array:
        """The first pose."""
        return np.array([0.5 * self.side_m, 0.5 * self.side_m, 0.0])

    def log(self, steps: int, seed: int) -> tuple[Log, dict[int, list[int]]]:
        """Return a log of scans without ids, and what each scan is of by its time (ns): trees, or the WALKER."""
        rng, events, of, poses = np.random.default_rng(seed), list[Event](), dict[int, list[int]](), dict[int, Array]()
        trees, pose = rng.uniform(0, self.side_m, (self.count, 2)), self.start
        way, to = self._walk(rng), rng.uniform(3, self.side_m - 3, 2)
        for k in range(steps):
            t_s = DT_S * (k + 1)
            if np.linalg.norm(to - pose[:2]) < 1.0:
                to = rng.uniform(3, self.side_m - 3, 2)
            turn = math.remainder(math.atan2(*(to - pose[:2])[::-1]) - pose[2], 2 * math.pi)
            u = np.array([SPEED_MPS * DT_S, 0.0, np.clip(turn, -TURN_RADPS * DT_S, TURN_RADPS * DT_S)])
            pose = km.geometry.compose(pose, u)[0]
            things = np.concatenate([trees, next(way)[None]]) if self.walks else trees
            y = km.geometry.observe(pose, things)[0]
            names = np.append(np.arange(self.count), WALKER)[: len(things)]
            seen = np.flatnonzero(self._in_view(y) & (rng.random(len(y)) < self.p_detect))
            events.append(km.Control(t_s, "r", u + rng.normal(size=3) * ODOMETRY))
            noisy = y[seen] + rng.normal(size=(len(seen), 2)) * SIGHT
            scan = km.Scan(t_s, "r", "lidar", np.column_stack([np.abs(noisy[:, 0]), noisy[:, 1]]))
            events.append(scan)
            of[scan.t_ns], poses[scan.t_ns] = names[seen].tolist(), pose
        return Log("field", ("r",), events, truth={"r": Trajectory.of(poses)}), of

    def _walk(self, rng: np.random.Generator) -> Iterator[Array]:
        at, to, t_s = rng.uniform(0, self.side_m, 2), rng.uniform(0, self.side_m, 2), 0.0
        while True:
            t_s += DT_S
            step, left = WALKS_MPS * DT_S * (t_s % (WALKS_S + STANDS_S) < WALKS_S), float(np.linalg.norm(to - at))
            at = at + (to - at) * min(1.0, step / left)
            to = rng.uniform(0, self.side_m, 2) if left <= step else to
            yield at

    def _in_view(self, y: Array) -> Flags:
        seen: Flags = (y[:, 0] < self.range_m) & (np.abs(y[:, 1]) <= 0.5 * self.fov_rad)
        if self.hides:
            apart = np.abs(np.angle(np.exp(1j * (y[:, None, 1] - y[None, :, 1]))))
            behind = (y[:, None, 0] > y[None, :, 0]) & (apart < np.arctan2(HIDES_M, y[None, :, 0]))
            seen &= ~behind.any(axis=1)
        return seen


def mapped(slam: km.Slam, events: Sequence[Event], of: dict[int, list[int]]) -> dict[object, int]:
    """Filter events; return what most observations of each landmark of the map are of."""
    votes: dict[object, Counter[int]] = defaultdict(Counter)
    for event in events:
        report = slam.process(event)
        if isinstance(event, Scan):
            for o in report.observations:
                if o.landmark is not None:
                    votes[o.landmark][of[event.t_ns][o.index]] += 1
    return {name: votes[name].most_common(1)[0][0] for name in slam.landmarks().ids}
