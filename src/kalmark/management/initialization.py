"""How a sensor whose measurements do not tell where a landmark is starts one all the same.

`Delayed` is for bearings.  `Trilateration` keeps ranges until a position follows, `Hypotheses` starts several
directions at once; both work with ids alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from kalmark.errors import MapError, ModelError
from kalmark.events import Id, Scan
from kalmark.management.delayed import Delayed
from kalmark.management.hypotheses import Hypotheses, Ring
from kalmark.management.trilateration import Ranges, Trilateration
from kalmark.report import Observation

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam
    from kalmark.tracks.robot import Mount
    from kalmark.tracks.scene import View

__all__ = ["Delayed", "Hypotheses", "Initialization", "Trilateration"]

Array = npt.NDArray[np.float64]
Unlocated = Ranges | Ring  # what is known of a landmark that is not in the map yet


class Initialization(Protocol):
    """A way to start landmarks from measurements of which one alone does not tell enough."""

    def observe(self, slam: Slam, view: View, event: Scan, k: int, id_: Id | None, name: Any, R: Array) -> Observation:
        """Take the k-th observation of a scan, of a landmark that is not in the map; start it when it can be."""


@dataclass(frozen=True)
class Unable:
    """No way: such measurements only correct landmarks that another sensor has started, or that are known."""

    def observe(self, slam: Slam, view: View, event: Scan, k: int, id_: Id | None, name: Any, R: Array) -> Observation:
        """Leave it alone."""
        kind = type(view.sensor).__name__
        return Observation(k, id_, "ignored", None, None, f"a {kind} measurement alone cannot start a landmark")


@dataclass(frozen=True)
class Named:
    """A way for landmarks with an id; without one a single number says too little to tell which landmark it is of."""

    way: Trilateration | Hypotheses

    def observe(self, slam: Slam, view: View, event: Scan, k: int, id_: Id | None, name: Any, R: Array) -> Observation:
        """Take an observation that has an id."""
        if isinstance(name, int | str):
            try:
                return self.way.observe(slam, view, event, k, id_, name, R)
            except MapError as full:
                return Observation(k, id_, "ignored", None, None, str(full))
        kind = type(view.sensor).__name__
        return Observation(k, id_, "ignored", None, None, f"a {kind} measurement without an id cannot start a landmark")


def initialization_of(mount: Mount, starts: bool) -> Initialization | None:
    """Return how a mounted sensor starts landmarks, None if one measurement is enough for it."""
    ranging = tuple(mount.sensor.columns) == ("range_m",) and hasattr(mount.sensor, "distances")
    way = mount.initialization
    if isinstance(way, Trilateration | Hypotheses) and not ranging:
        what = f"{type(mount.sensor).__name__} does not measure ranges alone"
        raise ModelError(f"Mount: initialization is {way!r}, but its {what}")
    if ranging and not isinstance(way, Delayed):
        return Named(way or Trilateration())
    return None if starts else Unable()
