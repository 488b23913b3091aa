"""The explanation of a scan: candidates, gates and decisions of each of its observations."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import RunError
from kalmark.events import fixed_seconds, seconds_text
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.report import Candidate
from kalmark.results.figure_texts import count, figure
from kalmark.results.filter_description import observed_points
from kalmark.results.history import History, Ints, LandmarkChange
from kalmark.results.measures import place_sigma
from kalmark.results.recording import Recording

AROUND_S = 1.0  # before the first and after the last scan, a time still means them
FAR = 30.0  # d2 of a landmark that an observation cannot be of, by whatever gate: it is not drawn, but for the nearest
FARTHEST = 100.0  # d2 of the nearest that is not drawn either


@dataclass(frozen=True, eq=False)
class Fate:
    """One observation: where it seemed to come from (d,), what became of it and why, what it was compared with."""

    index: int
    id: str
    outcome: str
    landmark: str
    d2: float
    reason: str
    seen_at: Array
    compared: tuple[Candidate, ...]

    @property
    def near(self) -> list[Candidate]:
        """Candidates to draw: those within the gate, the landmark decided on, and the nearest."""
        least = min((other.d2 for other in self.compared if other.d2 <= FARTHEST), default=0.0)
        return [c for c in self.compared if c.d2 <= max(FAR, least) or c.landmark == self.landmark]


@dataclass(frozen=True, eq=False)
class Explanation:
    """One scan of a run: its step, time since the first scan, the robot, the gates on d2, all that was decided.

    `in_log` is the time of the log in s, by which the scan is found again; `asked` is the text of a requested
    time and how it was read.
    """

    step: int
    t_s: float
    in_log: str
    robot: str
    sensor: str
    pose: Array
    covariance: Array
    gates: tuple[float, float] | None
    fates: tuple[Fate, ...]
    changes: tuple[LandmarkChange, ...]
    asked: str = ""

    def lines(self) -> Iterator[str]:
        """Yield the lines of its text."""
        d = 3 if len(self.pose) == 7 else 2
        at = ", ".join(f"{x:.2f}" for x in self.pose[:d])
        when = f"t = {self.t_s:.3f} s ({self.in_log} s in the log)"
        yield f"{self.robot} · {self.sensor or 'no sensor'} · {when}{'; ' if self.asked else ''}{self.asked}"
        sigma, seen = place_sigma(self.covariance, d), count(len(self.fates), "observation")
        yield f"then at ({at}) m, sigma {sigma:.3g} m; {seen}"
        if self.gates is not None:
            near, far = self.gates
            yield f"paired where d2 is at most {near:.2f}, a new landmark where it is above {far:.2f} from all"
        for fate in self.fates:
            name, known = f" {fate.landmark}" if fate.landmark else "", f" (id {fate.id})" if fate.id else ""
            d2 = "" if math.isnan(fate.d2) else f", d2 {figure(fate.d2)}"
            yield f"{fate.index:4d}{known}: {fate.outcome}{name}{d2}{': ' if fate.reason else ''}{fate.reason}"
            if fate.compared and [c.landmark for c in fate.compared] != [fate.landmark]:
                yield "      compared with " + ", ".join(f"{c.landmark} (d2 {figure(c.d2)})" for c in fate.compared)
        for change in self.changes:
            yield f"{change.landmark} {change.what}: {change.reason}"


def explain(run: Recording, t_s: float, robot: str | None = None) -> Explanation:
    """Return the explanation of the association of the scan nearest to a time.

    `t_s` is a time of the log, as in ``associations.csv``; where the log has no scan then, it counts from the first
    scan, as in the report.  Raises RunError if there is no such robot or scan.
    """
    history = run.history
    if robot is not None and robot not in history.robots:
        raise RunError(f"robot is {robot!r}, expected one of {', '.join(history.robots)}")
    steps = np.arange(len(history.t_ns)) if robot is None else np.flatnonzero(history.robot == robot)
    if not len(steps):
        raise RunError("the run has no scan, expected one to explain")
    begin, t = float(history.t_ns[0]) * 1e-9, history.t_s
    span = float(t[-1])
    in_log = -AROUND_S <= t_s - begin <= span + AROUND_S
    since = t_s - begin if in_log else t_s
    if not -AROUND_S <= since <= span + AROUND_S:
        first, last = fixed_seconds(history.t_ns[0]), fixed_seconds(history.t_ns[-1])
        raise RunError(f"scan is {t_s:g} s, expected {first} to {last} s of the log, or 0 to {span:.3f} s since then")
    told = with_known(run, explain_step(run, int(steps[np.argmin(np.abs(t[steps] - since))])))
    return replace(told, asked=f"{t_s:.12g} s {'in the log' if in_log else 'since the first scan'} was asked for")


def with_known(run: Recording, told: Explanation) -> Explanation:
    """Return an explanation with the places of observations with an id, and those expected of their landmarks.

    Both are seen from the pose after the scan: the way from one to the other is the innovation.  Nothing is added where
    the run has no map, or the sensor measures no distance.
    """
    open_ = [k for k, fate in enumerate(told.fates) if fate.id and not np.isfinite(fate.seen_at).all()]
    if not open_:
        return told
    try:
        slam = run.final_slam()
    except RunError:
        return told
    rows = run.history.step == told.step
    places, expected = (
        observed_points(slam, told.robot, told.sensor, told.pose, values[rows])
        for values in (run.history.y, run.history.e)
    )
    fates = list(told.fates)
    for k in open_:
        fate, there = fates[k], np.isfinite(expected[k]).all() and fates[k].landmark
        compared = (
            (Candidate(fate.index, fate.landmark, fate.d2, expected[k]),) if there and not math.isnan(fate.d2) else ()
        )
        fates[k] = replace(fate, seen_at=places[k], compared=compared)
    return replace(told, fates=tuple(fates))


def explain_step(run: Recording, step: int) -> Explanation:
    """Return the explanation of the association of the scan of a step."""
    history = run.history
    rows = np.flatnonzero(history.step == step)
    sensor = str(history.sensor[rows[0]]) if len(rows) else ""
    robot, changes = str(history.robot[step]), tuple(c for c in history.changes if c.step == step)
    fates, gates = tuple(fate_of(history, int(row)) for row in rows), _gates(run, robot, sensor, rows)
    pose, P, when = history.poses[step], history.pose_covariances[step], seconds_text(int(history.t_ns[step]))
    return Explanation(step, float(history.t_s[step]), when, robot, sensor, pose, P, gates, fates, changes)


def fate_of(history: History, row: int) -> Fate:
    """Return the outcome of an observation."""
    index, names, d2 = int(history.index[row]), history.candidate_landmark, history.candidate_d2
    mine = np.flatnonzero(history.candidate_row == row)
    mine = mine[np.argsort(d2[mine], kind="stable")]
    compared = tuple(Candidate(index, str(names[i]), float(d2[i]), history.candidate_place[i]) for i in mine)
    id_, outcome, landmark, reason = (str(vars(history)[k][row]) for k in ("id", "outcome", "landmark", "reason"))
    d2_, at = float(history.d2[row]), history.seen_at[row]
    return Fate(index, id_, outcome, landmark, d2_, reason, at, compared)


def _gates(run: Recording, robot: str, sensor: str, rows: Ints) -> tuple[float, float] | None:
    """Return the gates on d2 of a sensor's association, None if it has none."""
    section = run.section(robot, sensor).get("association") or run.config.get("association") or {}
    near, far = section.get("gate"), section.get("new_gate")
    size = int(np.isfinite(run.history.y[rows]).sum(axis=1).max(initial=0)) if len(rows) else 0
    if not size or not isinstance(near, float) or not isinstance(far, float):
        return None
    return chi2_gate(near, size), chi2_gate(far, size)
