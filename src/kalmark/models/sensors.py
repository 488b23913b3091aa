"""All sensors: those of the plane (`sensors2d`), those of space (`sensors3d`) and cameras (`sensors_camera`)."""

from kalmark.declare import built_in
from kalmark.models.sensors2d import *  # noqa: F403
from kalmark.models.sensors3d import *  # noqa: F403
from kalmark.models.sensors_camera import *  # noqa: F403

BUILT_IN = built_in("sensor")
