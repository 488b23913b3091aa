"""The compressed map: equal to the dense one, or to a dense filter that leaves the same blocks alone."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import MapError
from kalmark.filter import kernels
from kalmark.filter.compressed import compressed_map, ranks
from kalmark.filter.compressed.compressed_map import CompressedMap
from kalmark.filter.compressed.schedule import Schedule
from kalmark.filter.compressed.storage import PANEL, Triangle
from kalmark.filter.map import StochasticMap

J = np.array([[0.0, -1.0], [1.0, 0.0]])
Q, R = np.diag([0.01, 0.0, 0.02]) ** 2, np.diag([0.1, 0.02]) ** 2
START = (6.0, 0.0, np.pi / 2)
WORLD = np.random.default_rng(0).uniform(-10, 10, (120, 2))


def slam_of(estimator: Any, most: int | None = None, cov: Any = None, names: str = "r") -> km.Slam:
    """Return a Slam of robots that see range and bearing, its map compressed where `most` says how large it may get."""
    lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    motion = km.motion.Odometry2D(0.01, 0.0, 0.02)
    robots = [km.Robot(name, motion, START, {"lidar": lidar}, cov) for name in names]
    slam = km.Slam(robots, km.association.ByIdentity("off"), estimator, map="dense")
    if most is not None:
        slam.state.map = CompressedMap.from_dense(slam.map, most=most)
    return slam


def drive(steps: int, seed: int, reach: float = 4.0, names: str = "r") -> list[Any]:
    """Return the events of robots that go round among WORLD and see what is near."""
    rng, events = np.random.default_rng(seed), []
    truths = {name: np.array(START) for name in names}
    for t in range(1, steps + 1):
        for i, name in enumerate(names):
            u = np.array([0.3, 0.0, 0.05 - 0.1 * i])
            truths[name] = truth = km.geometry.compose(truths[name], u)[0]
            events.append(km.Control(t, name, u + rng.normal(size=3) * [0.01, 0, 0.02]))
            near = np.flatnonzero(np.hypot(*(WORLD - truth[:2]).T) < reach)[:8]
            y = km.geometry.observe(truth, WORLD[near])[0] + rng.normal(size=(len(near), 2)) * [0.1, 0.02]
            events.append(km.Scan(t, name, "lidar", np.column_stack([np.abs(y[:, 0]), y[:, 1]]), near.tolist()))
    return events


def differences(a: km.Slam, b: km.Slam) -> tuple[float, float]:
    """Return the largest difference of two maps' means, and of their covariances in units of the sigmas."""
    names = [*a.robots, *a.landmarks().ids]
    x = max(float(np.abs(a.mean(i) - b.mean(i)).max()) for i in names)
    P = a.covariance(*names)
    sigma = np.sqrt(np.diag(P))
    return x, float((np.abs(P - b.covariance(*names)) / np.outer(sigma, sigma)).max())


EKF, FEJ = km.estimators.Ekf(), km.estimators.Fej()


@pytest.mark.parametrize(
    ("estimator", "names", "steps"),
    [(EKF, "r", 220), (FEJ, "r", 220), (EKF, "rs", 110), (FEJ, "rs", 110), (EKF, "r", 3000)],
)
def test_a_compressed_map_equals_the_dense_one_to_1e_8(estimator: Any, names: str, steps: int) -> None:
    dense, compressed = slam_of(estimator, names=names), slam_of(estimator, most=60, names=names)
    updates = counted(compressed.map)
    for event in drive(steps, 1, names=names):
        for slam in (dense, compressed):
            slam.process(event)
    x, P = differences(dense, compressed)
    assert x < 1e-8
    assert P < 1e-8
    assert updates.count("full update") > 8
    assert len(compressed.map.entered) < len(dense.landmarks().ids)


def test_what_a_full_update_leaves_out_far_from_the_robot_is_below_rounding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ranks, "FEWEST", 0)
    slam, rng, truth = slam_of(EKF, most=150), np.random.default_rng(6), np.zeros(3)
    corridor = rng.uniform([0, -3], [300, 3], (500, 2))
    for t in range(520):  # to the end of the corridor and back
        u = np.array([0.75, 0.0, np.pi if t == 400 else 0.0])
        truth = km.geometry.compose(truth, u)[0]
        near = np.flatnonzero(np.hypot(*(corridor - truth[:2]).T) < 3)
        y = km.geometry.observe(truth, corridor[near])[0] + rng.normal(size=(len(near), 2)) * [0.1, 0.02]
        slam.process(km.Control(t, "r", u))
        slam.process(km.Scan(t, "r", "lidar", np.column_stack([np.abs(y[:, 0]), y[:, 1]]), near.tolist()))
    slam.save(tmp_path / "map.kmk")
    covariances, shares = [], []
    for exact in (ranks.EXACT, -1.0):  # with this nothing is left out
        monkeypatch.setattr(ranks, "EXACT", exact)
        m: Any = km.Slam.load(tmp_path / "map.kmk").map
        m.full_update()
        job = m._job
        m.finish()
        covariances.append(m.covariance(range(m.used)))
        shares.append(job.workspace.share)
    sigma = np.sqrt(np.diag(covariances[1]))
    difference = np.abs(covariances[0] - covariances[1]) / np.outer(sigma, sigma)
    assert difference.max() < 1e-12
    assert shares[0] < 0.5
    assert shares[1] == 1.0


def test_blocks_that_enter_together_are_what_they_are_one_after_the_other() -> None:
    slam = slam_of(km.estimators.Invariant(), most=1000)
    for t, event in enumerate(drive(300, 2)):
        slam.process(event)
        if t == 280:
            slam.map.full_update()
    together, alone = slam.map, deepcopy(slam.map)
    slots = [i for i, space in enumerate(together.spaces) if space is not None]
    new = [i for i in slots if i not in together.entered]
    assert len(new) > 4
    assert together.displaced
    together._enter(new)
    for i in new:
        alone._enter([i])
    found = []
    for m in (together, alone):
        rows = [m.active.rows(at[i]) for at in (m.entered, m.auxiliary) for i in slots]
        found.append((m.means(np.array(slots), 2), kernels.submatrix(m.active.P, np.concatenate(rows))))
    scale = np.sqrt(np.abs(np.diag(found[1][1]))) + 1.0
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[0][1] / np.outer(scale, scale), found[1][1] / np.outer(scale, scale), atol=1e-12)


def counted(map_: Any) -> list[str]:
    """Return the list to which a map writes its full updates, corrections, starts, and the slots that enter."""
    done: list[Any] = []
    update, correct_all, enter = map_.full_update, map_.correct_all, map_._enter
    correct, augment = map_.finish_correction, map_.augment

    def updated() -> None:
        done.append("full update")
        update()

    def corrected_all(*args: Any) -> None:
        done.append("correct all")
        correct_all(*args)

    def entered(slots: Iterable[int]) -> None:
        done.extend(slot for slot in slots if slot not in map_.entered)
        enter(slots)

    def corrected(*args: Any) -> None:
        done.append("correct")
        correct(*args)

    def started(*args: Any) -> int:
        done.append("start")
        return augment(*args)

    map_.full_update, map_.correct_all = updated, corrected_all
    map_._enter, map_.finish_correction, map_.augment = entered, corrected, started
    return done


class Frozen:
    """The invariant filter, dense, but for this: the correction is only added to an inactive landmark.

    It keeps the error coordinates that it had when it became inactive, until it is active again or corrected at once.
    """

    def __init__(self, P: np.ndarray) -> None:
        self.x, self.P, self.number = np.array(START), P, {}  # type: ignore[var-annotated]
        self.inactive: dict[int, np.ndarray] = {}  # where landmarks are frozen

    def rows(self, i: int) -> slice:
        return slice(3 + 2 * self.number[i], 5 + 2 * self.number[i])

    def activate(self, i: int) -> None:
        """Turn the coordinates of a landmark's error to where it is now."""
        A = np.eye(len(self.x))
        A[self.rows(i), 2] = J @ (self.x[self.rows(i)] - self.inactive.pop(i))
        self.P = A @ self.P @ A.T

    def refreeze(self, ids: Iterable[int]) -> None:
        for i in [*self.inactive]:
            self.activate(i)
        self.inactive = {i: self.x[self.rows(i)].copy() for i in ids}

    def generator(self, x: np.ndarray) -> np.ndarray:
        g = np.zeros(len(x))
        g[:2], g[2] = J @ x[:2], 1.0
        for i in self.number:
            if i not in self.inactive:
                g[self.rows(i)] = J @ x[self.rows(i)]
        return g

    def moved(self, d: np.ndarray, immediate: bool = False) -> np.ndarray:
        """Return x corrected by d; an immediate full correction turns inactive landmarks as well."""
        x, V = self.x + d, km.geometry.V(d[2])
        x[:2], x[2] = self.x[:2] + V @ d[:2], km.geometry.wrap(x[2])
        for i in self.number:
            l = self.x[self.rows(i)]
            if i not in self.inactive:
                x[self.rows(i)] = l + V @ d[self.rows(i)]
            elif immediate:
                x[self.rows(i)] = l + V @ (d[self.rows(i)] + J @ (l - self.inactive[i]) * d[2])
        return x

    def predict(self, u: np.ndarray) -> None:
        F = np.eye(len(self.x))
        r, F[:3, :3], F_u = km.geometry.compose(self.x[:3], u)
        self.P = F @ self.P @ F.T
        self.P[:3, :3] += F_u @ Q @ F_u.T
        self.x[:3] = r

    def correct(self, y: np.ndarray, ids: list[int], immediate: bool) -> None:
        d, k = np.zeros(len(self.x)), len(ids)
        seen = np.concatenate([np.arange(3), *(np.arange(s.start, s.stop) for s in map(self.rows, ids))])
        for _ in range(30):
            x, H, z = self.moved(d), np.zeros((2 * k, len(d))), np.zeros(2 * k)
            for row, i in enumerate(ids):
                e, E_r, E_l = km.geometry.observe(x[:3], x[self.rows(i)])
                at = slice(2 * row, 2 * row + 2)
                H[at, :3], H[at, self.rows(i)], z[at] = E_r, E_l, y[row] - e
                z[2 * row + 1] = km.geometry.wrap(z[2 * row + 1])
            H[:, 2] += H @ (self.generator(x) - self.generator(self.x))
            v, before = z + H @ d, d
            K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + np.kron(np.eye(k), R))
            d = K @ v
            if np.abs(d - before)[seen].max() < 1e-11:
                break
        x = self.moved(d, immediate)
        A = np.eye(len(x))
        A[:, 2] += self.generator(x) - self.generator(self.x)
        self.x, self.P = x, A @ (self.P - K @ H @ self.P) @ A.T

    def initialize(self, i: int, y: np.ndarray) -> None:
        n = len(self.x)
        l, L_r, L_y = km.geometry.inv_observe(self.x[:3], y)
        G = np.vstack([np.eye(n), np.hstack([L_r, np.zeros((2, n - 3))])])
        self.P = G @ self.P @ G.T
        self.P[n:, n:] += L_y @ R @ L_y.T
        self.x, self.number[i] = np.concatenate([self.x, l]), len(self.number)


@pytest.mark.parametrize(("noise", "steps", "slowly"), [(1.0, 1000, False), (4.0, 220, False), (4.0, 800, True)])
def test_the_invariant_form_equals_a_dense_filter_that_freezes_the_same_landmarks(
    noise: float, steps: int, slowly: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if slowly:  # a full update is still under way when the next large correction comes
        monkeypatch.setattr(Schedule, "due", lambda *_: 1.0)
        monkeypatch.setattr(compressed_map, "SLICE", 1.0)
    cov = np.diag([0.1, 0.1, 0.05 * noise]) ** 2
    slam = slam_of(km.estimators.Invariant(tolerance=1e-12), most=60, cov=cov)
    done, book = counted(slam.map), Frozen(cov)
    events, at_once, waiting = drive(steps, 2), 0, 0
    for t, event in enumerate(events):
        if noise > 1 and isinstance(event, km.Scan) and t % 80 < 60:
            continue  # drifting unseen, then a large correction
        done.clear()
        slam.process(event)
        if isinstance(event, km.Control):
            book.predict(event.u)
            continue
        assert event.ids is not None
        slots = {slam.slot(i): i for i in book.number}
        known = [k for k, i in enumerate(event.ids) if i in book.number]
        new = [k for k in range(len(event.ids)) if k not in known]
        for what, after in zip(done, [*done[1:], ""], strict=True):
            if what == "correct":
                at_once += after == "correct all"
                book.correct(event.y[known], [event.ids[k] for k in known], after == "correct all")
            elif what == "full update":
                book.refreeze(book.number)
            elif what == "correct all":
                book.refreeze([*book.inactive])
                waiting += after != "full update"
            elif what == "start":
                book.initialize(event.ids[new[0]], event.y[new.pop(0)])
            elif slots.get(what) in book.inactive:
                book.activate(slots[what])
    order = ["r", *book.number]
    mean = np.concatenate([slam.mean(i) for i in order])
    for i in [*book.inactive]:
        book.activate(i)
    P, sigma = slam.covariance(*order), np.sqrt(np.diag(book.P))
    # what the variances keep for rounding (`kernels.KEPT`, `RAISED`), the book does not; a correction of 3 m down to
    # .05 m within one full update leaves that much rounding, whatever the linear algebra
    np.testing.assert_allclose(mean, book.x, rtol=0, atol=2e-7 if slowly else 5e-8)
    np.testing.assert_allclose(P / np.outer(sigma, sigma), book.P / np.outer(sigma, sigma), rtol=0, atol=5e-8)
    assert at_once > len([what for what in done if what == "full update"])
    assert waiting > 0 or not slowly


def test_a_robot_that_stands_still_learns_nothing_of_its_heading_in_a_compressed_map() -> None:
    prior = np.radians(20)
    slam = slam_of(km.estimators.Invariant(tolerance=1e-9), most=12, cov=np.diag([0.5, 0.5, prior]) ** 2)
    assert isinstance(slam.map, CompressedMap | StochasticMap)
    rng, near = np.random.default_rng(3), np.argsort(np.hypot(*(WORLD - START[:2]).T))[:12]
    for t in range(200):
        ids = rng.choice(near, 4, replace=False)
        y = km.geometry.observe(np.array(START), WORLD[ids])[0] + rng.normal(size=(4, 2)) * [0.1, 0.02]
        slam.process(km.Scan(t, "r", "lidar", np.column_stack([np.abs(y[:, 0]), y[:, 1]]), ids.tolist()))
    assert np.degrees(np.sqrt(slam.covariance("r")[2, 2])) == pytest.approx(20, abs=1e-6)


def without(event: Any, left_out: set[Any]) -> Any:
    """Return an event without the observations of some landmarks."""
    if isinstance(event, km.Control):
        return event
    kept = [k for k, i in enumerate(event.ids) if i not in left_out]
    return km.Scan(event.t_s, event.robot, event.sensor, event.y[kept], [event.ids[k] for k in kept])


def test_a_landmark_that_does_not_fit_is_ignored_with_a_reason_and_all_else_goes_on() -> None:
    slams = [slam_of(km.estimators.Ekf(), most=60, names="rs") for _ in range(2)]
    slams[0].map.storage.limit_bytes = PANEL * PANEL * 8  # type: ignore[union-attr]
    reasons = set()
    for event in drive(220, 4, names="rs"):
        full = slams[0].process(event)
        reasons |= {seen.reason for seen in full.observations if seen.outcome == "ignored"}
        left_out = {seen.id for seen in full.observations if seen.outcome == "ignored"}
        slams[1].process(without(event, left_out))
    assert len(slams[0].landmarks().ids) == (PANEL - 6) // 2
    assert [r.startswith("the map is full: 128 rows take") for r in reasons] == [True]
    assert max(differences(*slams)) < 1e-9
    with pytest.raises(km.KalmarkError, match="the map is full"):
        slams[0].add_landmark("surveyed", (1.0, 2.0), np.zeros((2, 2)))


def test_in_a_map_too_full_for_the_error_of_a_control_the_robot_drives_on(monkeypatch: pytest.MonkeyPatch) -> None:
    lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    slam = km.Slam([km.Robot("r", km.motion.Unicycle(0.05, 0.02), sensors={"l": lidar})], map="postponed")

    def full(*_: Any) -> None:
        raise MapError("the map is full")

    for t in range(10):
        slam.process(km.Control(t, "r", (1.0, 0.0)))
        monkeypatch.setattr(slam.map, "add", full)
        slam.process(km.Scan(t + 0.5, "r", "l", [], []))  # within the control's interval: both parts had one error
    assert slam.mean("r")[0] == pytest.approx(9.5)
    assert slam.covariance("r")[0, 0] == pytest.approx(0.05**2 * (9 * 0.5 + 0.25))


@pytest.mark.parametrize("map_", ["dense", "postponed"])
@pytest.mark.parametrize("estimator", [km.estimators.Invariant(), km.estimators.Textbook()])
def test_the_parts_of_a_control_share_an_error_that_begins_anew_with_the_next(map_: str, estimator: Any) -> None:
    lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    slam = km.Slam(km.Robot("r", km.motion.Unicycle(0.05, 0.02), sensors={"l": lidar}), None, estimator, map=map_)
    for t in range(10):
        slam.process(km.Control(t, "r", (1.0, 0.0)))
        slam.process(km.Scan(t + 0.5, "r", "l", [[2.0, 0.3]], [t]))
    assert slam.covariance("r")[0, 0] == pytest.approx(0.05**2 * (9 + 0.25))


def test_float32_keeps_what_is_inactive_to_its_precision_in_half_the_memory() -> None:
    slams = [slam_of(km.estimators.Ekf()) for _ in range(2)]
    for slam, numbers in zip(slams, (np.float64, np.float32), strict=True):
        slam.state.map = CompressedMap.from_dense(slam.map, Triangle(numbers), most=60)  # type: ignore[arg-type]
        for event in drive(220, 1):
            slam.process(event)
    x, P = differences(*slams)
    assert 0 < x < 1e-4
    assert 0 < P < 1e-4
    assert slams[1].map.storage.nbytes * 2 == slams[0].map.storage.nbytes  # type: ignore[union-attr]


def test_a_map_known_beforehand_comes_to_rest_as_it_is_read_in() -> None:
    slam = km.Slam(slam_of(EKF).robots.values(), map="postponed")
    assert isinstance(slam.map, CompressedMap)
    for i in range(400):
        slam.add_landmark(i, (float(i), 1.0), np.diag([0.01, 0.02]))
        assert slam.map.active.n < 450
    np.testing.assert_array_equal(slam.covariance(7, 399), np.diag([0.01, 0.02, 0.01, 0.02]))
    np.testing.assert_array_equal(slam.mean(7), [7.0, 1.0])


def test_a_map_of_many_panels_saved_within_a_full_update_goes_on_as_the_one_that_was_not(tmp_path: Path) -> None:
    rng, side = np.random.default_rng(0), 20
    points = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2) * 2.0
    laser = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    slam = km.Slam([km.Robot("r", km.motion.Odometry2D(0.01, 0.01, 0.02), sensors={"l": laser})], map="postponed")
    for i, point in enumerate(points):
        slam.add_landmark(i, point, 0.01 * np.eye(2))
    assert isinstance(slam.map, CompressedMap)
    slam.map.full_update()
    pose, slams = np.zeros(3), [slam]
    for t in range(120):
        ahead = pose[:2] + 8 * np.array([np.cos(pose[2]), np.sin(pose[2])])
        u = np.array([8.0, 0.0, 0.0]) if (ahead > 0).all() and (ahead < 2 * side).all() else np.array([0.0, 0.0, 2.0])
        pose = km.geometry.compose(pose, u)[0]
        near = np.argsort(np.linalg.norm(points - pose[:2], axis=1))[:10]
        y = km.geometry.observe(pose, points[near])[0] + rng.normal(size=(10, 2)) * [0.05, 0.01]
        y[:, 0] = np.abs(y[:, 0])
        for each in slams:
            each.process(km.Control(t, "r", u))
            each.process(km.Scan(t, "r", "l", y, near.tolist()))
        if t == 60:
            slam.save(tmp_path / "map.kmk")
            slams.append(km.Slam.load(tmp_path / "map.kmk"))
    assert slams[1].map.interval > 5  # type: ignore[union-attr]  # full updates since
    for i in range(0, len(points), 7):
        np.testing.assert_array_equal(slams[1].mean(i), slam.mean(i))
        np.testing.assert_array_equal(slams[1].covariance("r", i), slam.covariance("r", i))


def test_landmarks_known_beforehand_do_not_stay_active() -> None:
    lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    slam = km.Slam([km.Robot("r", km.motion.Odometry2D(0.01, 0.0, 0.02), START, {"lidar": lidar})], map="postponed")
    for i, place in enumerate(WORLD):
        slam.add_landmark(i, place, 0.01 * np.eye(2))
    y, rows = km.geometry.observe(np.array(START), WORLD[:5])[0], []
    for t in range(60):
        slam.process(km.Scan(t, "r", "lidar", y, range(5)))
        rows.append(slam.map.active.n)  # type: ignore[attr-defined]
    assert rows[0] > 100
    assert rows[-1] < 40
