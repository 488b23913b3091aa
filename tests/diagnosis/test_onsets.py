"""Are errors in a part of a run named, with their times: a sensor that is turned, wheels that slip?"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import kalmark as km
from kalmark.batch.batch_state import LANDMARKS
from kalmark.batch.data import replay_events
from kalmark.batch.problem import sightings
from kalmark.config import build_slam, config_dict
from kalmark.diagnosis.batch_search import associated
from kalmark.diagnosis.linear import Linear
from kalmark.diagnosis.onsets import _turns
from kalmark.events import Control, Scan
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
    return km.diagnose(run), run


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
        assert associated(run, log_of_run(run)) is not run, "associations of less certain controls"


def test_the_associations_of_a_run_that_fits_are_those_it_has() -> None:
    _, run = slipping(False, 0.0, 0.0)
    assert associated(run, log_of_run(run)) is run


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
    for turn, axis in zip(_turns(linear, f, factor), np.eye(3) if len(at) == 7 else np.ones((1, 1)), strict=True):
        moved = []
        for step in (h, -h):  # about the sensor
            if len(at) == 7:
                turned = np.concatenate([at[:3], compose3d(np.array([0.0, 0, 0, *exp(axis * step)]), at)[0][3:]])
            else:
                turned = compose(at, np.array([0.0, 0.0, step]))[0]
            view = view_of(mount.sensor, given.landmark, turned)
            other = sightings(view, factor.term.blocks, factor.y, factor.R, np.inf, factor.sensor)
            moved.append(other.term.at(problem.start)[0])
        parts[f] = (moved[1] - moved[0]) / (2 * h)
        np.testing.assert_allclose(turn, linear.whitened(parts), rtol=1e-4, atol=1e-4 * np.abs(turn).max())
