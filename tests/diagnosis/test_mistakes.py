"""Are mistakes with units, signs, mounts and times named, from when on, and do the lines that cure them do so?"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam, config_dict
from kalmark.config.tree import parse_value
from kalmark.diagnosis.gross_mistakes import gross, likeliest
from kalmark.diagnosis.mistakes import Mistake, mistakes
from kalmark.diagnosis.trials import FITS, MISFIT, Fit, Trials, _in_race, fit_of_run
from kalmark.events import Control, Event, Scan
from kalmark.logs.log import Log
from kalmark.logs.log_corrections import correct_log
from kalmark.results.record import Recorder
from kalmark.results.run import Run
from kalmark.simulate import load_world, simulate

FIELD = ("world.count=16", "world.size_m=16", "steps=160", "robots.rover.start={x_m: 8, y_m: 8, theta_rad: 0}",
         "robots.rover.sensors.lidar.fov_rad=6.2832")  # fmt: skip
CORNERS = ("world={type: list, points_m: [[2, 2], [13, 3], [14, 12], [3, 14]]}",)
Change = Callable[[Event], Event]


def run_of(log: Log, settings: tuple[str, ...] = ()) -> Run:
    config = load_world("random_field", [*FIELD, *settings]).config()
    return km.record(
        build_slam(config, log), log, progress=False, config=config_dict(config), on_error="skip", pictures=False
    )


def log_of(change: Change, settings: tuple[str, ...] = ()) -> Log:
    log = simulate(load_world("random_field", [*FIELD, *settings]), 4)
    return replace(log, events=[*map(change, log.events)], truth={})


def measuring(change: Callable[[Any], Any], from_s: float = 0.0) -> Change:
    def changed(e: Event) -> Event:
        if not isinstance(e, Scan) or e.t_s < from_s:
            return e
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=change(e.y), ids=e.ids)

    return changed


def controlling(factors: tuple[float, float], times: float = 1.0) -> Change:
    def changed(e: Event) -> Event:
        t_ns = round(e.t_ns * times)
        if isinstance(e, Control):
            return Control(t_ns=t_ns, robot=e.robot, u=e.u * factors)
        assert isinstance(e, Scan)
        return Scan(t_ns=t_ns, robot=e.robot, sensor=e.sensor, y=e.y, ids=e.ids)

    return changed


def cured(log: Log, mistake: Mistake) -> Log:
    """Return a log as it is read with the line of a cure."""
    options: dict[str, Any] = {"factors": {}, "shift_s": {}}
    for line in mistake.cure.split("--set ")[1:]:
        path, _, value = line.strip().partition("=")
        _, option, *names = path.split(".")
        section = options[option]
        for name in names[:-1]:
            section = section.setdefault(name, {})
        section[names[-1]] = parse_value(value, "cure")
    return correct_log(log, **options)


CASES: dict[str, tuple[Change, str, str]] = {
    "mirrored": (
        measuring(lambda y: y * [1.0, -1.0]),
        "bearing_sign",
        "clockwise.*does not distinguish.*turns of rover",
    ),
    "turns": (controlling((1.0, -1.0)), "bearing_sign", "does not distinguish.*turns of rover"),
    "degrees": (measuring(lambda y: y * [1.0, 180 / np.pi]), "units", "rover.lidar.*degrees"),
    "millimetres": (measuring(lambda y: y * [1e3, 1.0]), "units", "rover.lidar.*millimetres"),
    "ways": (controlling((1e3, 1.0)), "units", "controls of rover.*millimetres"),
    "speeds": (controlling((3.6, 1.0)), "units", "speeds of the controls of rover.*kilometres per hour"),
    "times": (controlling((1.0, 1.0), 1e3), "units", "times.*milliseconds"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_mistake_is_named_and_its_cure_makes_the_log_fit(case: str) -> None:
    change, name, told = CASES[case]
    log = log_of(change)
    mistake, _ = gross(run_of(log), log, Trials()) or (None, None)
    assert mistake is not None
    assert mistake.name == name
    assert re.search(told, mistake.evidence), mistake.evidence
    assert fit_of_run(run_of(cured(log, mistake))).mean < FITS


def test_beacons_above_the_plane_of_their_robot_are_named_with_their_height(tmp_path: Path) -> None:
    beacons = tmp_path / "beacons.csv"
    beacons.write_text("id,x_m,y_m\n1,2,2\n2,13,3\n3,14,12\n4,3,14\n")
    settings = (
        *CORNERS, "steps=40", "robots.rover.sensors={radio: {type: range, sigma_range_m: 0.05, range_max_m: 30}}",
        f"filter.map.known={beacons}",
    )  # fmt: skip
    log = log_of(measuring(lambda y: np.sqrt(y**2 + 2.0**2)), settings)
    run = run_of(log, settings)
    heights = {m.cure.split("=")[1]: m for m in mistakes(run.config, run) if m.name == "height"}
    right, wrong = (Trials().fit_with(log, log.events, heights[z_m]) for z_m in ("-2", "-3"))
    assert right.mean < FITS < fit_of_run(run).mean
    assert right.likelihoods.sum() > wrong.likelihoods.sum()
    assert heights["-2"].cure == "--set robots.rover.sensors.radio.mount.z_m=-2"


def test_ranges_that_are_too_long_are_named_and_no_height_of_their_beacons() -> None:
    radio = "robots.rover.sensors={radio: {type: range, sigma_range_m: 0.05, range_max_m: 30}}"
    log = log_of(measuring(lambda y: y + 2.0), (*CORNERS, radio))
    run = run_of(log, (*CORNERS, radio))
    mistake, _ = gross(run, log, Trials()) or (None, None)
    assert mistake is not None
    assert (mistake.name, mistake.of, mistake.value) == ("range_offset", ("rover", "radio", "range_m"), 2.0)
    assert mistake.cure == "--set robots.rover.sensors.radio.bias_m=2"


def test_changes_that_cannot_win_are_dropped_early(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a noise is stated too small no mistake makes the log fit; each was once filtered to the end."""
    radio = "robots.rover.sensors={radio: {type: range, sigma_range_m: %s, range_max_m: 30}}"
    config = load_world("random_field", [*FIELD, *CORNERS, radio % 0.02]).config()
    log = simulate(load_world("random_field", [*FIELD, *CORNERS, radio % 0.1]), 4)
    run = km.record(build_slam(config, log), log, progress=False, config=config_dict(config), pictures=False)
    assert fit_of_run(run).mean > MISFIT
    taken, take = [], Recorder.take

    def counted(self: Recorder, events: Iterable[Event], *more: Any) -> None:
        part = [*events]
        taken.append(len(part))
        take(self, part, *more)

    monkeypatch.setattr(Recorder, "take", counted)
    assert likeliest(run, log, Trials()) is None
    assert sum(taken) < 0.4 * len(log.events) * len([*mistakes(run.config, run)])


def test_a_change_is_dropped_when_it_trails_or_can_explain_too_little() -> None:
    def fit(d2: float, number: int = 100) -> Fit:
        return Fit(np.full(number, d2), np.ones(number), np.full(number, -0.5 * d2))

    assert _in_race(fit(9.0, 1000), [fit(9.0), fit(1.0), fit(5.0)], 9.0).tolist() == [1], "the rest goes on so"
    assert _in_race(fit(9.0, 1000), [fit(9.0), fit(8.9)], 9.0).tolist() == [], "none explains what does not fit"
    assert _in_race(fit(1.0, 1000), [fit(1.0), fit(0.9)], 9.0).tolist() == [], "there is nothing to explain"
    later = Fit(*(np.append(a, b) for a, b in zip(fit(1.0), fit(9.0, 900), strict=True)))
    assert _in_race(later, [fit(1.0), fit(1.5)], 9.0).tolist() == [0, 1], "what does not fit comes later"


def test_a_mistake_that_shows_late_is_one_of_the_whole_log() -> None:
    log = log_of(measuring(lambda y: y * [1.0, 180 / np.pi]))
    run = run_of(log)
    mistake = likeliest(run, log, Trials(), len(run.history.d2) // 2)
    assert mistake is not None
    assert (mistake.name, mistake.since_s) == ("units", log.events[0].t_s)
    assert mistake.cure.startswith("--set log.factors.rover.lidar.bearing_rad=")


def test_a_sensor_that_is_turned_over_later_is_named_with_the_time() -> None:
    log = log_of(measuring(lambda y: y * [1.0, -1.0], from_s=16.0))
    mistake, _ = gross(run_of(log), log, Trials()) or (None, None)
    assert mistake is not None
    assert (mistake.name, mistake.since_s) == ("bearing_sign", pytest.approx(16.0, abs=1.0))
    assert not mistake.cure  # none leaves all of the log
    before = replace(log, events=[e for e in log.events if e.t_s < mistake.since_s])
    assert fit_of_run(run_of(before)).mean < FITS


def test_what_most_of_a_log_is_refused_with_does_not_fit_it() -> None:
    """With range and bearing swapped negative bearings would be refused, and few observations fit anything."""
    log = log_of(measuring(lambda y: y * [1.0, -1.0]), CORNERS)
    mistake, _ = gross(run_of(log, CORNERS), log, Trials()) or (None, None)
    assert mistake is not None and mistake.name == "bearing_sign"


def test_without_ids_a_filter_that_makes_new_landmarks_all_the_time_does_not_fit() -> None:
    settings = ("filter.association={type: auto}",)
    log = log_of(measuring(lambda y: y * [1e3, 1.0]), settings)
    events = [replace_ids(e) for e in log.events]
    log = replace(log, events=events)
    run = run_of(log, settings)
    mistake, _ = gross(run, log, Trials()) or (None, None)
    assert mistake is not None and mistake.name == "units" and "millimetres" in mistake.evidence


def replace_ids(e: Event) -> Event:
    return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=e.y) if isinstance(e, Scan) else e


def test_robots_with_the_same_sensors_may_make_a_mistake_alike() -> None:
    robots = {
        name: km.Robot(name, km.motion.Unicycle(), sensors={"laser": km.Mount(km.sensors.RangeBearing())})
        for name in ("a", "b")
    }
    run: Any = SimpleNamespace(final_slam=lambda: SimpleNamespace(robots=robots))
    made = [*mistakes({"robots": {"a": {}, "b": {}}}, run)]
    turned = next(
        one for one in made if one.name == "mount" and "a.laser" in one.evidence and "b.laser" in one.evidence
    )
    assert {turned.config["robots"][of]["sensors"]["laser"]["mount"]["theta_rad"] for of in "ab"} == {np.pi}
    assert turned.cure.count("--set") == 2
    flipped = next(
        one for one in made if one.name == "control_sign" and "of a " in one.evidence and "of b " in one.evidence
    )
    assert flipped.change is not None
    controls = [km.Control(t_s=0.0, robot=name, u=(1.0, 0.5)) for name in ("a", "b", "c")]
    assert [flipped.change(e).u[1] for e in controls] == [-0.5, -0.5, 0.5]
