"""Counts of the searches for a landmark in images, found and fitted; the decision to keep it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from kalmark.events import Id

TRIAL = 10  # searches after which a landmark may be given up
LEAST_SHARE = 0.5  # of its searches in which one is found and fits; fewer: it is given up
MOST_MISSED = 3  # times in a row that a new one may be missed
RECENT, MOST_MISFIT = 20, 2.0  # matches, and their mean d2 above which a landmark is given up: it slides


@dataclass
class Searches:
    """Counts of a landmark."""

    searched: int = 0
    found: int = 0
    fitted: int = 0
    missed: int = 0  # searches since it last fitted
    seen: int = -1  # frame of the last
    misfit: float = 0.0  # mean d2 of recent matches, a number measured: 1 where they fit

    def searched_for(self, found: bool) -> str:
        """Count a search; return why the landmark is given up, "" if it is not."""
        self.searched, self.missed = self.searched + 1, self.missed + 1
        if found:
            self.found += 1
        elif self.searched >= TRIAL and self.fitted < LEAST_SHARE * self.searched:
            return f"fitted in {self.fitted} of {self.searched} searches"
        elif self.searched < TRIAL and self.missed >= MOST_MISSED:
            return f"not found in {self.missed} searches, {self.fitted} before"
        if self.fitted >= TRIAL and self.misfit > MOST_MISFIT:
            return f"matches are off by {self.misfit:.1f} times their noise, as d2"
        return ""

    def fits(self, d2: float, frame: int) -> None:
        """Count a match in a frame, d2 being that of what it left, a number measured."""
        self.fitted, self.missed, self.seen = self.fitted + 1, 0, frame
        self.misfit += (d2 - self.misfit) / min(self.fitted, RECENT)


def make_room(looks: Mapping[Id, Searches], most: int, stay: Iterable[Id], gone: set[Id]) -> list[tuple[Id, str]]:
    """Return the landmarks above the number `most` that make room for new ones, least fitted first.

    Those that `stay`, as they are in view, do not; those that are `gone` do not count any more.
    """
    stay = {*stay, *gone}
    out = sorted((look.fitted, look.seen, k, name) for k, (name, look) in enumerate(looks.items()) if name not in stay)
    return [(name, "made room") for *_, name in out[: max(len(looks) - len(gone) - most, 0)]]
