# ruff: noqa: F403, I001 - each family lists its names; messages and the page of the configuration have them in this order
"""All sensors by name, and the modules of their families.  [S] A.4, Table 2."""

from __future__ import annotations

from kalmark.declare import built_in
from kalmark.models import blocks, doppler, radio, state_sensors, polar, spatial, imaging
from kalmark.models.blocks import *
from kalmark.models.doppler import *
from kalmark.models.radio import *
from kalmark.models.state_sensors import *
from kalmark.models.polar import *
from kalmark.models.spatial import *
from kalmark.models.imaging import *

__all__ = (
    blocks.__all__
    + doppler.__all__
    + imaging.__all__
    + polar.__all__
    + radio.__all__
    + spatial.__all__
    + state_sensors.__all__
)

BUILT_IN = built_in("sensor")  # those of landmarks and those of the state
