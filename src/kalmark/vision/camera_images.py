"""The images that the cameras of a log took, as the figures, the video and the report of a run show them."""

from __future__ import annotations

import base64
import math
from typing import TYPE_CHECKING, Any

from kalmark.errors import KalmarkError
from kalmark.events import Frame
from kalmark.logs.log import Log
from kalmark.vision import opencv as cv2

if TYPE_CHECKING:
    from kalmark.results.history import Camera, History

WIDEST_PX, QUALITY = 400, 60  # of an image in a page; of several cameras as many pixels in all


class CameraImages:
    """The images of a log by the cameras and the steps of a run's history.

    >>> eye = km.Mount(km.sensors.PinHole(), at=(0, 0, 0, 0, 0, 0, 1))
    >>> slam = km.Slam(km.Robot("drone", km.motion.Odometry3D(), sensors={"eye": eye}))
    >>> run = km.record(slam, [km.Scan(0.0, "drone", "eye", [[320.0, 240.0]], ids=[1])], progress=False)
    >>> log = km.Log("flight", ("drone",), [km.Frame(0.0, "drone", "eye", np.zeros((480, 640), np.uint8))])
    >>> km.vision.CameraImages(log, run.history).at(run.history.cameras[0], step=0).shape
    (480, 640)
    """

    def __init__(self, log: Log, history: History) -> None:
        self.history = history
        self.frames = {(e.t_ns, e.robot, e.sensor): e for e in log.events if isinstance(e, Frame)}

    def at(self, camera: Camera, step: int, side: str = "") -> Any | None:
        """Return the image (H, W) in grey values that a camera took at a step, None if there is none.

        Of a pair, that of the right one where the `side` is "right".
        """
        frame = self.frames.get((int(self.history.t_ns[step]), camera.robot, camera.sensor))
        try:
            return None if frame is None else frame.right_grey() if side == "right" else frame.grey()
        except KalmarkError:  # the run went on without it, too
            return None

    def uri(self, camera: Camera, step: int, side: str = "") -> str:
        """Return that image as a data URI of a JPEG, of a width for a page with all cameras, "" if there is none."""
        image = self.at(camera, step, side)
        if image is None:
            return ""
        scale = min(1.0, WIDEST_PX / math.sqrt(len(self.history.cameras)) / image.shape[1])
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1.0 else image
        packed = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
        return "data:image/jpeg;base64," + base64.b64encode(packed.tobytes()).decode()
