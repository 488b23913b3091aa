"""The sightings of tentative landmarks, kept with the poses from which they were made (`Upkeep.keep_poses`).

A tentative landmark must not pull the pose.  So a sighting is not fused; but it is kept, and the pose with it, as a
block of the map: a copy of the robot's, which goes along with every correction.  When the landmark is confirmed, its
sightings are fused from these poses, and waiting has cost nothing.  As in `delayed`, poses are removed when nothing
waits for them any more, and the oldest of too many with the sightings made there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.errors import MapError
from kalmark.events import Id, Scan
from kalmark.geometry.spaces import SCALAR, SE2, SE3, Space
from kalmark.management.merging import Difference
from kalmark.models.observe import linearize
from kalmark.report import Late

if TYPE_CHECKING:
    from kalmark.management.tentative import Tentative
    from kalmark.slam.slam import Slam
    from kalmark.tracks.scene import View

Array = npt.NDArray[np.float64]


class Kept(NamedTuple):
    """The k-th observation of a scan, its noise R (p, p), made from the kept pose number `at`; `scan` has it alone."""

    at: int
    k: int
    scan: Scan
    R: Array

    @property
    def late(self) -> Late:
        """Which observation of the log it is."""
        return self.scan.t_ns, self.scan.robot, self.scan.sensor, self.k


def keep(slam: Slam, view: View, event: Scan, seen: Mapping[int, Id], R: Array) -> None:
    """Keep the observations k of tentative landmarks, `seen` {k: name}, with the pose of now."""
    poses, most = view.waiting.poses, view.upkeep.keep_poses
    if not most or not seen or view.delayed is not None:
        return
    for number in list(poses)[: max(len(poses) - most + 1, 0)]:
        for t in slam.members.tentative.values():
            t.kept = [one for one in t.kept if one.at != number or _view(slam, one) is not view]
        slam.map.remove(poses.pop(number))
    robot, dof, space = slam.members.slots[event.robot], *((3, SE2) if len(view.at) == 3 else (6, SE3))
    mean, index = slam.map.mean(robot)[: len(view.at)], slam.map.index(robot)[:dof]
    try:
        slot = slam.map.augment(space, mean, index, np.eye(dof), np.zeros((dof, dof)))
    except MapError:  # it is full: these sightings are lost
        return
    view.waiting.numbered += 1
    poses[view.waiting.numbered] = slot
    for k, name in seen.items():
        cov = None if event.cov is None else R[k : k + 1]
        alone = Scan(t_ns=event.t_ns, robot=event.robot, sensor=event.sensor, y=event.y[k : k + 1], cov=cov)
        slam.members.tentative[name].kept.append(Kept(view.waiting.numbered, k, alone, R[k]))


def fuse(slam: Slam, view: View, robot: str, t: Tentative, name: Id) -> Iterator[Late]:
    """Fuse the sightings kept of a landmark that is tentative no more, and say which these were.

    What each expects less what it measured, e - y, becomes a block of the map; the robot of now sees that it is zero.
    The kept pose itself is no robot to the map.
    """
    for one in t.kept:
        try:
            slot, R = _residual(slam, one, t)
        except MapError:  # it is full
            return
        look, at, y = Difference(view.at, len(R)), slam.members.slots[robot], np.zeros((1, len(R)))
        done = slam.estimator.correct(slam.map, look, at, -1, np.array([slot]), len(R), y, R[None], view.gate)
        slam.refuse_sick(done.healthy, one.scan)
        slam.map.remove(slot)
        if done.fused[0]:
            slam.members.count([name])
            yield one.late


def _residual(slam: Slam, one: Kept, t: Tentative) -> tuple[int, Array]:
    """Make a block of e - y of a sighting; return its slot and the noise R (p, p) of y."""
    map_, view, slots = slam.map, _view(slam, one), np.array([t.slot])
    pose, look = view.waiting.poses[one.at], view.looks[t.kind.kind]
    R = view.noise(map_, pose, look, slots, one.R[None], one.scan)[0]
    l = map_.means(slots, look.d)
    _, z, E_h, E_l = linearize(look.view, view.head(map_, pose), l, one.scan.y)
    index = np.concatenate([view.head_index(map_, pose), map_.index(t.slot)])
    G = np.zeros((len(z[0]), len(index)))
    head = E_h.shape[2]
    G[:, :head] = slam.estimator.pose_jacobian(map_, pose, E_h[0])
    G[:, head : head + E_l.shape[2]] = E_l[0]
    space = Space("residual", (SCALAR,) * len(z[0]))
    return map_.augment(space, -z[0], index, G, np.zeros((len(z[0]),) * 2)), R


def forget(slam: Slam) -> None:
    """Remove the poses that nothing waits for any more."""
    used = {(id(_view(slam, one)), one.at) for t in slam.members.tentative.values() for one in t.kept}
    for view in slam._views.values():
        if view.upkeep.keep_poses and view.delayed is None:
            for number in [n for n in view.waiting.poses if (id(view), n) not in used]:
                slam.map.remove(view.waiting.poses.pop(number))


def _view(slam: Slam, one: Kept) -> View:
    return slam._views[one.scan.robot, one.scan.sensor]
