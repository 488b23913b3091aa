"""Configuration of detectors: the fields of `kalmark.detect`, by the same names."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from kalmark.config.sections import Limit, NotNegative, Positive, Section, type_or

Beams = Annotated[int, Field(ge=1)]
Acute = Annotated[float, Field(gt=0, lt=90)]


class _Laser(Section):
    sigma_range_m: Positive = 0.03
    """Noise of the range of one beam."""
    sigma_position_m: NotNegative = 0.0
    """Added to what is found: how far the real thing is from what it is taken for, in every direction."""
    sigma_bearing_rad: NotNegative = 0.0
    """Added to what is found: how far a whole scan is turned, by the motion during it or a late time stamp."""
    range_min_m: NotNegative = 0.05
    """A smaller range is no return."""
    range_max_m: Limit = math.inf
    """A range from here on is no return."""
    incidence_deg: Acute = 12.0
    """Neighbouring beams are on one surface if it can be hit under this angle at least."""
    jump_m: NotNegative = 0.15
    """How much more their ranges may differ."""
    signature: bool | None = None
    """Give the third number of what is found to the filter; if absent, where the sensor has a signature."""


class TrunksDetector(_Laser):
    """Tree trunks and posts: range, bearing and radius of circles that stand alone."""

    type: Literal["trunks"] = "trunks"
    beams: Beams = 2
    """Beams on a trunk, at least."""
    radius_min_m: NotNegative = 0.0
    """Smallest radius."""
    radius_max_m: Positive = 1.0
    """Largest radius."""
    roughness_m: Positive = 0.1
    """Beams lie so far off the circle at most, RMS."""
    beam_width_rad: NotNegative = 0.0
    """Divergence of a beam, full angle; three quarters of the step between beams at least are taken."""


class ReflectorsDetector(_Laser):
    """Reflectors, by the intensity of the beams: range and bearing of their centres."""

    type: Literal["reflectors"] = "reflectors"
    intensity_min: NotNegative = 1.0
    """A beam from a reflector is as bright as this at least."""
    radius_m: NotNegative = 0.0
    """Radius of the cylinders; 0: small and flat."""
    width_max_m: Positive = 0.5
    """What is wider is no reflector."""


class CornersDetector(_Laser):
    """Corners of walls: range, bearing and opening angle."""

    type: Literal["corners"] = "corners"
    split_m: Positive = 0.2
    """A wall is straight to this."""
    beams: Beams = 8
    """Beams on a wall, at least."""
    length_m: NotNegative = 0.5
    """Length of a wall, at least."""
    gap_m: NotNegative = 0.3
    """How far from the corner the ends of its walls may be."""
    bend_deg: Acute = 30.0
    """Angle between the walls, at least."""


Detector = Annotated[
    Annotated[TrunksDetector, Tag("trunks")]
    | Annotated[ReflectorsDetector, Tag("reflectors")]
    | Annotated[CornersDetector, Tag("corners")],
    Discriminator(type_or()),
]
