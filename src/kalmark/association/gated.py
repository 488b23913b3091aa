"""Associations by the ids of the log, or by what fits: each for itself, as an assignment, or jointly."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.association.matchings import best_matching
from kalmark.association.protocol import NEW, Answer, Decision, Matched, Mixture
from kalmark.association.query import Query
from kalmark.declare import Count, Probability, Within, declared, register
from kalmark.events import Id
from kalmark.geometry.gaussian import gate as chi2_gate

FORBIDDEN = 1e6  # times the gate: a pair outside

Gate = float | Literal["off", "default"]


@declared
class Gated:
    """Pairs of observations and landmarks inside an individual gate; ids are used where given.

    Beyond `new_gate` from every landmark an observation is a new one; what is nearer than that and stays without a pair
    is left alone.
    """

    gate: Annotated[Probability, "Pair an observation with a landmark inside this probability."] = 0.99
    new_gate: Annotated[
        Probability, "Beyond this probability from every landmark it is a new one; in between it is left alone."
    ] = 0.99999

    nearest: ClassVar[int] = 4  # candidates for an observation,
    farther: ClassVar[float] = 10.0  # within so many times the nearest distance
    alone: ClassVar[bool] = False  # whether each is of the nearest, where all can only be of one

    def threshold(self, m: int, default: float) -> float:
        """Return the gate as a squared Mahalanobis distance."""
        return chi2_gate(self.gate, m)

    def associate(self, query: Query) -> list[Decision]:
        """Answer with the ids where there are, with the pairs of `match` elsewhere."""
        if self.alone and (sure := query.nearest(self.nearest, self.farther, chi2_gate(self.gate, query.dof()))):
            return [(name, "") for name in sure]
        answers: list[Decision] = [(i, "") if i is not None else (NEW, "no landmark near") for i in query.ids]
        open_ = np.array([k for k, i in enumerate(query.ids) if i is None], dtype=np.int64)
        gate, far = chi2_gate(self.gate, query.dof()), chi2_gate(self.new_gate, query.dof())
        names, d2 = self.near(query, open_, gate) if len(open_) else ([], np.zeros((0, 0)))
        if not names:
            return answers
        pairs, reasons, mixed = self.match(query, open_, names, d2, gate)
        mixture = None if mixed is None else Mixture(open_, names, mixed)
        for row, (k, pair) in enumerate(zip(open_.tolist(), pairs.tolist(), strict=True)):
            if pair >= 0:
                answers[k] = (names[pair], reasons.get(row, ""))
                continue
            nearest = int(d2[row].argmin())
            d = float(d2[row, nearest])
            if pair == Answer.MIXTURE.value and mixture is not None:
                answers[k] = (mixture, reasons[row])
            elif pair < Answer.NONE.value:
                answers[k] = (Answer(pair), reasons[row])
            elif d <= gate:
                why = f"its nearest landmark {names[nearest]!r} is another observation's"
                answers[k] = (None, reasons.get(row, why))
            elif d <= far:
                answers[k] = (None, f"between {names[nearest]!r} and a new landmark: d2 {d:.1f}")
        return answers

    def near(self, query: Query, open_: Index, gate: float, nearest: int = 0) -> tuple[list[Id], Array]:
        """Return the candidates and their squared distances d2 (K, L) from the observations `open_`."""
        named = set(query.ids)
        names = [c for c in query.candidates(nearest or self.nearest, self.farther) if c not in named]
        d2 = query.distances(names) if names else np.zeros((len(query.ids), 0))
        return names, np.fmin(d2 if len(open_) == len(d2) else d2[open_], np.inf)  # NaN is as far as can be

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Return the number of the name paired with each row of d2 (K, L), -1 for none or its like, and why."""
        raise NotImplementedError


def assign(d2: Array, gate: float) -> Index:
    """Return the column for each row of d2 (K, L) whose sum is least, -1 for none, which counts as the gate."""
    from scipy.optimize import linear_sum_assignment

    count = d2.shape[1]
    cost = np.full((len(d2), count + len(d2)), gate)
    cost[:, :count] = np.where(d2 <= gate, d2, FORBIDDEN * gate)
    columns = linear_sum_assignment(cost)[1]
    return np.where(columns < count, columns, -1)


@register("association", "nearest")
class NearestNeighbour(Gated):
    """The nearest landmark by Mahalanobis distance, inside its gate.

    Each is taken at most once in a scan, the closest pair first.

    >>> lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1))
    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar})
    >>> slam = km.Slam(rover, association=km.association.NearestNeighbour())
    >>> for name, place in {7: (4.0, 1.0), 8: (2.0, -1.0)}.items():
    ...     slam.add_landmark(name, mean=place, cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24], [2.2, -0.46]]))
    >>> [(o.outcome, o.landmark) for o in report.observations]
    [('associated', 7), ('associated', 8)]
    """

    alone: ClassVar[bool] = True

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Pair greedily by d2 (K, L); an observation whose nearest landmark is taken gets none."""
        columns = d2.argmin(axis=1)
        nearest, least = columns.tolist(), d2[np.arange(len(d2)), columns]
        fits = (least <= gate).tolist()
        if all(fits) and len(set(nearest)) == len(nearest):
            return Matched(columns, {})
        pairs, reasons, taken = np.full(len(d2), -1), {}, set()
        for row in np.argsort(least, kind="stable").tolist():
            column = nearest[row]
            if column in taken:
                reasons[row] = f"its nearest landmark {names[column]!r} is taken by a nearer observation"
            elif fits[row]:
                taken.add(column)
                pairs[row] = column
        return Matched(pairs, reasons)


@register("association", "global")
class GlobalAssignment(Gated):
    """The pairs of the whole scan whose squared Mahalanobis distances add up to the least.

    An observation without a pair counts as the gate.  Bipartite matching: an observation gives way to another if that
    makes the whole better.

    >>> lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1))
    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar})
    >>> slam = km.Slam(rover, association=km.association.GlobalAssignment())
    >>> for name, place in {7: (4.0, 1.0), 8: (2.0, -1.0)}.items():
    ...     slam.add_landmark(name, mean=place, cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24], [2.2, -0.46]]))
    >>> [(o.outcome, o.landmark) for o in report.observations]
    [('associated', 7), ('associated', 8)]
    """

    alone: ClassVar[bool] = True

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Pair by the linear assignment of the whole scan, of d2 (K, L)."""
        return Matched(assign(d2, gate), {})


@register("association", "jcbb")
class JointCompatibility(Gated):
    """The largest set of pairs that fit together (JCBB): for a pose known worse than landmarks are apart.

    Neira and Tardos 2001.  The error of the pose is common to all observations of a scan, which only a joint test
    considers.  At most `most_nodes` of the search are examined; the best matching by then is taken.

    >>> lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1))
    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar})
    >>> slam = km.Slam(rover, association=km.association.JointCompatibility())
    >>> for name, place in {7: (4.0, 1.0), 8: (2.0, -1.0)}.items():
    ...     slam.add_landmark(name, mean=place, cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24], [2.2, -0.46]]))
    >>> [(o.outcome, o.landmark) for o in report.observations]
    [('associated', 7), ('associated', 8)]
    """

    most_nodes: Annotated[Count, "Nodes of the search after which the best so far is taken."] = 20_000

    nearest: ClassVar[int] = 16
    farther: ClassVar[float] = math.inf

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Pair by branch and bound on d2 (K, L), the observations with the fewest candidates first."""
        order = np.argsort((d2 <= gate).sum(axis=1), kind="stable")
        fitting = [np.flatnonzero(d2[row] <= gate) for row in order]
        fitting = [columns[np.argsort(d2[row, columns])] for row, columns in zip(order, fitting, strict=True)]
        first, columns = np.cumsum([0, *(len(c) for c in fitting)]), np.concatenate(fitting)
        pairs = np.full(len(d2), -1)
        if not len(columns):
            return Matched(pairs, {})
        rows = np.repeat(open_[order], np.diff(first))
        z, Z = query.jointly(rows, [names[c] for c in columns.tolist()])
        more = query.class_distances(names)[rows, columns]
        gates = np.array([0.0, *(chi2_gate(self.gate, z.shape[1] * (n + 1)) for n in range(len(d2)))])
        chosen, finished = best_matching(first, columns, z, Z, more, gates, self.most_nodes)
        pairs[order] = np.where(chosen >= 0, columns[chosen], -1)
        why = "it does not fit with the others" + ("" if finished else f", by a search of {self.most_nodes} nodes")
        return Matched(pairs, dict.fromkeys(range(len(d2)), why))


@register("association", "identity")
class ByIdentity:
    """Associate by the ids of the log.

    An id that is not in the map yet is a new landmark.

    `gate` is the probability with which a right pair is let through; "off" fuses all; "default" is the estimator's own:
    the guide's 3 sigma for `Ekf`, off for the others.

    >>> lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1))
    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar})
    >>> slam = km.Slam(rover, association=km.association.ByIdentity())
    >>> for name, place in {7: (4.0, 1.0), 8: (2.0, -1.0)}.items():
    ...     slam.add_landmark(name, mean=place, cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24], [2.2, -0.46]], ids=[7, 8]))
    >>> [(o.outcome, o.landmark) for o in report.observations]
    [('associated', 7), ('associated', 8)]
    """

    gate: Annotated[Gate, Within(gt=0, lt=1), "Refuse observations outside this probability; or off, or default."] = (
        "default"
    )

    def threshold(self, m: int, default: float) -> float:
        """Return the gate as a squared Mahalanobis distance."""
        if self.gate == "default":
            return default
        return math.inf if self.gate == "off" else chi2_gate(float(self.gate), m)

    def associate(self, query: Query) -> list[Decision]:
        """Return the ids as they are; `Slam` decides which are new."""
        return [(i, "") if i is not None else (None, "no id in the log") for i in query.ids]
