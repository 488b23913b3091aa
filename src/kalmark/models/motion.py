"""All motions: those in the plane (`motion2d`) and those in space (`motion3d`)."""

from kalmark.models.motion2d import Ackermann, Odometry2D, Unicycle
from kalmark.models.motion3d import ConstantVelocity3D, Odometry3D, Velocity3D

__all__ = ["Ackermann", "ConstantVelocity3D", "Odometry2D", "Odometry3D", "Unicycle", "Velocity3D"]
