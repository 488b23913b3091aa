"""Tree trunks, posts, pillars: whatever is round and stands alone."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from kalmark.declare import Count, Limit, NotNegative, Positive, register
from kalmark.detect.circles import circles
from kalmark.detect.scan import Array, Detections, Laser

LINEAR = 0.75  # of a step: beams are taken to be so wide at least, for an edge is straight only from there on


@register("detector", "trunks")
class Trunks(Laser):
    """Tree trunks and posts: range, bearing and radius of circles that stand alone.

    The radius, m, is the signature.  One is seen by `beams` at least, with nothing before its edges; its radius lies
    between `radius_min_m` and `radius_max_m`, and its beams within `roughness_m` of the circle, RMS.  `beam_width_rad`
    is the divergence of a beam, full angle: where it grazes an edge it is reflected from anywhere across it.
    `sigma_position_m` is added to the radius too.
    """

    columns: ClassVar[tuple[str, ...]] = ("range_m", "bearing_rad", "radius_m")

    beams: Annotated[Count, "Beams on a trunk, at least."] = 2
    radius_min_m: Annotated[NotNegative, "Smallest radius."] = 0.0
    radius_max_m: Annotated[Limit, "Largest radius."] = 1.0
    roughness_m: Annotated[Positive, "Beams lie so far off the circle at most, RMS."] = 0.1
    beam_width_rad: Annotated[
        NotNegative, "Divergence of a beam, full angle; three quarters of the step between beams at least are taken."
    ] = 0.0

    def _find(self, r: Array, a: Array, intensities: Array | None) -> Detections:
        pieces, step = self.pieces(r, a)
        width = max(self.beam_width_rad, LINEAR * step)
        y, P, chi2, beams = circles(r, a, pieces, step, self.sigma_range_m**2, width**2 / 12, max(self.beams, 1))
        rms = np.sqrt(chi2 / (beams[:, 1] - beams[:, 0] + 1)) * self.sigma_range_m
        round_ = (rms <= self.roughness_m) & (self.radius_min_m <= y[:, 2]) & (y[:, 2] <= self.radius_max_m)
        return Detections(self.columns, y, P, beams, {"radius_m": y[:, 2], "rms_m": rms}).take(round_)

    def _widened(self, found: Detections) -> Detections:
        """Return the circles with the noise that is not in the beams, that of the radius included."""
        found = super()._widened(found)
        found.cov[:, 2, 2] += self.sigma_position_m**2
        return found
