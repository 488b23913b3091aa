"""Pose graphs of g2o: edges that close loops are readings against earlier poses, and give the optimum of the graph."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from differences import derivative
from kalmark.arrays import Array
from kalmark.config import build_slam, open_run
from kalmark.datasets.g2o import turned_round
from kalmark.geometry import frames, frames3d
from kalmark.geometry.angles import wrap
from kalmark.results.run import Run

ODOMETRY, LOOP = np.array([0.05, 0.05, 0.02]), np.array([0.03, 0.03, 0.015])
Edge = tuple[int, int, Array, Array]


def change(a: Array, b: Array) -> Array:
    return frames.compose(frames.inverse(a)[0], b)[0]


def city(seed: int, poses: int = 150, size: int = 8, noise: float = 1.0) -> tuple[Array, list[Edge]]:
    """Return true poses (N, 3) of a robot in a city of blocks of 1 m, and edges: its steps, and where it has been."""
    rng = np.random.default_rng(seed)
    true, edges = np.zeros((poses, 3)), list[Edge]()
    for k in range(1, poses):
        here, ways = true[k - 1], (0.0, 0.0, np.pi / 2, -np.pi / 2)
        steps = [frames.compose(here, np.array([np.cos(w), np.sin(w), w]))[0] for w in rng.permutation(ways)]
        true[k] = next((s for s in steps if (np.abs(s[:2]) < size / 2).all()), steps[0])
        near = np.flatnonzero(np.hypot(*(true[: max(k - 10, 0), :2] - true[k, :2]).T) < 0.5)
        for a in [k - 1, *near[:2].tolist()]:
            sigma = ODOMETRY if a == k - 1 else LOOP
            edge = change(true[a], true[k]) + noise * rng.normal(0.0, sigma)
            edges.append((a, k, edge, np.diag(sigma**-2.0)))
    return true, edges


def written(path: Path, edges: Sequence[Edge], reverse: bool = False) -> Path:
    """Write a graph of the plane; those edges that close loops from the later pose, where `reverse`."""
    lines = []
    for a, b, z, H in edges:
        ids, step, info = (a, b), z, H
        if reverse and b - a > 1:
            step, C = turned_round(z, np.linalg.inv(H))
            ids, info = (b, a), np.linalg.inv(C)
        numbers = [*step.tolist(), *info[np.triu_indices(3)].tolist()]
        lines.append(" ".join(map(str, ["EDGE_SE2", *ids, *numbers])))
    path.write_text("\n".join(lines) + "\n")
    return path


def in_space(path: Path, edges: Sequence[Edge]) -> Path:
    """Write the graph of the plane as one of space; g2o's errors of a turn are half of its angle."""
    lines = []
    for a, b, (x, y, turn), H in edges:
        wide = np.zeros((6, 6))
        wide[np.ix_([0, 1, 5], [0, 1, 5])] = np.diag([1, 1, 2]) @ H @ np.diag([1, 1, 2])
        wide[[2, 3, 4], [2, 3, 4]] = 1e10
        z = [x, y, 0.0, 0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)]
        numbers = map(repr, map(float, [*z, *wide[np.triu_indices(6)]]))
        lines.append(" ".join(["EDGE_SE3:QUAT", str(a), str(b), *numbers]))
    path.write_text("\n".join(lines) + "\n")
    return path


def opened(path: Path) -> tuple[km.Slam, km.Log]:
    config, log = open_run(path)
    return build_slam(config, log), log


def run_of(path: Path) -> Run:
    slam, log = opened(path)
    return km.record(slam, log, progress=False)


def optimum(path: Path) -> tuple[Array, Array]:
    """Return the last pose (3,) of the batch solution of GTSAM, and its covariance (3, 3) in the frame of the map."""
    gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed")
    graph, _ = gtsam.readG2o(str(path), False)
    values, here, last = gtsam.Values(), gtsam.Pose2(), 0
    values.insert(0, here)
    for k in range(graph.size()):
        a, b = graph.at(k).keys()
        if b == a + 1:
            here, last = here.compose(graph.at(k).measured()), b
            values.insert(b, here)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-7)))
    best = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    pose, P = best.atPose2(last), gtsam.Marginals(graph, best).marginalCovariance(last)
    J = np.eye(3)
    J[:2, :2] = pose.rotation().matrix()
    return np.array([pose.x(), pose.y(), pose.theta()]), J @ P @ J.T


def d2(a: Array, b: Array, P: Array) -> float:
    d = a - b
    d[2] = wrap(d[2])
    return float(d @ np.linalg.solve(P, d))


@pytest.mark.parametrize("reverse", [False, True])
def test_loops_of_a_graph_give_its_optimum(reverse: bool, tmp_path: Path) -> None:
    _, edges = city(1, noise=0.02)
    path = written(tmp_path / "a.g2o", edges, reverse)
    mean, P = optimum(path)
    run = run_of(path)
    slam = run.final_slam()
    assert d2(slam.mean("robot"), mean, P) < 1e-4
    np.testing.assert_allclose(slam.covariance("robot"), P, rtol=0.01, atol=0.005 * float(np.diag(P).min()))
    assert (run.history.outcome == "associated").sum() == len(edges) - 149 > 50 and len(run.history.poses) == 150


def test_graphs_with_loops_are_consistent_and_near_the_optimum(tmp_path: Path) -> None:
    nees, off = [], []
    for seed in range(30):
        true, edges = city(seed)
        path = written(tmp_path / "a.g2o", edges)
        slam = run_of(path).final_slam()
        nees.append(d2(slam.mean("robot"), true[-1], slam.covariance("robot")))
        if seed < 5:
            mean, P = optimum(path)
            off.append(d2(slam.mean("robot"), mean, P))
    low, high = chi2.ppf([0.001, 0.999], 3 * len(nees))
    assert low < sum(nees) < high
    assert max(off) < 0.01


def test_a_graph_of_space_is_that_of_the_plane(tmp_path: Path) -> None:
    """Some of its loops are closed by a robot that looks the other way."""
    _, edges = city(2)
    assert any(b - a > 1 and abs(abs(z[2]) - np.pi) < 0.1 for a, b, z, _ in edges)
    flat = run_of(written(tmp_path / "a.g2o", edges)).final_slam()
    slam = run_of(in_space(tmp_path / "b.g2o", edges)).final_slam()
    x, q = slam.mean("robot"), flat.mean("robot")
    np.testing.assert_allclose([*x[:2], wrap(2 * np.arctan2(x[5], x[6]))], q, atol=1e-4)
    keep = np.ix_([0, 1, 5], [0, 1, 5])
    np.testing.assert_allclose(slam.covariance("robot")[keep], flat.covariance("robot"), rtol=1e-3, atol=1e-6)


def test_poses_are_kept_as_long_as_a_later_edge_names_them(tmp_path: Path) -> None:
    _, edges = city(3)
    slam, log = opened(written(tmp_path / "a.g2o", edges))
    loops = [(a, b) for a, b, _, _ in edges if b - a > 1]
    last = {a: max(b for one, b in loops if one == a) for a, _ in loops}
    slam.prepare_for(log.events)
    for event in log:
        slam.process(event)
        now = event.t_ns // 10**9
        kept = {clone.t_ns // 10**9 for clone in slam.state.clones.clones.values()}
        assert kept == {a for a, b in last.items() if a <= now < b} or isinstance(event, km.Control)
    assert not slam.state.clones.clones


@pytest.mark.parametrize("space", [False, True])
def test_the_errors_of_an_edge_turned_round_are_those_of_g2o(space: bool) -> None:
    rng = np.random.default_rng(4)
    q = rng.normal(size=4)
    Z = np.append(rng.normal(size=3), q / np.linalg.norm(q)) if space else np.array([1.0, -0.5, 2.5])
    g = frames3d if space else frames
    back, C = turned_round(Z, np.eye(6 if space else 3))

    def error(e: Array) -> Array:
        d = np.array([*e[:3], *e[3:], np.sqrt(1 - e[3:] @ e[3:])]) if space else e
        X = g.inverse(g.compose(Z, d)[0])[0]
        D = g.compose(g.inverse(back)[0], X)[0]
        return np.append(D[:3], D[3:6] * np.sign(D[6])) if space else D

    J = derivative(error, np.zeros(6 if space else 3))
    np.testing.assert_allclose(C, J @ J.T, atol=1e-6)
