"""Surveyed landmarks whose sightings do not fit: whether they stand elsewhere, or their robot.

A sighting outside its gate is left out, as a fix is.  Sightings of two such landmarks with none between that fits say
that the robot is elsewhere, not they: those are taken.  A landmark of which five sightings in a row do not fit, while
as many of others do, stands elsewhere: it is removed, and its next sighting maps it anew.
"""

from __future__ import annotations

from collections.abc import Collection

from kalmark.events import Id

MISFITS = 5  # sightings in a row that do not fit, and of others that do: the survey is wrong
TRUSTED = 5  # sightings that fit, after which it is right


class Surveys:
    """What sightings say of surveys.  `trial`: of landmarks in the map, how many sightings have fitted so far.

    `misfits`: how many sightings in a row did not fit, and how many of others did meanwhile.  `strangers`: by robot,
    the landmarks that did not fit since one did.
    """

    def __init__(self) -> None:
        self.trial: dict[Id, int] = {}
        self.misfits: dict[Id, tuple[int, int]] = {}
        self.strangers: dict[str, set[Id]] = {}

    def forget(self, name: Id) -> None:
        """Forget a landmark."""
        self.trial.pop(name, None)
        self.misfits.pop(name, None)
        for names in self.strangers.values():
            names.discard(name)

    def judge(self, robot: str, fitting: Collection[Id], others: Collection[Id]) -> bool:
        """Take sightings that fit and such that do not; return whether it is the robot that is elsewhere."""
        for name in fitting:
            self.misfits.pop(name, None)
            if name in self.trial:
                self.trial[name] += 1
                if self.trial[name] >= TRUSTED:
                    del self.trial[name]
        if fitting:
            self.misfits = {name: (out, fit + len(fitting)) for name, (out, fit) in self.misfits.items()}
            self.strangers.pop(robot, None)
        for name in others:
            out, fit = self.misfits.get(name, (0, 0))
            self.misfits[name] = out + 1, fit
        strangers = self.strangers.setdefault(robot, set())
        strangers.update(others if not fitting else ())
        if len(strangers) < 2:
            return False
        for name in [*strangers, *others]:
            self.misfits.pop(name, None)
        strangers.clear()
        return True

    def wrong(self) -> list[Id]:
        """Return the landmarks that stand elsewhere."""
        return [name for name, (out, fit) in self.misfits.items() if out >= MISFITS and fit >= MISFITS]
