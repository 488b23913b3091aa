"""Landmarks in images, searched where the filter expects them."""

from kalmark.vision.apriltags import Tags
from kalmark.vision.camera_images import CameraImages
from kalmark.vision.front_end import ActiveSearch
from kalmark.vision.overlay import overlay
from kalmark.vision.segments import LineSearch
from kalmark.vision.straight import Straightened

__all__ = ["ActiveSearch", "CameraImages", "LineSearch", "Straightened", "Tags", "overlay"]
