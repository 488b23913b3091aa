"""Slam: one door for all events, a reason for every outcome, and nothing changed by what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import DivergedError, EventError, MapError, ModelError
from kalmark.geometry.spaces import HEADING, SCALAR, Space
from kalmark.results.landmark_table import MapLandmarks

NAN, INF = float("nan"), float("inf")


def rover(**sensors: km.Mount) -> km.Robot:
    sensors = sensors or {"lidar": km.Mount(km.sensors.RangeBearing(), at=(0.3, 0, 0))}
    return km.Robot("rover", km.motion.Unicycle(), sensors=sensors)


def signature(landmark: km.landmarks.Point2D | None = None) -> km.Mount:
    return km.Mount(km.sensors.RangeBearingSignature(), landmark=landmark)


def started(**kwargs: Any) -> km.Slam:
    slam = km.Slam([rover()], **kwargs)
    slam.process(km.Control(0.0, "rover", (0.5, 0.1)))
    slam.process(km.Scan(1.0, "rover", "lidar", [[2.0, 0.3], [3.0, -1.0]], [1, 2]))
    return slam


def state(slam: km.Slam) -> tuple[Any, ...]:
    m = slam.map
    held = [(moving.held.t_ns, moving.held.fresh) for moving in slam.state.moving.values()]
    counts = {name: track.observations for name, track in slam.tracks.confirmed.items()}
    return (m.x.tobytes(), m.P.tobytes(), m.n, slam.t_ns, list(slam.tracks.slots), held, counts)


BAD: dict[str, tuple[Any, str]] = {
    "NaN range": (lambda: km.Scan(2, "rover", "lidar", [[NAN, 0]], [1]), "holds nan, expected finite"),
    "infinite bearing": (lambda: km.Scan(2, "rover", "lidar", [[1, INF]], [1]), "holds inf, expected finite"),
    "NaN control": (lambda: km.Control(2, "rover", (NAN, 0)), "holds nan, expected finite"),
    "NaN time": (lambda: km.Control(NAN, "rover", (1, 0)), "t_s is nan"),
    "no time": (lambda: km.Control(robot="rover", u=(1, 0)), "exactly one of t_s and t_ns"),
    "text": (lambda: km.Scan(2, "rover", "lidar", [["far", 0]], [1]), "expected numbers"),
    "negative range": (
        lambda: km.Scan(2, "rover", "lidar", [[1, 0], [-0.5, 0]], [1, 2]),
        "observation 1: range is -0.5",
    ),
    "noise not definite": (lambda: km.Scan(2, "rover", "lidar", [[1, 0]], [1], np.diag([1, 0])), "positive definite"),
    "asymmetric noise": (lambda: km.Scan(2, "rover", "lidar", [[1, 0]], [1], [[1, 0.5], [0, 1]]), "symmetric"),
    "wrong noise shape": (lambda: km.Scan(2, "rover", "lidar", [[1, 0]], [1], np.eye(3)), "cov has shape (3, 3)"),
    "control noise not semidefinite": (lambda: km.Control(2, "rover", (1, 0), np.diag([1, -1])), "semidefinite"),
    "wrong control": (lambda: km.Control(2, "rover", (1, 0, 0)), "expected (v_mps, w_radps)"),
    "wrong measurement": (lambda: km.Scan(2, "rover", "lidar", [[1, 0, 0]], [1]), "expected 2: range_m, bearing_rad"),
    "flat measurement": (lambda: km.Scan(2, "rover", "lidar", [1, 0], [1]), "expected (K, m)"),
    "ids missing": (lambda: km.Scan(2, "rover", "lidar", [[1, 0], [2, 0]], [1]), "1 ids for 2 observations"),
    "duplicate ids": (lambda: km.Scan(2, "rover", "lidar", [[1, 0], [2, 0]], [1, 1]), "id 1 appears twice"),
    "unknown robot": (lambda: km.Control(2, "rovr", (1, 0)), "expected one of ['rover']"),
    "unknown sensor": (lambda: km.Scan(2, "rover", "camera", [[1, 0]], [1]), "expected one of ['lidar']"),
    "time running backwards": (lambda: km.Control(0.5, "rover", (1, 0)), "comes after one at t=1 s"),
    "fix without covariance": (lambda: km.Fix(2, "rover", (1, 0)), "cov is missing"),
    "fix noise not definite": (lambda: km.Fix(2, "rover", (1, 0), np.zeros((2, 2))), "positive definite"),
    "no event at all": (lambda: "a control", "got str, expected a Control, a Scan, a Fix or raw data of a sensor"),
    "fix of wrong size": (lambda: km.Fix(2, "rover", (1, 0, 0), np.eye(3)), "expected (2,)"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_event_is_refused_with_one_line_and_changes_nothing(name: str) -> None:
    make, message = BAD[name]
    slam = started()
    before = state(slam)
    with pytest.raises(EventError) as refused:
        slam.process(make())
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
    assert state(slam) == before
    slam.process(km.Scan(2.0, "rover", "lidar", [[1.8, 0.3]], [1]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: km.Slam([]), "at least one robot"),
        (lambda: km.Slam([rover(), rover()]), "given twice"),
        (lambda: km.Slam("rover"), "robots is 'rover', expected a list of Robots"),
        (lambda: km.Slam(None), "robots is None, expected a list of Robots"),
        (lambda: km.Slam({"rover": rover()}), "robots: one is 'rover', expected a Robot"),
        (
            lambda: km.Slam(rover(), association="auto"),
            "association is 'auto', expected an object like km.association.A",
        ),
        (lambda: km.Slam(rover(), km.association.ByIdentity), "is the class ByIdentity, expected an instance"),
        (lambda: km.Slam(rover(), estimator="ekf"), "estimator is 'ekf', expected an object like km.estimators.Ekf()"),
        (lambda: km.Slam(rover(), estimator=km.estimators.Ekf), "estimator is the class Ekf, expected an instance"),
        (lambda: km.Slam(rover(), landmarks="point"), "landmarks is 'point', expected a landmark model"),
        (lambda: km.Slam(rover(), upkeep="merge"), "upkeep is 'merge', expected an Upkeep"),
        (lambda: km.Slam(rover(), reparametrize="off"), "reparametrize is 'off', expected a number"),
        (lambda: km.Slam(rover(), reparametrize=-1), "reparametrize is -1, expected a number of at least 0"),
        (lambda: km.Slam(rover(), map="sparse"), "map is 'sparse', expected one of auto, dense, postponed"),
        (lambda: km.Slam(rover()).covariance(), "covariance of no blocks, expected names of robots"),
        (lambda: km.Slam(rover()).covariance(["rover"]), "['rover'] is not in the map, expected 'rover' or one of"),
        (lambda: km.Slam(rover()).remove(["rover"]), "['rover'] is not in the map"),
        (lambda: km.Slam(rover()).add_landmark(1, (0, 0), landmark="point"), "landmark 1 is 'point', expected a landm"),
        (lambda: km.Mount(km.sensors.Range(), association="auto"), "Mount: association is 'auto', expected an object"),
        (lambda: km.Mount(km.sensors.Range(), detector="trunks"), "Mount: detector is 'trunks', expected an object"),
        (lambda: km.Mount(km.sensors.Range(), detector=km.detect.Trunks), "is the class Trunks, expected an instance"),
        (lambda: km.Slam([rover()], map="sparse"), "expected one of auto, dense, postponed"),
        (lambda: km.Robot("", km.motion.Unicycle()), "name is ''"),
        (lambda: km.Robot("r", km.motion.Unicycle(), start=(0, NAN, 0)), "three finite numbers"),
        (lambda: km.Robot("r", km.motion.Unicycle(), cov=np.diag([1, 1, -1])), "semidefinite"),
        (lambda: km.Robot("r", None), "expected a motion model"),
        (lambda: km.Mount(None), "expected columns, angular, expect and noise"),
        (lambda: km.association.ByIdentity(gate=2), "probability between 0 and 1"),
        (lambda: km.estimators.Invariant(iterations=0), "at least 1"),
        (lambda: km.Slam([rover()], landmarks=km.landmarks.PointSignature2D()), "finds 2 numbers"),
        (lambda: km.Slam([rover(s=signature(km.landmarks.Point2D()))]), "finds 3 numbers"),
        (lambda: km.sensors.RangeBearing(0, 0.02), "sigma_range_m is 0, expected a positive number"),
        (lambda: km.sensors.RangeBearing(np.inf, 0.02), "expected a finite number"),
        (lambda: km.motion.Unicycle("fast"), "sigma_v_mps is 'fast', expected a number"),
        (lambda: km.motion.Ackermann(0), "wheelbase_m is 0, expected a positive number"),
        (lambda: km.pointwise(lambda v: v, -np.eye(2)), "positive definite"),
    ],
)
def test_a_bad_model_is_refused(make: Any, message: str) -> None:
    with pytest.raises(km.KalmarkError, match=r".") as refused:
        make()
    assert message in str(refused.value)


def test_one_robot_need_not_be_in_a_list() -> None:
    assert list(km.Slam(rover()).robots) == list(km.Slam([rover()]).robots) == ["rover"]


def test_every_outcome_has_its_reason() -> None:
    slam = started(association=km.association.ByIdentity(gate=0.99))
    report = slam.process(km.Scan(1.0, "rover", "lidar", [[2.0, 0.3], [9.0, 1.0], [4.0, 2.0], [1, 1]], [1, 2, 3, None]))
    assert [o.outcome for o in report.observations] == ["associated", "rejected", "new", "ignored"]
    near, far, new, blind = report.observations
    assert near.landmark == 1
    assert near.d2 is not None
    assert near.d2 < 1e-20
    assert far.landmark == 2
    assert "outside the gate of 9.21" in far.reason
    assert (new.landmark, new.d2) == (3, None)
    assert blind.reason == "no id in the log"
    assert np.isnan(report.z[2:]).all()
    assert np.isfinite(report.z[:2]).all()
    assert far.d2 == pytest.approx(report.z[1] @ np.linalg.solve(report.Z[1], report.z[1]))


def test_a_sensor_that_cannot_start_a_landmark_says_so() -> None:
    slam = km.Slam([rover(camera=km.Mount(km.sensors.Bearing(), landmark=km.landmarks.Point2D()))])
    (observation,) = slam.process(km.Scan(0, "rover", "camera", [[0.1]], [1])).observations
    assert observation.outcome == "ignored"
    assert "alone cannot start a landmark" in observation.reason
    slam.add_landmark(1, (5.0, 0.0), np.eye(2))
    (observation,) = slam.process(km.Scan(1, "rover", "camera", [[0.1]], [1])).observations
    assert observation.outcome == "associated"


def test_the_prediction_of_a_split_control_equals_that_of_the_whole() -> None:
    """A held control's error is common to all parts into which scans split its interval."""
    whole, split = km.Slam([rover()]), km.Slam([rover()])
    for slam, times in ((whole, []), (split, [0.2, 0.5, 0.9])):
        slam.process(km.Control(0, "rover", (1.0, 0.4)))
        for t in times:
            slam.process(km.Scan(t, "rover", "lidar", np.zeros((0, 2))))
        slam.process(km.Control(1, "rover", (0.0, 0.0)))
    np.testing.assert_allclose(split.mean("rover"), whole.mean("rover"), atol=1e-12)
    np.testing.assert_allclose(split.covariance("rover"), whole.covariance("rover"), atol=1e-15)
    assert split.map.n == 5, "the error's block is free again, its place is kept"
    assert split.map.covariance([0]).shape == (3, 3)


def test_diffusion_does_not_care_how_its_interval_is_split() -> None:
    covariances = []
    for times in ([], np.linspace(0.01, 0.99, 50)):
        motion = km.motion.Unicycle(0, 0, sigma_along_m_per_sqrt_s=0.1, sigma_theta_rad_per_sqrt_s=0.1)
        slam = km.Slam([km.Robot("rover", motion, sensors={"lidar": km.Mount(km.sensors.RangeBearing())})])
        slam.process(km.Control(0, "rover", (0.0, 0.3)))
        for t in times:
            slam.process(km.Scan(t, "rover", "lidar", np.zeros((0, 2))))
        slam.process(km.Control(1, "rover", (0.0, 0.0)))
        covariances.append(np.trace(slam.covariance("rover")))
    assert covariances[0] == pytest.approx(covariances[1], rel=1e-9)


def test_a_fix_corrects_the_robot_and_what_it_saw() -> None:
    slam = started()
    before = slam.covariance(1).trace()
    place = slam.mean("rover")[:2] + 2 * np.sqrt(np.diag(slam.covariance("rover"))[:2])
    report = slam.process(km.Fix(1.0, "rover", place, 1e-4 * np.eye(2)))
    assert report.observations[0].outcome == "associated"
    np.testing.assert_allclose(slam.mean("rover")[:2], place, atol=0.05)
    assert slam.covariance(1).trace() < before


@pytest.mark.parametrize("estimator", [km.estimators.Ekf(), km.estimators.Invariant(), km.estimators.Fej()])
def test_robots_that_see_each_other_share_what_they_know(estimator: Any) -> None:
    camera = {"camera": km.Mount(km.sensors.RangeBearing(0.05, 0.01))}
    sure = km.Robot("a", km.motion.Unicycle(), (0, 0, 0), camera)
    lost = km.Robot("b", km.motion.Unicycle(), (3.4, 0.3, 1), camera, cov=np.diag([0.5, 0.5, 0.2]) ** 2)
    slam = km.Slam([sure, lost], estimator=estimator)
    report = slam.process(km.Scan(0, "a", "camera", [[3.0, 0.0], [4.0, 0.5]], ["b", 7]))
    assert [o.outcome for o in report.observations] == ["associated", "new"]
    np.testing.assert_allclose(slam.mean("b")[:2], (3, 0), atol=0.1)
    assert np.sqrt(np.diag(slam.covariance("b")))[:2].max() < 0.1
    (me,) = slam.process(km.Scan(0, "b", "camera", [[1.0, 0.0]], ["b"])).observations
    assert me.reason == "a robot does not see itself"


def test_an_observed_robot_is_moved_to_the_time_of_the_observation() -> None:
    camera = {"camera": km.Mount(km.sensors.RangeBearing())}
    slam = km.Slam([km.Robot(n, km.motion.Unicycle(), (x, 0, 0), camera) for n, x in (("a", 0), ("b", 3))])
    slam.process(km.Control(0, "b", (1.0, 0.0)))
    slam.process(km.Scan(2, "a", "camera", [[5.0, 0.0]], ["b"]))
    assert slam.mean("b")[0] == pytest.approx(5.0, abs=1e-9)


def test_a_signature_is_mapped_and_told() -> None:
    mount = km.Mount(km.sensors.RangeBearingSignature(sigma_signature=0.2))
    slam = km.Slam([km.Robot("r", km.motion.Unicycle(), sensors={"s": mount})])
    slam.process(km.Scan(0, "r", "s", [[2.0, 0.0, 5.0]], [1]))
    slam.process(km.Scan(1, "r", "s", [[2.0, 0.0, 6.0]], [1]))
    np.testing.assert_allclose(slam.mean(1), [2, 0, 5.5], atol=1e-9)
    assert slam.covariance(1)[2, 2] == pytest.approx(0.2**2 / 2)
    assert slam.landmarks().kinds == ["point_signature"]


def test_nearest_neighbour_names_new_landmarks_and_finds_them_again() -> None:
    slam = km.Slam([rover()], km.association.NearestNeighbour(), upkeep=km.Upkeep(confirm=1))
    first = slam.process(km.Scan(0, "rover", "lidar", [[2.0, 0.3], [3.0, -1.0]]))
    assert [(o.outcome, o.landmark) for o in first.observations] == [("new", "u1"), ("new", "u2")]
    again = slam.process(km.Scan(1, "rover", "lidar", [[3.05, -1.0], [2.0, 0.31], [2.0, 2.5], [2.5, 0.3]]))
    said = [(o.outcome, o.landmark) for o in again.observations]
    assert said == [("associated", "u2"), ("associated", "u1"), ("new", "u3"), ("ignored", None)]
    assert "between 'u1' and a new landmark" in again.observations[3].reason


def test_a_removed_landmark_is_new_when_it_is_seen_again() -> None:
    slam = started()
    slam.remove(1)
    assert slam.landmarks().ids == [2]
    with pytest.raises(MapError, match="1 is not in the map"):
        slam.mean(1)
    with pytest.raises(MapError, match="is a robot"):
        slam.remove("rover")
    report = slam.process(km.Scan(1.0, "rover", "lidar", [[2.0, 0.3]], [1]))
    assert report.observations[0].outcome == "new"


@pytest.mark.parametrize("estimator", [km.estimators.Ekf(), km.estimators.Invariant(), km.estimators.Fej()])
def test_a_saved_slam_resumes_bit_for_bit(estimator: Any, tmp_path: Path) -> None:
    def tail(slam: km.Slam) -> None:
        slam.process(km.Scan(1.3, "rover", "lidar", [[1.9, 0.3], [5.0, 2.0]], [1, "u4"]))
        slam.process(km.Control(2.0, "rover", (0.1, 0.3)))
        slam.process(km.Scan(2.5, "rover", "lidar", [[1.5, 0.35], [3.0, -1.2]], [1, 2]))

    straight = started(estimator=estimator)
    straight.remove(2)
    straight.save(tmp_path / "map.kmk")
    resumed = km.Slam.load(tmp_path / "map.kmk")
    for slam in (straight, resumed):
        tail(slam)
    assert resumed.mean("rover").tobytes() == straight.mean("rover").tobytes()
    ids = straight.landmarks().ids
    assert resumed.landmarks().ids == ids
    assert resumed.covariance("rover", *ids).tobytes() == straight.covariance("rover", *ids).tobytes()
    assert resumed.estimator == estimator


def test_a_map_of_a_users_sensor_wants_the_robots_again(tmp_path: Path) -> None:
    sensor = km.pointwise(lambda v: v, np.eye(2), inverse=lambda y: y)
    slam = km.Slam([rover(mine=km.Mount(sensor))])
    slam.process(km.Scan(0, "rover", "mine", [[1.0, 2.0]], [1]))
    slam.save(tmp_path / "map.kmk")
    with pytest.raises(MapError, match="give the robots to load"):
        km.Slam.load(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk", [rover(mine=km.Mount(sensor))])
    np.testing.assert_array_equal(again.mean(1), slam.mean(1))


def test_a_users_own_sensor_gives_the_map_of_the_built_in_one() -> None:
    mine = km.pointwise(
        lambda v: np.array([np.hypot(*v), np.arctan2(v[1], v[0])]),
        np.diag([0.1, 0.02]) ** 2,
        inverse=lambda y: y[0] * np.array([np.cos(y[1]), np.sin(y[1])]),
        angular=(False, True),
    )
    for estimator in (km.estimators.Ekf(), km.estimators.Invariant(), km.estimators.Fej()):
        slams = []
        for sensor in (mine, km.sensors.RangeBearing()):
            slam = km.Slam([rover(s=km.Mount(sensor))], estimator=estimator)
            slam.process(km.Control(0, "rover", (1.0, 0.2)))
            for t in range(4):
                slam.process(km.Scan(t, "rover", "s", [[5.0 - t, 0.1], [2.0, 3.1]], [1, 2]))
            slams.append(slam)
        np.testing.assert_allclose(slams[0].covariance("rover", 1, 2), slams[1].covariance("rover", 1, 2), atol=1e-7)
        np.testing.assert_allclose(slams[0].mean("rover"), slams[1].mean("rover"), atol=1e-6)


def test_a_landmark_known_beforehand_is_checked() -> None:
    slam = started()
    for arguments, message in (((1, (0, 0)), "in the map already"), ((9, (0, NAN)), "finite"), ((9, (0,)), "2 finite")):
        with pytest.raises(MapError, match=message):
            slam.add_landmark(*arguments)
    with pytest.raises(MapError, match="semidefinite"):
        slam.add_landmark(9, (0, 0), np.diag([1, -1]))
    assert ModelError.__mro__[1] is km.KalmarkError


def test_a_control_that_leads_nowhere_finite_is_refused_and_changes_nothing() -> None:
    car = km.Robot("car", km.motion.Ackermann(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    slam = km.Slam([car])
    slam.process(km.Control(0, "car", (1.0, float(np.arctan(2.83 / 0.76)))))  # the wheel would have to stand still
    before = state(slam)
    for event in (km.Control(1, "car", (1.0, 0.0)), km.Scan(1, "car", "lidar", [[2.0, 0.3]], [1])):
        slam_refuses = pytest.raises(EventError, match="expected a control that moves it somewhere finite")
        with slam_refuses:
            slam.process(event)
        assert state(slam) == before


def test_a_control_that_no_robot_can_follow_is_refused_before_it_is_held() -> None:
    for u, cov in (((1e16, 0.0), None), ((1.0, 0.0), np.diag([1e31, 1.0]))):
        with pytest.raises(
            EventError, match=r"control of 'rover' at t=1 s: (u|cov) holds 1e\+\d+, expected at most 1e\+"
        ):
            km.Control(1, "rover", u, cov)


def test_a_users_subclass_of_a_built_in_model_is_not_taken_for_it() -> None:
    class Biased(km.sensors.RangeBearing):
        def expect(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            e, E_v = super().expect(v)
            return e + np.array([1.0, 0.0]), E_v

    slam = km.Slam([rover(lidar=km.Mount(Biased()))])
    slam.add_landmark(1, (5.0, 0.0), np.eye(2))
    assert slam.process(km.Scan(0, "rover", "lidar", [[6.0, 0.0]], [1])).e[0, 0] == 6.0


def test_a_robots_heading_is_never_taken_for_a_signature() -> None:
    robots = [km.Robot(n, km.motion.Unicycle(), (x, 0, 1), {"s": signature()}) for n, x in (("a", 0), ("b", 3))]
    slam = km.Slam(robots)
    (seen,) = slam.process(km.Scan(0, "a", "s", [[3.0, -1.0, 2.5]], ["b"])).observations
    assert (seen.outcome, seen.reason) == ("rejected", "it is no point_signature")


@pytest.mark.parametrize("estimator", [km.estimators.Ekf(), km.estimators.Invariant(), km.estimators.Fej()])
def test_a_broken_covariance_ends_the_filter_instead_of_silencing_it(estimator: Any) -> None:
    slam = started(estimator=estimator)
    slam.map.P[0, 0] = -50
    with pytest.raises(DivergedError, match="not positive semidefinite"):
        slam.process(km.Scan(1.0, "rover", "lidar", [[2.0, 0.3]], [1]))


@pytest.mark.parametrize("estimator", [km.estimators.Ekf(), km.estimators.Invariant(), km.estimators.Fej()])
def test_a_measurement_beyond_all_numbers_is_refused_and_changes_nothing(estimator: Any) -> None:
    slam = started(estimator=estimator, association=km.association.ByIdentity("off"))
    before = slam.mean("rover"), slam.covariance("rover", 1)
    for event in (
        lambda: km.Scan(1.0, "rover", "lidar", [[1e200, 0.3]], [1]),
        lambda: km.Scan(1.0, "rover", "lidar", [[1e10, 0.3]], [1]),
        lambda: km.Fix(2.0, "rover", [1e200, 0], np.eye(2)),
    ):
        with pytest.raises(EventError, match=r"expected at most 1e\+"):
            slam.process(event())
    np.testing.assert_array_equal(slam.mean("rover"), before[0])
    np.testing.assert_array_equal(slam.covariance("rover", 1), before[1])


@pytest.mark.parametrize("estimator", [km.estimators.Invariant(1), km.estimators.Invariant(), km.estimators.Fej()])
def test_a_fix_of_a_lost_robot_is_as_certain_as_it_says(estimator: Any) -> None:
    rng, nees, cov = np.random.default_rng(4), [], np.diag([5.0, 5.0, np.radians(20)]) ** 2
    for _ in range(60):
        truth = rng.multivariate_normal(np.zeros(3), cov)
        slam = km.Slam([km.Robot("rover", km.motion.Unicycle(), cov=cov)], estimator=estimator)
        slam.process(km.Fix(0, "rover", truth[:2] + rng.normal(size=2) * 0.1, 0.01 * np.eye(2)))
        d = truth - slam.mean("rover")
        if estimator.coordinates == "log":
            d[:2] = km.geometry.V_inverse(d[2]) @ d[:2]
        nees.append(d @ np.linalg.solve(slam.covariance("rover"), d))
    assert 2.2 < np.mean(nees) < 4.0


@pytest.mark.parametrize("estimator", [km.estimators.Ekf(), km.estimators.Invariant(), km.estimators.Fej()])
def test_a_robot_that_is_not_connected_learns_nothing_from_the_other(estimator: Any) -> None:
    cov = np.diag([0.5, 0.5, 0.4]) ** 2
    lidar = {"lidar": km.Mount(km.sensors.RangeBearing())}
    slam = km.Slam([km.Robot(n, km.motion.Unicycle(), (0, 0, 0.3), lidar, cov) for n in "ab"], estimator=estimator)
    before = slam.mean("b").tobytes(), slam.covariance("b").tobytes()
    rng = np.random.default_rng(1)
    for t in range(50):
        y = np.array([[3.0, 0.4], [4.0, -1.0], [2.0, 2.0]]) + rng.normal(size=(3, 2)) * [0.1, 0.02]
        slam.process(km.Scan(t, "a", "lidar", y, [1, 2, 3]))
    assert (slam.mean("b").tobytes(), slam.covariance("b").tobytes()) == before


def test_a_landmark_is_where_its_model_says() -> None:
    slam = started()
    for name in ("rover", 1):
        where, P = slam.place(name)
        np.testing.assert_array_equal(where, slam.mean(name)[:2])
        np.testing.assert_array_equal(P, slam.covariance(name)[:2, :2])

    camera = km.Mount(km.sensors.Bearing(), landmark=km.landmarks.InverseDepth2D(prior_rho_per_m=0.5))
    slam = km.Slam([rover(eye=camera)])
    slam.process(km.Control(0.0, "rover", (0.5, 0.1)))
    slam.process(km.Scan(1.0, "rover", "eye", [[0.3]], [1]))
    x, y, bearing, rho = slam.mean(1)
    c, s = np.cos(bearing) / rho, np.sin(bearing) / rho
    P_l = np.array([[1, 0, -s, -c / rho], [0, 1, c, -s / rho]])
    where, P = slam.place(1)
    np.testing.assert_allclose(where, (x + c, y + s), atol=1e-12)
    np.testing.assert_allclose(P, P_l @ slam.covariance(1) @ P_l.T, atol=1e-12)


class Around:
    """A point of the plane by its direction from the origin and its distance, which has no position."""

    kind = "around"
    space = Space("around", (HEADING, SCALAR))

    def seen_from(self, T: Any, l: Any) -> Any:
        p, P_l = around(l)
        v, V_T, V_p = km.landmarks.Point2D().seen_from(T, p)
        return v, V_T, V_p @ P_l

    def from_view(self, T: Any, v: Any) -> Any:
        p, P_T, P_v = km.landmarks.Point2D().from_view(T, v)
        l = np.column_stack([np.arctan2(p[:, 1], p[:, 0]), np.hypot(p[:, 0], p[:, 1])])
        L_p = np.linalg.inv(around(l)[1])
        return l, L_p @ P_T, L_p @ P_v


class AroundPlaced(Around):
    """The same, which does."""

    def place(self, l: Any) -> Any:
        return around(l)


def around(l: Any) -> tuple[Any, Any]:
    c, s, d = np.cos(l[:, 0]), np.sin(l[:, 0]), l[:, 1]
    return np.stack([d * c, d * s], axis=1), np.stack([np.stack([-d * s, d * c], 1), np.stack([c, s], 1)], axis=2)


def test_a_user_s_landmark_is_where_its_place_says_and_so_in_the_tables() -> None:
    slam = started(landmarks=AroundPlaced())
    where, P = slam.place(1)
    (angle, distance), P_l = slam.mean(1), around(slam.mean(1)[None])[1][0]
    np.testing.assert_allclose(where, (distance * np.cos(angle), distance * np.sin(angle)))
    np.testing.assert_allclose(P, P_l @ slam.covariance(1) @ P_l.T)
    header, row, *_ = MapLandmarks.of(slam).to_csv().splitlines()
    assert header.split(",")[2:4] == ["x_m", "y_m"]
    np.testing.assert_allclose([float(x) for x in row.split(",")[2:4]], where)
    with pytest.raises(MapError, match="1 is a around, which has no position"):
        started(landmarks=Around()).place(1)
