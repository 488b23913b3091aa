"""Segments on the line of a wall that do not join it: the gap against three sigmas along the wall, by differences."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.association.wall_segments import FARTHEST, SIGMAS, disjoint_from_walls, gap
from kalmark.filter.map import StochasticMap
from kalmark.geometry import SE2
from kalmark.tracks.channel import Channel
from kalmark.tracks.clones import Clones
from kalmark.tracks.scan import ScanContext
from kalmark.tracks.track import Track, Tracks

WALL = km.landmarks.Wall2D(join_m=0.4)
ROBOT, L = np.array([1.0, -2.0, 0.6]), np.array([2.0, 3.0, 1.1])
EXTENT = np.array([-1.5, 0.5])
STEP = 1e-6
A = 0.01 * np.random.default_rng(4).normal(size=(6, 8))
P = A @ A.T  # of the robot and the wall


def scan_of(segments: Any) -> tuple[ScanContext, Track]:
    """Return a scan of segments (K, 2) on the line of the wall, by their abscissas on it, and the track of the wall."""
    m, tracks = StochasticMap(), Tracks(["r"])
    m.add(SE2, ROBOT, P[:3, :3])
    m.augment(WALL.space, L, m.index(0), P[3:, :3] @ np.linalg.inv(P[:3, :3]), np.zeros((3, 3)))
    m.P[3:6, 3:6] = P[3:, 3:]
    track = Track("wall", WALL, 1, extent=EXTENT)
    tracks.enter(track)
    n, along = np.array([math.cos(L[2]), math.sin(L[2])]), np.array([-math.sin(L[2]), math.cos(L[2])])
    foot = along @ (ROBOT[:2] - L[:2])  # the abscissa of the foot of the perpendicular
    y = [[n @ (L[:2] - ROBOT[:2]), L[2] - ROBOT[2], a - foot, b - foot] for a, b in segments]
    channel = Channel(km.sensors.Wall(), np.zeros(3), -1, WALL, lambda dof: math.inf, [WALL])
    event = km.Scan(0.0, "r", "s", np.array(y))
    R, report = np.tile(np.diag([0.02, 0.01]) ** 2, (len(y), 1, 1)), km.Report(event, event.y)
    scan = ScanContext(m, tracks, Clones(), km.estimators.Ekf(), channel, 0, event, (None,) * len(y), R, report)
    return scan, track


def sigma_along(end: float) -> float:
    """Return the sigma of where a point that is fixed in the robot's frame is along the wall, by differences.

    The point is at an end of the wall, from which the place is counted.
    """

    def place(x: np.ndarray) -> float:
        c, s = math.cos(x[2] - ROBOT[2]), math.sin(x[2] - ROBOT[2])
        along = np.array([-math.sin(L[2]), math.cos(L[2])])
        off = L[:2] + end * along - ROBOT[:2]
        seen = x[:2] + np.array([c * off[0] - s * off[1], s * off[0] + c * off[1]])
        known = x[3:5] + end * np.array([-math.sin(x[5]), math.cos(x[5])])
        return float(along @ (seen - known))

    x = np.concatenate([ROBOT, L])
    J = np.array([(place(x + h) - place(x - h)) / (2 * STEP) for h in STEP * np.eye(6)])
    return math.sqrt(float(J @ P @ J))


def disjoint(segments: Any, d2: float = 1.0) -> list[bool]:
    scan, track = scan_of(segments)
    rows = np.arange(len(scan.y))
    return disjoint_from_walls(scan, WALL, [track] * len(rows), rows, np.full(len(rows), d2)).tolist()


def test_a_gap_is_the_distance_of_two_intervals_whichever_comes_first() -> None:
    one, other = (
        np.array([[0.0, 1.0], [4.0, 6.0], [0.0, 5.0], [0.0, 1.0]]),
        np.array([[3.5, 4.0], [0.0, 1.0], [1.0, 2.0], [1.0, 2.0]]),
    )
    np.testing.assert_array_equal(gap(one, other), [2.5, 3.0, -2.0, 0.0])


@pytest.mark.parametrize(("share", "far"), [(0.999, False), (1.001, True)])
def test_a_segment_is_disjoint_beyond_the_joining_gap_and_three_sigmas_along_the_wall(share: float, far: bool) -> None:
    assert SIGMAS == 3.0
    ends = [
        EXTENT[1] + WALL.join_m + share * 3.0 * sigma_along(0.5),
        EXTENT[0] - WALL.join_m - share * 3.0 * sigma_along(-1.5),
    ]
    assert 0.02 < 3.0 * sigma_along(0.5) < 0.5
    assert disjoint([(ends[0], ends[0] + 1.0), (ends[1] - 1.0, ends[1])]) == [far, far]


def test_a_segment_within_the_joining_gap_or_over_the_wall_joins_it() -> None:
    assert disjoint([(0.85, 2.0), (-5.0, -1.85), (-1.0, 0.0), (-9.0, 9.0)]) == [False] * 4


def test_neither_another_line_nor_a_wall_without_extent_is_tested() -> None:
    away = [(5.0, 6.0)]
    assert disjoint(away) == [True]
    assert disjoint(away, FARTHEST * 1.001) == [False]
    scan, _ = scan_of(away)
    fresh = Track("new", WALL, 1)
    assert disjoint_from_walls(scan, WALL, [fresh], np.array([0]), np.ones(1)).tolist() == [False]


def test_each_row_has_its_own_track_and_its_own_observation() -> None:
    scan, track = scan_of([(5.0, 6.0), (0.0, 1.0)])
    fresh = Track("new", WALL, 1)
    rows = np.array([1, 0, 0])
    found = disjoint_from_walls(scan, WALL, [track, fresh, track], rows, np.ones(3))
    assert found.tolist() == [False, False, True]
