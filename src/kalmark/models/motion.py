"""All motions: those in the plane (`motion2d`) and those in space (`motion3d`)."""

from kalmark.models.motion2d import *  # noqa: F403
from kalmark.models.motion3d import *  # noqa: F403
