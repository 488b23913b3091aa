"""A verdict in plain words: one source for the terminal, the page and the picture."""

from __future__ import annotations

from collections.abc import Iterator

from kalmark.results.checked import OK, UNCHECKED, worst_status
from kalmark.results.figure_texts import Summary, count, figure

SHOWN = 3  # causes in a short verdict
ROUNDING_M = 1e-9
INNOVATIONS = "innovations alone"  # how a map was checked that has no batch solution
NO_MAP = "no landmark is in the map"  # why there is none: only the path is to be judged
NO_BATCH = "none was found for this log"  # why there is none of a map
NO_LANDMARKS = "no sensor observes landmarks"  # why there is no map, either
SEEN = 0.02  # by which a factor of the sigmas is worth a word, and of the accuracy a shift


def verdict_lines(verdict: Summary, shown: int | None = SHOWN) -> Iterator[str]:
    """Yield a verdict of ``summary.json`` in words: the map, then so many causes (None: all), each with its cure."""
    causes = verdict["causes"]
    yield _first(verdict)
    some = causes if shown is None else causes[:shown]
    for cause in some:
        yield f"{cause['name']}: {cause['evidence']}{'; ' + cause['cure'] if cause['cure'] else ''}"
    if len(some) < len(causes):
        yield f"{count(len(causes) - len(some), 'more cause')}: kalmark diagnose"
    if verdict.get("left_out"):
        more = "" if shown is None else "; kalmark diagnose RUN looks further"
        yield f"not looked at: {', '.join(verdict['left_out'])}{more}"


def alarm(verdict: Summary | None) -> list[str]:
    """Return the lines for the picture of a map or a path that is not ok: the first cause."""
    if verdict is None or overall(verdict) == OK:
        return []
    return [_first(verdict), *(cause["evidence"] for cause in verdict["causes"][:1])]


def overall(verdict: Summary) -> str:
    """Return the worst status of a map and of the paths of its robots."""
    return worst_status(verdict["map"], *verdict.get("robots", {}).values())


def _first(verdict: Summary) -> str:
    """Return the summary line: the status of the map, or the path, its cause, and its accuracy."""
    harmful = next((f" because of {cause['name']}" for cause in verdict["causes"] if not cause["harmless"]), "")
    why = ": the log does not check it" if verdict["map"] == UNCHECKED else harmful * (verdict["map"] != OK)
    what = "path" if str(verdict["checked"]).endswith((NO_MAP, NO_LANDMARKS)) else "map"
    because = harmful * (verdict["map"] == OK)
    others = [each for each in verdict.get("robots", {}).items() if each[1] != verdict["map"]]
    paths = [f"the path of {of} is {status}{because * (status != UNCHECKED)}" for of, status in others]
    return "; but ".join([f"the {what} is {verdict['map']}{why}{_trust(verdict)}", *[", ".join(paths)] * bool(paths)])


def _trust(verdict: Summary) -> str:
    """Return the accuracy of a map, as text."""
    factor, accuracy, shift = (verdict[key] for key in ("sigma_factor", "accuracy_m", "shift_m"))
    if verdict["map"] != "ok":
        least = max(SEEN * (accuracy or 0.0), ROUNDING_M)
        return f": its shape is off by {figure(shift)} m" if shift and shift > least else ""
    if factor is None:
        return f", by {checked}" if (checked := str(verdict["checked"])).startswith(INNOVATIONS) else ""
    said = f"{figure(factor, 2)} times what the filter states" if abs(factor - 1.0) > SEEN else "as the filter states"
    world, shape = (figure(value, 2) for value in (accuracy, verdict.get("shape_accuracy_m", accuracy)))
    good = f"{shape} m in shape, {world} m in the world" if shape != world else f"{world} m in shape and in the world"
    return f": its landmarks are good to {good} (1 sigma, {said})"
