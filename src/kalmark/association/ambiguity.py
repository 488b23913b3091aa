"""Is a pairing beyond doubt?  What it gains over the chance that another landmark stands there, and over its rival.

A pair of an observation and a landmark, or of two landmarks that may be one, says by its innovation z how likely it is:
N(z; 0, Z).  Had they nothing to do with each other, something would stand there by chance, with the density of
landmarks in the map.  The logarithm of the quotient is what the pair *gains*; of pairs that depend on each other, given
those before.  A first pair with a landmark long unseen gains little or nothing, because the pose is uncertain against
it; a second one beside it, much, because it must fit the first.  So what closes a loop is decided by all its pairs
together, and held back until they suffice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.association.protocol import DEFERRED, Decision
from kalmark.events import Id

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam
    from kalmark.tracks.scene import Scene, View

Array = npt.NDArray[np.float64]

CROWD = 4  # neighbours by whose distance the density of landmarks is told
LEAST_M = 0.1  # they are not taken to stand closer than this
LOOSE = math.log(10.0)  # a pair whose place is so much smaller than what a landmark has to itself needs no other


def density(slam: Slam, names: Sequence[Id], sensor: Array, d: int) -> float:
    """Return how many landmarks there are per m^2 (d = 2) or m^3 about some of them, seen from where the sensor is.

    Told by those that were seen in one scan with each: only they are certainly others.  One that was always alone has
    all the space to itself from which it was seen.
    """
    members, told = slam.members, []
    for name in names:
        others = [n for n in members.together.get(name, ()) if n != name and n in members.kinds]
        p = slam.map.means(members.slots_of([name, *others]), d)
        gaps = np.sort(np.linalg.norm(p[1:] - p[0], axis=1))[:CROWD]
        reach = gaps[-1] if len(gaps) else np.linalg.norm(p[0] - sensor[:d])
        told.append(max(len(gaps), 1) / max(float(reach), LEAST_M) ** d)
    return float(np.median(told)) / (math.pi if d == 2 else 4 / 3 * math.pi)


class Gains(NamedTuple):
    """An order of M pairs, what each gains in it (M,), given those before it, and that but for its d2."""

    order: list[int]
    gain: Array
    room: Array

    @property
    def total(self) -> float:
        """What all of them gain together."""
        return float(self.gain.sum())


def gains(z: Array, Z: Array, chance: Array, given: int = 0) -> Gains:
    """Return what M pairs gain, innovations z (M, p) with covariance Z (M p, M p), the one that gains most first.

    `chance` (M,) is the logarithm of the density of landmarks in the coordinates of z.  The first `given` are taken as
    they are.
    """
    count, p = z.shape
    place = chance + 0.5 * p * math.log(2 * math.pi)
    S, v = Z.copy(), z.copy()
    order: list[int] = []
    told, room, left = [], [], list(range(count))
    while left:
        some = left if len(order) >= given else left[:1]
        blocks = np.array([S[i * p : (i + 1) * p, i * p : (i + 1) * p] for i in some])
        d2 = np.einsum("ka,ka->k", v[some], np.linalg.solve(blocks, v[some][..., None])[..., 0])
        gain = -0.5 * d2 - 0.5 * np.linalg.slogdet(blocks)[1] - place[some]
        best = int(np.argmax(gain))
        room.append(float(gain[best] + 0.5 * d2[best]))
        i = some[best]
        order.append(i)
        told.append(float(gain[best]))
        left.remove(i)
        K = np.linalg.solve(blocks[best], S[i * p : (i + 1) * p]).T
        v -= (K @ v[i]).reshape(count, p)
        S -= K @ S[i * p : (i + 1) * p]
    return Gains(order, np.array(told), np.array(room))


def doubtful(found: Gains, given: int, odds: float) -> list[int]:
    """Return the pairs that are not beyond doubt.

    Where the place of a pair leaves room for others a group begins, which ends before the next such pair: beyond doubt
    if all of it together is so many times likelier than chance, and if it is more than what contradicts it.
    """
    out: list[int] = []
    starts = [i for i in range(given, len(found.order)) if min(found.room[i], found.gain[i] + LOOSE) < LOOSE]
    for start, end in reversed(list(pairwise([*starts, len(found.order)]))):
        if found.gain[start:end].sum() < math.log(odds) or end - start <= len(out):
            out += found.order[start:end]
    return out


def associate(slam: Slam, view: View, scene: Scene) -> list[Decision]:
    """Return what the association decides, but for the pairs that are not beyond doubt, which are held back.

    Only with `Upkeep.hold_back`, and only of associations that do not weigh matchings themselves.  Observations with
    ids are trusted.
    """
    decisions = view.association.associate(scene)
    if not view.upkeep.hold_back or getattr(view.association, "weighs", False):
        return decisions
    known = slam.members.kinds
    mine = [k for k, (name, _) in enumerate(decisions) if scene.ids[k] is None and name in known]
    if not mine or not view.tells_places:
        return decisions
    sensor: Any = view.sensor
    V_y = sensor.invert(scene.y)[1]
    if V_y.shape[1] != V_y.shape[2]:
        return decisions
    sure = [k for k, (name, _) in enumerate(decisions) if scene.ids[k] is not None and name in known]
    rows = np.array([*sure, *mine])
    names: list[Any] = [decisions[k][0] for k in rows]
    z, Z = scene.jointly(rows, names)
    here = view.pose(slam.map, slam.members.slots[scene.robot])
    chance = math.log(density(slam, names, here, 2 if len(view.at) == 3 else 3)) + np.linalg.slogdet(V_y[rows])[1]
    found = gains(z, Z, chance, len(sure))
    held = doubtful(found, len(sure), view.upkeep.odds)
    if not held:
        return decisions
    out = list(decisions)
    at = dict(zip(found.order, found.gain.tolist(), strict=True))
    for i in held:
        out[rows[i]] = (DEFERRED, f"{names[i]!r} or a new landmark: the odds are {math.exp(min(at[i], 50.0)):.2g} to 1")
    return out
