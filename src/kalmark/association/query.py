"""The questions of an association about a scan, answered from the map and the tracks."""

from __future__ import annotations

from zlib import crc32

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.association.matchings import Places
from kalmark.association.wall_segments import disjoint_from_walls
from kalmark.compiled import form_for
from kalmark.events import Id
from kalmark.filter import corrections, kernels
from kalmark.filter.known_marginal import append_known
from kalmark.filter.layout import P_AT
from kalmark.filter.map import Marginal, Pairs
from kalmark.filter.observed_block import add_blocks, observed_block
from kalmark.geometry.landmark_density import NEIGHBOURS, log_density, log_volume_change
from kalmark.models.observe import linearize
from kalmark.report import Compared
from kalmark.tracks.channel import ObservationModel
from kalmark.tracks.scan import ScanContext

AROUND = 64  # landmarks known exactly to be compared with what determines no place
LIMITS = 30, 1e-2  # linearisations of a matching, and the sigmas by which the last one moves anything


def log_volume_ratio(Z: Array, R: Array) -> Array:
    """Return log |Z| / |R| (M,): twice the information that a measurement gives."""
    return np.asarray(np.linalg.slogdet(Z)[1] - np.linalg.slogdet(R)[1])


class Query:
    """One scan before it is fused: the queries of an association about it.

    `reobserved` is the expected number of observations without ids that are of landmarks just seen.

    >>> class Nearest:
    ...     def threshold(self, m, default):
    ...         return default
    ...     def associate(self, query):
    ...         names = query.candidates()
    ...         d2 = query.distances(names)
    ...         print(names, d2.round(2))
    ...         return [(names[k], "the nearest one") for k in d2.argmin(axis=1)]
    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> slam = km.Slam(rover, association=Nearest())
    >>> slam.add_landmark(7, mean=(4.0, 1.0), cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24]]))
    [7] [[0.03]]
    """

    def __init__(self, scan: ScanContext) -> None:
        self.scan, self.ids, self.y = scan, scan.ids, scan.y
        self.reobserved = 0.0
        self._pairs: Pairs | None = None  # near each other, of the last query for candidates,
        self._names: list[Id] = []  # and the landmarks of these
        self._known = scan.tracks.known  # exactly, and outside the map

    def dof(self) -> int:
        """Return the size p of one innovation."""
        return self.scan.channel.dof

    def experience(self) -> float:
        """Return how many of the last observations without ids were of landmarks just seen."""
        return self.scan.tracks.experience

    def count_reobserved(self, again: float) -> None:
        """Set the expected number of observations without ids that are of landmarks just seen."""
        self.reobserved = float(again)

    def key(self) -> tuple[int, ...]:
        """Return numbers, at least 0, that differ from those of all other scans."""
        event = self.scan.event
        return event.t_ns % 2**63, crc32(event.robot.encode()), crc32(event.sensor.encode())

    # ------------------------------------------------------------------ one by one
    def candidates(self, nearest: int = 4, farther: float = 10.0) -> list[Id]:
        """Return the ids of the landmarks that this sensor could have observed where these observations seem to be.

        These are the `nearest` ones to each place within `farther` times the nearest distance.  A sensor whose
        measurements do not determine a place could have observed any.
        """
        scan, channel, tracks = self.scan, self.scan.channel, self.scan.tracks
        places = channel.places(scan.map, scan.robot, scan.y)
        if places is None:
            around = scan.pose()[None, : scan.dimensions]
            return tracks.observable(channel) + self._known.near(channel.models, around, AROUND)
        sorts = tracks.sorts_of(channel.kinds, len(scan.map.blocks))
        self._pairs = scan.map.pairs(sorts, scan.robot, channel.second(scan.robot), places, nearest, farther)
        self._names = [tracks.names[slot] for slot in self._pairs.slots.tolist()]
        if len(self._known):
            names = self._names + self._known.near(channel.models, places, nearest)
            read = self.read(names)
            at = read.map.means(read.slots, scan.dimensions)
            self._pairs = Pairs.of(np.arange(len(names)), at, read, places, nearest, farther)
            self._names = [names[i] for i in self._pairs.slots.tolist()]
        scan.report.seen_at = places
        return self._names.copy()

    def nearest(self, nearest: int, farther: float, gate: float) -> list[Id] | None:
        """Return the only landmark that each observation can be of: the nearest inside the gate on d2, of no other one.

        None of a scan in which that is not so of all, that has ids, or where the other queries are needed.
        """
        scan, channel, tracks = self.scan, self.scan.channel, self.scan.tracks
        model = tracks.only_model(channel)
        varied = channel.joins or scan.noise_varies or scan.reported is not None
        plain = scan.event.ids is None and not (tracks.tentative or self._known or varied)
        if model is None or not plain or not isinstance(model.model, tuple):
            return None
        p = channel.places(scan.map, scan.robot, scan.y)
        if p is None:
            return None
        sorts = tracks.sorts_of(channel.kinds, len(scan.map.blocks))
        seen = scan.robot, channel.second(scan.robot), model.d, self.y, scan.R
        found = scan.map.nearest(model.model, seen, (sorts, p, nearest, farther, gate))
        if found is None:
            return None
        landmarks = [tracks.names[slot] for slot in found.slots.tolist()]
        scan.report.seen_at = p
        scan.report.compared = Compared(found.rows, found.numbers, landmarks, found.compared, found.places)
        return [tracks.names[slot] for slot in found.at.tolist()]

    def read(self, names: list[Id]) -> Marginal:
        """Return the joint marginal of robot, mount and landmarks, those known exactly among them."""
        scan = self.scan
        mapped = [name for name in names if name not in self._known]
        read = scan.map.marginal(scan.robot, scan.channel.second(scan.robot), scan.tracks.slots_of(mapped))
        if len(mapped) == len(names):
            return read
        known = [name for name in names if name in self._known]
        read = append_known(read, [self._known.model(name).space for name in known], [*map(self._known.mean, known)])
        at = {name: i for i, name in enumerate(mapped + known)}
        return read._replace(slots=read.slots[[at[name] for name in names]])

    def distances(self, candidates: list[Id]) -> Array:
        """Return the squared Mahalanobis distances (K, L) of the observations from the candidates.  [S] (83).

        inf where a candidate is not near an observation.  A class that is reported adds what it is unlikely
        (`tracks/classes.py`).
        """
        return self._distances(candidates) + self.class_distances(candidates)

    def _distances(self, candidates: list[Id]) -> Array:
        d2 = np.full((len(self.y), len(candidates)), np.inf)
        if self._pairs is None:
            rows, numbers = (a.ravel() for a in np.indices(d2.shape))
            nowhere, read = np.zeros((len(candidates), 0)), None
            if any(name in self._known for name in candidates):
                slots, read = np.arange(len(candidates)), self.read(candidates)
            else:
                slots = self.scan.tracks.slots_of(candidates)
            d2[rows, numbers] = self._squared(Pairs(rows, numbers, slots, nowhere, read), candidates)
            return d2
        pairs, columns = self._pairs, self._pairs.numbers
        if candidates != self._names:
            at = {name: i for i, name in enumerate(candidates)}
            columns = np.array([at.get(name, -1) for name in self._names], dtype=np.int64)[columns]
            kept = columns >= 0
            columns, pairs = columns[kept], pairs._replace(rows=pairs.rows[kept], numbers=pairs.numbers[kept])
        d2[pairs.rows, columns] = squared = self._squared(pairs, self._names)
        self.scan.report.compared = Compared(pairs.rows, pairs.numbers, self._names, squared, pairs.places)
        return d2

    def _squared(self, pairs: Pairs, names: list[Id]) -> Array:
        """Return the squared distances (M,) of pairs of an observation and a landmark."""
        out = np.empty(len(pairs.rows))
        for model, which in self.scan.tracks.any_by_model(self.scan.channel, names):
            some = slice(None) if len(which) == len(names) else np.isin(pairs.numbers, which)
            k, l = pairs.rows[some], pairs.numbers[some]
            if pairs.marginal is None:
                out[some] = self.scan.predict(model, pairs.slots[l], k)[1]
            else:
                m, robot, mount, here = pairs.marginal
                R = self.scan.R[k]
                if self.scan.noise_varies:
                    R = self.scan.noise_of(model, m.means(here[l], model.d), k)
                out[some] = model.predict(m, robot, mount, here[l], self.y[k], R)[1]
            if self.scan.channel.joins:
                tracks = [self.scan.tracks.confirmed[names[i]] for i in l.tolist()]
                out[some] = np.where(
                    disjoint_from_walls(self.scan, model.landmark, tracks, k, out[some]), np.inf, out[some]
                )
        return out

    def class_distances(self, names: list[Id]) -> Array:
        """Return how much of the squared distances (K, L) from landmarks is of the classes that are reported."""
        return self.scan.class_distances(names)[0]

    # ------------------------------------------------------------------ jointly
    def jointly(self, rows: Index, names: list[Id]) -> tuple[Array, Array]:
        """Return the innovations z (M, p) of M pairs of an observation and a landmark, and their Z (M p, M p).

        The noise of an observation is in the blocks of its pairs, not between them: only one of them can be right.
        """
        scan, p = self.scan, self.scan.channel.dof
        m, robot, mount, here = self.read(names)
        z, R, H, at = np.empty((len(rows), p)), np.empty((len(rows), p, p)), [], []
        for model, which in scan.tracks.any_by_model(scan.channel, names):
            index, _, mean = observed_block(m.x, m.blocks, m.atoms, robot, mount, here[which], model.d)
            head = len(mean) - model.d * len(which)
            l = mean[head:].reshape(len(which), model.d)
            _, z[which], E_h, E_l = linearize(model.model, mean[:head], l, scan.y[rows[which]])
            R[which] = scan.noise_of(model, l, rows[which])
            H += [(i, E_h[k], E_l[k]) for k, i in enumerate(which)]
            h, d = E_h.shape[2], E_l.shape[2]
            at += [np.concatenate([index[:h], index[h + k * d : h + (k + 1) * d]]) for k in range(len(which))]
        index = np.concatenate(at)
        S, starts = kernels.submatrix(m.P, index), np.cumsum([0, *(len(a) for a in at)])
        J = np.zeros((z.size, len(index)))
        for (i, E_h, E_l), start, end in zip(H, starts[:-1], starts[1:], strict=True):
            J[i * p : (i + 1) * p, start:end] = np.hstack([E_h, E_l])
        Z = J @ S @ J.T
        add_blocks(Z, R)
        return z, Z

    def together(self, names: list[Id]) -> Candidates | None:
        """Return candidates for joint queries; None if of several kinds, or if this sensor gives no places."""
        scan = self.scan
        if not scan.channel.gives_places or len(sorts := {scan.tracks.sort(name) for name in names}) > 1:
            return None
        read = None if self._pairs is None else self._pairs.marginal
        if read is not None and names != self._names:
            at = {name: i for i, name in enumerate(self._names)}
            read = read._replace(slots=read.slots[[at[n] for n in names]]) if at.keys() >= set(names) else None
        model = scan.channel.models[str(sorts.pop())]
        return Candidates(scan, model, self.read(names) if read is None else read, names)


class Candidates:
    """Landmarks of one kind that a scan may show, for joint queries; `read` is a joint marginal that has them."""

    def __init__(self, scan: ScanContext, model: ObservationModel, read: Marginal, names: list[Id]) -> None:
        self._scan, self._model, self._read = scan, model, read
        self._of_classes, self._of_new = scan.class_distances(names)

    def places(self) -> Places:
        """Return where all observations seem to be from the sensor (K, n), where the landmarks are, and covariances."""
        n = self._scan.dimensions
        v, V_y = self._scan.channel.sensor.invert(self._scan.y)
        V = V_y[:, :n] @ self._scan.R @ V_y[:, :n].swapaxes(1, 2)
        m, _, _, here = self._read
        rows = (m.blocks[here, P_AT][:, None] + np.arange(n)).ravel()
        return np.ascontiguousarray(v[:, :n]), V, m.means(here, n), kernels.submatrix(m.P, rows)

    def fit(self, rows: Index, columns: Index) -> tuple[float, float]:
        """Return the joint d2 and log |Z| of pairs of an observation `rows` (M,) and a landmark `columns` (M,)."""
        m, robot, mount, here = self._read
        model, y = self._model, self._scan.y[rows]
        R = self._scan.noise_of(model, m.means(here[columns], model.d), rows)
        run = form_for(model.model, corrections.scan_fit)
        scan = robot, mount, here[columns], model.d, y, np.ascontiguousarray(R), np.inf
        d2, log_det = run(model.model, m.whole, scan, LIMITS)
        return float(d2 + self._of_classes[rows, columns].sum()), float(log_det)

    def log_volume_ratio(self, rows: Index, columns: Index) -> Array:
        """Return log |Z| / |R| (M,) of each pair: twice the information that the measurement gives."""
        if not len(rows):
            return np.zeros(0)
        m, robot, mount, here = self._read
        R = self._scan.noise_of(self._model, m.means(here[columns], self._model.d), rows)
        Z, _ = self._model.predict(m, robot, mount, here[columns], self._scan.y[rows], R)
        return log_volume_ratio(Z, R)

    def log_density(self, rows: Index) -> Array:
        """Return the logarithm of the density of landmarks where observations (M,) seem to be, in their units.

        That of the landmarks nearest to there, but for the one that an observation may be of; of those of the class
        that is reported.
        """
        scan, channel, n = self._scan, self._scan.channel, self._scan.dimensions
        v, V, l, _ = self.places()
        p = channel.landmark.from_view(scan.pose(), channel.calibrated(scan.map).invert(scan.y[rows])[0])[0]
        gaps = np.sort(np.linalg.norm(p[:, None, :n] - l, axis=2), axis=1)[:, 1 : NEIGHBOURS + 1]
        found = log_density(gaps, np.linalg.norm(v[rows], axis=1), n) + log_volume_change(V[rows], scan.R[rows])
        return found - 0.5 * self._of_new[rows]
