"""Is the work of a verdict counted and bounded, and does it name what it left out?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import pytest

import kalmark as km
from kalmark.config import build_slam, config_dict
from kalmark.diagnosis import trials
from kalmark.diagnosis.batch_verdict import judged
from kalmark.diagnosis.causes import Finding
from kalmark.diagnosis.cures import with_cures, without_error
from kalmark.diagnosis.gross_mistakes import likeliest
from kalmark.diagnosis.mistakes import late_scans
from kalmark.diagnosis.trials import CONTROL, HARDER, OBSERVATION, PART, SCAN, THOROUGH, Trials, work_of
from kalmark.diagnosis.verdict import Verdict
from kalmark.events import Control, Scan
from kalmark.logs.log import Log
from kalmark.results.record import Recorder
from kalmark.results.run import Run
from kalmark.results.verdict_text import verdict_lines
from kalmark.simulate import load_world, simulate

FIELD = ("world.count=16", "world.size_m=16", "steps=160", "robots.rover.start={x_m: 8, y_m: 8, theta_rad: 0}",
         "robots.rover.sensors.lidar.fov_rad=6.2832")  # fmt: skip


def run_of(mirrored: bool) -> tuple[Run, Log]:
    """Return the run of a log whose bearings may have the wrong sign, and that log."""
    world = load_world("random_field", FIELD)
    log, config = simulate(world, 4), world.config()
    sign = -1.0 if mirrored else 1.0
    events = [replace(e, y=e.y * [1.0, sign]) if isinstance(e, Scan) else e for e in log.events]
    log = replace(log, events=events, truth={})
    return km.record(build_slam(config, log), log, progress=False, config=config_dict(config), pictures=False), log


def poor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave a brief verdict its share of the run's own work alone."""
    monkeypatch.setattr(trials, "BRIEF", 0)


def test_the_work_of_events_is_a_count() -> None:
    control = Control(t_s=0.0, robot="r", u=(1.0, 0.0))
    ranges = Scan(t_s=0.0, robot="r", sensor="s", y=[[1.0]], ids=[1])
    known, unknown = (Scan(t_s=0.0, robot="r", sensor="s", y=[[1.0, 0.0]] * 3, ids=ids) for ids in ([1, 2, 3], None))
    assert work_of([control]) == CONTROL
    assert work_of([known]) == SCAN + 3 * OBSERVATION
    assert work_of([ranges]) == HARDER * (SCAN + OBSERVATION)
    assert work_of([control, unknown]) == CONTROL + HARDER * (SCAN + 3 * OBSERVATION)


def test_a_filter_takes_the_work_of_its_events_off_the_budget() -> None:
    run, log = run_of(False)
    engine = Trials(1e9)
    assert engine.filter(run.config, log, log.events) is not None
    assert 1e9 - engine.work == PART + work_of(log.events)


def test_a_search_that_the_budget_does_not_pay_is_named_once() -> None:
    engine = Trials(100)
    assert engine.pays("cheap", 100) and not engine.left_out
    assert not engine.pays("dear", 101) and not engine.pays("dear", 200)
    assert engine.left_out == {"dear": ""}


def test_a_verdict_that_was_asked_for_has_a_far_larger_budget() -> None:
    _, log = run_of(False)
    assert Trials.of(log, brief=False, progress=False).work == THOROUGH * Trials.of(log, True, False).work
    many = replace(log, events=[*log.events] * 1000)
    assert Trials.of(many, True, False).work == pytest.approx(0.3 * work_of(many.events))


def test_a_clean_log_is_ok_and_nothing_of_it_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    poor(monkeypatch)
    verdict = km.diagnose(run_of(False)[0], 3000, brief=True)
    assert (verdict.map, verdict.left_out) == ("ok", ())


def test_what_a_brief_verdict_leaves_out_is_told_and_no_ok(monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_of(True)[0]
    with monkeypatch.context() as short:
        poor(short)
        brief = km.diagnose(run, 3000, brief=True)
    assert brief.map != "ok" and "units, signs, columns, mounts and times" in brief.left_out
    assert run.summary["verdict"]["left_out"] == [*brief.left_out]
    *_, last = verdict_lines(brief.as_dict())
    assert last.startswith("not looked at: ") and last.endswith("; kalmark diagnose RUN looks further")
    asked = km.diagnose(run)
    assert (asked.map, asked.causes[0].name, asked.left_out) == ("wrong", "bearing_sign", ())


def test_a_map_whose_log_does_not_fit_is_not_ok_where_its_reason_was_not_looked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = run_of(True)[0]
    poor(monkeypatch)
    monkeypatch.setattr("kalmark.diagnosis.verdict._of_causes", lambda run, log, most, engine: left_out(engine))
    verdict = km.diagnose(run, brief=True)
    assert verdict.map == "doubtful" and verdict.causes[0].name == "misfit"


def left_out(engine: Trials) -> Verdict:
    engine.left_out["all"] = ""
    return Verdict("ok", (), "nothing")


def test_a_race_keeps_to_its_share_of_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    """The likeliest changes go on: with a fifth of the work the mistake is found as well."""
    run, log = run_of(True)
    budget = 10.0 * work_of(log.events)
    engine, taken, take = Trials(budget), [], Recorder.take

    def counted(self: Recorder, events: Iterable[Any], *more: Any) -> None:
        part = [*events]
        taken.append(work_of(part))
        take(self, part, *more)

    monkeypatch.setattr(Recorder, "take", counted)
    mistake = likeliest(run, log, engine)
    assert mistake is not None and mistake.name == "bearing_sign"
    assert engine.left_out["units, signs, columns, mounts and times"].startswith(" after ")
    assert budget - engine.work <= sum(taken) + PART * len(taken) < 0.6 * budget


def test_an_error_whose_cure_is_not_paid_is_named_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    run, _ = run_of(False)
    late = late_scans(run.config, "rover", 0.1)._replace(gain=100.0)
    poor(monkeypatch)
    monkeypatch.setattr("kalmark.diagnosis.verdict.gross", lambda *_: (late, None))
    verdict = km.diagnose(run, 3000, brief=True)
    assert (verdict.map, verdict.causes[0].name) == ("doubtful", "time_offset")
    assert "cures of small errors" in verdict.left_out


def late_run() -> tuple[Run, Log]:
    """Return the run of a log whose scans are stamped .15 s late, and that log."""
    run, log = run_of(False)
    events = [replace(e, t_ns=e.t_ns + 150_000_000) if isinstance(e, Scan) else e for e in log.events]
    late = replace(log, events=sorted(events, key=trials.sort_key))
    again = Trials().filter(run.config, late, late.events)
    assert again is not None
    return again, late


def test_a_cure_is_tried_on_the_first_part_of_a_log_that_the_budget_pays() -> None:
    again, late = late_run()
    mistake = late_scans(again.config, "rover", -0.12)
    finding = Finding(mistake.name, mistake.of, 0.0, 0.0, mistake.value, unit=mistake.unit)
    gain, without, _, _ = without_error(again, late, finding, Trials())
    part, *same = without_error(again, late, finding, Trials(0.6 * work_of(late.events)))
    assert without is not again and gain > part > trials.SURELY
    assert same == [again, late, finding]


def test_late_scans_have_the_size_with_which_the_log_is_likeliest() -> None:
    again, late = late_run()
    verdict, _ = with_cures(again, late, judged(again, late, [], 3000, Trials()), True, 3000, Trials())
    assert verdict.causes[0].name == "time_offset"
    (line,) = trials.options_of(verdict.causes[0].cure)
    assert float(line.partition("=")[2]) == pytest.approx(-0.15, abs=0.01)
