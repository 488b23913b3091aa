"""After an error the state is what it was; what does not fit is left out alone; only what is lost for good ends."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from state_digest import digest

import kalmark as km
from kalmark.errors import DivergedError, EventError, MapError, ModelError
from kalmark.report import INDEFINITE
from kalmark.slam.starting import SINGULAR

ESTIMATORS = [km.estimators.Ekf(), km.estimators.Invariant(), km.estimators.Fej()]
MAPS = ["dense", "postponed"]
LIDAR = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1, sigma_bearing_rad=0.02))
PLACES = {i: (4.0 + i, 2.0 * i - 3.0) for i in range(4)}


def seen(ids: list[Any], t_s: float = 1.0, robot: str = "a") -> km.Scan:
    """Return a scan of surveyed landmarks from the origin."""
    y = [[np.hypot(*PLACES[i]), np.arctan2(*PLACES[i][::-1])] for i in ids]
    return km.Scan(t_s, robot, "lidar", y, ids)


def surveyed(estimator: Any, map_: str, **robot: Any) -> km.Slam:
    start: dict[str, Any] = {"motion": km.motion.Unicycle(), "sensors": {"lidar": LIDAR}, "cov": 1e-2 * np.eye(3)}
    slam = km.Slam(km.Robot("a", **(start | robot)), estimator=estimator, map=map_)
    for name, place in PLACES.items():
        slam.add_landmark(name, place, 1e-2 * np.eye(2))
    return slam


@pytest.mark.parametrize("map_", MAPS)
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_an_observation_whose_covariance_is_none_is_rejected_alone(estimator: Any, map_: str) -> None:
    slam, whole = surveyed(estimator, map_), surveyed(estimator, map_)
    index = slam.map.index(slam.slot(2))
    m = slam.map if map_ == "dense" else slam.map.active  # type: ignore[attr-defined]
    whole.map.index(whole.slot(2))
    m.P[index, index] = -50.0
    report = slam.process(seen([0, 1, 2, 3]))
    assert [o.outcome for o in report.observations] == ["associated", "associated", "rejected", "associated"]
    assert report.observations[2].reason == INDEFINITE and report.observations[2].d2 is None
    whole.process(seen([0, 1, 3]))
    np.testing.assert_array_equal(slam.mean("a"), whole.mean("a"))
    apart = slam.covariance("a", 0, 1, 3) - whole.covariance("a", 0, 1, 3)  # sums of another order
    np.testing.assert_allclose(apart, 0.0, atol=1e-17)


@pytest.mark.parametrize("map_", MAPS)
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_robot_without_a_covariance_is_lost_and_the_error_says_what_would_help(estimator: Any, map_: str) -> None:
    for variance, fault in ((-50.0, "is not positive semidefinite: .* -5e"), (np.nan, "is not finite")):
        slam = surveyed(estimator, map_)
        at = slam.map.index(slam.slot("a"))
        m = slam.map if map_ == "dense" else slam.map.active  # type: ignore[attr-defined]
        m.P[at[0], at[0]] = variance
        with pytest.raises(
            DivergedError, match=rf"^scan at t=1 s: the covariance of 'a' {fault}.*; start again .*sigmas.*$"
        ):
            slam.process(seen([0, 1]))


@pytest.mark.parametrize("estimator", ESTIMATORS[1:])
def test_observations_that_are_valid_only_one_by_one_are_fused_so(estimator: Any) -> None:
    slam = surveyed(estimator, "dense")
    a, b = slam.map.index(slam.slot(0)), slam.map.index(slam.slot(1))
    slam.map.P[b[:, None], a] = 10.0 * np.eye(2)  # type: ignore[attr-defined] # more than their variances let them share
    report = slam.process(seen([0, 1]))
    assert report.observations[0].outcome == "associated"
    assert report.observations[1].outcome == "rejected" and report.observations[1].reason == INDEFINITE
    assert np.isfinite(slam.covariance("a")).all()


class Singular(km.association.ByIdentity):
    """An association that meets a singular matrix."""

    def associate(self, query: Any) -> Any:
        """Fail."""
        raise np.linalg.LinAlgError("Singular matrix")


def test_where_an_association_cannot_be_computed_only_ids_say_what_was_observed() -> None:
    slam = km.Slam(km.Robot("a", km.motion.Unicycle(), sensors={"lidar": LIDAR}), Singular())
    slam.add_landmark(0, PLACES[0], np.eye(2))
    y = seen([0, 1, 2]).y
    first, second, third = slam.process(km.Scan(1.0, "a", "lidar", y, [0, 1, None])).observations
    assert (first.outcome, second.outcome, third.outcome) == ("associated", "new", "ignored")
    assert third.reason == SINGULAR


class Broken(km.estimators.Ekf):
    """An estimator that meets a singular matrix."""

    def correct(self, map_: Any, update: Any) -> Any:
        """Fail."""
        raise np.linalg.LinAlgError("Singular\nmatrix")


def test_a_bare_linalgerror_never_comes_out() -> None:
    slam = surveyed(Broken(), "dense")
    with pytest.raises(DivergedError, match=r"^scan at t=1 s: Singular matrix; start again .*sigmas") as refused:
        slam.process(seen([0]))
    assert "\n" not in str(refused.value)


class Wild(km.motion.Odometry2D):
    """Odometry whose increments of more than a metre lead nowhere."""

    def move(self, r: Any, u: Any, dt_s: float) -> Any:
        """Return no number beyond a metre."""
        moved, F, R_u = super().move(r, u, dt_s)
        return (moved if abs(u[0]) <= 1.0 else np.full(3, np.nan)), F, R_u


@pytest.mark.parametrize("map_", MAPS)
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_an_increment_after_a_gap_is_checked_before_the_map_moves(estimator: Any, map_: str) -> None:
    slam = surveyed(estimator, map_, motion=Wild(0.1, 0.1, 0.1))
    for k in range(60):
        slam.process(km.Control(0.1 * k, "a", (0.01, 0.0, 0.0)))
    before = digest(slam)
    for _ in range(2):
        with pytest.raises(EventError, match="expected a control that moves it somewhere finite"):
            slam.process(km.Control(20.0, "a", (2.0, 0.0, 0.0)))
        assert digest(slam) == before
    (gap,) = slam.process(km.Control(20.0, "a", (0.01, 0.0, 0.0))).gaps
    assert gap.lasts_s == pytest.approx(20.0 - 5.9)


@pytest.mark.parametrize("map_", MAPS)
def test_a_scan_that_moves_several_robots_moves_all_or_none(map_: str) -> None:
    robots = [
        km.Robot(name, km.motion.Unicycle(), (x, 0, 0), {"lidar": LIDAR}, gaps=gaps)
        for name, x, gaps in (("a", 0.0, "widen"), ("b", 3.0, "refuse"))
    ]
    slam = km.Slam(robots, map=map_)
    for k in range(60):
        for name in "ab":
            slam.process(km.Control(0.1 * k, name, (0.5, 0.1)))
    slam.process(km.Scan(5.95, "a", "lidar", [[3.0, 0.0]], ["b"]))
    before = digest(slam)
    with pytest.raises(EventError, match="'b' had no control for"):
        slam.process(km.Scan(30.0, "a", "lidar", [[3.0, 0.0]], ["b"]))
    assert digest(slam) == before


@pytest.mark.parametrize("map_", MAPS)
def test_fej_starts_landmarks_from_a_mount_that_is_uncertain(map_: str) -> None:
    mount = km.Mount(km.sensors.RangeBearing(0.05, 0.01), at=(0.3, 0.0, 0.0), cov=1e-2 * np.eye(3))
    estimator = km.estimators.Fej()
    slam = surveyed(estimator, map_, sensors={"lidar": mount})
    slam.process(km.Control(0.0, "a", (0.5, 0.1)))
    slam.process(seen([0, 1, 2, 3]))
    (new,) = slam.process(km.Scan(1.5, "a", "lidar", [[5.0, 0.4]], [9])).observations
    assert new.outcome == "new"
    assert (np.linalg.eigvalsh(slam.covariance("a", 9)) > 0).all()
    J, robot = np.arange(12.0).reshape(2, 6), slam.slot("a")
    moved = estimator.pose_jacobian(slam.map, robot, J)
    np.testing.assert_array_equal(moved[:, :3], estimator.pose_jacobian(slam.map, robot, J[:, :3]))
    np.testing.assert_array_equal(moved[:, 3:], J[:, 3:])


def test_a_landmark_with_the_name_of_an_inner_block_is_refused_wherever_it_comes_from() -> None:
    slam = surveyed(km.estimators.Invariant(), "dense")
    before = digest(slam)
    for name in ("a bias", "a.lidar"):
        with pytest.raises(EventError, match="names a robot's bias or mount"):
            slam.process(km.Scan(1.0, "a", "lidar", [[1.0, 0.0]], [name]))
        with pytest.raises(MapError, match="names a robot's bias or mount"):
            slam.add_landmark(name, (1.0, 0.0))
    assert digest(slam) == before


def test_a_scan_of_more_observations_than_a_map_can_take_is_refused_and_changes_nothing() -> None:
    mount = km.Mount(km.sensors.RangeBearing())
    slam = km.Slam([km.Robot("a", km.motion.Unicycle(sigma_v_mps=0.1), sensors={"lidar": mount})])
    before = digest(slam)
    with pytest.raises(EventError, match="1000000 observations, expected at most 5000 in one scan"):
        slam.process(km.Scan(t_s=1.0, robot="a", sensor="lidar", y=np.ones((1_000_000, 2))))
    assert digest(slam) == before


def test_a_large_variance_hides_no_negative_one() -> None:
    slam = km.Slam(km.Robot("r", km.motion.Odometry3D()))
    before = slam.covariance("r")
    cov = np.diag([-1.0, 1e-300, 1e-12, 1e6, 1e9, 1.0])
    with pytest.raises(EventError, match="has the eigenvalue -1, expected a positive semidefinite"):
        slam.process(km.Control(t_s=0.0, robot="r", u=np.ones(6), cov=cov))
    np.testing.assert_array_equal(slam.covariance("r"), before)
    cov[0] = 0.0
    slam.process(km.Control(t_s=0.0, robot="r", u=np.ones(6), cov=cov))
    assert np.linalg.eigvalsh(slam.covariance("r"))[0] > -1e-9 * np.abs(slam.covariance("r")).max()


def test_a_user_s_noise_of_another_shape_is_refused_and_changes_nothing() -> None:
    class OneNumber(km.sensors.RangeBearing):
        def noise(self, y: np.ndarray) -> np.ndarray:
            return np.eye(2)

    class Wheels(km.motion.Unicycle):
        def control_noise(self, u: np.ndarray) -> np.ndarray:
            return np.eye(3)

    slam = km.Slam(km.Robot("a", km.motion.Unicycle(), sensors={"lidar": km.Mount(OneNumber())}))
    before = digest(slam)
    wanted = r"a.lidar, OneNumber: noise of 3 measurements has shape \(2, 2\), expected \(3, 2, 2\)"
    with pytest.raises(EventError, match=wanted):
        slam.process(km.Scan(t_s=1.0, robot="a", sensor="lidar", y=np.ones((3, 2)), ids=[1, 2, 3]))
    assert digest(slam) == before
    with pytest.raises(ModelError, match=r"'a': motion: control_noise has shape \(3, 3\), expected \(2, 2\)"):
        km.Robot("a", Wheels())
