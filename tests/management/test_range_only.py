"""Landmarks from ranges alone: by trilateration and by hypotheses; honest, the same turned, postponed and resumed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import MapError, ModelError
from kalmark.geometry import V_inverse
from kalmark.management.hypotheses import to_point

AT = np.array([0.2, 0.1, 0.3])
NOISE = np.array([0.01, 0.003, 0.005])
WAYS = [km.initialization.Trilateration(), km.initialization.Hypotheses()]
way = pytest.mark.parametrize("way", WAYS, ids=lambda w: type(w).__name__)


def robot(way: Any, start: Any = (0, 0, 0), cov: Any = None, **sensor: float) -> km.Robot:
    motion = km.motion.Odometry2D(*NOISE)
    radio = km.Mount(km.sensors.Range(sigma_range_m=0.1, **sensor), at=AT, initialization=way)
    return km.Robot("r", motion, start=start, cov=cov, sensors={"radio": radio})


def world(
    seed: int, steps: int = 40, turn: float = 0.06, count: int = 1, low: float = 5.0, high: float = 20.0,
    scale: float = 1.0,
) -> tuple[list[Any], np.ndarray, np.ndarray]:  # fmt: skip
    """Return the events of a robot that drives an arc, its true last pose, and the beacons."""
    rng = np.random.default_rng(seed)
    away, around = rng.uniform(low, high, count), rng.uniform(-np.pi, np.pi, count)
    beacons = np.column_stack([away * np.cos(around), away * np.sin(around)])
    r, u, events = np.zeros(3), np.array([0.5, 0.0, turn]), []
    for t in range(steps):
        events.append(km.Control(t_s=float(t), robot="r", u=u + rng.normal(size=3) * NOISE))
        r, _, _ = km.motion.Odometry2D().move(r, u, 1.0)
        T, _, _ = km.geometry.compose(r, AT)
        y = np.abs(scale * np.hypot(*(beacons - T[:2]).T) + 0.1 * rng.normal(size=count))
        events.append(km.Scan(t_s=float(t), robot="r", sensor="radio", y=y[:, None], ids=list(range(count))))
    return events, r, beacons


def played(slam: km.Slam, events: list[Any]) -> Iterator[Any]:
    for event in events:
        yield from slam.process(event).observations


def d2(slam: km.Slam, truth: np.ndarray, name: int, beacon: np.ndarray) -> float:
    """Return the squared error of a beacon in the coordinates of the invariant filter."""
    d = V_inverse(truth[2] - slam.mean("r")[2]) @ (beacon - slam.mean(name))
    return float(d @ np.linalg.solve(slam.covariance(name), d))


@way
def test_a_beacon_is_started_honestly_over_sixty_trials(way: Any) -> None:
    found = []
    for seed in range(60):
        events, r, beacons = world(seed)
        slam = km.Slam([robot(way)])
        outcomes = [o.outcome for o in played(slam, events)]
        if "new" in outcomes:
            assert set(outcomes[: outcomes.index("new")]) <= {"deferred", "tentative"}
            found.append(d2(slam, r, 0, beacons[0]))
    assert len(found) >= 54
    assert np.mean(np.array(found) < 9.21) >= 0.96  # 99 % of a consistent filter's
    assert 1.4 < np.mean(found) < 2.8  # 2


def test_four_beacons_and_the_scale_of_their_ranges_are_found_together() -> None:
    errors, sure = [], []
    for seed in range(6):
        rng = np.random.default_rng(100 + seed)
        scale = 1 + 0.07 * rng.normal()
        events, r, beacons = world(seed, steps=80, count=4, low=10.0, high=30.0, scale=scale)
        slam = km.Slam([robot(WAYS[0], sigma_scale=0.07)])
        list(played(slam, events))
        gain, sigma = slam.mean("r.radio")[3], np.sqrt(slam.covariance("r.radio")[3, 3])
        errors.append((gain - 1 / scale) / sigma)
        sure += [d2(slam, r, i, beacons[i]) < 9.21 for i in slam.landmarks().ids]
    assert len(sure) >= 20
    assert np.mean(sure) > 0.9
    assert np.sqrt(np.mean(np.square(errors))) < 1.7


def test_on_a_straight_line_the_mirror_image_fits_as_well_and_trilateration_waits() -> None:
    events, _, _ = world(3, turn=0.0)
    slam = km.Slam([robot(WAYS[0])])
    told = list(played(slam, events))
    assert {o.outcome for o in told} == {"deferred"}
    assert any("fit two positions" in o.reason for o in told)
    assert len(slam.tracks.pending[0].pending.measurements) <= 24  # type: ignore[union-attr]


@way
def test_a_beacon_that_waits_does_not_pull_the_pose(way: Any) -> None:
    events, _, _ = world(1, steps=4)
    seeing, blind = km.Slam([robot(way)]), km.Slam([robot(way)])
    list(played(seeing, events))
    list(played(blind, [e for e in events if isinstance(e, km.Control)]))
    assert not seeing.landmarks().ids
    np.testing.assert_array_equal(seeing.mean("r"), blind.mean("r"))
    np.testing.assert_allclose(seeing.covariance("r"), blind.covariance("r"), rtol=1e-12)


@way
@pytest.mark.parametrize("estimator", [km.estimators.Invariant(), km.estimators.Ekf()], ids=lambda e: type(e).__name__)
def test_turning_the_world_turns_the_beacons(way: Any, estimator: Any) -> None:
    events, _, _ = world(5, count=2)
    phi = 2.1
    E = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
    cov = np.diag([0.04, 0.04, 0.01])
    turned = np.block([[E @ cov[:2, :2] @ E.T, np.zeros((2, 1))], [np.zeros((1, 2)), cov[2:, 2:]]])
    one = km.Slam([robot(way, cov=cov)], estimator=estimator)
    other = km.Slam([robot(way, start=(*(E @ [0.0, 0.0]), phi), cov=turned)], estimator=estimator)
    for slam in (one, other):
        list(played(slam, events))
    assert one.landmarks().ids == other.landmarks().ids != []
    for name in one.landmarks().ids:
        np.testing.assert_allclose(other.mean(name), E @ one.mean(name), atol=1e-6)
        np.testing.assert_allclose(other.covariance(name), E @ one.covariance(name) @ E.T, rtol=1e-5, atol=1e-6)


@way
def test_the_postponed_map_starts_the_same_beacons_as_the_dense_one(way: Any) -> None:
    events, _, _ = world(7, count=3)
    slams = [km.Slam([robot(way)], map=map) for map in ("dense", "postponed")]
    outcomes = [[o[1:4] for o in played(slam, events)] for slam in slams]
    assert outcomes[0] == outcomes[1]
    assert slams[0].landmarks().ids
    names = ["r", *slams[0].landmarks().ids]
    np.testing.assert_allclose(slams[1].mean("r"), slams[0].mean("r"), atol=1e-8)
    np.testing.assert_allclose(slams[1].covariance(*names), slams[0].covariance(*names), atol=1e-8)


@way
@pytest.mark.parametrize("map", ["dense", "postponed"])
def test_a_map_saved_while_beacons_wait_resumes_bit_for_bit(way: Any, map: str, tmp_path: Path) -> None:
    events, _, _ = world(9, count=3)
    slam = km.Slam([robot(way, sigma_scale=0.05)], map=map)
    list(played(slam, events[:9]))
    assert slam.tracks.pending
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    assert list(played(again, events[9:])) == list(played(slam, events[9:]))
    names = ["r", "r.radio", *slam.landmarks().ids]
    assert len(names) > 2
    np.testing.assert_array_equal(again.covariance(*names), slam.covariance(*names))


def test_a_range_that_does_not_fit_the_others_is_left_out() -> None:
    events, r, beacons = world(2)
    bad = events[9]
    events[9] = km.Scan(t_s=bad.t_s, robot="r", sensor="radio", y=bad.y + 5.0, ids=[0])
    slam = km.Slam([robot(WAYS[0])])
    told = list(played(slam, events))
    assert any("does not fit the others" in o.reason for o in told)
    assert d2(slam, r, 0, beacons[0]) < 9.21


def test_a_polar_hypothesis_has_the_jacobian_of_differences() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        l = rng.normal(size=4) * [5, 5, 2, 4]
        p, P_l = to_point(l)
        np.testing.assert_allclose(p, l[:2] + l[3] * np.array([np.cos(l[2]), np.sin(l[2])]))
        for j in range(4):
            step = np.eye(4)[j] * 1e-6
            numeric = (to_point(l + step)[0] - to_point(l - step)[0]) / 2e-6
            np.testing.assert_allclose(P_l[:, j], numeric, atol=1e-7)


def test_ranges_without_an_id_start_nothing_and_other_sensors_take_no_initialization() -> None:
    slam = km.Slam([robot(None)], association=km.association.NearestNeighbour())
    (seen,) = slam.process(km.Scan(t_s=0.0, robot="r", sensor="radio", y=[[3.0]])).observations
    assert (seen.outcome, "without an id" in seen.reason) == ("ignored", True)
    mount = km.Mount(km.sensors.RangeBearing(), initialization=WAYS[1])
    with pytest.raises(ModelError, match="does not measure ranges alone"):
        km.Slam([km.Robot("r", km.motion.Odometry2D(), sensors={"s": mount})])
    with pytest.raises(ModelError, match="poses is 2"):
        km.initialization.Trilateration(poses=2)
    with pytest.raises(ModelError, match=r"odds is 1\.5"):
        km.initialization.Hypotheses(odds=1.5)


def test_ranges_whose_noise_grows_with_them_do_not_draw_beacons_near() -> None:
    """Too long and too short by the same share, in turn: weighed by the noise of what was measured, short ones win."""
    beacon = np.array([25.0, 15.0])
    sensor = km.Mount(km.sensors.Range(sigma_range_m=0.0, sigma_range_rel=0.1))
    slam = km.Slam([km.Robot("r", km.motion.Odometry2D(0, 0, 0), sensors={"radio": sensor})])
    pose, u = np.zeros(3), np.array([4.0, 0.0, 4 / 15])
    for t in range(20):
        pose, _, _ = km.motion.Odometry2D().move(pose, u, 1.0)
        slam.process(km.Control(t_s=float(t), robot="r", u=u))
        y = np.hypot(*(beacon - pose[:2])) * (1.1 if t % 2 else 0.9)
        report = slam.process(km.Scan(t_s=float(t), robot="r", sensor="radio", y=[[y]], ids=[0]))
        if report.observations[0].outcome == "new":
            break
    assert np.linalg.norm(slam.mean(0) - beacon) < 0.2  # otherwise 0.5


def test_the_valley_that_an_unknown_scale_bends_is_no_gaussian_and_waits() -> None:
    """From a circle a beacon inside and its inverse point outside look alike but for the scale."""
    rng, beacon, count = np.random.default_rng(0), np.array([0.0, 27.0]), 8
    sensor = km.Mount(km.sensors.Range(sigma_range_m=0.0, sigma_range_rel=0.1, sigma_scale=0.144))
    slam = km.Slam([km.Robot("r", km.motion.Odometry2D(0, 0, 0), sensors={"radio": sensor})])
    pose, u = np.zeros(3), np.array([1.0, 0.0, 1 / 15])
    for t in range(60):  # round the circle of 15 m about (0, 15), ranges 10 % long
        pose, _, _ = km.motion.Odometry2D().move(pose, u, 1.0)
        slam.process(km.Control(t_s=float(t), robot="r", u=u))
        if t % 3 == 0:
            y = 1.1 * np.hypot(*(beacon - pose[:2])) * (1 + 0.1 * rng.normal(size=count))
            scan = km.Scan(t_s=float(t), robot="r", sensor="radio", y=y[:, None], ids=range(count))
            outcomes = [o.outcome for o in slam.process(scan).observations]
    assert outcomes == ["deferred"] * count
    assert len(slam.landmarks()) == 0


@way
def test_in_a_full_map_ranges_are_ignored_with_the_reason_until_there_is_room(way: Any, tmp_path: Path) -> None:
    events, _, _ = world(7, count=3)
    slam = km.Slam([robot(way)], map="postponed")
    storage = slam.map.storage  # type: ignore[union-attr]
    limit, storage.limit_bytes = storage.limit_bytes, storage.nbytes
    placed: list[int] = []
    while len(placed) < 70:
        try:
            slam.add_landmark(1000 + len(placed), [1000.0 + len(placed), 0.0], np.zeros((2, 2)))
        except MapError:
            break
        placed.append(1000 + len(placed))
    assert len(placed) < 70
    told = list(played(slam, events[:20]))
    assert {o.outcome for o in told} <= {"ignored", "deferred", "tentative"}
    assert any("the map is full" in o.reason for o in told)
    for name in placed:
        slam.remove(name)
    storage.limit_bytes = limit  # only blocks of the same shape take the place of those removed
    list(played(slam, events[20:]))
    assert slam.landmarks().ids
    slam.save(tmp_path / "map.kmk")
    assert km.Slam.load(tmp_path / "map.kmk").landmarks().ids == slam.landmarks().ids


def strengths_heard(seed: int, near: tuple[float, float], steps: int) -> tuple[km.Slam, dict[int, np.ndarray]]:
    """Return the map of a robot on a circle of 10 m that hears a sender at a distance from it, and where that is."""
    rng = np.random.default_rng(seed)
    radio = km.sensors.SignalStrength2D(1.0, sigma_strength_db=3.0)
    true = km.sensors.SignalStrength2D(strength_dbm=rng.normal(-40, 3))
    mount = km.Mount(radio, initialization=km.initialization.Trilateration())
    slam = km.Slam(km.Robot("r", km.motion.Odometry2D(*NOISE), sensors={"radio": mount}))
    around, side = rng.uniform(-np.pi, np.pi), rng.choice([-1, 1])
    sender = np.array([0.0, 10.0]) + (10 + side * rng.uniform(*near)) * np.array([np.cos(around), np.sin(around)])
    x, u = np.zeros(3), np.array([0.5, 0.0, 0.05])
    for k in range(1, steps):
        x = km.motion.Odometry2D().move(x, u + rng.normal(size=3) * NOISE, 1.0)[0]
        slam.process(km.Control(float(k), "r", u))
        y = true.expect((sender - x[:2])[None])[0] + rng.normal(0, 1, (1, 1))
        slam.process(km.Scan(float(k), "r", "radio", y, [1]))
    return slam, {1: sender}


def test_strengths_of_a_sender_that_was_passed_closely_start_it_honestly() -> None:
    squares = []
    for seed in (5, 13, 20, 21):
        slam, senders = strengths_heard(seed, (0.2, 0.8), 250)
        d = slam.mean(1) - senders[1]
        squares.append(d @ np.linalg.solve(slam.covariance(1), d))
    assert max(squares) < 9.21


def test_strengths_that_fit_on_either_side_of_the_path_start_nothing() -> None:
    """From a circle around the first place, where the sender is far, only the wrong side was found: 240 in sigmas^2."""
    slam, _ = strengths_heard(53, (0.8, 2.5), 150)
    assert 1 not in slam.landmarks().ids


def test_strengths_take_no_hypotheses() -> None:
    mount = km.Mount(km.sensors.SignalStrength2D(), initialization=WAYS[1])
    with pytest.raises(ModelError, match="SignalStrength2D does not measure ranges alone"):
        km.Slam([km.Robot("r", km.motion.Odometry2D(), sensors={"radio": mount})])
