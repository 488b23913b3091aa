"""Which landmark was that: each observation for itself, all together, or jointly."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import kalmark as km
from kalmark.association.matchings import Places, best_matching, matchings
from kalmark.association.query import Query
from kalmark.errors import EventError
from kalmark.filter.compressed.compressed_map import CompressedMap
from kalmark.geometry.gaussian import gate
from kalmark.tracks.scan import ScanContext

METHODS = (
    km.association.NearestNeighbour(),
    km.association.GlobalAssignment(),
    km.association.JointCompatibility(),
    km.association.Cliques(),
    km.association.Sampled(),
    km.association.Averaged(),
    km.association.Automatic(),
)
ORIGIN = np.zeros(3)
RANGING = km.sensors.RangeBearing(0.1, 0.05)
OTHERS = np.array([[4.0, 0.0], [5.0, 3.0], [6.0, -2.0]])


def pairwise_m(points: np.ndarray) -> np.ndarray:
    """Return how far points (N, 2) are from each other, sorted."""
    return np.sort(np.linalg.norm(points[:, None] - points, axis=2)[np.triu_indices(len(points), 1)])


def seen_from(truth: np.ndarray, points: np.ndarray, cov: np.ndarray, method: object, seen: list[int]) -> list[object]:
    """Return what becomes of observations of the points `seen` from a pose that is believed to be the origin."""
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
    assert min(right["Sampled"], right["Cliques"]) >= 12
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
        chosen, finished = best_matching(first, landmark, z, Z, np.zeros(len(landmark)), gates, 100_000)
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
        if isinstance(slam.map, CompressedMap):
            slam.map.full_update()
            slam.map.index(slam.slot(3))  # awake, and not in the place it had
            slam.map.index(slam.slot("r"))
        scan = km.Scan(1, "r", "l", km.geometry.observe(ORIGIN, points)[0])
        context = ScanContext(
            slam.map, slam.tracks, slam.clones, slam.estimator, slam.state.channels["r", "l"], slam.slot("r"), scan,
            (None,) * 6, np.zeros((6, 2, 2)), km.Report(scan, scan.y),
        )  # fmt: skip
        asked.append(Query(context).jointly(np.array([3, 3, 0]), [3, 4, 3]))
    np.testing.assert_allclose(asked[0][0], asked[1][0], atol=1e-12)
    np.testing.assert_allclose(asked[0][1], asked[1][1], atol=1e-12)


def jittered_grid(rng: np.random.Generator) -> np.ndarray:
    grid = np.stack(np.meshgrid(np.arange(-6, 7), np.arange(-6, 7)), -1).reshape(-1, 2) * 2.0
    return grid + rng.uniform(-0.7, 0.7, grid.shape)


def test_lost_by_a_metre_and_fifteen_degrees_the_automatic_choice_pairs_much_and_nothing_wrongly() -> None:
    rng, sigmas, paired = np.random.default_rng(5), np.array([1.0, 1.0, np.radians(15)]), 0
    for _ in range(25):
        points, truth = jittered_grid(rng), rng.normal(size=3) * sigmas
        near = np.flatnonzero(np.linalg.norm(points - truth[:2], axis=1) < 7)
        seen = rng.choice(near, 8, replace=False).tolist()
        told = seen_from(truth, points, np.diag(sigmas**2), km.association.Automatic(), seen)
        assert all(t in ("deferred", "tentative", s) for t, s in zip(told, seen, strict=True))
        paired += sum(t == s for t, s in zip(told, seen, strict=True))
    assert paired > 0.85 * 8 * 25


def test_where_two_matchings_are_alike_the_automatic_choice_holds_them_back_and_says_so() -> None:
    points = np.array([[5.0, 1.0], [5.0, -1.0], [-3.0, 1.0], [-3.0, -1.0]])  # ahead and behind look the same
    mount = km.Mount(km.sensors.Position2D(0.02))
    robot = km.Robot("r", km.motion.Odometry2D(), cov=np.diag([6.0, 0.1, 0.01]) ** 2, sensors={"s": mount})
    for method in (km.association.Automatic(), km.association.Cliques()):
        slam = km.Slam([robot], method)
        for i, point in enumerate(points):
            slam.add_landmark(i, point, 1e-4 * np.eye(2))
        before = slam.mean("r")
        report = slam.process(km.Scan(1, "r", "s", [[1.0, 1.0], [1.0, -1.0]]))
        assert [o.outcome for o in report.observations] == ["deferred"] * 2
        assert all(
            word in report.observations[0].reason for word in ("contradict",) if method == km.association.Cliques()
        )
        np.testing.assert_array_equal(slam.mean("r"), before)


@pytest.mark.parametrize(("built_alike", "outcome"), [(False, "associated"), (True, "deferred")])
def test_a_lost_robot_takes_no_matching_of_which_all_but_a_pair_fits_elsewhere(built_alike: bool, outcome: str) -> None:
    place = np.array([[4.0, 0.0], [7.0, 1.0], [5.5, 4.0], [2.0, -5.0], [9.0, -3.0]])
    again = km.geometry.from_frame(np.array([12.0, 9.0, 2.0]), place[:4])[0]
    mount = km.Mount(km.sensors.Position2D(0.05))
    robot = km.Robot("r", km.motion.Odometry2D(), cov=np.diag([30.0, 30.0, 1.8]) ** 2, sensors={"s": mount})
    slam = km.Slam([robot], km.association.Automatic())
    for i, point in enumerate(np.vstack([place, again]) if built_alike else place):
        slam.add_landmark(i, point, 1e-4 * np.eye(2))
    report = slam.process(km.Scan(1, "r", "s", place))
    assert {o.outcome for o in report.observations} == {outcome}


def test_a_search_that_was_not_finished_says_nothing_about_what_is_not_there() -> None:
    rng = np.random.default_rng(5)
    points, truth = jittered_grid(rng), np.array([0.2, -0.2, 0.02])
    mount = km.Mount(km.sensors.Position2D(0.02))
    for nodes, outcome in ((1, "deferred"), (1_000_000, "associated")):
        robot = km.Robot("r", km.motion.Odometry2D(), cov=np.diag([0.25, 0.25, 0.05]) ** 2, sensors={"s": mount})
        slam = km.Slam([robot], km.association.Automatic(most_nodes=nodes))
        for i, point in enumerate(points):
            slam.add_landmark(i, point, 1e-4 * np.eye(2))
        seen = np.argsort(np.linalg.norm(points, axis=1))[:6]
        report = slam.process(km.Scan(1, "r", "s", km.geometry.to_frame(truth, points[seen])[0]))
        assert {o.outcome for o in report.observations} == {outcome}


def test_samples_are_drawn_as_often_as_their_matchings_are_likely_and_again_for_the_same_scan() -> None:
    points = np.array([[4.0, 0.0], [4.0, 1.0]])  # one thing is seen, half way between the two
    mount = km.Mount(km.sensors.Position2D(0.05))
    robot = km.Robot("r", km.motion.Odometry2D(), cov=np.diag([1e-3, 0.5, 1e-4]) ** 2, sensors={"s": mount})

    def drawn(seed: int) -> object:
        slam = km.Slam([robot], km.association.Sampled(seed=seed))
        for i, point in enumerate(points):
            slam.add_landmark(i, point, 1e-4 * np.eye(2))
        return slam.process(km.Scan(1, "r", "s", [[4.0, 0.5]])).observations[0].landmark

    draws = [drawn(seed) for seed in range(60)]
    assert 15 <= draws.count(0) <= 45 and draws.count(0) + draws.count(1) >= 40
    assert draws[:10] == [drawn(seed) for seed in range(10)]


def pair_of_posts(method: object, estimator: object, spread: float = 0.4) -> km.Slam:
    """Return a robot, uncertain across its way, before two posts a metre apart across it."""
    mount = km.Mount(km.sensors.Position2D(0.1))
    robot = km.Robot("r", km.motion.Odometry2D(), cov=np.diag([0.05, spread, 0.02]) ** 2, sensors={"s": mount})
    slam = km.Slam([robot], method, estimator)  # type: ignore[arg-type]
    for i, point in enumerate([[4.0, 0.0], [4.0, 1.0]]):
        slam.add_landmark(i, point, 0.05**2 * np.eye(2))
    return slam


def test_an_average_over_matchings_has_the_mean_and_covariance_of_their_mixture() -> None:
    scan = km.Scan(1, "r", "s", [[4.0, 0.45]])
    soft = pair_of_posts(km.association.Averaged(), km.estimators.Ekf())
    observation = soft.process(scan).observations[0]
    weights = dict(observation.shares)
    assert set(weights) == {0, 1} and min(weights.values()) > 0.2 and sum(weights.values()) < 1
    none = 1 - sum(weights.values())
    means, covs, shares = [], [], [none, weights[0], weights[1]]
    for id_ in (None, 0, 1):
        hard = pair_of_posts(km.association.ByIdentity("off"), km.estimators.Ekf())
        hard.process(km.Scan(1, "r", "s", [[4.0, 0.45]], ids=[id_]))
        means.append(np.concatenate([hard.mean("r"), hard.mean(0), hard.mean(1)]))
        covs.append(hard.covariance("r", 0, 1))
    mean = np.average(means, axis=0, weights=shares)
    cov = sum(w * (P + np.outer(x - mean, x - mean)) for w, x, P in zip(shares, means, covs, strict=True))
    np.testing.assert_allclose(np.concatenate([soft.mean("r"), soft.mean(0), soft.mean(1)]), mean, atol=1e-9)
    np.testing.assert_allclose(soft.covariance("r", 0, 1), cov, atol=1e-9)


@pytest.mark.parametrize("estimator", [km.estimators.Ekf(), km.estimators.Invariant()], ids=["ekf", "invariant"])
def test_where_posts_are_confounded_the_average_is_as_certain_as_it_says_and_the_nearest_is_not(
    estimator: object,
) -> None:
    rng, sigmas, nees = np.random.default_rng(8), np.array([0.05, 0.6, 0.02]), {}
    truths = rng.normal(size=(300, 3)) * sigmas
    noise = rng.normal(size=(300, 2)) * 0.1
    posts = np.array([[4.0, 0.0], [4.0, 1.0]]) + rng.normal(size=(300, 2, 2)) * 0.05
    which = rng.integers(0, 2, 300)
    for method in (km.association.Averaged(), km.association.NearestNeighbour()):
        spent = []
        for truth, e, post, i in zip(truths, noise, posts, which, strict=True):
            slam = pair_of_posts(method, estimator, spread=0.6)
            y = km.geometry.to_frame(truth, post[i : i + 1])[0] + e
            slam.process(km.Scan(1, "r", "s", y))
            error = slam.mean("r") - truth
            spent.append(error @ np.linalg.solve(slam.covariance("r"), error))
        nees[type(method).__name__] = float(np.mean(spent))
    assert 2.4 < nees["Averaged"] < 3.6
    assert nees["NearestNeighbour"] > 6


def test_averages_need_a_dense_map_and_keep_it() -> None:
    slam = pair_of_posts(km.association.Averaged(), km.estimators.Invariant())
    for i in range(100):
        slam.add_landmark(f"far {i}", [100.0 + i, 0.0], np.eye(2))
    assert not isinstance(slam.map, CompressedMap)
    postponed = km.Slam(slam.robots.values(), km.association.Averaged(), map="postponed")
    for i, point in enumerate([[4.0, 0.0], [4.0, 1.0]]):
        postponed.add_landmark(i, point, 0.05**2 * np.eye(2))
    before = postponed.mean("r"), postponed.covariance("r", 0, 1)
    with pytest.raises(EventError, match="dense"):
        postponed.process(km.Scan(1, "r", "s", [[4.0, 0.05], [4.0, 1.1]], ids=[0, None]))
    np.testing.assert_array_equal(postponed.mean("r"), before[0])
    np.testing.assert_array_equal(postponed.covariance("r", 0, 1), before[1])


def test_an_average_takes_each_observations_noise_where_it_is_seen() -> None:
    points, seen = np.array([[2.0, 0.0], [20.0, 0.0], [20.0, 1.0]]), np.array([[2.0, 0.0], [20.0, 0.02]])
    laser = km.Mount(km.sensors.RangeBearing(1e-6, 0.01, sigma_range_rel=0.1))
    robot = km.Robot("r", km.motion.Odometry2D(), cov=np.diag([0.5, 0.3, 0.01]) ** 2, sensors={"s": laser})
    slam = km.Slam([robot], km.association.Averaged())
    for i, point in enumerate(points):
        slam.add_landmark(i, point, 1e-6 * np.eye(2))
    slam.process(km.Scan(1, "r", "s", km.geometry.observe(ORIGIN, seen)[0]))
    once = 1 / (1 / 0.5**2 + 1 / 0.2**2 + 1 / 2.0**2)  # ranges of 2 and of 20 m along x, told apart with 98 %
    np.testing.assert_allclose(slam.covariance("r")[0, 0], once, rtol=0.1)


def test_what_fits_no_landmark_from_where_the_others_are_seen_is_new_however_uncertain_the_pose() -> None:
    points, truth = jittered_grid(np.random.default_rng(6)), np.array([0.9, -1.1, 0.2])
    seen = np.flatnonzero(np.linalg.norm(points - truth[:2], axis=1) < 6)[:9].tolist()
    left_out = seen[4]
    mount = km.Mount(km.sensors.Position2D(0.02))
    cov = np.diag([1.0, 1.0, 0.2]) ** 2
    robot = km.Robot("r", km.motion.Odometry2D(), cov=cov, sensors={"s": mount})
    slam = km.Slam([robot], km.association.Automatic(), upkeep=km.Upkeep(confirm=1))
    for i, point in enumerate(points):
        if i != left_out:
            slam.add_landmark(i, point, 1e-4 * np.eye(2))
    report = slam.process(km.Scan(1, "r", "s", km.geometry.to_frame(truth, points[seen])[0]))
    told = [o.landmark if o.outcome == "associated" else o.outcome for o in report.observations]
    assert told == [s if s != left_out else "new" for s in seen]


def test_the_search_for_agreeing_pairs_finds_every_matching_that_a_look_at_all_finds() -> None:
    rng, gate1 = np.random.default_rng(7), gate(0.99, 1)
    for _ in range(40):
        v, l = rng.uniform(0, 3, (4, 2)), rng.uniform(0, 3, (5, 2))
        places = v, np.tile(0.05 * np.eye(2), (4, 1, 1)), l, 0.02 * np.eye(10)
        candidates = [np.flatnonzero(rng.uniform(size=5) < 0.7) for _ in range(4)]
        first, landmark = np.cumsum([0, *(len(c) for c in candidates)]), np.concatenate(candidates)
        found, finished = matchings(first, landmark, places, gate1, 1, 10**7, 1000)
        assert finished
        told = {tuple(-1 if m < 0 else int(landmark[m]) for m in row) for row in found}
        every = set()
        for choice in itertools.product(*[[-1, *c.tolist()] for c in candidates]):
            pairs = [(i, a) for i, a in enumerate(choice) if a >= 0]
            if (
                pairs
                and len({a for _, a in pairs}) == len(pairs)
                and all(fit(*p, *q, places, gate1) for p, q in itertools.combinations(pairs, 2))
            ):
                every.add(choice)
        most = max((sum(a >= 0 for a in c) for c in every), default=0)
        whole = {c for c in every if not any(grown(c, d) for d in every)}
        assert told == {c for c in whole if sum(a >= 0 for a in c) >= most - 1}


def fit(i: int, a: int, j: int, b: int, places: Places, gate1: float) -> bool:
    v, V, l, C = places
    seen, known = v[i] - v[j], l[a] - l[b]
    r, s = np.linalg.norm(seen), np.linalg.norm(known)
    J = np.zeros(10)
    J[2 * a : 2 * a + 2], J[2 * b : 2 * b + 2] = known / s, -known / s
    var = seen / r @ (V[i] + V[j]) @ (seen / r) + J @ C @ J
    return bool((r - s) ** 2 <= gate1 * var)


def grown(small: tuple[int, ...], large: tuple[int, ...]) -> bool:
    return small != large and all(a in (-1, b) for a, b in zip(small, large, strict=True))


def prefix_fits(used: list[int], z: np.ndarray, Z: np.ndarray, gates: np.ndarray) -> bool:
    rows = np.concatenate([[2 * m, 2 * m + 1] for m in used])
    return bool(z[used].ravel() @ np.linalg.solve(Z[np.ix_(rows, rows)], z[used].ravel()) <= gates[len(used)])


def test_a_search_that_is_cut_short_gives_what_it_has() -> None:
    first, landmark = np.array([0, 2, 4]), np.array([0, 1, 0, 1])
    z, Z = np.zeros((4, 1)), np.eye(4)
    chosen, finished = best_matching(first, landmark, z, Z, np.zeros(len(landmark)), np.full(3, 9.0), 3)
    assert not finished
    assert (chosen >= 0).sum() <= 2


def test_a_bad_setting_is_refused() -> None:
    with pytest.raises(km.KalmarkError, match="GlobalAssignment: gate is 2, expected a probability"):
        km.association.GlobalAssignment(gate=2)
    with pytest.raises(km.KalmarkError, match="most_nodes is 0, expected a whole number of at least 1"):
        km.association.JointCompatibility(most_nodes=0)


def test_one_landmark_in_the_map_is_recognised_again_and_another_beside_it_is_new() -> None:
    robot = km.Robot("r", km.motion.Odometry2D(), cov=1e-6 * np.eye(3), sensors={"s": km.Mount(RANGING)})
    slam, rng = km.Slam([robot], km.association.Automatic()), np.random.default_rng(1)
    posts = np.array([[5.0, 0.0], [5.0, 1.5]])
    outcomes = []
    for t in range(60):
        y = km.geometry.observe(ORIGIN, posts)[0] + rng.normal(size=(2, 2)) * [0.1, 0.05]
        outcomes.append([o.outcome for o in slam.process(km.Scan(t, "r", "s", y[: 1 + t // 30])).observations])
    assert outcomes[20:30].count(["associated"]) >= 9
    assert len(slam.landmarks()) == 2
    assert sum(both == ["associated", "associated"] for both in outcomes[40:]) >= 14


def lost(hold_back: bool) -> tuple[km.Slam, list[str]]:
    """Return what a robot, lost among six posts, makes of three others that it sees again and again."""
    robot = km.Robot("r", km.motion.Odometry2D(), cov=np.diag([9.0, 9.0, 0.1]), sensors={"s": km.Mount(RANGING)})
    slam = km.Slam([robot], km.association.Automatic(), upkeep=km.Upkeep(hold_back=hold_back))
    for i, post in enumerate(np.random.default_rng(3).uniform(-6, 6, (6, 2))):
        slam.add_landmark(i, post, 1e-4 * np.eye(2))
    rng, outcomes = np.random.default_rng(4), []
    for t in range(20):
        slam.process(km.Control(t, "r", [0.05, 0.0, 0.0], cov=1e-4 * np.eye(3)))
        y = km.geometry.observe(np.array([0.05 * t, 0, 0]), OTHERS)[0] + rng.normal(size=(3, 2)) * [0.1, 0.05]
        outcomes += [o.outcome for o in slam.process(km.Scan(t, "r", "s", y[[t % 3]])).observations]
    return slam, outcomes


def test_a_robot_that_is_lost_holds_back_what_it_sees_or_if_told_to_maps_anew() -> None:
    slam, outcomes = lost(hold_back=False)
    assert set(outcomes) == {"deferred"}
    assert len(slam.landmarks()) == 6

    slam, outcomes = lost(hold_back=True)
    assert len(slam.landmarks()) == 9
    assert outcomes[-6:] == ["associated"] * 6
    found = [np.array(slam.mean(name)) for name in slam.landmarks().ids[6:]]
    np.testing.assert_allclose(pairwise_m(np.array(found)), pairwise_m(OTHERS), atol=0.3)
