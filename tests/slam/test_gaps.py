"""Controls that stop: noticed, and bridged by what the robot may have done meanwhile."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hall import alarmed, hall, mapped, right

import kalmark as km
from kalmark.association.relocalization import align_points
from kalmark.batch.motion_chain import Chain
from kalmark.diagnosis.verdict import diagnose
from kalmark.errors import EventError, ModelError
from kalmark.report import Gap

STEP = (0.08, 0.0, 0.02)  # an increment each tenth of a second: .8 m/s and .2 rad/s
LASER = {"laser": km.Mount(km.sensors.RangeBearing(0.03, 0.01))}


def driven(motion: Any, u: tuple[float, ...], **of_robot: object) -> km.Slam:
    """Return the filter of a robot after 40 controls, the last of them at 4 s."""
    slam = km.Slam([km.Robot("r", motion, sensors=LASER, **of_robot)])  # type: ignore[arg-type]
    for k in range(1, 41):
        slam.process(km.Control(0.1 * k, "r", u))
    return slam


def odometer(**of_robot: object) -> km.Slam:
    return driven(km.motion.Odometry2D(), STEP, **of_robot)


def test_an_increment_that_comes_late_widens_the_pose_by_the_motion_that_was_possible() -> None:
    slam = odometer()
    before = slam.covariance("r")
    report = slam.process(km.Control(7.0, "r", STEP))
    (gap,) = report.gaps
    assert (gap.robot, gap.kind, gap.start_ns, gap.end_ns) == ("r", "increments", 4_000_000_000, 7_000_000_000)
    lost_s = 2.9  # the late increment is of the last tenth
    assert gap.sigma_m == pytest.approx(1.2 * 0.8 * lost_s / 2, rel=1e-3)  # uniform in a disc
    assert gap.sigma_rad == pytest.approx(1.2 * 0.2 * lost_s / math.sqrt(3), rel=1e-3)  # uniform to both sides
    grown = np.diag(slam.covariance("r") - before)
    np.testing.assert_allclose(grown, [gap.sigma_m**2, gap.sigma_m**2, gap.sigma_rad**2], rtol=0.05)


def test_the_limits_of_the_robot_replace_those_of_the_log() -> None:
    slam = odometer(max_speed_mps=2.0, max_turn_radps=10.0)
    (gap,) = slam.process(km.Control(7.0, "r", STEP)).gaps
    assert gap.sigma_m == pytest.approx(2.0 * 2.9 / 2)
    assert gap.sigma_rad == pytest.approx(math.pi / math.sqrt(3))  # any heading


def test_an_increment_of_the_whole_gap_is_no_gap() -> None:
    slam = odometer()
    assert slam.process(km.Control(7.0, "r", (2.4, 0.0, 0.6))).gaps == ()
    assert slam.covariance("r")[0, 0] < 0.2


def test_a_velocity_that_is_held_too_long_is_noticed_at_the_next_scan() -> None:
    slam = driven(km.motion.Unicycle(0.01, 0.01), (0.8, 0.2))
    assert slam.process(km.Scan(4.3, "r", "laser", [[3.0, 0.1]], [1])).gaps == ()
    (gap,) = slam.process(km.Scan(7.1, "r", "laser", [], None)).gaps
    assert (gap.kind, gap.start_ns, gap.end_ns) == ("held", 4_000_000_000, 7_100_000_000)
    assert gap.sigma_m == pytest.approx(1.2 * 0.8 * 3.0 / 2, rel=1e-2)  # about the motion that is held


def test_a_gap_is_as_wide_for_a_robot_with_more_than_a_pose_and_for_one_that_counts_its_wheels() -> None:
    unicycle, slipping = (
        driven(motion, (0.8, 0.2)).process(km.Scan(7.1, "r", "laser", [], None)).gaps[0]
        for motion in (km.motion.Unicycle(0.01, 0.01), km.motion.SlippingUnicycle(0.01, 0.01))
    )
    assert (slipping.sigma_m, slipping.sigma_rad) == pytest.approx((unicycle.sigma_m, unicycle.sigma_rad))
    wheels = driven(km.motion.DifferentialDrive(0.1, 0.1, 0.5), (0.75, 0.85))  # 0.8 m/s, 0.2 rad/s
    (gap,) = wheels.process(km.Control(7.0, "r", (0.75, 0.85))).gaps
    (same,) = odometer().process(km.Control(7.0, "r", STEP)).gaps
    assert (gap.sigma_m, gap.sigma_rad) == pytest.approx((same.sigma_m, same.sigma_rad), rel=1e-3)


def test_a_gap_grows_as_one_while_scans_go_on_without_a_landmark() -> None:
    slam = odometer()
    parts = [gap for t in (5.0, 6.0, 7.0) for gap in slam.process(km.Scan(t, "r", "laser", [], None)).gaps]
    parts += slam.process(km.Control(7.0, "r", STEP)).gaps
    whole = odometer().process(km.Scan(7.0, "r", "laser", [], None)).gaps[0]
    assert math.hypot(*(part.sigma_m for part in parts)) == pytest.approx(whole.sigma_m)


def test_a_gap_is_refused_where_that_is_asked_for_and_nothing_changes() -> None:
    slam = odometer(gaps="refuse")
    mean, P = slam.mean("r"), slam.covariance("r")
    with pytest.raises(EventError, match=r"'r' had no control for 3 s from t=4 s on, expected one every 0\.1 s"):
        slam.process(km.Control(7.0, "r", STEP))
    assert np.array_equal(slam.mean("r"), mean)
    assert np.array_equal(slam.covariance("r"), P)
    slam.process(km.Control(4.1, "r", STEP))  # the clock was put back


def test_a_gap_that_is_ignored_is_reported_all_the_same() -> None:
    (gap,) = odometer(gaps="ignore").process(km.Control(7.0, "r", STEP)).gaps
    assert gap == Gap("r", "increments", 4_000_000_000, 7_000_000_000, 0.0, 0.0)


def test_what_is_no_way_to_take_a_gap_is_refused() -> None:
    with pytest.raises(ModelError, match="gaps is 'bridge', expected one of refuse, widen, ignore"):
        odometer(gaps="bridge")
    with pytest.raises(ModelError, match="max_speed_mps is -1"):
        odometer(max_speed_mps=-1.0)


def test_a_saved_filter_notices_the_same_gap(tmp_path: Path) -> None:
    slam = odometer()
    slam.save(tmp_path / "map.kmk")
    resumed = km.Slam.load(tmp_path / "map.kmk")
    late = km.Control(7.0, "r", STEP)
    assert resumed.process(late).gaps == slam.process(late).gaps
    assert np.array_equal(resumed.covariance("r"), slam.covariance("r"))


def test_points_seen_from_a_pose_give_it_back() -> None:
    rng = np.random.default_rng(0)
    T, v = np.array([3.0, -2.0, 3.0]), rng.uniform(-5, 5, (4, 2))
    l = km.geometry.from_frame(T, v)[0]
    np.testing.assert_allclose(align_points(v, l, np.array([1.0, 2.0, 0.5, 1.0])), T, atol=1e-12)


@pytest.mark.parametrize("held", [False, True])
def test_a_robot_lost_in_a_gap_finds_its_place_in_the_hall_again(held: bool) -> None:
    log = hall(4, gap_s=16.0, held=held)
    run = mapped(log, held)
    assert right(run, log)
    assert not alarmed(run)
    (gap,) = run.evaluate()["gaps"]
    assert gap["end_s"] - gap["start_s"] == pytest.approx(16.0, abs=0.2)
    assert gap["known_s"] - gap["end_s"] < 1.0
    assert any("of rover" in line for line in run.evaluate()["notes"])


def test_a_robot_lost_among_pillars_in_rows_waits_until_its_scan_fits_in_one_place_only() -> None:
    log = hall(2, gap_s=8.0, rows=True)
    run = mapped(log)
    assert right(run, log)
    (gap,) = run.evaluate()["gaps"]
    assert gap["known_s"] - gap["end_s"] > 20.0
    names = [cause.name for cause in diagnose(run, brief=True).causes if not cause.harmless]
    assert names[0] == "odometry_turn", "the right wheel is 1 % larger"
    assert "misfit" not in names, "what was left open meanwhile contradicts nothing"
    early = replace(log, events=[e for e in log.events if e.t_ns < gap["known_s"] * 1e9 - 10e9])
    verdict = diagnose(mapped(early), brief=True)
    assert (verdict.map, verdict.causes[0].name) == ("doubtful", "gap")
    assert verdict.causes[0].evidence.endswith("and it was not localized again")


@pytest.mark.parametrize("gap_s", [4.0, 8.0])  # after the first the heading is not known so badly yet that it is lost
def test_a_robot_whose_heading_is_unknown_is_not_kept_where_a_scan_in_rows_fitted_by_chance(gap_s: float) -> None:
    log = hall(8, gap_s, rows=True)
    run = mapped(log)
    assert right(run, log)
    assert [gap.kind for gap in run.history.gaps] == ["increments"]  # it was not elsewhere than its covariance allows


def adrift() -> km.Slam:
    """Return the filter of a robot that may be anywhere, heading any way, since a gap."""
    robot = km.Robot("r", km.motion.Odometry2D(), sensors=LASER, max_speed_mps=1.0, max_turn_radps=10.0)
    slam = km.Slam([robot], km.association.Automatic())
    for k in range(1, 41):
        slam.process(km.Control(0.1 * k, "r", STEP))
    slam.process(km.Control(7.0, "r", STEP))
    return slam


def test_a_robot_adrift_takes_no_single_landmark_for_the_only_one_near_it() -> None:
    slam = adrift()
    ahead = km.geometry.from_frame(slam.mean("r"), np.array([[1.0, 0.0], [90.0, 5.0], [90.0, 9.0]]))[0]
    for i, point in enumerate(ahead):
        slam.add_landmark(i, point, 1e-4 * np.eye(2))
    (seen,) = slam.process(km.Scan(7.0, "r", "laser", [[1.0, 0.0]])).observations
    assert seen.outcome != "associated"


@pytest.mark.parametrize("built_alike", [False, True])
def test_a_robot_adrift_is_only_moved_to_where_its_scan_is_recognised(built_alike: bool) -> None:
    slam, truth = adrift(), np.array([1.5, -1.0, -2.0])
    place = np.array([[5.5, -1.0], [4.5, 2.0], [-0.5, 1.5], [0.5, -5.0], [3.5, -4.0]])
    again = km.geometry.from_frame(np.array([8.0, 3.0, 2.0]), place[:4])[0]
    for i, point in enumerate(np.vstack([place, again]) if built_alike else place):
        slam.add_landmark(i, point, 1e-4 * np.eye(2))
    before = slam.mean("r")
    for k in range(2):
        slam.process(km.Scan(7.0 + 0.001 * k, "r", "laser", km.geometry.observe(truth, place)[0]))
    report = slam.process(km.Scan(7.002, "r", "laser", km.geometry.observe(truth, place)[0]))
    assert {o.outcome for o in report.observations} == {"deferred" if built_alike else "associated"}
    np.testing.assert_allclose(slam.mean("r"), before if built_alike else truth, atol=0.03)


def test_a_robot_that_turns_for_the_first_time_after_a_gap_has_a_gap() -> None:
    slam = odometer()
    turning = km.Control(7.0, "r", (0.08, 0.0, 0.1))  # five times as much as in any tenth before
    assert len(slam.process(turning).gaps) == 1


def test_after_a_gap_that_is_ignored_a_robot_is_found_by_its_landmarks_and_it_is_warned_of() -> None:
    log = hall(4, gap_s=4.0)
    run = mapped(log, gaps="ignore")
    assert len(run.landmarks) < 30
    assert [gap.kind for gap in run.history.gaps][-1] == "elsewhere"
    assert alarmed(run)


def jump_of(slam: km.Slam, u: tuple[float, ...], t_s: float = 4.1) -> km.Report:
    return slam.process(km.Control(t_s, "r", u))


def test_an_increment_beyond_the_limits_of_the_robot_is_left_out_and_bridged() -> None:
    slam = odometer(max_speed_mps=1.0, max_turn_radps=1.0)
    mean, before = slam.mean("r"), slam.covariance("r")
    (gap,) = jump_of(slam, (-7.0, 2.0, 1.0)).gaps
    assert (gap.kind, gap.start_ns, gap.end_ns) == ("ruled_out", 4_000_000_000, 4_100_000_000)
    np.testing.assert_array_equal(slam.mean("r"), mean)
    grown = np.diag(slam.covariance("r") - before)
    np.testing.assert_allclose(grown, [(0.1 / 2) ** 2] * 2 + [0.1**2 / 3], rtol=1e-6)  # what it may have done
    assert slam.process(km.Control(4.2, "r", STEP)).gaps == ()
    assert slam.mean("r")[0] != mean[0]


def test_a_velocity_beyond_the_limits_is_left_out_until_the_next_control() -> None:
    limits, scan = {"max_speed_mps": 1.0, "max_turn_radps": 1.0}, km.Scan(4.5, "r", "laser", [], None)
    slam, held = (driven(km.motion.Unicycle(0.01, 0.01), (0.8, 0.2), **limits) for _ in range(2))
    assert jump_of(slam, (30.0, 0.0)).gaps == ()  # nothing has asked for its pose yet
    (gap,) = slam.process(scan).gaps
    assert (gap.kind, gap.start_ns, gap.end_ns) == ("ruled_out", 4_100_000_000, 4_500_000_000)
    assert gap.sigma_m == pytest.approx(0.4 / 2)
    held.process(scan)
    np.testing.assert_allclose(slam.mean("r"), held.mean("r"), atol=1e-9)  # the control before is held
    assert slam.process(km.Control(4.6, "r", (0.8, 0.2))).gaps[0].end_ns == 4_600_000_000
    assert slam.process(km.Scan(4.7, "r", "laser", [], None)).gaps == ()


def test_no_control_is_beyond_limits_that_are_not_given_or_nearly_kept() -> None:
    assert jump_of(odometer(), (-7.0, 2.0, 1.0)).gaps == ()
    limits = {"max_speed_mps": 1.0, "max_turn_radps": 1.0}
    assert jump_of(odometer(**limits), (0.14, 0.0, 0.0)).gaps == ()  # 1.4 m/s
    assert jump_of(odometer(**limits, gaps="ignore"), (-7.0, 2.0, 1.0)).gaps == ()


def test_a_control_beyond_the_limits_is_refused_where_that_is_asked_for() -> None:
    slam = odometer(max_speed_mps=1.0, gaps="refuse")
    mean = slam.mean("r")
    with pytest.raises(EventError, match=r"expected at most 1\.0 m/s"):
        jump_of(slam, (-7.0, 2.0, 1.0))
    np.testing.assert_array_equal(slam.mean("r"), mean)
    assert jump_of(slam, STEP).gaps == ()


def test_a_control_that_was_left_out_is_kept_in_a_file(tmp_path: Path) -> None:
    slam = driven(km.motion.Unicycle(0.01, 0.01), (0.8, 0.2), max_speed_mps=1.0)
    jump_of(slam, (30.0, 0.0))
    slam.save(tmp_path / "map.kmk")
    again = km.Slam.load(tmp_path / "map.kmk")
    scan = km.Scan(4.5, "r", "laser", [], None)
    assert again.process(scan).gaps == slam.process(scan).gaps
    np.testing.assert_array_equal(again.covariance("r"), slam.covariance("r"))


def test_what_is_usual_of_controls_is_known_after_a_part_that_is_left_out() -> None:
    robot = km.Robot("r", km.motion.Unicycle(0.1, 0.05))
    chain = Chain({"r": robot}, {}, {})
    chain.node_at("r", 0)

    def drive(begin_s: float, end_s: float) -> None:
        for t_s in np.arange(begin_s, end_s, 0.1):
            chain.take(km.Control(t_s=float(t_s), robot="r", u=(0.5, 0.0)))

    drive(0.0, 5.0)
    chain.lose("r")
    drive(100.0, 100.5)
    chain.node_at("r", 100_500_000_000)
    drive(106.5, 107.0)  # after a gap of 6 s
    chain.node_at("r", 107_000_000_000)
    lost, gap = (np.sqrt(chain.nodes[k].Q[of, 0, 0]) for k, of in ((-2, -1), (-1, -2)))
    assert lost > 100.0  # it may have come from anywhere,
    assert 1.0 < gap < 10.0  # and have driven by so much
