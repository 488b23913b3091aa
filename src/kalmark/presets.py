"""Sensors of [S] Table 2 with noise, field of view, range and rate as documented: every number names its source.

    laser = km.presets.LASER
    km.Mount(laser.sensor); laser.rate_hz; laser.sources["range_max_m"]

A data sheet's accuracy is taken as one sigma.  Where a source gives a width and no noise (the lobe of a sonar), the
noise is that of a uniform distribution over it, the width by the square root of 12.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from kalmark.models.sensors2d import Bearing, RangeBearing

HOKUYO = "Hokuyo, Communication Protocol Specification for SCIP2.0, C-42-03320B"
WOODS = "T. Barfoot, Lost in the Woods, dataset2.mat: {} (published variance of a laser's sightings of cylinders)"
FAQ = "Devantech, Ultrasonic Rangers FAQ, robot-electronics.co.uk/htm/sonar_faq.htm"
SRF08 = "Devantech SRF08, technical specifications: range 3 cm to 6 m, robot-italy.com"
D435 = "Intel, High-speed capture mode of the RealSense depth camera D435, rev. 1.2"
KINECT = "Khoshelham and Elberink, Accuracy and Resolution of Kinect Depth Data, Sensors 12(2), 2012, mdpi.com"
FOV = "Kinect's hardware as quoted in a test of it, th4.ilovetranslation.com/boU9rIiFDGL=d: 57 deg horizontally, 640 px"
PIXEL = "one pixel, the noise of the SLAM toolbox's cameras [TB]"


@dataclass(frozen=True)
class Preset:
    """A sensor as documented: `sensor`, its rate, and the source of each number that is not a default."""

    sensor: Any
    rate_hz: float
    sources: Mapping[str, str]


LASER = Preset(
    RangeBearing(
        sigma_range_m=math.sqrt(9.0036e-4),
        sigma_bearing_rad=math.sqrt(6.7143e-4),
        range_min_m=0.02,
        range_max_m=5.6,
        fov_rad=math.radians(239.77),
    ),
    rate_hz=10.0,
    sources={
        "sigma_range_m": WOODS.format("r_var = 9.0036e-4"),
        "sigma_bearing_rad": WOODS.format("b_var = 6.7143e-4"),
        "range_min_m": f"{HOKUYO}, 8.12: DMIN 20 mm of the URG-04LX",
        "range_max_m": f"{HOKUYO}, 8.12: DMAX 5600 mm of the URG-04LX",
        "fov_rad": f"{HOKUYO}, Table 2: detection range 239.77 deg of the URG-04LX",
        "rate_hz": f"{HOKUYO}, 8.12: SCAN 600 rpm of the URG-04LX",
    },
)
"""A small laser range finder: range and bearing."""

SONAR = Preset(
    RangeBearing(
        sigma_range_m=0.04,
        sigma_bearing_rad=math.radians(55.0) / math.sqrt(12.0),
        range_min_m=0.03,
        range_max_m=6.0,
        fov_rad=math.radians(55.0),
    ),
    rate_hz=346.0 / (2 * 6.0),
    sources={
        "sigma_range_m": f"{FAQ}: 'We quote 3-4cm'",
        "sigma_bearing_rad": f"{FAQ}: lobe of the SRF08 55 deg at -6 dB; the echo may come from anywhere in it",
        "range_min_m": SRF08,
        "range_max_m": SRF08,
        "fov_rad": f"{FAQ}: lobe of the SRF08 55 deg at -6 dB",
        "rate_hz": f"{FAQ}: speed of sound 346 m/s, there and back over the 6 m of {SRF08}; the least it can wait",
    },
)
"""An ultrasonic ranger: good ranges, poor bearings."""

CAMERA = Preset(
    Bearing(sigma_bearing_rad=math.tan(math.radians(45.0)) / 424.0, fov_rad=math.radians(90.0)),
    rate_hz=90.0,
    sources={
        "sigma_bearing_rad": f"{PIXEL}, of 848 over 90 deg ({D435}): focal length 424 px",
        "fov_rad": f"{D435}: about 90 x 58 deg",
        "rate_hz": f"{D435}: 90 fps at 848 x 480",
    },
)
"""A camera, used in the plane: bearings alone."""

RGBD = Preset(
    RangeBearing(
        sigma_range_m=0.04,
        sigma_bearing_rad=2 * math.tan(math.radians(57.0 / 2)) / 640.0,
        fov_rad=math.radians(57.0),
    ),
    rate_hz=30.0,
    sources={
        "sigma_range_m": f"{KINECT}: a few millimetres up to about 4 cm at the maximum range; the most is taken",
        "sigma_bearing_rad": f"{PIXEL}, of 640 over 57 deg ({FOV})",
        "fov_rad": FOV,
        "rate_hz": f"{KINECT}: up to 30 fps",
    },
)
"""A depth camera (Kinect), used in the plane: range and bearing.  The source does not give its maximum range."""

ALL = {"laser": LASER, "sonar": SONAR, "camera": CAMERA, "rgbd": RGBD}
