"""Reflectors: marks that send back more light than anything else, by the intensities of the beams."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from kalmark.arrays import Array
from kalmark.declare import Limit, NotNegative, register
from kalmark.detect.laser_scan import Detections, Laser
from kalmark.errors import EventError


@register("detector", "reflectors")
class Reflectors(Laser):
    """Reflectors, by the intensity of the beams: range and bearing of their centres.

    They are cylinders of a radius that is known, `radius_m` (0: flat and small).  One is a run of beams whose intensity
    is at least `intensity_min`, on one surface.  Its radius is too large if it is wider than `width_max_m`.  The
    bearing lies anywhere where the outermost beams still hit and the next ones do not: its variance is that of the
    interval.

    >>> a = np.linspace(-1.0, 1.0, 201)
    >>> km.detect.Reflectors().detect(np.full(201, 4.0), a, abs(a - 0.5) < 0.022).y.round(2)
    array([[4. , 0.5]])
    """

    intensity_min: Annotated[NotNegative, "A beam from a reflector is as bright as this at least."] = 1.0
    radius_m: Annotated[NotNegative, "Radius of the cylinders; 0: small and flat."] = 0.0
    width_max_m: Annotated[Limit, "Largest width of a reflector."] = 0.5

    def _find(self, r: Array, a: Array, intensities: Array | None) -> Detections:
        if intensities is None:
            raise EventError("the beams have no intensities, expected those by which a reflector is recognised")
        bright = np.where(intensities >= self.intensity_min, r, np.inf)
        beams, step = self.pieces(bright, a)
        counts = beams[:, 1] - beams[:, 0] + 1
        owner = np.repeat(np.arange(len(beams)), counts)
        index = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts) + beams[owner, 0]
        near = np.bincount(owner, r[index], len(beams)) / counts
        half = np.arcsin(np.clip(self.radius_m / np.maximum(near + self.radius_m, 1e-9), 0.0, 1.0))
        first, last = a[beams[:, 0]], a[beams[:, 1]]
        low, high = np.maximum(first - step + half, last - half), np.minimum(first + half, last + step - half)
        low, high = np.where(low < high, low, last - step / 2), np.where(low < high, high, first + step / 2)
        bearing = (first + last) / 2 if self.radius_m == 0 else (low + high) / 2
        variance = np.full(len(beams), step**2 / 24) if self.radius_m == 0 else (high - low) ** 2 / 12
        off = (near + self.radius_m)[owner] * np.sin(a[index] - bearing[owner])
        depth = np.sqrt(np.maximum(self.radius_m**2 - off**2, 0.0))
        y = np.column_stack([np.bincount(owner, r[index] + depth, len(beams)) / counts, bearing])
        cov = np.zeros((len(beams), 2, 2))
        cov[:, 0, 0], cov[:, 1, 1] = self.sigma_range_m**2 / counts, variance
        light = np.bincount(owner, intensities[index], len(beams)) / counts
        width = y[:, 0] * (last - first)
        found = Detections(self.columns, y, cov, beams, {"intensity": light, "width_m": width})
        return found.take(width <= self.width_max_m)
