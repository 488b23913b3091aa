"""A run and its log without the truth: all that a verdict reads."""

from __future__ import annotations

from dataclasses import replace

from kalmark.config.schema import TRUTH
from kalmark.logs.log import Log, Trajectory, begins_at
from kalmark.models.protocols import coasts
from kalmark.results.batch import log_of_run
from kalmark.results.run import Run
from kalmark.results.truth import Truth


def blind(run: Run) -> tuple[Run, Log]:
    """Return a run and its log as if the log had no truth, with the figures of such a run.

    Values that the configuration took from the truth stay, as the filter was given them: starts of robots whose
    configuration states none, and the landmarks of ``map.known: truth``.  Raises KalmarkError if the log of the run
    cannot be read again.
    """
    slam, source = run.final_slam(), log_of_run(run)
    log = source if isinstance(source, Log) else Log(run.log.name, run.log.robots, list(source))
    stripped = log.without_truth()
    size, starts = run.truth.poses.shape[1], dict[str, Trajectory]()
    for start in (start for start in run.history.starts if start.robot in log.truth):
        motion = slam.robots[start.robot].motion
        t_ns = begins_at(log.events, start.robot, motion.held or coasts(motion))
        starts |= {} if t_ns is None else {start.robot: Trajectory.of({t_ns: start.mean[:size]})}
    given = log.landmarks if (run.config.get("map") or {}).get("known") == TRUTH else {}
    found = replace(
        run,
        history=replace(run.history, true_id=run.history.id),
        truth=Truth.of(stripped, run.history, run.truth.anchored),
        slam=slam,
        source=replace(stripped, truth=starts, landmarks=given),
        summary={},
        reference={},
    )
    found.evaluate()
    assert found.source is not None
    return found, found.source
