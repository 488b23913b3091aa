"""All sensors: those of the plane (`sensors2d`) and those of space (`sensors3d`)."""

from kalmark.models import sensors2d, sensors3d
from kalmark.models.sensors2d import Bearing, Position2D, Range, RangeBearing, RangeBearingSignature
from kalmark.models.sensors3d import (
    Omnidirectional,
    PinHole,
    Position3D,
    RangeBearing3D,
    Segments,
    Stereo,
    TagCorners,
    TagPose,
)

__all__ = [
    "Bearing", "Omnidirectional", "PinHole", "Position2D", "Position3D", "Range", "RangeBearing", "RangeBearing3D",
    "RangeBearingSignature", "Segments", "Stereo", "TagCorners", "TagPose",
]  # fmt: skip

BUILT_IN = (*sensors2d.BUILT_IN, *sensors3d.BUILT_IN)
