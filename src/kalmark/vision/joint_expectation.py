"""The joint expectation of the measurements of all landmarks in view: mutual information of one with the others.

With the Jacobians H of all expectations e and the joint covariance P of what they depend on, S = H P H' is what the
expectations are uncertain by together, C = P H'.  A measurement y of one of them, with noise R, changes all others:

    d <- d + C_i Z^-1 (y - e_i),   C <- C - C_i Z^-1 S_i,   S <- S - S_i' Z^-1 S_i,   Z = S_ii + R.

So a search for landmarks in an image can use what it has found already, without touching the map (Davison 2005).  The
expectations are projected again from the mean moved by d: a turn of the camera is not linear over an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import compiled
from kalmark.events import Id
from kalmark.filter.map import Map
from kalmark.filter.observed_block import observed_block
from kalmark.geometry.spaces import NO_TURN, Table, retract
from kalmark.models.observe import linearize
from kalmark.tracks.channel import Channel, ObservationModel, landmarks_in_frame
from kalmark.tracks.track import Tracks

PIXEL = 2  # numbers of a measurement that are searched for: the first ones, the place in the image
LEAST_RHO = 1e-3  # 1/m: a point of unknown depth is looked at as if it were so far away at most


class _Group(NamedTuple):
    """Landmarks of one model: their rows among all, the block of head and landmarks, and where it is in d."""

    model: ObservationModel
    rows: Index
    mean: Array
    table: Table
    at: Index
    known: Array | None


@dataclass(frozen=True, eq=False)
class Belief:
    """Density of the landmarks in view after some measurements: e (K, m), joint S (m K, m K), C and d.

    A measurement has m numbers; those made of some landmarks are `PIXEL`s, the first two of them.
    """

    e: Array
    S: Array
    C: Array
    d: Array

    @property
    def pixels(self) -> Array:
        """Expected pixels (K, 2) of the landmarks."""
        return self.e[:, :PIXEL]


class Prospect:
    """The landmarks in view of a robot's sensor: their `names`, the sensor's pose `T`, their `places` (K, 3)."""

    def __init__(self, map_: Map, tracks: Tracks, channel: Channel, robot: str) -> None:
        self.channel, slot = channel, tracks.slots[robot]
        self.T = channel.pose(map_, slot)
        self.sensor = channel.calibrated(map_)
        self.names: list[Id] = []
        found = [(model, *self._in_view(map_, tracks, model, names)) for model, names in self._sorted(tracks)]
        slots = np.concatenate([np.zeros(0, np.int64), *(s for _, s, l in found if l is None)])
        kept, here, second, at = map_.marginal(slot, channel.second(slot), slots)
        head_mean = channel.head(map_, slot)
        head = observed_block(kept.x, kept.blocks, kept.atoms, here, second, slots[:0], 0)
        self._groups: list[_Group] = []
        rows, m, widest = [head[0]], len(channel.sensor.columns), max((model.d for model, _, _ in found), default=0)
        h, done, first, taken = len(head[0]), 0, 0, len(head[0])
        none, no_places = np.zeros(0, np.int64), np.zeros((0, 3))
        parts = [(np.zeros((0, m)), np.zeros((0, m, h)), np.zeros((0, m, widest)), none, none, no_places)]
        for model, some, known in found:
            k = len(some)
            if known is None:
                index, table, mean = observed_block(
                    kept.x, kept.blocks, kept.atoms, here, second, at[done : done + k], model.d
                )
                own, done = index[h:], done + k
                l = mean[len(head_mean) :].reshape(k, model.d)
            else:
                own, table, mean, l = none, head[1], head_mean, known
            where = np.concatenate([np.arange(h), np.arange(taken, taken + len(own))])
            self._groups.append(_Group(model, np.arange(first, first + k), mean, table, where, known))
            e, _, E_h, E_l = self._linearized(model, mean[: len(head_mean)], l)
            size, E = len(own) // max(k, 1), np.zeros((k, m, widest))
            E[:, :, :size] = E_l[:, :, :size]
            parts.append((e, E_h, E, np.arange(k) * size + taken, np.full(k, size), _places(model, l)))
            rows.append(own)
            first, taken = first + k, taken + len(own)
        e, E_h, E_l, begins, widths, self.places = map(np.concatenate, zip(*parts, strict=True))
        self.R = np.array(channel.sensor.noise(e)) if len(e) else np.zeros((0, m, m))
        index = np.concatenate(rows)
        C, S = joint(kept.P, index, E_h, E_l, begins, widths)
        self.belief = Belief(e, S, C, np.zeros(len(index)))

    def __len__(self) -> int:
        return len(self.names)

    def _sorted(self, tracks: Tracks) -> list[tuple[ObservationModel, list[Id]]]:
        names = tracks.observable(self.channel)
        groups = [(model, [names[i] for i in rows]) for model, rows in tracks.by_model(self.channel, names)]
        known = [*tracks.known]
        return groups + [
            (model, [known[i] for i in rows]) for model, rows in tracks.known_by_model(self.channel, known)
        ]

    def _in_view(
        self, map_: Map, tracks: Tracks, model: ObservationModel, names: list[Id]
    ) -> tuple[Index, Array | None]:
        """Enter the names in view; return their slots (k,) and, of landmarks known exactly, where they are (k, n)."""
        exactly = names[0] in tracks.known
        slots = np.zeros(len(names), np.int64) if exactly else tracks.slots_of(names)
        l = tracks.known.means(names, model.d) if exactly else map_.means(slots, model.d)
        seen = np.flatnonzero(self.sensor.sees(landmarks_in_frame(model.landmark, self.T, l)))
        self.names += [names[i] for i in seen.tolist()]
        return slots[seen], l[seen] if exactly else None

    def _linearized(self, model: ObservationModel, head: Array, l: Array) -> tuple[Array, Array, Array, Array]:
        y = np.zeros((len(l), len(self.channel.sensor.columns)))
        return linearize(model.model, np.ascontiguousarray(head), np.ascontiguousarray(l), y)

    # ------------------------------------------------------------------ corrections by measurements
    def innovations(self, belief: Belief, rows: Index) -> Array:
        """Return the covariances Z (k, 2, 2) of the innovations of some landmarks' pixels, each by itself."""
        return self.whole_innovations(belief, rows)[:, :PIXEL, :PIXEL]

    def whole_innovations(self, belief: Belief, rows: Index) -> Array:
        """Return the covariances Z (k, m, m) of the innovations of some landmarks, each by itself."""
        k, p = belief.e.shape
        blocks = belief.S.reshape(k, p, k, p)
        return blocks[rows, :, rows, :] + self.R[rows]

    def moved(self, belief: Belief, rows: Sequence[int] | Index, y: Array) -> Array:
        """Return d (N,) after measurements y (k, 2) of some landmarks."""
        C = belief.C[:, _of_pixels(belief, rows)]
        K = np.linalg.solve(self._innovation(belief, rows), C.T).T
        return np.asarray(belief.d + K @ (y - belief.pixels[rows]).ravel(), dtype=np.float64)

    def expected(self, d: Array) -> Array:
        """Return what is expected (K, m) of all landmarks from the mean moved by d (N,)."""
        e = np.empty_like(self.belief.e)
        for model, rows, mean, table, at, known in self._groups:
            if not len(rows):
                continue
            x = mean.copy()
            retract(table, x, np.ascontiguousarray(d[at]), NO_TURN)
            head = len(x) if known is not None else len(x) - model.d * len(rows)
            l = x[head:].reshape(len(rows), model.d) if known is None else known
            e[rows] = self._linearized(model, x[:head], l)[0]
        return e

    def after(self, belief: Belief, rows: Sequence[int] | Index, y: Array) -> Belief:
        """Return the density after measurements y (k, 2) of some landmarks."""
        flat, d = _of_pixels(belief, rows), self.moved(belief, rows, y)
        S_i = belief.S[flat]
        G = np.linalg.solve(self._innovation(belief, rows), S_i)
        return Belief(self.expected(d), belief.S - S_i.T @ G, belief.C - belief.C[:, flat] @ G, d)

    def _innovation(self, belief: Belief, rows: Sequence[int] | Index) -> Array:
        flat, p = _of_pixels(belief, rows), PIXEL
        Z: Array = belief.S[np.ix_(flat, flat)]
        for k, i in enumerate(rows):
            Z[p * k : p * k + p, p * k : p * k + p] += self.R[i, :p, :p]
        return Z


def _of_pixels(belief: Belief, rows: Sequence[int] | Index) -> Index:
    """Return the rows of S (2 k,) of the pixels of some landmarks."""
    flat: Index = (belief.e.shape[1] * np.asarray(rows)[:, None] + np.arange(PIXEL)).ravel()
    return flat


def _places(model: ObservationModel, l: Array) -> Array:
    """Return where landmarks l (K, n) are (K, 3), those at unknown depth not infinitely far."""
    if model.d > 3:
        l = l.copy()
        l[:, -1] = np.maximum(l[:, -1], LEAST_RHO)
    return model.landmark.to_point(l)[0]  # type: ignore[attr-defined]


def places_of(map_: Map, tracks: Tracks, channel: Channel, names: list[Id]) -> Array:
    """Return where landmarks of a channel are (K, 3), NaN of those that it does not observe."""
    places = np.full((len(names), 3), np.nan)
    for model, rows in tracks.by_model(channel, names):
        places[rows] = _places(model, map_.means(tracks.slots_of([names[i] for i in rows]), model.d))
    return places


@compiled
def product(E_h: Array, E_l: Array, v: Array, first: int) -> float:
    """Return the product of a row of Jacobians, of the head (h,) and of the block from `first` on, with v (N,)."""
    s = 0.0
    for c in range(len(E_h)):
        s += E_h[c] * v[c]
    for c in range(len(E_l)):
        s += E_l[c] * v[first + c]
    return s


@compiled
def joint(P: Array, rows: Index, E_h: Array, E_l: Array, at: Index, width: Index) -> tuple[Array, Array]:
    """Return C = P H' (N, K p) and S = H C (K p, K p) of expectations of the head and of one landmark each."""
    (k, p, _), N = E_h.shape, len(rows)
    C, S = np.zeros((N, k * p)), np.zeros((k * p, k * p))
    row = np.empty(N)
    for r in range(N):
        i = rows[r]
        for c in range(N):
            j = rows[c]
            row[c] = P[max(i, j), min(i, j)]
        for o in range(k):
            first = at[o]
            for a in range(p):
                C[r, o * p + a] = product(E_h[o, a], E_l[o, a, : width[o]], row, first)
    for o in range(k):
        first = at[o]
        for a in range(p):
            for j in range(k * p):
                S[o * p + a, j] = product(E_h[o, a], E_l[o, a, : width[o]], C[:, j], first)
    return C, S
