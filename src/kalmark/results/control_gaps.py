"""Gaps in the controls of a run: when they were, by how much the pose was widened, and when it was known again."""

from __future__ import annotations

from collections.abc import Iterator
from operator import itemgetter

import numpy as np

from kalmark.arrays import Flags
from kalmark.report import ELSEWHERE, Gap
from kalmark.results.figure_texts import Figures, Summary, count, figure
from kalmark.results.history import History, grouped
from kalmark.results.measures import place_sigma
from kalmark.results.recording import Recording

KNOWN = 0.5  # of the sigma that a gap gave it, below which the position is known again
RULED_OUT = "ruled_out"  # the kind of a gap that is made: of controls beyond the limits of their robot
KINDS = "held", "increments"  # of gaps in the controls
NOTED, NOTED_S = 0.2, 0.5  # of a metre or a radian, sigmas above which a longer gap is worth a line


def merge_gaps(found: list[Gap]) -> tuple[Gap, ...]:
    """Return the gaps of which these are parts, each with all by which the pose was widened for it."""
    whole: dict[tuple[str, str, int], Gap] = {}
    for gap in found:
        key = gap.robot, gap.kind, gap.start_ns
        before = whole.get(key, gap._replace(sigma_m=0.0, sigma_rad=0.0))
        sigma_m, sigma_rad = np.hypot(before.sigma_m, gap.sigma_m), np.hypot(before.sigma_rad, gap.sigma_rad)
        whole[key] = gap._replace(sigma_m=float(sigma_m), sigma_rad=float(sigma_rad))
    return tuple(whole.values())


def gap_figures(run: Recording) -> list[Figures]:
    """Return the gaps as they are in ``summary.json``: times in seconds of the log, sigmas that the pose was given.

    `known_s` is when the position was known again to half of that, None if it never was.
    """
    history = run.history
    return [
        {
            "robot": gap.robot,
            "kind": gap.kind,
            "start_s": gap.start_ns * 1e-9,
            "end_s": gap.end_ns * 1e-9,
            "action": "widen" if gap.sigma_m > 0 else "ignore",
            "sigma_m": gap.sigma_m,
            "sigma_rad": gap.sigma_rad,
            "known_s": _known_s(history, gap),
        }
        for gap in history.gaps
    ]


def while_lost(history: History) -> Flags:
    """Return at which steps (S,) a robot is not known again after a gap."""
    out = np.zeros(len(history.t_ns), dtype=np.bool_)
    for gap in history.gaps:
        known_s = _known_s(history, gap) if gap.sigma_m > 0.0 else gap.end_ns * 1e-9
        until_ns = np.inf if known_s is None else known_s * 1e9 - 1.0
        out |= history.between(gap.robot, gap.start_ns, until_ns)
    return out


def _known_s(history: History, gap: Gap) -> float | None:
    later = np.flatnonzero((history.robot == gap.robot) & (history.t_ns >= gap.end_ns))
    earlier = np.flatnonzero((history.robot == gap.robot) & (history.t_ns <= gap.start_ns))
    sigma, before = (place_sigma(history.covariance[rows], history.d) for rows in (later, earlier[-1:]))
    again = later[sigma <= max(KNOWN * gap.sigma_m, before.sum())]
    return float(history.t_ns[again[0]]) * 1e-9 if len(again) else None


def is_reported(gap: Figures) -> bool:
    """Return whether a gap left the pose so uncertain that it is worth a line."""
    return max(gap["sigma_m"], gap["sigma_rad"]) > NOTED and gap["end_s"] - gap["start_s"] > NOTED_S


def stayed_lost(gap: Figures) -> bool:
    """Return whether a robot was not localized again after a gap that was bridged."""
    return gap["action"] == "widen" and gap["known_s"] is None and is_reported(gap)


def carried_line(gap: Summary) -> str:
    """Return that a robot came elsewhere in an unknown way, and where and when it was found."""
    moved = f"{figure(gap['sigma_m'])} m and {figure(float(np.degrees(gap['sigma_rad'])), 2)} deg"
    since = f"{gap['robot']} was elsewhere from t={gap['start_s']:.1f} s on"
    return f"{since}: its landmarks placed it {moved} away at t={gap['end_s']:.1f} s"


def controls_left_out(summary: Summary) -> Iterator[tuple[float, str]]:
    """Yield of each robot the time, s of the log, and a line of the controls that were beyond its limits."""
    odd = [gap for gap in summary.get("gaps", ()) if gap["kind"] == RULED_OUT]
    for robot, mine in grouped(odd, itemgetter("robot")).items():
        begin_s, often = mine[0]["start_s"], count(len(mine), "time")
        yield (
            begin_s,
            f"controls of {robot} are beyond its limits {often}, first at t={begin_s:.1f} s: they were left out",
        )


def gap_notes(gaps: list[Figures]) -> Iterator[str]:
    """Yield a line a robot of the gaps that were bridged, and of controls that were left out."""
    yield from (line for _, line in controls_left_out({"gaps": gaps}))
    yield from (carried_line(gap) for gap in gaps if gap["kind"] == ELSEWHERE)
    noted = [gap for gap in gaps if is_reported(gap) and gap["kind"] in KINDS]
    for robot, mine in grouped(noted, itemgetter("robot")).items():
        longest = max(mine, key=lambda gap: gap["end_s"] - gap["start_s"])
        lasts, turn = longest["end_s"] - longest["start_s"], np.degrees(longest["sigma_rad"])
        what = "is held too long" if longest["kind"] == "held" else "stops"
        often = f" {count(len(mine), 'time')}, at the longest" if len(mine) > 1 else ""
        yield (
            f"the control of {robot} {what}{often} for {figure(lasts)} s from t={longest['start_s']:.1f} s in the log: "
            f"its pose was widened by {figure(longest['sigma_m'], 2)} m and {figure(float(turn), 2)} deg there"
        )


def gap_warnings(gaps: list[Figures]) -> Iterator[str]:
    """Warn of gaps after which the map may be wrong: ignored ones, and those after which the robot stayed lost."""
    for gap in gaps:
        lasts = f"no controls of {gap['robot']} for {figure(gap['end_s'] - gap['start_s'])} s"
        since = f"from t={gap['start_s']:.1f} s in the log"
        if gap["action"] == "ignore":
            yield f"{lasts} {since}, which was ignored: the map may be wrong from there on; robots.each.gaps=widen"
        elif stayed_lost(gap):
            yield f"{lasts} {since}: it was not localized again, the map may be wrong from there on"
