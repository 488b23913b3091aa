"""Sensors of [S] Table 2 and common devices, with noise, range, rate and dropouts: every number names its source.

    laser = km.presets.LASER
    km.Mount(laser.sensor); laser.rate_hz; laser.dropouts; laser.sources["range_max_m"]

A data sheet's accuracy is taken as one sigma.  Where a source gives a width and no noise (the lobe of a sonar), the
noise is that of a uniform distribution over it, the width by the square root of 12.  A number that follows from a
source by some steps is derived in docs/presets.md; one without a source is called an assumption there and in `sources`.
`dropouts` is the probability that something in view is not reported: worlds take it, and the rate, from a sensor's
`preset`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from statistics import NormalDist
from typing import Any

from kalmark.models.inertial import Inertial
from kalmark.models.sensors import Bearing, Gps2D, Gps3D, Gyro2D, Range, RangeBearing, Speed

__all__ = [
    "ALL", "ARVA", "CAMERA", "DEVICES", "INERTIAL_UNIT", "LASER", "LASER_SCANNER", "MEMS_IMU", "MOTIONS", "RFID",
    "RGBD", "RTK_RECEIVER", "SONAR", "TABLE_2", "WHEEL_ENCODER", "Preset",
]  # fmt: skip

HOKUYO = "Hokuyo, Communication Protocol Specification for SCIP2.0, C-42-03320B"
WOODS = "T. Barfoot, Lost in the Woods, dataset2.mat, a laser that detects cylinders"
FAQ = "Devantech, Ultrasonic Rangers FAQ, robot-electronics.co.uk/htm/sonar_faq.htm"
SRF08 = "Devantech SRF08, technical specifications: range 3 cm to 6 m, robot-italy.com"
D435 = "Intel, High-speed capture mode of the RealSense depth camera D435, rev. 1.2"
KINECT = "Khoshelham and Elberink, Accuracy and Resolution of Kinect Depth Data, Sensors 12(2), 2012, mdpi.com"
FOV = "Kinect's hardware as quoted in a test of it, th4.ilovetranslation.com/boU9rIiFDGL=d: 57 deg horizontally, 640 px"
PIXEL = "one pixel, the noise of the SLAM toolbox's cameras [TB]"
STARRY = "T. Barfoot, Starry Night, dataset3.mat"
RAGNI = "M. Ragni, Autonomous VTOL for avalanche buried searching, Trento 2014"
BEACON = f"EN 300 718 on avalanche beacons, quoted by {RAGNI}, ch. 1"
DIPOLE = f"magnetic dipole in the near field, B = mu m / (4 pi r^3) (2 cos, sin): {RAGNI}, 2.1"
BOUNCE = "readings of one pulse after the other, earnyourturns.com/25247, Digital beacon bounce"
BACKSCATTER = "Arnitz, Witrisal and Muehlmann, Multifrequency CW radar approach to ranging in passive UHF RFID, 2009"
ARRIVAL = "Angerer, Langwieser and Rupp, Direction of arrival estimation by phased arrays in RFID, 2010"
TAGS = "Haehnel, Burgard, Fox, Fishkin and Philipose, Mapping and localization with RFID technology, 2003"
MULTI_TAG = "Bolotnyy, Krize and Robins, The practicality of multi-tag RFID systems"


@dataclass(frozen=True)
class Preset:
    """A sensor, or an inertial unit as a motion, as documented: `sensor`, its rate, its dropouts.

    `sources` are those of each number that is not a default; `in_space` is the sensor of space where that has more.

    >>> laser = km.presets.LASER
    >>> laser.rate_hz, laser.sensor.sigma_range_m, sorted(laser.sources)[0]
    (10.0, 0.03000599940011997, 'dropouts')
    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"laser": km.Mount(laser.sensor)})
    """

    sensor: Any
    rate_hz: float
    dropouts: float
    sources: Mapping[str, str]
    in_space: Any = None


def _preset(sensor: Any, in_space: Any = None, /, **documented: tuple[float, str]) -> Preset:
    """Return a preset of a sensor's class by its parameters, rate and dropouts, each with its source."""
    numbers = {name: value for name, (value, _) in documented.items()}
    rate_hz, dropouts = numbers.pop("rate_hz"), numbers.pop("dropouts")
    plane = sensor(**{name: value for name, value in numbers.items() if name in {f.name for f in fields(sensor)}})
    sources = {name: source for name, (_, source) in documented.items()}
    return Preset(plane, rate_hz, dropouts, sources, in_space and in_space(**numbers))


LASER = _preset(
    RangeBearing,
    sigma_range_m=(math.sqrt(9.0036e-4), f"{WOODS}: published variance r_var = 9.0036e-4"),
    sigma_bearing_rad=(math.sqrt(6.7143e-4), f"{WOODS}: published variance b_var = 6.7143e-4"),
    range_min_m=(0.02, f"{HOKUYO}, 8.12: DMIN 20 mm of the URG-04LX"),
    range_max_m=(5.6, f"{HOKUYO}, 8.12: DMAX 5600 mm of the URG-04LX"),
    fov_rad=(math.radians(239.77), f"{HOKUYO}, Table 2: detection range 239.77 deg of the URG-04LX"),
    rate_hz=(10.0, f"{HOKUYO}, 8.12: SCAN 600 rpm of the URG-04LX"),
    dropouts=(0.41, f"{WOODS}: of those in view, by the true poses, 41 % were not seen"),
)
"""A small laser range finder: range and bearing."""

LOBE = f"{FAQ}: lobe of the SRF08 55 deg at -6 dB"
SPEED = f"{FAQ}: speed of sound 346 m/s, there and back over the 6 m of {SRF08}; the least it can wait"
SONAR = _preset(
    RangeBearing,
    sigma_range_m=(0.04, f"{FAQ}: 'We quote 3-4cm'"),
    sigma_bearing_rad=(math.radians(55.0) / math.sqrt(12.0), f"{LOBE}; the echo may come from anywhere in it"),
    range_min_m=(0.03, SRF08),
    range_max_m=(6.0, SRF08),
    fov_rad=(math.radians(55.0), LOBE),
    rate_hz=(346.0 / (2 * 6.0), SPEED),
    dropouts=(0.41, "assumption: as often as the laser"),
)
"""An ultrasonic ranger: good ranges, poor bearings."""

CAMERA = _preset(
    Bearing,
    sigma_bearing_rad=(
        math.tan(math.radians(45.0)) / 424.0,
        f"{PIXEL}, of 848 over 90 deg ({D435}): focal length 424 px",
    ),
    fov_rad=(math.radians(90.0), f"{D435}: about 90 x 58 deg"),
    rate_hz=(90.0, f"{D435}: 90 fps at 848 x 480"),
    dropouts=(0.17, f"{STARRY}: of the markers in the image, by the true poses, 17 % were not seen"),
)
"""A camera, used in the plane: bearings alone."""

RGBD = _preset(
    RangeBearing,
    sigma_range_m=(0.04, f"{KINECT}: a few millimetres up to about 4 cm at the maximum range; the most is taken"),
    sigma_bearing_rad=(2 * math.tan(math.radians(57.0 / 2)) / 640.0, f"{PIXEL}, of 640 over 57 deg ({FOV})"),
    fov_rad=(math.radians(57.0), FOV),
    rate_hz=(30.0, f"{KINECT}: up to 30 fps"),
    dropouts=(0.17, "assumption: as often as the camera"),
)
"""A depth camera (Kinect), used in the plane: range and bearing.  The source does not give its maximum range."""

SPREAD = f"7.4 % by the unknown orientation ({DIPOLE}), 6.6 % by the scatter of {BOUNCE}"
BEACONS = f"{BEACON}: 0.5 to 2.23 uA/m at 10 m; its cube root, uniform in the logarithm"
ARVA = _preset(
    Range,
    sigma_range_m=(0.0, "none beside the part that grows with the range"),
    sigma_range_rel=(math.hypot(0.074, 0.066), SPREAD),
    range_max_m=(40.0, f"{RAGNI}, 2.1: roughly the maximum distance at which a beacon receives the signal"),
    sigma_scale=(math.log(2.23 / 0.5) / 3 / math.sqrt(12.0), BEACONS),
    rate_hz=(1.0, f"{BEACON}: period 1000 +- 300 ms"),
    dropouts=(2 / 9, f"2 of the 9 {BOUNCE}, are blank"),
)
"""An avalanche transceiver: ranges by field strength, true but for a factor, the strength of the beacons."""

FADING = f"{BACKSCATTER}: mean errors below 15 % in typical fading, as a Gaussian's sigma"
RFID = _preset(
    RangeBearing,
    sigma_range_m=(0.0, "none beside the part that grows with the range"),
    sigma_range_rel=(0.15 * math.sqrt(math.pi / 2), FADING),
    sigma_bearing_rad=(math.radians(3.3), f"{ARRIVAL}: 3.3 deg rms with two antennas in line of sight"),
    range_max_m=(6.0, f"{TAGS}: the detection range is approximately 6 m"),
    fov_rad=(math.pi, "two antennas half a wavelength apart measure directions from -90 to 90 deg"),
    rate_hz=(1.0, "assumption: one inventory a second"),
    dropouts=(0.34, f"{MULTI_TAG}: detection probability can be as low as 66 %"),
)
"""A reader of passive UHF tags with two antennas: poor ranges, fair bearings."""

TABLE_2 = {"laser": LASER, "sonar": SONAR, "camera": CAMERA, "rgbd": RGBD, "arva": ARVA, "rfid": RFID}
"""Those of [S] Table 2."""

# ---------------------------------------------------------------------- devices
UTM = "Hokuyo, UTM-30LX-EW specification"
SCIP = f"{HOKUYO}, Table 2, of the UTM-30LX"
LASER_SCANNER = _preset(
    RangeBearing,
    sigma_range_m=(0.03, f"{UTM}: accuracy 0.1 to 10 m +- 30 mm"),
    sigma_bearing_rad=(
        math.radians(360.0 / 1440.0) / math.sqrt(12.0),
        f"{SCIP}: 1440 steps a turn, anywhere in one; a detector that fits several beams finds more",
    ),
    range_min_m=(0.1, f"{UTM}: range 0.1 to 30 m"),
    range_max_m=(30.0, f"{UTM}: range 0.1 to 30 m"),
    fov_rad=(math.radians(270.25), f"{SCIP}: detection range 270.25 deg"),
    rate_hz=(40.0, f"{UTM}: 25 ms a scan"),
    dropouts=(0.41, "assumption: as often as the small laser"),
)
"""A 2-D laser scanner: Hokuyo UTM-30LX."""

EUROC = "Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 2016, imu0/sensor.yaml of its ADIS16448"
MEMS_IMU = _preset(
    Gyro2D,
    sigma_radps=(0.0, "none beside the density"),
    sigma_rad_per_sqrt_s=(1.6968e-4, f"{EUROC}: gyroscope_noise_density 1.6968e-04 rad/s/sqrt(Hz)"),
    sigma_bias_radps=(math.radians(0.5), "assumption: half a degree a second when it is switched on"),
    sigma_bias_radps_per_sqrt_s=(1.9393e-5, f"{EUROC}: gyroscope_random_walk 1.9393e-05 rad/s^2/sqrt(Hz)"),
    rate_hz=(200.0, f"{EUROC}: rate_hz 200"),
    dropouts=(0.0, "assumption: none, it is read by wire"),
)
"""The gyroscope of a MEMS inertial unit: ADIS16448."""

INERTIAL_UNIT = _preset(
    Inertial,
    gyroscope_noise_density_rad_per_sqrt_s=(1.6968e-4, f"{EUROC}: gyroscope_noise_density 1.6968e-04 rad/s/sqrt(Hz)"),
    gyroscope_random_walk_radps_per_sqrt_s=(1.9393e-5, f"{EUROC}: gyroscope_random_walk 1.9393e-05 rad/s^2/sqrt(Hz)"),
    accelerometer_noise_density_mps_per_sqrt_s=(2.0e-3, f"{EUROC}: accelerometer_noise_density 2.0e-3 m/s^2/sqrt(Hz)"),
    accelerometer_random_walk_mps2_per_sqrt_s=(3.0e-3, f"{EUROC}: accelerometer_random_walk 3.0e-3 m/s^3/sqrt(Hz)"),
    rate_hz=(200.0, f"{EUROC}: rate_hz 200"),
    dropouts=(0.0, "assumption: none, it is read by wire"),
)
"""The same unit as a motion, `inertial`: its accelerometers, too."""

F9P = "u-blox, ZED-F9P data sheet UBX-17051259"
RTK_RECEIVER = _preset(
    Gps2D,
    Gps3D,
    sigma_m=(
        0.01 / math.sqrt(2.0 * math.log(2.0)),
        f"{F9P}: RTK 0.01 m + 1 ppm CEP, near its base; half of a Gaussian is within 1.177 sigmas",
    ),
    sigma_z_m=(
        0.01 / NormalDist().inv_cdf(0.75),
        f"{F9P}: vertically RTK 0.01 m + 1 ppm R50, as the specification of CubePilot's Here 4 has it of the same "
        "engine (NEO-F9P); half of a Gaussian is within 0.674 sigmas",
    ),
    rate_hz=(1.0, "assumption: one position a second, as u-blox receivers are set when they are new"),
    dropouts=(0.0, "assumption: none under an open sky; where the ambiguities are not fixed it is worse"),
)
"""A satellite receiver with corrections of a base (RTK) that has fixed its ambiguities: u-blox ZED-F9P."""

BURGER = "ROBOTIS, TurtleBot3 e-Manual, Burger"
WHEEL_ENCODER = _preset(
    Speed,
    sigma_mps=(
        0.01 * 0.22,
        f"assumption: slip of 1 % at 0.22 m/s, the greatest speed ({BURGER}); its encoders of 4096 steps a turn, read "
        "20 times a second on wheels of 33 mm, add 0.3 mm/s",
    ),
    sigma_scale=(0.02, "assumption: 0.7 mm of the radius of the wheels, 33 mm"),
    rate_hz=(20.0, "assumption: 20 Hz, of joint_states in logs of that robot"),
    dropouts=(0.0, "assumption: none, it is read by wire"),
)
"""Wheel encoders of a small robot: TurtleBot3 Burger."""

DEVICES = {
    "laser_scanner": LASER_SCANNER, "mems_imu": MEMS_IMU, "rtk_receiver": RTK_RECEIVER, "wheel_encoder": WHEEL_ENCODER,
}  # fmt: skip
"""Common devices, by their data sheets."""
MOTIONS = {"mems_imu": INERTIAL_UNIT}
"""Devices that are a motion: `robots.NAME.motion.preset`."""
ALL = TABLE_2 | DEVICES
"""All of them, by the names that `preset` has in a configuration."""
