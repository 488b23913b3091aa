"""Faults that the order of observations shows: a robot that was carried away, a thing that is in the map twice."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hall import hall, mapped

import kalmark as km
from kalmark.diagnosis import doubled_landmarks
from kalmark.events import Control, Scan
from kalmark.results.history import History

NEAR, FAR, POST = (5.0, 0.0), (5.2, 0.0), (0.0, 5.0)


def seen(*scans: str, **places: tuple[float, float]) -> Any:
    """Return a run of scans, 1 s apart, of landmarks named by single letters."""
    step = np.repeat(np.arange(len(scans)), [len(scan) for scan in scans])
    history = object.__new__(History)  # of the fields that are read
    vars(history).update(
        t_ns=np.arange(len(scans)) * 10**9, step=step, landmark=np.array([*"".join(scans)]),
        outcome=np.full(len(step), "associated"), id=np.full(len(step), ""), robot=np.full(len(scans), "rover"),
        sensor=np.full(len(step), "lidar"),
    )  # fmt: skip
    means = [np.array(place) for place in places.values()]
    return SimpleNamespace(history=history, landmarks=SimpleNamespace(ids=[*places], means=means, in_space=False))


def test_one_thing_is_seen_in_turn_and_two_are_seen_together() -> None:
    in_turn = seen(*12 * ("ac", "bc", "ac", "ac", "bc"), a=NEAR, b=FAR, c=POST)
    for ids in ("", in_turn.history.landmark):  # one thing has two ids
        vars(in_turn.history)["id"] = np.where(in_turn.history.step >= 0, ids, "")
        assert [(pair.name, pair.other) for pair in doubled_landmarks.find_split_landmarks(in_turn)] == [("a", "b")]
    assert not doubled_landmarks.find_split_landmarks(
        seen(*12 * ("ac", "bc", "abc", "ac", "bc"), a=NEAR, b=FAR, c=POST)
    )


def test_two_sensors_are_never_in_one_scan() -> None:
    in_turn = seen(*12 * ("ac", "bc", "ac", "ac", "bc"), a=NEAR, b=FAR, c=POST)
    of_b = np.isin(in_turn.history.step, in_turn.history.step[in_turn.history.landmark == "b"])
    vars(in_turn.history)["sensor"] = np.where(of_b, "rear", "front")
    assert not doubled_landmarks.find_split_landmarks(in_turn)


def test_two_sides_of_a_wall_and_scans_of_single_landmarks_say_nothing() -> None:
    assert not doubled_landmarks.find_split_landmarks(seen(*30 * ("ac",), *30 * ("bc",), a=NEAR, b=FAR, c=POST))
    assert not doubled_landmarks.find_split_landmarks(seen(*30 * ("a", "b"), a=NEAR, b=FAR))


def test_landmarks_vanish_at_once_or_one_after_the_other() -> None:
    def moments(*scans: str) -> list[tuple[float, int, bool]]:
        found = doubled_landmarks.vanished_landmarks(seen(*scans, **dict.fromkeys("abcdefghijkl", NEAR)))
        return [(moment.t_s, moment.number, moment.score > 0.0) for moment in found]

    before, after = 90 * ("abcdef",), 90 * ("ghijkl",)
    assert moments(*before, *after) == [(90.0, 6, True)]
    assert moments(*before, *3 * ("ghijkl",), *before) == []  # a few bad scans
    assert moments(*before, *9 * ("ghijkl",), *before)[0] == (90.0, 6, False)  # seen again
    assert not moments(*before, *90 * ("fghijk",))
    assert not moments(*9 * ("abc",), *after)
    some = 60 * ("ab", "cd", "ef")  # of which only a third is in a scan: what is not in the next ones says less
    assert all(number == 6 for _, number, _ in moments(*some, *after))


def test_landmarks_that_ids_tell_do_not_vanish() -> None:
    run = seen(*90 * ("abcdef",), *90 * ("ghijkl",))
    vars(run.history)["id"] = run.history.landmark
    assert doubled_landmarks.vanished_landmarks(run) == []


@pytest.mark.parametrize("carried_m", [0.0, 5.0])
def test_a_robot_that_is_carried_away_is_found_and_named(carried_m: float) -> None:
    log = hall(2, bad_wheel=False)
    middle = log.events[len(log.events) // 2].t_ns
    truth = log.truth["rover"]
    rng, places = np.random.default_rng(0), np.array([*log.landmarks.values()])

    def moved(event: Scan) -> Scan:
        pose = truth.poses[np.searchsorted(truth.t_ns, event.t_ns)] - (0.0, carried_m, 0.0)
        y = km.geometry.observe(pose, places)[0] + rng.normal(size=(len(places), 2)) * (0.03, 0.01)
        return Scan(t_ns=event.t_ns, robot="rover", sensor="laser", y=y[y[:, 0] < 8.0])

    events = [moved(e) if isinstance(e, Scan) and e.t_ns > middle else e for e in log.events]
    verdict = km.diagnose(mapped(replace(log, events=events)))
    names = [cause.name for cause in verdict.causes]
    assert verdict.map == "ok"
    if carried_m:
        assert (names[0], verdict.robots["rover"]) == ("kidnapped", "doubtful")
        assert all(cause.harmless for cause in verdict.causes)
        assert verdict.checked.startswith("batch solution")
        assert verdict.causes[0].since_s == pytest.approx(middle * 1e-9, abs=0.5)
    else:
        assert "kidnapped" not in names


def test_a_control_far_too_large_is_named_and_its_robot_found() -> None:
    log = hall(2, bad_wheel=False)
    k = next(k for k, e in enumerate(log.events) if isinstance(e, Control) and 2 * k > len(log.events))
    far = log.events[k]
    assert isinstance(far, Control)
    events = [*log.events[:k], replace(far, u=np.add(far.u, (5.0, 0.0, 0.0))), *log.events[k + 1 :]]
    verdict = km.diagnose(mapped(replace(log, events=events)))
    first = verdict.causes[0]
    assert (verdict.map, first.name, first.harmless) == ("ok", "odometry_jump", True)
    assert first.since_s == pytest.approx(far.t_s) and "dx_m" in first.evidence and "max_speed_mps" in first.cure
    assert "kidnapped" not in [cause.name for cause in verdict.causes]


def test_a_noise_that_is_stated_too_small_is_named_for_the_landmarks_that_it_splits() -> None:
    rng, log = np.random.default_rng(1), hall(3, bad_wheel=False)

    def noisier(event: Scan) -> Scan:
        y = event.y + rng.normal(size=event.y.shape) * (0.1, 0.0)
        return Scan(t_ns=event.t_ns, robot="rover", sensor="laser", y=y[y[:, 0] > 0.0])

    events = [noisier(e) if isinstance(e, Scan) else e for e in log.events[: len(log.events) // 3]]
    verdict = km.diagnose(mapped(replace(log, events=events)))
    assert verdict.map != "ok"
    names = [cause.name for cause in verdict.causes[:3]]
    assert names[0] == "range_sigma" and "split_landmarks" not in names  # the noise explains them


@pytest.mark.usefixtures("never_found")
def test_scans_that_are_late_are_named_before_the_map_that_they_double_by_the_verdict_of_a_run() -> None:
    log = hall(2, bad_wheel=False)
    late = [
        Scan(t_ns=e.t_ns + 200_000_000, robot="rover", sensor="laser", y=e.y) if isinstance(e, Scan) else e
        for e in log.events[: len(log.events) // 2]
    ]
    verdict = km.diagnose(mapped(replace(log, events=sorted(late, key=km.events.sort_key))), 3_000)
    names = [cause.name for cause in verdict.causes]
    assert (verdict.map, names[0]) == ("wrong", "time_offset")
    assert "map_repeats" not in names  # the delay explains it
