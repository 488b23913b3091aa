"""Landmarks started late, from intersections of past measurements that persist: with ids and without."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import ModelError
from kalmark.geometry import bhattacharyya, intersection, relative_frame, wrap
from kalmark.geometry.frames import compose
from kalmark.geometry.gaussian import gate
from kalmark.models.pointwise import jacobian

DEG = np.pi / 180
EYE = km.sensors.Bearing(1 * DEG, range_max_m=40.0)
NOISE = np.array([0.01, 0.01, 0.2 * DEG])
POINTS = np.array([(6.0, 3.0), (9.0, -4.0), (-3.0, 5.0), (12.0, 8.0), (2.0, 12.0), (-6.0, -4.0)])
AT = np.array([0.2, 0.1, 0.3])


def test_the_bhattacharyya_distance_is_that_of_the_overlap() -> None:
    """BC = integral of sqrt(p q) = exp(-distance), by sums on a fine grid."""
    a, b = np.array([0.2, -0.1]), np.array([1.0, 0.6])
    A, B = np.array([[0.5, 0.2], [0.2, 0.4]]), np.array([[1.0, -0.3], [-0.3, 0.7]])
    x = np.stack(np.meshgrid(np.arange(-8, 8, 0.02), np.arange(-8, 8, 0.02)), -1)

    def density(mean: np.ndarray, cov: np.ndarray) -> np.ndarray:
        d = x - mean
        e = np.einsum("...i,ij,...j->...", d, np.linalg.inv(cov), d)
        return np.asarray(np.exp(-e / 2) / (2 * np.pi * np.sqrt(np.linalg.det(cov))))

    overlap = np.sqrt(density(a, A) * density(b, B)).sum() * 0.02**2
    assert bhattacharyya(a, A, b, B) == pytest.approx(-np.log(overlap), abs=1e-9)
    assert bhattacharyya(a, A, a, A) == pytest.approx(0, abs=1e-15)


def test_rays_meet_where_they_were_drawn_to_with_the_jacobians_of_their_differences() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        p, a, b = rng.normal(size=2) * 10, rng.normal(size=3) * 3, rng.normal(size=3) * 3
        for ray in (a, b):
            ray[2] = np.arctan2(*(p - ray[:2])[::-1])
        if abs(np.sin(a[2] - b[2])) < 0.1:
            continue
        q, P_a, P_b = intersection(a, b)
        np.testing.assert_allclose(q, p, atol=1e-9)
        np.testing.assert_allclose(P_a, jacobian(lambda x: intersection(x, b)[0], a), rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(P_b, jacobian(lambda x: intersection(a, x)[0], b), rtol=1e-5, atol=1e-4)
        c, C_a, C_b = relative_frame(a, b)
        np.testing.assert_allclose(compose(a, c)[0][:2], b[:2], atol=1e-12)
        np.testing.assert_allclose(C_a, jacobian(lambda x: relative_frame(x, b)[0], a, (False, False, True)), atol=1e-5)
        np.testing.assert_allclose(C_b, jacobian(lambda x: relative_frame(a, x)[0], b, (False, False, True)), atol=1e-5)
    assert np.isnan(intersection((0.0, 0, 0), (0.0, 1, 0.5))[0]).all(), "they part ahead and meet behind"


# ---------------------------------------------------------------------- whole runs
def slam_of(map_: str = "auto", association: Any = None, start: Any = None, cov: Any = None, **policy: Any) -> km.Slam:
    mount = km.Mount(EYE, at=AT, initialization=km.Delayed(**policy))
    robot = km.Robot("r", km.motion.Odometry2D(*NOISE), start=start, cov=cov, sensors={"eye": mount})
    return km.Slam([robot], association, map=map_)


def drive(seed: int, steps: int = 60, ids: bool = True, points: np.ndarray = POINTS) -> tuple[list[Any], np.ndarray]:
    """Return the events of a robot on an arc that sees all points, and where it ends."""
    rng, pose, events = np.random.default_rng(seed), np.zeros(3), []
    for k in range(steps):
        u = np.array([0.25, 0.0, 0.03])
        pose = compose(pose, u)[0]
        events.append(km.Control(0.1 * k, "r", u + rng.normal(size=3) * NOISE))
        v = km.geometry.to_frame(compose(pose, AT)[0], points)[0]
        y = wrap(np.arctan2(v[:, 1], v[:, 0]) + rng.normal(size=len(v)) * 1 * DEG)
        order = rng.permutation(len(v))
        events.append(km.Scan(0.1 * k, "r", "eye", y[order, None], (order + 1).tolist() if ids else None))
    return events, pose


def run(events: list[Any], slam: km.Slam) -> list[km.Report]:
    return [slam.process(event) for event in events]


def nees(slam: km.Slam, names: Any, truth: np.ndarray) -> float:
    e = truth - np.concatenate([slam.mean(name) for name in names])
    return float(e @ np.linalg.solve(slam.covariance(*names), e))


def test_known_ids_become_landmarks_that_are_consistent_with_each_other() -> None:
    total = count = 0.0
    for seed in range(15):
        slam = slam_of()
        run(drive(seed)[0], slam)
        names = slam.landmarks().ids
        assert len(names) >= 5, "of six; one may be behind the robot all the way"
        assert set(slam.landmarks().kinds) == {"point"}
        total += nees(slam, names, POINTS[np.array(names) - 1].ravel())  # type: ignore[operator]
        count += 2 * len(names)
    assert 0.7 < total / count < 1.35


def test_landmarks_are_right_at_the_moment_they_enter_the_map() -> None:
    """Jointly with the robot: 40 starts, NEES of 5 each."""
    inside, count, seed = 0, 0, 100
    while count < 40:
        slam, (events, _) = slam_of(), drive(seed, points=POINTS[seed % 6 : seed % 6 + 1])
        seed, pose = seed + 1, np.zeros(3)
        for event in events:
            if isinstance(event, km.Control):
                pose = compose(pose, np.array([0.25, 0.0, 0.03]))[0]
            report = slam.process(event)
            if any(seen.outcome == "new" for seen in report.observations):
                (name,) = slam.landmarks().ids
                inside += nees(slam, ("r", name), np.append(pose, POINTS[(seed - 1) % 6])) < gate(0.99, 5)
                count += 1
                break
    assert inside >= 37


def test_without_ids_the_right_landmarks_are_found_and_no_others() -> None:
    inside = found = started = 0
    for seed in range(6):
        slam = slam_of(association=km.association.NearestNeighbour())
        run(drive(seed, ids=False)[0], slam)
        table = slam.landmarks()
        which = [int(np.argmin(np.linalg.norm(POINTS - mean, axis=1))) for mean in table.means]
        assert len(set(which)) == len(which), "one landmark each"
        inside += sum(nees(slam, [name], POINTS[i]) < gate(0.999, 2) for name, i in zip(table.ids, which, strict=True))
        started, found = started + len(which), found + len(set(which))
    assert found >= 32, "of 36"
    assert inside >= started - 1


def test_every_outcome_says_what_is_waited_for() -> None:
    slam, (events, _) = slam_of(), drive(0, points=POINTS[:1])
    seen = [report.observations[0] for report in run(events, slam) if report.observations]
    assert seen[0] == km.Observation(0, 1, "deferred", None, None, "0 of 4 intersections agree")
    assert seen[1].reason == "until the robot has moved on"
    (new,) = [o for o in seen if o.outcome == "new"]
    assert (new.landmark, new.reason[2:]) == (1, "intersections agree")
    assert {o.outcome for o in seen[seen.index(new) + 1 :]} == {"associated"}


def test_nothing_is_left_behind_once_all_are_landmarks() -> None:
    slam, (events, _) = slam_of(), drive(1, points=POINTS[:1])
    run(events, slam)
    (candidates,) = slam.tracks.candidates.values()
    assert not candidates
    assert len(slam.clones.clones) <= 1
    assert sum(space is not None for space in slam.map.spaces) == 2 + len(slam.clones.clones)


def test_turning_the_world_turns_the_estimate() -> None:
    start, turn, cov = np.array([3.0, -2.0, 0.5]), 1.1, np.diag([0.1, 0.1, 0.2]) ** 2
    events, _ = drive(3, 40)
    space = slam_of().robots["r"].motion.space
    here, there = slam_of(start=start, cov=cov), slam_of(start=space.rotated(start, turn), cov=cov)
    for slam in (here, there):
        run(events, slam)
    assert here.landmarks().ids == there.landmarks().ids
    for name in here.landmarks().ids:
        np.testing.assert_allclose(km.geometry.rotation(turn) @ here.mean(name), there.mean(name), atol=1e-7)


@pytest.mark.parametrize("ids", [True, False])
def test_the_postponed_map_equals_the_dense_one(ids: bool) -> None:
    events, _ = drive(5, 40, ids)
    association = None if ids else km.association.NearestNeighbour()
    dense, postponed = slam_of("dense", association), slam_of("postponed", association)
    for slam in (dense, postponed):
        run(events, slam)
    names = ("r", *dense.landmarks().ids)
    assert names[1:] == tuple(postponed.landmarks().ids)
    assert len(names) > 3
    for name in names:
        np.testing.assert_allclose(postponed.mean(name), dense.mean(name), atol=1e-7)
    np.testing.assert_allclose(postponed.covariance(*names), dense.covariance(*names), atol=1e-8)


@pytest.mark.parametrize("estimator", [km.estimators.Invariant(), km.estimators.Ekf(), km.estimators.Fej()], ids=repr)
def test_a_map_saved_in_the_middle_resumes_bit_for_bit(estimator: Any, tmp_path: Path) -> None:
    events, _ = drive(6, 40, ids=False)
    straight = km.Slam(slam_of().robots.values(), km.association.NearestNeighbour(), estimator)
    run(events[:41], straight)
    (candidates,) = straight.tracks.candidates.values()
    assert len(candidates) > 5
    straight.save(tmp_path / "map.kmk")
    resumed = km.Slam.load(tmp_path / "map.kmk")
    for slam in (straight, resumed):
        run(events[41:], slam)
    names = ("r", *straight.landmarks().ids)
    assert names[1:] == tuple(resumed.landmarks().ids)
    assert [straight.mean(n).tobytes() for n in names] == [resumed.mean(n).tobytes() for n in names]
    assert straight.covariance(*names).tobytes() == resumed.covariance(*names).tobytes()


def test_what_cannot_start_late_is_refused() -> None:
    for sensor, landmark in ((km.sensors.RangeBearing(), None), (EYE, km.landmarks.InverseDepth2D())):
        mount = km.Mount(sensor, landmark=landmark, initialization=km.Delayed())
        robot = km.Robot("r", km.motion.Odometry2D(), sensors={"s": mount})
        with pytest.raises(ModelError, match=r"does not start a .* late"):
            km.Slam([robot])
    for bad in ({"persistence": 0}, {"distance": -1.0}, {"spacing_m": np.inf}, {"poses": 2}):
        with pytest.raises(ModelError, match=f"Delayed: {next(iter(bad))} is"):
            km.Delayed(**bad)  # type: ignore[arg-type]
