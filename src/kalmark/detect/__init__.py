"""From raw data to measurements of landmarks: what a laser's beams and a camera's image show, with covariances.

found = km.detect.Trunks(range_max_m=80.0).detect(ranges, angles)      # found.y, found.cov, found.attributes
km.Mount(km.sensors.RangeBearing(), detector=km.detect.Trunks(range_max_m=80.0))
"""

from kalmark.detect.apriltags import Tags
from kalmark.detect.corners import Corners, Walls
from kalmark.detect.draw import draw_scan
from kalmark.detect.laser_scan import Detections
from kalmark.detect.reflectors import Reflectors
from kalmark.detect.trunks import Trunks

__all__ = ["Corners", "Detections", "Reflectors", "Tags", "Trunks", "Walls", "draw_scan"]
