"""Associations that weigh matchings of a whole scan: the likeliest, one drawn, their mean, or what agrees by itself."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.association.gated import Gated, JointCompatibility, assign
from kalmark.association.posterior import (
    WELL_KNOWN,
    Posterior,
    consistent_matchings,
    expected_in_gate,
    least_increase,
    posterior,
)
from kalmark.association.protocol import Answer, Matched
from kalmark.association.query import Query
from kalmark.declare import Count, Within, declared, register
from kalmark.events import Id
from kalmark.geometry.gaussian import gate as chi2_gate

NEW, DEFERRED, MIXTURE, REMAP = (each.value for each in (Answer.NEW, Answer.DEFERRED, Answer.MIXTURE, Answer.REMAP))

NONE = 0.99  # how likely an observation must be of nothing in the map to be of something new
BY_CHANCE = 1e-3  # matchings as good to be expected by chance where there is more than one landmark in a gate
WIDEST = 256  # candidates for an observation


@declared
class Weighing(Gated):
    """Matchings as wholes, of landmarks however many are inside a gate.

    An observation of what is likely not in the map, by all matchings together, is new.  Where a gate holds more than
    one landmark on average, not counting those just seen, or its heading is unknown, the robot is lost: pairs are then
    not held against the pose one by one.
    """

    most_nodes: Annotated[Count, "Comparisons of pairs after which the search ends."] = 5_000_000

    weighs: ClassVar[bool] = True  # it decides itself what is ambiguous
    nearest: ClassVar[int] = 8
    farther: ClassVar[float] = math.inf

    def threshold(self, m: int, default: float) -> float:
        """Return that any pair of a matching is fused: it was tested as a whole."""
        return math.inf

    def near(self, query: Query, open_: Index, gate: float, nearest: int = 0) -> tuple[list[Id], Array]:
        """Return candidates, so many that each observation has one outside its gate, and d2 (K, L)."""
        nearest = nearest or (WIDEST if query.scan.adrift else self.nearest)
        names, d2 = super().near(query, open_, gate, nearest)
        if nearest < WIDEST and ((d2 <= gate).sum(axis=1) >= nearest).any():
            return self.near(query, open_, gate, 4 * nearest)
        return names, d2

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Pair one by one by d2 (K, L) where each observation is certain alone, jointly elsewhere."""
        together = query.together(names)
        if together is None:
            return JointCompatibility(self.gate, self.new_gate).match(query, open_, names, d2, gate)
        rows, columns = np.nonzero(np.isfinite(d2))
        just = np.zeros(d2.shape, dtype=np.bool_)
        just[rows, columns] = together.log_volume_ratio(open_[rows], columns) <= WELL_KNOWN
        fit, far = d2 <= gate, chi2_gate(self.new_gate, query.dof())
        lost = query.scan.adrift or expected_in_gate(np.where(just, np.inf, d2), gate, query.dof()).max() > 1
        if not lost and not fit[~just].any() and max(fit.sum(axis=0).max(), fit.sum(axis=1).max()) <= 1:
            query.count_reobserved(fit.sum())
            return Matched(np.where(fit.any(axis=1), fit.argmax(axis=1), -1), {})
        near: Flags = np.isfinite(d2) if lost else fit  # far off, the distances themselves are not valid
        search = self.gate, self.most_nodes, query.experience()
        found = posterior(together, open_, d2, near, just, query.dof(), *search)
        paired = np.asarray(near.any(axis=1))
        pairs, reasons, mixed = self.choose(query, names, found, paired, lost)
        none = np.where(paired, found.none() if found.finished else np.nan, np.where(d2.min(axis=1) > far, 1.0, np.nan))
        if lost and (pairs == REMAP).all():  # it has not recognised anything
            return self.remapped(np.where(just, d2, np.inf), gate, far, reasons)
        for row in np.flatnonzero(paired & (none >= NONE)).tolist() if not lost else ():
            pairs[row], reasons[row] = NEW, "no landmark is likely there"
        for row in np.flatnonzero(pairs == -1).tolist() if (pairs >= 0).any() else ():
            if least_increase(together, open_, pairs, row, np.flatnonzero(d2[row] <= far)) > far:
                pairs[row], reasons[row] = NEW, "no landmark fits there, from where the others are seen"
        query.count_reobserved(found.again(just) if found.finished else 0.0)
        return Matched(pairs, reasons, mixed)

    def remapped(self, d2: Array, gate: float, far: float, reasons: dict[int, str]) -> Matched:
        """Pair the observations of a lost robot with landmarks just seen, by d2 (K, L); map others again."""
        pairs = assign(d2, gate)
        pairs = np.where(pairs >= 0, pairs, np.where(d2.min(axis=1) > far, REMAP, DEFERRED))
        return Matched(pairs, reasons)

    def choose(self, query: Query, names: list[Id], found: Posterior, near: Flags, lost: bool) -> Matched:
        """Choose from the matchings; `near` (K,) marks the observations with a candidate inside the gate."""
        raise NotImplementedError


@register("association", "auto")
class Automatic(Weighing):
    """One by one where the pose is clear, the likeliest matching where it is not; what is ambiguous is deferred.

    Where gates are small against the gaps between landmarks, that is the global assignment.  Elsewhere the likeliest of
    the matchings whose pairs agree with each other is taken (`posterior`), and of it each pair that is at least as
    probable as `confidence`; the others are deferred.  A matching of a lost robot is only taken if it holds most of the
    scan, none as good is expected by chance, and none with a pair less is of another pose.

    >>> lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1))
    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar})
    >>> slam = km.Slam(rover, association=km.association.Automatic())
    >>> for name, place in {7: (4.0, 1.0), 8: (2.0, -1.0)}.items():
    ...     slam.add_landmark(name, mean=place, cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24], [2.2, -0.46]]))
    >>> [(o.outcome, o.landmark) for o in report.observations]
    [('associated', 7), ('associated', 8)]
    """

    confidence: Annotated[
        float, Within(ge=0, lt=1), "A pair of the likeliest matching that is less probable is deferred."
    ] = 0.9

    def choose(self, query: Query, names: list[Id], found: Posterior, near: Flags, lost: bool) -> Matched:
        """Choose the most probable matching, defer its uncertain pairs; `near` (K,) as in `choose` above."""
        count = int((found.pairs[0] >= 0).sum())
        if lost and (found.chance > BY_CHANCE or found.elsewhere or 2 * count <= len(near)):
            why = f"its scan is ambiguous: {count} pairs, {found.chance:.1g} matchings as good are expected by chance"
            why += f", {found.elsewhere} with at most a pair less fit from elsewhere"
            why = why if count else "no matching of its scan is likely"
            return Matched(np.full(len(near), REMAP), dict.fromkeys(range(len(near)), why))
        pairs, shares = found.pairs[0].copy(), found.shares()
        unsure = ((shares < self.confidence) | (not found.finished)) & near
        reasons = {row: found.why(row, names) for row in np.flatnonzero(unsure).tolist()}
        pairs[unsure] = DEFERRED
        return Matched(pairs, reasons)


@register("association", "sample")
class Sampled(Weighing):
    """A matching drawn by how likely each is.

    [F]'s independent samples from the posterior.

    The same scan draws the same matching for the same `seed`.

    >>> lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1))
    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar})
    >>> slam = km.Slam(rover, association=km.association.Sampled())
    >>> for name, place in {7: (4.0, 1.0), 8: (2.0, -1.0)}.items():
    ...     slam.add_landmark(name, mean=place, cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24], [2.2, -0.46]]))
    >>> [(o.outcome, o.landmark) for o in report.observations]
    [('associated', 7), ('associated', 8)]
    """

    seed: Annotated[int, Within(ge=0), "Another one draws others."] = 0

    def choose(self, query: Query, names: list[Id], found: Posterior, near: Flags, lost: bool) -> Matched:
        """Draw one matching; `near` (K,) marks the observations with a candidate."""
        rng = np.random.default_rng([self.seed, *query.key()])
        drawn = int(rng.choice(len(found.weights), p=found.weights))
        why = f"drawn with the probability {found.weights[drawn]:.2f}"
        return Matched(found.pairs[drawn].copy(), dict.fromkeys(range(len(near)), why))


@register("association", "jpda")
class Averaged(Weighing):
    """The mean over all matchings, each by how likely it is; for a dense map.

    As [F] would ideally: JPDA, but jointly for a whole scan.

    The map becomes the mean of what it would be after each, and its covariance holds how far these are apart.  Needs a
    dense map.

    >>> lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1))
    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar})
    >>> slam = km.Slam(rover, association=km.association.Averaged())
    >>> for name, place in {7: (4.0, 1.0), 8: (2.0, -1.0)}.items():
    ...     slam.add_landmark(name, mean=place, cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24], [2.2, -0.46]]))
    >>> [(o.outcome, o.landmark) for o in report.observations]
    [('associated', 7), ('associated', 8)]
    """

    averages: ClassVar[bool] = True

    def choose(self, query: Query, names: list[Id], found: Posterior, near: Flags, lost: bool) -> Matched:
        """Average over the observations `near` (K,) that have a candidate."""
        unlikely = (found.pairs >= 0).T @ found.weights < 0.5
        pairs = np.where(near & ~unlikely, MIXTURE, -1)
        return Matched(pairs, {row: found.why(row, names) for row in np.flatnonzero(near).tolist()}, found)


@register("association", "clique")
class Cliques(Gated):
    """The largest set of pairs that agree with each other wherever the robot is, if it fits jointly.

    Bailey 2002.

    Two pairs agree if the landmarks are as far from each other as the observations are; the pose is not used before the
    joint test.  Where two sets as large contradict each other, both are deferred.  For the closing of loops.

    >>> lidar = km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1))
    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": lidar})
    >>> slam = km.Slam(rover, association=km.association.Cliques())
    >>> for name, place in {7: (4.0, 1.0), 8: (2.0, -1.0)}.items():
    ...     slam.add_landmark(name, mean=place, cov=0.01 * np.eye(2))
    >>> report = slam.process(km.Scan(0.0, "rover", "lidar", [[4.12, 0.24], [2.2, -0.46]]))
    >>> [(o.outcome, o.landmark) for o in report.observations]
    [('associated', 7), ('associated', 8)]
    """

    most_nodes: Annotated[Count, "Comparisons of pairs after which the search ends."] = 5_000_000

    weighs: ClassVar[bool] = True
    nearest: ClassVar[int] = WIDEST
    farther: ClassVar[float] = math.inf

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Pair by the largest clique of the pairs with d2 (K, L) inside the gate."""
        together = query.together(names)
        if together is None:
            return JointCompatibility(self.gate, self.new_gate).match(query, open_, names, d2, gate)
        found, finished = consistent_matchings(together, open_, d2, np.isfinite(d2), self.gate, self.most_nodes)
        sizes, fit = (found >= 0).sum(axis=1), np.full(len(found), np.inf)
        for i, pairs in enumerate(found):
            rows = np.flatnonzero(pairs >= 0)
            fit[i] = together.fit(open_[rows], pairs[rows])[0]
        fits = fit <= [chi2_gate(self.gate, query.dof() * int(n)) for n in sizes]
        best = np.flatnonzero(fits & (sizes == sizes[fits].max(initial=0)))
        if not len(best):
            return Matched(np.full(len(d2), -1), {})
        alike = (found[best] == found[best[0]]).all(axis=0)
        why = "cliques as large contradict each other" + ("" if finished else ", and the search was not finished")
        pairs = np.where(alike, found[best[0]], DEFERRED)
        return Matched(pairs, dict.fromkeys(np.flatnonzero(~alike).tolist(), why))
