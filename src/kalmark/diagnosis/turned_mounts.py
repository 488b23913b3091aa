"""Sensors that were turned during a run: from some time on their direction differs from their mounts.

A turn of a mount is a systematic error that begins at some time.  The time is that of the largest score (Basseville,
Nikiforov 1993, section 2.4), looked for among stretches of the run, then within the best of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from kalmark.arrays import Array
from kalmark.batch.batch_state import LANDMARKS, POSES, BatchState
from kalmark.batch.problem import Factor
from kalmark.diagnosis.causes import LEAST_INFORMATION, SEEN, SHOWS, Finding, systematic
from kalmark.diagnosis.error_columns import Column
from kalmark.diagnosis.linear import Linear
from kalmark.geometry.rotations import matrix
from kalmark.models.observe import MOUNT, sensor_pose

TURNED = "mount"  # the cause
STRETCHES, ROUNDS = 20, 4  # in which the time is looked for, and how often within the best of them


def find_turned_mounts(linear: Linear, t_s: Array) -> list[Finding]:
    """Return of each sensor the turn of its mount, from some time on, that explains most.

    `t_s` (n,) are the times of the poses.  A turn that is smaller than the noise of a sighting is none: a calibration
    drifts.  `p` counts that the time was looked for.
    """
    found = []
    for f, factor in enumerate(linear.problem.factors):
        if not factor.sensor[1] or [b.group for b in factor.term.blocks] != [POSES, LANDMARKS]:
            continue
        seen_s = np.sort(t_s[factor.term.blocks[0].rows])[SEEN:-SEEN]
        best: tuple[float, float, Array] = 0.0, 0.0, np.zeros(0)
        for turn in _turns(linear, f, factor):
            gain, begin_s = _begins(linear, turn, t_s, seen_s)
            best = max(best, (gain, begin_s, turn), key=lambda one: one[0])
        gain, begin_s, turn = best
        if gain <= 0.0:
            continue
        Z = np.where(t_s[linear.rows.node] >= begin_s, turn, 0.0)
        column = Column(TURNED, factor.sensor, "rad", Z, np.zeros(len(linear.at.w)))
        for one in systematic(linear, [column]):
            shown = np.square(Z[Z != 0.0] * one.value)
            if float(shown.mean()) > SHOWS**2 and abs(one.value) < math.pi / 2:
                found.append(replace(one, p=min(1.0, len(seen_s) * one.p), since_s=begin_s))
    return found


def _turns(linear: Linear, f: int, factor: Factor) -> Iterator[Array]:
    """Yield the change of the data (N,) by one radian of a mount: about the axis of the plane or those of the robot."""
    E, factors = factor.term.at(linear.state)[1], linear.problem.factors
    for axis in _axes(linear.state, factor):
        parts = [np.zeros(other.R.shape[:2]) for other in factors]
        parts[f] = np.nan_to_num(np.einsum("kij,kj->ki", E[:, :, : axis.shape[1]], axis))
        yield linear.whitened(parts)


def _axes(state: BatchState, factor: Factor) -> Iterator[Array]:
    """Yield how a robot would move (K, dof), about its sensor, to see what the sensor sees if that turns."""
    block, mount = factor.term.blocks[0], factor.view[MOUNT] if isinstance(factor.view, tuple) else factor.view.mount
    poses = state.groups[POSES][block.rows]
    arm = poses[:, : state.d] - np.array([sensor_pose(pose, mount)[0][: state.d] for pose in poses])
    if state.d == 2:
        yield np.column_stack([-arm[:, 1], arm[:, 0], np.ones(len(poses))])
        return
    for axis in np.array([matrix(pose[3:]) for pose in poses]).transpose(2, 0, 1):
        yield np.column_stack([np.cross(axis, arm), axis])


def _begins(linear: Linear, turn: Array, t_s: Array, seen_s: Array) -> tuple[float, float]:
    """Return the gain of a turn of a mount from the best time on, and that time; 0 for none."""
    if len(seen_s) < STRETCHES:
        return 0.0, 0.0
    of_row, within, gain, begin_s = t_s[linear.rows.node], np.unique(seen_s), 0.0, 0.0
    for _ in range(ROUNDS):
        every = np.unique(np.linspace(0, len(within) - 1, STRETCHES).astype(np.int64))
        edges = within[every]
        stretch = np.searchsorted(edges, of_row, side="right") - 1
        Z = np.where(stretch[:, None] == np.arange(len(edges)), turn[:, None], 0.0)
        left = linear.left(Z, np.zeros((len(linear.at.w), len(edges)))).r
        g = np.cumsum((Z.T @ linear.residuals.r)[::-1])[::-1]
        I = np.cumsum(np.cumsum((Z.T @ left)[::-1, ::-1], axis=0), axis=1)[::-1, ::-1].diagonal()
        gains = np.where(LEAST_INFORMATION * (Z * Z).sum() < I, 0.5 * g * g / np.where(I > 0.0, I, 1.0), 0.0)
        at = int(np.argmax(gains))
        gain, begin_s = float(gains[at]), float(edges[at])
        if len(every) == len(within):
            break
        within = within[every[max(at - 1, 0)] : every[min(at + 1, len(every) - 1)] + 1]
    return gain, begin_s
