"""kalmark: EKF-SLAM with a covariance that stays honest.

import kalmark as km

rover = km.Robot("rover", motion=km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
slam = km.Slam([rover])
slam.process(km.Control(t_s=0.0, robot="rover", u=(0.5, 0.02)))
report = slam.process(km.Scan(t_s=0.1, robot="rover", sensor="lidar", y=[[4.2, 0.3]], ids=[7]))
"""

from kalmark import geometry
from kalmark.errors import KalmarkError
from kalmark.filter import estimators
from kalmark.models import landmarks, motion, sensors
from kalmark.models.pointwise import pointwise
from kalmark.slam import association
from kalmark.slam.events import Control, Fix, Scan
from kalmark.slam.report import Observation, Report
from kalmark.slam.robot import Mount, Robot
from kalmark.slam.slam import Slam

__version__ = "0.1.0"

__all__ = [
    "Control", "Fix", "KalmarkError", "Mount", "Observation", "Report", "Robot", "Scan", "Slam", "association",
    "estimators", "geometry", "landmarks", "motion", "pointwise", "sensors",
]  # fmt: skip
