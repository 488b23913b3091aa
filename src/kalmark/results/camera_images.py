"""The images that the cameras of a run took, for its video and report: of its log, which is read again if needed."""

from __future__ import annotations

import base64
import math
from contextlib import suppress
from copy import deepcopy
from typing import Any

from kalmark.config.reading import config_of
from kalmark.config.tree import Tree
from kalmark.errors import KalmarkError
from kalmark.events import Frame
from kalmark.logs.log import Log
from kalmark.plugins import entry_points_of, load
from kalmark.results.history import Camera
from kalmark.results.recording import Recording

WIDEST_PX, QUALITY = 400, 60  # of an image in a page; of several cameras as many pixels in all


class Pictures:
    """The images of a run's cameras by step; nothing where the log has none, or is not where it was."""

    def __init__(self, run: Recording) -> None:
        self.history = run.history
        log = run.source or _read_again(run)
        events = () if log is None else log.events
        self.frames = {(e.t_ns, e.robot, e.sensor): e for e in events if isinstance(e, Frame)}

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
        import cv2

        scale = min(1.0, WIDEST_PX / math.sqrt(len(self.history.cameras)) / image.shape[1])
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1.0 else image
        packed = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
        return "data:image/jpeg;base64," + base64.b64encode(packed.tobytes()).decode()


def _read_again(run: Recording) -> Log | None:
    """Return the log of a run that was loaded, None if no camera of it has a detector, or the log is not there."""
    searched = any(run.section(camera.robot, camera.sensor).get("detector") for camera in run.history.cameras)
    if not searched:
        return None
    from kalmark.results.batch import log_of_run  # heavy, and seldom needed

    log: Any = None
    with suppress(KalmarkError):
        log = log_of_run(run)
        config = config_of(Tree(deepcopy(dict(run.config))), None)
        for name in entry_points_of("keys"):
            log = load("keys", name).with_events(config, log)
    return log
