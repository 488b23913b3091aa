"""How often a landmark was searched for in images, found and fitted; and whether it is worth its place any more."""

from __future__ import annotations

from dataclasses import dataclass

TRIAL = 10  # searches after which a landmark may be given up
LEAST_SHARE = 0.5  # of its searches in which one is found and fits; fewer: it is given up
MOST_MISSED = 3  # times in a row that a new one may be missed


@dataclass
class Searches:
    """Counts of a landmark."""

    searched: int = 0
    found: int = 0
    fitted: int = 0
    missed: int = 0  # searches since it last fitted
    seen: int = -1  # frame of the last

    def searched_for(self, found: bool) -> str:
        """Count a search; return why the landmark is given up, "" if it is not."""
        self.searched, self.missed = self.searched + 1, self.missed + 1
        if found:
            self.found += 1
        elif self.searched >= TRIAL and self.fitted < LEAST_SHARE * self.searched:
            return f"fitted in {self.fitted} of {self.searched} searches"
        elif self.searched < TRIAL and self.missed >= MOST_MISSED:
            return f"not found in {self.missed} searches, {self.fitted} before"
        return ""
