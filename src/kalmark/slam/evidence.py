"""The evidence that a robot is elsewhere than its filter has it: a log-likelihood ratio over the time of its onset.

It is that of what is observed from here against what a robot anywhere would observe.  Of each landmark

    seen where it is expected        - log p,       p the probability that one is there by chance
    expected, and not seen there     log(1 - p_D),  p_D its detection probability
    observed, by its id, elsewhere   log p

and the ratio of an onset s is the sum of these over the landmarks that were begun before s and seen, or first missed,
after it: those begun since then fit wherever the robot is.  The evidence is the least ratio of any onset (Page 1954).
Once it is known where the robot is instead, those begun since s that are older landmarks from there add log p each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from kalmark.association.global_start import SURE
from kalmark.events import Id

MOST, RECENT = 64, 256  # landmarks whose misses count most, and that were seen last, which outweigh all others
NEVER_NS, MAPPED_NS = -1, 0  # when landmarks begin that were surveyed, and that were mapped before what is recorded


@dataclass
class Evidence:
    """Landmarks `seen`, with when they were begun, when seen last, and the log, and those `missed` since.

    Of these it is when they were seen last, since when they are missed, and the log.  `ratio` is the least one, of an
    onset at `since_ns`, `gain` that of the robot's second hypothesis, in which the landmarks `fitted` have counted.
    `far` are the places (x, y, sigma), in space with z, of observations with ids elsewhere, as the filter has them, and
    so many scans of these were `held` back.
    """

    seen: dict[Id, tuple[int, int, float]] = field(default_factory=dict)
    missed: dict[Id, tuple[int, int, float]] = field(default_factory=dict)
    ratio: float = 0.0
    since_ns: int = 0
    held: int = 0
    far: dict[Id, tuple[float, ...]] = field(default_factory=dict)
    gain: float = 0.0
    fitted: set[Id] = field(default_factory=set)

    def begin(self, names: Iterable[Id], t_ns: int) -> None:
        """Take note of landmarks that were begun."""
        self.seen |= {name: (t_ns, t_ns, 0.0) for name in names}

    def see(self, names: Iterable[Id], logs: Iterable[float], t_ns: int, surveyed: Callable[[Id], bool]) -> None:
        """Take note of landmarks that were seen where they are expected."""
        for name, log in zip(names, logs, strict=True):
            begun = self.seen.pop(name, (NEVER_NS if surveyed(name) else MAPPED_NS,))[0]
            self.seen[name] = begun, t_ns, min(float(log), SURE)  # the last one of all
            self.missed.pop(name, None)

    def miss(self, names: Iterable[Id], logs: Iterable[float], t_ns: int, surveyed: Callable[[Id], bool]) -> None:
        """Take note of landmarks that were not seen where they are expected, or elsewhere."""
        for name, log in zip(names, logs, strict=True):
            last = self.seen[name][1] if name in self.seen else NEVER_NS if surveyed(name) else MAPPED_NS
            self.missed.setdefault(name, (last, t_ns, max(float(log), -SURE)))
        most = sorted(reversed(self.missed), key=lambda name: self.missed[name][2])[:MOST]
        self.missed = {name: told for name, told in self.missed.items() if name in most}

    def weigh(self, again: Mapping[Id, float] | None = None) -> None:
        """Find the onset of the least ratio.

        The landmarks mapped `again`, with their logs, are older ones if the robot was elsewhere when they were begun.
        """
        if not self.missed:
            self.ratio = 0.0
            return
        last, first, logs = (np.array(column) for column in zip(*self.missed.values(), strict=True))
        again = again or {}
        mapped = np.array([self.seen[name][0] for name in again], dtype=np.int64)
        s = np.unique(np.concatenate([last, first - 1, mapped - 1]))
        ratios = logs @ ((last[:, None] <= s) & (s < first[:, None]))
        if self.seen:
            recent = islice(reversed(self.seen.values()), RECENT)
            begun, seen, gains = (np.array(column) for column in zip(*recent, strict=True))
            ratios = ratios + gains @ ((begun[:, None] <= s) & (s < seen[:, None]))
        ratios = ratios + np.array([*again.values()]) @ (s < mapped[:, None])
        self.ratio, self.since_ns = float(ratios.min()), int(s[np.flatnonzero(ratios == ratios.min())[-1]])

    @property
    def young(self) -> set[Id]:
        """The landmarks that were begun since the onset."""
        return {name for name, (begun, _, _) in self.seen.items() if begun > self.since_ns}
