"""The map and its estimators: against the textbook, against each other, and against what cannot be observed."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.compiled import python_form
from kalmark.errors import EventError
from kalmark.filter import corrections, kernels
from kalmark.filter.estimators import Movement, Update
from kalmark.filter.map import StochasticMap
from kalmark.filter.textbook import TextbookSlam
from kalmark.geometry import POINT2, SE2, Rn
from kalmark.models.observe import PythonView

J = np.array([[0.0, -1.0], [1.0, 0.0]])
ESTIMATORS = [km.estimators.Ekf(), km.estimators.Invariant(), km.estimators.Fej()]
Q, R = np.diag([0.01**2, 0.02**2]), np.diag([0.1**2, 0.02**2])


def robot(cov: Any = None, start: Any = (0, 0, 0)) -> km.Robot:
    lidar = km.Mount(km.sensors.RangeBearing(0.1, 0.02))
    return km.Robot("r", km.motion.Odometry2D(0.01, 0.0, 0.02), start, {"lidar": lidar}, cov)


def full(map_: StochasticMap) -> np.ndarray:
    P = map_.P[: map_.n, : map_.n]
    return np.tril(P) + np.tril(P, -1).T


def drive(steps: int, seed: int, world: np.ndarray, most: int = 6) -> list[km.Control | km.Scan]:
    """Return the events of a robot on a circle among `world` (L, 2), seeing random ones of them."""
    events: list[km.Control | km.Scan] = []
    rng, truth = np.random.default_rng(seed), np.zeros(3)
    for t in range(1, steps + 1):
        u = np.array([0.1, 0.0, 0.05])
        truth = km.geometry.compose(truth, u)[0]
        events.append(km.Control(t, "r", u + rng.normal(size=3) * [0.01, 0, 0.02]))
        ids = rng.choice(len(world), size=min(most, len(world)), replace=False)
        y = km.geometry.observe(truth, world[ids])[0] + rng.normal(size=(len(ids), 2)) * [0.1, 0.02]
        events.append(km.Scan(t, "r", "lidar", np.column_stack([np.abs(y[:, 0]), y[:, 1]]), ids.tolist()))
    return events


WORLD = np.random.default_rng(0).uniform(-8, 8, (30, 2))


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_scan_of_more_landmarks_than_are_fused_together_is_fused_in_parts(
    estimator: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    events = drive(3, 1, np.random.default_rng(2).uniform(-8, 8, (30, 2)), 30)

    def run(together: int, kind: str) -> tuple[km.Slam, Any]:
        monkeypatch.setattr("kalmark.filter.estimators.TOGETHER", together)
        slam = km.Slam([robot()], estimator=estimator, map=kind)
        return slam, [slam.process(event) for event in events][-1]

    (one, whole), (other, parts), (compressed, _) = run(30, "dense"), run(7, "dense"), run(7, "postponed")
    names = ["r", *one.landmarks().ids]
    P = one.covariance(*names)
    sigma = np.sqrt(np.diag(P))
    for name in names:
        s = np.sqrt(np.diag(one.covariance(name)))
        assert (np.abs(one.mean(name) - other.mean(name)) < 0.2 * s).all()
        np.testing.assert_allclose(compressed.mean(name), other.mean(name), rtol=0, atol=1e-3 * s.min())
    assert (np.abs(P - other.covariance(*names)) / np.outer(sigma, sigma)).max() < 0.05
    assert [(o.index, o.id, o.outcome) for o in whole.observations] == [
        (o.index, o.id, o.outcome) for o in parts.observations
    ]
    first = slice(0, 7)  # the first part is compared with what all of them are compared with
    np.testing.assert_allclose([o.d2 for o in whole.observations[first]], [o.d2 for o in parts.observations[first]],
                               rtol=0.2, atol=0.05)  # fmt: skip


def test_the_fast_ekf_equals_the_textbook_to_1e_10() -> None:
    slam, book, number = km.Slam([robot()], estimator=km.estimators.Ekf()), TextbookSlam([0, 0, 0], Q, R), {}
    for event in drive(60, 1, WORLD):
        report = slam.process(event)
        if isinstance(event, km.Control):
            book.predict(event.u[[0, 2]])
            continue
        known = [k for k, i in enumerate(event.ids) if i in number]
        passed = [book.correct(number[event.ids[k]], event.y[k]) for k in known]
        assert [report.observations[k].outcome == "associated" for k in known] == passed
        for k, i in enumerate(event.ids):
            if i not in number:
                number[i] = book.initialize(event.y[k])
    order = sorted(number, key=number.get)  # type: ignore[arg-type]
    mean = np.concatenate([slam.mean("r"), *(slam.mean(i) for i in order)])
    np.testing.assert_allclose(mean, book.x, rtol=0, atol=1e-10)
    np.testing.assert_allclose(slam.covariance("r", *order), book.P, rtol=0, atol=1e-10)
    assert len(order) == len(WORLD)


def test_the_recorded_course_run_agrees_to_1e_9(oracle: Callable[[str], Path]) -> None:
    course = json.loads(gzip.decompress(oracle("course2d.json.gz").read_bytes()))
    (sx, sa), (sr, sb) = course["q"], course["s"]
    lidar = km.Mount(km.sensors.RangeBearing(sr, sb))
    rover = km.Robot("r", km.motion.Odometry2D(sx, 0.0, sa), course["R0"], {"lidar": lidar})
    slam = km.Slam([rover], estimator=km.estimators.Ekf())
    tried = rejected = 0
    for t, step in enumerate(course["steps"]):
        forward, turn = np.add(course["U"], step["n"])
        slam.process(km.Control(t, "r", (forward, 0, turn)))
        recorded = step["corr"] if isinstance(step["corr"], list) else [step["corr"]]
        ids = [c["i"] for c in recorded] + ([step["init"]] if step["init"] else [])
        y = np.array(step["Y"])[:, np.array(ids) - 1].T
        report = slam.process(km.Scan(t, "r", "lidar", y, ids))
        outcomes = [o.outcome for o in report.observations[: len(recorded)]]
        assert outcomes == ["associated" if c["ok"] else "rejected" for c in recorded]
        tried, rejected = tried + len(recorded), rejected + outcomes.count("rejected")
        used = np.array(step["used"]) - 1
        difference = slam.map.x[used] - step["x"]
        difference[2] = km.geometry.wrap(difference[2])  # the course wraps after a motion, we wrap after a correction
        np.testing.assert_allclose(difference, 0, atol=1e-9)
        if step.get("P"):
            np.testing.assert_allclose(full(slam.map)[np.ix_(used, used)], step["P"], rtol=0, atol=1e-9)
    assert (tried, rejected) == (6534, 86)
    np.testing.assert_allclose(full(slam.map), course["Pend"], rtol=0, atol=1e-9)


class Xi:
    """The right-invariant filter written out: dense, in xi coordinates, iterated on the full state."""

    def __init__(self, start: np.ndarray, P: np.ndarray, R: np.ndarray) -> None:
        self.x, self.R = np.array(start, float), R
        self.B = self.to_xi() @ P @ self.to_xi().T  # covariance of xi

    def to_xi(self) -> np.ndarray:
        """Return d xi / d d: xi = d - generator d_theta."""
        A = np.eye(len(self.x))
        A[:2, 2] -= J @ self.x[:2]
        for i in range(3, len(self.x), 2):
            A[i : i + 2, 2] -= J @ self.x[i : i + 2]
        return A

    def moved(self, x: np.ndarray, xi: np.ndarray) -> np.ndarray:
        """Return x rotated by Exp(d_theta) about the origin and carried along V xi."""
        E, V, out = km.geometry.rotation(xi[2]), km.geometry.V(xi[2]), x.copy()
        for i in [0, *range(3, len(x), 2)]:
            out[i : i + 2] = E @ x[i : i + 2] + V @ xi[i : i + 2]
        out[2] = km.geometry.wrap(x[2] + xi[2])
        return out

    def predict(self, u: np.ndarray, N: np.ndarray) -> None:
        P = np.linalg.solve(self.to_xi(), np.linalg.solve(self.to_xi(), self.B).T)
        r, F_r, F_u = km.geometry.compose(self.x[:3], u)[0], *km.geometry.compose(self.x[:3], u)[1:]
        F = np.eye(len(self.x))
        F[:3, :3] = F_r
        P = F @ P @ F.T
        P[:3, :3] += F_u @ N @ F_u.T
        self.x[:3] = r
        self.B = self.to_xi() @ P @ self.to_xi().T

    def correct(self, y: np.ndarray, numbers: list[int]) -> None:
        x0, xi = self.x.copy(), np.zeros(len(self.x))
        R = np.kron(np.eye(len(numbers)), self.R)
        for _ in range(30):
            self.x = self.moved(x0, xi)
            H, z = np.zeros((2 * len(numbers), len(x0))), np.zeros(2 * len(numbers))
            for k, i in enumerate(numbers):
                at = 3 + 2 * i
                e, E_r, E_l = km.geometry.observe(self.x[:3], self.x[at : at + 2])
                H[2 * k : 2 * k + 2, :3], H[2 * k : 2 * k + 2, at : at + 2] = E_r, E_l
                z[2 * k : 2 * k + 2] = (y[k] - e) - [0, (y[k] - e)[1] - km.geometry.wrap((y[k] - e)[1])]
            H = H @ np.linalg.inv(self.to_xi())
            K = self.B @ H.T @ np.linalg.inv(H @ self.B @ H.T + R)
            step = K @ (z + H @ xi)
            if np.abs(step - xi).max() < 1e-12:
                break
            xi = step
        self.x = self.moved(x0, xi)
        self.B = self.B - K @ H @ self.B


def test_the_invariant_filter_equals_its_dense_form_in_xi_coordinates() -> None:
    cov = np.diag([0.2, 0.1, 0.3]) ** 2
    slam = km.Slam([robot(cov)], estimator=km.estimators.Invariant(30, 1e-9))
    rng = np.random.default_rng(5)
    world = WORLD[:5]
    prior = np.diag(np.r_[0.2, 0.1, 0.3, np.full(10, 0.3)]) ** 2
    xi = Xi(np.r_[0, 0, 0, world.ravel() + 0.2], prior, R)
    for i, l in enumerate(world):
        slam.add_landmark(i, l + 0.2, 0.3**2 * np.eye(2))
    truth = np.array([0.1, -0.1, 0.2])
    for t in range(1, 15):
        u = np.array([0.4, 0.1, 0.2])
        truth = km.geometry.compose(truth, u)[0]
        slam.process(km.Control(t, "r", u))
        xi.predict(u, np.diag([0.01, 0, 0.02]) ** 2)
        ids = rng.choice(5, 3, replace=False).tolist()
        y = km.geometry.observe(truth, world[ids])[0] + rng.normal(size=(3, 2)) * [0.1, 0.02]
        slam.process(km.Scan(t, "r", "lidar", y, ids))
        xi.correct(y, ids)
    mean = np.concatenate([slam.mean("r"), *(slam.mean(i) for i in range(5))])
    np.testing.assert_allclose(mean, xi.x, atol=1e-6)
    P = slam.covariance("r", *range(5))
    np.testing.assert_allclose(xi.to_xi() @ P @ xi.to_xi().T, xi.B, atol=1e-6 * np.abs(xi.B).max())


def standing(estimator: Any, prior: float, scans: int) -> float:
    """Return the heading sigma (deg) of a robot that stands still and looks at the same landmarks again and again."""
    rng = np.random.default_rng(3)
    slam = km.Slam([robot(np.diag([0.5, 0.5, prior]) ** 2)], km.association.ByIdentity("off"), estimator)
    truth, world = np.array([0.2, -0.3, 0.25]), WORLD[:6]
    for t in range(scans):
        y = km.geometry.observe(truth, world)[0] + rng.normal(size=(6, 2)) * [0.1, 0.02]
        slam.process(km.Scan(t, "r", "lidar", np.column_stack([np.abs(y[:, 0]), y[:, 1]]), range(6)))
    return float(np.degrees(np.sqrt(slam.covariance("r")[2, 2])))


def test_a_robot_that_stands_still_learns_nothing_of_its_heading() -> None:
    prior = np.radians(20)
    assert standing(km.estimators.Invariant(), prior, 500) == pytest.approx(20, abs=1e-6)
    assert standing(km.estimators.Invariant(1), prior, 100) == pytest.approx(20, abs=1e-6)
    assert standing(km.estimators.Fej(), prior, 100) == pytest.approx(20, abs=1e-6)
    assert standing(km.estimators.Ekf(), prior, 500) < 3, "the textbook filter claims to learn it"


def relative_map(estimator: Any, cov: Any) -> np.ndarray:
    slam = km.Slam([robot(cov)], km.association.ByIdentity("off"), estimator)
    for event in drive(150, 7, WORLD[:12]):
        slam.process(event)
    return km.geometry.to_frame(slam.mean("r"), np.array([slam.mean(i) for i in range(12)]))[0]


def test_an_uncertain_start_leaves_the_map_relative_to_the_robot_as_it_is() -> None:
    cov = np.diag([0.5, 0.5, np.radians(20)]) ** 2
    ours, book = km.estimators.Invariant(tolerance=1e-9), km.estimators.Ekf()
    np.testing.assert_allclose(relative_map(ours, cov), relative_map(ours, None), atol=1e-9)
    assert np.abs(relative_map(book, cov) - relative_map(book, None)).max() > 1e-4


def test_rotating_the_world_rotates_the_estimate() -> None:
    phi = 2.1
    turned = km.geometry.rotation(phi)
    runs = []
    for start, world in (((0, 0, 0), WORLD[:8]), ((0, 0, phi), WORLD[:8] @ turned.T)):
        slam = km.Slam([robot(start=start)])
        for event in drive(80, 9, WORLD[:8]):
            slam.process(event)
        runs.append((slam, world))
    (a, _), (b, _) = runs
    for i in range(8):
        np.testing.assert_allclose(turned @ a.mean(i), b.mean(i), atol=1e-9)
        np.testing.assert_allclose(turned @ a.covariance(i) @ turned.T, b.covariance(i), atol=1e-9)


def test_augmenting_is_the_limit_of_a_huge_prior_with_a_difference_falling_as_one_over_C() -> None:
    """Tacher 3: a landmark with prior C I, corrected by its first observation, against augmentation."""
    differences = []
    for C in (1e2, 1e3, 1e4):
        y = np.array([3.0, 0.4])
        book = TextbookSlam([0.3, -0.2, 0.1], Q, R, P=np.diag([0.1, 0.1, 0.05]) ** 2)
        book.initialize(y)
        prior = TextbookSlam([0.3, -0.2, 0.1], Q, R, P=np.diag([0.1, 0.1, 0.05]) ** 2)
        prior.x = book.x.copy()
        P = np.zeros((5, 5))
        P[:3, :3], P[3:, 3:] = prior.P, C * np.eye(2)
        prior.P = P
        assert prior.correct(0, y)
        differences.append(np.abs(prior.P - book.P).max() / np.abs(book.P).max())
    np.testing.assert_allclose(np.array(differences[:-1]) / differences[1:], 10, rtol=0.05)


def test_a_known_map_stays_as_it_is_and_locates_the_robot() -> None:
    for estimator in ESTIMATORS:
        slam = km.Slam([robot(np.diag([0.3, 0.3, 0.1]) ** 2)], estimator=estimator)
        for i, l in enumerate(WORLD[:10]):
            slam.add_landmark(i, l)
        for event in drive(50, 11, WORLD[:10]):
            slam.process(event)
        np.testing.assert_array_equal([slam.mean(i) for i in range(10)], WORLD[:10])
        truth = np.zeros(3)
        for _ in range(50):
            truth = km.geometry.compose(truth, np.array([0.1, 0, 0.05]))[0]
        error = SE2.minus(slam.mean("r"), truth)
        assert error @ np.linalg.solve(slam.covariance("r"), error) < 16.3, type(estimator).__name__


def test_the_plain_python_source_of_a_correction_equals_the_compiled_one() -> None:
    for fast in (corrections.invariant, corrections.textbook, corrections.first_estimates):
        maps = []
        for function in (python_form(fast), fast):
            slam = km.Slam([robot()])
            for event in drive(20, 13, WORLD):
                slam.process(event)
            m, slots, y = slam.map, np.array([slam.slot(i) for i in (1, 2, 3)]), np.full((3, 2), 2.0)
            view, R3 = slam.state.channels["r", "lidar"].models["point"].model, np.tile(R, (3, 1, 1))
            last = {corrections.invariant: (6, 1e-3), corrections.first_estimates: m.x_first}.get(fast)
            function(view, m.whole, (0, -1, slots, 2, y, R3, np.inf), last)
            maps.append((m.x[: m.n].copy(), full(m)))
        np.testing.assert_allclose(maps[0][0], maps[1][0], atol=1e-9)
        np.testing.assert_allclose(maps[0][1], maps[1][1], atol=1e-9)


def test_a_scan_is_linearised_alike_by_a_compiled_model_and_by_a_model_in_python() -> None:
    slam = km.Slam([robot()])
    for event in drive(20, 13, WORLD):
        slam.process(event)
    model, slots = slam.state.channels["r", "lidar"].models["point"], np.array([slam.slot(i) for i in (1, 2, 3)])
    scan = 0, -1, slots, 2, np.full((3, 2), 2.0), np.tile(R, (3, 1, 1)), np.inf
    in_python = PythonView(model.sensor, model.landmark, model.at, np.array(model.sensor.angular))
    fast, plain = (corrections.seen_at(view, slam.map.whole, scan) for view in (model.model, in_python))
    e, E_r, E_l = km.geometry.observe(slam.mean("r"), np.array([slam.mean(i) for i in (1, 2, 3)]))
    for found, again, expected in zip(fast, plain, (None, e, None, E_r, E_l), strict=True):
        np.testing.assert_allclose(found, again, atol=1e-12)
        if expected is not None:
            np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_array_equal(fast[0], [*range(3), *np.concatenate([slam.map.index(s) for s in slots])])
    covariances = corrections.innovation_covariances
    for found, again in zip(
        *(f(model.model, slam.map.whole, scan) for f in (covariances, python_form(covariances))), strict=True
    ):
        np.testing.assert_allclose(found, again, rtol=1e-12)


# ---------------------------------------------------------------------- the map itself
def random_map(blocks: int, seed: int) -> StochasticMap:
    rng, m = np.random.default_rng(seed), StochasticMap(capacity=4)
    m.add(SE2, rng.normal(size=3), np.eye(3))
    for _ in range(blocks):
        m.augment(POINT2, rng.normal(size=2), m.index(0), rng.normal(size=(2, 3)), np.eye(2))
    return m


def test_prediction_acts_on_the_rows_of_the_robot_alone() -> None:
    rng, m = np.random.default_rng(1), random_map(30, 2)
    P, F, D = full(m), np.eye(m.n), np.zeros((m.n, m.n))
    index = m.index(0)
    F[np.ix_(index, index)] = f = rng.normal(size=(3, 3))
    D[np.ix_(index, index)] = d = np.diag([1.0, 2, 3])
    m.predict(index, f, d)
    np.testing.assert_allclose(full(m), F @ P @ F.T + D, atol=1e-12)


@pytest.mark.parametrize("blocks", [3, 40, 200])
def test_the_downdate_and_the_transport_equal_their_dense_forms_alone_and_together(blocks: int) -> None:
    rng, m, both = np.random.default_rng(2), random_map(blocks, 3), random_map(blocks, 3)
    P, V, a = full(m), rng.normal(size=(5, m.n)), rng.normal(size=m.n)
    kernels.downdate(m.P, V)
    P = P - V.T @ V
    np.testing.assert_allclose(full(m), P, atol=1e-10)
    A = np.eye(m.n)
    A[:, 2] += a
    kernels.downdate_and_transport(m.P, np.zeros((0, len(a))), a[:, None].copy(), np.array([2]))
    np.testing.assert_allclose(full(m), A @ P @ A.T, atol=1e-9)
    kernels.downdate_and_transport(both.P, V, a[:, None].copy(), np.array([2]))
    np.testing.assert_allclose(full(both), A @ P @ A.T, atol=1e-9)


def test_a_removed_block_leaves_its_slot_to_the_next_and_the_rest_as_it_is() -> None:
    m = random_map(5, 4)
    rest, before = [0, 1, 2, 4, 5], full(m)
    kept = m.covariance(rest)
    m.remove(3)
    np.testing.assert_array_equal(m.covariance(rest), kept)
    slot = m.add(POINT2, np.array([7.0, 8.0]), 4 * np.eye(2))
    assert slot == 3
    assert m.n == len(before)
    np.testing.assert_array_equal(m.mean(slot), [7, 8])
    np.testing.assert_array_equal(m.covariance([0, slot])[:3, 3:], np.zeros((3, 2)))
    other = m.add(Rn(2), np.zeros(2), np.eye(2))
    assert other == 6, "a block of another kind takes a place of its own"


def test_the_map_grows_without_losing_anything() -> None:
    small, large = random_map(100, 5), StochasticMap(capacity=1000)
    rng = np.random.default_rng(5)
    large.add(SE2, rng.normal(size=3), np.eye(3))
    for _ in range(100):
        large.augment(POINT2, rng.normal(size=2), large.index(0), rng.normal(size=(2, 3)), np.eye(2))
    np.testing.assert_array_equal(full(small), full(large))
    np.testing.assert_array_equal(small.x[: small.x_n], large.x[: large.x_n])


def test_P_stays_symmetric_and_positive_definite_over_ten_thousand_corrections() -> None:
    slam = km.Slam([robot()])
    for event in drive(1700, 15, WORLD[:8]):
        slam.process(event)
    assert np.linalg.eigvalsh(slam.covariance("r", *range(8))).min() > 0


class Own:
    """A user's estimator: the textbook's, but it inflates the noise of every scan.  It cannot average."""

    coordinates, default_gate = "world", 9.0
    inner = km.estimators.Ekf()

    def predict(self, map_: Any, movement: Movement) -> bool:
        return self.inner.predict(map_, movement)

    def correct(self, map_: Any, update: Update) -> Any:
        return self.inner.correct(map_, update._replace(R=4 * update.R))

    def for_fixes(self) -> Any:
        return self

    def pose_jacobian(self, map_: Any, robot: int, J: np.ndarray) -> np.ndarray:
        return J


@pytest.mark.parametrize("map_", ["dense", "postponed"])
def test_a_users_estimator_drives_either_map(map_: str) -> None:
    inflated, plain = (km.Slam([robot()], estimator=e, map=map_) for e in (Own(), km.estimators.Ekf()))
    for event in drive(40, 1, WORLD):
        for slam in (inflated, plain):
            slam.process(event)
    sigmas = [np.sqrt(np.diag(slam.covariance("r"))) for slam in (inflated, plain)]
    assert (sigmas[0] > sigmas[1]).all()
    assert np.abs(inflated.mean("r") - plain.mean("r")).max() < 3 * sigmas[0].max()


def test_averaging_over_matchings_is_refused_to_an_estimator_that_cannot() -> None:
    slam = km.Slam([robot()], km.association.Averaged(), Own())
    with pytest.raises(EventError, match="an estimator with `average`, Own has none"):
        slam.process(km.Scan(1, "r", "lidar", [[4.0, 0.1]]))
