"""The parts common to laser detectors: the raw scan, the detections, and the service of a mount."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.declare import Limit, NotNegative, Within, declared
from kalmark.errors import EventError
from kalmark.events import Scan, label_of_event

TURN = 2.01 * math.pi
Acute = Annotated[float, Within(gt=0, lt=90)]
RAW = ("range_m", "bearing_rad", "intensity")


@dataclass(frozen=True, eq=False)
class Detections:
    """Detections in one scan: K measurements `y` (K, m) named by `columns`, with covariances `cov` (K, p, p).

    p is m, but 2 for walls, whose ends have no error that counts.  `beams` (K, 2) are the first and the last beam of
    each, `attributes` what else is known of them, K of each.

    >>> a = np.linspace(-1.0, 1.0, 201)
    >>> found = km.detect.Reflectors().detect(np.full(201, 4.0), a, abs(a - 0.5) < 0.022)
    >>> len(found), found.columns, found.cov.shape
    (1, ('range_m', 'bearing_rad'), (1, 2, 2))
    """

    columns: tuple[str, ...]
    y: Array
    cov: Array
    beams: Index
    attributes: dict[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.y)

    def take(self, keep: Any) -> Detections:
        """Return some of the detections, chosen by a mask or by their indices."""
        rest = {name: values[keep] for name, values in self.attributes.items()}
        return Detections(self.columns, self.y[keep], self.cov[keep], self.beams[keep], rest)


@declared
class Laser:
    """A scanning laser: N ranges at increasing angles.

    Ranges below `range_min_m`, from `range_max_m` on, and not finite are no returns.  `sigma_range_m` is the noise of a
    range.  Neighbouring beams hit one surface unless their ranges differ by more than on a surface hit under
    `incidence_deg`, and `jump_m` more.  `sigma_position_m` and `sigma_bearing_rad` are added to the noise of a
    detection: the distance of the real object from the fitted one, and the rotation of the whole scan by the robot's
    motion during it or by a late time stamp.  With `signature` the third component of a detection is kept.
    """

    columns: ClassVar[tuple[str, ...]] = ("range_m", "bearing_rad")  # of what is found
    given: ClassVar[int] = 2  # numbers of it that the filter gets; with a signature one more

    sigma_range_m: Annotated[float, Within(ge=1e-6), "Noise of the range of one beam."] = 0.03
    sigma_position_m: Annotated[
        NotNegative, "Added to what is found: how far the real thing is from what it is taken for, in every direction."
    ] = 0.0
    sigma_bearing_rad: Annotated[
        NotNegative,
        "Added to what is found: how far a whole scan is turned, by the motion during it or a late time stamp.",
    ] = 0.0
    range_min_m: Annotated[NotNegative, "A smaller range is no return."] = 0.05
    range_max_m: Annotated[Limit, "A range from here on is no return."] = math.inf
    incidence_deg: Annotated[
        Acute, "Neighbouring beams are on one surface if it can be hit under this angle at least."
    ] = 12.0
    jump_m: Annotated[NotNegative, "Largest further difference of their ranges."] = 0.15
    signature: Annotated[
        bool | None,
        "Give the third number of what is found to the filter; if absent, where the sensor has a signature.",
    ] = None

    def detect(self, ranges: Any, angles: Any, intensities: Any = None) -> Detections:
        """Return what is found among beams of these ranges (N,) m at these angles (N,) rad.  Raises EventError."""
        r, a, i = _beams(ranges, angles, intensities)
        returned = (self.range_min_m <= r) & (r < self.range_max_m)
        return self._widened(self._find(np.where(returned, r, np.inf), a, i))

    def warm_up(self) -> None:
        """Compile what `detect` needs: look for a post before the corner of a room."""
        a = np.linspace(-1.5, 1.5, 361)
        walls = np.minimum(4.0 / np.cos(a), 3.0 / np.maximum(np.sin(a), 1e-3))
        post = np.where(np.abs(a) < 0.06, 2.0 - np.sqrt(0.15**2 - (2.0 * a).clip(-0.15, 0.15) ** 2), np.inf)
        scale = min(1.0, self.range_max_m / 10.0)
        self.detect(scale * np.minimum(walls, post), a, np.ones(len(a)))

    def __call__(self, scan: Scan) -> Scan:
        """Return the scan of what is found in a raw one, whose y (N, 2 or 3) has beams: range, bearing[, intensity].

        Beams without a return may be left out; in one or two there is nothing to be found.
        """
        if not len(scan.y):
            return scan
        if scan.y.shape[1] not in (2, 3):
            raise EventError(
                f"{label_of_event(scan)}: y has {scan.y.shape[1]} columns, expected beams: {', '.join(RAW)}"
            )
        if len(scan.y) < 3:
            return Scan(t_ns=scan.t_ns, robot=scan.robot, sensor=scan.sensor)
        try:
            found = self.detect(*scan.y.T)
        except EventError as error:
            raise EventError(f"{label_of_event(scan)}: {error}") from None
        size = max(self.given, 3 if self.signature else 0)
        y, cov = found.y[:, :size], found.cov[:, :size, :size]
        return replace(scan, y=y, ids=None, cov=cov if len(y) else None)

    def _find(self, r: Array, a: Array, intensities: Array | None) -> Detections:
        raise NotImplementedError

    def _widened(self, found: Detections) -> Detections:
        """Return detections (range, bearing, ...) with the noise that is not in the beams."""
        cov, d = found.cov.copy(), np.maximum(found.y[:, 0], 1e-3)
        cov[:, 0, 0] += self.sigma_position_m**2
        cov[:, 1, 1] += (self.sigma_position_m / d) ** 2 + self.sigma_bearing_rad**2
        return replace(found, cov=cov)

    def pieces(self, r: Array, a: Array) -> tuple[Index, float]:
        """Return the first and last beam (S, 2) of each piece of surface, and the least step between beams, rad.

        There is none where beams are so far apart that no surface hit under `incidence_deg` joins neighbours.
        """
        step = float(np.diff(a).min())
        least = math.radians(self.incidence_deg)
        if step >= least:  # neighbours that no surface joins
            return np.empty((0, 2), np.int64), step
        return segments(r, a, step, least, self.jump_m), step


@compiled
def segments(r: Array, a: Array, step: float, slope: float, jump_m: float) -> Index:
    """Return the first and last beam (S, 2) of each piece of surface in a scan of ranges r (N,) at angles a (N,).

    Ranges that are not finite are no returns.  Neighbours, at most 1.5 steps apart, belong together unless their ranges
    differ by more than on a surface that is hit under an angle of at least `slope`:
    r sin(step) / sin(slope - step) + jump_m.  Borges and Aldon 2004.
    """
    n, count = len(r), 0
    out = np.empty((n, 2), np.int64)
    rate = math.sin(step) / math.sin(slope - step)
    for i in range(n):
        if not math.isfinite(r[i]):
            continue
        joined = count > 0 and out[count - 1, 1] == i - 1 and a[i] - a[i - 1] <= 1.5 * step
        if joined and abs(r[i] - r[i - 1]) <= min(r[i], r[i - 1]) * rate + jump_m:
            out[count - 1, 1] = i
        else:
            out[count, 0] = out[count, 1] = i
            count += 1
    return out[:count].copy()


def _beams(ranges: Any, angles: Any, intensities: Any) -> tuple[Array, Array, Array | None]:
    """Return the beams as arrays of one length, no returns as infinite ranges; of one turn of the laser at most."""
    given = {"ranges": ranges, "angles": angles} | ({} if intensities is None else {"intensities": intensities})
    arrays = {name: np.ascontiguousarray(value, dtype=np.float64) for name, value in given.items()}
    r, a = arrays["ranges"], arrays["angles"]
    for name, values in arrays.items():
        if values.ndim != 1 or values.shape != r.shape or len(r) < 3:
            raise EventError(f"{name} has shape {values.shape}, expected the beams of one scan, at least 3")
    if not (np.isfinite(a).all() and (np.diff(a) > 0).all()):
        first = int(np.argmin(np.diff(a) > 0)) + 1
        raise EventError(f"angle {first} is {a[first]} after {a[first - 1]} rad, expected increasing angles")
    if a[-1] - a[0] > TURN:
        raise EventError(f"the angles go from {a[0]:.6g} to {a[-1]:.6g} rad, expected one turn, 2 pi, at most")
    if (r < 0).any():
        first = int(np.argmax(r < 0))
        raise EventError(f"range {first} is {r[first]} m, expected at least 0")
    return r, a, arrays.get("intensities")
