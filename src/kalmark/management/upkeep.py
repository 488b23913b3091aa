"""Upkeep of a map: when an observation becomes a landmark, when a landmark is removed, when two are one."""

from __future__ import annotations

from typing import Annotated, Literal

from kalmark.declare import Count, Probability, Within, refuse, register


@register("upkeep", "upkeep")
class Upkeep:
    """Confirmation of landmarks from observations without an id: docs/association.md.

    An observation without an id that belongs to no landmark starts a *tentative* one, which becomes a landmark when it
    was seen `confirm` times within `within` scans in which it was in the sensor's view, and is dropped when that cannot
    be any more.  With `confirm` 1 it is one at once.  Its observations are kept with the last `keep_poses` poses they
    were made from, and fused when it is confirmed (`confirm.py`); with 0, the first and the confirming one alone count.

    With `merge`, two landmarks that turn out to be one are merged (`merge.py`) when that is `odds` times
    likelier than that they stand there by chance.  With `hold_back`, so must be what an observation is paired with
    (`association/ratio.py`); what is held back by that is mapped again until then, as are observations of a robot that
    is lost.

    With `repeats` two parts of the map that agree under a shift and a turn, though never observed together, are
    searched while it grows (`repeated_places.py`): "warn" puts them into the report.  "merge" states that no two places
    have the same shape: those that the covariance of the map lets be one are merged, and a robot that maps a place
    again is placed by its shape, though no landmark is missed (`elsewhere.py`).

    A landmark without an id that should be seen and is not is marked, with `gone` "remove" removed, when it is `odds`
    times likelier that nothing is there (`existence.py`).  The detection probability of the sensor
    is estimated from the log.  Where it is stated, `p_detect`, each scan counts, with ids too, and what is gone is
    removed.  `p_false` is the probability that something else is taken for a landmark that is gone.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover, association=km.association.Automatic(), upkeep=km.Upkeep(confirm=2))
    >>> for t_s in (0.0, 0.1):
    ...     report = slam.process(km.Scan(t_s, "rover", "lidar", [[4.0, 0.3]]))
    ...     print([one.outcome for one in report.observations], len(slam.landmarks()))
    ['tentative'] 0
    ['new'] 1
    """

    confirm: Annotated[
        Count, "A tentative landmark becomes one when it was seen so often; 1: at its first observation."
    ] = 3
    within: Annotated[Count, "It is dropped if that did not happen in so many scans in which it was in view."] = 10
    merge: Annotated[bool, "Merge landmarks that turn out to be one."] = True
    repeats: Annotated[
        Literal["off", "warn", "merge"],
        "Search the map for parts that agree under a shift and a turn while it grows: report them, or, as no places "
        "are alike, merge them and place a robot by what it maps again.",
    ] = "off"
    hold_back: Annotated[
        bool,
        "Defer observations below the odds (`nearest`, `global`, `jcbb`) or of a lost robot (`auto`); map them again.",
    ] = False
    odds: Annotated[float, Within(ge=1), "Odds against chance at which a hypothesis is accepted."] = 100.0
    gone: Annotated[Literal["mark", "remove"], "Treatment of landmarks that are no longer observed."] = "mark"
    p_detect: Annotated[
        float | None,
        Within(gt=0, lt=1),
        "Detection probability in view (absent: as in the log); if given, landmarks that are no longer observed go.",
    ] = None
    p_false: Annotated[Probability, "Probability that something else is taken for a landmark that is gone."] = 0.05
    keep_poses: Annotated[
        int,
        Within(ge=0),
        "Its observations are kept with so many past poses, and fused when it is one; 0: they are not used.",
    ] = 0

    def __post_init__(self) -> None:
        if self.within < self.confirm:
            raise refuse(self, "within", f"at least confirm, {self.confirm}")
        if self.p_detect is not None and self.p_detect <= self.p_false:
            raise refuse(self, "p_detect", f"a probability between p_false, {self.p_false}, and 1")

    @property
    def removes(self) -> bool:
        """True if landmarks that are not seen again are removed."""
        return self.gone == "remove" or self.p_detect is not None

    def confirms(self, hits: int) -> bool:
        """Return whether a tentative landmark seen so often is one."""
        return hits >= self.confirm

    def deletes(self, hits: int, chances: int) -> bool:
        """Return whether a tentative landmark seen in `hits` of `chances` scans cannot become one any more."""
        return hits + max(self.within - chances, 0) < self.confirm


CAREFUL = Upkeep()
