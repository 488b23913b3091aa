"""What a run warns of, and that a good run warns of nothing."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import results_space
from kalmark.config import build_slam, config_dict
from kalmark.diagnosis.verdict import diagnose
from kalmark.errors import DivergedError
from kalmark.events import Control, Event, Fix, Scan, sort_key
from kalmark.logs.log import Log
from kalmark.models.motion import Unicycle
from kalmark.models.sensors import Bearing, RangeBearing
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.run_page import report_html
from kalmark.simulate import load_world, simulate
from kalmark.slam.robot import Mount, Robot
from kalmark.slam.slam import Slam
from results_space import spiral
from results_world import STEP_NS, circle, slam_for, start_of


def warned(log: Log, events: list[Event] | None = None, **options: Any) -> list[str]:
    log = log if events is None else replace(log, events=events)
    lines: list[str] = record(slam_for(log, **options), log, progress=False).evaluate()["warnings"]
    return lines


def only(lines: list[str]) -> str:
    assert len(lines) == 1, lines
    return lines[0]


def scan(event: Scan, **changes: Any) -> Scan:
    given = {"t_ns": event.t_ns, "robot": event.robot, "sensor": event.sensor, "y": event.y, "ids": event.ids}
    return Scan(**(given | changes))


@pytest.mark.parametrize(
    "log",
    [circle(steps=60), circle(robots=("a", "b"), steps=30), circle(truth=False, gps=True)],
    ids=["one robot", "two robots", "position fixes to score with"],
)
def test_a_good_run_warns_of_nothing(log: Log) -> None:
    assert warned(log) == []


def test_observations_without_ids_are_said_to_be_ignored_and_what_helps() -> None:
    log = circle(steps=20)
    lines = warned(log, [scan(e, ids=None) if isinstance(e, Scan) else e for e in log])
    count = sum(len(e.y) for e in log if isinstance(e, Scan))
    assert f"{count} observations have no id and were ignored; try --set association.type=auto" in lines
    assert "no landmark was mapped" in lines


def test_a_log_in_which_nothing_was_seen_is_said_to_have_nothing_to_map() -> None:
    assert only(warned(circle(steps=10, landmarks=0))).startswith("no observation was made")


def test_true_landmarks_with_other_names_than_the_log_s_are_said_not_to_be_scored() -> None:
    log = circle(steps=20)
    other = replace(log, landmarks={f"L{i}": l for i, l in log.landmarks.items()})
    said = "the log calls them 2, 4, 7, ..., the true ones are L1, L2, L3, ..."
    assert only(warned(other)) == f"the landmarks are not scored: {said}"


def test_a_robot_that_is_never_controlled_is_named() -> None:
    log = circle(robots=("a", "b"), steps=10)
    lines = warned(log, [e for e in log if not (isinstance(e, Control) and e.robot == "b")])
    assert "robot b has 10 scans but no controls: it is taken to stand still" in lines


def test_bearings_in_degrees_are_noticed() -> None:
    log = circle(steps=20)
    events: list[Event] = [scan(e, y=e.y * [1.0, 180 / np.pi]) if isinstance(e, Scan) else e for e in log]
    assert any("bearings beyond 2 pi rad: are they in degrees?" in line for line in warned(log, events))


def test_truth_that_fits_no_robot_and_robots_without_truth_are_named() -> None:
    log = circle(robots=("a", "b"), steps=10)
    truth = {"a": log.truth["a"], "c": log.truth["b"]}
    lines = warned(replace(log, truth=truth))
    assert lines == [
        "the log has truth for c, which is not in this run (robots: a, b)",
        "the log has no truth for robot b, but for a, c",
    ]


def fixed(log: Log, shift: tuple[float, float], sigma_m: float = 0.1, seed: int = 3) -> list[Event]:
    """Return the events of a log with a fix at every fifth step, all shifted."""
    rng, path = np.random.default_rng(seed), log.truth["rover"]
    fixes = [
        Fix(t_ns=t, robot="rover", y=pose[:2] + shift + sigma_m * rng.normal(size=2), cov=sigma_m**2 * np.eye(2))
        for t, pose in zip(path.t_ns[5::5].tolist(), path.poses[5::5], strict=True)
    ]
    return sorted([*log, *fixes], key=lambda e: (e.t_ns, isinstance(e, Scan) + 2 * isinstance(e, Fix)))


def test_good_fixes_are_counted_with_their_nis_and_bring_no_warning() -> None:
    log = circle(steps=100)
    log = replace(log, events=fixed(log, (0.0, 0.0)))
    summary = record(slam_for(log), log, progress=False).evaluate()
    assert summary["fixes"] == 20
    assert 0.3 < summary["fix_nis_per_dof"] < 2.0
    assert summary["warnings"] == []


def test_of_fixes_whose_noise_is_far_too_large_it_is_advised_by_how_much() -> None:
    log = circle(steps=300)
    for stated_m, told in ((0.1, []), (0.4, [1.5, 4.2])):
        events = [replace(e, cov=np.eye(2) * stated_m**2) if isinstance(e, Fix) else e for e in fixed(log, (0.0, 0.0))]
        lines = record(slam_for(log), replace(log, events=events), progress=False).evaluate()["advice"]
        found = [
            re.match(r"fixes: NIS \S+ where 1 is expected: their sigma is stated at least (\S+) times", x)
            for x in lines
        ]
        assert [told[0] < float(one[1]) < told[1] for one in found if one] == [True] * bool(told)


def test_a_first_fix_far_from_the_start_says_which_setting_to_change() -> None:
    log = circle(steps=50)
    lines = warned(log, fixed(log, (11.0, 2.0)))
    (line,) = (line for line in lines if "first fix" in line)
    assert "of rover is 11." in line
    assert "with a configured sigma of 0 m: set robots.rover.start" in line


def test_noise_that_is_not_the_log_s_is_noticed() -> None:
    log = circle(steps=100)
    rng = np.random.default_rng(5)
    events: list[Event] = [
        scan(e, y=e.y + [0.3, 0.1] * rng.normal(size=e.y.shape)) if isinstance(e, Scan) else e for e in log
    ]
    lines = warned(log, events)
    assert any(line.startswith("pose NEES ") and "where 3 is consistent" in line for line in lines)
    assert any(line.endswith("the noise is set too small") for line in lines)


def advised(log: Log, range_: float, bearing: float, control: float = 1.0) -> list[str]:
    """Return the advice on a log whose noise is stated so many times what it is."""
    lidar = RangeBearing(sigma_range_m=0.05 * range_, sigma_bearing_rad=0.02 * bearing)
    motion = Unicycle(sigma_v_mps=0.05 * control, sigma_w_radps=0.02 * control)
    start = start_of(("rover",), "rover")
    slam = Slam([Robot("rover", motion, start=start, sensors={"lidar": Mount(lidar)})])
    lines: list[str] = record(slam, log, progress=False).evaluate()["advice"]
    return lines


@pytest.mark.parametrize("seed", range(4))
def test_of_a_noise_that_is_far_too_large_it_is_advised_by_how_much_and_of_a_right_one_nothing(seed: int) -> None:
    log = circle(steps=120, seed=seed)
    assert advised(log, 1.0, 1.0) == advised(log, 1.25, 1.25) == []
    line = only(advised(log, 2.3, 2.3))
    factors = re.fullmatch(
        r"sensor lidar: NIS 0\.(19|2|21) where 1 is expected: its sigma is stated about (\S+) times \(range_m\), "
        r"(\S+) times \(bearing_rad\) too large, unless its errors last from one observation to the next",
        line,
    )
    assert factors is not None, line
    assert [float(f) for f in factors.groups()[1:]] == pytest.approx([2.3, 2.3], rel=0.15)
    assert " times (range_m) too large" in only(advised(log, 3.0, 1.0))


def test_a_sensor_is_not_blamed_for_controls_whose_noise_is_too_large_nor_by_few_scans_nor_against_the_truth() -> None:
    log = circle(steps=120)
    assert advised(log, 1.0, 1.0, control=10.0) == []
    assert advised(replace(log, events=log.events[:40]), 2.0, 2.0) == []
    poses = log.truth["rover"].poses * [1.3, 1.3, 1.0]  # the stated noise is large, and yet the filter is too sure
    assert advised(replace(log, truth={"rover": replace(log.truth["rover"], poses=poses)}), 2.3, 2.3) == []


@pytest.mark.filterwarnings("error")
def test_of_two_sensors_the_one_with_the_wrong_noise_is_named() -> None:
    log = circle(steps=100)
    sensors = {
        "lidar": Mount(RangeBearing(sigma_range_m=0.05, sigma_bearing_rad=0.02)),
        "eye": Mount(Bearing(sigma_bearing_rad=0.06)),
    }
    eye = [scan(e, sensor="eye", y=e.y[:, 1:]) for e in log if isinstance(e, Scan) and e.t_ns % (2 * STEP_NS) == 0]
    events = [e for e in log if not (isinstance(e, Scan) and e.t_ns % (2 * STEP_NS) == 0)]
    motion = Unicycle(sigma_v_mps=0.05, sigma_w_radps=0.02)
    slam = Slam([Robot("rover", motion, start=start_of(("rover",), "rover"), sensors=sensors)])
    run = record(slam, replace(log, events=sorted([*events, *eye], key=sort_key)), progress=False)
    assert only(run.evaluate()["advice"]).startswith("sensor eye: NIS ")


def test_advice_is_kept_with_a_run_and_shown_in_its_report(tmp_path: Path) -> None:
    log = circle(steps=60)
    events: list[Event] = [scan(e, cov=np.diag([0.2, 0.1]) ** 2) if isinstance(e, Scan) else e for e in log]
    run = record(slam_for(log), replace(log, events=events), progress=False)
    verdict = diagnose(run)
    run.save(tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert f'<ul class="warnings verdict {verdict.map}"><li>the map is {verdict.map}' in page
    assert "its sigma is stated" in only(run.summary["advice"])
    assert Run.load(tmp_path).evaluate()["advice"] == run.summary["advice"]
    assert '<ul class="warnings advice">' in page and "<li>sensor lidar: " in page


def test_a_filter_that_stopped_says_so_first_and_the_report_shows_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    log = circle(steps=20)
    slam = slam_for(log)
    process = slam.process

    def refuse(event: Event) -> object:
        if event.t_ns >= 10 * STEP_NS:
            raise DivergedError("the innovation is <absurd>")
        return process(event)

    monkeypatch.setattr(slam, "process", refuse)
    run = record(slam, log, progress=False)
    assert run.evaluate()["warnings"][0] == "the filter stopped: the innovation is <absurd>"
    page = report_html(run)
    assert '<ul class="warnings"><li>the filter stopped: the innovation is &lt;absurd&gt;</li>' in page
    run.save(tmp_path)
    assert Run.load(tmp_path).evaluate()["warnings"] == run.summary["warnings"]


def test_warnings_and_fixes_outlive_saving(tmp_path: Path) -> None:
    log = circle(steps=50)
    log = replace(log, events=fixed(log, (11.0, 2.0)))
    run = record(slam_for(log), log, progress=False)
    run.save(tmp_path)
    loaded = Run.load(tmp_path)
    assert run.summary["warnings"]
    assert loaded.evaluate() == run.evaluate()
    assert len(loaded.history.fixes) == 10


def test_a_diverged_run_is_not_to_be_used() -> None:
    log = circle(steps=100)
    turned = [Control(t_ns=e.t_ns, robot=e.robot, u=-e.u) if isinstance(e, Control) else e for e in log]
    blind = [scan(e, y=(), ids=None) if isinstance(e, Scan) else e for e in turned]
    assert any(line.startswith("DIVERGED: the error of rover") for line in warned(log, blind))


def test_what_a_camera_s_attention_leaves_alone_is_no_warning() -> None:
    log = spiral(steps=10)
    run = record(results_space.slam_for(log), log, progress=False)
    count = len(run.history.step)
    for reason, warns in (("not among the 10 of most information", False), ("no such landmark", True)):
        history = replace(run.history, outcome=np.full(count, "ignored"), reason=np.full(count, reason))
        lines = replace(run, history=history, summary={}).evaluate()["warnings"]
        assert any("were ignored" in line for line in lines) == warns


def test_measurements_outside_the_image_are_noticed() -> None:
    slam, log = results_space.with_camera(spiral(steps=10))
    run = record(slam, log, progress=False)
    assert run.evaluate()["warnings"] == []
    (camera,) = run.history.cameras
    history = replace(run.history, cameras=(camera._replace(size=(320.0, 240.0)),))
    (line,) = replace(run, history=history, summary={}).evaluate()["warnings"]
    assert line.endswith("of camera eye lie outside its image of 320 x 240 pixels: set width_px and height_px")


def test_a_sensor_that_notices_that_its_robot_stands_needs_no_observations() -> None:
    world = load_world("stop_and_go", ["steps=60"])
    log, config = simulate(world, seed=1), world.config()
    run = record(build_slam(config, log), log, config=config_dict(config), progress=False)
    assert not [line for line in run.evaluate()["warnings"] if "still" in line]
