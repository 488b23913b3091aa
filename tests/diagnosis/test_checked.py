"""Verdicts that are earned: by the log alone, without its truth, and only where the log checks map and paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam, config_dict
from kalmark.diagnosis import doubled_landmarks
from kalmark.diagnosis.trials import fit_of_run
from kalmark.events import Control, Event, Scan
from kalmark.logs.log import Log, Trajectory
from kalmark.results.evaluate import evaluate
from kalmark.results.run import Run
from kalmark.results.verdict_text import alarm, verdict_lines
from kalmark.results.warnings import signs
from kalmark.simulate import load_world, simulate

FIELD = ("world.count=20", "world.size_m=20", "steps=250", "robots.rover.start={x_m: 10, y_m: 10, theta_rad: 0}")
Change = Callable[[Event], Event]


def simulated(world: str, settings: tuple[str, ...], change: Change | None = None) -> tuple[Log, Callable[[Log], Run]]:
    """Return the log of a world, its events changed, and what filters a log as the world says."""
    made = load_world(world, settings)
    log = simulate(made, 3)
    log = log if change is None else replace(log, events=[*map(change, log.events)])

    def run_of(log: Log) -> Run:
        config = made.config()
        return km.record(build_slam(config, log), log, progress=False, config=config_dict(config))

    return log, run_of


def with_scans(change: Callable[[Scan], Scan]) -> Change:
    return lambda e: change(e) if isinstance(e, Scan) else e


def scan_of(e: Scan, rows: slice = slice(None), **changes: object) -> Scan:
    ids = None if e.ids is None else e.ids[rows]
    of: dict[str, object] = {"t_ns": e.t_ns, "robot": e.robot, "sensor": e.sensor, "y": e.y[rows], "ids": ids}
    return Scan(**(of | changes))  # type: ignore[arg-type]


def carried(e: Event) -> Event:
    """Return a control that turns by half a radian at one time."""
    at = isinstance(e, Control) and abs(e.t_s - 12.0) < 0.01
    return Control(t_ns=e.t_ns, robot=e.robot, u=np.add(e.u, [0.0, 5.0])) if at and isinstance(e, Control) else e


@pytest.mark.parametrize(
    ("world", "settings", "change"),
    [
        ("random_field", FIELD, None),
        ("random_field", FIELD, with_scans(lambda e: scan_of(e, y=np.add(e.y, [0.0, 0.05])))),
        ("random_field", (*FIELD, "ids=false"), carried),
        ("lever_arm", ("steps=300",), None),
    ],
    ids=["clean", "bearings off", "turned, without ids", "a receiver"],
)
def test_a_verdict_is_the_same_with_truth_without_and_with_a_wrong_one(
    world: str, settings: tuple[str, ...], change: Change | None
) -> None:
    log, run_of = simulated(world, settings, change)
    wrong = {name: Trajectory(t.t_ns, np.add(t.poses, [50.0, 0.0, 0.0])) for name, t in log.truth.items()}
    elsewhere = replace(log, truth=wrong, landmarks={name: place + 50.0 for name, place in log.landmarks.items()})
    runs = [run_of(each) for each in (log, log.without_truth(), elsewhere)]
    first, *others = [km.diagnose(run, brief=True).as_dict() for run in runs]
    assert all(other == first for other in others)
    assert runs[0].summary["robots"] != runs[1].summary["robots"]  # figures of an evaluation are against the truth


def test_a_run_that_diverged_by_the_truth_alone_is_warned_of_and_not_judged_by_it() -> None:
    log, run_of = simulated("random_field", FIELD)
    far = {
        name: Trajectory(t.t_ns, t.poses + np.outer(np.arange(len(t)), [1.0, 0, 0])) for name, t in log.truth.items()
    }
    run = run_of(replace(log, truth=far))
    assert km.diagnose(run).map == "ok"
    assert run.summary["diverged"] and any(line.startswith("DIVERGED") for line in run.summary["warnings"])


def test_dead_reckoning_alone_is_unchecked() -> None:
    log, run_of = simulated("random_field", FIELD)
    run = run_of(replace(log, events=[e for e in log.events if isinstance(e, Control)]))
    verdict = km.diagnose(run)
    assert (verdict.map, verdict.robots) == ("unchecked", {"rover": "unchecked"})
    assert next(verdict_lines(verdict.as_dict())) == "the path is unchecked: the log does not check it"


def test_things_that_are_seen_once_each_are_unchecked() -> None:
    log, run_of = simulated("random_field", FIELD)
    first = next(e for e in log.events if isinstance(e, Scan) and len(e.y))
    verdict = km.diagnose(run_of(replace(log, events=[e for e in log.events if isinstance(e, Control) or e is first])))
    assert verdict.map == "unchecked"
    assert "nothing was observed twice: no observation checks another one" in [c.evidence for c in verdict.causes]


def test_a_robot_that_never_moved_has_no_error_of_its_controls() -> None:
    log, run_of = simulated("differential_drive", ())
    first = next(e for e in log.events if isinstance(e, Scan) and len(e.y))
    verdict = km.diagnose(run_of(replace(log, events=[first for _ in range(6)])))
    assert not [cause for cause in verdict.causes if cause.name.startswith("odometry")]


def test_a_map_of_which_most_observations_are_unused_is_unchecked() -> None:
    log, run_of = simulated("random_field", FIELD)
    run = run_of(log)
    unused = np.arange(len(run.history.step)) % 3 > 0
    outcome, reason = np.where(unused, "deferred", run.history.outcome), np.where(unused, "no answer", "")
    found = replace(run, history=replace(run.history, outcome=outcome, reason=reason), summary={})
    line = f"{unused.sum()} of {len(unused)} observations were deferred, most often: no answer"
    assert line in evaluate(found)["warnings"]
    assert km.diagnose(found).map != "ok"


def test_a_robot_whose_last_half_is_dead_reckoning_is_not_covered_by_a_map_that_is_ok() -> None:
    log, run_of = simulated("random_field", FIELD)
    half = log.events[len(log.events) // 2].t_ns
    verdict = km.diagnose(
        run_of(replace(log, events=[e for e in log.events if isinstance(e, Control) or e.t_ns < half]))
    )
    assert (verdict.map, verdict.robots) == ("ok", {"rover": "unchecked"})
    line = next(verdict_lines(verdict.as_dict()))
    assert line.startswith("the map is ok") and line.endswith("; but the path of rover is unchecked")
    assert alarm(verdict.as_dict())[0] == line


def test_observations_that_do_not_fit_at_the_end_of_a_robot_are_no_ok() -> None:
    log, run_of = simulated("random_field", FIELD)
    end = log.events[-1].t_ns - 3_000_000_000
    off = [scan_of(e, y=np.add(e.y, [3.0, 0.0])) if isinstance(e, Scan) and e.t_ns > end else e for e in log.events]
    verdict = km.diagnose(run_of(replace(log, events=off)))
    assert verdict.map != "ok" and verdict.robots["rover"] != "ok"


def test_things_in_a_map_twice_are_not_seen_again_where_they_were() -> None:
    log, run_of = simulated("random_field", (*FIELD, "steps=700"))
    half = log.events[len(log.events) // 2].t_ns
    doubled = with_scans(lambda e: e if e.t_ns < half else scan_of(e, ids=[1000 + int(str(i)) for i in e.ids or ()]))
    clean, twice = run_of(log), run_of(replace(log, events=[*map(doubled, log.events)]))
    assert doubled_landmarks.unseen_counts(clean) is None
    found = doubled_landmarks.unseen_counts(twice)
    assert found is not None and found.since_s > half * 1e-9 - 1.0
    verdict = km.diagnose(twice)
    assert verdict.map == "doubtful" and "unseen_landmarks" in [cause.name for cause in verdict.causes]


def test_what_a_budget_leaves_out_is_no_misfit() -> None:
    log, run_of = simulated("random_field", FIELD)
    run = run_of(log)
    outcome, reason = run.history.outcome.copy(), run.history.reason.astype("U40")
    outcome[::2], reason[::2] = "ignored", "not among the 10 of most information"
    assert fit_of_run(replace(run, history=replace(run.history, outcome=outcome, reason=reason))).mean < 2.0
    assert fit_of_run(replace(run, history=replace(run.history, outcome=outcome))).mean > 10.0


def test_warnings_by_the_truth_leave_an_ok() -> None:
    log, run_of = simulated("random_field", FIELD)
    run = run_of(log)
    summary = run.evaluate()
    found = signs(run, summary | {"repeats": [], "diverged": True, "robots": {"rover": {"diverged": True}}})
    assert found[0].line.startswith("DIVERGED") and {sign.status for sign in found} == {"ok"}  # no verdict reads truth
