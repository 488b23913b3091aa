"""Two landmarks that turn out to be one: found by their joint covariance, constrained equal, and one of them removed.

What closes a loop late looks like this: the robot did not recognise the place and mapped it again.  Landmarks that were
never seen in one scan may be the same; which are is decided for all that were seen lately, at once, and only when it is
beyond doubt (`ambiguity.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from kalmark.association.ambiguity import density, gains
from kalmark.errors import MapError
from kalmark.events import Id
from kalmark.filter import kernels
from kalmark.filter.map import P_AT, P_SIZE, StochasticMap
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.geometry.spaces import SCALAR, VECTOR, VECTOR3, Space
from kalmark.report import Observation

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam
    from kalmark.tracks.scene import View

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

EVERY = 5  # sightings of a landmark, after which it is looked at again
NEAREST = 128  # landmarks near it, among which are those that it may be,
NEAR = 32  # and so many at first:
FEW = 3  # of these, by where they came to rest, tell how near the nearest is
COMPANY = 12  # landmarks seen lately, which must find their own as well
TRIES = 8  # of what it may be
WIDE = 1.5  # times the gate of the nearest it may be, within which all are that it may be
SLACK_M, SLACK_RAD = 0.3, 0.3  # by which the company may miss, and by which it may be turned
GATE = 0.99
EQUAL_M = 1e-4  # how equal two landmarks are made
LINEAR = (VECTOR, VECTOR3, SCALAR)  # atoms of which a difference is one


@dataclass(frozen=True, eq=False)
class Difference:
    """What is seen of a block that is the difference of two others: that it is zero."""

    mount: Array
    numbers: int

    def linearize(self, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Return e = l, z = y - e, E_h = 0 and E_l = 1."""
        count, n = l.shape
        E_l = np.tile(np.eye(n), (count, 1, 1))
        pose = 3 if len(self.mount) == 3 else 6
        return l.copy(), y - l, np.zeros((count, n, pose * (len(head) // len(self.mount)))), E_l


def note(slam: Slam, outcomes: Sequence[Observation]) -> list[Id]:
    """Note which landmarks were seen in one scan, and so are different; return those without an id in the log."""
    members = slam.members
    seen: list[Any] = [o.landmark for o in outcomes if o.outcome in ("associated", "new")]
    names = [name for name in seen if name in members.kinds]
    if names != members.last_seen:
        for name in names:
            members.together.setdefault(name, set()).update(names)
        members.lately = [name for name in members.lately if name not in names][-COMPANY:] + names
        members.last_seen = names
    unnamed: list[Any] = [o.landmark for o in outcomes if o.id is None]
    return [name for name in unnamed if name in names]


def merge(slam: Slam, view: View, robot: str, outcomes: Sequence[Observation]) -> Iterator[tuple[Id, Id, str]]:
    """Merge landmarks that are one beyond doubt; return each that is gone, the one it is now, and why."""
    members = slam.members
    mine = note(slam, outcomes)
    if not view.upkeep.merge:
        return
    again, kept = False, list[Id]()
    for name in mine:
        if name in members.kinds and (again or _is_due(slam, name)) and _fits(members.kinds[name].space):
            members.looked[name] = members.seen.get(name, 0), members.changes
            for merged in _merge_with(slam, view, robot, name):
                again = True  # now the others are known better to each other
                kept.append(merged[1])
                yield merged
    yield from _follow(slam, view, robot, kept)


def _is_due(slam: Slam, name: Id) -> bool:
    """Return whether to look at a landmark: where nothing has come or gone, only when seen twice as often."""
    seen, (before, changes) = slam.members.seen.get(name, 0), slam.members.looked.get(name, (0, -1))
    return seen % EVERY == 0 and (changes != slam.members.changes or seen >= 2 * before)


def _follow(slam: Slam, view: View, robot: str, merged: list[Id]) -> Iterator[tuple[Id, Id, str]]:
    """Look at what was seen with merged landmarks before the loop closed, each once, and merge it as well."""
    members, tried = slam.members, set(slam.members.lately)
    while merged:
        at = merged.pop(0)
        around = sorted((n for n in members.together.get(at, ()) if n not in tried), key=str)
        tried.update(around)
        for name in around:
            if name in members.kinds and _fits(members.kinds[name].space):
                for found in _merge_with(slam, view, robot, name):
                    merged.append(found[1])
                    yield found


def _fits(space: Space) -> bool:
    return all(kind in LINEAR for kind in space.kinds)


def _merge_with(slam: Slam, view: View, robot: str, name: Id) -> Iterator[tuple[Id, Id, str]]:
    """Merge a landmark, and others seen lately, with what they are, if that is beyond doubt.

    What it may be is tried one by one: the others, moved along, find their own.  Of those hypotheses for which most of
    them do, the one that gains most must gain more than chance and than any other that has nothing in common with it.
    """
    d = 2 if len(view.at) == 3 else 3
    tried = []
    for pairs in _hypotheses(slam, name, d):
        z, Z = _differences(slam, pairs)
        sensor = view.pose(slam.map, slam.members.slots[robot])
        chance = math.log(density(slam, [name], sensor, d))
        found = gains(z, Z, np.full(len(pairs), chance))
        best = int(np.argmax(np.cumsum(found.gain))) + 1
        d2 = 2.0 * float((found.room - found.gain)[:best].sum())
        if d2 <= chi2_gate(GATE, z.shape[1] * best):
            tried.append((float(found.gain[:best].sum()), [pairs[i] for i in found.order[:best]]))
    if not tried:
        return
    gain, chosen = max(tried, key=lambda each: each[0])
    rival = max((other for other, pairs in tried if not set(pairs) & set(chosen)), default=0.0)
    if gain - max(rival, 0.0) >= math.log(view.upkeep.odds):
        yield from _fuse(slam, view, robot, chosen, gain)


def _hypotheses(slam: Slam, name: Id, d: int) -> Iterator[list[tuple[Id, Id]]]:
    """Return what a landmark and others seen lately may be: lists of pairs, its own first."""
    members, together = slam.members, slam.members.together
    at = slam.mean(name)[:d]
    for count in (NEAR, NEAREST):  # most can be none of those nearby, and so of none
        others, possible = _others(slam, name, at, count)
        told = count == NEAREST or len(possible) >= FEW
        if told and (not possible or _is_out_of_reach(slam, name, [others[l] for l in possible[:FEW]], d)):
            return
    places = _places(slam, others, d)
    far = np.linalg.norm(places - at, axis=1)
    possible.sort(key=lambda l: far[l])
    reach = _reach(_differences(slam, [(name, others[possible[0]])])[1])
    possible = [l for l in possible if far[l] <= reach]
    if not possible:
        return
    company = _company(slam, name, d)
    mine = _places(slam, company, d)
    moved = mine[:, None] + (places[possible] - at)  # (C, L, d): the company, were the landmark the l-th that it may be
    gaps: Any = cKDTree(places).query(moved)
    found, nearest = gaps[0], gaps[1]
    given = {n for n in others if not members.made_up(n)}
    known = [together[c] | {c} | (given if not members.made_up(c) else set()) for c in company]
    apart = np.array([[o in different for o in others] for different in known], dtype=np.bool_)
    apart = apart.reshape(len(company), len(others))
    found[np.take_along_axis(apart, nearest, axis=1)] = np.inf
    slack = SLACK_M + SLACK_RAD * np.linalg.norm(mine - at, axis=1)[:, None]
    score = np.maximum(1.0 - found / slack, 0.0).sum(axis=0)
    for i in np.argsort(-score, kind="stable")[:TRIES].tolist():
        first = (name, others[possible[i]])
        z, Z = _differences(slam, [first])
        if z[0] @ np.linalg.solve(Z, z[0]) <= chi2_gate(GATE, len(Z)):
            pairs, used = [first], {*first}
            for c in np.argsort(found[:, i], kind="stable").tolist():
                pair = company[c], others[nearest[c, i]]
                if found[c, i] <= slack[c, 0] and used.isdisjoint(pair):
                    pairs.append(pair)
                    used |= {*pair}
            yield pairs


def _others(slam: Slam, name: Id, at: Array, count: int) -> tuple[list[Id], list[int]]:
    """Return the landmarks nearest to one that is `at` (2 or 3,), and the numbers of those that it may be."""
    members, together = slam.members, slam.members.together
    near = slam.nearby.around(slam, members.kinds[name].kind, at, count)
    others = [n for n in near if n in together and n != name]
    by_id = not members.made_up(name)  # two ids are two landmarks
    different = together[name]
    return others, [l for l, o in enumerate(others) if o not in different and (not by_id or members.made_up(o))]


def _company(slam: Slam, name: Id, d: int) -> list[Id]:
    """Return what must find its own if a landmark does: what was seen lately, or, if it was not, once, with it."""
    members, kinds = slam.members, slam.members.kinds
    lately = name in members.lately
    others = [n for n in (members.lately if lately else sorted(members.together[name], key=str)) if n != name]
    others = [n for n in others if n in members.together and n in kinds and kinds[n].kind == kinds[name].kind]
    if lately or len(others) <= COMPANY:
        return others
    far = np.linalg.norm(_places(slam, others, d) - slam.mean(name)[:d], axis=1)
    return [others[i] for i in np.argsort(far, kind="stable")[:COMPANY].tolist()]


def _places(slam: Slam, names: Sequence[Id], d: int) -> Array:
    """Return where landmarks are (N, d)."""
    return slam.map.means(slam.members.slots_of(names), d) if names else np.zeros((0, d))


def _reach(Z: Array) -> float:
    """Return within which distance a landmark may be another, Z (n, n) being that of the nearest that it may be."""
    return WIDE * math.sqrt(chi2_gate(GATE, len(Z)) * float(np.linalg.eigvalsh(Z)[-1]))


def _is_out_of_reach(slam: Slam, name: Id, others: Sequence[Id], d: int) -> bool:
    """Return whether a landmark can be none of some others."""
    m, here = _read(slam, [name, *others])
    l = m.means(here, d)
    far = np.linalg.norm(l[1:] - l[0], axis=1)
    i = int(np.argmin(far))
    P = m.covariance([here[0], here[1 + i]])
    n = len(P) // 2
    return bool(far[i] > _reach(P[:n, :n] + P[n:, n:] - P[:n, n:] - P[n:, :n] + EQUAL_M**2 * np.eye(n)))


def _read(slam: Slam, names: Sequence[Id]) -> tuple[StochasticMap, Index]:
    """Return a map to read landmarks from, and their slots (K,) there."""
    m, _, _, here = slam.map.excerpt(slam.members.slots[next(iter(slam.robots))], -1, slam.members.slots_of(names))
    return m, here


def _differences(slam: Slam, pairs: Sequence[tuple[Id, Id]]) -> tuple[Array, Array]:
    """Return the differences z (M, n) of pairs of landmarks and their joint covariance (M n, M n)."""
    names = list(dict.fromkeys(name for pair in pairs for name in pair))
    m, here = _read(slam, names)
    n = int(m.blocks[here[0], P_SIZE])
    P = kernels.submatrix(m.P, (m.blocks[here, P_AT][:, None] + np.arange(n)).ravel())
    at, rows = {name: i for i, name in enumerate(names)}, np.arange(len(pairs))
    of = np.zeros((len(pairs), len(names)))
    of[rows, [at[b] for _, b in pairs]] = 1.0
    of[rows, [at[a] for a, _ in pairs]] = -1.0
    J = (of[:, None, :, None] * np.eye(n)[:, None]).reshape(len(pairs) * n, -1)
    return of @ m.means(here, n), J @ P @ J.T + EQUAL_M**2 * np.eye(len(J))


def _fuse(
    slam: Slam, view: View, robot: str, pairs: Sequence[tuple[Id, Id]], gain: float
) -> Iterator[tuple[Id, Id, str]]:
    """Constrain pairs of landmarks to be equal, through the estimator, and remove one of each.

    Of an id of the log and a name made up the id stays, else the older one.  In a full map nothing is merged.
    """
    map_, members = slam.map, slam.members
    slots, space = [], members.kinds[pairs[0][0]].space
    for a, b in pairs:
        one, other = members.slots[a], members.slots[b]
        l, index = map_.mean(other) - map_.mean(one), np.concatenate([map_.index(one), map_.index(other)])
        n = len(index) // 2
        G = np.hstack([-np.eye(n), np.eye(n)])
        try:
            slots.append(map_.augment(Space("difference", space.kinds), l, index, G, np.zeros((n, n))))
        except MapError:
            for slot in slots:
                map_.remove(slot)
            return
    look: Any = Difference(view.at, space.size)
    y, R = np.zeros((len(pairs), space.size)), np.tile(EQUAL_M**2 * np.eye(space.size), (len(pairs), 1, 1))
    done = slam.estimator.correct(
        map_, look, members.slots[robot], view.mount, np.array(slots), space.size, y, R, math.inf
    )
    age = {name: i for i, name in enumerate(members.kinds)}
    for slot, (a, b), d2 in zip(slots, pairs, done.d2.tolist(), strict=True):
        map_.remove(slot)
        kept, gone = sorted((a, b), key=lambda name: (members.made_up(name), age[name]))
        members.seen[kept] = members.seen.get(kept, 0) + members.seen.get(gone, 0)
        for name in list(members.together.get(gone, ())):
            members.together.setdefault(name, set()).add(kept)
        members.together.setdefault(kept, set()).update(members.together.get(gone, ()))
        slam.remove(gone)
        others = f", with {len(pairs) - 1} others" if len(pairs) > 1 else ""
        yield gone, kept, f"merged into {kept!r}: d2 {d2:.1f}, e^{gain:.0f} times likelier than chance{others}"
