"""Measurement selection: which observations correct the map, and which start landmarks.  Davison 2005; [TB]."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from kalmark.association.protocol import DEFERRED, REMAP, Answer, Decision
from kalmark.management.attention import Attention
from kalmark.models.protocols import image_size
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.scan import ScanContext

Group = tuple[ObservationModel, list[int]]


def chosen(
    scan: ScanContext, attention: Attention, groups: Sequence[Group], decisions: Sequence[Decision]
) -> tuple[list[Group], list[int]]:
    """Return the groups of observations with those alone that correct the map, and the rows that are left out."""
    rows, information = [], []
    for model, some in groups:
        slots = scan.tracks.slots_of([decisions[k][0] for k in some])
        Z, _, R = scan.predict(model, slots, some)
        rows += some
        information.append(np.nan_to_num(np.linalg.slogdet(Z)[1] - np.linalg.slogdet(R)[1], nan=-np.inf))
    worth = attention.worth_a_correction(np.concatenate(information))
    out = [k for k, good in zip(rows, worth, strict=True) if not good]
    return [(model, [k for k in some if k not in out]) for model, some in groups], out


def left_out(
    scan: ScanContext, attention: Attention, starts: Collection[Answer], new: Sequence[int], known: Sequence[int],
    decisions: Sequence[Decision],
) -> dict[int, str]:  # fmt: skip
    """Return why some of the observations that could start landmarks do not.

    `starts` are the answers that start a landmark; `known` are the observations of landmarks in the map.
    """
    held = [None, *(answer for answer in (DEFERRED, REMAP) if answer not in starts)]
    wanted = [k for k in new if decisions[k][0] not in held and decisions[k][0] not in scan.tracks.slots]
    empty = not scan.tracks.confirmed
    return attention.worth_a_start(wanted, known, scan.y, image_size(scan.channel.sensor), empty)
