"""What of a scan is worth a correction, and what is worth a start, where `Attention` sets a limit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kalmark.association.protocol import ANEW, DEFERRED, Decision
from kalmark.events import Scan
from kalmark.tracks.scene import Look, View

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]


def least(
    slam: Slam, event: Scan, view: View, groups: list[tuple[Look, list[int]]], decisions: Sequence[Decision], R: Array
) -> list[int]:
    """Take out of the groups what is not worth a correction and return it."""
    robot, order, told = slam.members.slots[event.robot], [], []
    for look, rows in groups:
        slots = slam.members.slots_of([decisions[k][0] for k in rows])
        order += rows
        told += view.information(slam.map, robot, look, slots, event, rows, R[rows]).tolist()
    worth = view.attention.worth_a_correction(np.array(told))
    out = [k for k, good in zip(order, worth, strict=True) if not good]
    for _, rows in groups:
        rows[:] = [k for k in rows if k not in out]
    return out


def starts(
    slam: Slam, view: View, new: list[int], known: list[int], y: Array, decisions: Sequence[Decision]
) -> dict[int, str]:
    """Return why some of the observations that could start landmarks do not."""
    held = [None, *(answer for answer in (DEFERRED, ANEW) if answer not in view.starts)]
    wanted = [k for k in new if decisions[k][0] not in held and decisions[k][0] not in slam.members.slots]
    image, empty = getattr(view.sensor, "image", None), not slam.members.kinds
    return view.attention.worth_a_start(wanted, known, y, image, empty)
