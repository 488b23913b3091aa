"""Causes that residuals cannot show: a place that is mapped twice still fits its data."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from kalmark.diagnosis import doubled_landmarks, repeated_events
from kalmark.diagnosis.cause_texts import odd_control_text
from kalmark.diagnosis.effect import FEW, is_by_chance
from kalmark.diagnosis.gross_mistakes import started_at
from kalmark.diagnosis.jumps import LISTED
from kalmark.diagnosis.lost import find_lost_robots
from kalmark.diagnosis.named_causes import COPIES, JUMP, MISFIT, Cause, begin_s, cause_of_mistake, controls_of
from kalmark.diagnosis.single_ids import MISPLACED, MOVED, OUTLIERS
from kalmark.diagnosis.state_readings import SIGMA, fit_of_readings, reasons
from kalmark.diagnosis.trials import FITS, LOST, MOST, Trials, fit_of_run
from kalmark.diagnosis.trials import MISFIT as MISFITS_ALL
from kalmark.logs.log import Log
from kalmark.report import ELSEWHERE as CARRIED
from kalmark.results.control_gaps import KINDS, carried_line, controls_left_out, is_reported, stayed_lost
from kalmark.results.figure_texts import count, figure
from kalmark.results.history import RelocatedRobot
from kalmark.results.run import Run
from kalmark.results.warnings import NO_ID, placements, words_of
from kalmark.results.wrong_starts import restarts
from kalmark.slam.elsewhere import ODDS
from kalmark.slam.relocation_by_fixes import NEEDED
from kalmark.slam.surveyed_corrections import ELSEWHERE
from kalmark.slam.tentative import ELSEWHERE as BEGUN_AGAIN

LEAST_S = 5.0  # for which a robot is lost at the end
STOPPED_S = 1.0  # after a gap in the controls, within which a place is mapped again because of it
MOST_PAIRS = 0.7  # of a repeat, of which one landmark was seen first before a gap, and the other one after it
LEAST_SHARE = 0.3  # of the observations without ids that are of landmarks, in a map that determines the pose


def structural_causes(run: Run, log: Log, off: list[Cause]) -> list[Cause]:
    """Return the causes that residuals cannot show: a place that is mapped twice still fits its data."""
    if not run.summary:
        run.evaluate()
    return [
        *find_kidnaps(run, log),
        *gaps(run),
        *_carried(run, log),
        *cause_of_repeats(run.summary),
        *split_landmarks(run),
        *unseen_landmarks(run),
        *_remapped_landmarks(run),
        *fits_nothing(run),
        *off,
        *abandoned_surveys(run),
        *_started_elsewhere(run),
        *_placed_elsewhere(run),
        *_lost(run),
        *_copied(run, log),
    ]


def _started_elsewhere(run: Run) -> Iterator[Cause]:
    """Yield the robots that started elsewhere than stated; the map was moved onto their fixes, which does no harm."""
    for start in run.history.starts:
        restart = restarts(run.history).get(start.robot)
        if restart is not None:
            _, evidence, cure = started_at(run.config, start, restart.onto, restart.agreed, restart.variance)
            evidence += f"; the map was moved onto them at t={restart.t_ns * 1e-9:.1f} s"
            first = run.history.fixes[: restart.fixes]
            score = 0.5 * sum(fix.d2 for fix in first)
            yield Cause("start", start.t_ns * 1e-9, score, evidence, cure, True)


def _placed_elsewhere(run: Run) -> Iterator[Cause]:
    """Yield the times when readings that agree moved a robot that others had placed: one of both is wrong."""
    for mine in placements(run.history):
        first, of = mine[0], words_of(mine)
        if first.before < NEEDED and len(mine) == 1:
            yield Cause("start", first.t_ns * 1e-9, 0.0, f"{of}, as few had fitted before", "", True)
        else:
            evidence = (
                f"{of}, from t={first.t_ns * 1e-9:.1f} s on: it was lost, or they jumped, as those of receivers do"
            )
            cure = "leave their rows out where they jump, or state more noise for them"
            yield Cause(MISFIT, first.t_ns * 1e-9, _left_out_until(run, mine), evidence, cure)


def _lost(run: Run) -> Iterator[Cause]:
    """Yield the robots that nothing places any more at the end of the run."""
    for one in find_lost_robots(run):
        evidence = f"the last {one.number} {one.of} of {one.robot}, from t={one.since_s:.1f} s on, were left out: "
        evidence += "the path or these measurements are wrong"
        cure = "compare its controls with these from then on, or state more noise"
        yield Cause("lost", one.since_s, 0.5 * MOST * one.number, evidence, cure)
    state, end_s = run.final_slam().state, float(run.history.t_ns.max(initial=0)) * 1e-9
    for robot, of in state.evidence.items():
        since_s, number = max(of.since_ns * 1e-9, begin_s(run)), count(len(of.missed), "landmark")
        lasts = end_s - since_s >= LEAST_S and not state.moving[robot].held.is_adrift
        if of.ratio <= -math.log(ODDS) and lasts:
            evidence = f"{robot} does not see {number} where it should from t={since_s:.1f} s on: it is elsewhere"
            cure = "look for a motion at that time that the controls do not contain"
            yield Cause("lost", since_s, -of.ratio, evidence, cure)


def _left_out_until(run: Run, placed: Sequence[RelocatedRobot]) -> float:
    """Return half of the chi-square of the readings that moved a robot: those left out in a row until it was moved."""
    h, now, score = run.history, fit_of_run(run), 0.0
    of = h.made_by(placed[0].robot, placed[0].sensor)
    for one in placed:
        mine = np.flatnonzero(of & (h.t_ns[h.step] <= one.t_ns))
        used = np.flatnonzero(h.outcome[mine] != "rejected")
        rows = mine[used[-1] + 1 if len(used) else 0 :]
        score += 0.5 * float(np.minimum(h.d2[rows], MOST * now.dof[rows]).sum())
    return score


def _remapped_landmarks(run: Run) -> Iterator[Cause]:
    """Yield the landmarks that were begun again elsewhere: moved, or begun by an outlier.  It does no harm."""
    h = run.history
    for change in (c for c in h.changes if c.reason == BEGUN_AGAIN):
        rows = np.flatnonzero((h.id == change.landmark) & (h.step <= change.step))
        now_s, begun_s = map(h.at_s, (change.step, h.step[rows].min(initial=change.step)))
        score, cure = 0.5 * MOST * len(rows), f"leave out its first observation, at t={begun_s:.1f} s"
        if (h.outcome[rows] != "rejected").sum() > 1:  # there, too, observations agreed
            told = f"landmark {change.landmark} was moved by t={now_s:.1f} s: from then on it is mapped there"
            yield Cause(MOVED, now_s, score, told, "", True)
            continue
        told = f"landmark {change.landmark} was begun by an outlier: from later observations it was begun again"
        yield Cause(MISPLACED, begun_s, score, told, cure, True)


def fits_nothing(run: Run) -> Iterator[Cause]:
    """Yield the cause that most observations without an id are of no landmark: the map does not determine the pose."""
    h, now = run.history, fit_of_run(run)
    mine = (h.id == "") & (h.reason != NO_ID) & ~h.of_own
    share = float(np.mean(now.values[mine] < LOST)) if mine.any() else 1.0
    if share < LEAST_SHARE:
        evidence = f"{share:.0%} of the {int(mine.sum())} observations without an id are of a landmark in the map"
        cure = "the scans contradict the controls: look at mounts, signs and units of both, and their times"
        yield Cause(MISFIT, begin_s(run), 0.5 * LOST * float(mine.sum()), f"only {evidence}", cure)


def readings_off(run: Run, log: Log, trials: Trials) -> tuple[list[Cause], bool]:
    """Return the faults of sensors of the state, those that still do not fit, and whether that explains the run.

    They, or some in a row, are further off than their noise and that of the pose allow.  More noise explains nothing
    with certainty.
    """
    now = fit_of_readings(run)
    alone = now.sensors() and not len(run.landmarks) and fit_of_run(run).mean >= MISFITS_ALL
    if not (now.off() or now.parts_off() or alone):
        return [], False
    found, after = reasons(run, log, trials)
    causes = [*map(cause_of_mistake, found)]
    left = {*after.off()} if found and after is not None else {*now.off()}
    for robot, sensor in (of for of in now.off() if of in left):
        mine = now.of((robot, sensor))
        dof, mean = int(now.fit.dof[mine].sum()), now.mean((robot, sensor))
        score, of = 0.5 * dof * (mean - 1.0 - float(np.log(mean))), f"{len(mine)} readings of {sensor} of {robot}"
        evidence = f"d2 per degree of freedom is {figure(mean, 2)} over {of}, where 1 is expected"
        cure = "state more noise for it, or look for what lasts: a bias, a delay, its mount, a wrong start"
        causes.append(Cause(MISFIT, begin_s(run), score, evidence, cure))
    fits = after is not None and not left and fit_of_run(after.run).mean < FITS
    return causes, bool(found) and found[0].name != SIGMA and fits


def _copied(run: Run, log: Log) -> list[Cause]:
    """Return the streams of the log that come twice."""
    found = []
    for robot, sensor, number, of, since_s, noticed in repeated_events.copies(run, log):
        what = f"scans of {robot}.{sensor}" if sensor else f"fixes of {robot}" if noticed else f"controls of {robot}"
        evidence = f"{number} of {of} {what} repeat the one before to the last bit: "
        if noticed:
            evidence += "they are no new measurements, and were left out"
            found.append(Cause(COPIES, since_s, float(number), evidence, "give each measurement once", True))
            continue
        evidence += "the log has them twice"
        harmless = not sensor and run.final_slam().robots[robot].motion.held  # the same velocity goes on
        found.append(Cause(COPIES, since_s, float(number), evidence, "leave out every second of them", harmless))
    return found


def unfitting_measurements(run: Run) -> list[Cause]:
    """Return the sensors, and fixes, of which more fitted nothing than by chance; without ids nothing was seen again.

    They do no harm.
    """
    h, found = run.history, []
    alone = (h.outcome == "tentative") & ~np.isin(h.landmark, h.landmark[h.fused])
    of = [f"observations of {a}.{b}" for a, b in h.sensor_keys()]
    stream = np.array([*of, *(f"fixes of {fix.robot}" for fix in h.fixes)])
    out = np.array([*(alone | (h.outcome == "rejected")), *(not fix.used for fix in h.fixes)], dtype=np.bool_)
    for name in np.unique(stream):
        number, left_out = int((stream == name).sum()), int(out[stream == name].sum())
        if not is_by_chance(left_out, number):
            evidence = f"{left_out} of {number} {name} fit nothing in the map, and were left out"
            found.append(Cause(OUTLIERS, begin_s(run), 0.5 * MOST * left_out, evidence, "", True))
    return found


def abandoned_surveys(run: Run) -> list[Cause]:
    """Return the surveyed landmarks that the filter found elsewhere, and maps again where it can: that does no harm."""
    h, found, now = run.history, [], {str(id_): k for k, id_ in enumerate(run.landmarks.ids)}
    surveys = {prior.landmark: prior for prior in h.priors}
    for change in (c for c in h.changes if c.reason == ELSEWHERE and c.landmark in surveys):
        prior, d, told = surveys[change.landmark], h.d, "does not fit its survey: the filter left its survey out"
        chi2 = MOST * float(((h.id == change.landmark) & (h.outcome == "rejected")).sum())
        if change.landmark in now:
            k = now[change.landmark]
            mean, P = run.landmarks.means[k][:d], run.landmarks.covariances[k][:d, :d] + prior.covariance[:d, :d]
            off, at = mean - prior.mean[:d], ", ".join(figure(float(x)) for x in mean)
            chi2 = float(off @ np.linalg.pinv(P) @ off)
            sure = f"{figure(float(np.linalg.norm(off)))} m from its survey ({figure(float(np.sqrt(chi2)), 2)} sigma)"
            told = f"is {sure}: the filter left its survey out and mapped it at ({at}) m"
        cure = f"correct {change.landmark} in the file of the survey, or leave it out"
        found.append(
            Cause("landmark_prior", h.at_s(change.step), 0.5 * chi2, f"landmark {change.landmark} {told}", cure, True)
        )
    return found


def gaps(run: Run) -> list[Cause]:
    """Return the gaps in the controls; one that was bridged, and after which the pose was known, is harmless.

    Not if a place that was mapped before it is mapped again after it: then the robot was lost.
    """
    summary, found = run.summary, []
    stops = [gap for gap in summary.get("gaps", ()) if gap["kind"] in KINDS]
    for gap in (gap for gap in stops if gap["action"] == "ignore" or is_reported(gap)):
        lasts, bridged = gap["end_s"] - gap["start_s"], gap["action"] == "widen" and gap["known_s"] is not None
        anew = any(_mapped_again(run, part, gap["start_s"]) for part in summary.get("repeats", ()))
        cure = f"--set robots.{gap['robot']}.gaps=widen" if gap["action"] == "ignore" else ""
        again = f", which was bridged: it was localized again at t={gap['known_s']:.1f} s" if bridged else ""
        told = ", and it was not localized again" if stayed_lost(gap) else again
        told = ", and places are mapped again after it" if anew else told
        evidence = f"the control of {gap['robot']} stops for {figure(lasts)} s{told}"
        cure = cure or ("--set upkeep.repeats=merge" if anew else "")
        found.append(Cause("gap", gap["start_s"], lasts, evidence, cure, bridged and not anew))
    return found + [Cause(JUMP, begin_s, 0.0, line, "", True) for begin_s, line in controls_left_out(summary)]


def _carried(run: Run, log: Log) -> Iterator[Cause]:
    """Yield the robots that were elsewhere and found: from the start, by a control, or carried.  It does no harm."""
    for gap in run.summary.get("gaps", ()):
        if gap["kind"] == CARRIED:
            since_s, told = gap["start_s"], (carried_line(gap), "")
            odd = controls_of(run, log, gap["robot"]).odd(since_s, gap["end_s"] - since_s)
            name = "start" if since_s <= begin_s(run) else "kidnapped"
            if odd is not None:
                name, since_s, told = JUMP, odd.t_s, odd_control_text(gap["robot"], odd)
            yield Cause(name, since_s, math.log(ODDS), *told, True)


def _mapped_again(run: Run, part: dict[str, Any], t_s: float) -> bool:
    """Return whether most of a repeat's older landmarks were seen first before a time, and the newer ones after it."""
    h = run.history
    names, first = np.unique(h.landmark, return_index=True)
    at = dict(zip(names.tolist(), (h.t_ns[h.step[first]] * 1e-9).tolist(), strict=True))
    before = [(at.get(a, np.inf) < t_s) & (at.get(b, -np.inf) >= t_s) for a, b in part["landmarks"]]
    return float(np.mean(before)) > MOST_PAIRS


def cause_of_repeats(summary: dict[str, Any]) -> list[Cause]:
    """Return the parts of the map that agree, as if one place were mapped twice, as one cause: the largest of them."""
    parts = sorted(summary.get("repeats", ()), key=lambda part: -len(part["landmarks"]))
    if not parts:
        return []
    number, shift = len(parts[0]["landmarks"]), figure(float(np.linalg.norm(parts[0]["shift_m"])))
    more = f"; {count(len(parts) - 1, 'more such part')}" if len(parts) > 1 else ""
    evidence = f"{number} landmarks repeat {number} others {shift} m away: one place is mapped twice{more}"
    since_s, score = min(part["start_s"] or 0.0 for part in parts), sum(part["score"] for part in parts)
    return [Cause("map_repeats", since_s, score, evidence, "--set upkeep.repeats=merge")]


def find_kidnaps(run: Run, log: Log) -> Iterator[Cause]:
    """Yield the kidnapped robots: their earlier landmarks vanish at once, and the landmarks in view are new.

    Chance does not do that, or the place is in the map already.  Not if its controls had stopped: then it may have
    driven.  With a control that is far larger than all others it is its odometry that jumps.
    """
    h, repeat = run.history, next(iter(run.summary.get("repeats", ())), None)
    stops = [(gap["robot"], gap["start_s"], gap["end_s"] + STOPPED_S) for gap in run.summary.get("gaps", ())]
    moments = [
        m
        for m in doubled_landmarks.vanished_landmarks(run)
        if not any(m.robot == r and a <= m.t_s <= b for r, a, b in stops)
    ]
    far_m, again = float(np.linalg.norm(repeat["shift_m"])) if repeat else 0.0, list[doubled_landmarks.Moment]()
    if repeat and far_m > doubled_landmarks.landmark_spacing(run):
        last = int(np.searchsorted(h.t_ns, round((repeat["start_s"] or 0.0) * 1e9)))
        again = [moment for moment in moments if last - doubled_landmarks.NEAR_SCANS <= moment.step <= last]
    first = max(again or moments, key=lambda moment: (moment.score, moment.number), default=None)
    if first is None or not (again or first.score > 0.0):
        return
    far, others = (f" by {figure(far_m)} m", "them again") if again else ("", "others")
    told = f"it sees none of the {first.number} landmarks that it saw just before, and maps {others}"
    evidence = f"{first.robot} was elsewhere{far} from t={first.t_s:.1f} s on: {told}"
    score = max(first.score, repeat["score"] if repeat and again else 0.0)
    odd = controls_of(run, log, first.robot).odd(first.t_s)
    if odd is not None:
        yield Cause(JUMP, odd.t_s, score, *odd_control_text(first.robot, odd))
        return
    yield Cause("kidnapped", first.t_s, score, evidence)


def split_landmarks(run: Run) -> Iterator[Cause]:
    """Yield that things are in the map twice, side by side: their landmarks are seen in turn, never together."""
    pairs = doubled_landmarks.find_split_landmarks(run)
    if pairs:
        number, mapped = len({pair.name for pair in pairs}), len(run.landmarks)
        first = ", ".join(f"{pair.name} and {pair.other}" for pair in pairs[:LISTED])
        told = "seen in turn and never together with their neighbours, so they are the same things"
        evidence = f"{number} of {mapped} landmarks are {told} ({first}{', ...' if len(pairs) > LISTED else ''})"
        more = "a noise that is stated too small splits landmarks: state more"
        cure = "give each thing one id" if pairs[0].name in run.history.id else more
        yield Cause(
            "split_landmarks", begin_s(run), sum(p.score for p in pairs), evidence, cure, number <= FEW * mapped
        )


def unseen_landmarks(run: Run) -> Iterator[Cause]:
    """Yield that landmarks are not seen again where they should be: they are in the map twice, or nowhere.

    Of landmarks that are there a share `FEW` is marked by chance.  With ids, the times are counted
    at which landmarks came into view as before.
    """
    marks, h, found = run.landmarks, run.history, doubled_landmarks.unseen_counts(run)
    names = [name for name in marks.ids if name in marks.unseen]
    by_chance = is_by_chance(len(names), len(marks))
    if names:
        where = dict(zip(marks.ids, marks.positions()[0].tolist(), strict=True))
        some = ", ".join(f"{name} at ({', '.join(f'{x:.1f}' for x in where[name])}) m" for name in names[:LISTED])
        some += ", ..." * (len(names) > LISTED)
        evidence = f"{len(names)} of {len(marks)} landmarks were not seen again where they should be: {some}"
        first = h.t_ns[h.step[np.isin(h.landmark, [str(name) for name in names])]].min(initial=h.t_ns[-1])
        score = -sum(marks.log_odds[name] for name in names)
        cure = "they moved, or are in the map twice: --set upkeep.gone=remove takes them out"
        yield Cause("unseen_landmarks", float(first) * 1e-9, score, evidence, cure, by_chance)
    if found is not None and by_chance:
        evidence = f"in {found.unseen} of {found.number} times a landmark came into view as before it was not seen"
        cure = "things are in the map twice, or came and went: look at the errors of the controls, and at what moves"
        yield Cause("unseen_landmarks", found.since_s, found.score, evidence, cure)
