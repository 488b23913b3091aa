"""From raw data to measurements of landmarks: those in the beams of a laser.  Plug-ins add others, as `Tags`.

found = km.detect.Trunks(range_max_m=80.0).detect(ranges, angles)      # found.y, found.cov, found.attributes
km.Mount(km.sensors.RangeBearing(), detector=km.detect.Trunks(range_max_m=80.0))
"""

from functools import partial

from kalmark.detect.corners import Corners, Walls
from kalmark.detect.draw import draw_scan
from kalmark.detect.laser_scan import Detections
from kalmark.detect.reflectors import Reflectors
from kalmark.detect.trunks import Trunks
from kalmark.plugins import name_of_plugin, names_with_plugins

__all__ = ["Corners", "Detections", "Reflectors", "Trunks", "Walls", "draw_scan"]
__getattr__ = partial(name_of_plugin, __name__)
__dir__ = partial(names_with_plugins, __name__, __all__)
