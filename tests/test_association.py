"""Which landmark was that: each observation for itself, all together, or jointly."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import kalmark as km
from kalmark.filter.postponed import PostponedMap
from kalmark.geometry.gaussian import gate
from kalmark.slam.joint import best_matching
from kalmark.slam.scene import Scene

METHODS = (
    km.association.NearestNeighbour(),
    km.association.GlobalAssignment(),
    km.association.JointCompatibility(),
)
ORIGIN = np.zeros(3)


def seen_from(truth: np.ndarray, points: np.ndarray, cov: np.ndarray, method: object, seen: list[int]) -> list[object]:
    """Return what becomes of sightings of the points `seen` from a pose that is believed to be the origin."""
    mount = km.Mount(km.sensors.Position2D(0.02))
    robot = km.Robot("r", km.motion.Odometry2D(), start=ORIGIN, cov=cov, sensors={"s": mount})
    slam = km.Slam([robot], method)  # type: ignore[arg-type]
    for i, point in enumerate(points):
        slam.add_landmark(i, point, 1e-4 * np.eye(2))
    y = km.geometry.to_frame(truth, points[seen])[0]
    return [
        o.landmark if o.outcome == "associated" else o.outcome
        for o in slam.process(km.Scan(1, "r", "s", y)).observations
    ]


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
def test_where_the_pose_is_clear_every_way_finds_the_landmarks_and_what_is_new(method: object) -> None:
    points = np.random.default_rng(0).uniform(-8, 8, (12, 2))
    robot = km.Robot("r", km.motion.Odometry2D(), sensors={"s": km.Mount(km.sensors.Position2D(0.02))})
    slam = km.Slam([robot], method, upkeep=km.Upkeep(confirm=1))  # type: ignore[arg-type]
    for i, point in enumerate(points[:-1]):
        slam.add_landmark(i, point, 1e-4 * np.eye(2))
    report = slam.process(km.Scan(1, "r", "s", points[[3, 11, 5]], ids=[None, None, 5]))
    assert [o.outcome for o in report.observations] == ["associated", "new", "associated"]
    assert [report.observations[i].landmark for i in (0, 2)] == [3, 5]


def test_one_landmark_between_two_observations_goes_to_the_one_that_makes_the_whole_better() -> None:
    points = np.array([[5.0, 0.0], [5.0, 1.0]])
    cov = np.diag([0.3, 0.3, 1e-6]) ** 2
    y_from = np.array([0.0, -0.55, 0.0])  # all seems .55 m further to the left than it is
    assert seen_from(y_from, points, cov, km.association.GlobalAssignment(), [0, 1]) == [0, 1]
    greedy = seen_from(y_from, points, cov, km.association.NearestNeighbour(), [0, 1])
    assert greedy != [0, 1]


def test_a_joint_test_finds_the_landmarks_when_the_pose_is_off_by_half_their_spacing() -> None:
    rng = np.random.default_rng(2)
    right = {type(m).__name__: 0 for m in METHODS}
    for _ in range(20):
        grid = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)), -1).reshape(-1, 2) * 2.0
        points = grid + rng.uniform(-0.7, 0.7, grid.shape)
        truth = rng.normal(size=3) * [0.4, 0.4, np.radians(5)]
        seen = rng.choice(len(points), 8, replace=False).tolist()
        cov = np.diag([0.4, 0.4, np.radians(5)]) ** 2
        for method in METHODS:
            right[type(method).__name__] += seen_from(truth, points, cov, method, seen) == seen
    assert right["JointCompatibility"] >= 18
    assert right["NearestNeighbour"] < 14


def test_branch_and_bound_finds_what_a_look_at_all_matchings_finds() -> None:
    rng = np.random.default_rng(3)
    gates = np.array([0.0, *(gate(0.95, 2 * n) for n in range(1, 5))])
    for _ in range(60):
        first = np.cumsum([0, *rng.integers(0, 4, size=4)])
        total = int(first[-1])
        landmark = np.concatenate([rng.choice(5, n, replace=False) for n in np.diff(first)] or [np.zeros(0)]).astype(
            np.int64
        )
        A = rng.normal(size=(2 * total, 2 * total + 3))
        Z, z = A @ A.T / (2 * total + 3), rng.normal(size=(total, 2)) * 1.6
        chosen, finished = best_matching(first, landmark, z, Z, gates, 100_000)
        assert finished
        best = (0, 0.0)
        for pairs in itertools.product(*[[-1, *range(a, b)] for a, b in itertools.pairwise(first)]):
            used = [m for m in pairs if m >= 0]
            if len({int(landmark[m]) for m in used}) < len(used):
                continue
            rows = np.concatenate([[2 * m, 2 * m + 1] for m in used]).astype(int) if used else np.zeros(0, int)
            d2 = float(z[used].ravel() @ np.linalg.solve(Z[np.ix_(rows, rows)], z[used].ravel())) if used else 0.0
            fits = all(prefix_fits(used[: n + 1], z, Z, gates) for n in range(len(used)))
            if fits and (len(used), -d2) > (best[0], -best[1]):
                best = (len(used), d2)
        assert (chosen >= 0).sum() == best[0]


def test_what_is_asked_jointly_is_the_same_of_a_postponed_map_and_of_a_dense_one() -> None:
    points, asked = np.random.default_rng(4).uniform(2, 8, (6, 2)), []
    for map_ in ("dense", "postponed"):
        laser = km.Mount(km.sensors.RangeBearing(0.05, 0.01, sigma_range_rel=0.2))  # its noise depends on the place
        robot = km.Robot("r", km.motion.Odometry2D(), cov=0.01 * np.eye(3), sensors={"l": laser})
        slam = km.Slam([robot], map=map_)
        for i, point in enumerate(points):
            slam.add_landmark(i, point, 0.01 * np.eye(2))
        if isinstance(slam.map, PostponedMap):
            slam.map.flush()
            slam.map.index(slam.slot(3))  # awake, and not in the place it had
            slam.map.index(slam.slot("r"))
        view, scan = slam._views["r", "l"], km.Scan(1, "r", "l", km.geometry.observe(ORIGIN, points)[0])
        scene = Scene(slam, view, scan, (None,) * 6, np.zeros((6, 2, 2)))
        asked.append(scene.jointly(np.array([3, 3, 0]), [3, 4, 3]))
    np.testing.assert_allclose(asked[0][0], asked[1][0], atol=1e-12)
    np.testing.assert_allclose(asked[0][1], asked[1][1], atol=1e-12)


def prefix_fits(used: list[int], z: np.ndarray, Z: np.ndarray, gates: np.ndarray) -> bool:
    rows = np.concatenate([[2 * m, 2 * m + 1] for m in used])
    return bool(z[used].ravel() @ np.linalg.solve(Z[np.ix_(rows, rows)], z[used].ravel()) <= gates[len(used)])


def test_a_search_that_is_cut_short_gives_what_it_has() -> None:
    first, landmark = np.array([0, 2, 4]), np.array([0, 1, 0, 1])
    z, Z = np.zeros((4, 1)), np.eye(4)
    chosen, finished = best_matching(first, landmark, z, Z, np.full(3, 9.0), 3)
    assert not finished
    assert (chosen >= 0).sum() <= 2


def test_a_bad_setting_is_refused() -> None:
    with pytest.raises(km.KalmarkError, match="GlobalAssignment: gate is 2, expected a probability"):
        km.association.GlobalAssignment(gate=2)
    with pytest.raises(km.KalmarkError, match="most_nodes is 0, expected at least 1"):
        km.association.JointCompatibility(most_nodes=0)
