"""Read the DLR Spatial Cognition set (U. Frese): steps and circular landmarks, both metric and with covariance.

The file's robot frame has X to the right and -Y forward, so its third axis points down and its headings grow
clockwise.  kalmark's frame is x forward, y left, z up:

    x = -Y,  y = -X,  theta = -Phi          M = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]

`M` carries increments (u = M u_file, C = M C_file M^T), its upper left block observations.  A path or map in the
file's frame becomes one in kalmark's by the same exchange of axes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from kalmark.errors import LogError
from kalmark.logs.log import Array, Log
from kalmark.logs.source import Format, Request, quantity
from kalmark.logs.steps import Steps
from kalmark.logs.text import landmark_id, number, rows

ROBOT, SENSOR, FILE = "robot", "camera", "map.circles"
M = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
SPURIOUS = -1


def find(path: Path) -> Path | None:
    """Return the file of steps and landmarks, given it or its folder."""
    file = path / FILE if path.is_dir() else path
    if not file.is_file():
        return None
    with file.open("rb") as stream:
        start = b"\n" + stream.read(8192)
    return file if b"\nSTEP " in start or b"\nLANDMARK_C " in start else None


def read(path: Path, request: Request, covariance_scale: Any = None) -> Log:
    """Return the log: step k ends at k seconds; the id -1 (spurious) becomes None.

    `covariance_scale` multiplies all covariances of the file (None: they stay as they are).
    """
    scale = 1.0 if covariance_scale is None else quantity(covariance_scale, "covariance_scale", 1e-9)
    steps = Steps(ROBOT, SENSOR)
    for line, cells in rows(path):
        where = f"{path}:{line}"
        try:
            if cells[0] == "STEP" and len(cells) == 11:
                u, cov = step([number(cell) for cell in cells[2:]])
                steps.step(u, scale * cov)
            elif cells[0] in ("LANDMARK_C", "LANDMARK") and len(cells) == 8:
                id_ = landmark_id(cells[7])
                y, cov = observation([number(cell) for cell in cells[1:7]])
                steps.see(y, None if id_ == SPURIOUS else id_, request.refuse, where, scale * cov)
            else:
                raise ValueError
        except ValueError:
            request.refuse(
                f"{where}: {' '.join(cells)!r}, expected STEP image dX dY dPhi cXX cXY cYY cXPhi cYPhi cPhiPhi"
                " or LANDMARK_C pX pY quality cXX cXY cYY id, with covariances that are positive definite"
            )
    events = steps.close()
    if not events:
        raise LogError(f"{path}: no step that can be used, expected STEP lines")
    return Log(
        name="dlr",
        format="dlr",
        path=path,
        robots=(ROBOT,),
        events=events,
        skipped=request.skipped,
        control_columns={ROBOT: ("dx_m", "dy_m", "dtheta_rad")},
        sensor_columns={(ROBOT, SENSOR): ("x_m", "y_m")},
    )


def step(values: list[float]) -> tuple[Array, Array]:
    """Return increment (3,) and covariance (3, 3) of one STEP; the file's order is XX XY YY XPhi YPhi PhiPhi."""
    xx, xy, yy, xp, yp, pp = values[3:]
    cov = np.array([[xx, xy, xp], [xy, yy, yp], [xp, yp, pp]])
    return M @ values[:3], M @ definite(cov) @ M.T


def observation(values: list[float]) -> tuple[Array, Array]:
    """Return position (2,) in the robot's frame and covariance (2, 2) of one landmark."""
    xx, xy, yy = values[3:]
    m = M[:2, :2]
    return m @ values[:2], m @ definite(np.array([[xx, xy], [xy, yy]])) @ m.T


def definite(cov: Array) -> Array:
    """Return a covariance if it is positive definite.  Raises ValueError."""
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        raise ValueError("covariance is not positive definite") from None
    return cov


DLR = Format("dlr", f"{FILE} or its folder", find, read, options=("covariance_scale",))
