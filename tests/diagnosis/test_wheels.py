"""Are radii and tracks of wheels that are not as stated named, each with its size and a cure that works?"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import kalmark as km
from kalmark.batch.data import replay_events
from kalmark.batch.motion_chain import TURNING
from kalmark.config import build_slam, config_dict
from kalmark.diagnosis.verdict import Verdict
from kalmark.events import Control, Event
from kalmark.logs.log import Log
from kalmark.results.batch import batch_input
from kalmark.results.run import Run
from kalmark.simulate import load_world, simulate

KNOWN = "robots.rover.motion.sigma_radius_m=0", "robots.rover.motion.sigma_track_m=0"
MOTION = "filter.robots.rover.motion"


@cache
def run_with(motion: tuple[str, ...] = (), steps: int = 400) -> tuple[Run, Log]:
    """Return the run of a filter that is told other wheels, and its log."""
    world = load_world("differential_drive", [f"steps={steps}", *KNOWN, *(f"{MOTION}.{key}" for key in motion)])
    log, config = simulate(world, 1), world.config()
    return km.record(build_slam(config, log), log, progress=False, pictures=False, config=config_dict(config)), log


def verdict_on(*motion: str) -> Verdict:
    return km.diagnose(run_with(motion)[0], brief=True)


@pytest.mark.parametrize(
    ("motion", "name", "evidence", "cures"),
    [
        (("track_m=0.55",), "odometry_turn", "turns of rover are", {"robots.rover.motion.track_m": 0.5}),
        (
            ("left_radius_m=0.092", "right_radius_m=0.092"), "odometry_scale", "left_rad and right_rad of rover are",
            {"log.factors.rover.left_rad": 0.1 / 0.092, "log.factors.rover.right_rad": 0.1 / 0.092},
        ),
        (("left_radius_m=0.096",), "odometry_turn", "left_rad of rover is", {"log.factors.rover.left_rad": 1 / 0.96}),
    ],
    ids=["track", "radii", "a radius"],
)  # fmt: skip
def test_what_is_wrong_with_wheels_is_named_first_with_its_size(
    motion: tuple[str, ...], name: str, evidence: str, cures: dict[str, float]
) -> None:
    first = verdict_on(*motion).causes[0]
    assert first.name == name and first.evidence.startswith(evidence)
    told = dict(part.split("=") for part in first.cure.split("; or: ")[0].replace("--set ", "").split())
    assert {key: float(value) for key, value in told.items()} == pytest.approx(cures, rel=0.02)


def test_wheels_that_are_as_stated_are_not_accused() -> None:
    assert not [cause for cause in verdict_on().causes if not cause.harmless]


def test_the_error_of_all_turns_matches_differences() -> None:
    """Turns are in proportion to the reciprocal of the track."""
    (run, log), h = run_with(steps=12), 1e-6
    given = batch_input(run)
    problem = replay_events(given, log)
    k = next(k for k, error in enumerate(problem.motions.errors) if error.column == TURNING)

    def more(e: Event) -> Event:
        turn = 0.5 * h * np.array([-1.0, 1.0]) * np.diff(e.u) if isinstance(e, Control) else 0.0
        return replace(e, u=e.u + turn) if isinstance(e, Control) else e

    other = replay_events(given, map(more, log.events))
    w, w_more = (each.motions.term.at(problem.start)[0] for each in (problem, other))
    np.testing.assert_allclose((w - w_more).ravel() / h, problem.motions.systematic[:, k], atol=0.02)
