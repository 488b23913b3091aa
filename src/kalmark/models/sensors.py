"""All sensors: those of the plane (`sensors2d`), those of space (`sensors3d`) and cameras (`sensors_camera`)."""

from kalmark.models import sensors2d, sensors3d, sensors_camera
from kalmark.models.sensors2d import Bearing, Position2D, Range, RangeBearing, RangeBearingSignature
from kalmark.models.sensors3d import Position3D, RangeBearing3D, TagPose
from kalmark.models.sensors_camera import Omnidirectional, PinHole, Segments, Stereo, TagCorners

__all__ = [
    "Bearing", "Omnidirectional", "PinHole", "Position2D", "Position3D", "Range", "RangeBearing", "RangeBearing3D",
    "RangeBearingSignature", "Segments", "Stereo", "TagCorners", "TagPose",
]  # fmt: skip

BUILT_IN = (*sensors2d.BUILT_IN, *sensors3d.BUILT_IN, *sensors_camera.BUILT_IN)
