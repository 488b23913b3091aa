"""Surveyed landmarks whose observations do not fit: a test whether the survey or the pose is wrong.

An observation outside its gate is left out, as a fix is.  Observations of two such landmarks with none between that
fits show that the robot is elsewhere: those are used.  A landmark of which five observations in a row do not fit, while
at least two thirds of the surveyed landmarks fit, is at another place than its survey states: it is removed, and its
next observation maps it again.
Landmarks that were mapped from here do not count: they fit wherever the robot is.
"""

from __future__ import annotations

from collections.abc import Collection

from kalmark.events import Id

SURVEYED = 0.9999  # of right observations are within the gate
MISFITS, TWICE = 5, 2  # observations in a row that do not fit, and landmarks that do: the survey is wrong
TRUSTED = 5  # observations that fit, after which it is right


class Surveys:
    """Test of surveys by observations.

    `trial`: of landmarks in the map, how many observations have fitted so far.  `trusted`: those of which enough have.
    `misfits`: how many observations in a row did not fit, and which landmarks did meanwhile.  `misfitting`:
    landmarks without a fitting observation since the last one that fitted, by robot.
    """

    trial: dict[Id, int]
    trusted: set[Id]
    misfits: dict[Id, tuple[int, frozenset[Id]]]
    misfitting: dict[str, set[Id]]

    def __init__(self) -> None:
        self.trial, self.trusted, self.misfits, self.misfitting = {}, set(), {}, {}

    def forget(self, name: Id) -> None:
        """Forget a landmark."""
        self.trial.pop(name, None)
        self.trusted.discard(name)
        self.misfits.pop(name, None)
        for names in self.misfitting.values():
            names.discard(name)

    def judge(self, robot: str, fitting: Collection[Id], others: Collection[Id]) -> bool:
        """Count observations that fit and others that do not; return whether the robot, not a survey, is wrong."""
        for name in fitting:
            self.misfits.pop(name, None)
            if name in self.trial:
                self.trial[name] += 1
                if self.trial[name] >= TRUSTED:
                    del self.trial[name]
                    self.trusted.add(name)
        if fitting:
            self.misfits = {name: (out, fit.union(fitting)) for name, (out, fit) in self.misfits.items()}
            self.misfitting.pop(robot, None)
        for name in others:
            out, fit = self.misfits.get(name, (0, frozenset[Id]()))
            self.misfits[name] = out + 1, fit.union(fitting)
        misfitting = self.misfitting.setdefault(robot, set())
        misfitting.update(others if not fitting else ())
        if len(misfitting) < 2:
            return False
        for name in [*misfitting, *others]:
            self.misfits.pop(name, None)
        misfitting.clear()
        return True

    def contradict(self) -> bool:
        """Return whether no more landmarks fit than do not meanwhile: then it may be the robot."""
        fitting = frozenset[Id]().union(*(fit for _, fit in self.misfits.values()))
        return len(self.misfits) >= TWICE and len(self.misfits) >= len(fitting - self.misfits.keys())

    def wrong(self) -> list[Id]:
        """Return the landmarks that stand elsewhere."""
        least = TWICE * len(self.misfits)
        return [name for name, (out, fit) in self.misfits.items() if out >= MISFITS and len(fit) >= least]
