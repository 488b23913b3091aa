"""Warnings of a run: figures that may be wrong, and noise that is stated too large, one line each.

Signs of a wrong map: innovations that are too large or keep their signs, and observations that fit no landmark.  NIS,
observations left out and the whiteness of innovations are taken in windows of time.  Bar-Shalom, Li, Kirubarajan 2001,
section 5.4: time-average NIS and autocorrelation of the innovations.

Signs of a noise that is too large: an innovation has the noise of its measurement in it, and the uncertainty of pose
and map on top: E[z z'] = H P H' + R is at least R for every P.  If the mean square of z is far below R, R is therefore
too large, at least by their ratio.  This does not hold for errors that are correlated from one observation to the next:
the map absorbs those, and a larger white noise stands for them.  So there is no such warning where the truth shows that
the filter is overconfident.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.config.reading import did_you_mean
from kalmark.declare import class_of, registered_name
from kalmark.geometry.gaussian import gate, quantile
from kalmark.logs.log import Section
from kalmark.models import sensors
from kalmark.results.association_errors import LEAST, no_ids
from kalmark.results.checked import DOUBTFUL, OK, UNCHECKED, WRONG, Sign
from kalmark.results.control_gaps import gap_warnings
from kalmark.results.figure_texts import Figures, Summary, count, figure
from kalmark.results.history import History, Ints, RelocatedRobot, UsedFix, grouped
from kalmark.results.measures import associated_nis, nis, place_sigma, ratio, truncated_variance
from kalmark.results.recording import Recording
from kalmark.results.repeated_landmarks import repeat_warnings
from kalmark.results.self_calibration import mount_warnings
from kalmark.results.wrong_starts import restarts
from kalmark.slam.held_readings import AGAIN

DEGREES = 100  # of freedom in a window, at least
OBSERVATIONS = 60  # in a window of those left out, at least
CHANCE = 1e-6  # with which a consistent run would raise a flag
TIMES = 3.0  # a window's NIS over the median window's
LEFT_OUT = 0.5  # share of a window's observations that fit nothing, where the median window has less than half of it
CORRELATED = 0.5  # by which a window's autocorrelation of innovations exceeds the median window's
PAIRS = 60  # of successive innovations in a window
SIGMAS = 4.0  # of what white innovations have, that an autocorrelation exceeds: of single numbers .2 in a window
WINDOW_SCANS = 10  # at least, as good as, in a window: the observations of one share the error of the pose
SCANS_PAIRED = 30  # in a window of pairs
MOST_GAP_STEPS = 5
NO_ID = "no id in the log"  # the reason that association by identity gives
NIS_HIGH = 3.0  # per degree of freedom
TOO_SMALL = "the noise is set too small"  # the cause of a high one, unless a verdict finds another
FIX_NIS_HIGH = 5.0
FIRST_FIX = 0.9999  # of right starts pass the test of the first fix
BEARINGS = ("range_bearing", "range_bearing_3d")
ATTENTION = ("not among the ", "nearer than ", "more than ")  # how the reasons begin that an attention gives
MARGIN = 0.1  # of an image, by which its measurements may lie outside it
LISTED = 5  # of the times when readings moved a robot
FEW_FIXES = 5  # fewer do not determine the noise
LOW = 0.5  # squares of innovations over those of the stated noise: it is 1.4 times too large
TINY_NIS = 0.1
TINY = 1e-6  # of those squares, where a log has no noise
NUMBER, SCANS = 100, 30  # of observations, of scans: with a right noise one in 30,000 sensors is below LOW
NOTICES = registered_name(sensors.ZeroVelocity2D)  # a sensor that needs no rows in a log
COLUMNS = {registered_name(cls): tuple(cls.columns) for cls in sensors.BUILT_IN}


@dataclass(frozen=True)
class Window:
    """A stretch of time: when it begins and ends, in seconds since the first step, and its figure.

    `chance` is the part of the figure that may be by chance.
    """

    start_s: float
    end_s: float
    value: float
    number: int
    chance: float = 0.0


def window_figures(history: History) -> Figures:
    """Return the figures of ``summary.json`` that windows of time have; absent where there is too little."""
    out: Figures = {}
    for name, windows in (("nis", nis_windows(history)), ("left_out", left_out_windows(history))):
        if len(windows) > 1:
            worst = max(windows, key=lambda w: w.value)
            out |= {f"{name}_window_max": worst.value, f"{name}_window_max_s": [worst.start_s, worst.end_s]}
            out[f"{name}_window_median"] = float(np.median([w.value for w in windows]))
    correlations = autocorrelations(history)
    if correlations:
        out["innovation_autocorrelation"] = float(np.median([w.value for w in correlations]))
    return out


def nis_windows(history: History) -> list[Window]:
    """Return the NIS per degree of freedom of windows of at least so many degrees, one after the other."""
    value, dof, step = associated_nis(history)
    return _windows(history, step, value, dof, DEGREES, WINDOW_SCANS)


def left_out_windows(history: History) -> list[Window]:
    """Return the share of observations that were rejected, or ignored because they fit nothing, window by window."""
    mine = history.outcome != "tentative"
    out = np.isin(history.outcome[mine], ["rejected", "ignored", "deferred"]) & (history.d2[mine] > 0)
    wrong = (out | history.reason_begins(("between ", "it does not"))[mine]).astype(np.float64)
    return _windows(history, history.step[mine], wrong, np.ones(len(wrong), dtype=np.int64), OBSERVATIONS, WINDOW_SCANS)


def autocorrelations(history: History) -> list[Window]:
    """Return the correlation of successive whitened innovations of the same landmark, window by window."""
    rows = np.flatnonzero((history.outcome == "associated") & np.isfinite(history.z).any(axis=1))
    white = _whitened(history, rows)
    robots = history.observers[rows]
    order = np.lexsort((history.step[rows], history.landmark[rows], history.sensor[rows], robots))
    one, two = order[:-1], order[1:]
    same = history.step[rows[two]] - history.step[rows[one]] <= MOST_GAP_STEPS
    for of in (history.landmark[rows], history.sensor[rows], robots):
        same &= of[one] == of[two]
    one, two = one[same], two[same]
    turn = np.argsort(history.step[rows[two]], kind="stable")
    a, b, step = white[one[turn]], white[two[turn]], history.step[rows[two[turn]]]
    both, numbers = np.nansum(a * b, axis=1), np.isfinite(a).sum(axis=1)
    size = np.sqrt(np.nansum(a**2, axis=1) * np.nansum(b**2, axis=1))
    ones = np.ones(len(both), dtype=np.int64)
    sums = (both, size, size**2 / numbers)  # the last: the variance of the first, if directions are random
    windows = zip(*(_windows(history, step, value, ones, PAIRS, SCANS_PAIRED) for value in sums), strict=True)
    return [
        Window(p.start_s, p.end_s, p.value / s.value, p.number, max(_by_chance(s, v) - CORRELATED, 0.0))
        for p, s, v in windows
        if s.value > 0
    ]


def _by_chance(size: Window, variance: Window) -> float:
    """Return the limit of the autocorrelation of white innovations, by the mean sizes and variances of its products."""
    return SIGMAS * float(np.sqrt(variance.value / size.number)) / size.value


def _whitened(history: History, rows: Ints) -> Array:
    """Return L^-1 z (K, p), L the factor of Z, NaN where there is none."""
    out = np.full((len(rows), history.z.shape[1]), np.nan)
    sizes = np.isfinite(history.z[rows]).sum(axis=1)
    for m in np.unique(sizes[sizes > 0]):
        mine = np.flatnonzero(sizes == m)
        L = np.linalg.cholesky(history.Z[rows[mine], :m, :m])
        out[mine, :m] = np.linalg.solve(L, history.z[rows[mine], :m, None])[..., 0]
    return out


def _windows(history: History, step: Ints, value: Array, weight: Ints, least: int, scans: int) -> list[Window]:
    """Return sums of values over sums of weights, cut each time the weights add up to so much.

    A scan counts for no more than one of so many `scans` of a window.
    """
    if not len(step):
        return []
    _, scan = np.unique(step, return_inverse=True)
    counts = weight * np.minimum(1.0, least / scans / np.maximum(np.bincount(scan, weight), 1.0))[scan]
    number = ((np.cumsum(counts) - counts) / least + 1e-9).astype(np.int64)
    ends = np.searchsorted(number, np.arange(number[-1] + 2))
    t, out = history.t_s, []
    for begin, end in itertools.pairwise(ends.tolist()):
        if (total := counts[begin:end].sum()) >= 0.9 * least:
            share = float(value[begin:end].sum() / weight[begin:end].sum())
            out.append(Window(float(t[step[begin]]), float(t[step[end - 1]]), share, round(total)))
    return out


def window_warnings(run: Recording) -> Iterator[str]:
    """Yield a line for each sign in the innovations alone that the map is wrong."""
    history = run.history
    begin_s = float(history.t_ns[0]) * 1e-9 if len(history.t_ns) else 0.0
    signs = ((nis_windows, _high_nis), (left_out_windows, _left_out), (autocorrelations, _correlated))
    for windows, told in ((of(history), told) for of, told in signs):
        if len(windows) < 3:
            continue
        worst = max(windows, key=lambda w: w.value - w.chance)
        line = told(worst, float(np.median([w.value for w in windows])), len(windows))
        if line:
            when = f"from t={worst.start_s:.1f} to {worst.end_s:.1f} s"
            if begin_s:
                when += f" ({begin_s + worst.start_s:.1f} to {begin_s + worst.end_s:.1f} s in the log)"
            yield f"{line} {when}: the {'path' if history.localizes else 'map'} may be wrong from there on"


def _high_nis(worst: Window, median: float, count: int) -> str:
    bound = float(quantile(1 - CHANCE / count, worst.number)) / worst.number
    if worst.value <= max(bound, TIMES * median):
        return ""
    return f"NIS per degree of freedom rises to {figure(worst.value, 2)}, median {figure(median, 2)},"


def _correlated(worst: Window, median: float, count: int) -> str:
    if worst.value - worst.chance - max(median, 0.0) < CORRELATED:
        return ""
    return f"successive innovations are correlated by {figure(worst.value, 2)}, median {figure(median, 2)},"


def _left_out(worst: Window, median: float, count: int) -> str:
    if worst.value < LEFT_OUT or median > LEFT_OUT / 2:
        return ""
    return f"{worst.value:.0%} of the observations fit nothing, median {median:.0%},"


def warnings(run: Recording, summary: Summary) -> list[str]:
    """Return a line for everything in a run and its summary that should not be overlooked, the worst first."""
    return [sign.line for sign in signs(run, summary)]


def signs(run: Recording, summary: Summary) -> list[Sign]:
    """Return the warnings of a run, each with the best status that a verdict can have beside it.

    Those about truth leave any, and so do those whose effect a verdict itself states: about noise, starts that
    fixes correct, robots that readings place elsewhere.
    """
    of_map = ((gap_warnings(summary["gaps"]), DOUBTFUL), (repeat_warnings(summary["repeats"]), WRONG))
    parts = (
        (_stopped, WRONG),
        (_lost, DOUBTFUL),
        (_placed, OK),
        (_diverged, OK),
        (_observations, UNCHECKED),
        (_images, OK),
        (_robots, UNCHECKED),
        (_sensors, OK),
        (_truth, OK),
        (_first_fixes, OK),
        (_fixes, DOUBTFUL),
        (_noise, OK),
        (mount_warnings, OK),
    )
    found = *of_map, *((part(run, summary), status) for part, status in parts)
    return [Sign(line, status) for lines, status in found for line in lines]


def advice(run: Recording, summary: Summary) -> list[str]:
    """Return a line for each sensor, and for fixes, whose noise is stated far too large.

    One if the NIS is tiny for another reason.
    """
    lines, nis_ = [*_stated_too_large(run, summary), *_fixes_stated_too_large(summary)], summary["nis_per_dof"]
    if not lines and nis_ is not None and nis_ < TINY_NIS and summary["associated"] >= NUMBER // 2:
        lines = [f"NIS per degree of freedom {figure(nis_, 2)} where 1 is consistent: the noise is set too large"]
    return lines


def _stopped(run: Recording, _: Summary) -> Iterator[str]:
    if run.stopped:
        yield f"the filter stopped: {run.stopped}"


def _lost(run: Recording, _: Summary) -> Iterator[str]:
    yield from _moved(run, "it was", with_map=False)


def _moved(run: Recording, what: str, with_map: bool) -> Iterator[str]:
    """Yield a line of each time when fixes moved a robot, with all of the map or alone."""
    again = {(robot, restart.t_ns) for robot, restart in restarts(run.history).items()}
    for fix in run.history.fixes:
        if fix.moved_m > 0 and ((fix.robot, fix.t_ns) in again) == with_map:
            agreed = f"its fixes agreed that it was {fix.moved_m:.1f} m away; {what} moved there"
            yield f"{fix.robot} was lost {_since_first(run, fix.t_ns)}: {agreed}"


def _since_first(run: Recording, t_ns: int) -> str:
    return f"{(t_ns - int(run.history.t_ns[:1].sum())) * 1e-9:.1f} s after the first scan"


def _placed(run: Recording, _: Summary) -> Iterator[str]:
    yield from _moved(run, "with all of the map it was", with_map=True)
    for mine in placements(run.history):
        yield f"{words_of(mine)}, first {_since_first(run, mine[0].t_ns)}: it was lost, or they jumped"


def _diverged(_: Recording, summary: Summary) -> Iterator[str]:
    lost = [name for name, figures in summary["robots"].items() if figures.get("diverged")]
    if lost:
        names = ", ".join(lost)
        yield f"DIVERGED: the error of {names} exceeds 10 of its own sigmas and 5 % of the path; do not use this map"


def placements(history: History) -> list[list[RelocatedRobot]]:
    """Return the times when robots were placed elsewhere, those of a sensor together."""
    return [*grouped(history.placed, attrgetter("robot", "sensor")).values()]


def words_of(placed: list[RelocatedRobot]) -> str:
    """Return the words for the readings of one sensor."""
    far = ", ".join(figure(one.moved_m, 2) for one in placed[:LISTED]) + " m" + " and so on" * (len(placed) > LISTED)
    return f"readings of {placed[0].sensor} that agree moved {placed[0].robot} by {far}"


def _observations(run: Recording, summary: Summary) -> Iterator[str]:
    history, total = run.history, int(summary["observations"])
    yield from _unused(run)
    if not total and history.scans:
        yield "no observation was made: there is nothing to map"
    elif not summary["landmarks"] and history.scans and not history.localizes:
        yield "no landmark was mapped"
    seen = history.sensor_keys()
    bearing = {pair for pair in set(seen) if run.section(*pair).get("type") in BEARINGS}
    angles = history.y[[pair in bearing for pair in seen]][:, 1:]  # all but the first column are bearings
    turns = (np.abs(angles) > 2 * np.pi).any(axis=1)  # NaN, where a sensor has less numbers, is not
    if turns.any():
        yield f"{int(turns.sum())} bearings beyond 2 pi rad: are they in degrees?"


def left_out_by_attention(history: History) -> Flags:
    """Return which observations (O,) an attention left out: that contradicts nothing."""
    return history.reason_begins(ATTENTION)


def _unused(run: Recording) -> Iterator[str]:
    """Yield warnings of sensors most of whose observations could not be used, and of none of a known landmark."""
    history = run.history
    by_design = left_out_by_attention(history) | (history.reason == AGAIN)
    pairs = sorted(set(history.sensor_keys()))
    for robot, sensor in pairs:
        own = history.made_by(robot, sensor)
        of = f" of {sensor!r} of {robot!r}" if len(pairs) > 1 else ""
        mine = own & ~np.isin(history.outcome, ("associated", "new")) & ~by_design
        if 2 * int(mine.sum()) <= int(own.sum()):
            continue
        reason, number = Counter(history.reason[mine].tolist()).most_common(1)[0]
        if reason == NO_ID:
            yield f"{number} observations{of} have no id and were ignored; try --set association.type=auto"
            continue
        outcomes = " or ".join(dict(Counter(history.outcome[mine].tolist()).most_common()))
        said = reason or "no reason given"
        yield f"{int(mine.sum())} of {int(own.sum())} observations{of} were {outcomes}, most often: {said}"
    of_things = ~history.of_own
    if of_things.any() and not (of_things & (history.outcome == "associated")).any():
        yield "nothing was observed twice: no observation checks another one"


def _images(run: Recording, _: Summary) -> Iterator[str]:
    """Yield warnings of cameras whose measurements lie outside their images."""
    history = run.history
    for camera in history.cameras:
        mine = history.made_by(camera.robot, camera.sensor)
        outside = np.zeros(int(mine.sum()), dtype=np.bool_)
        for k, name in enumerate(camera.columns[: history.y.shape[1]]):
            if name.endswith("_px"):
                limit = camera.size[0 if name.startswith("u") else 1]
                outside |= (history.y[mine, k] < -MARGIN * limit) | (history.y[mine, k] > (1 + MARGIN) * limit)
        if outside.any():
            width, height = (f"{size:g}" for size in camera.size)
            yield (
                f"{int(outside.sum())} of {count(len(outside), 'measurement')} of camera {camera.sensor} lie outside "
                f"its image of {width} x {height} pixels: set width_px and height_px"
            )


def _robots(run: Recording, summary: Summary) -> Iterator[str]:
    history = run.history
    for name in history.robots:
        mine = history.robot == name
        scans, controls = history.t_ns[mine], history.controls.get(name)
        coasts = np.isfinite(history.mean[mine]).sum(axis=1).max(initial=0) not in (3, 7)  # its velocity is estimated
        if len(scans) and controls is None and not coasts:
            what = count(len(scans), "fix", "fixes") if history.stepped == "fix" else count(len(scans), "scan")
            yield f"robot {name} has {what} but no controls: it is taken to stand still"
        elif len(scans) > 1 and controls is not None and controls.number > 1:
            shared = min(int(scans[-1]), controls.last_ns) - max(int(scans[0]), controls.first_ns)
            share = max(shared, 0) / max(int(scans[-1] - scans[0]), 1)
            if share < 0.5:
                of = f"of the time of its {plural(history)}"
                yield f"controls of robot {name} cover {share:.0%} {of}: are both in seconds?"


def _sensors(run: Recording, summary: Summary) -> Iterator[str]:
    """Yield the configured sensors that no observation was by."""
    robots: Section = run.config.get("robots") or {}
    seen = set(run.history.sensor_keys())
    for key, given in robots.items() if seen and not run.stopped else ():
        mine = [name for name in run.log.robots if name == key or (key == "each" and name not in robots)]
        used = sorted({sensor for robot, sensor in seen if robot in mine})
        configured: Section = (given or {}).get("sensors") or {}
        for name, section in configured.items() if mine else ():
            if name not in used and (section or {}).get("type") != NOTICES:
                hint = did_you_mean(name, used)
                yield f"no observation is by the sensor {name} of {', '.join(mine)}, which is configured{hint}"


def _truth(run: Recording, summary: Summary) -> Iterator[str]:
    if no_ids(run) and not summary.get("landmarks_matched"):
        yield (
            "the landmarks are not scored: no ids tie them to the true ones, and less than half of them (or less than "
            f"{LEAST}) are nearer to a true one than half the way to the next: is the truth in the map's frame?"
        )
    ids, there = run.history.id[~run.history.of_own], {str(i) for i in run.truth.landmarks}
    told = set(ids.tolist()) - {"", *run.history.robots}
    if told and there and told.isdisjoint(there):
        yield f"the landmarks are not scored: the log calls them {_some(told)}, the true ones are {_some(there)}"
    true, mine = set(run.truth.robots), run.history.robots
    for name in run.truth.robots:
        if name not in mine:
            yield f"the log has truth for {name}, which is not in this run (robots: {', '.join(mine)})"
    for name in mine:
        if true and name not in true:
            yield f"the log has no truth for robot {name}, but for {', '.join(sorted(true))}"
        elif name in true and "ate_m" not in summary["robots"].get(name, {}) and (run.history.robot == name).any():
            yield f"the truth of robot {name} covers none of its {plural(run.history)}: are both in seconds?"


def plural(history: History) -> str:
    """Return the plural of the events that end a run's steps."""
    return {"fix": "fixes"}.get(history.stepped, f"{history.stepped}s")


def _some(names: set[str]) -> str:
    first = sorted(names, key=lambda name: (len(name), name))[:3]
    return ", ".join(first) + (", ..." if len(names) > len(first) else "")


def _first_fixes(run: Recording, summary: Summary) -> Iterator[str]:
    starts = {start.robot: start for start in run.history.starts}
    for name, (first, *_) in grouped(run.history.fixes, attrgetter("robot")).items():
        if name in starts and first.d2 > gate(FIRST_FIX, len(first.z)):
            far, sigma = float(np.linalg.norm(first.z)), float(place_sigma(starts[name].covariance, len(first.z)))
            yield (
                f"the first fix of {name} is {figure(far)} m from where its start puts it, "
                f"with a configured sigma of {figure(sigma)} m: set robots.{name}.start"
            )


def _fixes(run: Recording, summary: Summary) -> Iterator[str]:
    value = summary.get("fix_nis_per_dof")
    if value is not None and value > FIX_NIS_HIGH and summary["fixes"] >= FEW_FIXES:
        yield f"NIS per degree of freedom of the fixes is {figure(value)} where 1 is consistent: too small a noise?"
    if 2 * summary["fixes_rejected"] > summary["fixes"]:
        yield f"{summary['fixes_rejected']} of {count(summary['fixes'], 'fix', 'fixes')} were rejected by the gate"


def fix_nis_per_dof(fixes: tuple[UsedFix, ...]) -> float:
    """Return the sum of the normalised innovations squared of the fixes used over their dimensions, NaN without any."""
    used = [fix for fix in fixes if fix.used]
    return ratio(sum(fix.d2 for fix in used), sum(len(fix.z) for fix in used))


def is_overconfident(figures: Summary) -> bool:
    """Return whether the truth shows a robot's pose to be off by more than its covariance."""
    value, most = figures.get("pose_nees"), figures.get("pose_nees_most")
    return value is not None and most is not None and value > most


def _noise(run: Recording, summary: Summary) -> Iterator[str]:
    dof = summary["pose_dof"]
    for name, figures in summary["robots"].items():
        value = figures.get("pose_nees")
        if is_overconfident(figures):
            whose = f" of {name}" if len(summary["robots"]) > 1 else ""
            yield (
                f"pose NEES{whose} {figure(value)} where {dof} is consistent, and at most "
                f"{figure(figures['pose_nees_most'], 2)} in such a run: the noise in the configuration is not what "
                "this log has (correlated or biased errors?)"
            )
    value = summary["nis_per_dof"]
    if value is not None and value > NIS_HIGH and summary["associated"] >= 50:
        yield f"NIS per degree of freedom {figure(value, 2)} where 1 is consistent: {TOO_SMALL}"


def _stated_too_large(run: Recording, summary: Summary) -> Iterator[str]:
    history = run.history
    if summary["diverged"] or any(map(is_overconfident, summary["robots"].values())):
        return
    for sensor in dict.fromkeys(history.sensor.tolist()):
        mine = (history.outcome == "associated") & (history.sensor == sensor) & np.isfinite(history.noise).any(axis=1)
        if mine.sum() >= NUMBER and len(set(history.step[mine].tolist())) >= SCANS:
            sections = [run.section(robot, sensor) for robot in run.config.get("robots") or {}]
            columns = next((COLUMNS.get(str(section.get("type")), ()) for section in sections if section), ())
            dof = int(np.isfinite(history.z[mine]).sum(axis=1).max())
            yield from _compared(history, sensor, mine, columns, _cut_off(run, sections, dof))


def _fixes_stated_too_large(summary: Summary) -> Iterator[str]:
    value = summary.get("fix_nis_per_dof")
    if value is not None and value < LOW and summary["fixes"] - summary["fixes_rejected"] >= NUMBER // 2:
        yield (
            f"fixes: NIS {figure(value, 2)} where 1 is expected: their sigma is stated at least "
            f"{figure(value**-0.5, 2)} times too large, unless their errors last from one to the next"
        )


def _cut_off(run: Recording, sections: list[Section], dof: int) -> float:
    """Return the variance of innovations of `dof` numbers that the gate of a sensor's association leaves of one."""
    own = next((section["association"] for section in sections if section.get("association")), None)
    share = (own or run.config.get("association") or {}).get("gate")
    if share == "default":
        with suppress(KeyError):  # of a plug-in that is not loaded
            return truncated_variance(class_of("estimator", run.estimator).default_gate, dof)  # type: ignore[attr-defined]
    return truncated_variance(gate(share, dof), dof) if isinstance(share, float) else 1.0


def _compared(history: History, sensor: str, mine: Any, columns: tuple[str, ...], left: float) -> Iterator[str]:
    """Compare the squares with those of the noise that is stated, of which the gate leaves so much."""
    size = int(np.isfinite(history.noise[mine]).sum(axis=1).max())  # the padding after its numbers is that of others
    z, sigma = history.z[mine], history.noise[mine]
    squares = np.nanmean((z[:, :size] / sigma[:, :size]) ** 2, axis=0) / left
    low = np.flatnonzero(squares < LOW)
    if not len(low):
        return
    value, dof = nis(z, history.Z[mine])
    factors = 1.0 / np.sqrt(np.maximum(squares, TINY))
    if len(columns) == size:
        told = "sigma is", ", ".join(f"{figure(factors[k], 2)} times ({columns[k]})" for k in low)
    elif len(low) == size:
        told = "sigmas are", f"{figure(float(1.0 / np.sqrt(np.mean(np.maximum(squares, TINY)))), 2)} times"
    else:
        return
    share = figure(float(np.nansum(value) / dof.sum()), 2)
    yield (
        f"sensor {sensor}: NIS {share} where 1 is expected: its {told[0]} stated about {told[1]} too large, "
        "unless its errors last from one observation to the next"
    )
