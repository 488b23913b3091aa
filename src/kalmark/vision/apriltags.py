"""AprilTags in images, by OpenCV: ``pip install 'kalmark[opencv]'``."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from kalmark.arrays import Array
from kalmark.declare import Positive, register
from kalmark.errors import EventError
from kalmark.events import Frame, Raw, Scan, label_of_event
from kalmark.models.sensors import TagCorners
from kalmark.vision import opencv as cv2

Family = Literal["16h5", "25h9", "36h10", "36h11"]


@lru_cache(maxsize=8)
def _detector(family: str) -> Any:
    """Return OpenCV's detector of a family, its corners refined to a fraction of a pixel."""
    aruco = cv2.aruco
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    return aruco.ArucoDetector(aruco.getPredefinedDictionary(getattr(aruco, f"DICT_APRILTAG_{family}")), parameters)


@register("detector", "tags")
class Tags:
    """Tags of one family and one size, by the pixels of their corners, as a `TagCorners` sensor takes them.

    >>> eye = km.Mount(km.sensors.TagCorners(), detector=km.detect.Tags(size_m=0.2))
    >>> slam = km.Slam(km.Robot("drone", km.motion.Velocity3D(), sensors={"eye": eye}))
    >>> image = np.full((480, 640), 255, np.uint8)  # without a tag
    >>> slam.process(km.Frame(0.0, "drone", "eye", image)).observations
    ()
    """

    columns: ClassVar[tuple[str, ...]] = TagCorners.columns
    takes: ClassVar[type[Raw]] = Frame

    family: Annotated[Family, "Family of the tags."] = "36h11"
    size_m: Annotated[Positive, "Length of a side of the black square."] = 0.1

    def detect(self, image: Any) -> tuple[Array, list[int]]:
        """Return the corners and the size (K, 9) of the tags in an image (H, W) or (H, W, 3) of bytes, and their ids.

        Corners in the order (-s, -s), (s, -s), (s, s), (-s, s) of the tag's frame, x right and y up as it is printed.
        A tag that appears twice is left out.
        """
        pixels = np.asarray(image)
        if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or not pixels.size:
            raise EventError(f"the image is {pixels.dtype} {pixels.shape}, expected bytes (H, W) or (H, W, 3)")
        corners, ids, _ = _detector(self.family).detectMarkers(np.ascontiguousarray(pixels))
        names = [] if ids is None else [int(i) for i in np.ravel(ids)]
        once = [k for k, i in enumerate(names) if names.count(i) == 1]
        y = np.empty((len(once), 9))
        for row, k in enumerate(once):
            y[row, :8] = corners[k].reshape(4, 2)[::-1].ravel()  # OpenCV goes the other way round, from the top left
        y[:, 8] = self.size_m
        return y, [names[k] for k in once]

    def __call__(self, scan: Scan) -> Scan:
        """Return the scan of the tags in an image, given as a scan whose y (H, W) are grey values of 0 to 255."""
        if not len(scan.y):
            return scan
        return self._scan(scan, np.clip(np.rint(scan.y), 0, 255).astype(np.uint8))

    def scan_of(self, frame: Frame) -> Scan:
        """Return the scan of the tags in a frame."""
        return self._scan(frame, frame.pixels())

    def _scan(self, scan: Scan | Frame, image: Any) -> Scan:
        try:
            y, ids = self.detect(image)
        except EventError as error:
            raise EventError(f"{label_of_event(scan)}: {error}") from None
        return Scan(t_ns=scan.t_ns, robot=scan.robot, sensor=scan.sensor, y=y if ids else (), ids=ids or None)
