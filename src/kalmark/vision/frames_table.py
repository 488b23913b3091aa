"""The table `frames.csv` of native logs: t_s, robot, sensor, image[, depth][, right]: files beside it.

Depths have 16 bits, 5000 a metre.  `write_native` puts the images below the folder, as
images/ROBOT_SENSOR/NANOSECONDS_COLUMN.png.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from kalmark.events import Event, Frame
from kalmark.logs import native_writer
from kalmark.logs.log import Log
from kalmark.logs.source import Request
from kalmark.logs.table import Content, Refused, Row, read_table
from kalmark.vision.image_files import Album, write_depth, write_image

IMAGES = "images"
PICTURES = "image", "depth", "right"  # columns that name files


def read(path: Path | Content, request: Request, note: Callable[[Row], None]) -> Iterator[Event]:
    """Yield the frames of the table, without those whose images cannot be used; `note` takes each row."""
    folder, album = Path(str(path)).parent, Album()

    def make(row: Row) -> Frame | None:
        note(row)
        if not row.text("image"):
            raise Refused("image is empty, expected a file beside this one")
        told = (row.text(name) if name in row.table.index else "" for name in ("depth", "right"))
        depth, right = (folder / name if name else None for name in told)
        return album.frame(row.t_ns, row.robot, row.sensor, folder / row.text("image"), depth, right)

    table = read_table(path, ("t_s", "robot", "sensor", "image"), allowed=("depth", "right"))
    yield from table.made(request, make, by_sensor=True)
    album.report(request)


def rows(log: Log, folder: Path) -> Iterator[native_writer.Row]:
    """Yield the rows of the table, and write the images below the folder."""
    for frame in log:
        if not isinstance(frame, Frame):
            continue
        row = native_writer.time_and_robot(frame) | {"sensor": native_writer.name(frame.sensor)}
        told = frame.pixels(), frame.depths(), frame.right_grey()
        for column, pixels, write in zip(PICTURES, told, (write_image, write_depth, write_image), strict=True):
            if pixels is None:
                continue
            place = Path(IMAGES, f"{frame.robot}_{frame.sensor}".replace("/", "_"), f"{frame.t_ns}_{column}.png")
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            write(folder / place, pixels)
            row[column] = place.as_posix()
        yield row
