"""Images as a camera without distortion would take them: straight lines of the world are straight there."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.events import Frame
from kalmark.vision import opencv as cv2


class Straightened:
    """The grey images of a camera, as one at the same place takes them that has `intrinsics` (4,) and size `image`.

    >>> bent = km.sensors.PinHole(lens="radtan", distortion=(-0.28, 0.07, 0.0, 0.0))
    >>> straight = Straightened(bent, np.array([320.0, 320.0, 320.0, 240.0]), (640, 480))
    >>> u, v = straight.maps
    >>> u.shape, u[240, [0, 320, 639]].round(1)
    ((480, 640), array([ 67.2, 320. , 572.3], dtype=float32))
    """

    def __init__(self, camera: Any, intrinsics: Array, image: tuple[float, float]) -> None:
        self.camera, self.intrinsics, self.size = camera, intrinsics, image

    @cached_property
    def maps(self) -> tuple[Any, Any]:
        """Places (H, W) of the pixels of the straight image in that of the camera: u and v."""
        width, height = map(int, self.size)
        v, u = np.mgrid[:height, :width]
        fx, fy, cx, cy = self.intrinsics
        rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=2).reshape(-1, 3)
        e = self.camera.expect(rays)[0].astype(np.float32).reshape(height, width, 2)
        return np.ascontiguousarray(e[..., 0]), np.ascontiguousarray(e[..., 1])

    def of(self, frame: Frame) -> Any:
        """Return the straight image (H, W) of a frame, 0 where the camera does not see.  Raises ImageError."""
        return cv2.remap(frame.grey(), *self.maps, cv2.INTER_LINEAR)
