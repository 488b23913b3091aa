"""Start of a robot by its true poses, moved back by its controls where they begin after its log."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.geometry.pose_frames import FRAMES
from kalmark.logs.log import Log, begins_at
from kalmark.models.protocols import Motion, coasts


def true_start(log: Log, name: str, motion: Motion) -> tuple[Array | None, Array | None]:
    """Return the true pose (3,) or (7,) of a robot when its first event begins, and its covariance; None of none.

    Where the truth begins later, the first true pose T is moved back by the motion D of the controls:
    T D^-1, with the covariance of D by the noise of the motion.  A robot whose velocity is in its state has no such
    controls.
    """
    held = motion.held or coasts(motion)
    truth, begin = log.truth.get(name), begins_at(log.events, name, held)
    if truth is None or begin is None or len(truth.poses[0]) != motion.space.pose.size:
        return None, None
    if np.isfinite(pose := truth.at(begin)).all():
        return pose, None
    later = truth.t_ns[truth.t_ns > begin]
    size = len(pose)
    if coasts(motion) or motion.space.size != size or not len(later):
        return None, None
    in_plane: Any = FRAMES[size]
    D, P = np.append(np.zeros(size - 1), float(size == 7)), np.zeros((motion.space.dof,) * 2)
    here, end_ns = D.copy(), int(later[0]) if motion.held else begin
    for u, N, dt_s, t_ns in pieces(log, name, motion, begin, int(later[0])):
        D, D_d, D_u = motion.move(D, u, dt_s)
        P = D_d @ P @ D_d.T + D_u @ N @ D_u.T
        if (Q := motion.diffusion(u, dt_s)) is not None:
            turned = in_plane.compose(D, here)[2]
            P += turned @ Q @ turned.T
        end_ns = t_ns
    back, b_d = in_plane.inverse(D)
    start, _, s_b = in_plane.compose(true := truth.at(end_ns), back)
    if np.isnan(true).any():
        return None, None
    J = s_b @ b_d
    return start, J @ P @ J.T


def pieces(
    log: Log, name: str, motion: Motion, begin_ns: int, first_ns: int
) -> Iterator[tuple[Array, Array, float, int]]:
    """Yield the controls from the beginning to the first true pose: u, its noise, for how long (s) and until when (ns).

    A held control ends there; increments end at the first of their ends from there on.
    """
    controls = log.controls_of(name)
    last_ns = begin_ns
    for k, control in enumerate(controls):
        N = motion.control_noise(control.u) if control.cov is None else control.cov
        if motion.held:
            until = first_ns if k + 1 == len(controls) else min(controls[k + 1].t_ns, first_ns)
            if control.t_ns < first_ns:
                yield control.u, N, (until - control.t_ns) * 1e-9, until
        elif last_ns < first_ns:
            yield control.u, N * control.share, (control.t_ns - last_ns) * 1e-9, control.t_ns
            last_ns = control.t_ns
