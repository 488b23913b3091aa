"""How a map keeps itself clean: when a sighting becomes a landmark, when a landmark goes, when two are one."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kalmark.errors import ModelError


@dataclass(frozen=True)
class Upkeep:
    """What makes a landmark one, and what makes it go.

    An observation without an id that belongs to no landmark starts a *tentative* one, which becomes a landmark when it
    was seen `confirm` times within `within` scans in which it was in the sensor's view, and is dropped when that cannot
    be any more.  With `confirm` 1 it is one at once.  Its sightings are kept with the last `keep_poses` poses they were
    made from, and fused when it is confirmed (`kept.py`); with 0, the first and the confirming one alone count.

    With `merge`, two landmarks that turn out to be one are merged (`merging.py`) when that is `odds` times
    likelier than that they stand there by chance.  With `hold_back`, so must be what an observation is paired with
    (`ambiguity.py`); what is held back by that is mapped anew until then, as is what a robot that is lost sees.

    With `p_detect`, the probability that the sensor sees a landmark in its view, one that should be seen and is not is
    removed when it is `odds` times likelier that it is gone (`existence.py`); `p_false` is the probability that
    something else is taken for a landmark that is gone.
    """

    confirm: int = 3
    within: int = 10
    merge: bool = True
    hold_back: bool = False
    odds: float = 100.0
    p_detect: float | None = None
    p_false: float = 0.05
    keep_poses: int = 0

    def __post_init__(self) -> None:
        for name in ("confirm", "within"):
            value = getattr(self, name)
            if type(value) is not int or value < 1:
                raise ModelError(f"Upkeep: {name} is {value!r}, expected a whole number of at least 1")
        if type(self.keep_poses) is not int or self.keep_poses < 0:
            raise ModelError(f"Upkeep: keep_poses is {self.keep_poses!r}, expected a whole number of at least 0")
        if self.within < self.confirm:
            raise ModelError(f"Upkeep: within is {self.within}, expected at least confirm, {self.confirm}")
        if not 1 <= self.odds < math.inf:
            raise ModelError(f"Upkeep: odds is {self.odds!r}, expected a finite number of at least 1")

        if not 0 < self.p_false < 1:
            raise ModelError(f"Upkeep: p_false is {self.p_false!r}, expected a probability between 0 and 1")
        if self.p_detect is not None and not self.p_false < self.p_detect < 1:
            wanted = f"a probability between p_false, {self.p_false}, and 1"
            raise ModelError(f"Upkeep: p_detect is {self.p_detect!r}, expected {wanted}")

    def confirms(self, hits: int) -> bool:
        """Return whether a tentative landmark seen so often is one."""
        return hits >= self.confirm

    def hopeless(self, hits: int, chances: int) -> bool:
        """Return whether a tentative landmark seen in `hits` of `chances` scans cannot become one any more."""
        return hits + max(self.within - chances, 0) < self.confirm


CAREFUL = Upkeep()
