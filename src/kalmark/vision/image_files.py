"""Image files and videos, read when their pixels are needed; files that are missing or cut short are noticed before."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice, repeat
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import ImageError, LogError
from kalmark.events import Frame
from kalmark.logs.source import Request
from kalmark.vision import opencv as cv2

ENDINGS = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff", ".webp")
TRAILERS = {b"\x89PN": b"IEND\xaeB`\x82", b"\xff\xd8\xff": b"\xff\xd9"}
"""The end of a file of PNG or JPEG, by the three bytes that begin it: its name may be wrong."""
TAIL = 64  # bytes at the end of a file in which its trailer is: some cameras pad their files
DEPTH_SCALE = 5000.0  # of TUM RGB-D: a depth of 1 m is 5000


def image_of(path: Path) -> Any:
    """Return an image file in grey values (H, W).  Raises OSError if it cannot be decoded."""
    return _decoded(path, cv2.IMREAD_GRAYSCALE)


def depth_of(path: Path, scale: float) -> Array:
    """Return an image file of depths in m (H, W): its numbers over `scale`.  Raises OSError if it cannot be decoded."""
    return np.asarray(_decoded(path, cv2.IMREAD_UNCHANGED), dtype=np.float64) / scale


def _decoded(path: Path, flag: int) -> Any:
    image = cv2.imdecode(np.fromfile(path, dtype=np.uint8), flag)
    if image is None:
        raise OSError(f"{path}: cannot be decoded, expected an image")
    return image


def flaw(path: Path) -> str:
    """Return the fault of an image file, by its end: "missing", "cut short", or ""."""
    try:
        with path.open("rb") as stream:
            begin = stream.read(3)
            stream.seek(max(0, path.stat().st_size - TAIL))
            tail = stream.read()
    except OSError:
        return "missing"
    return "" if tail and TRAILERS.get(begin, b"") in tail else "cut short"


class Album:
    """Makes frames of image files, and counts those that are missing or cut short."""

    def __init__(self, scale: float = DEPTH_SCALE) -> None:
        self.scale = scale
        self.count, self.flaws, self.first = 0, Counter[str](), ""

    def frame(
        self, t_ns: int, robot: str, sensor: str, file: Path, depth: Path | None = None, right: Path | None = None
    ) -> Frame | None:
        """Return the frame of a file, without a depth or right image that cannot be used; None if the image cannot."""
        self.count += 1
        wrong = flaw(file)
        if wrong:
            self.flaws[wrong] += 1
            self.first = self.first or str(file)
            return None
        taken = None if depth is None or flaw(depth) else partial(depth_of, depth, self.scale)
        other = None if right is None or flaw(right) else partial(image_of, right)
        return Frame(t_ns=t_ns, robot=robot, sensor=sensor, image=partial(image_of, file), depth=taken, right=other)

    def report(self, request: Request) -> None:
        """List how many images were left out.  Raises LogError if none can be used."""
        if self.flaws:
            what = " and ".join(f"{count} {name}" for name, count in sorted(self.flaws.items()))
            request.leave_out(self.flaws.total(), f"{self.first}: of {self.count} images {what}, this one first")
        if self.flaws.total() == self.count:
            raise LogError(f"{self.first or 'images'}: no image of {self.count} can be used, expected some")


def frames_of(
    robot: str, sensor: str, t_ns: Iterable[int], files: Iterable[Path], request: Request,
    depths: Iterable[Path | None] = repeat(None), scale: float = DEPTH_SCALE,
    rights: Iterable[Path | None] = repeat(None),
) -> list[Frame]:  # fmt: skip
    """Return the frames of image files at these times (ns), without those that cannot be used.  Raises LogError."""
    album = Album(scale)
    rows = zip(t_ns, files, depths, rights, strict=False)
    frames = [album.frame(t, robot, sensor, file, depth, right) for t, file, depth, right in rows]
    album.report(request)
    return [frame for frame in frames if frame is not None]


def write_image(path: Path, image: Any) -> None:
    """Write an image (H, W) or (H, W, 3) of bytes as PNG."""
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def write_depth(path: Path, depth: Array) -> None:
    """Write depths (H, W) in m as PNG of 16 bits, DEPTH_SCALE a metre, 0 where there is none or more than fits."""
    numbers = np.rint(np.where(np.isfinite(depth), depth, 0.0) * DEPTH_SCALE)
    write_image(path, np.where(numbers <= np.iinfo(np.uint16).max, numbers, 0).astype(np.uint16))


def image_size(frames: Iterable[Frame]) -> dict[str, int]:
    """Return the size of the first image that can be read, as a camera's configuration has it.  Raises ImageError."""
    wrong: ImageError | None = None
    for frame in frames:
        try:
            height, width = frame.pixels().shape[:2]
        except ImageError as error:
            wrong = wrong or error
            continue
        return {"width_px": int(width), "height_px": int(height)}
    raise wrong or ImageError("no frame, expected some")


class Forward:
    """Images that are read one after the other; the k-th is read by going on to it, an earlier one from the start.

    `start` begins: it yields images (H, W), or an OSError in the place of one that cannot be read.
    """

    def __init__(self, start: Callable[[], Iterator[Any]]) -> None:
        self.start = start
        self._images: Iterator[Any] = iter(())
        self._next, self._last = 0, (-1, None)

    def at(self, k: int) -> Any:
        """Return the k-th image (H, W).  Raises OSError if there is none."""
        if k != self._last[0]:
            self._go_to(k)
        image = self._last[1]
        if isinstance(image, OSError):
            raise image
        return image

    def _go_to(self, k: int) -> None:
        if k < self._next or self._next == 0:
            self._images, self._next = self.start(), 0
        image = next(islice(self._images, k - self._next, None), None)
        if image is None:
            self._next = 0
            raise OSError(f"image {k} cannot be read: the source ends before")
        self._next, self._last = k + 1, (k, image)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy in another process needs: it reads from the start."""
        return {"start": self.start}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["start"])  # type: ignore[misc]


def video_images(path: Path) -> Iterator[Any]:
    """Yield the images of a video in grey values (H, W)."""
    video = cv2.VideoCapture(str(path))
    try:
        while True:
            there, image = video.read()
            if not there:
                return
            yield image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    finally:
        video.release()


def video_facts(path: Path) -> tuple[int, float]:
    """Return the number of images and the rate [Hz] that a video states, 0 if it does not.  Raises LogError."""
    with warnings.catch_warnings():
        video = cv2.VideoCapture(str(path))
        count, rate = int(video.get(cv2.CAP_PROP_FRAME_COUNT)), float(video.get(cv2.CAP_PROP_FPS))
        there = video.isOpened() and video.grab()
        video.release()
    if not there:
        raise LogError(f"{path}: cannot be decoded, expected a video that OpenCV reads")
    return max(count, 0), rate if np.isfinite(rate) and rate > 0 else 0.0
