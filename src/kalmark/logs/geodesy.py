"""Latitude and longitude as metres east, north and up of an origin: the local tangent plane of WGS 84.

The closed form through earth-centred coordinates is exact (Hofmann-Wellenhof, Lichtenegger, Wasle, GNSS, 2008, 8.2):

    N = a / sqrt(1 - e^2 sin^2 lat)
    X = ((N + h) cos lat cos lon, (N + h) cos lat sin lon, ((1 - e^2) N + h) sin lat)
    (east, north, up) = R(origin) (X - X(origin))

A library for map projections would compute these three lines, too; it is needed for other datums and geoids, and
receivers give neither.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import short_text

A_M = 6378137.0
FLATTENING = 1 / 298.257223563
E2 = FLATTENING * (2 - FLATTENING)


def earth_centred(lla: Any) -> Array:
    """Return positions (..., 3) = latitude and longitude (deg), height (m) as X, Y, Z (m), earth-centred."""
    lla = np.asarray(lla, dtype=np.float64)
    lat, lon, h = np.radians(lla[..., 0]), np.radians(lla[..., 1]), lla[..., 2]
    n = A_M / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    across = (n + h) * np.cos(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), ((1 - E2) * n + h) * np.sin(lat)], axis=-1)


def to_tangent_plane(lla: Any, origin: Any) -> Array:
    """Return positions (..., 3) = latitude, longitude (deg), height (m) as east, north, up (m) of an origin (3,)."""
    origin = np.asarray(origin, dtype=np.float64)
    lat, lon = np.radians(origin[:2])
    s, c, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    R = np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
    enu: Array = (earth_centred(lla) - earth_centred(origin)) @ R.T
    return enu


def fault(lla: Any) -> str:
    """Return the fault of a latitude and longitude (deg), "" without one."""
    lat, lon = lla[0], lla[1]
    if np.isfinite([lat, lon]).all() and abs(lat) <= 90 and abs(lon) <= 360:
        return ""
    return f"latitude and longitude are {[float(lat), float(lon)]}, expected degrees, of at most 90 and 360"


def origin_of(given: Any, what: str) -> Array | None:
    """Return the origin (3,) that a user gave, None for none.  Raises LogError."""
    if given is None:
        return None
    try:
        lla = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        lla = np.zeros(0)
    if lla.shape not in ((2,), (3,)) or not np.isfinite(lla).all() or fault(lla):
        raise LogError(f"{what} is {short_text(given)}, expected [latitude_deg, longitude_deg, height_m]")
    return np.append(lla, np.zeros(3 - len(lla)))


@dataclass
class Globe:
    """Origin of the tangent plane on the Earth: `origin` (3,), latitude, longitude (deg) and height (m).

    None until it is known: then it is the first position that is asked for.
    """

    origin: Array | None = None

    def local(self, lla: Any) -> Array:
        """Return a position (2 or 3,) on the globe as east, north, up (3,) m; without a height, at the origin's."""
        lla = np.array(lla, dtype=np.float64)
        if self.origin is None:
            self.origin = np.append(lla, np.zeros(3 - len(lla)))
        return to_tangent_plane(np.append(lla, self.origin[len(lla) :]), self.origin)
