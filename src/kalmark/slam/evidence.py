"""The evidence that a robot is elsewhere than its filter has it: a log-likelihood ratio over the time of its onset.

It is that of what is observed from here against what a robot anywhere would observe.  Of each landmark

    seen where it is expected        log N(z; 0, Z) - log rho,  rho the density of landmarks
    expected, and not seen there     log(1 - p_D),  p_D its detection probability
    observed, by its id, elsewhere   log p,         p the probability of that by chance

and the ratio of an onset s is the sum of these over the landmarks that were begun before s and seen, or first missed,
after it: those begun since then fit wherever the robot is.  The evidence is the least ratio of any onset (Page 1954).
Once it is known where the robot is instead, those begun since s that are older landmarks from there add log p each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.association.global_start import SURE
from kalmark.events import Id

MOST, RECENT = 64, 256  # landmarks whose misses count most, and that were seen last, which outweigh all others
FEWEST = 5  # landmarks of a constellation that was mapped where nothing shows that the robot is elsewhere
NEVER_NS = -(2**62)  # when landmarks begin that were surveyed
NOTHING = NEVER_NS, NEVER_NS, 0.0
EQUAL = 1e-9  # between two ratios that are one but for rounding


@dataclass
class Evidence:
    """Landmarks `seen`, with when they were begun, when seen last, and the log, and those `missed` since.

    Of these it is when they were seen last, since when they are missed, and the log.  `ratio` is the least one, of an
    onset at `since_ns`, `gain` that of the robot's second hypothesis, in which the landmarks `fitted` have counted with
    these logs, those of the constellation together.
    Those begun `again` are older ones in that hypothesis, with when they were begun and the log; p is the probability
    of a fit by chance.  `searched` is how much the map had changed when a constellation was looked for.
    `far` are the places (x, y), in space with z, of observations with ids elsewhere and of their sensor, as the filter
    has them, with a sigma.
    """

    seen: dict[Id, tuple[int, int, float]] = field(default_factory=dict)
    missed: dict[Id, tuple[int, int, float]] = field(default_factory=dict)
    ratio: float = 0.0
    since_ns: int = 0
    far: dict[Id, tuple[float, ...]] = field(default_factory=dict)
    gain: float = 0.0
    fitted: dict[Id, float] = field(default_factory=dict)
    again: list[tuple[int, float]] = field(default_factory=list)
    p: float = 0.0
    searched: int = 0

    def see(self, names: Iterable[Id], logs: Iterable[float], t_ns: int, begun_ns: Callable[[Id], int]) -> None:
        """Take note of landmarks that were seen where they are expected."""
        for name, log in zip(names, logs, strict=True):
            self.seen.pop(name, None)
            self.seen[name] = begun_ns(name), t_ns, min(float(log), SURE)  # the last one of all
            self.missed.pop(name, None)

    def miss(self, names: Iterable[Id], logs: Iterable[float], t_ns: int, begun_ns: Callable[[Id], int]) -> None:
        """Take note of landmarks that were not seen where they are expected, or elsewhere."""
        for name, log in zip(names, logs, strict=True):
            last = self.seen[name][1] if name in self.seen else begun_ns(name)
            self.missed.setdefault(name, (last, t_ns, max(float(log), -SURE)))
        most = sorted(reversed(self.missed), key=lambda name: self.missed[name][2])[:MOST]
        self.missed = {name: since for name, since in self.missed.items() if name in most}

    def weigh(self) -> None:
        """Find the onset of the least ratio, the last one of several, those begun `again` included.

        These are older ones if the robot was elsewhere when they were begun; they are no evidence of where it is not.
        """
        self.ratio = 0.0
        if not (self.missed or self.again):
            return
        onsets, missed, seen, again = self._of_onsets()
        some = missed + again < -EQUAL
        if not some.any():
            return
        ratios = missed + seen
        least = (ratios + again)[some].min()
        last = np.flatnonzero(some & (ratios + again <= least + EQUAL))[-1]
        self.ratio, self.since_ns = float(ratios[last]), int(onsets[last])

    def onset(self, begun: Sequence[int], odds: float) -> int | None:
        """Return the onset of the least ratio, the last one of several, that landmarks `begun` since then may outweigh.

        They do so by odds if they are older ones, and enough for a constellation.
        """
        onsets, missed, seen, _ = self._of_onsets()
        young, ratios = len(begun) - np.searchsorted(np.sort(begun), onsets, side="right"), missed + seen
        some = np.flatnonzero((young >= FEWEST) & (ratios - SURE * young <= -math.log(odds)))
        return int(onsets[some[ratios[some] <= ratios[some].min() + EQUAL][-1]]) if len(some) else None

    def _of_onsets(self) -> tuple[Index, Array, Array, Array]:
        """Return onsets (S,), and the sums (S,) of the logs of landmarks missed, seen, and begun `again`.

        Each landmark counts for the onsets of an interval: a missed one from when it was seen last until it is missed,
        a seen one from when it was begun until it was seen, those begun `again` at these times until then.
        """
        recent = [*islice(reversed(self.seen.values()), RECENT), NOTHING]
        terms = [*self.missed.values(), *recent, *((NEVER_NS, begun, log) for begun, log in self.again)]
        begin, end, logs = (np.array(column) for column in zip(*terms, strict=True))
        times, at = np.unique(np.concatenate([begin, end]), return_inverse=True)
        which = np.repeat([0, 1, 2], [len(self.missed), len(recent), len(self.again)])
        changes = np.zeros((3, len(times)))
        np.add.at(changes, (np.tile(which, 2), at), np.concatenate([logs, -logs]))
        return times[1:] - 1, *np.cumsum(changes, axis=1)[:, :-1]

    def count(self, logs: Mapping[Id, float]) -> None:
        """Count landmarks for the second hypothesis, each once: by the last time that it was seen, if it was."""
        for name, log in logs.items():
            before = self.fitted.get(name, 0.0)
            if name not in self.fitted or (before != 0.0 < log):  # those of the constellation count together
                self.gain += log - before
                self.fitted[name] = log
