"""How a robot's motion moves the map: the prediction, with what of a control's error is a block of the map.

A control's error is white from one control to the next and needs no block.  Two kinds are not: that of a control whose
interval a scan has split, common to both parts until the next control; and the *bias*, common to all controls
(`sigma_v_bias_mps` and the like).  Both add to the control, the scans correct them like all else in the map.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import EventError, MapError
from kalmark.events import seconds
from kalmark.filter.kernels import moved_noise
from kalmark.geometry.spaces import Rn, Space
from kalmark.slam.motion import Part, body_axes

if TYPE_CHECKING:
    from kalmark.models.protocols import Motion
    from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]


def bias_name(robot: str) -> str:
    """Return the name of the bias of a robot's controls in the map."""
    return f"{robot} bias"


def bias_block(motion: Motion) -> tuple[Space, Array, Array] | None:
    """Return the space, the mean and the covariance of the bias of a motion's controls, None if it has none."""
    cov: Any = getattr(motion, "bias_cov", None)
    return None if cov is None else (Rn(len(cov)), np.zeros(len(cov)), cov)


def place_bias(slam: Slam, robot: str) -> None:
    """Enter the bias of a robot's controls into the map, if it has one."""
    block = bias_block(slam.robots[robot].motion)
    if block is not None:
        slam.members.slots[bias_name(robot)] = slam.map.add(*block)


def predict(slam: Slam, name: str, part: Part) -> None:
    """Move a robot by one part of its control: R <- f(R, u), P <- F P F' + Q.  [S] (14)-(17)."""
    map_, slot, motion = slam.map, slam.members.slots[name], slam.robots[name].motion
    error, bias = slam._errors.get(name), slam.members.slots.get(bias_name(name))
    added = [block for block in (error, bias) if block is not None]
    r, u = map_.mean(slot), sum((map_.mean(block) for block in added), start=part.u)
    moved, F, R_u = motion.move(r, u, part.dt_s)
    F = slam.estimator.pose_jacobian(map_, slot, F)
    Q, finite = moved_noise(moved, F, R_u, part.N)
    if not finite:
        what = f"{name!r} at t={seconds(slam.t_ns or 0)} s"
        raise EventError(f"{what}: u is {part.u.tolist()}, expected a control that moves it somewhere finite")
    if error is None and not (part.first and part.last) and part.N.any():
        try:
            slam._errors[name] = map_.add(Rn(len(u)), np.zeros(len(u)), part.N)
            added.append(slam._errors[name])
        except MapError:  # it is full: each part has an error of its own
            pass
    if name in slam._errors:
        Q = np.zeros_like(Q)
    index = map_.index(slot)
    if added:
        index, F, Q = np.concatenate([index, *map(map_.index, added)]), *_joined(F, Q, R_u, len(added))
    D = motion.diffusion(part.u, part.dt_s)
    if D is not None:
        G = body_axes(moved)
        Q[: len(G), : len(G)] += G @ D @ G.T
    map_.predict(index, F, Q)
    map_.set_predicted(slot, moved)


def _joined(F: Array, Q: Array, R_u: Array, count: int) -> tuple[Array, Array]:
    """Return F and Q of a robot together with `count` blocks that are added to its control and stay as they are."""
    n, k = R_u.shape
    whole, noise = np.eye(n + count * k), np.zeros((n + count * k,) * 2)
    whole[:n, :n], whole[:n, n:], noise[:n, :n] = F, np.tile(R_u, count), Q
    return whole, noise


def forget_error(slam: Slam, name: str) -> None:
    """Remove the error of a control that is no longer held."""
    error = slam._errors.pop(name, None)
    if error is not None:
        slam.map.remove(error)
