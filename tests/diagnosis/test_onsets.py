"""Are errors in a part of a run named, with their times: a sensor that is turned, wheels that slip?"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.batch.batch_state import LANDMARKS, POSES
from kalmark.batch.data import replay_events
from kalmark.batch.problem import observation_factor
from kalmark.config import build_slam, config_dict
from kalmark.diagnosis.batch_search import associated
from kalmark.diagnosis.causes import Finding
from kalmark.diagnosis.error_columns import TURNED, columns_of
from kalmark.diagnosis.linear import Linear
from kalmark.diagnosis.onsets import _as_turn, without_onset
from kalmark.diagnosis.trials import Trials
from kalmark.events import Control, Scan, sort_key
from kalmark.geometry.frames import compose
from kalmark.geometry.frames3d import compose as compose3d
from kalmark.geometry.rotations import exp
from kalmark.models.observe import view_of
from kalmark.results.batch import batch_input, log_of_run
from kalmark.results.run import Run
from kalmark.simulate import load_world, simulate

PLANE = ("world.count=30", "world.size_m=24", "steps=400", "robots.rover.start={x_m: 12, y_m: 12, theta_rad: 0}")


def test_a_sensor_that_is_turned_by_ten_degrees_on_the_way_is_named_first() -> None:
    world = load_world("random_field", PLANE)
    log, config, by = simulate(world, 3), world.config(), math.radians(10.0)
    events = [
        Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=e.y - [0.0, by], ids=e.ids)
        if isinstance(e, Scan) and len(e.y) and e.t_s >= 10.0
        else e
        for e in log.events
    ]
    log = replace(log, events=events)
    run = km.record(build_slam(config, log), log, progress=False, config=config_dict(config), pictures=False)
    (cause, *others) = km.diagnose(run).causes
    assert (cause.name, cause.since_s) == ("mount", pytest.approx(10.0, abs=0.5))
    assert cause.evidence.startswith(f"from t={cause.since_s:.1f} s on the sensor rover.lidar is turned by ")
    assert float(cause.evidence.split("turned by ")[1].split()[0]) == pytest.approx(10.0, abs=0.5)
    assert cause.cure == ""
    assert all(other.score < 0.02 * cause.score for other in others), others


def slipping(ids: bool, begin_s: float, end_s: float) -> tuple[km.Verdict, Run]:
    """Return the verdict on a run whose robot moves by less than its controls say for some time."""
    world = load_world("random_field", (*PLANE, "filter.association={type: auto}"))
    log, config = simulate(world, 3), world.config()
    events = [
        replace(e, u=e.u * [2.0, 1.0])
        if isinstance(e, Control) and begin_s <= e.t_s < end_s
        else replace(e, ids=None)
        if isinstance(e, Scan) and not ids
        else e
        for e in log.events
    ]
    log = replace(log, events=events)
    run = km.record(build_slam(config, log), log, progress=False, config=config_dict(config), pictures=False)
    return km.diagnose(run, brief=True), run


@pytest.mark.parametrize("ids", [True, False])
def test_wheels_that_slip_for_a_while_are_named_first_with_both_times(ids: bool) -> None:
    verdict, run = slipping(ids, 10.0, 14.0)
    cause = verdict.causes[0]
    assert cause.name in ("odometry_scale", "odometry_offset"), verdict.causes
    begin_s, end_s = (float(cause.evidence.split(word)[1].split()[0]) for word in ("t=", " to "))
    assert begin_s == pytest.approx(10.0, abs=0.3)
    assert end_s == pytest.approx(14.0, abs=0.3)
    assert cause.cure == ""
    if not ids:
        assert associated(run, log_of_run(run), Trials()) is not run, "associations of less certain controls"


@pytest.mark.parametrize(
    ("name", "of", "value", "changed"),
    [
        ("odometry_scale", ("rover", "v_mps", "scale"), -0.25, lambda u: u / [1.25, 1.0]),
        ("odometry_turn", ("rover", "w_radps", "scale"), 0.2, lambda u: u / [1.0, 0.8]),
        ("odometry_turn", ("rover", "w_radps", "offset"), 0.1, lambda u: u - [0.0, -0.1]),
        ("range_scale", ("rover", "lidar", "range_m"), 0.1, lambda y: y / [1.1, 1.0]),
        ("range_offset", ("rover", "lidar", "range_m"), 0.3, lambda y: y - [0.3, 0.0]),
        ("mount", ("rover", "lidar", "bearing_rad"), 0.2, lambda y: y - [0.0, -0.2]),
        ("mount_position", ("rover", "lidar", "x_m"), 0.2, None),
    ],
)
def test_an_error_is_taken_out_of_its_part_of_a_log_alone(name: str, of: tuple[str, ...], value: float, changed: Any
) -> None:  # fmt: skip
    world = load_world("random_field", (*PLANE, "steps=40"))
    log = simulate(world, 3)
    run = km.record(build_slam(world.config(), log), log, progress=False, pictures=False)
    without = without_onset(run, log, Finding(name, of, 0.0, 0.0, value, since_s=2.0, until_s=4.0))
    if changed is None:
        assert without is None
        return
    assert without is not None
    begin_s, kind = float(run.history.t_ns[0]) * 1e-9, "u" if name.startswith("odometry") else "y"
    for e, other in zip(log.events, without.events, strict=True):
        for key in ("u", "y"):
            if not hasattr(e, key) or not len(getattr(e, key)):
                continue
            within = key == kind and begin_s + 2.0 <= e.t_s < begin_s + 4.0
            have = getattr(e, key)
            np.testing.assert_allclose(getattr(other, key), changed(have) if within else have)


def test_scans_of_a_part_of_a_log_alone_are_moved_in_time() -> None:
    world = load_world("random_field", (*PLANE, "steps=40"))
    log = simulate(world, 3)
    run = km.record(build_slam(world.config(), log), log, progress=False, pictures=False)
    late = Finding("time_offset", ("rover", "lidar"), 0.0, 0.0, 0.5, since_s=2.0, until_s=4.0)
    begin_s = float(run.history.t_ns[0]) * 1e-9
    for unit, by in (("s", lambda t_s: 0.5), ("s/s", lambda t_s: 0.5 * (t_s - begin_s))):
        without = without_onset(run, log, replace(late, unit=unit))
        assert without is not None
        have, moved = ([e.t_s for e in of.events if isinstance(e, Scan)] for of in (log, without))
        expected = [t + by(t) if begin_s + 2.0 <= t < begin_s + 4.0 else t for t in have]
        np.testing.assert_allclose(moved, sorted(expected), atol=1e-8)
        assert [e.t_ns for e in without.events] == sorted(e.t_ns for e in without.events)


def test_a_clock_that_drifts_is_named_with_how_much_it_gains() -> None:
    world = load_world("random_field", PLANE)
    log, config = simulate(world, 3), world.config()
    late = [replace(e, t_ns=round(1.004 * e.t_ns)) if isinstance(e, Scan) else e for e in log.events]
    log = replace(log, events=sorted(late, key=sort_key))
    run = km.record(build_slam(config, log), log, progress=False, config=config_dict(config), pictures=False)
    cause = km.diagnose(run).causes[0]
    assert cause.name == "time_offset"
    gains_s = cause.evidence.split("the clock of rover.lidar gains ")[1].split()[0]
    assert float(gains_s) == pytest.approx(0.004, rel=0.1)


def test_the_associations_of_a_run_that_fits_are_those_it_has() -> None:
    _, run = slipping(False, 0.0, 0.0)
    assert associated(run, log_of_run(run), Trials()) is run


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("random_field", (*PLANE, "steps=20")),
        ("thick_cloister_stereo", ("steps=5",)),
        ("thick_cloister_pinhole", ("steps=8",)),
        ("tags_room", ("steps=5",)),
    ],
)
def test_the_turn_of_a_mount_matches_differences(name: str, options: tuple[str, ...]) -> None:
    world = load_world(name, options)
    log = simulate(world, 3)
    given = batch_input(km.record(build_slam(world.config(), log), log, progress=False, pictures=False))
    problem, h = replay_events(given, log), 1e-6
    linear = Linear.of(problem, problem.start)
    f, factor = next((f, o) for f, o in enumerate(problem.factors) if o.term.blocks[-1].group == LANDMARKS)
    mount = given.robots[factor.sensor[0]].sensors[factor.sensor[1]]
    at, parts = np.array(mount.at), [np.zeros(other.R.shape[:2]) for other in problem.factors]
    rates = np.zeros((len(problem.robots), linear.state.spaces[POSES].dof))
    columns = map(_as_turn, columns_of(linear, {factor.sensor: tuple(mount.sensor.columns)}, rates))
    turns = [column.Z for column in columns if column.name == TURNED]
    for turn, axis in zip(turns, np.eye(3) if len(at) == 7 else np.ones((1, 1)), strict=True):
        moved = []
        for step in (h, -h):  # about the sensor
            if len(at) == 7:
                turned = np.concatenate([at[:3], compose3d(np.array([0.0, 0, 0, *exp(axis * step)]), at)[0][3:]])
            else:
                turned = compose(at, np.array([0.0, 0.0, step]))[0]
            view = view_of(mount.sensor, given.landmark, turned)
            other = observation_factor(view, factor.term.blocks, factor.y, factor.R, np.inf, factor.sensor)
            moved.append(other.term.at(problem.start)[0])
        parts[f] = (moved[1] - moved[0]) / (2 * h)
        np.testing.assert_allclose(turn, linear.whitened(parts), rtol=1e-4, atol=1e-4 * np.abs(turn).max())
