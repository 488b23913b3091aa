"""Some landmarks that one scan may show, asked about jointly: an excerpt of the map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kalmark.association.index import Excerpt
from kalmark.association.matchings import Places
from kalmark.association.posterior import room
from kalmark.events import Id
from kalmark.filter import corrections, kernels
from kalmark.filter.map import P_AT

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam
    from kalmark.tracks.scene import View

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

LIMITS = 30, 1e-2  # linearisations of a matching, and the sigmas by which the last one moves anything


class Landmarks:
    """Landmarks of one kind, whose places a sensor tells; `read` is an excerpt of the map that has them."""

    def __init__(self, slam: Slam, view: View, event: Any, names: list[Id], R: Array, read: Excerpt | None) -> None:
        self._slam, self._view, self._event, self._R = slam, view, event, R
        self._look = view.looks[slam.members.sorts[names[0]]]
        self._slots = slam.members.slots_of(names)
        self._robot = slam.members.slots[event.robot]
        self._here = slam.map.excerpt(self._robot, view.mount, self._slots) if read is None else read

    def places(self) -> Places:
        """Return where all observations seem to be from the sensor (K, n), where the landmarks are, and covariances."""
        v, V_y = self._view.sensor.invert(self._event.y)  # type: ignore[attr-defined]
        m, _, _, here = self._here
        n = 2 if len(self._view.at) == 3 else 3
        V = V_y[:, :n] @ self._R @ V_y[:, :n].swapaxes(1, 2)
        rows = (m.blocks[here, P_AT][:, None] + np.arange(n)).ravel()
        return np.ascontiguousarray(v[:, :n]), V, m.means(here, n), kernels.submatrix(m.P, rows)

    def fit(self, rows: Index, columns: Index) -> tuple[float, float]:
        """Return d2 and log |Z| of pairs of an observation and a landmark, all at once."""
        m, robot, mount, here = self._here
        look, y = self._look, self._event.y[rows]
        R = self._view.noise(self._slam.map, self._robot, look, self._slots[columns], self._R[rows], self._event)
        run = corrections.compiled_fit if isinstance(look.view, tuple) else corrections.fit
        scan = robot, mount, here[columns], look.d, y, np.ascontiguousarray(R), np.inf
        d2, log_det = run(look.view, (m.x, m.P, m.n, m.blocks, m.atoms, m.axes), scan, LIMITS)
        return float(d2), float(log_det)

    def room(self, rows: Index, columns: Index) -> Array:
        """Return log |Z| / |R| of each pair: how much less is known of where it is seen than a sensor tells."""
        if not len(rows):
            return np.zeros(0)
        (m, robot, mount, here), y = self._here, self._event.y[rows]
        R = self._view.noise(self._slam.map, self._robot, self._look, self._slots[columns], self._R[rows], self._event)
        Z, _ = self._look.predict(m, robot, mount, here[columns], y, R)
        return room(Z, R)
