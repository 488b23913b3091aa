"""Increments cut at the scans between their ends: the parts make the whole, and each scan finds its robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import kalmark as km
from kalmark import Control, Scan
from kalmark.config.building import build_slam
from kalmark.config.opening import open_run
from kalmark.diagnosis.jumps import Controls
from kalmark.diagnosis.repeated_events import copies
from kalmark.errors import EventError
from kalmark.events import Event
from kalmark.geometry import frames, frames3d
from kalmark.logs.increments import CUT, cut_increments, part_of, unevenness
from kalmark.logs.log import Log, begins_at
from kalmark.logs.overflow import overflows
from kalmark.models.observe import step, step_of
from kalmark.slam.held_control import control_covariance

PLANE, SPACE, WHEELS = CUT
WHOLE = {PLANE: [0.4, 0.1, 0.9], SPACE: [0.4, 0.1, -0.2, 0.3, -0.5, 0.7], WHEELS: [2.0, 3.1]}
MOTIONS = {PLANE: km.motion.Odometry2D, SPACE: km.motion.Odometry3D, WHEELS: km.motion.DifferentialDrive}


def log_of(events: list[Event], columns: tuple[str, ...] = PLANE, robots: tuple[str, ...] = ("rover",)) -> Log:
    return Log("test", robots, events, "native", control_columns=dict.fromkeys(robots, columns))


def drive(*scans_s: float, number: int = 8) -> list[Event]:
    """Return increments of a second each, and scans at times."""
    steps: list[Event] = [Control(k, "rover", WHOLE[PLANE]) for k in range(1, number + 1)]
    return [*steps, *(Scan(t_s, "rover", "laser", [[4.0, 0.2]], ids=[1]) for t_s in scans_s)]


@pytest.mark.parametrize("columns", CUT)
def test_parts_make_the_whole(columns: tuple[str, ...]) -> None:
    u = np.array(WHOLE[columns])
    model = step_of(MOTIONS[columns]())
    parts = [part_of(u, columns, share) for share in (0.2, 0.5, 0.3)]
    start = np.array([1.0, 2.0, 0.3]) if columns != SPACE else frames3d.move(np.eye(1, 7, 6)[0], u)[0]
    pose = start
    for part, share in zip(parts, (0.2, 0.5, 0.3), strict=True):
        pose = step(model, pose, part, share)[0]
    assert_allclose(pose, step(model, start, u, 1.0)[0], atol=1e-12)


def test_half_of_a_turn_ends_on_its_circle() -> None:
    """A quarter of a circle of radius 1, as an increment, is (1, 1, 90 deg); its half is at 45 deg on the circle."""
    half = part_of(np.array([1.0, 1.0, np.pi / 2]), PLANE, 0.5)
    assert_allclose(half, [np.sqrt(0.5), 1 - np.sqrt(0.5), np.pi / 4], atol=1e-12)


def test_a_scan_within_an_increment_cuts_it() -> None:
    found = [e for e in cut_increments(log_of(drive(2.25, 2.75, 5.0))) if isinstance(e, Control)]
    assert [e.t_s for e in found] == [1, 2, 2.25, 2.75, 3, 4, 5, 6, 7, 8]
    assert [e.share for e in found] == [1, 1, 0.25, 0.5, 0.25, 1, 1, 1, 1, 1]


def test_parts_share_the_noise_of_the_whole() -> None:
    motion, N = km.motion.Odometry2D(sigma_x_m=0.1, sigma_y_m=0.2, sigma_theta_rad=0.3), np.diag([4.0, 5.0, 6.0])
    for cov, whole in ((None, np.diag([0.01, 0.04, 0.09])), (N, N)):
        events: list[Event] = [Control(k, "rover", WHOLE[PLANE], cov) for k in (1, 2, 3)]
        found = [e for e in cut_increments(log_of([*events, *drive(1.3, 1.6, number=0)])) if isinstance(e, Control)]
        assert_allclose(sum(control_covariance(motion, e) for e in found if 1 < e.t_s <= 2), whole)


@pytest.mark.parametrize(("a", "b"), [(0.0, 0.3), (0.3, 0.5), (0.5, 1.0), (0.1, 0.9)])
def test_unevenness_is_that_of_a_step_at_any_time(a: float, b: float) -> None:
    s = (np.arange(100_000) + 0.5) / 100_000  # when the rate falls from 1 to 0: the whole is s
    part = np.clip(s, a, b) - a
    assert_allclose(unevenness(a, b), np.mean((part - (b - a) * s) ** 2), rtol=1e-4)


def test_a_turn_that_begins_within_an_increment_makes_its_parts_uncertain() -> None:
    turn = [[0.4, 0.0, w] for w in (0.0, 0.0, 0.0, 0.5, 1.0, 1.0, 1.0)]
    events: list[Event] = [Control(k, "rover", u) for k, u in enumerate(turn, start=1)]
    found = cut_increments(log_of([*events, *drive(2.5, 3.5, 6.5, number=0)]))
    more = {e.t_s: e.uneven[2] for e in found if isinstance(e, Control) and e.uneven is not None}
    assert_allclose(
        [more[t_s] for t_s in (2.5, 3.0, 3.5, 4.0, 6.5, 7.0)], np.array([0, 0, 1, 1, 0, 0]) / 48, atol=1e-12
    )


@pytest.mark.parametrize(
    "part",
    [{"share": 0.5, "uneven": u} for u in ([1.0], [-1.0, 0.0, 0.0], 3.0)] + [{"uneven": [1.0] * 3}, {"share": 2}],
)
def test_a_part_that_is_none_is_refused_and_changes_nothing(part: dict[str, Any]) -> None:
    slam = km.Slam([km.Robot("rover", km.motion.Odometry2D())])
    slam.process(Control(0.0, "rover", WHOLE[PLANE]))
    before = slam.mean("rover"), slam.covariance("rover")
    with pytest.raises(EventError, match=r"t=1 s: (uneven|share) is .*, expected"):
        slam.process(Control(1.0, "rover", WHOLE[PLANE], **part))
    assert_allclose(slam.mean("rover"), before[0], rtol=0)
    assert_allclose(slam.covariance("rover"), before[1], rtol=0)


@pytest.mark.parametrize(
    "motion", [km.motion.Unicycle(), km.motion.Inertial(), km.motion.ConstantTurnRate()], ids=lambda m: type(m).__name__
)
def test_a_part_of_rates_is_refused_and_changes_nothing(motion: Any) -> None:
    slam = km.Slam([km.Robot("rover", motion)])
    u = np.full(len(motion.columns), 0.1)
    slam.process(Control(0.0, "rover", u))
    before = slam.mean("rover"), slam.covariance("rover")
    with pytest.raises(
        EventError, match=r"t=1 s: share is 0.5, expected 1: the controls .+ are no increments of a pose, and only"
    ):
        slam.process(Control(1.0, "rover", u, share=0.5, uneven=np.ones(len(u))))
    assert_allclose(slam.mean("rover"), before[0], rtol=0)
    assert_allclose(slam.covariance("rover"), before[1], rtol=0)


def test_the_first_increment_began_one_interval_before_its_end() -> None:
    log = cut_increments(log_of(drive(-0.5, 0.25)))
    assert [e.t_s for e in log][:3] == [-0.5, 0.25, 0.25]
    assert begins_at(log.events[1:], "rover", held=False) == 0


def test_two_increments_at_one_time_are_left_as_they_are() -> None:
    events: list[Event] = [Control(t_s, "rover", WHOLE[PLANE]) for t_s in (1, 2, 2, 3)]
    found = [e for e in cut_increments(log_of([*events, *drive(2.5, number=0)])) if isinstance(e, Control)]
    assert [(e.t_s, e.share) for e in found] == [(1, 1), (2, 1), (2, 1), (2.5, 0.5), (3, 0.5)]


def test_a_gap_is_not_cut() -> None:
    """Of a gap nobody knows when its increment began: it stays whole, and the gap is noticed."""
    after: list[Event] = [Control(14 + k, "rover", WHOLE[PLANE]) for k in range(8)]
    events = [*drive(9.5, 11.5), *after]
    found = [e for e in cut_increments(log_of(events)) if isinstance(e, Control)]
    assert all(e.share == 1 for e in found)


def test_a_robot_is_cut_where_another_sees_it() -> None:
    seen = Scan(2.5, "scout", "camera", [[4.0, 0.2]], ids=["rover"])
    found = [e for e in cut_increments(log_of([*drive(), seen], robots=("rover", "scout"))) if isinstance(e, Control)]
    assert [e.t_s for e in found if e.share < 1] == [2.5, 3]


def test_velocities_are_not_cut() -> None:
    events: list[Event] = [Control(k, "rover", [1.0, 0.1]) for k in (1, 2, 3)]
    log = log_of([*events, *drive(1.5, number=0)], columns=("v_mps", "w_radps"))
    assert cut_increments(log).events == sorted(log.events, key=lambda e: e.t_ns)


def on_a_circle(folder: Path, seed: int) -> Path:
    """Write a log of a robot on a circle: an increment every .5 s, a scan every .3 s; without ids."""
    rng = np.random.default_rng(seed)
    landmarks = rng.uniform(-8, 8, (14, 2))

    def pose(t_s: float) -> np.ndarray:
        return np.array([4 * np.cos(0.25 * t_s), 4 * np.sin(0.25 * t_s), 0.25 * t_s + np.pi / 2])

    rows = {"controls": ["t_s,robot,dx_m,dy_m,dtheta_rad"], "scans": ["t_s,robot,sensor,id,range_m,bearing_rad"],
            "truth": ["t_s,robot,x_m,y_m,theta_rad"]}  # fmt: skip
    for k in range(1, 121):
        u = frames.to_frame(pose(0.5 * (k - 1)), pose(0.5 * k)[:2])[0]
        u = np.append(u, 0.125) + rng.normal(size=3) * (0.01, 0.002, 0.005)
        rows["controls"].append(f"{0.5 * k:.1f},rover," + ",".join(f"{x:.6f}" for x in u))
    for k in range(1, 201):
        t_s = 0.3 * k
        rows["truth"].append(f"{t_s:.1f},rover," + ",".join(f"{x:.6f}" for x in pose(t_s)))
        for p in landmarks:
            distance, bearing = frames.observe(pose(t_s), p)[0]
            if distance < 7:
                y = distance + 0.03 * rng.normal(), bearing + 0.01 * rng.normal()
                rows["scans"].append(f"{t_s:.1f},rover,laser,,{y[0]:.5f},{y[1]:.6f}")
    folder.mkdir()
    for name, lines in rows.items():
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    config = folder / "mine.yaml"
    config.write_text("""log: {path: .}
robots:
  each:
    motion: {type: odometry_2d, sigma_x_m: .01, sigma_y_m: .002, sigma_theta_rad: .005}
    start: {x_m: 4, y_m: 0, theta_rad: 1.570796}
    sensors: {laser: {type: range_bearing, sigma_range_m: .03, sigma_bearing_rad: .01}}
association: {type: auto}
""")
    return config


def test_scans_between_increments_find_their_robot(tmp_path: Path) -> None:
    """Without the cuts half of the landmarks are made twice; with them the pose is as far off as it says."""
    config, nees = on_a_circle(tmp_path / "log", seed=1), {}
    for how, landmarks in (("cut", 14), ("recorded", 20)):
        settings, log = open_run(config, overrides=[f"log.increments={how}"])
        run = km.record(build_slam(settings, log), log, progress=False)
        summary = run.evaluate()
        nees[how] = summary["robots"]["rover"]["pose_nees"]
        assert (summary["landmarks"] <= landmarks) == (how == "cut")
        assert summary["controls"] == 120
    assert nees["cut"] < 9 < nees["recorded"]


def test_halves_are_no_copies() -> None:
    """Two halves are equal to the last bit, and no sign of a log that repeats its rows."""
    rng = np.random.default_rng(3)
    steps: list[Event] = [Control(k, "rover", WHOLE[PLANE] + 0.01 * rng.normal(size=3)) for k in range(1, 60)]
    log = cut_increments(log_of([*steps, *drive(*(np.arange(1, 59) + 0.5), number=0)]))
    rover = km.Robot("rover", km.motion.Odometry2D(), sensors={"laser": km.Mount(km.sensors.RangeBearing())})
    run = km.record(km.Slam([rover]), log, progress=False)
    assert [same for same in copies(run, log) if not same.sensor] == []
    controls = Controls(log, PLANE, "rover")
    assert controls.interval_s == 1.0
    assert_allclose(controls.u[1:3], 2 * np.array([e.u for e in log if isinstance(e, Control)][1:3]))


def test_a_robot_without_controls_has_none_that_is_far_larger_than_the_others() -> None:
    assert Controls(log_of([]), PLANE, "rover").odd(1.0) is None


@pytest.mark.parametrize(("bits", "way", "digits"), [(16, -1, 6), (16, 1, 15), (32, -1, 15)])
def test_a_counter_of_a_wheel_that_ran_over_is_named_with_what_to_add(
    bits: int, way: int, digits: int, tmp_path: Path
) -> None:
    counts, step = np.random.default_rng(3).integers(280, 321, 60), 2 * np.pi / 2 ** (10 if bits == 16 else 16)
    left = np.round(np.where(np.arange(60) == 40, counts + way * 2.0**bits, counts) * step, digits)
    rows = [f"{k},r,{a:.15g},{b:.15g}" for k, (a, b) in enumerate(zip(left, counts * step, strict=True))]
    (tmp_path / "controls.csv").write_text("\n".join(["t_s,robot,left_rad,right_rad", *rows, ""]))
    said = f"left_rad of r at t=40.* s is .*: a counter of {bits} bits, whose steps are {step:.6g} rad, ran over"
    with pytest.raises(km.errors.LogError, match=said) as error:
        km.open_log(tmp_path)
    (tmp_path / "controls.csv").write_text(f"t_s,robot,left_rad,right_rad\n1,r,1,{2.0**32 * 0.006}\n")
    with pytest.raises(km.errors.LogError, match=r"expected at most 1e\+06 rad: did the counter of the wheel run over"):
        km.open_log(tmp_path)
    assert float(str(error.value).rpartition("add ")[2]) == pytest.approx(-way * 2.0**bits * step, rel=1e-5)


def test_a_wheel_that_jumps_by_something_else_is_not_taken_for_a_counter(tmp_path: Path) -> None:
    counts, step = np.random.default_rng(3).integers(280, 321, 60), 2 * np.pi / 1024
    smooth = np.random.default_rng(4).normal(1.8, 0.05, 60)
    for values in (np.where(np.arange(60) == 40, 50_000, counts) * step, np.where(np.arange(60) == 40, 402.0, smooth)):
        assert overflows(values) == []
    assert overflows(np.zeros(9)) == overflows(counts * step) == []
