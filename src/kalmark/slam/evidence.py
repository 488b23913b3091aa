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

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from kalmark.association.global_start import SURE
from kalmark.events import Id

MOST, RECENT = 64, 256  # landmarks whose misses count most, and that were seen last, which outweigh all others
NEVER_NS = -(2**62)  # when landmarks begin that were surveyed
EQUAL = 1e-9  # between two ratios that are one but for rounding


@dataclass
class Evidence:
    """Landmarks `seen`, with when they were begun, when seen last, and the log, and those `missed` since.

    Of these it is when they were seen last, since when they are missed, and the log.  `ratio` is the least one, of an
    onset at `since_ns`, `gain` that of the robot's second hypothesis, in which the landmarks `fitted` have counted with
    these logs, those of the constellation together.
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

    def weigh(self, again: Sequence[tuple[int, float]] = ()) -> None:
        """Find the onset of the least ratio, the last one of several.

        Each landmark counts for the onsets s of an interval: a missed one from when it was seen last until it is
        missed, a seen one from when it was begun until it was seen.  Those begun `again` at these times, with their
        logs, count until then: they are older ones if the robot was elsewhere when they were begun.
        """
        if all(last >= first for last, first, _ in self.missed.values()):
            self.ratio = 0.0
            return
        recent = islice(reversed(self.seen.values()), RECENT)
        terms = [*self.missed.values(), *recent, *((NEVER_NS, begun, log) for begun, log in again)]
        begin, end, logs = (np.array(column) for column in zip(*terms, strict=True))
        is_missed = np.arange(len(logs)) < len(self.missed)
        times, at = np.unique(np.concatenate([begin, end]), return_inverse=True)
        ratios = np.cumsum(np.bincount(at, np.concatenate([logs, -logs])))
        some = np.cumsum(np.bincount(at, np.concatenate([is_missed, -1.0 * is_missed]))) > 0.5
        least = ratios[some].min()
        last = np.flatnonzero(some & (ratios <= least + EQUAL))[-1]
        self.ratio, self.since_ns = float(least), int(times[last + 1] - 1)

    def count(self, logs: Mapping[Id, float]) -> None:
        """Count landmarks for the second hypothesis, each once: one that was missed at first, when it is seen."""
        for name, log in logs.items():
            before = self.fitted.get(name, 0.0)
            if name not in self.fitted or before < 0.0 < log:
                self.gain += log - before
                self.fitted[name] = log
