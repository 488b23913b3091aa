"""Read Victoria Park (E. Nebot, ACFR Sydney): a car with a laser among trees, encoders, a poor GPS, 26 minutes.

Everything is put on the clock of the `.mat` files; the ascii files run 20.967 s behind it.
"""

from __future__ import annotations

import zipfile
from itertools import groupby, pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from kalmark.arrays import Array
from kalmark.datasets.array_files import arrays, times
from kalmark.errors import LogError
from kalmark.events import Control, Event, Scan
from kalmark.files import refuse_bomb
from kalmark.logs.log import Log, PositionTrack, Times
from kalmark.logs.source import (
    Format,
    Request,
    folder_of,
    nanoseconds_of_text,
    one_robot,
    read_text,
    text_rows,
    timed_rows,
)
from kalmark.logs.table_columns import BEAM

ROBOT, SENSOR = "car", "laser"
ASCII_ZIP, ASCII_DR, MAT_DR, GPS = "victoria_park_ascii.zip", "DRS.txt", "aa3_dr.mat", "aa3_gpsx.mat"
SLSJF = Path("slsjf") / "data_sensor_clean_clean.mat"
ASCII_LASER, RFS = "LASER.txt", Path("rfs-slam") / "measurements.dat"
BEAMS = 361
ANGLES = np.radians(np.arange(BEAMS) / 2 - 90.0)
"""The laser's beams, rad: by half a degree from the right to the left."""
ASCII_BEHIND_NS = 20_967_000_000
ANTENNA = np.array([3.78, 0.5])
"""Laser and GPS antenna from the centre of the rear axle, m: a + L ahead (0.95 + 2.83), b to the left."""
IGNORE = -1


def find(path: Path) -> Path | None:
    """Return the dataset's folder, given it or one of its files."""
    return folder_of(path, (ASCII_ZIP, ASCII_DR, MAT_DR))


def read(
    path: Path,
    request: Request,
    detections: Annotated[Literal["slsjf", "rfs", "laser"], "Source of the detections."] = "slsjf",
    steering: Annotated[Literal["ascii", "mat"], "Calibration of the steering."] = "ascii",
) -> Log:
    """Return the log with detections, and the encoders' calibration `ascii` or `mat`.

    `slsjf`: trees of known identity; `rfs`: trees without, by range, bearing and radius; `laser`: the beams themselves.
    """
    events = ascii_controls(path, request) if steering == "ascii" else mat_controls(path / MAT_DR)
    if detections == "slsjf":
        events += slsjf_scans(path / SLSJF, request)
    else:
        events += rfs_scans(path / RFS, request) if detections == "rfs" else laser_scans(path)
    gps = {ROBOT: read_gps(path / GPS)} if (path / GPS).is_file() else {}
    sensors = {SENSOR: BEAM + (("signature",) if detections == "rfs" else ())}
    return one_robot("victoria_park", path, request, ROBOT, events, ("v_mps", "steering_rad"), sensors, gps=gps)


def ascii_text(path: Path, name: str, otherwise: str) -> tuple[Path, str]:
    """Return an ascii file and its text, from beside the zip or from within."""
    if (path / name).is_file():
        return path / name, read_text(path / name)
    file = path / ASCII_ZIP
    try:
        with zipfile.ZipFile(file) as archive:
            refuse_bomb(archive, file, LogError)
            return file / name, archive.read(name).decode("ascii")
    except (OSError, KeyError, UnicodeDecodeError, zipfile.BadZipFile) as error:
        raise LogError(f"{file}: {error}, expected a zip with {name} (or {otherwise})") from None


def ascii_controls(path: Path, request: Request) -> list[Event]:
    """Return speed and steering of the ascii files (recalibrated), from DRS.txt or the zip that holds it."""
    file, text = ascii_text(path, ASCII_DR, "steering: mat")
    table = timed_rows(file, ("v_mps", "steering_rad"), request.refuse, text_rows(file, text))
    return [Control(t_ns=t_ns + ASCII_BEHIND_NS, robot=ROBOT, u=u) for _, t_ns, u in table]


def mat_controls(path: Path) -> list[Event]:
    """Return speed and steering of the .mat file."""
    data = arrays(path, ("time", "speed", "steering"))
    t_ns = milliseconds(data["time"], path, "time")
    u = np.column_stack([data["speed"].ravel(), data["steering"].ravel()])
    return [Control(t_ns=t, robot=ROBOT, u=row) for t, row in zip(t_ns.tolist(), u, strict=True)]


def slsjf_scans(path: Path, request: Request) -> list[Event]:
    """Return the scans of trees with known ids; bearings are turned so that 0 is forward."""
    (table,) = arrays(path, ("data_sensor_clean_clean",)).values()
    if table.ndim != 2 or table.shape[1] != 6:
        raise LogError(f"{path}: table has shape {table.shape}, expected 6 columns: t range bearing x y id")
    if (table[:, 1] < 0).any():
        row = int(np.argmax(table[:, 1] < 0)) + 1
        raise LogError(f"{path}: row {row} has range {table[row - 1, 1]}, expected a range of at least 0")
    ids = table[:, 5].astype(np.int64)
    if (poor := int((ids == IGNORE).sum())) > 0:
        request.leave_out(poor, f"{path}: {poor} detections of poor quality (id -1)")
    table, ids = table[ids != IGNORE], ids[ids != IGNORE]
    t_ns = milliseconds(table[:, 0], path, "t")
    y = np.column_stack([table[:, 1], table[:, 2] - np.pi / 2])
    starts = np.flatnonzero(np.diff(t_ns, prepend=-1))
    return [
        Scan(t_ns=int(t_ns[a]), robot=ROBOT, sensor=SENSOR, y=y[a:b], ids=ids[a:b].tolist())
        for a, b in zip(starts, [*starts[1:], len(t_ns)], strict=True)
    ]


def laser_scans(path: Path) -> list[Event]:
    """Return the raw scans, each beam's range and bearing; 81.91 m is no return."""
    file, text = ascii_text(path, ASCII_LASER, "detections: slsjf")
    cells = text.split()
    if not cells or len(cells) % (BEAMS + 1):
        raise LogError(f"{file}: {len(cells)} numbers, expected whole scans of a time and {BEAMS} ranges")
    try:
        table = np.array(cells, dtype=np.float64).reshape(-1, BEAMS + 1)
        t_ns = [nanoseconds_of_text(cell) + ASCII_BEHIND_NS for cell in cells[:: BEAMS + 1]]
    except ValueError as error:
        raise LogError(f"{file}: {error}, expected numbers") from None
    r = table[:, 1:]
    bad = ~(np.isfinite(r) & (r >= 0))
    if bad.any():
        scan, beam = (int(i) + 1 for i in np.argwhere(bad)[0])
        raise LogError(f"{file}: scan {scan} beam {beam} has range {r[scan - 1, beam - 1]}, expected at least 0")
    if any(after < before for before, after in pairwise(t_ns)):
        raise LogError(f"{file}: times run backwards, expected times that never do")
    beams = (np.column_stack([ranges, ANGLES]) for ranges in r)
    return [Scan(t_ns=t, robot=ROBOT, sensor=SENSOR, y=y) for t, y in zip(t_ns, beams, strict=True)]


def rfs_scans(path: Path, request: Request) -> list[Event]:
    """Return the scans of trees of unknown identity: range, bearing with 0 forward, and radius, half of column 4."""
    events: list[Event] = []
    table = []
    for line, t_ns, y in timed_rows(path, (*BEAM, "diameter_m"), request.refuse):
        if y[0] < 0 or y[2] < 0:
            request.refuse(f"{path}:{line}: range {y[0]} m, diameter {y[2]} m, expected numbers of at least 0")
        else:
            table.append((t_ns, y))
    for t_ns, rows in groupby(table, key=lambda row: row[0]):
        trees = [[r, b - np.pi / 2, diameter / 2] for _, (r, b, diameter) in rows]
        events.append(Scan(t_ns=t_ns + ASCII_BEHIND_NS, robot=ROBOT, sensor=SENSOR, y=trees))
    return events


def read_gps(path: Path) -> PositionTrack:
    """Return the GPS fixes (x = Lo_m, y = La_m), which jump and drop out: for scoring only."""
    data = arrays(path, ("timeGps", "Lo_m", "La_m"))
    xy = np.column_stack([data["Lo_m"].ravel(), data["La_m"].ravel()])
    return PositionTrack(milliseconds(data["timeGps"], path, "timeGps"), xy, ANTENNA)


def milliseconds(values: Array, path: Path, name: str) -> Times:
    """Return times in ms as integer ns.  Raises LogError if they run backwards."""
    refused = f"{name} row {{row}} is before row {{before}}, expected times that never run backwards"
    return times(path, values, refused, scale=1e6, strictly=False)


VICTORIA_PARK = Format("victoria_park", f"a folder with {ASCII_ZIP} or {MAT_DR}, and {SLSJF.as_posix()} or the zip's"
                       " laser", find, read)  # fmt: skip
