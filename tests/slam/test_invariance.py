"""Rotating the world rotates the estimate: whole runs, every sensor with every kind of landmark it sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import kalmark as km
from kalmark.config.building import build_slam
from kalmark.events import Event
from kalmark.geometry.rotations import exp, matrix
from kalmark.geometry.spaces import SE3
from kalmark.simulate.robots import simulate
from kalmark.simulate.worlds import load_world

ANGLES = ("inverse_depth", "inverse_depth_line")  # azimuth and elevation: turns with the world to first order only
TURN = np.array([0.7, -1.1, 0.4])
LINES = ("pluecker", "anchored_pluecker", "inverse_depth", "anchored_homogeneous", "homogeneous")
CASES = [
    ("thick_cloister", "point", ()),
    ("thick_cloister_stereo", "point", ()),
    *[("thick_cloister_stereo", kind, ()) for kind in ("inverse_depth", "anchored_homogeneous", "homogeneous")],
    *[("thick_cloister_pinhole", kind, ()) for kind in ("inverse_depth", "anchored_homogeneous", "homogeneous")],
    ("thick_cloister_constant_velocity", "anchored_homogeneous", ()),
    ("thick_cloister_pinhole", "homogeneous", ("robots.robot.sensors.camera.type=omnidirectional",)),
    *[("house", f"{kind}_line", ()) for kind in LINES],
    ("tags_room", "tag", ()),
    ("self_calibration", "point", ()),
]


@pytest.mark.parametrize("iterations", [1, 6])
@pytest.mark.parametrize(("name", "kind", "keys"), CASES, ids=str)
def test_rotating_the_world_rotates_the_estimate(name: str, kind: str, keys: tuple[str, ...], iterations: int) -> None:
    filter_ = (f"filter.landmarks.type={kind}", "filter.estimator.type=invariant")
    world = load_world(name, ["steps=20", *filter_, f"filter.estimator.iterations={iterations}", *keys])
    log, Q = simulate(world, 1), matrix(exp(TURN))
    here, there = build_slam(world.config(), log), build_slam(world.config(), log)
    for robot in there.robots.values():  # the same controls and observations: they are in the robot's frame
        slot = there.slot(robot.name)
        there.map.set_predicted(slot, robot.motion.space.rotated(there.map.mean(slot), TURN))
    for event in log:
        assert said(here.process(event)) == said(there.process(turned(event, Q, there)))
    assert here.tracks.confirmed, "nothing was seen"
    both, near = np.kron(np.eye(2), Q), 1e-2 if kind in ANGLES else 1e-6
    for id_, track in here.tracks.confirmed.items():
        space = track.model.space
        d = space.minus(space.rotated(here.mean(id_), TURN), there.mean(id_))
        np.testing.assert_allclose(d, 0, atol=near, err_msg=str(id_))
    for robot in here.robots.values():
        P, P_there = (slam.covariance(robot.name)[:6, :6] for slam in (here, there))
        d = SE3.minus(SE3.rotated(here.mean(robot.name)[:7], TURN), there.mean(robot.name)[:7])
        np.testing.assert_allclose(d, 0, atol=near)
        np.testing.assert_allclose(both @ P @ both.T, P_there, atol=near * np.abs(P).max())


def turned(event: Event, Q: np.ndarray, slam: km.Slam) -> Event:
    """Return the event with what it says in the world's frame turned: the impulse of a robot that coasts."""
    if isinstance(event, km.Control) and slam.robots[event.robot].motion.columns[0] == "dvx_mps":
        return replace(event, u=np.concatenate([Q @ event.u[:3], event.u[3:]]))
    return event


def said(report: km.Report) -> list[tuple[int, str]]:
    return [(seen.index, seen.outcome) for seen in report.observations]
