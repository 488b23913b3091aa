"""The frames of the plane and of space, by how many numbers a pose has."""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.geometry import frames, frames3d

FRAMES: dict[int, Any] = {3: frames, 7: frames3d}
ORIGIN = {3: np.zeros(3), 7: np.array([0.0, 0, 0, 0, 0, 0, 1])}
