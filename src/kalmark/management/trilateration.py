"""Landmarks from ranges alone, delayed: ranges are kept with the places they were taken from until a position follows.

The places are blocks of the map, so that they are corrected with everything else and their errors are correlated as
they are.  The position l minimises the chi-square of all ranges kept, y_i = h(l - s_i), whose errors are those of the
places s, of the sensor's own parameters and of the ranges, marginalised: Sigma = H_s P H_s' + R.  The search starts in
every direction; it is answered when one minimum alone is left and is as Gaussian as its covariance says.  Then the
landmark is a function of the map, l = g(s, y), and enters as any other does.  [S] (32)-(38); docs/range_only.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.errors import ModelError
from kalmark.events import Id, Scan
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.geometry.spaces import POINT2
from kalmark.models.observe import composed
from kalmark.report import Observation

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam
    from kalmark.tracks.scene import View

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

STEPS = 25  # of a search,
SETTLED = 1e-7  # which is over when they are shorter, m
OUTLIER = 0.9999  # a set of ranges that fits worse than this probability has one that is wrong
BULGE = 0.03  # how far a circle may leave its tangent within a sigma of the position, in sigmas of the range
OUT = 3.0  # sigmas from the minimum at which its shape is looked at,
AROUND = 2 * np.pi * np.arange(24) / 24  # in these directions (0: the longest axis),
SHAPE = 2.0  # and by how much less the likelihood may fall off there than a Gaussian's, OUT^2


class Kept(NamedTuple):
    """A range, its variance, and the block of the place it was taken from.

    `varies`: the variance is that of a range like it; the distance that it comes from will tell it.
    """

    slot: int
    y: float
    variance: float
    varies: bool = False


@dataclass
class Ranges:
    """The ranges kept of one landmark, none nearer to the one before than `spacing` metres."""

    robot: str
    sensor: str
    spacing: float
    kept: list[Kept] = field(default_factory=list)


class Fits(NamedTuple):
    """How J positions l (J, 2) fit n ranges: `cost` = -2 log likelihood and chi-square (J,), residuals z (J, n).

    `H` (J, n, 2) is with respect to the position, `H_x` (J, n, .) to what the map has of sensor and places, `inverse`
    (J, n, n) that of the covariance, and `R` (J, n) the ranges' variances, as the position would have them.
    """

    l: Array
    cost: Array
    chi2: Array
    z: Array
    H: Array
    H_x: Array
    inverse: Array
    R: Array

    def only(self, which: Any) -> Fits:
        """Return some of them."""
        return Fits(*(each[which] for each in self))


@dataclass(frozen=True)
class Trilateration:
    """Keep ranges until the position that they tell is beyond doubt, then start a point.

    `poses` is the number of ranges kept of a landmark: of more, every other one is given up.  The search starts in
    `directions` directions; a second answer whose odds are above `odds` means to wait.
    """

    poses: int = 24
    directions: int = 12
    odds: float = 1e-3

    def __post_init__(self) -> None:
        for name, least in (("poses", 4), ("directions", 3)):
            value = getattr(self, name)
            if type(value) is not int or value < least:
                raise ModelError(f"Trilateration: {name} is {value!r}, expected a whole number of at least {least}")
        if not 0 < self.odds < 1:
            raise ModelError(f"Trilateration: odds is {self.odds!r}, expected a number between 0 and 1")

    def observe(self, slam: Slam, view: View, event: Scan, k: int, id_: Id | None, name: Id, R: Array) -> Observation:
        """Take a range of a landmark that is not in the map yet: keep it, and start the landmark if that is enough.

        Raises MapError, the range not kept or the landmark not started, where the map is full.
        """
        unlocated = slam.members.unlocated
        known = unlocated.get(name)
        here = view.pose(slam.map, slam.members.slots[event.robot])[:2]
        if not isinstance(known, Ranges) or (known.robot, known.sensor) != (event.robot, event.sensor):
            if known is not None:
                return Observation(k, id_, "ignored", None, None, "another sensor's ranges of it are being kept")
            known = Ranges(event.robot, event.sensor, math.sqrt(R[0, 0]))
        elif np.linalg.norm(here - slam.map.mean(known.kept[-1].slot)) < known.spacing:
            why = f"within {known.spacing:.2f} m of where the last range kept was taken"
            return Observation(k, id_, "deferred", None, None, why)
        varies = view.noise_at is not None and event.cov is None
        known.kept.append(Kept(_place(slam, view, event), float(event.y[k, 0]), float(R[0, 0]), varies))
        unlocated[name] = known
        found = self._answer(slam, view, known) if len(known.kept) > 2 else "it takes three ranges to tell"
        if isinstance(found, str):
            self._thin(slam, known)
            return Observation(k, id_, "deferred", None, None, found)
        slot = slam.map.augment(POINT2, *found)
        count = len(known.kept)
        del unlocated[name]
        _release(slam, known.kept)
        slam.members.start(name, slot, view.landmark)
        slam.members.seen[name] = count
        return Observation(k, id_, "new", name, None, f"from {count} ranges")

    def _thin(self, slam: Slam, known: Ranges) -> None:
        """Give up every other range when there are too many: they span the same ground."""
        if len(known.kept) >= self.poses:
            known.kept, gone = known.kept[::2], known.kept[1::2]
            known.spacing *= 2
            _release(slam, gone)

    def _answer(self, slam: Slam, view: View, known: Ranges) -> str | tuple[Array, Index, Array, Array]:
        """Return the landmark, the rows it depends on, G and Q; or why there is none yet."""
        index, S, fit, places = _problem(slam, view, known.kept)
        distance = float(view.calibrated(slam.map).distances(np.array([[known.kept[0].y]]))[0])
        heading = view.pose(slam.map, slam.members.slots[known.robot])[2]  # whatever it is, it turns with the world
        angles = heading + 2 * np.pi * np.arange(self.directions) / self.directions
        minima = _search(fit, places[0] + distance * np.column_stack([np.cos(angles), np.sin(angles)]))
        best = minima.only(int(np.argmin(minima.cost)))
        if best.chi2 > chi2_gate(OUTLIER, max(1, len(known.kept) - 2)):
            worst = known.kept.pop(int(np.argmax((best.inverse @ best.z) ** 2 / np.diag(best.inverse))))
            _release(slam, [worst])
            return f"a range of {worst.y:.2f} m does not fit the others and is left out"
        information = best.H.T @ best.inverse @ best.H
        bent = len(index) > 2 * len(known.kept) or any(each.varies for each in known.kept)
        if not (_flat(best, S, places) and _gaussian(fit, best, information, bent)):
            return f"{len(known.kept)} ranges do not tell yet where it is"
        gaps = minima.l - best.l
        apart = np.einsum("ji,ik,jk->j", gaps, information, gaps) > 1.0
        if (apart & (minima.cost - best.cost < -2 * math.log(self.odds))).any():
            return f"{len(known.kept)} ranges fit two positions"
        W = np.linalg.solve(information, best.H.T @ best.inverse)
        return best.l, index, -W @ best.H_x, (W * best.R) @ W.T


def _place(slam: Slam, view: View, event: Scan) -> int:
    """Return the block of where the sensor is now: one for all that it sees in this scan."""
    members = slam.members
    map_, robot = slam.map, members.slots[event.robot]
    if members.here is not None and members.here[:3] == (event.robot, event.sensor, event.t_ns):
        return members.here[3]
    head, size = view.head(map_, robot), len(view.at)
    T, T_r, T_s = composed(head[:size], head[size : 2 * size] if view.mount >= 0 else view.at)
    index = view.head_index(map_, robot)
    G = np.zeros((2, len(index)))
    G[:, :3] = T_r[:2]
    if view.mount >= 0:
        G[:, 3:6] = T_s[:2]
    slot = map_.augment(POINT2, T[:2].copy(), index, slam.estimator.pose_jacobian(map_, robot, G), np.zeros((2, 2)))
    members.here = (event.robot, event.sensor, event.t_ns, slot)
    return slot


def _release(slam: Slam, gone: list[Kept]) -> None:
    """Remove the places that no range needs any more."""
    needed = {each.slot for known in slam.members.unlocated.values() for each in getattr(known, "kept", ())}
    for slot in dict.fromkeys(each.slot for each in gone):
        if slot not in needed:
            slam.map.remove(slot)
            if slam.members.here is not None and slam.members.here[3] == slot:
                slam.members.here = None


def _problem(slam: Slam, view: View, kept: list[Kept]) -> tuple[Index, Array, Callable[[Array], Fits], Array]:
    """Return the rows of the map that ranges depend on and their covariance, how positions (J, 2) fit, the places."""
    map_, sensor, n = slam.map, view.calibrated(slam.map), len(kept)
    slots = [each.slot for each in kept]
    places = np.array([map_.mean(slot) for slot in slots])
    own = len(map_.mean(view.mount)) - len(view.at) if view.mount >= 0 else 0
    blocks = [view.mount, *slots] if own else slots
    for _ in range(2):  # to ask for a block may move those asked for before
        index = np.concatenate([map_.index(slot) for slot in blocks])
    S, first, rows = map_.covariance(blocks), len(index) - 2 * n, np.arange(n)
    y, variance, varies = (np.array(column) for column in list(zip(*kept, strict=True))[1:])

    def fit(l: Array) -> Fits:
        v = (l[:, None] - places).reshape(-1, 2)
        e, E_v = sensor.expect(v)
        H, H_x = E_v.reshape(-1, n, 2), np.zeros((len(l), n, len(index)))
        for axis in range(2):
            H_x[:, rows, first + 2 * rows + axis] = -H[:, :, axis]
        if own:
            H_x[:, :, first - own : first] = sensor.parameters_jacobian(v).reshape(-1, n, own)
        R = np.where(varies, sensor.range_variance(e).reshape(-1, n), variance)
        Sigma = H_x @ S @ H_x.transpose(0, 2, 1) + R[:, :, None] * np.eye(n)
        z, inverse = y - e.reshape(-1, n), np.asarray(np.linalg.inv(Sigma), dtype=np.float64)
        chi2 = np.einsum("ji,jik,jk->j", z, inverse, z)
        return Fits(l, chi2 + np.linalg.slogdet(Sigma)[1], chi2, z, H, H_x, inverse, R)

    return index, S, fit, places


def _search(fit: Callable[[Array], Fits], starts: Array) -> Fits:
    """Return the minima (J, 2) that positions come to by Levenberg's and Marquardt's steps."""
    now, damping = fit(starts), np.full(len(starts), 1e-3)
    for _ in range(STEPS):
        J = now.H.transpose(0, 2, 1) @ now.inverse
        A = J @ now.H
        A[:, [0, 1], [0, 1]] *= 1 + damping[:, None]
        A[:, [0, 1], [0, 1]] += 1e-12
        step = np.linalg.solve(A, J @ now.z[:, :, None])[:, :, 0]
        new = fit(now.l + step)
        better = np.einsum("ji,jik,jk->j", new.z, now.inverse, new.z) < now.chi2  # Sigma as it was
        damping = np.where(better, 0.1 * damping, 10 * damping)
        now = Fits(*(np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(new, now, strict=True)))
        if (np.abs(step).max(axis=1) < SETTLED).all():
            break
    return now


def _flat(best: Fits, S: Array, places: Array) -> bool:
    """Return whether circles are as good as straight within a sigma of the position, as seen from the places.

    What all places have in common does not bend a circle: the position is taken relative to them, its errors those of
    the ranges and of the sensor's parameters alone, S (., .) being the covariance of sensor and places.
    """
    own = len(S) - 2 * len(places)
    H_x = best.H_x[:, :own]
    information = best.H.T @ np.linalg.solve(H_x @ S[:own, :own] @ H_x.T + np.diag(best.R), best.H)
    values = np.linalg.eigvalsh(information)
    if not np.isfinite(values).all() or values[0] <= 0:
        return False
    bulge = 0.5 / values[0] / np.hypot(*(best.l - places).T)
    return bool(np.median(bulge / np.sqrt(best.R)) < BULGE)


def _gaussian(fit: Callable[[Array], Fits], best: Fits, information: Array, bent: bool) -> bool:
    """Return whether the likelihood falls off at least as that of a Gaussian does.

    A scale that is not known, and noise that grows with the range, make valleys that are `bent`: they leave the longest
    axis and are found beside it only.
    """
    values, vectors = np.linalg.eigh(information)
    angles = AROUND if bent else AROUND[[0, len(AROUND) // 2]]
    steps = OUT * np.column_stack([np.cos(angles), np.sin(angles)]) / np.sqrt(values)
    return bool((fit(best.l + steps @ vectors.T).cost - best.cost > OUT**2 - SHAPE).all())
