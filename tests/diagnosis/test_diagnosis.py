"""Does the diagnosis name what is wrong with a log, and nothing where nothing is?"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hall import hall, mapped

import kalmark as km
from kalmark.batch.batch_state import LANDMARKS
from kalmark.batch.data import replay_events
from kalmark.batch.motion_chain import Course
from kalmark.batch.solver import optimum
from kalmark.cli.app import main
from kalmark.cli.run import run_log
from kalmark.config import build_slam, config_dict
from kalmark.diagnosis import single_ids
from kalmark.diagnosis.batch_search import SEGMENT, subsample
from kalmark.diagnosis.breakdown import breakdown, nees_parts
from kalmark.diagnosis.cause_texts import OR, finding_text
from kalmark.diagnosis.causes import Finding
from kalmark.diagnosis.linear import Linear
from kalmark.diagnosis.named_causes import _is_of_gap, causes_of
from kalmark.diagnosis.repeated_events import repeated_measurements
from kalmark.diagnosis.trials import fit_of_run
from kalmark.diagnosis.verdict import Verdict
from kalmark.events import Control, Event, Scan, sort_key
from kalmark.geometry.frames import compose, inverse
from kalmark.geometry.spaces import SE3
from kalmark.logs import write_native
from kalmark.logs.log import Log
from kalmark.results.batch import batch_input
from kalmark.results.measures import rigid, rmse
from kalmark.results.run import Run
from kalmark.results.verdict_text import verdict_lines
from kalmark.simulate import load_world, simulate
from kalmark.slam.held_control import MotionPart

WORLD = ("world.count=30", "world.size_m=24", "steps=400", "robots.rover.start={x_m: 12, y_m: 12, theta_rad: 0}")
SIGMA = "robots.rover.sensors.lidar.sigma_range_m"
Change = Callable[[Event], Event]


judge = partial(km.diagnose, brief=True)  # as at the end of a run


def world_of(*settings: str) -> Any:
    return load_world("random_field", [*WORLD, *settings])


@cache
def log_of(seed: int = 3) -> Log:
    """Return the log of the world, simulated once."""
    return simulate(world_of(), seed)


def recorded_under(config: Any, log: Log, pictures: bool = False) -> Run:
    """Return the run of a log; what comes before a jump is judged by the maps of a run with `pictures`."""
    return km.record(build_slam(config, log), log, progress=False, config=config_dict(config), pictures=pictures)


@cache
def run_of(change: Change | None = None, settings: tuple[str, ...] = (), seed: int = 3) -> Run:
    """Return the run of a world's log, changed, by a filter with other settings."""
    log, config = log_of(seed), world_of(*settings).config()
    if change is not None:
        log = replace(log, events=sorted(map(change, log.events), key=lambda e: e.t_ns))
    return recorded_under(config, log)


@cache
def verdict_on(change: Change | None = None, settings: tuple[str, ...] = (), seed: int = 3) -> Verdict:
    """Return the verdict on such a run, which many tests read."""
    return judge(run_of(change, settings, seed))


def seen(scan: Scan, y: Any = None, t_ns: int | None = None) -> Scan:
    return Scan(t_ns=scan.t_ns if t_ns is None else t_ns, robot=scan.robot, sensor=scan.sensor,
                y=scan.y if y is None else y, ids=scan.ids)  # fmt: skip


def measuring(change: Callable[[Any], Any]) -> Change:
    return lambda e: seen(e, y=change(e.y)) if isinstance(e, Scan) and len(e.y) else e


def controlling(change: Callable[[Any], Any]) -> Change:
    return lambda e: Control(t_ns=e.t_ns, robot=e.robot, u=change(e.u)) if isinstance(e, Control) else e


FAULTS: dict[str, tuple[Change | None, tuple[str, ...], float | None]] = {
    "range_sigma": (None, (f"{SIGMA}=0.05",), 2.0),
    "bearing_offset": (measuring(lambda y: np.add(y, [0.0, 0.02])), (), 0.02),
    "range_scale": (measuring(lambda y: y * [1.06, 1.0]), (), 0.06),
    "height": (measuring(lambda y: np.column_stack([np.hypot(y[:, 0], 1.5), y[:, 1]])), (), 1.5**2),
    "time_offset": (lambda e: seen(e, t_ns=e.t_ns + 100_000_000) if isinstance(e, Scan) else e, (), -0.1),
    "odometry_turn": (controlling(lambda u: np.add(u, [0.0, 0.02])), (), -0.02),
    "mount_position": (None, ("robots.rover.sensors.lidar.mount.y_m=0.5",), -0.5),
}
MISTAKES: dict[str, tuple[Change | None, tuple[str, ...]]] = {
    "bearing_sign": (measuring(lambda y: y * [1.0, -1.0]), ()),
    "units": (measuring(lambda y: y * [1.0, 180 / np.pi]), ()),
    "mount": (None, ("robots.rover.sensors.lidar.mount.theta_rad=3.14159",)),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_first_with_its_size(name: str) -> None:
    change, settings, size = FAULTS[name]
    verdict = verdict_on(change, settings)
    assert verdict.causes[0].name == name, verdict.causes
    assert verdict.search is not None
    finding = next(f for f in verdict.search.found if f.name == name)
    assert finding.value == pytest.approx(size, abs=4 * finding.sigma + 0.1 * abs(size or 0.0))
    assert verdict.causes[0].cure


@pytest.mark.parametrize("name", ["range_sigma", "bearing_offset", "range_scale", "mount_position"])
def test_the_cure_of_a_fault_takes_it_out(name: str) -> None:
    change, settings, _ = FAULTS[name]
    cure = verdict_on(change, settings).causes[0].cure.split(OR)[0]
    after = judge(run_of(change, (*settings, cure.removeprefix("--set "))))
    assert name not in [cause.name for cause in after.causes]


def run_with_moved(ids: list[int], by: tuple[float, float]) -> Run:
    """Return the run of a log in which landmarks are moved in the middle."""
    log, rng = log_of(), np.random.default_rng(0)
    middle, truth = log.events[len(log.events) // 2].t_ns, log.truth["rover"]

    def other(e: Event) -> Event:
        if not isinstance(e, Scan) or e.ids is None or e.t_ns < middle:
            return e
        pose = truth.poses[np.searchsorted(truth.t_ns, e.t_ns)]
        places = np.array([np.add(log.landmarks[i][:2], by) for i in e.ids])
        y = km.geometry.observe(compose(pose, np.array([0.3, 0.0, 0.0]))[0], places)[0]
        y += rng.normal(size=y.shape) * (0.1, 0.02)
        return seen(e, y=np.where(np.isin(e.ids, ids)[:, None], y, e.y))

    return recorded_under(world_of().config(), replace(log, events=[*map(other, log.events)]), pictures=True)


def test_a_landmark_that_is_moved_once_is_named_and_is_no_outlier() -> None:
    first, *others = judge(run_with_moved([12], (1.5, 0.6))).causes
    assert first.name == "moving_landmark" and "landmark 12 " in first.evidence
    assert "outliers" not in [cause.name for cause in others]


def test_two_landmarks_that_are_moved_far_are_named_and_the_robot_is_not_kidnapped() -> None:
    verdict = judge(run_with_moved([5, 20], (-3.0, 2.0)))
    assert (verdict.map, verdict.causes[0].name) == ("ok", "moving_landmark")
    assert "landmarks 20, 5 are elsewhere" in verdict.causes[0].evidence
    assert verdict.causes[0].cure == "give each thing an id of its own, and a thing that is moved a new one"
    assert "kidnapped" not in [cause.name for cause in verdict.causes]
    assert "e-" not in next(verdict_lines(verdict.as_dict()))


def test_a_log_that_does_not_fit_is_not_ok_where_there_is_no_batch_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    def unsolved(*given: Any) -> Any:
        raise km.KalmarkError("not determined")

    monkeypatch.setattr("kalmark.diagnosis.batch_verdict.search_causes", unsolved)
    assert judge(run_of()).map == "ok"
    verdict = judge(run_of(measuring(lambda y: np.add(y, [0.0, 0.5 * np.sin(3 * y[0, 0])]))))
    assert verdict.map != "ok"


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named_first_and_makes_the_map_wrong(name: str) -> None:
    verdict = verdict_on(*MISTAKES[name])
    assert (verdict.map, verdict.causes[0].name) == ("wrong", name)


def test_a_clean_log_is_not_accused() -> None:
    for seed in range(5):
        verdict = verdict_on(seed=seed)
        assert (verdict.map, verdict.causes) == ("ok", ())
        assert verdict.sigma_factor == pytest.approx(1.0, abs=0.1)


def test_a_part_of_the_observations_is_enough() -> None:
    run = run_of(*FAULTS["bearing_offset"][:2])
    verdict = judge(run, 2000)
    assert verdict.causes[0].name == "bearing_offset"
    number = int(verdict.checked.split()[3])
    assert 1500 < number < 2500 < run.summary["observations"]


def test_a_robot_that_was_carried_away_is_noticed_at_that_time() -> None:
    log = log_of()
    begin, end = (log.events[k * len(log.events) // 5].t_ns for k in (2, 3))
    events: list[Event] = [e for e in log.events if e.t_ns < begin]
    for e in log.events:
        t_ns = e.t_ns - end + begin
        if isinstance(e, Scan) and t_ns >= begin:
            events.append(seen(e, t_ns=t_ns))
        elif isinstance(e, Control) and t_ns >= begin:
            events.append(Control(t_ns=t_ns, robot=e.robot, u=e.u))
    log = replace(log, events=events, truth={})
    verdict = judge(recorded_under(world_of().config(), log, pictures=True))
    assert (verdict.map, verdict.causes[0].name, verdict.causes[0].harmless) == ("ok", "kidnapped", True)
    assert verdict.causes[0].since_s == pytest.approx(begin * 1e-9, abs=5.0)


def bumped(seed: int, by: tuple[float, float, float], when: float = 0.5) -> tuple[Log, float]:
    """Return a log in which the robot is moved `by` a step, in its frame, and the time of that."""
    log, rng = log_of(seed), np.random.default_rng(seed)
    t_ns, truth = log.events[int(when * len(log.events))].t_ns, log.truth["rover"]
    before = truth.poses[np.searchsorted(truth.t_ns, t_ns)]
    to = compose(compose(before, np.array(by))[0], inverse(before)[0])[0]
    names, places = [*log.landmarks], np.array([*log.landmarks.values()])

    def moved(e: Event) -> Event:
        if not isinstance(e, Scan) or e.t_ns <= t_ns:
            return e
        pose = truth.poses[np.searchsorted(truth.t_ns, e.t_ns)]
        y = km.geometry.observe(compose(compose(to, pose)[0], np.array([0.3, 0.0, 0.0]))[0], places)[0]
        near = (y[:, 0] > 0.5) & (y[:, 0] < 12.0) & (np.abs(y[:, 1]) < np.pi / 2)
        y = y[near] + rng.normal(size=(near.sum(), 2)) * (0.1, 0.02)
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=y, ids=[n for n, i in zip(names, near) if i])  # noqa: B905

    return replace(log, events=[*map(moved, log.events)], truth={}), t_ns * 1e-9


def recorded(log: Log, *settings: str, pictures: bool = False) -> Run:
    return recorded_under(world_of(*settings).config(), log, pictures)


@pytest.mark.parametrize("seed", [1, 3])
def test_a_bump_is_a_jump_of_its_size_at_its_time(seed: int) -> None:
    log, t_s = bumped(seed, (0.2, 0.2, 0.25))
    verdict = judge(recorded(log))
    assert [cause.name for cause in verdict.causes] == ["odometry_jump"]
    assert verdict.causes[0].since_s == pytest.approx(t_s + 0.2, abs=0.21)
    assert verdict.search is not None
    (jump,) = verdict.search.found
    assert jump.at is not None
    np.testing.assert_allclose(jump.at, (0.2, 0.2, 0.25), atol=0.12)


def test_a_robot_that_is_carried_far_is_kidnapped_and_no_odometry_jumps() -> None:
    verdict = judge(recorded(bumped(3, (-4.0, 3.0, 0.3))[0], pictures=True))
    assert verdict.causes[0].name == "kidnapped"
    assert "odometry_jump" not in [cause.name for cause in verdict.causes]


def test_a_control_that_jumps_is_named_and_its_cure_leaves_it_out() -> None:
    log = log_of()
    t_ns = next(e.t_ns for e in log.events[len(log.events) // 2 :] if isinstance(e, Control))
    jumps = [
        Control(t_ns=e.t_ns, robot=e.robot, u=np.array([25.0, 0.0])) if isinstance(e, Control) and e.t_ns == t_ns else e
        for e in log.events
    ]
    log = replace(log, events=jumps)
    cause = judge(recorded(log)).causes[0]
    assert cause.name == "odometry_jump" and "v_mps of rover is 25 " in cause.evidence
    assert cause.since_s == pytest.approx(t_ns * 1e-9, abs=0.3)
    cured = recorded(log, cause.cure.removeprefix("--set "))
    (gap,) = cured.evaluate()["gaps"]
    assert (gap["kind"], gap["start_s"]) == ("ruled_out", pytest.approx(t_ns * 1e-9))
    verdict = judge(cured)
    assert [(c.name, c.harmless) for c in verdict.causes] == [("odometry_jump", True)]
    assert "left out" in verdict.causes[0].evidence


def test_a_slip_while_there_are_no_scans_is_found_by_a_part_of_the_observations() -> None:
    log = log_of()
    middle, fast = log.events[len(log.events) // 2].t_ns, np.array([6.0, 1.5])
    within = [e for e in log.events if not isinstance(e, Scan) or not middle <= e.t_ns < middle + 8_000_000_000]
    slips = [
        Control(t_ns=e.t_ns, robot=e.robot, u=e.u + fast)
        if isinstance(e, Control) and middle <= e.t_ns < middle + 1_000_000_000
        else e
        for e in within
    ]
    cause = judge(recorded(replace(log, events=slips)), 800).causes[0]
    assert cause.name in ("odometry_jump", "kidnapped")
    assert cause.since_s == pytest.approx((middle + 8_000_000_000) * 1e-9, abs=1.0)


def test_controls_that_jump_among_surveyed_tags_are_named_without_a_batch_solution() -> None:
    rng, start = np.random.default_rng(5), np.array([0.0, 0, 0, 0, 0, 0, 1])
    tags = [np.array([*rng.uniform(-6, 6, 2), 1.0, 0, 0, 0, 1]) for _ in range(12)]
    robot = km.Robot(
        "cam", km.motion.Odometry3D(0.01, 0.01, 0.01, 0.005), start, {"eye": km.Mount(km.sensors.TagPose())}
    )
    slam = km.Slam(robot, km.association.ByIdentity())
    for i, tag in enumerate(tags):
        slam.add_landmark(i, tag, np.diag([1e-8] * 3 + [1e-10] * 3), km.landmarks.Tag())
    pose, events = np.zeros(3), list[Event]()
    for k in range(1, 200):
        u = np.array([0.1, 0.0, 0.03])
        pose = compose(pose, u)[0]
        u = u + rng.normal(size=3) * (0.01, 0.01, 0.005) + (0.7 * (k in (80, 140)), 0.0, 0.0)
        events.append(Control(t_s=0.2 * k, robot="cam", u=np.array([u[0], u[1], 0, 0, 0, u[2]])))
        at = np.array([*pose[:2], 0.0, 0, 0, np.sin(pose[2] / 2), np.cos(pose[2] / 2)])
        y = km.landmarks.Tag().seen_from(at, np.array(tags))[0][: 4 + k % 8]
        y = np.array([SE3.plus(one, 0.02 * rng.normal(size=6)) for one in y])
        events.append(Scan(t_s=0.2 * k, robot="cam", sensor="eye", y=y, ids=range(len(y))))
    verdict = judge(km.record(slam, Log("tags", ("cam",), events), progress=False))
    assert verdict.map == "ok" and "no batch solution" in verdict.checked  # the tags place the camera at once
    assert [(c.name, c.since_s) for c in verdict.causes] == [("odometry_jump", 16.0), ("odometry_jump", 28.0)]
    assert "dx_m" in verdict.causes[0].evidence and "max_speed_mps" in verdict.causes[0].cure


def test_control_noise_and_gaps_are_no_jumps() -> None:
    noisy = run_of(None, tuple(f"robots.rover.motion.sigma_{c}=0.0167" for c in ("v_mps", "w_radps")))
    assert {cause.name for cause in judge(noisy).causes} == {"control_sigma"}
    log = log_of()
    begin = log.events[len(log.events) // 2].t_ns
    log = replace(log, events=[e for e in log.events if not begin <= e.t_ns < begin + 4_000_000_000])
    for gaps in ("widen", "ignore"):
        assert [cause.name for cause in judge(recorded(log, f"robots.rover.gaps={gaps}")).causes] == ["gap"]


def surveyed(folder: Path, log: Log, sigma_m: float, wrong: dict[int, tuple[float, float]]) -> str:
    """Return the setting of a known map with landmarks at wrong places; `wrong` counts the ones seen most from 0."""
    ids = [i for e in log.events if isinstance(e, Scan) for i in e.ids or ()]
    often, rng = sorted({*ids}, key=lambda i: (-ids.count(i), i)), np.random.default_rng(0)
    lines = ["id,x_m,y_m" + (",cov_xx,cov_xy,cov_yy" if sigma_m else "")]
    for name, place in log.landmarks.items():
        x, y = place + rng.normal(size=2) * sigma_m + wrong.get(often.index(name), (0.0, 0.0))
        lines.append(f"{name},{x},{y}" + (f",{sigma_m**2},0,{sigma_m**2}" if sigma_m else ""))
    (folder / "survey.csv").write_text("\n".join(lines) + "\n")
    return f"filter.map.known={folder / 'survey.csv'}"


@pytest.mark.parametrize(("sigma_m", "gate"), [(0.0, "default"), (0.02, "default"), (0.0, "off"), (0.02, "off")])
def test_surveyed_landmarks_that_are_elsewhere_are_named_with_their_place(
    tmp_path: Path, sigma_m: float, gate: str
) -> None:
    log = log_of()
    ids = [i for e in log.events if isinstance(e, Scan) for i in e.ids or ()]
    often = sorted({*ids}, key=lambda i: (-ids.count(i), i))
    association = f"filter.association={{type: identity, gate: {gate}}}"
    survey = surveyed(tmp_path, log, sigma_m, {0: (0.9, 0.3), 2: (-0.6, 0.8)})
    verdict = judge(recorded(log, survey, association))
    named = [cause for cause in verdict.causes if cause.name == "landmark_prior"]
    assert {cause.evidence.split()[1] for cause in named} == {str(often[0]), str(often[2])}
    assert verdict.causes[0].name == "landmark_prior"
    assert verdict.map == ("ok" if gate == "default" else "doubtful")
    for cause in named:
        true = log.landmarks[next(i for i in often if str(i) == cause.evidence.split()[1])]
        at = [
            float(x) for x in cause.evidence[cause.evidence.index("at (") + 4 : cause.evidence.index(") m")].split(",")
        ]
        assert np.linalg.norm(at - true) < 0.25
        assert cause.harmless == (gate == "default") == ("mapped it" in cause.evidence)  # or is the map pulled?


@pytest.mark.parametrize("sigma_m", [0.0, 0.02, 0.5])
def test_a_survey_that_is_right_is_not_accused(tmp_path: Path, sigma_m: float) -> None:
    log = log_of()
    run = recorded(log, surveyed(tmp_path, log, sigma_m, {}))
    for most in (20_000, 2000):
        verdict = judge(run, most)
        assert (verdict.map, verdict.causes) == ("ok", ())


def with_fixes(log: Log) -> Log:
    """Return a log with a fix of .3 m of each robot at every tenth pose."""
    rng = np.random.default_rng(0)
    fixes = [
        km.Fix(t_ns=int(t), robot=name, y=pose[:d] + rng.normal(size=d) * 0.3, cov=0.09 * np.eye(d))
        for name, truth in log.truth.items()
        for d in (2 if truth.poses.shape[1] == 3 else 3,)
        for t, pose in [*zip(truth.t_ns, truth.poses, strict=True)][::10]
    ]
    return replace(log, events=sorted([*log.events, *fixes], key=sort_key))


@pytest.mark.parametrize("heading", [0.5, -2.5])
def test_a_wrong_first_heading_is_named_where_fixes_tell(heading: float) -> None:
    log = with_fixes(log_of())
    start = f"robots.rover.start={{x_m: 12, y_m: 12, theta_rad: {heading}}}"
    verdict = judge(recorded(log, start))
    assert (verdict.map, verdict.causes[0].name, verdict.causes[0].harmless) == ("ok", "start", True)
    assert "the map was moved onto them" in verdict.causes[0].evidence
    assert not [cause for cause in verdict.causes if not cause.harmless]
    cured = judge(recorded(log, verdict.causes[0].cure.removeprefix("--set ").strip("'")))
    assert (cured.map, cured.causes) == ("ok", ())


APART = ("steps=400", "sight_robots=false", "world.size_m=60", "world.count=200",
         "robots.beta.start={x_m: 35, y_m: 35}",
         "robots.beta.route.points_m=[[55,35],[55,55],[35,55],[35,35]]")  # fmt: skip


ALIKE = (
    "robots.beta.motion={type: unicycle, sigma_v_mps: 0.05, sigma_w_radps: 0.05}",
    "robots.beta.sensors={lidar: "
    "{type: range_bearing, sigma_range_m: 0.1, sigma_bearing_rad: 0.02, range_min_m: 0.3, range_max_m: 8}}",
)


def by_fixes(world: str, *settings: str) -> Callable[[str], Run]:
    """Return how a log with fixes is run from a start."""
    log = with_fixes(simulate(load_world(world, ["steps=200", *settings]), 3))

    def run_from(start: str) -> Run:
        config = load_world(world, [*settings, start]).config()
        return recorded_under(config, log)

    return run_from


def cure_of(verdict: Verdict) -> str:
    return verdict.causes[0].cure.removeprefix("--set ").strip("'")


@pytest.mark.parametrize("yaw_deg", [0.0, 70.0])
def test_a_wrong_start_in_space_is_named_where_fixes_tell(yaw_deg: float) -> None:
    run_from = by_fixes("thick_cloister")
    run = run_from(f"robots.robot.start={{x_m: 5, y_m: -5, z_m: 2, roll_deg: 0, yaw_deg: {yaw_deg}}}")
    verdict = judge(run)
    assert (verdict.map, [(c.name, c.harmless) for c in verdict.causes]) == ("ok", [("start", True)])
    assert not run.summary["robots"]["robot"]["diverged"]
    assert run.summary["landmark_rmse_raw_m"] < 0.3
    cured = judge(run_from(cure_of(verdict)))
    assert (cured.map, cured.causes) == ("ok", ())


@pytest.mark.parametrize(
    ("robot", "x_m", "settings"), [("alpha", 5.0, ()), ("beta", 8.0, ()), ("beta", 40.0, APART)], ids=str
)
def test_the_robot_of_two_that_starts_elsewhere_is_named_where_fixes_tell(
    robot: str, x_m: float, settings: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kalmark.slam.elsewhere.ODDS", math.inf)  # else its landmarks place it
    run_from = by_fixes("two_robots", *settings)
    verdict = judge(run_from(f"robots.{robot}.start.x_m={x_m}"))
    assert (verdict.map, verdict.causes[0].name) == ("wrong", "start")
    assert verdict.causes[0].evidence.startswith(f"{robot} starts at")
    run = run_from(cure_of(verdict))
    cured = judge(run)
    assert (cured.map, cured.causes) == ("ok", ())
    assert run.summary["landmark_rmse_raw_m"] < 0.3


@pytest.mark.parametrize("each", [False, True])
def test_several_robots_that_start_elsewhere_are_named_together(each: bool, tmp_path: Path) -> None:
    log = with_fixes(simulate(load_world("two_robots", ["steps=200", *(ALIKE if each else ())]), 4))
    robots = config_dict(load_world("two_robots").config())["robots"]
    for name, x_m in (("alpha", 5.0), ("beta", 8.0)):
        robots[name]["start"]["x_m"] = x_m
    write_native(log, tmp_path / "log")
    path = tmp_path / "config.yaml"
    robots = {"each": robots["alpha"]} if each else robots
    path.write_text(json.dumps({"log": {"path": "log"}, "robots": robots}))
    verdict = judge(run_log(path, progress=False))
    assert (verdict.map, verdict.causes[0].name) == ("wrong", "start")
    cures = [cure.strip().strip("'") for cure in verdict.causes[0].cure.split("--set ")[1:]]
    assert [cure.split("=")[0] for cure in cures] == ["robots.alpha.start", "robots.beta.start"]
    run = run_log(path, overrides=cures, progress=False)
    cured = judge(run)
    assert (cured.map, cured.causes) == ("ok", ())
    assert run.summary["landmark_rmse_raw_m"] < 0.3


def test_a_wrong_first_heading_is_named_in_a_known_map(tmp_path: Path) -> None:
    log = log_of()
    start = "robots.rover.start={x_m: 12, y_m: 12, theta_rad: 0.6}"
    for sigma_m in (0.0, 0.05):
        verdict = judge(recorded(log, start, surveyed(tmp_path, log, sigma_m, {})))
        assert verdict.causes[0].name == "start" and " 3" in verdict.causes[0].evidence  # some 34 deg


def test_a_start_that_may_be_anywhere_is_not_said_to_be_surer(tmp_path: Path) -> None:
    log = log_of()
    start = "robots.rover.start={x_m: 12, y_m: 12, sigma_xy_m: 10, sigma_theta_rad: 3}"
    verdict = judge(recorded(log, start, surveyed(tmp_path, log, 0.0, {})))
    assert (verdict.map, verdict.causes) == ("ok", ())


def test_a_landmark_that_began_with_an_outlier_is_begun_again_and_named() -> None:
    log, begun = log_of(), set[Any]()

    def first_off(e: Event) -> Event:
        if not isinstance(e, Scan) or e.ids is None or not len(e.y):
            return e
        off = [4.0 if i in (3, 8) and i not in begun else 0.0 for i in e.ids]
        begun.update(e.ids)
        return seen(e, y=e.y + np.column_stack([off, np.zeros(len(off))]))

    gated = "filter.association={type: identity, gate: 0.9999}"
    assert judge(recorded(log, gated)).map == "ok"
    verdict = judge(recorded(replace(log, events=[*map(first_off, log.events)]), gated))
    assert verdict.map == "ok"
    named = [cause for cause in verdict.causes if cause.name == "misplaced_landmark"]
    assert sorted(cause.evidence.split()[1] for cause in named) == ["3", "8"]
    assert {cause.name for cause in verdict.causes} <= {"misplaced_landmark", "outliers"}


def test_observations_that_have_the_id_of_another_landmark_are_named() -> None:
    log, rng = log_of(), np.random.default_rng(3)
    events: list[Event] = []
    for e in log.events:
        event = e
        if isinstance(event, Scan) and event.ids is not None and len(event.ids) > 1 and rng.random() < 0.05:
            event = Scan(t_ns=e.t_ns, robot=event.robot, sensor=event.sensor, y=event.y,
                         ids=[event.ids[1], event.ids[0], *event.ids[2:]])  # fmt: skip
        events.append(event)
    assert judge(recorded(replace(log, events=events))).causes[0].name == "wrong_ids"


def test_ranges_that_are_off_among_near_landmarks_do_not_have_wrong_ids() -> None:
    near = ("world.count=60", "world.size_m=12", f"{SIGMA}=0.3", "robots.rover.sensors.lidar.sigma_bearing_rad=0.06",
            "robots.rover.start={x_m: 6, y_m: 6, theta_rad: 0}")  # fmt: skip
    log, rng = simulate(world_of(*near), 3), np.random.default_rng(3)

    def off(e: Event) -> Event:
        if not isinstance(e, Scan) or not len(e.y):
            return e
        bad = rng.random(len(e.y)) < 0.02
        return seen(e, y=e.y + np.column_stack([np.where(bad, rng.choice([2.0, 2.5], len(bad)), 0.0), 0.0 * bad]))

    names = [cause.name for cause in judge(recorded(replace(log, events=[*map(off, log.events)]), *near)).causes]
    assert "outliers" in names
    assert "wrong_ids" not in names


def test_errors_that_last_under_a_noise_that_is_stated_too_large_are_no_systematic_errors() -> None:
    log, rng, last = log_of(), np.random.default_rng(3), dict[Any, Any]()

    def lasting(e: Event) -> Event:
        if not isinstance(e, Scan) or e.ids is None or not len(e.y):
            return e
        for i in e.ids:
            last[i] = 0.95 * last.get(i, np.zeros(2)) + rng.normal(size=2) * (0.1, 0.02) * np.sqrt(1.0 - 0.95**2)
        return seen(e, y=e.y + np.array([last[i] for i in e.ids]), t_ns=e.t_ns + 100_000_000)

    wide = (f"{SIGMA}=0.4", "robots.rover.sensors.lidar.sigma_bearing_rad=0.08")
    log = replace(log, events=sorted(map(lasting, log.events), key=sort_key))
    verdict = judge(recorded(log, *wide))
    assert verdict.search is not None
    found = {f.name: f for f in verdict.search.found}
    assert found["time_offset"].value == pytest.approx(-0.1, abs=3 * found["time_offset"].sigma)
    assert {*found} == {"time_offset", "correlated_noise", "range_sigma", "bearing_sigma"}
    assert all(not c.cure for c in verdict.causes if c.harmless)


def test_the_first_line_of_a_verdict_names_the_cause() -> None:
    verdict = verdict_on(*MISTAKES["bearing_sign"]).as_dict()
    assert next(verdict_lines(verdict)) == "the map is wrong because of bearing_sign"


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_ids_that_mean_each_others_landmarks_are_wrong_and_the_robot_is_not_kidnapped(
    share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no more than a share of the log is filtered at once, too."""
    log, config = log_of(), world_of().config()
    ids = [i for e in log.events if isinstance(e, Scan) for i in e.ids or ()]
    a, b = sorted({*ids}, key=lambda i: (-ids.count(i), i))[:2]
    begin = log.events[len(log.events) // 2].t_ns

    def swapped(e: Event) -> Event:
        if not isinstance(e, Scan) or e.ids is None or e.t_ns < begin:
            return e
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=e.y, ids=[{a: b, b: a}.get(i, i) for i in e.ids])

    log = replace(log, events=[*map(swapped, log.events)])
    run = recorded_under(config, log, pictures=True)
    monkeypatch.setattr(single_ids, "AT_ONCE", int(share * len(run.history.d2)))
    verdict = judge(run)
    assert verdict.causes[0].name == "wrong_ids"
    assert verdict.map == ("ok" if share == 1.0 else "doubtful"), "a part of the log says less of the map"
    assert verdict.causes[0].since_s == pytest.approx(begin * 1e-9, abs=2.0)
    told = [f"what is called {one} is where {other} was" for one, other in ((a, b), (b, a))]
    assert any(words in verdict.causes[0].evidence for words in (told[:1] if share == 1.0 else told))
    # its score is half of the chi-square of what was filtered again, which is at most that of the whole run
    fit = fit_of_run(run)
    assert (100 if share == 1.0 else 50) < verdict.causes[0].score < 0.5 * fit.values @ fit.dof


def test_an_id_on_two_things_is_named() -> None:
    log = log_of()
    ids = [i for e in log.events if isinstance(e, Scan) for i in e.ids or ()]
    pairs = {frozenset((i, j)) for e in log.events if isinstance(e, Scan) for i in e.ids or () for j in e.ids or ()}
    usual = sorted({*ids}, key=lambda i: (-ids.count(i), i))
    a, b = next((a, b) for a in usual for b in usual if a != b and frozenset((a, b)) not in pairs)

    def doubled(e: Event) -> Event:
        if not isinstance(e, Scan) or e.ids is None:
            return e
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=e.y, ids=[a if i == b else i for i in e.ids])

    verdict = judge(recorded(replace(log, events=[*map(doubled, log.events)])))
    assert verdict.causes[0].name == "wrong_ids"
    assert f"id {a} is on two things" in verdict.causes[0].evidence


@pytest.mark.parametrize("gate", ["default", "off"])
def test_wrong_ids_are_named_and_bend_the_map_only_where_all_observations_are_used(gate: str) -> None:
    exact = (f"{SIGMA}=0.03", "robots.rover.sensors.lidar.sigma_bearing_rad=0.004", f"filter.association.gate={gate}")
    rng, made = np.random.default_rng(0), world_of(*exact)

    def mixed(e: Event) -> Event:
        if not isinstance(e, Scan) or e.ids is None:
            return e
        ids = list(e.ids)
        for k in np.flatnonzero(rng.random(len(ids)) < 0.02):
            j = int(rng.integers(len(ids)))
            ids[k], ids[j] = ids[j], ids[k]
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=e.y, ids=ids)

    log = simulate(made, 3)
    log = replace(log, events=[*map(mixed, log.events)])
    run = recorded_under(made.config(), log)
    places = np.array([log.landmarks[name][:2] for name in run.landmarks.ids])
    mapped = run.landmarks.positions()[0]
    off = rmse(rigid(mapped, places)(mapped) - places)
    verdict = judge(run)
    assert [cause.name for cause in verdict.causes if not cause.harmless] == ["wrong_ids"]
    if gate == "off":
        assert off > 0.2 and verdict.map == "doubtful"
        assert verdict.shift_m == pytest.approx(off, rel=0.3)
    else:
        assert off < 0.01 and verdict.map == "ok"


def test_a_landmark_that_moves_by_less_than_the_map_is_good_to_is_no_cause() -> None:
    run = run_of()
    search = judge(run).search
    assert search is not None
    search.found = [Finding("moving_landmark", ("7",), 50.0, 1e-9, 0.001, 0.0001, "m/s", moved_m=0.04)]
    assert causes_of(run, search, accuracy_m=0.05) == []
    (cause,) = causes_of(run, search, accuracy_m=0.03)
    assert "0.04 m while it was seen" in cause.evidence


def test_what_is_left_of_data_is_their_projection_in_textbook_form() -> None:
    run = run_of(settings=("steps=12",))
    log = Log("", ("rover",), simulate(world_of("steps=12"), 3).events)
    run = km.record(build_slam(world_of().config(), log), log, progress=False)
    problem = replay_events(batch_input(run), log)
    linear = Linear.of(problem, optimum(problem).state)
    rng, n, q = np.random.default_rng(1), len(linear.at.z), len(linear.at.w)
    z, e = rng.normal(size=n), rng.normal(size=linear.root.shape[1])
    left = linear.left(z, linear.root @ e)
    # textbook: the white errors e and the data z by generalised least squares, motion as constraints of J dx = root e
    H, J, Q = linear.at.H.toarray(), linear.at.J.toarray(), linear.Q.toarray()
    free = problem.free
    kkt = np.block([[H.T @ H, J.T], [J, -Q]])[:, np.r_[free, np.ones(q, bool)]][np.r_[free, np.ones(q, bool)]]
    rhs = np.concatenate([(H.T @ z)[free], -(linear.root @ e)])
    x = np.linalg.lstsq(kkt, rhs, rcond=None)[0]
    np.testing.assert_allclose(left.r, z - H[:, free] @ x[: free.sum()], atol=1e-7)
    total = left.r @ left.r + left.m @ Q @ left.m
    assert total == pytest.approx(z @ left.r + (linear.root @ e) @ left.m, rel=1e-6)  # a projection


def test_systematic_errors_of_controls_match_differences() -> None:
    log = simulate(world_of("steps=12"), 3)
    config = world_of().config()
    run = km.record(build_slam(config, log), log, progress=False)
    given = batch_input(run)
    problem, h = replay_events(given, log), 1e-6
    for k, error in enumerate(problem.motions.errors):
        c = ("v_mps", "w_radps").index(error.column)
        way = {"offset": lambda u: 1.0, "scale": lambda u, c=c: u[c], "per_way": lambda u: abs(u[0])}[error.kind]

        def more(u: Any, c: int = c, way: Any = way) -> Any:
            u = np.array(u)
            u[c] += h * way(u)
            return u

        other = replay_events(given, map(controlling(more), log.events))
        w, _ = problem.motions.term.at(problem.start)
        w_more, _ = other.motions.term.at(problem.start)
        np.testing.assert_allclose((w - w_more).ravel() / h, problem.motions.systematic[:, k], atol=1e-5)


def test_a_run_folder_is_diagnosed_and_keeps_its_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "random_field", "--out", str(tmp_path / "log"), "--seed", "3", "--set", "steps=150"]) == 0
    config = tmp_path / "log" / "config.yaml"
    source = [str(config)] if config.is_file() else ["random_field"]
    assert main(["run", *source, "--log", str(tmp_path / "log"), "--out", str(tmp_path / "run")]) == 0
    assert "verdict: the map is ok" in capsys.readouterr().out
    assert main(["diagnose", str(tmp_path / "run")]) == 0
    told = capsys.readouterr().out
    assert "the map is ok" in told and "innovations" in told and "against the truth" in told
    assert (tmp_path / "run" / "diagnosis.png").stat().st_size > 10_000
    verdict = json.loads((tmp_path / "run" / "summary.json").read_text())["verdict"]
    assert {"map", "sigma_factor", "causes"} <= verdict.keys()
    assert main(["evaluate", str(tmp_path / "run"), "--batch"]) == 0
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["verdict"] == verdict


def test_the_table_of_innovations_accuses_the_range_that_is_wrong() -> None:
    clean, biased = (breakdown(run_of(change)) for change in (None, FAULTS["range_scale"][0]))
    assert not any(group.alarm for group in clean)
    assert any(group.alarm for group in biased)
    parts = {part: float(value) for _, part, value, _ in nees_parts(run_of())}
    assert set(parts) == {"position", "heading", "pose"}
    assert parts["pose"] < 3


def test_a_filter_that_reads_its_position_is_not_too_sure_against_a_batch_solution_that_does_not() -> None:
    world = load_world("lever_arm", ["steps=300"])
    log, config = simulate(world, 3), world.config()
    verdict = judge(recorded_under(config, log))
    assert not verdict.causes
    assert verdict.sigma_factor is not None and 0.5 < verdict.sigma_factor < 2.0


def test_the_textbook_filter_is_named_as_what_is_too_sure() -> None:
    for estimator, named, factor in (("ekf", ["estimator"], 2.0), ("invariant", [], 0.9)):
        world = load_world("loop_b2", [f"filter.estimator.type={estimator}"])
        log, config = simulate(world, 3), world.config()
        run = recorded_under(config, log)
        verdict = judge(run)
        assert [cause.name for cause in verdict.causes] == named
        assert factor < (verdict.sigma_factor or 0.0) < 3 * factor


def test_a_verdict_in_words_is_short_or_whole() -> None:
    causes = tuple(verdict_on(*FAULTS["bearing_offset"][:2]).causes) * 5
    verdict = Verdict("doubtful", causes, "", 2.0, 0.1, 0.3).as_dict()
    assert len([*verdict_lines(verdict)]) == 5
    assert len([*verdict_lines(verdict, None)]) == 1 + len(causes)


def test_the_verdict_on_a_run_without_landmarks_is_on_its_path() -> None:
    log = hall(0)
    run = mapped(replace(log, events=[e for e in log.events if isinstance(e, km.Control)]))
    assert next(verdict_lines(judge(run).as_dict())).startswith("the path is unchecked: the log does not check it")


def test_a_run_that_used_no_observation_is_not_ok() -> None:
    t_s = [0.5 * k for k in range(1, 40)]
    log = km.log_from(
        controls={"t_s": t_s, "robot": "r", "v_mps": 0.5, "w_radps": 0.1},
        scans={"t_s": t_s, "robot": "r", "sensor": "radio", "id": 1, "rssi_dbm": -60.0},
    )
    radio = km.Mount(km.sensors.SignalStrength2D())
    slam = km.Slam(km.Robot("r", motion=km.motion.Unicycle(), sensors={"radio": radio}))
    verdict = judge(km.record(slam, log, progress=False))
    assert verdict.map == "doubtful"
    assert [cause.evidence for cause in verdict.causes] == ["none of the 39 observations was used"]


def test_a_hall_that_is_mapped_twice_after_a_gap_is_wrong_and_its_wheel_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("kalmark.slam.elsewhere.ODDS", math.inf)  # else it is mapped once
    log = hall(1, gap_s=4.0)
    log = replace(log, events=log.events[: 2 * len(log.events) // 3])
    doubled, bridged = (km.diagnose(mapped(log, gaps=gaps)) for gaps in ("ignore", "widen"))
    assert (doubled.map, [cause.name for cause in doubled.causes[:2]]) == ("wrong", ["gap", "odometry_turn"])
    assert "places are mapped again after it" in doubled.causes[0].evidence
    assert (bridged.map, bridged.causes[0].name) == ("ok", "odometry_turn")
    assert "sigma_turn_rad_per_m" in bridged.causes[0].cure
    assert "estimator" not in [cause.name for cause in bridged.causes]
    assert [cause.harmless for cause in bridged.causes if cause.name == "gap"] == [True]


def test_scans_that_come_twice_are_named_and_count_once() -> None:
    log = simulate(world_of("steps=200"), 3)
    again = [seen(e, t_ns=e.t_ns + 1_000_000) for e in log.events if isinstance(e, Scan)]
    log = replace(log, events=sorted([*log.events, *again], key=sort_key))
    verdict = judge(recorded(log))
    assert [cause.name for cause in verdict.causes] == ["copies"]
    number, _, of, *_ = verdict.causes[0].evidence.split()
    assert 190 <= int(number) <= 200 and of == "400"  # the first ones tell how fine the numbers are
    assert (verdict.map, verdict.causes[0].harmless) == ("ok", True)
    assert 0.9 < (verdict.sigma_factor or 0.0) < 1.1


def test_segments_of_a_long_log_have_scans_enough_of_each_robot() -> None:
    world = load_world("two_robots", ["steps=400"])
    log = simulate(world, 0)
    run = km.record(build_slam(world.config(), log), log, progress=False)
    given = subsample(run, batch_input(run), 600)
    assert given.segments is not None and len(given.segments) > 1
    for begin, end in given.segments.tolist():
        robots = given.robot[(given.t_ns >= begin) & (given.t_ns <= end)]
        assert all((robots == name).sum() >= SEGMENT - 1 for name in given.robots)


def test_copies_come_in_pairs_and_a_sensor_that_repeats_itself_for_long_has_none() -> None:
    def copies_in(values: list[float]) -> int:
        return int(repeated_measurements(np.array(values).reshape(-1, 1), np.arange(len(values))).sum())

    noise = [float(k) for k in range(1, 21)]
    assert copies_in([a for value in noise for a in (value, value)]) == 20
    assert [copies_in(values) for values in (noise, [1.0] * 40, [0.0, 1.0] * 40, [])] == [0, 0, 0, 0]


def test_a_scan_is_a_copy_if_all_its_rows_are() -> None:
    first = np.arange(0, 80, 2)  # scans of two rows, the second of each pair a copy
    y = np.repeat(np.arange(80.0).reshape(20, 4), 2, axis=0).reshape(-1, 2)
    assert repeated_measurements(y, first).sum() == 20
    y[7, 1] += 1e-12
    assert repeated_measurements(y, first).sum() == 19
    with_more = np.delete(first, 1)  # one scan of four rows: the next is no copy of it
    assert repeated_measurements(y, with_more).sum() == 18


def test_noise_of_several_columns_is_no_outliers() -> None:
    settings = ("range_m", "azimuth_rad", "elevation_rad")
    stated = (0.04, 0.007, 0.007)
    overrides = [f"filter.robots.robot.sensors.lidar.sigma_{c}={s}" for c, s in zip(settings, stated, strict=True)]
    world = load_world("thick_cloister", ["steps=120", *overrides])
    log, config = simulate(world, 2), world.config()
    verdict = judge(recorded_under(config, log))
    assert {cause.name for cause in verdict.causes[:3]} == {"range_sigma", "azimuth_sigma", "elevation_sigma"}
    assert verdict.map == "ok"


def test_a_noise_that_was_found_before_a_systematic_error_counts_what_that_leaves_of_it() -> None:
    again = copy(verdict_on(*FAULTS["mount_position"][:2]).search)
    assert again is not None
    again.linear, again.found, again.simulated = again.first, [], again.first.simulated(40)
    candidates = again.candidates()
    noise = max((f for f in candidates if f.takes_up), key=lambda f: f.gain)
    mount = max((f for f in candidates if f.name == "mount_position"), key=lambda f: f.gain)
    assert again.likeliest([replace(noise, gain=2.0 * mount.gain), mount]).name == "mount_position"
    again.take(noise)
    again.take(next(f for f in again.candidates() if (f.name, f.of) == (mount.name, mount.of)))
    again._leave_out_explained()
    left = {(f.name, f.of): f.gain for f in again.found}
    assert left[mount.name, mount.of] > 20.0
    assert left.get((noise.name, noise.of), 0.0) < 0.5 * noise.gain


def test_an_error_of_controls_in_a_gap_of_them_is_no_cause() -> None:
    run: Any = SimpleNamespace(
        history=SimpleNamespace(t_ns=np.array([10**9]), at_s=lambda _: 1.0),
        summary={"gaps": [{"robot": "a", "kind": "held", "start_s": 5.0, "end_s": 9.0}]},
    )
    slip = Finding("odometry_turn", ("a", "w_radps", "scale"), 90.0, 0.0, 1.0, Z=np.zeros(1), W=np.ones(1), since_s=4.5)
    assert _is_of_gap(run, replace(slip, until_s=7.0))
    assert not _is_of_gap(run, slip)  # to the end
    assert not _is_of_gap(run, replace(slip, since_s=3.0, until_s=7.0))
    assert not _is_of_gap(run, replace(slip, of=("b", "w_radps", "scale"), until_s=7.0))
    assert not _is_of_gap(run, replace(slip, W=np.zeros(1), until_s=7.0))  # of a sensor
    assert not _is_of_gap(run, replace(slip, of=(), until_s=7.0))  # of all sensors


def test_no_error_of_controls_adds_to_a_gap() -> None:
    course = Course(km.Robot("a", km.motion.Unicycle()), 0)
    u, unknown = np.array([1.0, 0.1]), np.diag([4.0, 4.0, 0.1])
    course.add(MotionPart(u, np.eye(2), 1.0, True, True, unknown), [])
    assert not course.T.any()
    assert course.Q[-1] == pytest.approx(0.0)
    assert np.trace(course.Q[-2]) == pytest.approx(8.1)
    course.add(MotionPart(u, np.eye(2), 1.0, True, True), [])
    assert course.T.any()


def test_the_cure_of_a_control_noise_names_the_key_of_its_column() -> None:
    config = {"robots": {"a": {"motion": {"sigma_theta_rad": 0.01, "sigma_x_m": 0.02}}}}
    finding = Finding("control_sigma", ("a", "dtheta_rad"), 10.0, 0.0, 3.0, 0.1, "times")
    assert finding_text(finding, config)[1] == "--set robots.a.motion.sigma_theta_rad=0.03"
    assert finding_text(replace(finding, of=("a", "dx_m")), config)[1] == "--set robots.a.motion.sigma_x_m=0.06"


def test_a_map_of_tags_is_judged_by_its_batch_solution() -> None:
    world = load_world("tags_room", ["steps=60", "filter.robots.rig.sensors.camera.sigma_px=0.25"])
    log, config = simulate(world, 2), world.config()
    verdict = judge(recorded_under(config, log))
    assert verdict.checked.startswith("batch solution")
    (cause,) = verdict.causes
    assert cause.name == "measurement_sigma"
    assert float(cause.cure.removeprefix("--set robots.rig.sensors.camera.sigma_px=")) == pytest.approx(0.5, rel=0.1)


def test_bearings_alone_accuse_no_odometry() -> None:
    settings = (
        "world.count=35", "world.size_m=18", "steps=900", "dt_s=0.15", "noise_on=robot",
        "robots.rover.start={x_m: 9, y_m: 4}",
        "robots.rover.route={type: wander, speed_mps: 0.6, turn_radius_m: 1}",
        "robots.rover.motion={type: odometry_2d, sigma_x_m: 0.01, sigma_y_m: 0.005, sigma_theta_rad: 0.005}",
        "robots.rover.sensors={eye: {type: bearing, range_max_m: 8, initialization: {type: delayed}}}",
        "robots.rover.sensors.eye.sigma_bearing_rad=0.01",
    )  # fmt: skip
    world = load_world("random_field", settings)
    log, config = simulate(world, 1), world.config()
    run = recorded_under(config, log)
    for verdict in (judge(run), km.diagnose(run, 3000)):
        assert verdict.map == "ok" and not verdict.causes


@pytest.mark.parametrize("seed", [1, 2])
def test_bearings_alone_on_a_circle_accuse_no_mount(seed: int) -> None:
    world = load_world("camera", ["steps=100"])
    log = simulate(world, seed)
    verdict = judge(recorded_under(world.config(), log))
    assert (verdict.map, verdict.robots) == ("ok", {"robot": "ok"})
    assert not [cause.name for cause in verdict.causes if not cause.harmless]


def test_a_mount_that_is_elsewhere_leaves_the_map_ok_and_not_the_path() -> None:
    run, verdict = (of(*FAULTS["mount_position"][:2]) for of in (run_of, verdict_on))
    summary = run.evaluate()
    assert (verdict.map, verdict.robots) == ("ok", {"rover": "doubtful"})
    assert summary["robots"]["rover"]["pose_nees"] > 20 and summary["landmark_rmse_m"] < 0.15
    told = next(verdict_lines(verdict.as_dict()))
    assert told.startswith("the map is ok: ")
    assert told.endswith("; but the path of rover is doubtful because of mount_position")
    assert (verdict_on().map, verdict_on().robots) == ("ok", {"rover": "ok"})


def test_a_gate_that_is_tight_makes_no_noise_too_large() -> None:
    """Innovations that are cut off at a gate of .9 have .74 of their variance."""
    run = run_of(settings=("filter.association={type: identity, gate: 0.9}",))
    assert (run.history.outcome == "rejected").mean() > 0.08
    told = {cause.name for cause in judge(run).causes}
    assert not told & {"range_sigma", "bearing_sigma"}, told
    assert not run.summary["advice"]


def test_the_accuracy_that_is_told_has_what_a_systematic_error_does_to_the_map() -> None:
    verdict = verdict_on(*FAULTS["range_scale"][:2])
    assert verdict.search is not None
    linear = verdict.search.linear
    places = linear.state.groups[LANDMARKS][:, :2]
    off = 0.05 * np.sqrt(np.mean(np.sum((places - places.mean(axis=0)) ** 2, axis=1)))
    assert verdict.shift_m == pytest.approx(off, rel=0.25)
    assert verdict.accuracy_m is not None
    assert verdict.accuracy_m > 0.7 * off
