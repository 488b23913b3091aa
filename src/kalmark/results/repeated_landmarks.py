"""Repeats in the map at the end of a run: landmarks that were mapped twice, how far apart, and since when."""

from __future__ import annotations

from collections.abc import Iterator
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from kalmark.management.repeated_places import IN_A_REPEAT, find_repeats
from kalmark.results.figure_texts import Figures, count, figure
from kalmark.results.history import History, Repeated, grouped
from kalmark.results.recording import Recording

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

NAMED = 3  # pairs that a warning names
SOME = 3  # landmarks of a part


def repeat_rows(slam: Slam) -> tuple[Repeated, ...]:
    """Return the repeats in a filter's map, a row a pair."""
    return tuple(
        Repeated(number, str(a), str(b), each.shift, float(each.T[2]), each.score, each.p)
        for number, each in enumerate(find_repeats(slam.map, slam.tracks))
        for a, b in each.pairs
    )


def repeat_figures(run: Recording) -> list[Figures]:
    """Return the repeats as they are in ``summary.json``, the surest first.

    `start_s` is when three landmarks of the newer part had been observed, in seconds of the log.
    """
    return [
        {
            "landmarks": [[row.landmark, row.other] for row in mine],
            "shift_m": mine[0].shift.tolist(),
            "turn_rad": mine[0].turn_rad,
            "score": mine[0].score,
            "p": mine[0].p,
            "start_s": _start_s(run.history, [row.other for row in mine]),
        }
        for mine in grouped(run.history.repeats, attrgetter("number")).values()
    ]


def repeat_notes(history: History) -> Iterator[str]:
    """Yield warnings of the repeats that were merged while the map grew."""
    steps = [change.step for change in history.changes if change.reason.endswith(IN_A_REPEAT)]
    for step in dict.fromkeys(steps):
        when = float(history.t_ns[step]) * 1e-9
        what = f"{count(steps.count(step), 'landmark')} mapped twice, in a map that repeated itself"
        yield f"{what}: merged at t={when:.1f} s in the log"


def _start_s(history: History, landmarks: list[str]) -> float | None:
    """Return the time at which some of these landmarks had been observed: one or two may be of the older part."""
    mine = np.isin(history.landmark, landmarks)
    first = np.sort(history.step[mine][np.unique(history.landmark[mine], return_index=True)[1]])
    return float(history.t_ns[first[min(len(first), SOME) - 1]]) * 1e-9 if len(first) else None


def repeat_warnings(found: list[Figures]) -> Iterator[str]:
    """Warn of each repeat: which landmarks, how far apart, since when, and what to do."""
    for each in found:
        pairs, far = each["landmarks"], float(np.hypot(*each["shift_m"]))
        named = ", ".join(f"{a} and {b}" for a, b in pairs[:NAMED]) + (", ..." if len(pairs) > NAMED else "")
        since = "" if each["start_s"] is None else f", from t={each['start_s']:.1f} s in the log on"
        yield (
            f"the map repeats itself: {count(len(pairs), 'landmark')} seem to be mapped twice, {figure(far)} m and "
            f"{figure(float(np.degrees(each['turn_rad'])), 2)} deg apart{since} ({named}); if they are, the robot lost "
            "its way before that: robots.each.gaps=widen, upkeep.repeats=merge, or more noise of its controls"
        )
