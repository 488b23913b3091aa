"""The compressed map with every block of space: the dense map's covariance and gauge."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.filter.compressed.compressed_map import CompressedMap
from kalmark.filter.compressed.schedule import Schedule
from kalmark.filter.estimators import Update
from kalmark.filter.map import StochasticMap
from kalmark.geometry.rotations import exp
from kalmark.geometry.spaces import SE3, Space
from kalmark.models import landmarks
from kalmark.models.observe import expectation, view_of
from placed_landmarks import placed

POINT, LIDAR = km.landmarks.Point3D(), km.sensors.RangeBearing3D()
MOUNT = np.array([0.2, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0])
START = np.concatenate([[0.4, -0.3, 0.2], exp(np.array([0.1, 0.2, -0.15]))])
R = np.diag([0.05, 0.02, 0.02]) ** 2
POINTS, SEEN = 10, 3
STEPPED = ("homogeneous", "pluecker_line", "homogeneous_line")  # moved by a translation by what depends on their value


def a_map(stepped: bool, turn: float, own: float) -> tuple[StochasticMap, list[Space]]:
    """Return a robot, points and two blocks of every other kind: uncertain together by a turn, each by its own."""
    rng, m = np.random.default_rng(1), StochasticMap()
    kinds = [
        kind() for kind in landmarks.BUILT_IN if kind().space.world == "space" and (stepped or kind.kind not in STEPPED)
    ]
    models = [POINT] * POINTS + [kind for kind in kinds if kind.kind != "point3"] * 2
    spaces, means = [SE3], [START]
    for model in models:
        p, q = rng.normal(size=3) * 4, rng.normal(size=3) * 4
        spaces.append(model.space)
        means.append(placed(model, np.array([0.0, 0, 0, 0, 0, 0, 1]), p, q, rng))
    B = np.vstack([s.generator(x)[:, -3:] for s, x in zip(spaces, means, strict=True)])
    for space, mean in zip(spaces, means, strict=True):
        m.add(space, mean)
    W = rng.normal(size=(m.n, m.n + 5)) * own
    W[:6] = 0.0
    m.P[: m.n, : m.n] = W @ W.T / m.n + turn**2 * B @ B.T
    return m, spaces


def scans(m: StochasticMap, steps: int, error: float, slots: range) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return slots of points and what a robot at the start sees of them, each where the map has it within an error."""
    rng, seen = np.random.default_rng(2), []
    world = {slot: m.mean(slot) + rng.normal(size=3) * error for slot in slots}
    for _ in range(steps):
        near = rng.choice(list(slots), SEEN, replace=False)
        l = np.array([world[slot] for slot in near])
        y = expectation(START, MOUNT, LIDAR, POINT, l)[0]
        seen.append((near, y + rng.normal(size=y.shape) * np.sqrt(np.diag(R))))
    return seen


def correct(m: Any, slots: np.ndarray, y: np.ndarray) -> None:
    """Fuse what the robot sees of points."""
    noise, view = np.tile(R, (SEEN, 1, 1)), view_of(LIDAR, POINT, MOUNT)
    assert km.estimators.Invariant().correct(m, Update(view, 0, -1, slots, 3, y, noise)).fused.all()


@pytest.mark.parametrize("stepped", [False, True])
def test_corrections_applied_to_all_blocks_inactive_are_the_dense_filters(
    stepped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Schedule, "due", lambda *_: 1e300)  # each full update is over by the next correction
    dense, spaces = a_map(stepped, 0.1, 0.1)
    compressed = CompressedMap.from_dense(a_map(stepped, 0.1, 0.1)[0])
    compressed._far = lambda robot, s: True  # type: ignore[method-assign]
    Q = np.diag([0.02] * 3 + [0.01] * 3) ** 2
    for slots, y in scans(dense, 12, 0.1, range(1, 1 + POINTS)):
        for m in (dense, compressed):
            m.predict(m.index(0), np.eye(6), Q)
            correct(m, slots, y)
    every = range(len(spaces))
    P = dense.covariance(every)
    sigma = np.sqrt(np.diag(P))
    for slot, space in enumerate(spaces):
        np.testing.assert_allclose(space.minus(compressed.mean(slot), dense.mean(slot)), 0.0, atol=1e-9)
    np.testing.assert_allclose((compressed.covariance(every) - P) / np.outer(sigma, sigma), 0.0, atol=1e-9)
    assert len(compressed.entered) < len(spaces)


def test_a_block_that_moves_with_the_whole_pose_may_come_after_immediate_corrections(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Schedule, "due", lambda *_: 1e300)
    dense, spaces = a_map(False, 0.1, 0.1)
    compressed = CompressedMap.from_dense(a_map(False, 0.1, 0.1)[0])
    compressed._far = lambda robot, s: True  # type: ignore[method-assign]
    spaces.append(km.landmarks.Homogeneous().space)
    G = 0.1 * np.random.default_rng(6).normal(size=(spaces[-1].dof, 6))
    for i, (slots, y) in enumerate(scans(dense, 12, 0.1, range(1, 1 + POINTS))):
        for m in (dense, compressed):
            if i == 6:
                m.augment(spaces[-1], np.array([1.0, 2.0, 0.5, 0.8]), m.index(0), G, 0.01 * np.eye(len(G)))
            m.predict(m.index(0), np.eye(6), np.diag([0.02] * 3 + [0.01] * 3) ** 2)
            correct(m, slots, y)
        if i == 9:
            compressed.full_update()
    every = range(len(spaces))
    P = dense.covariance(every)
    sigma = np.sqrt(np.diag(P))
    np.testing.assert_allclose((compressed.covariance(every) - P) / np.outer(sigma, sigma), 0.0, atol=1e-9)
    for slot, space in enumerate(spaces):
        np.testing.assert_allclose(space.minus(compressed.mean(slot), dense.mean(slot)), 0.0, atol=1e-9)


@pytest.mark.parametrize("stepped", [False, True])
def test_a_standing_robot_learns_nothing_of_its_orientation_from_any_block_inactive(stepped: bool) -> None:
    prior = np.radians(20)
    before, spaces = a_map(stepped, prior, 0.05)
    m = CompressedMap.from_dense(before, most=90)
    m._far = lambda robot, s: False  # type: ignore[method-assign]
    for slots, y in scans(before, 60, 0.05, range(1, 1 + POINTS)):
        correct(m, slots, y)
    P = m.covariance(range(len(spaces)))
    gauge = np.vstack([space.generator(m.mean(slot))[:, -3:] for slot, space in enumerate(spaces)])
    np.testing.assert_allclose(P[:, 3:6] / prior**2, gauge, rtol=0, atol=1e-8)
    moved = [np.abs(s.minus(m.mean(i), before.mean(i))).max() for i, s in enumerate(spaces)]
    assert min(moved[1:]) > 1e-4, "blocks that were never seen have moved as well"
